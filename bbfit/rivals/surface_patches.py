"""A surface in patches, each of which is a height field over a plane: the first step of coding it as height fields.

Ochotta and Saupe 2004 (section on partitioning) split and merge clusters of points until the normals of each lie in a cone. Here triangles
take the place of points, and patches are only split: into connected pieces, and, while normals leave the cone, by two directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CONE = 0.5
"""Least cosine between the normals of a patch's triangles and the patch's mean normal: a cone of 60 degrees."""
# Rounds of splitting, of which each halves the patches that are too curved; rounds of moving triangles between halves.
_ROUNDS, _MOVES = 12, 3


def surface_patches(triangles: Floats, links: Integers) -> Integers:
    """The patch of each triangle, [T], numbered from 0.

    ``triangles`` are corners in meters, [T, 3, 3]; ``links`` are pairs of neighbors, [L, 2].
    """
    normals = scaled_normals(triangles)
    patches = _connected(np.zeros(len(triangles), np.int64), links)
    for _ in range(_ROUNDS):
        means, directions = _unit(_sums(normals, patches)), _unit(normals)
        cosines = (directions * means[patches]).sum(-1)
        curved = np.zeros(patches.max() + 1, bool)
        curved[patches[cosines < CONE]] = True
        if not curved.any():
            break
        away = _extreme(-cosines, patches)  # the triangle of each patch that turns most from its mean
        first = directions[away]
        second = directions[_extreme(-(directions * first[patches]).sum(-1), patches)]
        for _ in range(_MOVES):
            side = (directions * second[patches]).sum(-1) > (directions * first[patches]).sum(-1)
            halves = _unit(_sums(normals, 2 * patches + side, 2 * len(curved)))
            first, second = halves[0::2], halves[1::2]
        patches = _connected(2 * patches + np.where(curved[patches], side, False), links)
    return patches


def halved(triangles: Floats, patches: Integers, chosen: NDArray[np.bool_], links: Integers) -> Integers:
    """Patches of which the chosen ones, [P], are cut across their longest side and fall into connected pieces."""
    middles = triangles.mean(1)
    means = _sums(middles, patches) / np.bincount(patches)[:, None]
    apart = middles - means[patches]
    axis = np.stack([np.bincount(patches, apart[:, each] ** 2) for each in range(3)], -1).argmax(-1)
    beyond = np.take_along_axis(apart, axis[patches][:, None], -1)[:, 0] > 0
    return _connected(2 * patches + np.where(chosen[patches], beyond, False), links)


def linked(faces: Integers) -> Integers:
    """Pairs of triangles that share an edge, [L, 2], for the vertices of triangles, [T, 3]."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
    owners = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(-1)
    return np.stack([owners[order[:-1]][same], owners[order[1:]][same]], -1)


def scaled_normals(triangles: Floats) -> Floats:
    """Normals of triangles [T, 3, 3], as long as twice their area, [T, 3]."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _sums(values: Floats, groups: Integers, count: int = 0) -> Floats:
    return np.stack([np.bincount(groups, values[:, axis], count) for axis in range(values.shape[1])], -1)


def _extreme(values: Floats, groups: Integers) -> Integers:
    """The index of each group's largest value."""
    order = np.lexsort((values, groups))
    return order[np.append(np.nonzero(np.diff(groups[order]))[0], len(order) - 1)]


def _connected(labels: Integers, links: Integers) -> Integers:
    """Pieces of equal label that links connect, numbered from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    kept = links[labels[links[:, 0]] == labels[links[:, 1]]]
    graph = coo_matrix((np.ones(len(kept), bool), (kept[:, 0], kept[:, 1])), shape=(len(labels), len(labels)))
    return connected_components(graph, directed=False)[1].astype(np.int64)
