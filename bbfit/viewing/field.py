"""A field of trees: where each stands, how it is turned, how large it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range

MOST = 10_000
"""Trees in a field at most."""
# Distance of neighbors as a share of the tree's width; how far a tree may be off its place, as a share of that; the range of sizes.
_APART, _OFF, _SIZES = 1.05, 0.35, (0.7, 1.3)


@dataclass(frozen=True)
class Field:
    """N trees."""

    positions: NDArray[np.float32]
    """Where each tree's own origin goes, in meters, [N, 3]; the first tree stands in the middle."""
    wxyzs: NDArray[np.float32]
    """Rotations about the vertical as quaternions, [N, 4]."""
    scales: NDArray[np.float32]
    """Sizes, 1 as large as the tree itself, [N]."""
    side: float
    """Width of the field in meters."""

    def __len__(self) -> int:
        return len(self.scales)


def plant(count: int, bounds: NDArray[np.float64], *, seed: int = 0) -> Field:
    """Plant trees on the ground, on a grid that is shaken, each turned and scaled at random.

    Parameters
    ----------
    count : 1 to :data:`MOST`.
    bounds : the tree's lowest and highest corner in meters, [2, 3]; it stands on its lowest height.
    seed : of the places, turns and sizes; the same seed gives the same field.
    """
    check_count("trees", count)
    check_range("trees", count, 1, MOST)
    low, high = bounds
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    width = float(max(high[0] - low[0], high[2] - low[2]))
    apart, cells = _APART * width, math.ceil(math.sqrt(count))
    x, z = np.meshgrid(np.arange(cells) - (cells - 1) // 2, np.arange(cells) - (cells - 1) // 2)
    grid = np.stack([x.ravel(), z.ravel()], -1).astype(np.float64)
    grid = grid[np.argsort((grid**2).sum(-1), kind="stable")[:count]]
    random = np.random.default_rng(seed)
    grid[1:] += random.uniform(-_OFF, _OFF, (count - 1, 2))
    yaw, scales = random.uniform(0, 2 * np.pi, count), random.uniform(*_SIZES, count)
    yaw[0], scales[0] = 0.0, 1.0  # the one in the middle is the tree as it is
    stands = np.stack([foot[0] + apart * grid[:, 0], np.full(count, foot[1]), foot[2] + apart * grid[:, 1]], -1)
    # Trees turn and grow about their foot, models about their origin.
    turned = np.stack(
        [foot[0] * np.cos(yaw) + foot[2] * np.sin(yaw), np.full(count, foot[1]), foot[2] * np.cos(yaw) - foot[0] * np.sin(yaw)], -1
    )
    zero = np.zeros(count)
    return Field(
        positions=(stands - scales[:, None] * turned).astype(np.float32),
        wxyzs=np.stack([np.cos(yaw / 2), zero, np.sin(yaw / 2), zero], -1).astype(np.float32),
        scales=scales.astype(np.float32),
        side=cells * apart,
    )
