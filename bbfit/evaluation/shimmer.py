"""Shimmer: how much a model flickers when the camera turns by a degree, relative to how much the tree itself changes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import check_shape, fail
from bbfit.evaluation.backgrounds import BACKGROUNDS, over_background
from bbfit.evaluation.report import ShimmerScore
from bbfit.evaluation.sizes import Draw
from bbfit.geometry.camera import Camera
from bbfit.images import shrunk
from bbfit.views.dataset import TurnedViews

SIDES = (512, 256, 128, 64, 32)
"""Longer sides of the pictures in pixels; those longer than the views' are left out."""


def score_shimmer(draw: Draw, pairs: TurnedViews, antialiased: Draw | None = None) -> tuple[ShimmerScore, ...]:
    """Compare the change of a model between neighboring views with that of the tree, at each of :data:`SIDES` that the views allow.

    The change of two pictures is their mean absolute difference (:func:`change`); the ratio is that of the sums over all pairs, so a pair
    in which little happens counts little. The tree's pictures are averaged to each size by area (:func:`~bbfit.images.shrunk`).
    The model is drawn at that size, one picture per camera, because a viewer does not average either.

    ``draw`` returns what a batch of B cameras sees: premultiplied RGBA over nothing, [B, H, W, 4], which is then clamped to [0, 1].
    ``antialiased`` is the same for the mask drawn with alpha to coverage. Raises InputError if there are no pairs, or if a render has
    another shape or values that are not finite.

    The change includes the noise of the tree's pictures, which differs between both of a pair. Noise makes the ratio smaller. It averages
    out in small pictures.
    """
    count, cameras = len(pairs.views), pairs.views.cameras
    if count == 0 or len(pairs.turned) != count:
        fail("turned", f"expected as many turned views as views, at least one, got {len(pairs.turned)} and {count}")
    draws = [draw] if antialiased is None else [draw, antialiased]
    longest, scores = max(cameras.width, cameras.height), []
    for side in SIDES:
        if side > longest:
            continue
        width, height = (max(1, round(old * side / longest)) for old in (cameras.width, cameras.height))
        tree, models = 0.0, [0.0] * len(draws)
        for index in range(count):
            tree += change(*(shrunk(part.targets([index], torch.float64)[0], width, height) for part in (pairs.views, pairs.turned)))
            for number, each in enumerate(draws):
                models[number] += change(*_drawn(each, pairs, index, width, height))
        ratios = [model / tree if tree else None for model in models]
        scores.append(ShimmerScore(width, height, tree / count, *ratios))
    return tuple(scores)


def change(first: Tensor, second: Tensor) -> float:
    """The mean absolute difference of two premultiplied RGBA pictures, [H, W, 4], over pixels, color channels and backgrounds, in [0, 1].

    The pictures are compared over :data:`~bbfit.evaluation.backgrounds.BACKGROUNDS`, as in all scores, because that is what a viewer shows:
    a leaf that comes and goes before a background of its color does not flicker.
    """
    pairs = [over_background(first, second, name) for name in BACKGROUNDS]
    return float(np.mean([np.abs(one - other).mean() for one, other in pairs]))


def _drawn(draw: Draw, pairs: TurnedViews, index: int, width: int, height: int) -> Tensor:
    """The renders of a view and of the turned one, float64 [2, h, w, 4]."""
    camera = Camera.joined([part.cameras.resized(width, height)[index] for part in (pairs.views, pairs.turned)])
    with torch.no_grad():
        images = draw(camera).detach().cpu().double()
    name = pairs.views.names[index]
    check_shape(f"the render of view {name}", tuple(images.shape), (2, height, width, 4))
    if not images.isfinite().all():
        fail("draw", f"returned values that are not finite for view {name} at {width} x {height} pixels", "check the model")
    return images.clamp(0, 1)
