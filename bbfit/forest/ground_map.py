"""The ground of a forest for its web page: a coarse grid of heights and of the share that crowns cover, from the trees alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bbfit.forest.placements import Placements

CELLS = 128
"""Cells along a side."""
# Heights that differ by less are those of a plane, in meters.
_FLAT = 0.01


@dataclass(frozen=True)
class GroundMap:
    """A grid over the ground, to which placements are added one tile after another. Rows count to the south, columns to the east."""

    low: tuple[float, float]
    """Its lowest x and z in meters."""
    high: tuple[float, float]
    """Its highest x and z."""
    areas: NDArray[np.float64]
    """The area of each tree's crown at its own size, in square meters, [T]."""
    _crowns: NDArray[np.float64] = field(default_factory=lambda: np.zeros((CELLS, CELLS)))
    _heights: NDArray[np.float64] = field(default_factory=lambda: np.zeros((CELLS, CELLS)))
    _counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((CELLS, CELLS), np.int64))

    def add(self, placements: Placements) -> None:
        """Add the trees of a tile."""
        places = placements.positions[:, [0, 2]]
        sides = np.subtract(self.high, self.low)
        columns, rows = np.clip((places - self.low) / sides * CELLS, 0, CELLS - 1).astype(np.int64).T
        np.add.at(self._crowns, (rows, columns), self.areas[placements.trees] * placements.scales.astype(np.float64) ** 2)
        np.add.at(self._heights, (rows, columns), placements.positions[:, 1])
        np.add.at(self._counts, (rows, columns), 1)

    def cover(self) -> NDArray[np.uint8]:
        """The share of each cell that crowns cover, 255 all of it, [CELLS, CELLS]. Crowns at random places overlap."""
        cell = float(np.prod(np.subtract(self.high, self.low))) / CELLS**2
        return np.round(255 * (1 - np.exp(-self._crowns / cell))).astype(np.uint8)

    def heights(self) -> NDArray[np.float32] | None:
        """The mean height of the trunks in each cell in meters, [CELLS, CELLS]; ``None`` if all stand on the plane y = 0.

        Cells without trees have the height of the nearest cell that has some.
        """
        from scipy.ndimage import distance_transform_edt

        heights = self._heights / np.maximum(self._counts, 1)
        if np.abs(heights).max() < _FLAT:
            return None
        rows, columns = distance_transform_edt(self._counts == 0, return_distances=False, return_indices=True)
        return heights[rows, columns].astype(np.float32)
