"""Billboard clouds (Décoret, Durand, Sillion and Dorsey 2003, "Billboard Clouds for Extreme Model Simplification", SIGGRAPH).

Implemented from the paper's abstract and descriptions of it, without its full text. Planes are searched in a discretized plane space of a
direction (theta, phi) and a distance rho from the origin; a face is valid for a plane if all its corners lie within
epsilon of it. A plane's density is the area of its valid faces (coverage), projected onto the plane. The densest plane is chosen and
refined in finer plane space, and its faces are removed, until no face is left. A face appears on every plane for which it is valid, which
closes cracks.

Differences: the paper takes epsilon and returns the number of planes; this module takes the number of planes and finds epsilon by
bisection, such that the planes hold a share of the area. Planes are chosen on random triangles, because a tree has millions. Each chosen
plane is moved to the least-squares plane of its faces' corners if all of them stay valid. The paper's penalty on planes that are not
tangent to the surface is left out, because scattered leaves form no surface. Fuhrmann, Umlauf and
Mantler 2005 ("Extreme Model Simplification for Forest Rendering") make 15 to 50 billboards of a tree in this way; their
changes for trees are not implemented.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range, check_shape, fail
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rivals.baking import BakeConfig, Slabs, bake, tree_triangles
from bbfit.tree_files.tree_file import TreeFile

# Degrees between neighboring directions of plane space, and how often the step is halved around the densest plane.
_STEP, _HALVINGS = 9.0, 4
# Bins of rho to an epsilon, and in all at most.
_BINS, _MOST_BINS = 4, 2000
# Directions that are processed together, to bound the memory.
_TOGETHER = 16
# Smallest epsilon as a share of the largest, and steps of the bisection.
_LEAST, _BISECTIONS = 1e-3, 9
# A normal nearer to the vertical than this, as a cosine, has no upright direction in its plane.
_LEVEL = 0.999
# Share of the area below which differences are rounding errors.
_NOTHING = 1e-12
# Share of epsilon by which corners may be beyond it through rounding.
_ROUNDING = 1e-6

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneChoice:
    """N planes and the triangles of each."""

    normals: Array
    """Unit normals, [N, 3]."""
    distances: Array
    """Distances of the planes from the origin along their normals in meters, [N]."""
    members: tuple[NDArray[np.int64], ...]
    """Indices of the triangles of each plane, N arrays; each triangle belongs to at most one plane."""
    epsilon: float
    """Largest distance of a plane's triangles from it, in meters."""
    share: float
    """Share of the triangles' area that the planes hold."""


