"""The placement of billboards as an optimizable quantity: position, orientation and extent, their gradients, and Adam."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.geometry.cloud import BillboardCloud

BETAS, EPSILON = (0.8, 0.95), 1e-12
# Learning rate of extents, as a fraction of the rate of positions, for at most so many steps. It is low because textures can shrink by
# becoming transparent, and grow when the billboards get new bounds. Extents move no farther in a longer fit: rectangles that only shrink
# would end too small.
_EXTENT_RATE, _EXTENT_STEPS = 0.3, 800


class Movement:
    """The movement of N billboards from their initial placement, as eight parameters each, and the state of Adam over them.

    Three parameters are a translation, in multiples of ``reach`` meters. Three are a rotation vector about the billboard's center, in
    radians. Two are the logarithms of the growth of its half extents, in units of 0.3, or of less if there are more than 800 ``steps`` in
    all. Their gradients come from the homographies.

    Unless they may ``grow``, half extents stay at most as large as they are at the start. A larger billboard nearly always lowers the loss,
    and no loss knows that a graphics card shades all of its pixels.
    """

    def __init__(self, cloud: BillboardCloud, reach: float, *, grow: bool = True, steps: int = _EXTENT_STEPS) -> None:
        cloud = cloud.without_textures().to("cpu")
        self._cloud = replace(cloud, **{name: getattr(cloud, name).double() for name in ("centers", "rights", "ups", "half_extents")})
        extent = _EXTENT_RATE * min(1, _EXTENT_STEPS / steps)
        self._units = torch.tensor([reach] * 3 + [1.0] * 3 + [extent] * 2, dtype=torch.float64)
        self._state = torch.zeros(3, len(cloud), 8, dtype=torch.float64)  # parameters, their first and second moments
        self._most = math.inf if grow else 0.0
        self._steps = 0

    @property
    def parameters(self) -> Tensor:
        """The current parameters, float64 [N, 8]."""
        return self._state[0]

    def placed(self, parameters: Tensor, texels: Tensor) -> BillboardCloud:
        """Move the initial cloud by parameters, [N, 8], and give it texels. The float64 placement is differentiable in the parameters."""
        moved = parameters * self._units
        rotation = torch.linalg.matrix_exp(_cross_matrices(moved[:, 3:6]))
        cloud = self._cloud
        return replace(
            cloud,
            centers=cloud.centers + moved[:, :3],
            rights=(rotation @ cloud.rights[..., None])[..., 0],
            ups=(rotation @ cloud.ups[..., None])[..., 0],
            half_extents=cloud.half_extents * moved[:, 6:].exp(),
            texels=texels,
        )

    def placement(self) -> Tensor:
        """Concatenate the current centers, rights, ups and half extents to float64 [N, 11], many times faster than :meth:`placed`."""
        moved, cloud = self.parameters * self._units, self._cloud
        vectors = moved[:, 3:6]
        angles = vectors.norm(dim=-1, keepdim=True)
        first, second = torch.sinc(angles / math.pi), 0.5 * torch.sinc(angles / (2 * math.pi)).square()
        rotated = []
        for axes in (cloud.rights, cloud.ups):  # Rodrigues' formula
            across = torch.linalg.cross(vectors, axes)
            rotated.append(axes + first * across + second * torch.linalg.cross(vectors, across))
        return torch.cat([cloud.centers + moved[:, :3], *rotated, cloud.half_extents * moved[:, 6:].exp()], -1)

    def pull_back(self, placement: Tensor, gradient: Tensor) -> Tensor:
        """Transform the gradient of the current :meth:`placement`, both [N, 11], to the gradient of :attr:`parameters`, [N, 8]."""
        center_gradient, right_gradient, up_gradient, extent_gradient = gradient.split((3, 3, 3, 2), -1)
        _, rights, ups, half_extents = placement.split((3, 3, 3, 2), -1)
        vectors = self.parameters[:, 3:6] * self._units[3:6]
        torque = torch.linalg.cross(rights, right_gradient) + torch.linalg.cross(ups, up_gradient)
        # The transpose of the left Jacobian of rotation vectors (Chirikjian 2012, equation 10.86).
        angles = vectors.norm(dim=-1, keepdim=True)
        second = 0.5 * torch.sinc(angles / (2 * math.pi)).square()
        third = torch.where(angles < 1e-4, 1 / 6, (1 - torch.sinc(angles / math.pi)) / angles.square())
        once = torch.linalg.cross(vectors, torque)
        vector_gradient = torque - second * once + third * torch.linalg.cross(vectors, once)
        return torch.cat([center_gradient, vector_gradient, extent_gradient * half_extents], -1) * self._units

    def now(self, texels: Tensor) -> BillboardCloud:
        """Return the cloud in its current placement, float32, with the given texels."""
        centers, rights, ups, half_extents = self.placement().float().split((3, 3, 3, 2), -1)
        return replace(self._cloud, centers=centers, rights=rights, ups=ups, half_extents=half_extents, texels=texels)

    def update(self, gradient: Tensor, rate: float) -> None:
        """Take a step of Adam (Kingma and Ba 2015) on the parameters with their gradient, [N, 8], and a learning rate."""
        self._steps += 1
        value, first, second = self._state
        first.lerp_(gradient, 1 - BETAS[0])
        second.lerp_(gradient.square(), 1 - BETAS[1])
        root = (second / (1 - BETAS[1] ** self._steps)).sqrt()
        value -= rate / (1 - BETAS[0] ** self._steps) * first / (root + EPSILON)
        value[:, 6:].clamp_(max=self._most)

    def tensors(self) -> dict[str, Tensor]:
        """Return the state that steps change."""
        return {"movement": self._state, "movement_steps": torch.tensor([self._steps])}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore a state that :meth:`tensors` returned."""
        self._state, self._steps = tensors["movement"].clone(), int(tensors["movement_steps"])


def _cross_matrices(vectors: Tensor) -> Tensor:
    """Return the matrices, [N, 3, 3], that multiply like cross products with vectors, [N, 3]."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
