"""The bark of the trunk and of thick branches: which parts of a mesh it is, and the flat facets that stand for it.

Leaves are cards or clouds of leaves from afar, but wood is solid. Facets on its surface hide what is behind them, and move against each
other as the view turns, as the wood does. Planes through its middle do neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.fitting.clusters import Planes

if TYPE_CHECKING:
    import trimesh

# Least diagonal of a connected part of the mesh that can be wood, as a share of the tree's longest side. Leaves are smaller.
_LEAST_PART = 0.05
# Largest radius of wood, as a share of the tree's longest side, and iterations of the balls that measure it. Ten are nearly always enough.
_THICKEST, _SHRINKINGS = 0.1, 16
# A point is in a ball if it is closer to the middle than this share of the radius. The ball touches the surface across from a point if it
# does so at least this share of the radius below the point's tangent plane.
_INSIDE, _ACROSS = 0.999, 0.5
# Vertices closer than this share of the tree's longest side are the same.
_SAME = 1e-6
# Iterations of the clustering of facets. The costs of a point against its squared distance from the facet's plane: the weight of its
# squared distance from the facet's middle, and the cost of a normal at right angles, in mean squared distances of the bark from its middle.
_ITERATIONS, _LOCALITY, _TURNED = 25, 0.1, 0.01


@dataclass(frozen=True)
class Bark:
    """Which of the points on a tree are on the bark of its trunk and thick branches."""

    members: Tensor
    """Indices of the points, int64 [B]."""
    normals: Tensor
    """Unit normals of the surface there, outwards, float64 [B, 3]."""


def bark_of(mesh: trimesh.Trimesh, points: NDArray[np.float64], faces: NDArray[np.int64], thickness: float) -> NDArray[np.int64]:
    """Find the points on a mesh, [P, 3], that lie on wood of at least ``thickness`` meters. Returns their indices.

    ``faces`` are the triangles that the points lie on, [P]. Wood is a connected part of the mesh that is large, and round: the largest ball
    that touches the surface in a point from inside, and contains no other point of the part, is small against the tree ("shrinking ball",
    Ma, Bae and Choi 2012, "3D medial axis point approximation using nearest neighbors and the normal field"). Its diameter is the
    thickness. A flat card or a bent leaf has no such ball.
    """
    side, (part, diagonals) = float(mesh.extents.max()), _parts(mesh)
    members = np.nonzero(diagonals[part[faces]] >= _LEAST_PART * side)[0]
    if len(members) < 2:
        return members[:0]
    on = faces[members]
    return members[_thickness(points[members], mesh.face_normals[on], part[on], _THICKEST * side) >= thickness]


def facets(points: Tensor, normals: Tensor, count: int, generator: torch.Generator) -> Planes:
    """Cluster points on bark, float64 [B, 3], with unit normals, [B, 3], into at most ``count`` flat facets that face where they do.

    The cost of a point grows with its distance from the facet's plane and from its middle, and with the angle between the normals
    (Cohen-Steiner, Alliez and Desbrun 2004, "Variational Shape Approximation"), so that facets are long and narrow, along branches.
    """
    count = min(count, len(points))
    turned = _TURNED * float((points - points.mean(0)).square().sum(-1).mean())
    start = torch.randperm(len(points), generator=generator)[:count]
    centers, facing = points[start], normals[start]
    labels = torch.zeros(len(points), dtype=torch.int64)
    for _ in range(_ITERATIONS):
        away = points @ facing.mT - (centers * facing).sum(-1)
        costs = away.square() + _LOCALITY * torch.cdist(points, centers).square() + turned * (1 - normals @ facing.mT)
        cost, labels = costs.min(-1)
        sums = torch.zeros(count, 7, dtype=points.dtype)
        sums.index_add_(0, labels, torch.cat([points, normals, torch.ones_like(points[:, :1])], -1))
        number = sums[:, 6:]
        centers, facing = torch.where(number > 0, sums[:, :3] / number.clamp_min(1), centers), normalize(sums[:, 3:6], dim=-1)
        lost = torch.nonzero((number[:, 0] == 0) | (facing.norm(dim=-1) < 0.5))[:, 0]  # no points, or points that face all ways
        worst = cost.topk(len(lost)).indices
        centers[lost], facing[lost] = points[worst], normals[worst]
    used, labels = labels.unique(return_inverse=True)
    return Planes(facing[used], (facing * centers).sum(-1)[used], labels)


def _parts(mesh: trimesh.Trimesh) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The connected part that each triangle belongs to, [F], and the diagonals in meters of the boxes around the parts."""
    places = np.asarray(mesh.vertices)
    grid = np.round((places - places.min(0)) / (_SAME * float(mesh.extents.max()))).astype(np.int64)
    _, vertex = np.unique(grid @ [1 << 42, 1 << 21, 1], return_inverse=True)  # 20 bits hold a coordinate
    corners = vertex[mesh.faces]
    count = int(corners.max()) + 1
    edges = np.concatenate([corners[:, :2], corners[:, 1:]])
    _, part = connected_components(coo_matrix((np.ones(len(edges), dtype=bool), edges.T), shape=(count, count)), directed=False)
    part = part[corners[:, 0]].astype(np.int64)
    low, high = np.full((part.max() + 1, 3), np.inf), np.full((part.max() + 1, 3), -np.inf)
    for corner in mesh.triangles.transpose(1, 0, 2):
        np.minimum.at(low, part, corner)
        np.maximum.at(high, part, corner)
    return part, np.linalg.norm(np.where(low <= high, high - low, 0), axis=-1)


def _thickness(points: NDArray[np.float64], normals: NDArray[np.float64], part: NDArray[np.int64], largest: float) -> NDArray[np.float64]:
    """The diameter of the largest ball that touches each point from inside and contains no other of its part, in meters, [P].

    Points that the ball contains beside the point, and not across from it, do not count: they are noise, or an edge of a coarse mesh. It is
    0 if no ball with a radius of at most ``largest`` touches the part across from the point.
    """
    apart = 4 * largest * part[:, None]  # a fourth coordinate, in which other parts are out of reach
    tree, radii, shrinking = cKDTree(np.hstack([points, apart])), np.full(len(points), largest), np.arange(len(points))
    for _ in range(_SHRINKINGS):
        middles = points[shrinking] - radii[shrinking, None] * normals[shrinking]
        distance, nearest = tree.query(np.hstack([middles, apart[shrinking]]))
        across = points[shrinking] - points[nearest]
        depth = np.maximum((across * normals[shrinking]).sum(-1), 1e-12)
        smaller = np.square(across).sum(-1) / (2 * depth)
        inside = (distance < _INSIDE * radii[shrinking]) & (depth > _ACROSS * smaller)
        shrinking = shrinking[inside]
        radii[shrinking] = smaller[inside]
    return np.where(radii < largest, 2 * radii, 0.0)
