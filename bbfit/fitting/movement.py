"""Adam over where billboards stand: their position, orientation and extent, together with their texels."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bbfit.geometry.cloud import BillboardCloud

BETAS, EPSILON = (0.8, 0.95), 1e-12
# Extents move at this share of the rate: textures can shrink by becoming transparent, and grow when they are bounded anew.
_EXTENT_RATE = 0.3


class Movement:
    """How far N billboards have moved from where they began, as eight numbers each.

    Three are a translation, in multiples of ``reach``; three a rotation vector in radians, about the billboard's centre; two the
    logarithms by which its half extents have grown. Gradients arrive through the homographies.
    """

    def __init__(self, cloud: BillboardCloud, reach: float) -> None:
        self._cloud = cloud.to("cpu")
        self._units = torch.tensor([reach] * 3 + [1.0] * 3 + [_EXTENT_RATE] * 2, dtype=torch.float64)
        self._kept = torch.zeros(3, len(cloud), 8, dtype=torch.float64)  # the numbers, and their first and second moments
        self._steps = 0

    @property
    def parameters(self) -> Tensor:
        """The numbers as they are now, float64 [N, 8], each in units of its own rate."""
        return self._kept[0]

    def placed(self, parameters: Tensor, texels: Tensor) -> BillboardCloud:
        """The cloud after a movement, with the given texels; float64 placement, differentiable in the parameters."""
        moved = parameters * self._units
        turn = torch.linalg.matrix_exp(_cross_matrices(moved[:, 3:6]))
        cloud = self._cloud
        return replace(
            cloud,
            centers=cloud.centers.double() + moved[:, :3],
            rights=(turn @ cloud.rights.double()[..., None])[..., 0],
            ups=(turn @ cloud.ups.double()[..., None])[..., 0],
            half_extents=cloud.half_extents.double() * moved[:, 6:].exp(),
            texels=texels,
        )

    def now(self, texels: Tensor) -> BillboardCloud:
        """The cloud where it is now, float32, with the given texels."""
        return self.placed(self.parameters, texels).to(torch.float32)

    def update(self, gradient: Tensor, rate: float) -> None:
        """Take a step against ``gradient``, [N, 8], of about ``rate`` (in units) each."""
        self._steps += 1
        value, first, second = self._kept
        first.lerp_(gradient, 1 - BETAS[0])
        second.lerp_(gradient.square(), 1 - BETAS[1])
        root = (second / (1 - BETAS[1] ** self._steps)).sqrt()
        value -= rate / (1 - BETAS[0] ** self._steps) * first / (root + EPSILON)

    def tensors(self) -> dict[str, Tensor]:
        """All that changes from step to step."""
        return {"movement": self._kept, "movement_steps": torch.tensor([self._steps])}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from :meth:`tensors`."""
        self._kept, self._steps = tensors["movement"].clone(), int(tensors["movement_steps"])


def _cross_matrices(vectors: Tensor) -> Tensor:
    """The matrices [N, 3, 3] whose products are cross products with vectors [N, 3]."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
