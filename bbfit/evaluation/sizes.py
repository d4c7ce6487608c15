"""Scores of a tree seen from afar: in pictures of a half, a quarter and so on of the views' size."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import check_count, check_shape, fail
from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import mean_psnr
from bbfit.evaluation.report import SizeMeasures, SizeScore
from bbfit.geometry.camera import Camera
from bbfit.images import shrunk
from bbfit.views.view_set import ViewSet

Draw = Callable[[Camera], Tensor]
HALVINGS = 4
"""How many times an evaluation halves the views' size."""


def score_sizes(
    draw: Draw,
    views: ViewSet,
    halvings: int = HALVINGS,
    *,
    antialiased: Draw | None = None,
    on_size: Callable[[int, int], None] | None = None,
) -> tuple[SizeScore, ...]:
    """Compare renders at the views' size, at half of it and so on with the views averaged to the same size.

    Returns at most ``halvings + 1`` scores, the largest size first; sizes with a side below 11 pixels
    (:data:`bbfit.evaluation.metrics.SSIM_WINDOW`) are left out. ``draw`` returns what a batch of B cameras sees: premultiplied RGBA over
    nothing, [B, H, W, 4], which is then clamped to [0, 1]. ``antialiased`` is the same for the mask drawn with alpha to coverage.
    ``on_size`` is called after each size with the number of finished sizes and their total. Raises InputError if there are no views, they
    are too small, ``halvings`` is negative, or a render has another shape or values that are not finite.

    A smaller camera covers the same field of view with fewer pixels, as if the tree were farther away. A pixel of the target is the mean,
    by area, of the part of the view that it covers. The mean is taken of premultiplied display-referred values, as in all scores, without
    conversion to linear light; so coverage is the same at all sizes.

    With few samples per pixel the coverage of a small picture of a tree varies by some percent at random. Below the full size the coverage
    of a render is therefore the mean of several renders, 4 at half the size and 16 below, shifted by fractions of a pixel.
    """
    check_count("halvings", halvings, 0)
    if len(views) == 0:
        fail("views", "there is no held-out view to measure on", "give views with a test split")
    metrics.check_size(views.cameras.width, views.cameras.height)
    scores, draws = [], [draw] if antialiased is None else [draw, antialiased]
    for halving in range(halvings + 1):
        width, height = views.cameras.width >> halving, views.cameras.height >> halving
        if min(width, height) >= metrics.SSIM_WINDOW:
            scores.append(SizeScore(width, height, *_measures(draws, views, halving, width, height)))
        if on_size is not None:
            on_size(halving + 1, halvings + 1)
    return tuple(scores)


def _measures(draws: Sequence[Draw], views: ViewSet, halving: int, width: int, height: int) -> list[SizeMeasures]:
    cameras, target_cover = views.cameras.resized(width, height), 0.0
    errors: list[list[tuple[float, float, float]]] = [[] for _ in draws]
    for index, name in enumerate(views.names):
        target = shrunk(views.targets([index], torch.float64)[0], width, height)
        target_cover += float(target[..., 3].sum())
        batch = _shifted(cameras[index], min(halving, 2))
        for own, draw in zip(errors, draws, strict=True):
            with torch.no_grad():
                images = draw(batch).detach().cpu()
            check_shape(f"the render of view {name}", tuple(images.shape), (len(batch), height, width, 4))
            if not images.isfinite().all():
                fail("draw", f"returned values that are not finite for view {name} at {width} x {height} pixels", "check the model")
            centered, *shifted = images.clamp(0, 1)
            square = metrics.mean_squared_error(target[..., 3].numpy(), centered[..., 3].numpy())
            covers = [float(image[..., 3].double().sum()) for image in shifted or [centered]]
            own.append((mean_psnr(target, centered), square, sum(covers) / len(covers)))
    measures = []
    for own in errors:
        psnr, square, cover = np.mean(own, 0).tolist()
        coverage = cover * len(views) / target_cover if target_cover else None
        measures.append(SizeMeasures(psnr, coverage, square**0.5))
    return measures


def _shifted(camera: Camera, halvings: int) -> Camera:
    """The camera and, after halvings, the same camera with its pixels' centers moved to those of their 4^halvings parts."""
    parts = 2**halvings
    steps = [(part + 0.5) / parts - 0.5 for part in range(parts)]
    moves = [(0.0, 0.0), *(itertools.product(steps, steps) if halvings else ())]
    shift = torch.tensor([[[0, 0, right], [0, 0, down], [0, 0, 0]] for right, down in moves]).to(camera.intrinsics)
    return replace(camera, world_to_camera=camera.world_to_camera.expand(len(moves), 4, 4), intrinsics=camera.intrinsics + shift)
