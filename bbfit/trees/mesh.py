"""The surface of a grown tree: tapered tubes around its stems, flat polygons for its leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.trees.formulas import stem_radius
from bbfit.trees.leaf_shapes import leaf_shape
from bbfit.trees.parts import Material, Part
from bbfit.trees.skeleton import Array, Indices, Skeleton, Stems, cross, dot, unit
from bbfit.trees.species import LEAF_TINT, Species

# By level, at detail 1: rings for each segment of a stem's curve, and corners of a ring.
_RINGS = (8, 4, 3, 3)
_SIDES = (24, 12, 8, 5)
# Rings of the trunk lie closer where it flares: their shares of its length go by this power.
_TRUNK_SPACING = 1.5
# Lower bound on radii as a share of the tree's scale: triangles of fine twigs must not vanish in single precision.
_LEAST_RADIUS = 2e-5


@dataclass(frozen=True)
class _Lines:
    """The polylines along which the tubes of one level run, and on which their children begin."""

    points: Array
    """Points of all polylines, concatenated, [P, 3]."""
    begin: Indices
    """Index of each polyline's first point, [S]."""
    pieces: Indices
    """Segments of each polyline, [S]; it has one point more."""
    low: Array
    """Share of the stem's length at which the polyline begins, [S]."""
    spacing: Array
    """Power by which shares grow along it, [S]."""

    def at(self, stems: Indices, shares: Array) -> Array:
        """Points [K, 3] of K stems at shares [K] of their length."""
        low = self.low[stems]
        place = self.pieces[stems] * np.clip((shares - low) / (1 - low), 0, 1) ** (1 / self.spacing[stems])
        piece = np.minimum(place.astype(np.int64), self.pieces[stems] - 1)
        part = (place - piece)[:, None]
        first = self.begin[stems] + piece
        return (1 - part) * self.points[first] + part * self.points[first + 1]


def count_vertices(skeleton: Skeleton, detail: float) -> int:
    """Number of vertices that ``tree_parts`` returns."""
    total = leaf_vertices(skeleton.species, len(skeleton.leaves.parent))
    for stems in skeleton.levels:
        for node, alike in enumerate(np.bincount(stems.first).tolist()):
            total += stem_vertices(stems.level, stems.resolution - node, alike, detail)
    return total


def stem_vertices(level: int, segments: int, stems: int, detail: float) -> int:
    """Vertices of ``stems`` stems of a level with ``segments`` segments each."""
    return stems * (_pieces(level, segments, detail) * (_sides(level, detail) + 1) + 1)


def leaf_vertices(species: Species, leaves: int) -> int:
    """Vertices of ``leaves`` leaves."""
    return leaves * len(leaf_shape(species.leaf_shape).points)


def tree_parts(skeleton: Skeleton, seed: int, *, detail: float) -> list[Part]:
    """The tree's triangles by material, Y up: bark, then one part for each leaf tone, which ``seed`` chooses.

    ``detail`` is a factor of more than 0 on the rings of a stem and the corners of a ring.
    """
    lines: list[_Lines] = []
    bark = _Bark()
    for stems in skeleton.levels:
        lines.append(_add_tubes(bark, skeleton, stems, lines, detail))
    parts = [bark.part(Material("bark", skeleton.species.bark_color, 0.95, double_sided=False))]
    return parts + _leaf_parts(skeleton, lines[-1], seed)


