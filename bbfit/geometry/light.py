"""Light from one sun and an even sky, as every program has it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

import torch
from torch import Tensor

from bbfit.checks import check_shape, fail

LEAST_ELEVATION = 10.0
"""Least elevation of the suns of :func:`sky` in degrees: below it, a sun lights little but the edges of a tree."""
SUNNY = (1.8 * math.pi, 0.4)
"""Strengths of the sun and of the sky on a sunny day: a white surface that faces the sun has 1.8 and 0.4 times the radiance of white."""
QUARTER_TURN = 90.0
"""Angle in degrees by which one of the held-out suns is turned about the vertical against the sun of the views' own pictures."""
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Light:
    """A batch of L lights, each of one distant sun and an even sky, for L views.

    A matte surface of reflectance 1 that faces the sun, in the open, has the linear color ``ambient + sun_strength * sun_color / pi``:
    white at 1. Strengths are those of Blender (watts per square meter of a sun, and the strength of an even world), and of a
    ``DirectionalLight`` in three.js, whose ``AmbientLight`` has pi times the strength of the sky.
    """

    sun_directions: Tensor
    """Unit vectors towards the sun, Y up, float64 [L, 3]."""
    sun_strengths: Tensor
    """Irradiance of a surface that faces the sun, in watts per square meter, float64 [L], 0 or more."""
    sun_colors: Tensor
    """Linear color of the sun, float64 [L, 3], 0 or more."""
    ambients: Tensor
    """Radiance of the sky, float64 [L], 0 or more."""

    def __post_init__(self) -> None:
        count = len(self.sun_directions)
        check_shape("sun_directions", tuple(self.sun_directions.shape), (None, 3))
        check_shape("sun_strengths", tuple(self.sun_strengths.shape), (count,))
        check_shape("sun_colors", tuple(self.sun_colors.shape), (count, 3))
        check_shape("ambients", tuple(self.ambients.shape), (count,))
        for name, value in vars(self).items():
            if value.dtype != torch.float64 or not value.isfinite().all():
                fail(name, "expected finite float64 values")
            if name != "sun_directions" and (value < 0).any():
                fail(name, "expected values of at least 0")
        if ((self.sun_directions.norm(dim=-1) - 1).abs() > 1e-3).any():
            fail("sun_directions", "expected unit vectors")

    def __len__(self) -> int:
        return len(self.sun_directions)

    def __getitem__(self, indices: Sequence[int] | Tensor) -> Light:
        """The lights with these indices, a batch."""
        return Light(*(value[indices] for value in vars(self).values()))

    @property
    def fingerprint(self) -> str:
        """SHA-256 over all values."""
        return sha256(b"".join(value.contiguous().numpy().tobytes() for value in vars(self).values())).hexdigest()

    @staticmethod
    def of(sun_directions: Tensor, sun_strength: float, ambient: float, sun_color: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
        """Lights of equal strengths from different directions, [L, 3], which need not be unit vectors."""
        directions = torch.nn.functional.normalize(sun_directions.to(torch.float64), dim=-1)
        ones = torch.ones(len(directions), dtype=torch.float64)
        return Light(directions, sun_strength * ones, ones[:, None] * torch.tensor(sun_color, dtype=torch.float64), ambient * ones)

    @staticmethod
    def joined(lights: Sequence[Light]) -> Light:
        """The lights of several batches in one."""
        return Light(*(torch.cat(parts) for parts in zip(*(vars(light).values() for light in lights), strict=True)))


def direction(azimuth_degrees: float, elevation_degrees: float) -> Tensor:
    """The unit vector towards a sun, float64 [3]. Azimuth 0 is +Z and 90 is +X, as of cameras (:class:`~bbfit.geometry.orbit.Orbit`)."""
    azimuth, elevation = math.radians(azimuth_degrees), math.radians(elevation_degrees)
    across = math.cos(elevation)
    return torch.tensor([across * math.sin(azimuth), math.sin(elevation), across * math.cos(azimuth)], dtype=torch.float64)


def angles_degrees(towards: Tensor) -> tuple[float, float]:
    """Azimuth in [0, 360) and elevation of a unit vector towards a sun, [3]: the inverse of :func:`direction`, to 6 decimals."""
    x, y, z = towards.tolist()
    azimuth, elevation = math.degrees(math.atan2(x, z)), math.degrees(math.asin(min(max(y, -1.0), 1.0)))
    return round(azimuth, 6) % 360, round(elevation, 6)


def to_z_up(vector: Sequence[float]) -> list[float]:
    """A vector in the axes of Blender and of the NeRF-synthetic layout, which are Z up."""
    x, y, z = vector
    return [x, -z, y]


def from_z_up(vector: Sequence[float]) -> list[float]:
    """The inverse of :func:`to_z_up`."""
    x, y, z = vector
    return [x, z, -y]


def sky(count: int, turn_degrees: float = 0.0) -> Tensor:
    """Directions spread evenly over the sky above :data:`LEAST_ELEVATION`, float64 [count, 3], from the horizon up.

    They lie on a spherical Fibonacci spiral (Swinbank and Purser 2006, "Fibonacci grids"), which ``turn_degrees`` turns.
    """
    low = math.sin(math.radians(LEAST_ELEVATION))
    index = torch.arange(count, dtype=torch.float64)
    height = low + (1 - low) * (index + 0.5) / max(count, 1)
    angle, across = math.radians(turn_degrees) + _GOLDEN_ANGLE * index, (1 - height**2).sqrt()
    return torch.stack([across * angle.sin(), height, across * angle.cos()], -1)
