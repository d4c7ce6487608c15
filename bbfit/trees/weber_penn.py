"""The tree model of Weber and Penn ("Creation and Rendering of Realistic Trees", SIGGRAPH 1995), in numpy.

Section numbers are the paper's. All stems of a level grow together, one curve segment after the other, in array operations. Angles of a
species are in degrees, all others in radians.

Choices that the paper leaves open, and additions to it:

- A stem's frame turns from node to node, and the stem is the smooth curve through the nodes with those directions. The turn of a split is
  part of the segment after it, so that a clone leaves its stem without a kink.
- A stem and its clones share the splits that nSegSplits gives; the part of a stem without children has none. In the paper every clone
  splits at the full rate: an acer's 1.5 would multiply its stems by 2.5 in every segment.
- A trunk's clone bears branches as densely as the trunk; any other stem and its clones share the branches that nBranches gives.
- A hanging stem splits like an upright one: declination is counted from the vertical, up or down.
- A trunk leans at most 75 degrees, and stems stop above the ground as they do at the pruning envelope.
- Scale ± ScaleV is the height to which the grown tree is scaled. In the paper it is the length of the trunk, so that the height depends on
  the bend of the trunk and on the topmost branches.
- The trunk's clones are spread evenly around it; clones of other stems turn about the vertical, as in section 4.2.
- Tropism is section 4.8's AttractionUp as a vector: in a segment, a stem turns toward the vector by the vector's length times the angle
  between them over nCurveRes; if the vector points below the horizon, the angle is that from its opposite. Its z part acts
  from the third level on.
- A negative nRotate puts children alternately on the left and right, at that angle from the side to which a positive nCurve bends their
  parent: for a branch, from below.
- nBendV turns a stem sideways, about its y axis, by up to ± nBendV / nCurveRes per segment, as nCurveV does about its x axis.
- LeafBend turns a leaf upwards about its own x axis, as a stalk bends. Section 4.9 turns it about a horizontal axis, which at the usual
  0.6 lays all leaves flat.
- nBranchDist gathers children into whorls of 1 + nBranchDist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.trees.formulas import TAPERED_CYLINDRICAL, in_envelope, shape_ratio, stem_radius
from bbfit.trees.skeleton import Array, Indices, Leaves, Skeleton, Stems, arctan2, cross, dot, rotation, rotation_about
from bbfit.trees.species import Species

Count = Callable[[int, int], None]
"""Called with a level and its number of stems before they are made; the level after the last means the leaves. It may raise to stop."""

# Stems shorter than this share of the tree's scale are left out; the pruning envelope (section 4.6) makes many such stubs.
_LEAST_LENGTH = 2e-3
# Shares of its length that are tried for a stem that must be shortened.
_SHORTENINGS = np.arange(0.95, 0.02, -0.05)
# Lowest height of stems above the ground, as a share of the tree's scale.
_CLEARANCE = 0.03
# How much of the way towards the tropism a stem turns in one segment at most, so that stems which split stay apart.
_MOST_PULL = 0.8
_STEEPEST = np.radians(75)
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class _Buds:
    """Where stems or leaves are about to grow, K of them."""

    parent: Indices
    offset: Array
    points: Array
    frames: Array
    length: Array


def grow_skeleton(species: Species, seed: int, count: Count, *, leaves: float = 1.0) -> Skeleton:
    """Grow a tree; the same seed of at least 0 gives the same tree.

    ``count`` is called before memory for a level's stems, or for the leaves, is allocated. ``leaves`` is section 4.5's quality: the share
    of the leaves that grow, 0 to 1; they are enlarged to keep the total area.
    """
    levels: list[Stems] = []
    for level in range(species.levels):
        random = np.random.default_rng([seed, level])
        if level == 0:
            scale = species.scale + random.uniform(-1, 1) * species.scale_v
            buds = _trunk(species, scale, random)
        else:
            buds = _children(species, levels, random, count)
        stems = _grow(species, level, buds, random, count)
        stems = _pruned(species, scale, stems)
        if level > 0:
            stems = _without_stubs(stems, _LEAST_LENGTH * scale)
        levels.append(replace(stems, radius=_base_radii(species, stems, levels)))
    kept = _leaves(species, levels, leaves, np.random.default_rng([seed, species.levels]), count)
    return _to_height(Skeleton(species, scale, tuple(levels), kept))


def _trunk(species: Species, scale: float, random: np.random.Generator) -> _Buds:
    length = scale * (species.length[0] + random.uniform(-1, 1, 1) * species.length_v[0])
    return _Buds(np.array([-1]), np.zeros(1), np.zeros((1, 3)), rotation("z", random.uniform(0, 2 * np.pi, 1)), length)


def _children(species: Species, levels: list[Stems], random: np.random.Generator, count: Count) -> _Buds:
    """Positions, frames and lengths of the next level's stems (section 4.3)."""
    level, stems = len(levels), levels[-1]
    many = species.branches[level] * np.ones(len(stems))
    if level == 2:
        many *= 0.2 + 0.8 * stems.length / levels[0].length[0] / max(species.length[1], 1e-6)
    elif level > 2:
        many *= 1 - 0.5 * stems.offset[stems.root]
    many = many * _shares(species, stems)
    count(level, round(many.sum()))
    parent, offset, turn = _along(species, stems, _whole(many, random), level, 1 + species.branch_dist[level], random)
    points, frames = _bud_frames(species, stems, parent, offset, turn, level, random)
    share = species.length[level] + random.uniform(-1, 1, len(parent)) * species.length_v[level]
    if level == 1:
        share *= shape_ratio(species.shape, (1 - offset) / (1 - species.base_size[0]), species)
    else:
        share *= 1 - 0.6 * offset
    return _Buds(parent, offset, points, frames, np.maximum(share, 0) * stems.length[parent])


