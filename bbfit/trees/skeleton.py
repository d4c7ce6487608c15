"""The skeleton of a grown tree: stems as curves, leaves as frames.

Z is up and lengths are in meters. An array of frames [..., 3, 3] holds local axes in its columns; the third axis runs along the stem or
leaf. The skeleton does not depend on the detail of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bbfit.trees.species import Species

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Stems:
    """The S stems of one level; clones follow the stems that they split from."""

    level: int
    """0 for the trunk."""
    nodes: Array
    """Ends of the curve's segments, [S, nCurveRes + 1, 3]. Before its first node, a clone has those of the stem that it split from."""
    frames: Array
    """Local axes at the nodes, [S, nCurveRes + 1, 3, 3]."""
    first: Indices
    """The node at which a stem begins, [S]; 0 except for clones."""
    length: Array
    """Meters from node 0 to the tip, [S]."""
    radius: Array
    """Radius at node 0 without flare and lobes, meters, [S]."""
    parent: Indices
    """The stem from which it grows, [S]: a stem of the previous level, or of its own level for a clone; -1 for the trunk."""
    offset: Array
    """Position on that stem as a share of its length, [S]."""
    root: Indices
    """The stem from which a chain of clones split, [S]; the stem itself if it is not a clone."""

    def __len__(self) -> int:
        return len(self.length)

    @property
    def resolution(self) -> int:
        """Segments of the curve: nCurveRes."""
        return self.nodes.shape[1] - 1

    def at(self, stems: Indices, shares: Array) -> tuple[Array, Array]:
        """Points [K, 3] and frames [K, 3, 3] of K stems at shares [K] of their length."""
        last = self.resolution - 1
        segment = np.clip((shares * self.resolution).astype(np.int64), 0, last)
        u = (shares * self.resolution - segment)[:, None]
        begin, end = self.nodes[stems, segment], self.nodes[stems, segment + 1]
        step = (self.length[stems] / self.resolution)[:, None]
        out, into = self.frames[stems, segment, :, 2] * step, self.frames[stems, segment + 1, :, 2] * step
        # The cubic Hermite curve and its derivative.
        points = (2 * u**3 - 3 * u**2 + 1) * begin + (u**3 - 2 * u**2 + u) * out + (3 * u**2 - 2 * u**3) * end + (u**3 - u**2) * into
        slopes = (6 * u**2 - 6 * u) * (begin - end) + (3 * u**2 - 4 * u + 1) * out + (3 * u**2 - 2 * u) * into
        z = unit(slopes)
        x = self.frames[stems, segment + 1, :, 0]
        x = unit(x - z * dot(x, z))
        return points, np.stack([x, cross(z, x), z], -1)


@dataclass(frozen=True)
class Leaves:
    """The L leaves, which grow on the stems of the last level."""

    parent: Indices
    """The stem, [L]."""
    offset: Array
    """Position on the stem as a share of its length, [L]."""
    frames: Array
    """Local axes, [L, 3, 3]: across the blade, normal of the upper side, from the stalk to the tip."""
    length: float
    """From stalk to tip, meters."""


@dataclass(frozen=True)
class Skeleton:
    """A grown tree without a surface."""

    species: Species
    scale: float
    """The tree's own Scale ± ScaleV, meters (section 4.3)."""
    levels: tuple[Stems, ...]
    """Trunk, branches, twigs: as many as the species has Levels."""
    leaves: Leaves
    """What grows on the last of them."""


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis, which is kept, [..., 1]."""
    return (a * b).sum(-1, keepdims=True)


def unit(vectors: Array) -> Array:
    """Vectors scaled to length one, [..., 3]."""
    return vectors / np.sqrt(dot(vectors, vectors))


def cross(a: Array, b: Array) -> Array:
    """Vector product of [..., 3] and [..., 3]; several times as fast as numpy's."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def arctan2(y: Array, x: Array) -> Array:
    """Angles of (x, y), the same to the bit wherever the arrays lie in memory: numpy takes another routine for some strided ones."""
    return np.arctan2(np.ascontiguousarray(y), np.ascontiguousarray(x))


def rotation(name: Literal["x", "y", "z"], angles: Array) -> Array:
    """Rotations about a coordinate axis, [K, 3, 3], by K angles in radians."""
    axis = "xyz".index(name)
    after, last = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((len(angles), 3, 3))
    matrices[:, axis, axis] = 1
    matrices[:, after, after] = matrices[:, last, last] = np.cos(angles)
    matrices[:, last, after] = np.sin(angles)
    matrices[:, after, last] = -matrices[:, last, after]
    return matrices


def rotation_about(axes: Array, angles: Array) -> Array:
    """Rotations [K, 3, 3] about K axes [K, 3] of any length (Rodrigues' formula); about an axis of no length, no rotation."""
    length = np.sqrt(dot(axes, axes))
    axes = axes / np.where(length > 1e-12, length, 1)
    sine, rest = np.where(length > 1e-12, np.sin(angles)[:, None], 0), np.where(length > 1e-12, 1 - np.cos(angles)[:, None], 0)
    matrices = rest[..., None] * axes[:, :, None] * axes[:, None, :]
    matrices += np.where(length > 1e-12, np.cos(angles)[:, None], 1)[..., None] * np.eye(3)
    for one, two, three in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[:, two, one] += sine[:, 0] * axes[:, three]
        matrices[:, one, two] -= sine[:, 0] * axes[:, three]
    return matrices
