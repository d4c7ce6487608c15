"""Octahedral impostors of a few colored balls, whose frames are computed and not rendered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics
from bbfit.images import bleed_color, over_color, to_bytes
from bbfit.rivals.mesh_rays import pixel_rays
from bbfit.rivals.octahedral import OctahedralImpostor
from bbfit.rivals.octahedral_grid import OctahedralGrid

CENTER, RADIUS = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), 1.0
# Centers, radii and colors.
BALLS = (
    ((0.0, 0.7, 0.0), 0.4, (0.9, 0.2, 0.1)),
    ((0.5, 1.3, 0.2), 0.3, (0.1, 0.8, 0.2)),
    ((-0.4, 1.4, -0.3), 0.25, (0.2, 0.3, 0.9)),
    ((0.1, 1.2, 0.6), 0.2, (0.9, 0.8, 0.1)),
)
SAMPLES = 4


def seen(camera: Camera) -> tuple[Tensor, Tensor]:
    """The balls as one camera sees them, premultiplied RGBA [H, W, 4], and the distances along its axis, [H, W], infinite beside them.

    A pixel has the mean color of 4 x 4 samples, and the least of their distances.
    """
    middles = torch.full((camera.height * camera.width * SAMPLES**2, 2), 0.5)
    starts, rays = (part.double() for part in pixel_rays(camera, middles, SAMPLES))
    nearest, colors = torch.full((len(rays),), torch.inf, dtype=torch.float64), torch.zeros(len(rays), 4, dtype=torch.float64)
    for center, radius, color in BALLS:
        offset = starts - torch.tensor(center, dtype=torch.float64)
        middle = -(offset * rays).sum(-1)
        depth = middle - (radius**2 - offset.square().sum(-1) + middle**2).sqrt()  # NaN beside the ball
        point = offset + depth[:, None] * rays
        stripes = 0.7 + 0.3 * (12 * point[:, 1:2] / radius).sin()
        closer = depth < nearest
        nearest = torch.where(closer, depth, nearest)
        shown = torch.cat([stripes * torch.tensor(color, dtype=torch.float64), torch.ones_like(stripes)], -1)
        colors = torch.where(closer[:, None], shown, colors)
    along = nearest * (rays @ camera.forward.double())
    return colors.reshape(camera.height, camera.width, -1, 4).mean(2), along.reshape(camera.height, camera.width, -1).amin(-1)


def frame_camera(grid: OctahedralGrid, frame: int, texels: int) -> Camera:
    """The parallel camera of a frame."""
    transform = look_at(CENTER + 2 * RADIUS * grid.directions[[frame]], CENTER)[0]
    return Camera(transform, orthographic_intrinsics(2 * RADIUS, texels, texels), texels, texels, orthographic=True)


def ball_impostor(frames: int = 8, texels: int = 64, *, hemisphere: bool = True, **options: Any) -> OctahedralImpostor:
    """The impostor of the balls."""
    grid = OctahedralGrid(frames, hemisphere)
    side = frames * texels
    colors, heights = torch.zeros(side, side, 4, dtype=torch.uint8), torch.zeros(side, side, dtype=torch.uint8)
    for frame in range(frames**2):
        picture, depth = seen(frame_camera(grid, frame, texels))
        straight = torch.cat([picture[..., :3] / picture[..., 3:].clamp_min(1e-9), picture[..., 3:]], -1)
        height = ((2 * RADIUS - depth) / RADIUS + 1) / 2
        height = torch.where(depth.isfinite(), height, 0.0)
        place = tuple(slice(index * texels, (index + 1) * texels) for index in divmod(frame, frames))
        colors[place] = bleed_color(torch.from_numpy(to_bytes(straight)))
        known = torch.cat([height[..., None].expand(-1, -1, 3), depth.isfinite()[..., None]], -1)
        heights[place] = bleed_color(torch.from_numpy(to_bytes(known)))[..., 0]
    return replace(OctahedralImpostor(grid, colors, heights, CENTER, RADIUS), **options)


def over_white(impostor: OctahedralImpostor, camera: Camera) -> Tensor:
    """What it looks like over white from a batch of cameras, [V, H, W, 3]."""
    return torch.stack([over_color(impostor.draw(camera[index])) for index in range(len(camera))])