def _leaves(species: Species, levels: list[Stems], share: float, random: np.random.Generator, count: Count) -> Leaves:
    """Positions of the leaves (section 4.5) and their turn toward the light (section 4.9)."""
    stems, level = levels[-1], min(len(levels), 3)
    place = stems.offset[stems.root] if len(levels) > 1 else np.ones(len(stems))
    many = share * abs(species.leaves) * shape_ratio(TAPERED_CYLINDRICAL, place, species) * _shares(species, stems)
    count(len(levels), round(many.sum()))
    parent, offset, turn = _along(species, stems, _whole(many, random), level, 1.0, random)
    if species.leaves < 0:  # a fan at the tip, as wide as the down angle
        fan = np.radians(species.down_angle[level] * (offset - 0.5) + species.down_angle_v[level] * random.uniform(-1, 1, len(offset)))
        offset = np.ones_like(offset)
        points, frames = stems.at(parent, offset)
        frames = frames @ rotation("y", fan)
    else:
        points, frames = _bud_frames(species, stems, parent, offset, turn, level, random)
    if species.leaf_bend:
        frames = _facing_light(frames, points, species.leaf_bend)
    return Leaves(parent, offset, frames, species.leaf_scale / np.sqrt(share or 1.0))


def _facing_light(frames: Array, points: Array, bend: float) -> Array:
    """Leaves turned about the vertical to face outwards, then pitched to face upwards, each by a share of the angle that is missing."""
    normals = frames[:, :, 1]
    around = arctan2(points[:, 1], points[:, 0]) - arctan2(normals[:, 1], normals[:, 0])
    frames = rotation("z", bend * ((around + np.pi) % (2 * np.pi) - np.pi)) @ frames
    return frames @ rotation("x", bend * arctan2(frames[:, 2, 2], frames[:, 2, 1]))


def _shares(species: Species, stems: Stems) -> Array:
    """Share of what a stem would bear if it had no clones, for each of a stem and its clones."""
    base = species.base_size[stems.level]
    own = (1 - np.maximum(base, stems.first / stems.resolution)) / (1 - base)
    return own if stems.level == 0 else own / np.bincount(stems.root, own)[stems.root]


