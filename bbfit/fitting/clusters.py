"""Planes through a tree's points by k-planes clustering, and rectangles on them.

k-means with planes for means (Bradley and Mangasarian 2000, "k-Plane Clustering"), for the purpose of Décoret et al.'s (2003) billboard
clouds: every point is moved onto a plane, and what is paid for is how far that displacement can be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter

import torch
from torch import Tensor

from bbfit.fitting.bounds import smallest_rectangle
from bbfit.fitting.initialize import sized
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud

_ITERATIONS = 20
# A cluster with fewer points than this share of an even one is begun anew where points lie far from all planes.
_STARVED = 0.02


@dataclass(frozen=True)
class Planes:
    """K planes, ``normal . x = offset``, and the points that are nearest to each."""

    normals: Tensor
    """Unit vectors, float64 [K, 3]."""
    offsets: Tensor
    """Meters, float64 [K]."""
    labels: Tensor
    """Plane of every point, int64 [P]."""


def seen_across(camera: Camera) -> Tensor:
    """The mean over views of the projection across the viewing direction, M [3, 3]: of a displacement d, ``d . M d`` of |d|^2 is seen."""
    forward = camera.batch().forward
    return torch.eye(3, dtype=forward.dtype) - (forward[:, :, None] * forward[:, None, :]).mean(0)


def cluster_planes(points: Tensor, count: int, seen: Tensor, *, upright: bool, generator: torch.Generator) -> Planes:
    """Planes from a random start, by turns of giving each point to the plane that displaces it least and fitting each plane to its points.

    Parameters
    ----------
    points : float64 [P, 3].
    count : K, at least 1.
    seen : :func:`seen_across` of the cameras.
    upright : whether planes have to contain the vertical.
    """
    normals = torch.randn(count, 3, dtype=points.dtype, generator=generator)
    if upright:
        normals[:, 1] = 0
    normals = torch.nn.functional.normalize(normals, dim=-1)
    offsets = (normals * points[torch.randint(len(points), (count,), generator=generator)]).sum(-1)
    return _refined(points, normals, offsets, seen, upright=upright)[0]


def split_planes(points: Tensor, axes: Tensor, seen: Tensor, *, upright: bool) -> Planes:
    """Two planes that start from halves of the points across one of some directions, [A, 3]; whichever displaces them least."""
    tried = []
    for axis in axes.to(points):
        along = points @ axis
        normals, offsets, _ = best_planes(moments(points, (along > along.median()).long(), 2), upright=upright)
        tried.append(_refined(points, normals, offsets, seen, upright=upright))
    return min(tried, key=itemgetter(1))[0]


def _refined(points: Tensor, normals: Tensor, offsets: Tensor, seen: Tensor, *, upright: bool) -> tuple[Planes, float]:
    """What planes settle down to, and the sum of squared displacements."""
    count = len(normals)
    least = max(3, int(_STARVED * len(points) / count))
    labels = torch.full((len(points),), -1)
    for _ in range(_ITERATIONS):
        distance = _displacement(points, normals, offsets, seen)
        nearest, chosen = distance.min(-1)
        for k in torch.nonzero(torch.bincount(chosen, minlength=count) < least)[:, 0].tolist():
            far = points[nearest.argmax()]
            around = (points - far).square().sum(-1).topk(min(len(points), 2 * least), largest=False).indices
            chosen[around], nearest[around] = k, 0
        if torch.equal(chosen, labels):
            break
        labels = chosen
        fitted = best_planes(moments(points, labels, count), upright=upright)
        enough = torch.bincount(labels, minlength=count) >= 3
        normals = torch.where(enough[:, None], fitted[0], normals)
        offsets = torch.where(enough, fitted[1], offsets)
    distance, labels = _displacement(points, normals, offsets, seen).min(-1)
    return Planes(normals, offsets, labels), float(distance.square().sum())


def _displacement(points: Tensor, normals: Tensor, offsets: Tensor, seen: Tensor) -> Tensor:
    """How far moving each point onto each plane is seen, root mean square over views, in meters, [P, K]."""
    visible = ((normals @ seen) * normals).sum(-1).clamp_min(0).sqrt()
    return (points @ normals.mT - offsets).abs() * visible


def moments(points: Tensor, labels: Tensor, count: int) -> Tensor:
    """The sums of p p^T over each cluster's points p = (x, y, z, 1), [K, 4, 4]; those of a union of clusters are the sums of these."""
    extended = torch.nn.functional.pad(points, (0, 1), value=1.0)
    return points.new_zeros(count, 4, 4).index_add_(0, labels, extended[:, :, None] * extended[:, None, :])


