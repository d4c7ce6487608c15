"""Which points on a tree the cameras see: what leaves hide needs no billboard."""

from __future__ import annotations

import torch
from torch import Tensor

from bbfit.geometry.camera import Camera

# Most cameras, and the width in pixels of the pictures in which points hide each other.
_CAMERAS, _WIDTH = 24, 96
# Least weight of a point. Light that passes between leaves shows a little of everything.
_LEAST = 0.01


def seen_indices(visibility: Tensor, count: int, seed: int) -> Tensor:
    """Choose ``count`` of P > ``count`` points in proportion to their :func:`visibility`, float64 [P]. Returns their indices, int64.

    Without it, a clustering of a dense tree's points would place most billboards inside the crown, where no view sees them.
    """
    generator = torch.Generator().manual_seed(seed)
    return torch.multinomial(visibility.clamp_min(_LEAST), count, replacement=False, generator=generator)


def visibility(points: Tensor, area: float, cameras: Camera) -> Tensor:
    """The share of a point's light that reaches the cameras, in [0, 1], averaged over at most 24 of V cameras, float64 [P].

    The points, float64 [P, 3], sample a surface of ``area`` square meters evenly. Each stands for an equal part of it in random
    orientation, which hides half of its area. Of the light that passes n such parts of a pixel, exp(-n h) remains, where h is the share of
    the pixel that one part hides (Beer-Lambert law; Ross 1981 for foliage).
    """
    total, used = torch.zeros(len(points), dtype=torch.float64), range(0, len(cameras), -(-len(cameras) // _CAMERAS))
    for index in used:
        camera = cameras[index]
        camera = camera.resized(_WIDTH, max(1, round(_WIDTH * camera.height / camera.width)))
        pixel, inside = pixels_of(points, camera)
        depth = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
        scale = camera.intrinsics[0, 0] * camera.intrinsics[1, 1] / (1.0 if camera.orthographic else depth.square())
        hidden = torch.where(inside, scale * (area / len(points) / 2), 0.0)
        order = depth.argsort()
        order = order[pixel[order].argsort(stable=True)]  # by pixel, the nearest first
        before = hidden[order].cumsum(0) - hidden[order]
        first = torch.ones(len(order), dtype=torch.bool)
        first[1:] = pixel[order].diff() != 0
        in_pixel = before - torch.where(first, before, 0.0).cummax(0).values
        total[order] += torch.where(inside[order], torch.exp(-in_pixel), 0.0)
    return total / len(used)


def pixels_of(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project points, [P, 3], to the pixels of a single camera.

    Returns the indices of the pixels, row by row, int32 [P], 0 outside the picture, and whether each point is inside it, bool [P].
    """
    x, y = camera.project(points).nan_to_num(nan=-1).round().clamp(-1, max(camera.width, camera.height)).int().unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return torch.where(inside, y * camera.width + x, 0), inside
