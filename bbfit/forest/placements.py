"""Where the trees of a library stand: placements as arrays, as records of a file, and as matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RECORD = np.dtype(
    [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("turn", "<f4"), ("scale", "<f4"), ("tree", "<i4"), ("species", "<i4"), ("row", "<i8")]
)
"""A placement in a file: 48 bytes. ``species`` is the number of the register's own name of the species, -1 without one."""


@dataclass(frozen=True)
class Placements:
    """P placements of a library's trees in the local frame."""

    positions: NDArray[np.float64]
    """Meters, [P, 3]: where the trunk meets the ground. +X is east, +Y up, and -Z north, as in glTF."""
    turns: NDArray[np.float32]
    """Degrees counterclockwise seen from above, [P]."""
    scales: NDArray[np.float32]
    """Factor of the tree's own size, [P]."""
    trees: NDArray[np.int32]
    """Index into ``Library.trees``, [P]."""
    rows: NDArray[np.int64] | None = None
    """Row of the register, [P], or ``None``: the line of a table as spreadsheet programs count, or the number of a feature, from 1."""
    species: NDArray[np.int32] | None = None
    """Index into the names of species that the register uses (``Forest.species``), -1 without one, [P], or ``None``."""

    def __len__(self) -> int:
        return len(self.positions)

    def subset(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Placements:
        """Some of the placements, by a mask or by indices."""
        rows = None if self.rows is None else self.rows[chosen]
        species = None if self.species is None else self.species[chosen]
        return Placements(self.positions[chosen], self.turns[chosen], self.scales[chosen], self.trees[chosen], rows, species)


def placements_of(records: NDArray[np.void]) -> Placements:
    """The placements of records of the type :data:`RECORD`, [P]."""
    positions = np.stack([records["x"], records["y"], records["z"]], -1)
    columns = [np.ascontiguousarray(records[name]) for name in ("turn", "scale", "tree", "row", "species")]
    return Placements(positions, *columns)


def matrices(placements: Placements) -> NDArray[np.float32]:
    """The matrix that moves each tree to its place, column after column as in glTF, [P, 16]."""
    angles, scales = np.radians(placements.turns.astype(np.float64)), placements.scales.astype(np.float64)
    columns = np.zeros((len(placements), 4, 4))
    columns[:, 0, 0] = columns[:, 2, 2] = np.cos(angles) * scales
    columns[:, 0, 2], columns[:, 2, 0] = -np.sin(angles) * scales, np.sin(angles) * scales
    columns[:, 1, 1] = scales
    columns[:, 3, :3], columns[:, 3, 3] = placements.positions, 1
    return columns.reshape(-1, 16).astype(np.float32)


def quaternions(turns: NDArray[np.float32]) -> NDArray[np.float64]:
    """Turns about the vertical axis in degrees, [P], as unit quaternions (x, y, z, w), [P, 4]."""
    halves = np.radians(turns.astype(np.float64)) / 2
    zeros = np.zeros(len(halves))
    return np.stack([zeros, np.sin(halves), zeros, np.cos(halves)], -1)
