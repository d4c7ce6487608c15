"""The placements of a forest in a quadtree: sorted by place, in files of one tile each, so that one tile at a time is in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bbfit.checks import fail
from bbfit.forest.placements import RECORD, Placements, placements_of
from bbfit.inputs import reading

TILES = "placements"
"""The folder of the tiles' files in the folder of a forest."""
_HINT = "start bbfit forest again"


@dataclass(frozen=True)
class ForestTile:
    """A square of ground with its trees."""

    name: str
    """``depth/x/y``: the root is ``0/0/0``; x counts to the east and y to the north."""
    low: tuple[float, float, float]
    """The lowest corner of its trees' bounds in meters, in the local frame (+X east, +Y up, -Z north)."""
    high: tuple[float, float, float]
    """The highest corner of its trees' bounds."""
    count: int
    """Number of its trees."""
    children: tuple[ForestTile, ...]
    """Its quarters with trees, or none. A tile without children is a leaf."""

    @property
    def file(self) -> str:
        """The name of its file in the folder of tiles."""
        return self.name.replace("/", "-") + ".npy"


def leaves(root: ForestTile) -> Iterator[ForestTile]:
    """The tiles without children, which together have every tree once."""
    if not root.children:
        yield root
    for child in root.children:
        yield from leaves(child)


def read_tile(folder: str | Path, name: str) -> Placements:
    """The placements of a tile, by the folder of the forest and the tile's name.

    Those of a leaf are all of its trees. Those of another tile are a part of them, spread evenly. Raises MissingFileError or InputError if
    the file is missing or damaged.
    """
    path = Path(folder) / TILES / (name.replace("/", "-") + ".npy")
    with reading("forest", path, _HINT):
        records = np.load(path, allow_pickle=False)
    if records.dtype != RECORD or records.ndim != 1:
        fail("forest", f"{path} has no placements", _HINT)
    return placements_of(records)
