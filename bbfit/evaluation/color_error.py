"""How different a tree and its billboards look at a size on the screen, and the size from which nobody sees it."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable

import torch
from torch import Tensor

from bbfit.evaluation.backgrounds import mean_flip_map
from bbfit.evaluation.scoring import held_out
from bbfit.geometry.camera import Camera
from bbfit.images import shrunk
from bbfit.views.view_set import ViewSet, evenly

# FLIP's filters reach 10 pixels at 67 pixels a degree; so far, the background around the tree counts.
_AROUND = 10
# The ratio of neighboring sizes.
_STEP = 2**0.25


def color_error(target: Tensor, image: Tensor) -> float:
    """Perceived difference of two premultiplied RGBA pictures [H, W, 4] at their size on the screen, in [0, 1]; 0 for two empty ones.

    It is FLIP (:func:`~bbfit.evaluation.metrics.flip_map`), the mean over :data:`~bbfit.evaluation.backgrounds.BACKGROUNDS` and over the
    pixels of the tree, each weighted by the larger alpha of both. FLIP is made for pictures that replace each other, as levels of detail
    do. It filters them as the eye does, so that the difference of a small tree is faint.

    What is visible? Measured on 60 pairs of even colors of leaves and bark: pairs 2.3 dE*ab apart, just noticeable (Mahy et al. 1994,
    "Evaluation of uniform color spaces developed after the adoption of CIELAB and CIELUV"), have a mean of 0.10; 3 dE, hardly perceptible,
    0.11; 6 dE, the end of what is acceptable side by side (Hardeberg 1999, "Acquisition and reproduction of colour images"), 0.19.
    """
    target, image = (torch.nn.functional.pad(picture.double(), (0, 0, *[_AROUND] * 4)) for picture in (target, image))
    weights = torch.maximum(target[..., 3], image[..., 3]).numpy()
    total = float(weights.sum())
    return float((mean_flip_map(target, image) * weights).sum()) / total if total else 0.0


def mean_color_error(draw: Callable[[Camera], Tensor], views: ViewSet, share: float) -> float:
    """The mean :func:`color_error` of a model in views that are reduced to a ``share`` of their size, in (0, 1]; 0 without views.

    At most 24 views count, evenly spaced. ``draw`` is as for :func:`~bbfit.evaluation.scoring.held_out`. Pictures are drawn at the views'
    size and averaged by area, as a screen with many samples a pixel shows them.
    """
    chosen = evenly(range(len(views)))
    pairs = (held_out(draw, views, index) for index in chosen)
    return sum(color_error(*(_reduced(picture, share) for picture in pair)) for pair in pairs) / max(1, len(chosen))


def share_within(draw: Callable[[Camera], Tensor], views: ViewSet, most: float, share: float = 1.0) -> float:
    """The largest share of the views' size, at most ``share``, at which the mean :func:`color_error` is at most ``most``.

    Shares are a fourth root of 2 apart. This relies on smaller pictures differing less. Pictures of one pixel are taken to differ by less
    than anybody sees.
    """
    side = max(views.cameras.width, views.cameras.height)
    steps = range(max(0, math.ceil(math.log(share * side, _STEP))))
    return share / _STEP ** bisect_left(steps, True, key=lambda step: mean_color_error(draw, views, share / _STEP**step) <= most)


def _reduced(picture: Tensor, share: float) -> Tensor:
    height, width = (max(1, round(share * side)) for side in picture.shape[:2])
    return shrunk(picture, width, height)
