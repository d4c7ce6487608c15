"""From rows of a register to placements: which tree of the library stands there, how large it is, and how it is turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bbfit.forest.config import ForestConfig
from bbfit.forest.placements import RECORD
from bbfit.forest.species import Match
from bbfit.library.manifest import Library

# Trees whose heights are within this factor of the nearest one are equally good.
_ALIKE = 1.15


def planted(
    rows: NDArray[np.void], places: NDArray[np.float64], library: Library, matches: Sequence[Match], config: ForestConfig
) -> NDArray[np.void]:
    """The placements of rows of the type ``ROW``, [P], at (east, north) in meters, [P, 2], as records of the type ``RECORD``, [P].

    ``matches`` has the trees for each species, and in the end those for rows without one. Of these trees, one with the nearest height
    is chosen. Without a height, and where several are alike, it is random.
    """
    records = np.zeros(len(rows), RECORD)
    records["x"], records["z"] = places[:, 0], -places[:, 1]
    records["y"] = np.nan_to_num(rows["z"])
    records["species"], records["row"] = rows["species"], rows["row"]
    trees = np.zeros(len(rows), np.int32)
    for species in np.unique(rows["species"]):
        chosen = rows["species"] == species
        trees[chosen] = _choice(rows[chosen], matches[species].trees, library, config.seed)
    records["tree"] = trees
    heights = np.array([tree.height for tree in library.trees])
    widths = np.array([max(tree.high[0] - tree.low[0], tree.high[2] - tree.low[2]) for tree in library.trees])
    low, high = config.sizes
    scales = low * (high / low) ** uniform(rows["row"], config.seed, "size")
    for known in (rows["crown"] / widths[trees], rows["scale"], rows["height"] / heights[trees]):  # the last one that is known counts
        scales = np.where(np.isnan(known), scales, known)
    records["scale"] = scales
    turns = np.where(np.isnan(rows["turn"]), 360 * uniform(rows["row"], config.seed, "turn"), rows["turn"])
    records["turn"] = np.mod(turns, 360)
    return records


def _choice(rows: NDArray[np.void], trees: Sequence[int], library: Library, seed: int) -> NDArray[np.int32]:
    """A tree of ``trees`` for each row, [P]."""
    heights = np.log([library.trees[tree].height for tree in trees])
    apart = np.abs(np.log(rows["height"])[:, None] - heights)  # NaN where the height is not known
    fits = ~(apart > apart.min(1, keepdims=True) + np.log(_ALIKE))
    numbers = np.floor(uniform(rows["row"], seed, "tree") * fits.sum(1)).astype(int)
    return np.array(trees, np.int32)[np.argmax(np.cumsum(fits, 1) > numbers[:, None], 1)]


_STREAMS: Mapping[str, int] = {"tree": 1, "size": 2, "turn": 3, "mix": 4}


def uniform(rows: NDArray[np.int64], seed: int, stream: str) -> NDArray[np.float64]:
    """Random numbers in [0, 1) that depend on the number of each row alone, [P], so that batches and other rows do not change them.

    They are the outputs of SplitMix64 (Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators") of these numbers.
    """
    with np.errstate(over="ignore"):
        first = np.array([seed % (1 << 64)], np.uint64)
        state = _mixed(_mixed(first) + np.uint64(_STREAMS[stream])) + rows.astype(np.uint64)
        return (_mixed(state) >> np.uint64(11)) * 2.0**-53


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
