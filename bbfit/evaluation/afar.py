"""How a model looks and what it costs to draw where it is most often seen: some way off, a hundred pixels high, say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import mean_flip_map, mean_psnr
from bbfit.evaluation.scoring import drawn_view
from bbfit.geometry.camera import Camera
from bbfit.images import shrunk
from bbfit.views.view_set import ViewSet


@dataclass(frozen=True)
class FarView:
    """A view as from afar."""

    target: Tensor
    """The view, averaged to the smaller size: premultiplied RGBA in [0, 1], float64 [h, w, 4]."""
    camera: Camera
    """The view's camera with pictures of that size."""
    tree_pixels: float
    """Height of the tree in this picture, in pixels."""


@dataclass(frozen=True)
class FarScore:
    """A model in pictures in which the tree has a given height: means over views."""

    tree_pixels: float
    """Height of the tree in pixels."""
    psnr: float
    """PSNR in dB, a mean over backgrounds too."""
    flip: float
    """FLIP in [0, 1], a mean over backgrounds too."""
    fragments: float | None
    """Fragments that a graphics card shades for a picture; ``None`` if that is not known."""


def drawing_cost(score: FarScore | None, triangles: int | None, fragments_per_triangle: float) -> float | None:
    """What a picture from afar costs to draw, in fragments, if a triangle takes as long as some of them; ``None`` if that is not known."""
    if score is None or score.fragments is None or triangles is None:
        return None
    return score.fragments + fragments_per_triangle * triangles


def seen_afar(views: ViewSet, index: int, tree_pixels: int) -> FarView | None:
    """One of the views at the size at which the tree is ``tree_pixels`` high in it; ``None`` if the view is empty.

    A view in which the tree is not as high keeps its size. No side gets shorter than 11 pixels
    (:data:`bbfit.evaluation.metrics.SSIM_WINDOW`). Raises InputError if the picture cannot be read.
    """
    target = views.targets([index], torch.float64)[0]
    rows = np.flatnonzero(target[..., 3].amax(1).numpy() > 0)
    if len(rows) == 0:
        return None
    height = int(rows[-1] + 1 - rows[0])
    share = min(1.0, tree_pixels / height)
    size = [max(metrics.SSIM_WINDOW, round(share * side)) for side in (views.cameras.width, views.cameras.height)]
    return FarView(shrunk(target, *size), views.cameras[index].resized(*size), height * size[1] / views.cameras.height)


def score_afar(
    draw: Callable[[Camera], Tensor], views: ViewSet, tree_pixels: int, fragments: Callable[[Camera], float] | None = None
) -> FarScore | None:
    """Compare a model with views that are averaged to the size at which the tree is ``tree_pixels`` high in them.

    ``draw`` is as for :func:`~bbfit.evaluation.scoring.held_out`; ``fragments`` returns what a graphics card shades for one camera. Returns
    ``None`` if all views are empty. Raises InputError if a picture cannot be read, or if a render has values that are not finite.
    """
    scores = list[tuple[float, float, float]]()
    shaded = list[float]()
    for index in range(len(views)):
        view = seen_afar(views, index, tree_pixels)
        if view is None:
            continue
        image = drawn_view(draw, view.camera, views.names[index])
        scores.append((view.tree_pixels, mean_psnr(view.target, image), float(mean_flip_map(view.target, image).mean())))
        if fragments is not None:
            shaded.append(fragments(view.camera))
    if not scores:
        return None
    pixels, psnr, flip = np.mean(scores, 0).tolist()
    return FarScore(pixels, psnr, flip, float(np.mean(shaded)) if shaded else None)