def _along(
    species: Species, stems: Stems, numbers: Indices, level: int, whorl: float, random: np.random.Generator
) -> tuple[Indices, Array, Array]:
    """Parent, offset and turn about the parent of each of ``numbers`` [S] children, which come in whorls (section 4.3)."""
    parent = np.repeat(np.arange(len(stems)), numbers)
    place = np.arange(len(parent)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
    group = np.floor(place / whorl)
    low = np.maximum(species.base_size[stems.level], stems.first / stems.resolution)[parent]
    phase, begin = random.uniform(0, 1, len(stems))[parent], random.uniform(0, 2 * np.pi, len(stems))[parent]
    offset = low + (1 - low) * (group + phase) / np.ceil(numbers[parent] / whorl)

    step = np.radians(species.rotate[level] + random.uniform(-1, 1, len(parent)) * species.rotate_v[level])
    if species.rotate[level] >= 0:
        total = np.cumsum(np.where(np.diff(group, prepend=-1) != 0, step, 0))
        turn = begin + total - total[np.searchsorted(parent, parent)]
    else:  # to the left and the right in turn, counted from the side that the parent curves to
        turn = np.where(group % 2, -1, 1) * step
    member = place - np.ceil(group * whorl)
    members = np.minimum(np.ceil((group + 1) * whorl), numbers[parent]) - np.ceil(group * whorl)
    return parent, offset, turn + 2 * np.pi * member / np.maximum(members, 1)


def _bud_frames(
    species: Species, stems: Stems, parent: Indices, offset: Array, turn: Array, level: int, random: np.random.Generator
) -> tuple[Array, Array]:
    """Points and frames of children: turned about their parents, then away from them by the down angle (section 4.3)."""
    points, frames = stems.at(parent, offset)
    vary = species.down_angle_v[level]
    if vary >= 0:
        down = species.down_angle[level] + random.uniform(-1, 1, len(parent)) * vary
    else:  # from one end of the parent to the other
        height = (1 - offset) / (1 - species.base_size[stems.level])
        down = species.down_angle[level] + vary * (1 - 2 * shape_ratio(0, height, species))
    return points, frames @ rotation("z", turn) @ rotation("x", np.radians(down))


def _whole(values: Array, random: np.random.Generator) -> Indices:
    """Whole numbers in place of ``values``, their running sums within one of the values' (section 4.2's error diffusion)."""
    edges = np.floor(np.concatenate([[0.0], np.cumsum(values)]) + random.uniform())
    return np.diff(edges).astype(np.int64)


def _grow(species: Species, level: int, buds: _Buds, random: np.random.Generator, count: Count) -> Stems:
    """Stems of one level from their buds: curves (section 4.1), splits (4.2), attraction (4.8)."""
    resolution = species.curve_res[level]
    nodes = np.zeros((len(buds.parent), resolution + 1, 3))  # for now in lengths of the stem, from its base
    frames = np.zeros((len(buds.parent), resolution + 1, 3, 3))
    frames[:, 0] = buds.frames
    helix = species.curve_v[level] < 0
    if helix:
        frames[:, 0] = frames[:, 0] @ rotation("x", np.full(len(frames), np.radians(-species.curve_v[level])))
    root = np.arange(len(nodes))  # the bud that a stem or the stem it was split from grew from
    first = np.zeros(len(nodes), np.int64)
    parent, offset = buds.parent, buds.offset
    restoring = np.zeros(len(nodes))  # turn about x of every segment to come, which undoes splits
    curve, back = np.radians([species.curve[level], species.curve_back[level]])

    for segment in range(resolution):
        # Every stem's turn in this segment: spin about z, then pitch about x, then yaw about y; and after all, a turn about the vertical.
        spin, vertical = np.zeros(len(nodes)), np.zeros(len(nodes))
        pitch = restoring.copy()
        copies = _clones(species, level, segment, root, random)
        if copies.any():
            count(level, len(nodes) + int(copies.sum()))
            source = np.repeat(np.arange(len(nodes)), copies)
            member = np.concatenate([np.zeros(len(nodes)), np.arange(len(source)) - np.repeat(np.cumsum(copies) - copies, copies) + 1])
            stem = np.concatenate([np.arange(len(nodes)), source])
            nodes, frames, root, restoring, pitch = nodes[stem], frames[stem], root[stem], restoring[stem], pitch[stem]
            first = np.concatenate([first, np.full(len(source), segment)])
            parent = np.concatenate([parent, source])
            offset = np.concatenate([offset, np.full(len(source), segment / resolution)])
            split = copies[stem]
            axes = np.abs(frames[:, segment, 2])
            declination = np.degrees(arctan2(np.hypot(axes[:, 0], axes[:, 1]), axes[:, 2]))
            angle = species.split_angle[level] + random.uniform(-1, 1, len(stem)) * species.split_angle_v[level]
            angle = np.radians(np.where(split > 0, np.maximum(angle - declination, 0), 0))
            pitch = pitch + angle
            restoring = restoring - angle / max(resolution - segment - 1, 1)
            if level == 0:
                begin = random.uniform(0, 2 * np.pi, len(copies))[stem]
                spin = np.where(split > 0, begin + 2 * np.pi * member / (split + 1), 0)
                vertical = np.zeros(len(stem))
            else:
                spin = np.zeros(len(stem))
                spread = 20 + 0.75 * (30 + (90 - declination)) * random.uniform(0, 1, len(stem)) ** 2
                vertical = np.where(member > 0, np.radians(spread) * random.choice([-1, 1], len(stem)), 0)
        here = frames[:, segment]
        if helix:
            here = rotation_about(buds.frames[root][:, :, 2], np.full(len(nodes), 2 * np.pi / resolution)) @ here
            yaw = np.zeros(len(nodes))
        else:
            pitch += _curvature(curve, back, segment, resolution)
            pitch += np.radians(species.curve_v[level]) / resolution * random.uniform(-1, 1, len(nodes))
            yaw = np.radians(species.bend_v[level]) / resolution * random.uniform(-1, 1, len(nodes))
        turned = rotation("z", vertical) @ here @ rotation("z", spin) @ rotation("x", pitch) @ rotation("y", yaw)
        turned = _attracted(turned, species.tropism if level >= 2 else (*species.tropism[:2], 0.0), resolution)
        if level == 0:
            declination = arctan2(np.hypot(turned[:, 0, 2], turned[:, 1, 2]), turned[:, 2, 2])
            turned = rotation_about(cross(turned[:, :, 2], _UP), np.maximum(declination - _STEEPEST, 0)) @ turned
        frames[:, segment + 1] = turned
        nodes[:, segment + 1] = nodes[:, segment] + _chord(frames[:, segment, :, 2], turned[:, :, 2]) / resolution
    length = buds.length[root]
    nodes = buds.points[root][:, None] + length[:, None, None] * nodes
    return Stems(level, nodes, frames, first, length, np.zeros(len(nodes)), parent, offset, root)


def _curvature(curve: float, back: float, segment: int, resolution: int) -> float:
    """The turn of a segment without its random part: all alike, or ``curve`` over the first half of the stem and ``back`` over the rest."""
    if back == 0:
        return curve / resolution
    half = (resolution + 1) // 2
    return curve / half if segment < half else back / (resolution - half)


def _clones(species: Species, level: int, node: int, root: Indices, random: np.random.Generator) -> Indices:
    """How many clones split from each stem at a node (section 4.2)."""
    if level == 0 and node == 1 and species.base_splits:
        most = species.base_splits
        return np.full(len(root), most if most > 0 else random.integers(0, -most, endpoint=True))
    if node == 0 or node / species.curve_res[level] <= species.base_size[level] or species.seg_splits[level] == 0:
        return np.zeros(len(root), np.int64)
    share = species.seg_splits[level] / np.bincount(root)[root]
    order = random.permutation(len(root))
    copies = np.zeros(len(root), np.int64)
    copies[order] = _whole(share[order], random)
    return copies


def _attracted(frames: Array, tropism: tuple[float, float, float], resolution: int) -> Array:
    """Frames after a segment's pull by the tropism (section 4.8)."""
    strength = float(np.linalg.norm(tropism))
    if strength == 0:
        return frames
    towards = np.array(tropism) / strength
    axis = cross(frames[:, :, 2], towards)
    angle = arctan2(np.sqrt(dot(axis, axis)), dot(frames[:, :, 2], towards))[:, 0]
    pull = angle if towards[2] >= 0 else np.pi - angle
    return rotation_about(axis, np.minimum(strength * pull / resolution, _MOST_PULL * angle)) @ frames


def _chord(begin: Array, end: Array) -> Array:
    """Chord of the circular arc of length one that leaves in one direction and arrives in the other, both [S, 3]."""
    middle = begin + end
    half = 0.5 * np.arccos(np.clip(dot(begin, end), -1, 1))
    length = np.sqrt(dot(middle, middle))
    return np.where(length > 1e-9, np.sinc(half / np.pi) * middle / np.maximum(length, 1e-9), 0)


def _pruned(species: Species, scale: float, stems: Stems) -> Stems:
    """Stems cut back at the pruning envelope and above the ground; a trunk, whose foot is outside, at the envelope's side and top."""
    if species.prune_ratio > 0:
        bole = species.base_size[0] * scale if stems.level == 0 else -1.0
        stems = _shortened(stems, lambda points: in_envelope(species, scale, points) | (points[..., 2] <= bole), species.prune_ratio)
    if stems.level > 0:  # those that begin below the clearance may not sink further
        stems = _shortened(stems, lambda points: points[..., 2] > np.minimum(_CLEARANCE * scale, 0.9 * points[:, :1, 2]), 1.0)
    return stems


def _shortened(stems: Stems, inside: Callable[[Array], NDArray[np.bool_]], ratio: float) -> Stems:
    """Stems shortened until they and their clones lie inside, as section 4.6 does; by a share ``ratio`` of what that takes.

    Those whose foot is outside get a length of 0, but for the trunk.
    """
    share = np.ones(len(stems))
    base = stems.nodes[:, :1]
    outside = np.arange(len(stems))
    for tried in (1.0, *_SHORTENINGS, *([0.0] if stems.level > 0 else [])):
        points = base[outside] + tried * (stems.nodes[outside] - base[outside])
        roots = np.unique(stems.root[outside[~inside(points).all(1)]])
        share[outside] = tried
        outside = np.flatnonzero(np.isin(stems.root, roots))
        if len(outside) == 0:
            break
    share = 1 - ratio * (1 - share)
    return replace(stems, nodes=base + share[:, None, None] * (stems.nodes - base), length=share * stems.length)


def _to_height(skeleton: Skeleton) -> Skeleton:
    """The tree scaled until its highest point, leaves of LeafScale included, is as high as its scale says."""
    leaves, last = skeleton.leaves, skeleton.levels[-1]
    without_leaves = factor = skeleton.scale / max(float(stems.nodes[..., 2].max(initial=0)) for stems in skeleton.levels)
    if len(leaves.parent):
        feet, tips = last.at(leaves.parent, leaves.offset)[0][:, 2], skeleton.species.leaf_scale * leaves.frames[:, 2, 2]
        factor = min(without_leaves, float(((skeleton.scale - tips) / feet).min()))
    factor = max(factor, without_leaves / 2)  # a tree smaller than its leaves
    levels = (
        replace(stems, nodes=factor * stems.nodes, length=factor * stems.length, radius=factor * stems.radius) for stems in skeleton.levels
    )
    return replace(skeleton, levels=tuple(levels))


def _without_stubs(stems: Stems, least: float) -> Stems:
    """Stems without those that are shorter than ``least``."""
    kept = stems.length >= least
    new = np.cumsum(kept) - 1
    parent = np.where(stems.first > 0, new[np.where(stems.first > 0, stems.parent, 0)], stems.parent) if len(stems) else stems.parent
    chosen = {name: getattr(stems, name)[kept] for name in ("nodes", "frames", "first", "length", "radius", "offset")}
    return replace(stems, parent=parent[kept], root=new[stems.root][kept], **chosen)


def _base_radii(species: Species, stems: Stems, levels: list[Stems]) -> Array:
    """Radius of stems at their bases (section 4.4), at most that of the parent there."""
    if not levels:
        return species.radius_mod[0] * species.ratio * stems.length
    parents, parent, offset = levels[-1], stems.parent[stems.root], stems.offset[stems.root]
    radius, length = parents.radius[parent], parents.length[parent]
    wanted = species.radius_mod[stems.level] * radius * (stems.length / length) ** species.ratio_power
    return np.minimum(wanted, stem_radius(species, parents.level, radius, length, offset))
