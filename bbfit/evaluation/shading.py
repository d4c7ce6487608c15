"""How many pixels a graphics card shades for a model."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bbfit.checks import check_shape
from bbfit.geometry.camera import Camera
from bbfit.views.view_set import ViewSet


def score_shading(fragments: Callable[[Camera], float], views: ViewSet) -> float | None:
    """Fragments that a graphics card shades in all views over the pixels that the targets cover, by the sum of their alpha.

    ``fragments`` returns the number for one camera (:meth:`bbfit.rendering.cards.CardRenderer.fragments`, :func:`triangle_fragments`). 1 is
    a model without layers or empty fragments. ``None`` if the targets are empty.
    """
    shaded = sum(fragments(views.cameras[index]) for index in range(len(views)))
    covered = sum(float(views.targets([index], torch.float64)[0][..., 3].sum()) for index in range(len(views)))
    return shaded / covered if covered else None


def triangle_fragments(triangles: Tensor, camera: Camera) -> float:
    """The sum of the areas of triangles in the picture of a single camera, in pixels, whichever way they face.

    ``triangles`` are corners in meters, [T, 3, 3]. It is what a graphics card shades without an early depth test, but for rounding. Parts
    beyond the picture count; triangles with a corner at or behind the camera do not.
    """
    check_shape("triangles", tuple(triangles.shape), (None, 3, 3))
    corners = camera.project(triangles.reshape(-1, 3).to(camera.position)).reshape(-1, 3, 2)
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).unbind(-1), (corners[:, 2] - corners[:, 0]).unbind(-1)
    return float(((ax * by - ay * bx).abs() / 2).nan_to_num(0.0).sum())