def best_planes(sums: Tensor, *, upright: bool) -> tuple[Tensor, Tensor, Tensor]:
    """The planes with the least squared distances: across the direction of least variance (Pearson 1901).

    Parameters
    ----------
    sums : :func:`moments`, [K, 4, 4].
    upright : whether planes have to contain the vertical.

    Returns
    -------
    Unit normals [K, 3], offsets [K] and the sums of squared distances [K].
    """
    means = sums[:, :3, 3] / sums[:, 3, 3:].clamp_min(1)
    scatter = sums[:, :3, :3] - means[:, :, None] * sums[:, None, :3, 3]
    if upright:
        values, vectors = torch.linalg.eigh(scatter[:, ::2, ::2])
        x, z = vectors[:, :, 0].unbind(-1)
        normals = torch.stack([x, torch.zeros_like(x), z], -1)
    else:
        values, vectors = torch.linalg.eigh(scatter)
        normals = vectors[:, :, 0]
    return normals, (normals * means).sum(-1), values[:, 0].clamp_min(0)


def rectangles(points: Tensor, planes: Planes, texels_a_meter: float, margin: float, *, two_sided: bool) -> BillboardCloud:
    """The smallest rectangles on the planes that hold the points of each, float64, with transparent textures.

    Rectangles stand upright unless a turned one is a fifth smaller.

    Parameters
    ----------
    margin : meters added on every side.
    two_sided : whether each gets a texture for its back.
    """
    parts = []
    for k, (normal, offset) in enumerate(zip(planes.normals, planes.offsets, strict=True)):
        own = points[planes.labels == k]
        up = torch.tensor([0.0, 1.0, 0.0], dtype=points.dtype)
        if float(normal[1].abs()) > 0.999:
            up = torch.tensor([0.0, 0.0, -1.0], dtype=points.dtype)
        right = torch.nn.functional.normalize(torch.linalg.cross(up, normal), dim=0)
        up = torch.linalg.cross(normal, right)
        flat = torch.stack([own @ right, own @ up], -1) if len(own) else torch.zeros(1, 2, dtype=points.dtype)
        center, axis, half = smallest_rectangle(flat)
        middle = normal * offset + right * center[0] + up * center[1]
        parts.append((middle, axis[0] * right + axis[1] * up, axis[0] * up - axis[1] * right, half + margin))
    centers, rights, ups, halves = (torch.stack(part) for part in zip(*parts, strict=True))
    return sized(
        BillboardCloud(
            centers,
            rights,
            ups,
            halves,
            torch.ones(len(centers), 2, dtype=torch.int64),
            torch.full((len(centers),), two_sided),
            torch.zeros(len(centers) * (1 + two_sided), 4),
        ),
        texels_a_meter,
    )


def splatted(cloud: BillboardCloud, points: Tensor, colors: Tensor, labels: Tensor) -> BillboardCloud:
    """The same billboards with textures made of the points that each carries.

    A texel's color is the mean of its points' colors, and its alpha is 1 - exp(-n / m), with n points on it and m of them, on average,
    on those texels of the billboard that have any: what a random arrangement of as much surface covers.

    Parameters
    ----------
    points, colors, labels : [P, 3], straight RGB [P, 3] and billboard [P].
    """
    textures = []
    for k, (h, w) in enumerate(cloud.texture_sizes.tolist()):
        own = labels == k
        offset = points[own] - cloud.centers[k]
        u = (offset @ cloud.rights[k] / cloud.half_extents[k, 0] + 1) * w / 2
        v = (1 - offset @ cloud.ups[k] / cloud.half_extents[k, 1]) * h / 2
        index = v.long().clamp(0, h - 1) * w + u.long().clamp(0, w - 1)
        number = torch.zeros(h * w).index_add_(0, index, torch.ones(len(index)))
        color = torch.zeros(h * w, 3).index_add_(0, index, colors[own]) / number.clamp_min(1)[:, None]
        color[number == 0] = colors[own].mean(0) if len(index) else 0.5
        alpha = 1 - torch.exp(-number / number[number > 0].mean()) if len(index) else number
        textures.append(torch.cat([color, alpha[:, None]], -1).repeat(1 + int(cloud.two_sided[k]), 1))
    return cloud.with_texels(torch.cat(textures))
