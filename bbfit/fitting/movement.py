"""Adam over where billboards stand: their position, orientation and extent, together with their texels."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.geometry.cloud import BillboardCloud

BETAS, EPSILON = (0.8, 0.95), 1e-12
# Extents move at this share of the rate: textures can shrink by becoming transparent, and grow when they are bounded anew.
_EXTENT_RATE = 0.3


class Movement:
    """How far N billboards have moved from where they began, as eight numbers each.

    Three are a translation, in multiples of ``reach``; three a rotation vector in radians, about the billboard's center; two the
    logarithms by which its half extents have grown. Gradients arrive through the homographies.
    """

    def __init__(self, cloud: BillboardCloud, reach: float) -> None:
        cloud = cloud.without_textures().to("cpu")
        self._cloud = replace(cloud, **{name: getattr(cloud, name).double() for name in ("centers", "rights", "ups", "half_extents")})
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
            centers=cloud.centers + moved[:, :3],
            rights=(turn @ cloud.rights[..., None])[..., 0],
            ups=(turn @ cloud.ups[..., None])[..., 0],
            half_extents=cloud.half_extents * moved[:, 6:].exp(),
            texels=texels,
        )

    def placement(self) -> Tensor:
        """Where the billboards are now: centers, rights, ups and half extents side by side, float64 [N, 11]; many times faster."""
        moved, cloud = self.parameters * self._units, self._cloud
        vectors = moved[:, 3:6]
        angles = vectors.norm(dim=-1, keepdim=True)
        first, second = torch.sinc(angles / math.pi), 0.5 * torch.sinc(angles / (2 * math.pi)).square()
        turned = []
        for axes in (cloud.rights, cloud.ups):  # Rodrigues' formula
            across = torch.linalg.cross(vectors, axes)
            turned.append(axes + first * across + second * torch.linalg.cross(vectors, across))
        return torch.cat([cloud.centers + moved[:, :3], *turned, cloud.half_extents * moved[:, 6:].exp()], -1)

    def pull_back(self, placement: Tensor, gradient: Tensor) -> Tensor:
        """The gradient in :attr:`parameters`, [N, 8], from the one in what :meth:`placement` has returned, [N, 11] both."""
        of_centers, of_rights, of_ups, of_extents = gradient.split((3, 3, 3, 2), -1)
        _, rights, ups, half_extents = placement.split((3, 3, 3, 2), -1)
        vectors = self.parameters[:, 3:6] * self._units[3:6]
        torque = torch.linalg.cross(rights, of_rights) + torch.linalg.cross(ups, of_ups)
        # The transpose of the left Jacobian of rotation vectors (Chirikjian 2012, equation 10.86).
        angles = vectors.norm(dim=-1, keepdim=True)
        second = 0.5 * torch.sinc(angles / (2 * math.pi)).square()
        third = torch.where(angles < 1e-4, 1 / 6, (1 - torch.sinc(angles / math.pi)) / angles.square())
        once = torch.linalg.cross(vectors, torque)
        of_vectors = torque - second * once + third * torch.linalg.cross(vectors, once)
        return torch.cat([of_centers, of_vectors, of_extents * half_extents], -1) * self._units

    def now(self, texels: Tensor) -> BillboardCloud:
        """The cloud where it is now, float32, with the given texels."""
        centers, rights, ups, half_extents = self.placement().float().split((3, 3, 3, 2), -1)
        return replace(self._cloud, centers=centers, rights=rights, ups=ups, half_extents=half_extents, texels=texels)

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
