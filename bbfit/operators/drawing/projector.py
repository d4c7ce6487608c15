"""Projection of moving billboards by Warp kernels: one launch forward and one backward, instead of a hundred small torch operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.projection import Projection, texture_table
from bbfit.operators.drawing.projection_kernels import Lens, Rectangle, project_planes, pull_back
from bbfit.operators.drawing.tile_kernels import Plane
from bbfit.operators.launching import struct_array


class Projector:
    """Projects billboards whose placement changes into some of V views at a time, as
    :func:`bbfit.operators.drawing.projection.project` does, up to the rounding of float64."""

    def __init__(self, cloud: BillboardCloud, cameras: Camera) -> None:
        cameras = cameras.batch().to(torch.float64)
        self._cameras, self._device = cameras, cloud.texels.device
        parts = (cameras.world_to_pixel, cameras.world_to_camera, torch.linalg.inv(cameras.intrinsics), cameras.position)
        self._lenses = torch.cat([part.flatten(1) for part in parts], -1).to(self._device)
        self._textures = texture_table(cloud).to(self._device)
        self._last: list[Any] = []  # kernel arguments that both directions share

    def project(self, placement: Tensor, chosen: Sequence[int]) -> Projection:
        """Project billboards with their centers, rights, ups and half extents side by side, float64 [N, 11], into B views by index."""
        views, count = len(chosen), len(placement)
        inputs = [
            wp.from_torch(torch.tensor(chosen, dtype=torch.int32, device=self._device)),
            struct_array(self._lenses, Lens),
            struct_array(placement.to(self._device, torch.float64).contiguous(), Rectangle),
            wp.from_torch(self._textures, dtype=wp.vec4i),
        ]
        planes = torch.empty(views, count, 19, dtype=torch.int32, device=self._device)
        to_texel = wp.from_torch(torch.empty(views, count, 3, 3, dtype=torch.float64, device=self._device), dtype=wp.mat33d)
        self._last = [*inputs, to_texel]
        rows_apart = torch.ones(views, dtype=torch.int32, device=self._device)
        camera = (self._cameras.width, self._cameras.height, self._cameras.orthographic)
        outputs = [struct_array(planes, Plane), to_texel, wp.from_torch(rows_apart)]
        wp.launch(project_planes, (views, count), [*inputs, *camera], outputs, device=wp.device_from_torch(self._device))
        numbers = planes[..., :12].view(torch.float32)
        matrices, nearness = numbers[..., :9].unflatten(-1, (3, 3)), numbers[..., 9:]
        return Projection(matrices, nearness, planes[..., 12:15], planes[..., 15:], rows_apart, *camera)

    def pull_back(self, of_matrices: Tensor) -> Tensor:
        """The gradient in the last placement, float64 [N, 11], for a gradient in its homographies ``to_texel``, float64 [B, N, 3, 3]."""
        of_placement = torch.empty(of_matrices.shape[1], 11, dtype=torch.float64, device=self._device)
        inputs = [*self._last, wp.from_torch(of_matrices.contiguous(), dtype=wp.mat33d)]
        outputs = [struct_array(of_placement, Rectangle)]
        wp.launch(pull_back, len(of_placement), inputs, outputs, device=wp.device_from_torch(self._device))
        return of_placement
