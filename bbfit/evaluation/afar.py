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
    """A model in pictures as from afar: means over views."""

    tree_pixels: float
    """Height of the tree in pixels where it is highest."""
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


def shown_height(views: ViewSet, index: int) -> int:
    """The height of what one of the views shows, in pixels; 0 for an empty view. Raises InputError if the picture cannot be read."""
    rows = np.flatnonzero(views.image(index)[..., 3].amax(1).numpy())
    return int(rows[-1] + 1 - rows[0]) if len(rows) else 0


def seen_afar(views: ViewSet, index: int, scale: float) -> FarView:
    """One of the views at a smaller scale, at most 1.

    No side gets shorter than 11 pixels (:data:`bbfit.evaluation.metrics.SSIM_WINDOW`). Raises InputError if the picture cannot be read.
    """
    width, height = (max(metrics.SSIM_WINDOW, round(min(1.0, scale) * side)) for side in (views.cameras.width, views.cameras.height))
    target = shrunk(views.targets([index], torch.float64)[0], width, height)
    return FarView(target, views.cameras[index].resized(width, height), shown_height(views, index) * height / views.cameras.height)


def score_afar(
    draw: Callable[[Camera], Tensor],
    views: ViewSet,
    height: int,
    fragments: Callable[[Camera], float] | None = None,
    drawn: str = "cloud",
) -> FarScore | None:
    """Compare a model with views that are averaged to one smaller size, at which the tree is ``height`` pixels high where it is highest.

    So all views are as from one distance. If the tree is not as high in any of them, they keep their size. ``draw`` is as for
    :func:`~bbfit.evaluation.scoring.held_out`; ``fragments`` returns what a graphics card shades for one camera. Returns ``None`` if all
    views are empty. Raises InputError if a picture cannot be read, or if a render of what is ``drawn`` has values that are not finite.
    """
    highest = max(shown_height(views, index) for index in range(len(views)))
    if highest == 0:
        return None
    scores, shaded, heights = list[tuple[float, float]](), list[float](), list[float]()
    for index in range(len(views)):
        view = seen_afar(views, index, height / highest)
        image = drawn_view(draw, view.camera, views.names[index], drawn)
        scores.append((mean_psnr(view.target, image), float(mean_flip_map(view.target, image).mean())))
        heights.append(view.tree_pixels)
        if fragments is not None:
            shaded.append(fragments(view.camera))
    psnr, flip = np.mean(scores, 0).tolist()
    return FarScore(max(heights), psnr, flip, float(np.mean(shaded)) if shaded else None)
