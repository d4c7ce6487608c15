"""A grid of view directions on an octahedron, and the frames of it that a direction lies between.

The octahedral map of the sphere to a square is that of Engelhardt and Dachsbacher 2008 ("Octahedron Environment Maps", VMV). Brucks 2018
("Octahedral Impostors", shaderbits.com) uses it, and half of it turned by 45 degrees for the upper hemisphere, as the grid of an impostor.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import check_range


@dataclass(frozen=True)
class OctahedralGrid:
    """Directions from a tree towards its viewers, at the vertices of a square grid that is folded to a (half) octahedron.

    A square's point (u, v) in [-1, 1]^2 is a direction (:meth:`towards`). Frame ``row * frames + column`` has u by its column and v by its
    row, from -1 to 1. The middle of the square is the direction straight up; its border is the horizon, or straight down at the corners.
    """

    frames: int
    """Directions along each side of the grid, N >= 2."""
    hemisphere: bool = True
    """Whether directions are those above the horizon; otherwise all."""

    def __post_init__(self) -> None:
        check_range("frames", self.frames, 2, 256)

    @property
    def directions(self) -> Tensor:
        """Unit vectors of the N * N frames, [N * N, 3] float64."""
        line = torch.linspace(-1, 1, self.frames, dtype=torch.float64)
        v, u = torch.meshgrid(line, line, indexing="ij")
        return self.towards(torch.stack([u, v], -1).reshape(-1, 2))

    def towards(self, places: Tensor) -> Tensor:
        """Unit vectors at points of the square, [..., 2] -> [..., 3]."""
        u, v = places.unbind(-1)
        if self.hemisphere:
            x, z = (u + v) / 2, (v - u) / 2
            y = 1 - x.abs() - z.abs()
        else:
            y = 1 - u.abs() - v.abs()
            below = (-y).clamp_min(0)
            x, z = u - below.copysign(u), v - below.copysign(v)
        return torch.nn.functional.normalize(torch.stack([x, y, z], -1), dim=-1)

    def places(self, directions: Tensor) -> Tensor:
        """The inverse of :meth:`towards`, [..., 3] -> [..., 2]. On a hemisphere, directions below the horizon move up to it."""
        x, y, z = directions.unbind(-1)
        y = y.clamp_min(0) if self.hemisphere else y
        x, y, z = torch.stack([x, y, z]) / (x.abs() + y.abs() + z.abs()).clamp_min(1e-12)
        if self.hemisphere:
            return torch.stack([x - z, x + z], -1)
        below = (-y).clamp_min(0)
        return torch.stack([x + below.copysign(x), z + below.copysign(z)], -1)

    def nearest(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The frames at the corners of the grid's triangle around each direction, and its barycentric weights there.

        Each square of the grid is cut along the diagonal of equal steps in u and v. Weights are continuous in the direction.

        Parameters
        ----------
        directions
            Unit vectors, [..., 3].

        Returns
        -------
        tuple of Tensor
            Indices of frames, int64 [..., 3], and weights >= 0 that sum to 1, [..., 3].
        """
        place = (self.places(directions) + 1) / 2 * (self.frames - 1)
        cell = place.floor().clamp(0, self.frames - 2)
        across, down = (place - cell).clamp(0, 1).unbind(-1)
        column, row = cell.long().unbind(-1)
        right = (across > down).long()  # otherwise the third corner lies below the first
        first = row * self.frames + column
        indices = torch.stack([first, first + right + (1 - right) * self.frames, first + self.frames + 1], -1)
        most, least = torch.maximum(across, down), torch.minimum(across, down)
        return indices, torch.stack([1 - most, most - least, least], -1)
