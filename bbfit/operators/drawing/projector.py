"""Projection of moving billboards by Warp kernels: one launch forward and one backward, instead of a hundred small torch operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.kernels import Plane
from bbfit.operators.drawing.projection import Projection
from bbfit.operators.drawing.projection_kernels import Lens, Rectangle, project_planes, pull_back


class Projector:
    """Projects billboards whose placement changes into some of V views at a time.

    The same as :func:`bbfit.operators.drawing.projection.project`, up to the rounding of float64.
    """

    def __init__(self, cloud: BillboardCloud, cameras: Camera) -> None:
        cameras = cameras.batch().to(torch.float64)
        self._cameras, self._device = cameras, cloud.texels.device
        parts = (cameras.world_to_pixel, cameras.world_to_camera, torch.linalg.inv(cameras.intrinsics), cameras.position)
        self._lenses = torch.cat([part.flatten(1) for part in parts], -1).to(self._device)
        area = cloud.texture_sizes.prod(-1)
        owned = area * (1 + cloud.two_sided.long())
        textures = torch.stack([owned.cumsum(0) - owned, *cloud.texture_sizes.unbind(-1), area * cloud.two_sided], -1)
        self._textures = textures.to(torch.int32).to(self._device)
        self._last: tuple[Tensor, ...] | None = None

    def project(self, placement: Tensor, chosen: Sequence[int]) -> Projection:
        """Project the billboards into the chosen views.

        Parameters
        ----------
        placement : Tensor
            Centers, rights, ups and half extents side by side, float64 [N, 11].
        chosen : Sequence[int]
            Indices of B views.
        """
        views, count = len(chosen), len(placement)
        placement = placement.to(self._device, torch.float64).contiguous()
        on = torch.tensor(chosen, dtype=torch.int32, device=self._device)
        planes = torch.empty(views, count, 19, dtype=torch.int32, device=self._device)
        to_texel = torch.empty(views, count, 3, 3, dtype=torch.float64, device=self._device)
        rows_apart = torch.ones(views, dtype=torch.int32, device=self._device)
        self._last = (on, placement, to_texel)
        cameras = self._cameras
        wp.launch(
            project_planes,
            (views, count),
            [
                wp.from_torch(on),
                cameras.width,
                cameras.height,
                int(cameras.orthographic),
                _structs(self._lenses, Lens),
                _structs(placement, Rectangle),
                wp.from_torch(self._textures, dtype=wp.vec4i),
            ],
            [_structs(planes, Plane), wp.from_torch(to_texel, dtype=wp.mat33d), wp.from_torch(rows_apart)],
            device=wp.device_from_torch(self._device),
        )
        return Projection(
            planes[..., :9].view(torch.float32).unflatten(-1, (3, 3)),
            planes[..., 9:12].view(torch.float32),
            planes[..., 12:15],
            planes[..., 15:19],
            rows_apart,
            cameras.width,
            cameras.height,
            cameras.orthographic,
        )

    def pull_back(self, of_matrices: Tensor) -> Tensor:
        """The gradient in the last placement, float64 [N, 11], for a gradient in its homographies ``to_texel``, float64 [B, N, 3, 3]."""
        assert self._last is not None
        on, placement, to_texel = self._last
        of_placement = torch.empty_like(placement)
        wp.launch(
            pull_back,
            len(placement),
            [
                wp.from_torch(on),
                _structs(self._lenses, Lens),
                _structs(placement, Rectangle),
                wp.from_torch(self._textures, dtype=wp.vec4i),
                wp.from_torch(to_texel, dtype=wp.mat33d),
                wp.from_torch(of_matrices.contiguous(), dtype=wp.mat33d),
            ],
            [_structs(of_placement, Rectangle)],
            device=wp.device_from_torch(self._device),
        )
        return of_placement


def _structs(tensor: Tensor, kind: Any) -> Any:
    """A Warp view of a tensor whose last dimension is the memory of a struct. The tensor must outlive it."""
    return wp.array(ptr=tensor.data_ptr(), shape=tuple(tensor.shape[:-1]), dtype=kind, device=wp.device_from_torch(tensor.device))
