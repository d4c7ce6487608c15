"""Grids over patches of a surface: a plane for each patch in a few whole numbers, its cells, and samples of the surface in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bbfit.rivals.surface_patches import scaled_normals

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LEVELS = 3
"""Levels of wavelets. Patches are so far apart on the common sheet that they do not meet on any level."""
# Steps of a half turn and a full turn in which planes are stored; samples along a cell's side; most samples at a time.
_HALF_TURN, _TURN, _DENSITY, _BATCH = 127, 256, 2.0, 1 << 21


@dataclass(frozen=True)
class PatchGrid:
    """The planes of patches and their cells. Everything here is whole numbers, as a file stores them."""

    spacing: float
    """Width of a cell in meters."""
    corners: Integers
    """A corner of each patch's rectangle, in cells from the origin, [P, 3]."""
    turns: Integers
    """Polar angle and azimuth of each patch's normal and the turn about it, [P, 3]."""
    sizes: Integers
    """Rows and columns of cells, [P, 2]."""

    @staticmethod
    def around(triangles: Floats, patches: Integers, spacing: float) -> PatchGrid:
        """Planes through patches, with rectangles along their longest side, for triangles [T, 3, 3] with patches [T]."""
        normals = _by_patch(scaled_normals(triangles), patches)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
        polar = np.rint(np.arccos(normals[:, 2].clip(-1, 1)) / np.pi * _HALF_TURN)
        azimuth = np.rint(np.arctan2(normals[:, 1], normals[:, 0]) / (2 * np.pi) * _TURN) % _TURN
        turns = np.stack([polar, azimuth, np.zeros_like(polar)], -1).astype(np.int64)
        corners, owners = triangles.reshape(-1, 3), np.repeat(patches, 3)
        flat = _local(corners, _axes(turns)[owners])
        apart = flat - (_by_patch(flat, owners) / np.bincount(owners)[:, None])[owners]
        xx, xy, yy = (np.bincount(owners, apart[:, a] * apart[:, b]) for a, b in ((0, 0), (0, 1), (1, 1)))
        turns[:, 2] = np.rint(np.arctan2(2 * xy, xx - yy) / (2 * np.pi) * _TURN) % _TURN  # twice the angle, for half a turn
        axes = _axes(turns)
        flat = _local(corners, axes[owners])
        low = np.stack([_extreme(np.minimum, flat[:, 0], owners), _extreme(np.minimum, flat[:, 1], owners)], -1)
        low -= np.sqrt(0.75) * spacing  # as far as rounding the corner can move it
        height = np.bincount(owners, flat[:, 2]) / np.bincount(owners)
        places = np.einsum("pa,pax->px", np.concatenate([low, height[:, None]], -1), axes)
        rounded = np.rint(places / spacing).astype(np.int64)
        cells = _local(corners - rounded[owners] * spacing, axes[owners]) / spacing
        sizes = np.stack([_extreme(np.maximum, cells[:, axis], owners) for axis in (1, 0)], -1).astype(np.int64) + 1
        return PatchGrid(spacing, rounded, turns, sizes)

    @cached_property
    def axes(self) -> Floats:
        """Right, up and normal of each patch, [P, 3, 3]."""
        return _axes(self.turns)

    @cached_property
    def starts(self) -> Integers:
        """The first cell of each patch among all cells, and the number of all cells, [P + 1]."""
        return np.concatenate([[0], np.cumsum(self.sizes.prod(-1))])

    @cached_property
    def owners(self) -> Integers:
        """The patch of each cell, [C]; a patch's cells are in order of rows."""
        return np.repeat(np.arange(len(self.sizes)), np.diff(self.starts))

    @cached_property
    def places(self) -> Integers:
        """Row and column of each cell in its patch, [C, 2]."""
        local, columns = np.arange(self.starts[-1]) - self.starts[self.owners], self.sizes[self.owners, 1]
        return np.stack([local // columns, local % columns], -1)

    def sheet(self) -> tuple[Integers, tuple[int, int]]:
        """Place each patch on a common sheet, in shelves: the row and column of each cell [C, 2], and the sheet's size."""
        block = 1 << LEVELS
        room = (-(-self.sizes // block) + 1) * block
        width = max(int(room[:, 1].max()), block * int(np.sqrt(room.prod(-1).sum()) / block + 1))
        offsets, top, left, tall = np.zeros_like(room), 0, 0, 0
        for patch in np.argsort(-room[:, 0], kind="stable"):
            if left + room[patch, 1] > width:
                top, left, tall = top + tall, 0, 0
            offsets[patch], left, tall = (top, left), left + room[patch, 1], max(tall, room[patch, 0])
        return offsets[self.owners] + self.places, (top + tall, width)

    def samples(self, triangles: Floats, patches: Integers) -> Iterator[tuple[Integers, Floats, Floats]]:
        """Samples of the surface, at least two along a cell's side: cells [N], heights over the planes in meters [N], areas in m² [N]."""
        edges = triangles - np.roll(triangles, 1, axis=1)
        counts = np.ceil(np.linalg.norm(edges, axis=-1).max(-1) * _DENSITY / self.spacing).clip(1).astype(np.int64)
        areas = np.linalg.norm(scaled_normals(triangles), axis=-1) / 2
        for count in np.unique(counts):
            weights = _subdivided(int(count))
            alike = np.nonzero(counts == count)[0]
            for chosen in np.array_split(alike, len(alike) * len(weights) // _BATCH + 1):
                owner = np.repeat(patches[chosen], len(weights))
                points = (weights @ triangles[chosen]).reshape(-1, 3) - self.corners[owner] * self.spacing
                local = _local(points, self.axes[owner])
                column, row = (np.floor(local[:, axis] / self.spacing).astype(np.int64) for axis in (0, 1))
                yield self.starts[owner] + row * self.sizes[owner, 1] + column, local[:, 2], np.repeat(areas[chosen] / count**2, count**2)


def _axes(turns: Integers) -> Floats:
    """Right, up and normal, [P, 3, 3], of angles in steps, [P, 3]."""
    polar, azimuth, turn = turns[:, 0] * np.pi / _HALF_TURN, turns[:, 1] * 2 * np.pi / _TURN, turns[:, 2] * np.pi / _TURN
    zero = np.zeros_like(polar)
    normal = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    south = np.stack([np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)], -1)
    east = np.stack([-np.sin(azimuth), np.cos(azimuth), zero], -1)
    right = np.cos(turn)[:, None] * south + np.sin(turn)[:, None] * east
    return np.stack([right, np.cross(normal, right), normal], 1)


def _local(points: Floats, axes: Floats) -> Floats:
    return np.einsum("nax,nx->na", axes, points)


def _by_patch(values: Floats, patches: Integers) -> Floats:
    return np.stack([np.bincount(patches, values[:, axis]) for axis in range(values.shape[1])], -1)


def _extreme(function: np.ufunc, values: Floats, patches: Integers) -> Floats:
    order = np.argsort(patches, kind="stable")
    return function.reduceat(values[order], np.searchsorted(patches[order], np.arange(patches.max() + 1)))


def _subdivided(count: int) -> Floats:
    """Barycentric coordinates of the centers of the ``count`` squared triangles that a triangle is cut into, [N, 3]."""
    i, j = (each.ravel() for each in np.meshgrid(np.arange(count), np.arange(count)))
    upright = np.stack([i, j], -1)[i + j < count] + 1 / 3
    inverted = np.stack([i, j], -1)[i + j < count - 1] + 2 / 3
    inner = np.concatenate([upright, inverted]) / count
    return np.concatenate([inner, 1 - inner.sum(-1, keepdims=True)], -1)
