"""A field of trees: where each tree is, how it is turned, how large it is."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range

MAX_TREES = 10_000
"""The most trees that a field has."""
# Distance of neighbors as a share of the tree's width; largest shift of a tree, as a share of that distance; the range of scales.
_SPACING, _SHIFT, _SCALES = 1.05, 0.35, (0.7, 1.3)


def plant(count: int, bounds: NDArray[np.float64], *, seed: int = 0) -> NDArray[np.float32]:
    """Plant trees, 1 to :data:`MAX_TREES`, on the ground, on a jittered grid, each turned and scaled at random.

    ``bounds`` are the tree's lowest and highest corner in meters, [2, 3]; the ground is at its lowest height. The same seed gives the same
    field. Returns the trees, [N, 5]: the position of the tree's origin (x, y, z) in meters, its rotation about +Y in radians, and its
    scale. The first tree is in the middle and is neither shifted, turned nor scaled. Raises InputError if the count is out of range.
    """
    check_count("trees", count)
    check_range("trees", count, 1, MAX_TREES)
    low, high = bounds
    foot_x, foot_z = (low[0] + high[0]) / 2, (low[2] + high[2]) / 2
    spacing, cells = _SPACING * max(high[0] - low[0], high[2] - low[2]), math.ceil(math.sqrt(count))
    x, z = np.meshgrid(np.arange(cells) - (cells - 1) // 2, np.arange(cells) - (cells - 1) // 2)
    grid = np.stack([x.ravel(), z.ravel()], -1).astype(np.float64)
    grid = grid[np.argsort((grid**2).sum(-1), kind="stable")[:count]]
    random = np.random.default_rng(seed)
    grid[1:] += random.uniform(-_SHIFT, _SHIFT, (count - 1, 2))
    yaw, scales = random.uniform(0, 2 * np.pi, count), random.uniform(*_SCALES, count)
    yaw[0], scales[0] = 0.0, 1.0
    # Trees turn and grow about their foot, models about their origin.
    turned_x, turned_z = foot_x * np.cos(yaw) + foot_z * np.sin(yaw), foot_z * np.cos(yaw) - foot_x * np.sin(yaw)
    positions = [
        foot_x + spacing * grid[:, 0] - scales * turned_x,
        low[1] * (1 - scales),
        foot_z + spacing * grid[:, 1] - scales * turned_z,
    ]
    return np.stack([*positions, yaw, scales], -1).astype(np.float32)
