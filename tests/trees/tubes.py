"""A grown tree read back from its triangles alone: the tubes that the bark is made of, and how far points are from their axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bbfit.trees.parts import Part

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Tubes:
    """The bark's connected pieces, T of them, in the order of their vertices; and their rings, R in all, the tip being the last of each."""

    tube: Indices
    """The tube of each ring, [R]."""
    centers: Array
    """Middle of each ring, [R, 3]."""
    radius: Array
    """Smallest distance of its vertices from there, [R]; 0 at tips."""
    starts: Indices
    """First ring of each tube, [T]."""

    def __len__(self) -> int:
        return len(self.starts)


def find_tubes(bark: Part) -> Tubes:
    """Tubes are what edges connect; a ring is the vertices of a tube with the same v, the seam's there twice."""
    edges = bark.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(bark.vertices)
    number, labels = connected_components(coo_matrix((np.ones(len(edges), bool), edges.T), (count, count)), directed=False)
    order = np.unique(labels, return_index=True)[1]
    assert (np.diff(labels[np.sort(order)]) == 1).all() and (np.diff(labels) >= 0).all(), "a tube's vertices are not side by side"
    v = bark.uvs[:, 1]
    fresh = np.concatenate([[True], (np.diff(labels) != 0) | (np.diff(v) != 0)])
    ring = np.cumsum(fresh) - 1
    first = np.flatnonzero(fresh)
    vertices = bark.vertices.astype(np.float64)
    last = np.concatenate([first[1:], [count]]) - 1
    once = np.ones(count, bool)  # without the seam's second vertex
    once[last[last > first]] = False
    assert np.array_equal(bark.vertices[last], bark.vertices[first]), "a ring is not closed"
    size = np.bincount(ring, once)
    centers = np.stack([np.bincount(ring, once * vertices[:, axis]) / size for axis in range(3)], -1)
    radius = np.full(len(first), np.inf)
    np.minimum.at(radius, ring, np.linalg.norm(vertices - centers[ring], axis=-1))
    tube = labels[first]
    assert number == tube[-1] + 1
    return Tubes(tube, centers, radius, np.flatnonzero(np.diff(tube, prepend=-1)))


def beyond_bark(tubes: Tubes, points: Array, before: Indices | None = None, *, reach: float) -> tuple[Array, Array]:
    """How far points [K, 3] are from the nearest axis, and how far beyond the tube's radius there, both in meters.

    ``before`` [K] leaves only tubes of lower numbers. A point farther than ``reach`` from all axes gets infinity.
    """
    begin = np.flatnonzero(np.diff(tubes.tube) == 0)
    a, b = tubes.centers[begin], tubes.centers[begin + 1]
    cuts = np.ceil(np.linalg.norm(b - a, axis=-1) / reach).astype(int)
    piece = np.repeat(np.arange(len(begin)), cuts)
    place = (np.arange(len(piece)) - np.repeat(np.cumsum(cuts) - cuts, cuts) + 0.5) / cuts[piece]
    middles = a[piece] + place[:, None] * (b - a)[piece]
    near: Any = cKDTree(points).sparse_distance_matrix(cKDTree(middles), 1.5 * reach, output_type="ndarray")
    point, piece = near["i"], piece[near["j"]]
    if before is not None:
        kept = tubes.tube[begin[piece]] < before[point]
        point, piece = point[kept], piece[kept]
    along = (b - a)[piece]
    share = np.clip(((points[point] - a[piece]) * along).sum(-1) / (along**2).sum(-1), 0, 1)
    away = np.linalg.norm(a[piece] + share[:, None] * along - points[point], axis=-1)
    beyond = away - ((1 - share) * tubes.radius[begin[piece]] + share * tubes.radius[begin[piece] + 1])
    distance, excess = np.full(len(points), np.inf), np.full(len(points), np.inf)
    np.minimum.at(distance, point, away)
    np.minimum.at(excess, point, beyond)
    return distance, excess
