"""Outlines of leaves: flat polygons, one for each LeafShape of the figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The right half of each outline from the stalk (0, 0) to the tip, both on the midrib, as (across, along) in shares of the leaf's length;
# the left half mirrors it. Widths are for a LeafScaleX of 1. The index is LeafShape's number; 0 is the default.
_HALVES: tuple[tuple[tuple[float, float], ...], ...] = (
    ((0.0, 0.0), (0.32, 0.14), (0.48, 0.36), (0.46, 0.6), (0.27, 0.86), (0.0, 1.0)),  # default
    ((0.0, 0.0), (0.27, 0.12), (0.4, 0.34), (0.32, 0.62), (0.12, 0.88), (0.0, 1.0)),  # ovate
    ((0.0, 0.0), (0.13, 0.15), (0.15, 0.5), (0.11, 0.88), (0.0, 1.0)),  # linear
    ((0.0, 0.0), (0.02, 0.14), (0.24, 0.07), (0.43, 0.22), (0.46, 0.44), (0.3, 0.72), (0.1, 0.92), (0.0, 1.0)),  # cordate
    (  # maple
        *((0.0, 0.0), (0.02, 0.14), (0.3, 0.06), (0.27, 0.2), (0.55, 0.3), (0.44, 0.42), (0.62, 0.62), (0.36, 0.62)),
        *((0.3, 0.74), (0.16, 0.66), (0.17, 0.84), (0.0, 1.0)),
    ),
    (  # palmate
        *((0.0, 0.0), (0.02, 0.2), (0.34, 0.12), (0.15, 0.31), (0.56, 0.38), (0.2, 0.46), (0.48, 0.76), (0.13, 0.6)),
        *((0.0, 1.0),),
    ),
    (  # spiky oak
        *((0.0, 0.0), (0.06, 0.14), (0.34, 0.12), (0.2, 0.3), (0.46, 0.38), (0.23, 0.5), (0.44, 0.66), (0.17, 0.7)),
        *((0.22, 0.88), (0.0, 1.0)),
    ),
    (  # rounded oak
        *((0.0, 0.0), (0.1, 0.16), (0.26, 0.2), (0.22, 0.32), (0.38, 0.4), (0.39, 0.5), (0.29, 0.55), (0.41, 0.68)),
        *((0.36, 0.79), (0.24, 0.8), (0.17, 0.95), (0.0, 1.0)),
    ),
    ((0.0, 0.0), (0.2, 0.13), (0.34, 0.36), (0.34, 0.64), (0.2, 0.87), (0.0, 1.0)),  # elliptic
    ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)),  # rectangle
    ((0.0, 0.0), (0.5, 0.0), (0.25, 0.5), (0.0, 1.0)),  # triangle
)
# Where all triangles of a leaf meet: a point on the midrib from which the whole outline is visible.
_CENTERS = (0.5, 0.4, 0.5, 0.42, 0.44, 0.42, 0.5, 0.55, 0.5, 0.5, 0.35)


@dataclass(frozen=True)
class LeafShape:
    """A flat leaf of length 1: across and along its midrib, stalk at (0, 0), tip at (0, 1)."""

    points: NDArray[np.float64]
    """Corners, [K, 2]: first the one on the midrib that all triangles share, then the outline counter-clockwise (across to the right)."""
    faces: NDArray[np.int32]
    """Triangles, [F, 3], counter-clockwise."""
    uvs: NDArray[np.float64]
    """Texture coordinates, [K, 2]: the leaf's bounding box fills the unit square."""


def leaf_shape(number: int) -> LeafShape:
    """The outline for a LeafShape of the figures, 0 to 10."""
    right = np.array(_HALVES[number])
    left = right[-2:0:-1] * [-1, 1]
    outline = np.concatenate([right, left])
    points = np.concatenate([[[0, _CENTERS[number]]], outline])
    corner = np.arange(1, len(points))
    faces = np.stack([np.zeros_like(corner), corner, np.roll(corner, -1)], -1).astype(np.int32)
    size = np.ptp(outline, axis=0)
    return LeafShape(points, faces, (points - outline.min(0)) / size)
