"""The trunk below the crown: where pictures show it alone, its points, and crossed planes through it."""

from __future__ import annotations

import math
from bisect import insort
from statistics import median

import torch
from torch import Tensor

from bbfit.fitting.clusters import Planes
from bbfit.fitting.config import TRUNK_PLANES
from bbfit.geometry.camera import Camera
from bbfit.views.view_set import ViewSet

STEEPEST_DEGREES = 30.0
"""Largest angle between a camera's direction and the horizon for which the trunk below the crown is looked for."""
# A row of the picture shows the crown if its silhouette is more than so many times as wide as the median row below it, or more than this
# share of the widest row. A trunk that forks in two is at most about twice as wide.
_FORKED, _NARROW = 2.0, 0.2
# Share of the rows below the crown that is left out at the top, where single leaves hang.
_HANGING = 0.05
# Least height of the trunk below the crown, as a share of the tree's height. The foot of a tree whose leaves hang to the ground is lower.
_LEAST_HEIGHT = 0.05
# Most views that points are looked for in, least share of them that show a trunk below the crown, and least number of points. Of these
# views, the least share that shows a point below the crown: a branch that hangs beside the trunk hides it from few sides.
_VIEWS, _SHARE, _LEAST_POINTS, _AGREEING = 24, 0.5, 12, 0.75


def is_level(camera: Camera) -> Tensor:
    """Whether each of V cameras is at most 30 degrees above or below the horizon, bool [V]."""
    return camera.batch().forward[:, 1].abs() <= math.sin(math.radians(STEEPEST_DEGREES)) + 1e-9


def trunk_top(inside: Tensor) -> int | None:
    """Find the first row of a silhouette, bool [H, W], from which on downwards the picture shows the trunk alone.

    From the lowest row of the silhouette upwards, the trunk ends where a row is empty, or where the silhouette is wider than 0.2 times its
    widest row, or wider than twice the median of the rows below. Width is the number of pixels, so that both halves of a fork belong to
    the trunk. The highest 5 % of these rows do not count. Returns ``None`` if the rest is lower than 5 % of the silhouette, as with a tree
    whose leaves hang to the ground, or if the silhouette is empty.
    """
    widths = inside.sum(-1).tolist()
    shown = [row for row, width in enumerate(widths) if width]
    if not shown:
        return None
    first, bottom = shown[0], shown[-1]
    narrow, top, below = _NARROW * max(widths), bottom, list[int]()
    while top >= 0 and widths[top]:
        insort(below, widths[top])
        if widths[top] > min(narrow, _FORKED * median(below)):
            break
        top -= 1
    left_out = round(_HANGING * (bottom - top))
    if bottom - top - left_out < _LEAST_HEIGHT * (bottom - first + 1):
        return None
    return top + 1 + left_out


def trunk_points(points: Tensor, views: ViewSet) -> Tensor:
    """Select the points, float64 [P, 3], that views show below the crown (:func:`trunk_top`). Returns their indices, int64.

    Of the views from near the horizon, 24 to 47 are used if there are more, and three quarters of those that show a trunk below the crown
    must agree on a point. There are no such points if fewer than half of the views show a trunk, and if there are fewer than 12 points.
    """
    level = [index for index in torch.nonzero(is_level(views.cameras))[:, 0].tolist() if views.shows(index)]
    level = level[:: max(1, len(level) // _VIEWS)]
    tops = [(index, top) for index in level if (top := trunk_top(views.image(index)[..., 3] >= 128)) is not None]
    none = torch.zeros(0, dtype=torch.int64)
    if not tops or len(tops) < _SHARE * len(level):
        return none
    below = torch.zeros(len(points), dtype=torch.int64)
    for index, top in tops:
        below += views.cameras[index].project(points)[:, 1] >= top - 0.5  # not for NaN
    found = torch.nonzero(below >= _AGREEING * len(tops))[:, 0]
    return found if len(found) >= _LEAST_POINTS else none


def trunk_parts(points: Tensor, count: int) -> list[tuple[Tensor, int]]:
    """Divide a trunk's points, float64 [P, 3], into parts above each other, and ``count`` planes among them.

    A trunk bends, and a plane through all of it is off its axis almost everywhere. Each part has as many points as the others, at least 12
    if it is not the only one, and at least :data:`~bbfit.fitting.config.TRUNK_PLANES` planes if ``count`` allows. Returns the indices of
    each part's points, int64, and its number of planes, from the lowest part upwards.
    """
    parts = max(1, min(count // TRUNK_PLANES, len(points) // _LEAST_POINTS))
    members = points[:, 1].argsort(stable=True).tensor_split(parts)
    return [(part, count // parts + (number < count % parts)) for number, part in enumerate(members)]


def crossed_planes(points: Tensor, count: int) -> Planes:
    """Cross ``count`` upright planes at equal angles in the vertical line through the mean of the points, float64 [P, 3].

    The first plane contains the horizontal direction in which the points vary most. Seen from the horizon, one of K crossed planes faces
    the camera to within 90 / K degrees. All labels are 0.
    """
    flat = points[:, ::2] - points[:, ::2].mean(0)
    x, z = torch.linalg.eigh(flat.mT @ flat).eigenvectors[:, 1].tolist()
    angles = math.atan2(z, x) + math.pi / 2 + math.pi * torch.arange(count, dtype=points.dtype) / count
    normals = torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], -1)
    return Planes(normals, normals @ points.mean(0), torch.zeros(len(points), dtype=torch.int64))
