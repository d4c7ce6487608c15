"""Scores of the levels of a library: those of the files, with the atlas that all of them share."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from bbfit.evaluation.backgrounds import mean_psnr
from bbfit.evaluation.color_error import color_error
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.lod import LodLevel
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.images import shrunk
from bbfit.library.manifest import LevelScore
from bbfit.rendering.cards import CardRenderer
from bbfit.threads import one_thread
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

# Pixels of a side of the smallest pictures that are compared.
_LEAST_SIDE = 11


def drawing(cards: Cards, views: ViewSet) -> Callable[[Camera], Tensor]:
    """A function that draws what the files of cards show to one camera, cards with maps in the light of the views."""
    light = None if cards.atlas.surface is None or views.light is None else views.light[[0]]
    return partial(CardRenderer(cards).draw, light=light)


def scored(cards: Cards, level: LodLevel, dataset: ViewDataset, texels: int) -> tuple[float, LevelScore]:
    """The PSNR of a level in the held-out views at their size, and its score at the size at which it takes over.

    ``cards`` are those of the library's files, with the shared atlas and its mip levels. ``texels`` are those that they take up there.
    """
    views, scale = dataset.test, float(pixels_per_meter(dataset.train.cameras))
    assert dataset.request and dataset.request.tree.bounds
    low, high = dataset.request.tree.bounds
    height = (high[1] - low[1]) * scale
    share = min(1.0, (level.tree_pixels or height) / height)
    width, tall = (max(_LEAST_SIDE, round(side * share)) for side in (views.cameras.width, views.cameras.height))
    near, far, colors, draw = list[float](), list[float](), list[float](), drawing(cards, views)
    with one_thread():
        for index in range(len(views)):
            near.append(mean_psnr(*held_out(draw, views, index)))
            target = shrunk(views.targets([index])[0].double(), width, tall)
            image = draw(views.cameras[index].resized(width, tall)).double().clamp(0, 1)
            far.append(mean_psnr(target, image))
            colors.append(color_error(target, image))
    near_mean, far_mean, color_mean = (sum(values) / len(views) for values in (near, far, colors))
    return near_mean, LevelScore(height * share, far_mean, color_mean, texels)