def billboard_cloud(
    tree: str | Path | TreeFile,
    count: int,
    config: BakeConfig,
    *,
    share: float = 0.95,
    samples: int = 50_000,
    folder: str | Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> BillboardCloud:
    """Choose planes for a tree's triangles and bake onto each all that lies within epsilon of it.

    A rectangle bounds the triangles of its plane. It shows everything within epsilon, including parts of triangles that are not valid; the
    inside of stems that are cut open takes the bark's color. For everything else see ``bake``.

    Parameters
    ----------
    count
        N >= 1 billboards at most.
    share
        Of the tree's area that the planes must hold, in (0, 1].
    samples
        Triangles on which planes are chosen, sampled by area with the seed ``config.views.seed``; all triangles if there are fewer.
    """
    check_count("samples", samples)
    triangles = tree_triangles(tree)
    areas = _areas(triangles)
    if len(triangles) > samples:
        drawn = np.random.default_rng(config.views.seed).choice(len(triangles), samples, p=areas / areas.sum())
        triangles, areas = triangles[drawn], np.ones(samples)
    slabs = slabs_of(choose_planes(triangles, count, areas=areas, share=share), triangles)
    return bake(tree, slabs, config, fill_cuts=True, folder=folder, on_progress=on_progress)


def choose_planes(triangles: Array, count: int, *, areas: Array | None = None, share: float = 0.95) -> PlaneChoice:
    """Choose at most N >= 1 planes that hold a share of the triangles' area within the smallest epsilon that the bisection finds.

    The triangles' corners are [T, 3, 3] in meters, their weights ``areas`` [T] (by default their areas), and ``share`` is in (0, 1].
    Raises ``InputError`` if there are no triangles, or all have zero area.
    """
    check_count("billboards", count)
    check_range("share", share, 0, 1, open_low=True)
    check_shape("triangles", triangles.shape, (None, 3, 3))
    areas = _areas(triangles) if areas is None else areas
    if not len(triangles) or not areas.sum() > 0:
        fail("triangles", "expected at least one that has an area")
    middle = (triangles.min((0, 1)) + triangles.max((0, 1))) / 2
    space = _PlaneSpace(triangles - middle, areas)
    # Of epsilon's logarithm; the upper end is where one plane through the middle holds everything.
    low, high = math.log(_LEAST * space.radius), math.log(space.radius * (1 + _ROUNDING))
    best = space.choose(math.exp(high), count)
    for _ in range(_BISECTIONS):
        attempt = space.choose(math.exp((low + high) / 2), count)
        if attempt.share >= share - _NOTHING:
            best, high = attempt, (low + high) / 2
        else:
            low = (low + high) / 2
    return PlaneChoice(best.normals, best.distances + best.normals @ middle, best.members, best.epsilon, best.share)


def slabs_of(choice: PlaneChoice, triangles: Array) -> Slabs:
    """The upright rectangle around each plane's triangles, and the slab within epsilon of the plane."""
    rows: list[tuple[Array, Array, Array, Array]] = []
    for normal, distance, members in zip(choice.normals, choice.distances, choice.members, strict=True):
        vertical = np.array([0.0, 1.0, 0.0] if abs(normal[1]) < _LEVEL else [0.0, 0.0, -1.0])
        up = vertical - (vertical @ normal) * normal
        up /= np.linalg.norm(up)
        right = np.cross(up, normal)
        local = triangles[members].reshape(-1, 3) @ np.stack([right, up], -1)
        low, high = local.min(0), local.max(0)
        middle = (low + high) / 2
        rows.append((middle[0] * right + middle[1] * up + distance * normal, right, up, (high - low) / 2))
    depths = torch.tensor([-choice.epsilon, choice.epsilon], dtype=torch.float64).repeat(len(rows), 1)
    centers, rights, ups, halves = (torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))
    return Slabs(centers, rights, ups, halves, depths)


def _areas(triangles: Array) -> Array:
    a, b, c = triangles.transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def _directions(step_degrees: float) -> Array:
    """Directions of a half-sphere at about this angle from each other, on circles of equal polar angle, [K, 3]."""
    rows = [np.array([[0.0, 1.0, 0.0]])]
    circles = round(90 / step_degrees)
    for circle in range(1, circles + 1):
        theta = math.pi / 2 * circle / circles
        around = 2 * math.pi if circle < circles else math.pi  # at the equator a direction and its opposite are the same plane
        n = max(1, round(around * math.sin(theta) / math.radians(step_degrees)))
        phi = np.arange(n) * around / n
        rows.append(np.stack([math.sin(theta) * np.sin(phi), np.full(n, math.cos(theta)), math.sin(theta) * np.cos(phi)], -1))
    return np.concatenate(rows)


