"""Trees with nothing at random, and measures of stems."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bbfit.trees.skeleton import Array, Skeleton, Stems
from bbfit.trees.species import Species, load_species
from bbfit.trees.weber_penn import grow_skeleton

ROUNDING = 1e-9  # of float64 through some twenty rotations and a scaling; measured at most 2e-14 on angles and shares


def grown(species: Species, seed: int = 0, leaves: float = 1.0) -> Skeleton:
    return grow_skeleton(species, seed, lambda level, number: None, leaves=leaves)


def plain(**figures: Any) -> Species:
    """A straight trunk, straight branches that stand off at right angles, twigs likewise, a leaf shape; nothing at random."""
    start = {
        "shape": 3,
        "scale": 10,
        "scale_v": 0,
        "levels": 2,
        "base_size": (0.2, 0, 0, 0),
        "down_angle": (0, 90, 60, 45),
        "down_angle_v": (0,) * 4,
        "rotate": (0, 140, 140, 140),
        "rotate_v": (0,) * 4,
        "branches": (1, 12, 5, 3),
        "length": (1, 0.3, 0.5, 0.5),
        "length_v": (0,) * 4,
        "seg_splits": (0,) * 4,
        "split_angle": (0,) * 4,
        "split_angle_v": (0,) * 4,
        "curve_res": (6,) * 4,
        "curve": (0,) * 4,
        "curve_back": (0,) * 4,
        "curve_v": (0,) * 4,
        "bend_v": (0,) * 4,
        "branch_dist": (0,) * 4,
        "leaves": 0,
        "tropism": (0, 0, 0),
    }
    return replace(load_species("quaking_aspen"), **{**start, **figures})


def by_level(level: int, value: float) -> tuple[float, ...]:
    return tuple(value if index == level else 0 for index in range(4))


def angles(a: Array, b: Array) -> Array:
    """Degrees between vectors, [..., 3] each."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def directions(stems: Stems) -> Array:
    """Unit tangents at the nodes, [S, nCurveRes + 1, 3]."""
    return stems.frames[..., 2]


def at_parents(parents: Stems, stems: Stems) -> tuple[Array, Array]:
    """Where stems grow from their parents: points and the parents' tangents there."""
    points, frames = parents.at(stems.parent, stems.offset)
    return points, frames[..., 2]
