"""Fields of trees: where the copies of a tree stand before a camera that shows all of them at one size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.frames.config import FramesConfig
from bbfit.geometry.camera import Camera, look_at

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""The lowest and the highest corner of a tree in meters, Y up."""


@dataclass(frozen=True)
class Field:
    """Copies of a tree before an orthographic camera that looks at the origin from +Z and from above."""

    matrices: NDArray[np.float32]
    """Where each copy stands and how it is turned, [N, 16], column after column."""
    meters_high: float
    """Height of the picture in meters."""
    reach: float
    """Distance of the camera from the origin in meters; nothing is farther away from the origin."""

    def camera(self, size: int, elevation_degrees: float) -> Camera:
        """The camera, with the middle of the picture as a square of ``size`` x ``size`` pixels."""
        angle = math.radians(elevation_degrees)
        position = torch.tensor([[0.0, math.sin(angle), math.cos(angle)]], dtype=torch.float64) * self.reach
        scale, middle = size / self.meters_high, (size - 1) / 2
        intrinsics = torch.tensor([[[scale, 0, middle], [0, scale, middle], [0, 0, 1]]], dtype=torch.float64)
        return Camera(look_at(position, torch.zeros(3, dtype=torch.float64)), intrinsics, size, size, orthographic=True)[0]


def planted(bounds: Bounds, tree_pixels: int, count: int, config: FramesConfig) -> Field:
    """``count`` copies of a tree, each ``tree_pixels`` high if it is seen from the side, with random turns and in random order.

    Their middles fill the picture evenly: one stands in each cell of a jittered grid on the ground that the picture shows.
    """
    low, high = np.array(bounds[0]), np.array(bounds[1])
    tall, sine = float(high[1] - low[1]), math.sin(math.radians(config.elevation_degrees))
    meters = tall / tree_pixels  # for each pixel
    width, depth = config.width * meters, config.height * meters / sine
    columns = min(count, max(1, round(math.sqrt(count * width / depth))))
    rows = -(-count // columns)
    random = np.random.default_rng(config.seed)
    cells = random.permutation(rows * columns)[:count]
    x = ((cells % columns + random.random(count)) / columns - 0.5) * width
    z = ((cells // columns + random.random(count)) / rows - 0.5) * depth
    angles = random.random(count) * 2 * math.pi
    matrices = np.zeros((count, 4, 4))  # transposed
    matrices[:, 0, 0] = matrices[:, 2, 2] = np.cos(angles)
    matrices[:, 0, 2], matrices[:, 2, 0] = -np.sin(angles), np.sin(angles)
    matrices[:, 1, 1] = matrices[:, 3, 3] = 1
    middle = (low + high) / 2
    turned = np.stack(
        [middle[0] * np.cos(angles) + middle[2] * np.sin(angles), -middle[0] * np.sin(angles) + middle[2] * np.cos(angles)], -1
    )
    matrices[:, 3, 0], matrices[:, 3, 1], matrices[:, 3, 2] = x - turned[:, 0], -middle[1], z - turned[:, 1]
    reach = math.hypot(width, depth) / 2 + 2 * float(np.linalg.norm(high - low))
    return Field(matrices.reshape(count, 16).astype(np.float32), config.height * meters, reach)
