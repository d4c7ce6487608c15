"""The colors of a finished fit: their mean is that of the tree, and they are rounded to few bits."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.config import Backend
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet

# Most views to compare. Texels are clamped to [0, 1], and layers hide each other, so one round of factors is not exact.
_VIEWS, _ROUNDS = 24, 3
# Largest factor of a channel, and its inverse the smallest.
_LARGEST = 2.0


def matched_colors(cloud: BillboardCloud, views: ViewSet, backend: Backend = "auto") -> BillboardCloud:
    """Multiply each color channel of a cloud by one number so that its mean color is that of the views.

    A mean color is the sum of premultiplied color over the sum of alpha, over all pixels of at most 24 views, evenly spaced. Where texels
    are larger than leaves, or few billboards stand in for depth, alpha is too low in the middle of the crown, and a fit of color and alpha
    together makes up for it with colors that are too dark or too strong. Before a background of another color, that shows.
    """
    indices = [index * len(views) // _VIEWS for index in range(_VIEWS)] if len(views) > _VIEWS else list(range(len(views)))
    cameras, target = views.cameras[indices], _mean_color(views.targets([index]) for index in indices)
    if target is None or len(cloud) == 0:
        return cloud
    with torch.no_grad():
        for _ in range(_ROUNDS):
            drawn = _mean_color(render(cloud, cameras[[index]].to(cloud.texels.device), backend=backend) for index in range(len(indices)))
            if drawn is None:
                break
            factors = (target / drawn.clamp_min(1e-6)).clamp(1 / _LARGEST, _LARGEST).to(cloud.texels)
            cloud = cloud.with_texels(torch.cat([(cloud.texels[:, :3] * factors).clamp(0, 1), cloud.texels[:, 3:]], 1))
    return cloud


def _mean_color(pictures: Iterable[Tensor]) -> Tensor | None:
    """The mean straight color of premultiplied pictures, float64 [3], or ``None`` if all of them are transparent."""
    total = sum((picture.double().cpu().sum((0, 1, 2)) for picture in pictures), torch.zeros(4, dtype=torch.float64))
    return total[:3] / total[3] if float(total[3]) > 0 else None
