"""The colors of a finished fit: their mean is that of the tree, and they are rounded to few bits."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, unpremultiply
from bbfit.operators.config import Backend
from bbfit.rendering.dispatch import render
from bbfit.views.view_set import ViewSet, evenly

# Texels are clamped to [0, 1], and layers hide each other, so one round of factors is not exact.
_ROUNDS = 3
# Largest factor of a channel, and its inverse the smallest.
_LARGEST = 2.0
# Texels on a side of the square whose mean color counts, and the least mean alpha there.
_AROUND, _LEAST_ALPHA = 5, 1e-4


def matched_colors(cloud: BillboardCloud, views: ViewSet, backend: Backend = "auto") -> BillboardCloud:
    """Multiply each color channel of a cloud by one number so that its mean color is that of the views.

    A mean color is the sum of premultiplied color over the sum of alpha, over all pixels of at most 24 views, evenly spaced. Where texels
    are larger than leaves, or few billboards stand in for depth, alpha is too low in the middle of the crown, and a fit of color and alpha
    together makes up for it with colors that are too dark or too strong. Before a background of another color, that shows.
    """
    indices = evenly(range(len(views)))
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


def smoothed_colors(cloud: BillboardCloud) -> BillboardCloud:
    """Mix the color of each texel with the mean color around it, the more the fainter the texel is; opaque texels stay as they are.

    Faint texels hardly show, so a fit leaves them any color. But programs average straight color and alpha apart for mip levels, so faint
    texels count there as much as opaque ones: without this step, an acer lost 5 % of its chroma. The mean is over 5 x 5 texels, weighted
    by alpha. With a mask, texels are opaque from the cutoff on.
    """
    full, textures = cloud.alpha.cutoff if cloud.alpha.kind == "mask" else 1.0, []
    for texture in cloud.textures():
        color, seen = texture[..., :3], (texture[..., 3:] / full).clamp(max=1)
        weighted = premultiply(torch.cat([color, seen], -1)).movedim(3, 1)
        around = unpremultiply(avg_pool2d(weighted, _AROUND, 1, _AROUND // 2).movedim(1, 3))
        mixed = torch.where(around[..., 3:] > _LEAST_ALPHA, seen * color + (1 - seen) * around[..., :3], color)
        textures.append(torch.cat([mixed, texture[..., 3:]], -1).reshape(-1, 4))
    return cloud.with_texels(torch.cat(textures))


def _mean_color(pictures: Iterable[Tensor]) -> Tensor | None:
    """The mean straight color of premultiplied pictures, float64 [3], or ``None`` if all of them are transparent."""
    total = sum((picture.double().cpu().sum((0, 1, 2)) for picture in pictures), torch.zeros(4, dtype=torch.float64))
    return total[:3] / total[3] if float(total[3]) > 0 else None
