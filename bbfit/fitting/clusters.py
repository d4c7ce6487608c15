"""Planes through the points of a tree by k-planes clustering, and textured rectangles on these planes.

k-planes clustering is k-means with planes in place of means (Bradley and Mangasarian 2000, "k-Plane Clustering"). It serves the purpose of
billboard clouds (Décoret et al. 2003): it moves every point onto a plane, and the cost is the displacement that the views can see. With a
locality above 0, the cost also grows with the distance from the middle of the cluster, as in k-means. Clusters are then compact patches
instead of slices through the whole tree, and their rectangles have less area.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from bbfit.fitting.bounds import smallest_rectangle
from bbfit.fitting.initialize import sized
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud

_ITERATIONS = 20
# A cluster with fewer points than this fraction of the average cluster restarts at the point that is farthest from all planes.
_STARVED = 0.02
# Iterations of k-means before the first planes of compact clusters.
_MEANS_ITERATIONS = 4
# Rounds that fit a plane, and the share of a cluster's extent or of a view's displacement below which either counts as none.
_PLANE_ROUNDS = 4
_FLAT = 1e-12
# Costs that are computed together, so few that they stay in the processor's cache.
_IN_CACHE = 1 << 18


@dataclass(frozen=True)
class Planes:
    """K planes, ``normal . x = offset``, and the assignment of points to them."""

    normals: Tensor
    """Unit vectors, float64 [K, 3]."""
    offsets: Tensor
    """Meters, float64 [K]."""
    labels: Tensor
    """Index of the nearest plane of every point, int64 [P]."""


class _Costs:
    """The costs of points, float64 [P, 3], in clusters: how far views see a point move onto the plane, and how far the center is.

    A cost, in square meters, is a quadratic form in (x, y, z, 1), so that a product of matrices has the costs in all clusters.
    """

    def __init__(self, points: Tensor, projection: Tensor, locality: float) -> None:
        self.projection, self._locality = projection, locality
        self._origin = points.mean(0)  # near which squares of coordinates lose no digits
        self._rows, self._columns = torch.triu_indices(4, 4)
        extended = torch.nn.functional.pad(points - self._origin, (0, 1), value=1.0)
        self._products = (extended[:, self._rows] * extended[:, self._columns]).float()
        self._squares = _squares(points)

    def least(self, normals: Tensor, offsets: Tensor, centers: Tensor) -> tuple[Tensor, Tensor]:
        """The least cost of each point in K clusters, float32 [P], and its cluster, int64 [P]."""
        planes = torch.cat([normals, (normals @ self._origin - offsets)[:, None]], -1)
        visible = _form(self.projection, normals).clamp_min(0)
        return self._least(visible[:, None, None] * planes[:, :, None] * planes[:, None, :] + self._locality * self._distances(centers))

    def moments(self, labels: Tensor, count: int) -> Tensor:
        """The :func:`moments` of ``count`` clusters of the points."""
        return _summed(self._squares, labels, count)

    def nearest(self, centers: Tensor) -> Tensor:
        """The index of the center, of [K, 3], nearest to each point, int64 [P]."""
        return self._least(self._distances(centers))[1]

    def _distances(self, centers: Tensor) -> Tensor:
        """The matrices of the squared distances from K centers, [K, 4, 4]."""
        identity = torch.eye(3, dtype=centers.dtype).expand(len(centers), 3, 3)
        away = torch.cat([identity, (self._origin - centers)[..., None]], -1)
        return away.mT @ away

    def _least(self, forms: Tensor) -> tuple[Tensor, Tensor]:
        """The least value at each point of K symmetric forms, [K, 4, 4], and the index of that form."""
        twice = torch.where(self._rows == self._columns, 1, 2)
        coefficients = (twice * forms[:, self._rows, self._columns]).float()
        parts = self._products.split(max(1, _IN_CACHE // len(forms)))
        # numpy instead of torch, whose argmin takes several times as long
        labels = torch.from_numpy(np.concatenate([(part @ coefficients.mT).numpy().argmin(-1) for part in parts]))
        return (self._products * coefficients[labels]).sum(-1), labels


def view_projection(camera: Camera) -> Tensor:
    """Average the projections across the viewing directions of V cameras to a matrix M, [3, 3].

    Of the squared length of a displacement d, the views see ``d . M d`` on average.
    """
    forward = camera.batch().forward
    return torch.eye(3, dtype=forward.dtype) - (forward[:, :, None] * forward[:, None, :]).mean(0)


def cluster_planes(
    points: Tensor, count: int, projection: Tensor, *, upright: bool, generator: torch.Generator, locality: float = 0.0
) -> Planes:
    """Cluster points, float64 [P, 3], onto ``count`` planes, at least one, from a random start.

    Two steps alternate: assign each point to the plane that costs least, and fit each plane to its points. The cost is the squared
    displacement that the views see, where ``projection`` is the :func:`view_projection` of the cameras, plus ``locality`` times the squared
    distance from the mean of the cluster's points. With ``upright``, all planes contain the vertical.
    """
    normals = torch.randn(count, 3, dtype=points.dtype, generator=generator)
    centers, costs = points[torch.randint(len(points), (count,), generator=generator)], _Costs(points, projection, locality)
    if locality:
        for _ in range(_MEANS_ITERATIONS):
            sums = costs.moments(costs.nearest(centers), count)
            centers = torch.where(sums[:, 3, 3:] > 0, _centers(sums), centers)
        normals, offsets, _ = best_planes(costs.moments(costs.nearest(centers), count), projection, upright=upright)
    else:
        if upright:
            normals[:, 1] = 0
        normals = torch.nn.functional.normalize(normals, dim=-1)
        offsets = (normals * centers).sum(-1)
    return _refined(points, normals, offsets, centers, costs, upright=upright)[0]


def split_planes(points: Tensor, axes: Tensor, projection: Tensor, *, upright: bool, locality: float = 0.0) -> Planes:
    """Cluster points, float64 [P, 3], onto two planes.

    For each of A directions, [A, 3], the clustering starts from the two halves of the points below and above the median along it. The
    clustering with the least cost is returned. The other parameters are those of :func:`cluster_planes`.
    """
    results, costs = [], _Costs(points, projection, locality)
    for axis in axes.to(points):
        along = points @ axis
        sums = costs.moments((along > along.median()).long(), 2)
        normals, offsets, _ = best_planes(sums, projection, upright=upright)
        results.append(_refined(points, normals, offsets, _centers(sums), costs, upright=upright))
    return min(results, key=itemgetter(1))[0]


def _refined(points: Tensor, normals: Tensor, offsets: Tensor, centers: Tensor, costs: _Costs, *, upright: bool) -> tuple[Planes, float]:
    """Iterate the clustering until the assignment is stable. Return the planes and the sum of the costs."""
    count = len(normals)
    least = max(3, int(_STARVED * len(points) / count))
    labels = torch.full((len(points),), -1)
    for _ in range(_ITERATIONS):
        cost, nearest = costs.least(normals, offsets, centers)
        for k in torch.nonzero(torch.bincount(nearest, minlength=count) < least)[:, 0].tolist():
            far = points[cost.argmax()]
            around = (points - far).square().sum(-1).topk(min(len(points), 2 * least), largest=False).indices
            nearest[around], cost[around] = k, 0
        if torch.equal(nearest, labels):
            break
        labels = nearest
        sums = costs.moments(labels, count)
        new_normals, new_offsets, _ = best_planes(sums, costs.projection, upright=upright)
        enough = sums[:, 3, 3] >= 3
        normals = torch.where(enough[:, None], new_normals, normals)
        offsets = torch.where(enough, new_offsets, offsets)
        centers = torch.where(enough[:, None], _centers(sums), centers)
    cost, labels = costs.least(normals, offsets, centers)
    return Planes(normals, offsets, labels), float(cost.sum(dtype=torch.float64))


def _centers(sums: Tensor) -> Tensor:
    """The mean of the points of each cluster, [K, 3], from the :func:`moments`."""
    return sums[:, :3, 3] / sums[:, 3, 3:].clamp_min(1)


def moments(points: Tensor, labels: Tensor, count: int) -> Tensor:
    """Sum p p^T over the points p = (x, y, z, 1) of each cluster, [K, 4, 4]. ``labels`` are the clusters of the points, int64 [P].

    The moments of a union of clusters are the sum of their moments.
    """
    return _summed(_squares(points), labels, count)


def _squares(points: Tensor) -> Tensor:
    """p p^T of the points p = (x, y, z, 1), [P, 4, 4]."""
    extended = torch.nn.functional.pad(points, (0, 1), value=1.0)
    return extended[:, :, None] * extended[:, None, :]


def _summed(squares: Tensor, labels: Tensor, count: int) -> Tensor:
    return squares.new_zeros(count, 4, 4).index_add_(0, labels, squares)


def best_planes(sums: Tensor, projection: Tensor, *, upright: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a plane through the mean of each cluster, so that the views see the least displacement of its points onto the plane.

    The squared displacement that views see along a unit normal n is the product of n . S n, where S is the scatter of the points, and
    n . M n, where M is the :func:`view_projection`. The logarithm of each factor is at most its tangent, so that every round lowers the
    product by the least eigenvector of the sum of the tangents (majorization and minimization, Hunter and Lange 2004). Where views see all
    displacements alike, the result is the plane of least squares (Pearson 1901).

    ``sums`` are the :func:`moments` of K clusters. With ``upright``, all planes contain the vertical. Returns the unit normals, [K, 3], the
    offsets in meters, [K], and the sums of squared distances, [K].
    """
    means, axes = _centers(sums), [0, 2] if upright else [0, 1, 2]
    scatter = (sums[:, :3, :3] - means[:, :, None] * sums[:, None, :3, 3])[:, axes][:, :, axes]
    visible, scale = projection[axes][:, axes], scatter.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(_FLAT)

    def least(apart: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The least eigenvectors for the values of both factors, [K], and the values at these vectors."""
        within = torch.linalg.eigh(scatter / apart[:, None, None] + visible / seen[:, None, None])[1][..., 0]
        return within, _form(scatter, within).maximum(_FLAT * scale), _form(visible, within).clamp_min(_FLAT)

    # The product has several minima. One search begins where both factors weigh the same, the other at the plane of least squares.
    results = []
    for weight in (1, 1 / _FLAT):
        within, apart, seen = least(scale, weight * visible.diagonal().mean().expand_as(scale))
        for _ in range(_PLANE_ROUNDS):
            within, apart, seen = least(apart, seen)
        results.append((within, apart * seen))
    (within, product), (other, other_product) = results
    within = torch.where((product <= other_product)[:, None], within, other)
    normals = within.new_zeros(len(sums), 3)
    normals[:, axes] = within
    return normals, (normals * means).sum(-1), _form(scatter, within).clamp_min(0)


def _form(matrix: Tensor, vectors: Tensor) -> Tensor:
    """The quadratic forms v . A v of vectors, [K, D], and one or K matrices, [D, D] or [K, D, D]."""
    return (vectors[:, None] @ matrix @ vectors[:, :, None])[:, 0, 0]


def rectangles(points: Tensor, planes: Planes, texels_per_meter: float, margin: float, *, two_sided: bool) -> BillboardCloud:
    """Place the smallest rectangle that contains the points, float64 [P, 3], of each of K planes, plus a margin in meters on every side.

    A rectangle is upright unless a rotated one is a fifth smaller. Returns K billboards, float64, with transparent textures of
    ``texels_per_meter`` along each side. Two-sided ones have a back texture.
    """
    parts, counts = [], torch.bincount(planes.labels, minlength=len(planes.normals)).tolist()
    ordered = points[planes.labels.argsort(stable=True)].split(counts)
    for members, normal, offset in zip(ordered, planes.normals, planes.offsets, strict=True):
        up = torch.tensor([0.0, 0.0, -1.0] if float(normal[1].abs()) > 0.999 else [0.0, 1.0, 0.0], dtype=points.dtype)
        right = torch.nn.functional.normalize(torch.linalg.cross(up, normal), dim=0)
        up = torch.linalg.cross(normal, right)
        flat = torch.stack([members @ right, members @ up], -1) if len(members) else torch.zeros(1, 2, dtype=points.dtype)
        center, axis, half = smallest_rectangle(flat)
        middle = normal * offset + right * center[0] + up * center[1]
        parts.append((middle, axis[0] * right + axis[1] * up, axis[0] * up - axis[1] * right, half + margin))
    centers, rights, ups, halves = (torch.stack(part) for part in zip(*parts, strict=True))
    sizes, sides = torch.ones(len(centers), 2, dtype=torch.int64), torch.full((len(centers),), two_sided)
    cloud = BillboardCloud(centers, rights, ups, halves, sizes, sides, torch.zeros(len(centers) * (1 + two_sided), 4))
    return sized(cloud, texels_per_meter)


def splatted(cloud: BillboardCloud, points: Tensor, colors: Tensor, labels: Tensor) -> BillboardCloud:
    """Splat points, [P, 3], with straight RGB, [P, 3], into the textures of N billboards at the indices ``labels``, int64 [P].

    The color of a texel is the mean color of its points. Its alpha is 1 - exp(-n / m), the expected coverage of randomly placed surface,
    where n is the number of points in the texel and m the mean of n over the texels of the billboard that contain points.
    """
    sizes, count = cloud.texture_sizes.prod(-1), len(cloud)
    owners, total = torch.arange(count).repeat_interleave(sizes), int(sizes.sum())
    offset, half = points - cloud.centers[labels], cloud.half_extents[labels]
    h, w = cloud.texture_sizes[labels].unbind(-1)
    u = ((offset * cloud.rights[labels]).sum(-1) / half[:, 0] + 1) * w / 2
    v = (1 - (offset * cloud.ups[labels]).sum(-1) / half[:, 1]) * h / 2
    row, column = v.long().clamp_min(0).minimum(h - 1), u.long().clamp_min(0).minimum(w - 1)
    index = (sizes.cumsum(0) - sizes)[labels] + row * w + column
    number = torch.zeros(total).index_add_(0, index, torch.ones(len(index)))
    color = torch.zeros(total, 3).index_add_(0, index, colors)
    whole = torch.zeros(count, 4).index_add_(0, owners, torch.cat([color, number[:, None]], -1))
    shown = torch.zeros(count).index_add_(0, owners, (number > 0).float())
    mean = torch.where(whole[:, 3:] > 0, whole[:, :3] / whole[:, 3:], 0.5)
    color = torch.where(number[:, None] > 0, color / number[:, None], mean[owners])
    alpha = 1 - torch.exp(-number / (whole[:, 3] / shown).nan_to_num(nan=1.0)[owners])
    textures = torch.cat([color, alpha[:, None]], -1).split(sizes.tolist())
    return cloud.with_texels(torch.cat([part.repeat(1 + back, 1) for part, back in zip(textures, cloud.two_sided.tolist(), strict=True)]))