def y_up(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert vectors [..., 3] from Z up to Y up, as in glTF: (x, y, z) becomes (x, z, -y)."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], -1).astype(np.float32) + np.float32(0)


def _pieces(level: int, segments: int, detail: float) -> int:
    return max(1, round(_RINGS[level] * segments * detail))


def _sides(level: int, detail: float) -> int:
    return max(3, round(_SIDES[level] * detail))


class _Bark:
    """Collects the tubes of all levels."""

    def __init__(self) -> None:
        self.vertices: list[NDArray[np.float32]] = []
        self.normals: list[NDArray[np.float32]] = []
        self.uvs: list[NDArray[np.float32]] = []
        self.faces: list[NDArray[np.int32]] = []
        self.count = 0

    def add(self, vertices: Array, normals: Array, uvs: Array, faces: Indices) -> None:
        """Add S meshes of the same topology: [S, n, 3], [S, n, 3], [S, n, 2], and shared faces [m, 3]."""
        begin = self.count + vertices.shape[1] * np.arange(len(vertices))
        self.vertices.append(y_up(vertices).reshape(-1, 3))
        self.normals.append(y_up(normals).reshape(-1, 3))
        self.uvs.append(uvs.astype(np.float32).reshape(-1, 2))
        self.faces.append((begin[:, None, None] + faces).astype(np.int32).reshape(-1, 3))
        self.count += vertices.shape[0] * vertices.shape[1]

    def part(self, material: Material) -> Part:
        """All tubes as one part."""
        arrays = np.concatenate(self.vertices), np.concatenate(self.normals), np.concatenate(self.uvs), np.concatenate(self.faces)
        return Part(material, *arrays)


def _add_tubes(bark: _Bark, skeleton: Skeleton, stems: Stems, lines: list[_Lines], detail: float) -> _Lines:
    """Add the tubes of one level, each beginning on its parent's polyline; return their polylines."""
    level, first = stems.level, stems.first
    pieces = np.array([_pieces(level, stems.resolution - node, detail) for node in range(stems.resolution)], np.int64)[first]
    begin = np.cumsum(pieces + 1) - (pieces + 1)
    spacing = np.where((first == 0) & (level == 0), _TRUNK_SPACING, 1.0)
    own = _Lines(np.zeros((int((pieces + 1).sum()), 3)), begin, pieces, first / stems.resolution, spacing)
    for node in range(stems.resolution):  # a stem before its clones
        chosen = np.flatnonzero(first == node)
        if len(chosen) == 0:
            continue
        if node > 0:
            foot = own.at(stems.parent[chosen], stems.offset[chosen])
        elif level > 0:
            foot = lines[-1].at(stems.parent[chosen], stems.offset[chosen])
        else:
            foot = stems.nodes[chosen, 0]
        shift = foot - stems.nodes[chosen, node]
        number = int(pieces[chosen[0]])
        low, power = own.low[chosen[0]], spacing[chosen[0]]
        shares = low + (1 - low) * (np.arange(number + 1) / number) ** power
        points, frames = stems.at(np.repeat(chosen, number + 1), np.tile(shares, len(chosen)))
        points = points.reshape(len(chosen), number + 1, 3) + shift[:, None]
        own.points[begin[chosen][:, None] + np.arange(number + 1)] = points
        bark.add(*_tubes(skeleton, stems, chosen, shares, points, frames.reshape(len(chosen), number + 1, 3, 3), _sides(level, detail)))
    return own


def _tubes(
    skeleton: Skeleton, stems: Stems, chosen: Indices, shares: Array, points: Array, frames: Array, sides: int
) -> tuple[Array, Array, Array, Indices]:
    """Tubes around S polylines [S, R + 1, 3]: a ring at each point but the last, which is the tip."""
    species, level = skeleton.species, stems.level
    length, base = stems.length[chosen, None], stems.radius[chosen, None]
    radius = stem_radius(species, level, base, length, shares[None])
    lobes, depth = 0, 0.0
    if level == 0:
        radius = radius * (1 + species.flare * (100 ** np.maximum(1 - 8 * shares, 0) - 1) / 100)  # section 4.4
        lobes, depth = species.lobes, species.lobe_depth
    radius = np.maximum(radius, _LEAST_RADIUS * skeleton.scale)
    radius[:, -1] = 0
    slope = np.gradient(radius, axis=1) / (np.gradient(shares) * length)

    axes = frames[..., 2]
    right = np.empty_like(axes)
    right[:, 0] = frames[:, 0, :, 0]
    for ring in range(1, len(shares)):  # parallel transport, so that the tube does not twist
        right[:, ring] = unit(right[:, ring - 1] - axes[:, ring] * dot(axes[:, ring], right[:, ring - 1]))
    up = cross(axes, right)

    angles = 2 * np.pi * np.arange(sides + 1) / sides
    angles[-1] = 0  # the seam's two sides are the same points
    across, along = np.cos(angles)[:, None], np.sin(angles)[:, None]
    rings = slice(0, len(shares) - 1)
    outwards = across * right[:, rings, None] + along * up[:, rings, None]  # [S, R, sides + 1, 3]
    wave = 1 + depth * np.sin(lobes * angles)
    vertices = points[:, rings, None] + (radius[:, rings, None] * wave)[..., None] * outwards
    if level == 0:
        vertices[..., 2] = np.maximum(vertices[..., 2], 0)  # the foot stays on the ground if the trunk leans
    normals = outwards - slope[:, rings, None, None] * axes[:, rings, None]
    if lobes:
        sideways = across * up[:, rings, None] - along * right[:, rings, None]
        normals = normals - (depth * lobes * np.cos(lobes * angles) / wave)[:, None] * sideways
    count = len(chosen)
    turns = np.broadcast_to(np.arange(sides + 1) / sides, (count, len(shares) - 1, sides + 1))
    around = 2 * np.pi * np.maximum(base, _LEAST_RADIUS * skeleton.scale)
    uvs = np.stack([turns, np.broadcast_to((shares * length / around)[:, rings, None], turns.shape)], -1)
    tips = np.stack([np.full(count, 0.5), (length / around)[:, 0]], -1)
    return (
        np.concatenate([vertices.reshape(count, -1, 3), points[:, -1:]], 1),
        np.concatenate([unit(normals).reshape(count, -1, 3), axes[:, -1:]], 1),
        np.concatenate([uvs.reshape(count, -1, 2), tips[:, None]], 1),
        _tube_faces(len(shares) - 1, sides),
    )


def _tube_faces(rings: int, sides: int) -> Indices:
    """Triangles between rings of ``sides`` + 1 vertices, then of the last ring and the tip."""
    row = sides + 1
    here = np.arange(rings - 1)[:, None] * row + np.arange(sides)
    quads = np.stack([here, here + 1, here + 1 + row, here, here + 1 + row, here + row], -1).reshape(-1, 3)
    last = (rings - 1) * row + np.arange(sides)
    return np.concatenate([quads, np.stack([last, last + 1, np.full(sides, rings * row)], -1)])


def _leaf_parts(skeleton: Skeleton, lines: _Lines, seed: int) -> list[Part]:
    species, leaves = skeleton.species, skeleton.leaves
    tones = np.random.default_rng([seed, species.levels + 1]).integers(0, len(species.leaf_colors), len(leaves.parent))
    shape = leaf_shape(species.leaf_shape)
    outline = (shape.points * leaves.length * [species.leaf_scale_x, 1]).astype(np.float32)
    parts = []
    for tone, color in enumerate(species.leaf_colors):
        chosen = np.flatnonzero(tones == tone)
        feet = y_up(lines.at(leaves.parent[chosen], leaves.offset[chosen]))
        across, normal, along = (y_up(leaves.frames[chosen, :, axis]) for axis in range(3))
        vertices = feet[:, None] + outline[:, :1] * across[:, None] + outline[:, 1:] * along[:, None]
        first = len(outline) * np.arange(len(chosen), dtype=np.int32)
        # Across, along and normal make a left-handed system: turned over, a triangle runs counter-clockwise seen from the normal's side.
        faces = (first[:, None, None] + shape.faces[:, ::-1]).reshape(-1, 3)
        uvs = np.tile(shape.uvs.astype(np.float32), (len(chosen), 1))
        red, green, blue = (min(value * tint, 1.0) for value, tint in zip(color, LEAF_TINT, strict=True))
        material = Material(f"leaf_{tone}", color, 0.6, True, species.leaf_transmission, (red, green, blue))
        parts.append(Part(material, vertices.reshape(-1, 3), normal.repeat(len(outline), 0), uvs, faces))
    return parts