class _PlaneSpace:
    """Triangles about the origin, and the density of the planes that they are valid for."""

    def __init__(self, triangles: Array, areas: Array) -> None:
        self.triangles = triangles
        self.areas = areas / areas.sum()
        self.radius = float(np.linalg.norm(triangles, axis=-1).max())
        a, b, c = triangles.transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)
        self.directions = _directions(_STEP)

    def choose(self, epsilon: float, count: int) -> PlaneChoice:
        """The greedy choice of at most ``count`` planes for one epsilon."""
        left = np.ones(len(self.triangles), bool)
        bins = min(_MOST_BINS, max(3, math.ceil(2 * self.radius / epsilon * _BINS)))
        slopes = self._slopes(self.directions, np.flatnonzero(left), epsilon, bins)
        planes: list[tuple[Array, float, NDArray[np.int64]]] = []
        while len(planes) < count and left.any():
            density = slopes.cumsum(-1)
            best = int(density.argmax())
            if density.flat[best] <= _NOTHING:
                break
            k, b = divmod(best, density.shape[1])
            coarse = self.directions[k], self._rho(b, bins)
            normal, distance = self._refined(*coarse, float(density.flat[best]), left, epsilon)
            members = self._valid(normal, distance, left, epsilon)
            if not len(members):
                break
            normal, distance, members = self._fitted(normal, distance, members, left, epsilon)
            planes.append((normal, distance, members))
            slopes -= self._slopes(self.directions, members, epsilon, bins)
            left[members] = False
        normals = np.stack([normal for normal, _, _ in planes]) if planes else np.zeros((0, 3))
        held = float(self.areas[~left].sum())
        return PlaneChoice(normals, np.array([d for _, d, _ in planes]), tuple(m for _, _, m in planes), epsilon, held)

    def _rho(self, index: int, bins: int) -> float:
        return (2 * (index + 0.5) / bins - 1) * self.radius

    def _slopes(self, directions: Array, faces: NDArray[np.int64], epsilon: float, bins: int) -> Array:
        """Differences along rho of the density at the bins' centers, [K, bins + 1], of some faces."""
        slopes = np.zeros((len(directions), bins + 1))
        corners, normals, areas = self.triangles[faces], self.normals[faces], self.areas[faces]
        for start in range(0, len(directions), _TOGETHER):
            some = directions[start : start + _TOGETHER]
            a, b, c = (corners[:, i] @ some.T for i in range(3))  # a reduction over an axis of three is ten times as slow
            least, most = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
            # A face is valid from rho = max - epsilon to rho = min + epsilon.
            first = np.ceil(((most - epsilon) / self.radius + 1) * bins / 2 - 0.5).astype(np.int64).clip(0, bins)
            last = np.floor(((least + epsilon) / self.radius + 1) * bins / 2 - 0.5).astype(np.int64).clip(-1, bins - 1) + 1
            weight = np.where(last > first, areas[:, None] * np.abs(normals @ some.T), 0.0)
            row = np.arange(len(some)) * (bins + 1)
            length = len(some) * (bins + 1)
            starts = np.bincount((first + row).ravel(), weight.ravel(), length)
            ends = np.bincount((np.maximum(last, first) + row).ravel(), weight.ravel(), length)
            slopes[start : start + _TOGETHER] = (starts - ends).reshape(len(some), bins + 1)
        return slopes

    def _refined(self, normal: Array, distance: float, value: float, left: NDArray[np.bool_], epsilon: float) -> tuple[Array, float]:
        """Refine a plane of the coarse plane space by smaller turns and finer bins of rho; ``value`` is its density."""
        reach = epsilon + self.radius * math.radians(_STEP)  # farther faces cannot become valid
        near = np.flatnonzero(left & (np.abs(self.triangles @ normal - distance).max(-1) <= reach))
        bins = min(_MOST_BINS, max(3, math.ceil(2 * self.radius / epsilon * _BINS * 2)))
        step = math.radians(_STEP) / 2
        for _ in range(_HALVINGS):
            around = self._turned(normal, step)
            density = self._slopes(around, near, epsilon, bins).cumsum(-1)
            k, b = divmod(int(density.argmax()), density.shape[1])
            if density[k, b] >= value:
                plateau = np.flatnonzero(density[k] >= density[k, b] * (1 - 1e-9))
                normal, distance, value = around[k], self._rho(int(plateau[len(plateau) // 2]), bins), float(density[k, b])
            step /= 2
        return normal, distance

    @staticmethod
    def _turned(normal: Array, angle: float) -> Array:
        """A direction and eight around it, [9, 3]; the direction itself first."""
        side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        side /= np.linalg.norm(side)
        other = np.cross(normal, side)
        turns = np.arange(8) * math.pi / 4
        around = math.cos(angle) * normal + math.sin(angle) * (np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * other)
        return np.concatenate([normal[None], around])

    def _valid(self, normal: Array, distance: float, left: NDArray[np.bool_], epsilon: float) -> NDArray[np.int64]:
        return np.flatnonzero(left & (np.abs(self.triangles @ normal - distance).max(-1) <= epsilon * (1 + _ROUNDING)))

    def _fitted(
        self, normal: Array, distance: float, members: NDArray[np.int64], left: NDArray[np.bool_], epsilon: float
    ) -> tuple[Array, float, NDArray[np.int64]]:
        """The least-squares plane of a plane's faces, by area, if all of them stay valid; else the plane as it was."""
        corners, weights = self.triangles[members].reshape(-1, 3), np.repeat(self.areas[members], 3)
        if not weights.sum() > 0:
            return normal, distance, members
        mean = (weights[:, None] * corners).sum(0) / weights.sum()
        _, axes = np.linalg.eigh((weights[:, None] * (corners - mean)).T @ (corners - mean))
        fitted: Array = axes[:, 0] * (1.0 if axes[:, 0] @ normal >= 0 else -1.0)
        valid = self._valid(fitted, float(fitted @ mean), left, epsilon)
        return (fitted, float(fitted @ mean), valid) if np.isin(members, valid).all() else (normal, distance, members)
