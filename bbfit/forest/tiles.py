"""The placements of a forest in a quadtree: sorted by place, in files of one tile each, so that one tile at a time is in memory."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.files import write_bytes
from bbfit.forest.gathering import Gathered
from bbfit.forest.placements import RECORD, Placements, placements_of
from bbfit.inputs import reading
from bbfit.library.manifest import Library
from bbfit.outputs import output_folder, remove_results
from bbfit.stages.stage import OnProgress

FOREST_FILE = "forest.json"
"""The description of a forest, in its folder."""
TILES = "placements"
"""The folder of the tiles' files in the folder of a forest."""
_HINT = "start bbfit forest again"
_BATCH = 1 << 16
# Most depths of the quadtree: squares of a million trees on 10 km are then a millimeter wide.
_DEEPEST = 24


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


def write_tiles(gathered: Gathered, folder: Path, library: Library, most: int, on_progress: OnProgress) -> ForestTile:
    """Sort placements into a quadtree whose leaves have at most ``most`` trees, and write a file for each tile to ``folder``.

    ``folder`` is that of the forest. The files of an earlier forest go first, its description before them. In memory are 16 bytes for each
    tree, and one tile. The same placements give the same files. Raises InputError if more than ``most`` trees are at one place; an earlier
    forest is then as it was.
    """
    records = np.memmap(gathered.file, RECORD, "r", shape=(gathered.count,))
    parts = [records[start : start + _BATCH] for start in range(0, len(records), _BATCH)]
    low = np.min([[part["x"].min(), -part["z"].max()] for part in parts], 0)
    high = np.max([[part["x"].max(), -part["z"].min()] for part in parts], 0)
    side = max(float((high - low).max()) * (1 + 1e-9), 1e-3)
    keys = np.empty(len(records), np.uint64)
    for start, part in zip(range(0, len(records), _BATCH), parts, strict=True):
        keys[start : start + len(part)] = _keys(part["x"] - low[0], -part["z"] - low[1], side)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    crowded = np.unique(keys[most:][keys[most:] == keys[:-most]])
    if len(crowded):
        starts = np.searchsorted(keys, crowded)
        counts = np.searchsorted(keys, crowded, "right") - starts
        largest, row = int(counts.max()), records[order[starts[counts.argmax()]]]["row"]
        fail("placements", f"{largest:,} trees are at one place, such as that of row {row}", f"remove them, or give --tile-trees {largest}")
    (folder / FOREST_FILE).unlink(missing_ok=True)
    remove_results(output_folder("out", folder / TILES), "*.npy")
    quadtree = _Quadtree(records, order, keys, folder / TILES, library, most, on_progress)
    return quadtree.written(0, len(keys), 0, 0, 0)


class _Quadtree:
    """Writes the tiles of a quadtree, whose trees are ranges of the sorted ones."""

    def __init__(
        self,
        records: NDArray[np.void],
        order: NDArray[np.intp],
        keys: NDArray[np.uint64],
        folder: Path,
        library: Library,
        most: int,
        on_progress: OnProgress,
    ) -> None:
        self._records, self._order, self._keys = records, order, keys
        self._folder, self._most, self._report = folder, most, on_progress
        corners = np.array([[tree.low, tree.high] for tree in library.trees])
        self._heights = corners[:, 1, 1]
        self._depths = np.minimum(corners[:, 0, 1], 0.0)
        # A tree may be turned by any angle.
        self._radii = np.hypot(np.abs(corners[:, :, 0]).max(1), np.abs(corners[:, :, 2]).max(1))

    def written(self, start: int, end: int, depth: int, x: int, y: int) -> ForestTile:
        """The tile with the sorted trees from ``start`` to ``end``, after it and its children were written."""
        children = list[ForestTile]()
        if end - start > self._most:
            step = 2 * (_DEEPEST - depth - 1)
            quarters = self._keys[start:end] >> np.uint64(step) & np.uint64(3)
            edges = start + np.searchsorted(quarters, np.arange(5, dtype=np.uint64))
            for quarter, (first, last) in enumerate(itertools.pairwise(edges)):
                if first < last:
                    children.append(self.written(int(first), int(last), depth + 1, 2 * x + quarter % 2, 2 * y + quarter // 2))
        if children:
            chosen = self._order[np.linspace(start, end - 1, self._most).round().astype(np.intp)]
            low, high = np.min([child.low for child in children], 0), np.max([child.high for child in children], 0)
            records = self._records[chosen]
        else:
            records = self._records[self._order[start:end]]
            low, high = self._bounds(records)
            self._report("sort", end, len(self._keys))
        tile = ForestTile(f"{depth}/{x}/{y}", tuple(low.tolist()), tuple(high.tolist()), end - start, tuple(children))
        content = io.BytesIO()
        np.save(content, records, allow_pickle=False)
        write_bytes(self._folder / tile.file, content.getvalue())
        return tile

    def _bounds(self, records: NDArray[np.void]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lowest and the highest corner of the trees."""
        trees, scales = records["tree"], records["scale"].astype(float)
        around = self._radii[trees] * scales
        x, y, z = records["x"], records["y"], records["z"]
        low = [x - around, y + self._depths[trees] * scales, z - around]
        high = [x + around, y + self._heights[trees] * scales, z + around]
        return np.min(low, 1), np.max(high, 1)


def _keys(east: NDArray[np.float64], north: NDArray[np.float64], side: float) -> NDArray[np.uint64]:
    """Where points are along the Z-order curve of a square, [P]."""
    keys = np.zeros(len(east), np.uint64)
    for axis, values in enumerate((east, north)):
        cells = np.minimum(values / side * (1 << _DEEPEST), (1 << _DEEPEST) - 1).astype(np.uint64)
        for bit in range(_DEEPEST):
            keys |= (cells >> np.uint64(bit) & np.uint64(1)) << np.uint64(2 * bit + axis)
    return keys
