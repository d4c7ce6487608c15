"""Which cards rays from all around meet, in which order.

For an order of drawing, only the layers that overlap on the screen matter; the samples list them pair by pair.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.hulls import bilinear, rimmed_alpha, texel_corners
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import sides
from bbfit.operators.drawing.compositing import TIE

# Pairs of layers with a smaller weight are left out.
_LEAST_WEIGHT = 1e-4


@dataclass(frozen=True)
class Rig:
    """The positions and viewing directions of V cameras around the cards."""

    eyes: NDArray[np.float64]
    """Positions in meters, [V, 3]."""
    forwards: NDArray[np.float64]
    """Unit viewing directions, [V, 3]."""


@dataclass(frozen=True)
class VisibilitySamples:
    """The H hits of rays on sheets of cards, and the N pairs of hits that lie on one ray."""

    cameras: Rig
    """The cameras that the rays start from."""
    rectangle: NDArray[np.int64]
    """The texture of each hit, [H]."""
    points: NDArray[np.float64]
    """The place of each hit on its texture in texels, [H, 2]."""
    seen_from: NDArray[np.int64]
    """The camera of each hit, [H]."""
    camera: NDArray[np.int64]
    """The camera of each pair, [N]."""
    front: NDArray[np.int64]
    """The nearer hit of each pair, [N]."""
    back: NDArray[np.int64]
    """The farther hit of each pair, [N]."""
    weight: NDArray[np.float64]
    """Share of the visible picture in which these two are the first two opaque layers, if alpha is the probability of being opaque, [N].
    This share is wrong if the two are drawn in the other order; all weights together are at most 1."""


@dataclass(frozen=True)
class Overlaps:
    """N overlaps of two things in the picture of a camera: of two faces, or of two nodes."""

    camera: NDArray[np.int64]
    """Index of the camera, [N]."""
    front: NDArray[np.int64]
    """Index of the thing that is in front, [N]."""
    back: NDArray[np.int64]
    """Index of the thing that is behind it, [N]."""
    weight: NDArray[np.float64]
    """Share of the visible picture that is wrong in the other order, [N] (:class:`~bbfit.exporting.visibility.VisibilitySamples`)."""

    def take(self, rows: NDArray) -> Overlaps:
        """Some of the overlaps."""
        return Overlaps(self.camera[rows], self.front[rows], self.back[rows], self.weight[rows])

    def grouped(self, group: NDArray[np.int64]) -> Overlaps:
        """The overlaps of different groups of things, given the group of each thing; those of one camera and pair add up."""
        front, back, count = group[self.front], group[self.back], int(group.max(initial=0)) + 1
        apart = front != back
        entry, index = np.unique(((self.camera * count + front) * count + back)[apart], return_inverse=True)
        rest, back = np.divmod(entry, count)
        camera, front = np.divmod(rest, count)
        return Overlaps(camera, front, back, np.bincount(index, self.weight[apart], len(entry)).astype(np.float64))


def bounding_sphere(cards: Cards) -> tuple[NDArray[np.float64], float]:
    """The center of the cards' bounding box, [3], and the distance of the farthest corner from it, in meters."""
    corners = np.concatenate([card.corners for card in cards.cards])
    center = (corners.min(0) + corners.max(0)) / 2
    return center, float(np.linalg.norm(corners - center, axis=-1).max())


def fit_rig(cards: Cards, count: int = 1000) -> Rig:
    """The cameras that origins are fitted to: from 22 degrees below the horizon to straight above, at 1.5, 2.5 and 6 radii in turn.

    The directions form a spiral that turns by the golden angle, so no two have the same elevation or azimuth. An order that was fitted to
    regular rings is wrong more often between the rings. It takes this many: with 420, eight planes of an aspen had 0.14 % wrong here and
    0.22 % from elsewhere, with 1000 they had 0.08 % and 0.15 %. A second spiral looks down from within 12 degrees of the zenith, of which
    the first has few: without it 0.5 % of an aspen's pixels and 0.6 % of a willow's were wrong from there.
    """
    center, radius = bounding_sphere(cards)
    lowest, highest = np.sin(np.radians([-22.0, 78.0]))
    towards = np.concatenate([_spiral(lowest, count), _spiral(highest, max(1, count // 12))])
    distance = np.resize([1.5, 2.5, 6.0], len(towards)) * radius
    return Rig(center + distance[:, None] * towards, -towards)


def _spiral(lowest: float, count: int) -> NDArray[np.float64]:
    """Directions that are evenly spread from a sine of the elevation up to the zenith, [count, 3]."""
    index = np.arange(count) + 0.5
    height = lowest + (1 - lowest) * index / count
    azimuth = index * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.sin(azimuth), height, across * np.cos(azimuth)], -1)


def check_rig(cards: Cards) -> Rig:
    """The cameras that orders are measured with: 13 on each of five rings at 1.8 and 4 radii, none of them one of :func:`fit_rig`."""
    center, radius = bounding_sphere(cards)
    azimuths, distances, towards = 13, (1.8, 4.0), []
    for number, (_, elevation) in enumerate(itertools.product(distances, (-12.0, 8.0, 31.0, 58.0, 82.0))):
        azimuth = (np.arange(azimuths) + 0.21 + 0.37 * number) * (2 * np.pi / azimuths)
        across, height = np.cos(np.radians(elevation)), np.sin(np.radians(elevation))
        towards.append(np.stack([across * np.sin(azimuth), np.full(azimuths, height), across * np.cos(azimuth)], -1))
    directions = np.concatenate(towards)
    return Rig(center + np.repeat(distances, len(directions) // len(distances))[:, None] * radius * directions, -directions)


def sample_visibility(cards: Cards, cameras: Rig, across: int = 32) -> VisibilitySamples:
    """Trace a grid of ``across`` x ``across`` rays from every camera over the cards.

    Cards of one texture are parts of one sheet, which a ray meets once; it is seen from both sides if they are. Layers whose depths differ
    by less than a relative :data:`~bbfit.operators.drawing.compositing.TIE` have no order.
    """
    eyes = cameras.eyes
    rays, cell = _rays(np.concatenate([card.corners for card in cards.cards]), cameras, across)
    largest: dict[int, Card] = {}
    for card in sorted(cards.cards, key=_extent):
        largest[card.rectangle] = card
    hits = []
    for number, card in enumerate(largest.values()):
        middle, at = card.corners.mean(0), texel_corners(cards, card)
        to_texel = np.linalg.pinv(card.corners - middle) @ (at - at.mean(0))
        facing, start = (eyes - middle) @ card.normal, (eyes - middle) @ to_texel + at.mean(0)
        along, right, down = np.moveaxis(rays @ np.column_stack([card.normal, to_texel]), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -facing[:, None] / along
            x, y = start[:, :1] + t * right, start[:, 1:] + t * down
        others = [other for other in cards.cards if other.rectangle == card.rectangle]
        from_behind = any(not other.culled or other.normal @ card.normal < 0 for other in others)
        alpha = rimmed_alpha(cards, card.rectangle)
        height, width = alpha.shape
        met = (t > 0) & (x > -1) & (x < width - 2) & (y > -1) & (y < height - 2) & (facing != 0 if from_behind else facing > 0)[:, None]
        points = np.stack([x[met], y[met]], -1)
        opacity = bilinear(alpha, points)
        seen = opacity > 0
        values = (part[seen].astype(np.float32) for part in (t[met], opacity, points))
        hits.append((np.full(int(seen.sum()), number), np.flatnonzero(met)[seen], *values))
    sheet, ray, depth, alpha, points = (np.concatenate(parts) for parts in zip(*hits, strict=True))
    return _paired(cameras, cell, across, np.array(list(largest))[sheet], points, ray, depth, alpha)


def _extent(card: Card) -> float:
    return float(np.linalg.norm(np.cross(*(card.corners[1:] - card.corners[0])[[0, -1]])))


def _rays(points: NDArray, cameras: Rig, across: int) -> tuple[NDArray, NDArray]:
    """Ray directions of unit depth through the cells of a grid over the points' picture, [V, R, 3], and the area of a cell, [V]."""
    eyes, forwards = cameras.eyes, cameras.forwards
    reference = np.where(abs(forwards[:, 1:2]) < 0.99, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    right = np.cross(forwards, reference)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(right, forwards)
    relative = points - eyes[:, None]
    depth = np.einsum("vpi,vi->vp", relative, forwards)
    depth = np.maximum(depth, 1e-2 * np.linalg.norm(relative, axis=-1))
    grid, cell = [], np.ones(len(eyes))
    steps = (np.arange(across) + 0.5) / across
    for axis in (right, up):
        place = np.einsum("vpi,vi->vp", relative, axis) / depth
        low, high = place.min(1), place.max(1)
        grid.append(low[:, None] + (high - low)[:, None] * steps)
        cell *= (high - low) / across
    cell *= (np.linalg.norm(eyes - points.mean(0), axis=-1)) ** 2  # each camera has the same weight at any distance
    rays = forwards[:, None, None] + grid[0][:, None, :, None] * right[:, None, None] + grid[1][:, :, None, None] * up[:, None, None]
    return rays.reshape(len(eyes), -1, 3), cell


def _paired(
    cameras: Rig, cell: NDArray, across: int, rectangle: NDArray, points: NDArray, ray: NDArray, depth: NDArray, alpha: NDArray
) -> VisibilitySamples:
    """Sort the hits of each ray into layers, and list the pairs.

    Rays are numbered from camera to camera. Hits have a texture [H], a place [H, 2], a ray, a depth and an opacity [H]. Those of one depth
    keep their order.
    """
    order = np.lexsort((depth, ray))
    rays, first, column = np.unique(ray[order], return_index=True, return_inverse=True)
    layer = np.arange(len(order)) - first[column]
    most = int(layer.max(initial=0)) + 1

    def layered(values: NDArray) -> NDArray:
        made = np.zeros((most, len(rays)), values.dtype)
        made[layer, column] = values[order]
        return made

    hit, depth, alpha, camera = layered(np.arange(len(ray))), layered(depth), layered(alpha), rays // across**2
    cell = cell[camera]
    through = np.cumprod(1.0 - alpha, 0)
    visible = max(float(((1 - through[-1]) * cell).sum()), 1e-300)
    before = np.concatenate([np.ones_like(through[:1]), through[:-1]])
    pairs = []
    for i in range(len(depth)):
        light = before[i] * alpha[i]
        for j in range(i + 1, len(depth)):
            weight = light * alpha[j]
            kept = np.flatnonzero((weight > _LEAST_WEIGHT) & (depth[j] > depth[i] * (1 + TIE)))
            pairs.append((np.full(len(kept), i), np.full(len(kept), j), kept, weight[kept] * cell[kept] / visible))
            light = light * (1 - alpha[j])
    empty = (np.zeros(0, np.int64),) * 3 + (np.zeros(0),)
    front, back, ray, weight = (np.concatenate(parts) for parts in zip(empty, *pairs, strict=True))
    used, index = np.unique(np.stack([front, back]) * len(camera) + ray, return_inverse=True)
    index = index.reshape(2, -1)
    layer, at = np.divmod(used, max(len(camera), 1))
    seen = hit[layer, at]
    return VisibilitySamples(cameras, rectangle[seen], points[seen], camera[at], camera[ray], index[0], index[1], weight)


def visible_cards(cards: Cards, samples: VisibilitySamples) -> NDArray[np.int64]:
    """The index of the card that each hit lies on, [H]; -1 for none. Accurate to a thousandth of a texel, as hits are float32."""
    owners = np.full(len(samples.points), -1)
    for rectangle in {card.rectangle for card in cards.cards}:
        at = np.flatnonzero(samples.rectangle == rectangle)
        points, eyes = samples.points[at], samples.cameras.eyes[samples.seen_from[at]]
        for index, card in enumerate(cards.cards):
            if card.rectangle == rectangle:
                normals, offsets = sides(texel_corners(cards, card))
                inside = (points @ normals.T <= offsets + 1e-3).all(-1)
                owners[at[inside & (not card.culled or is_ahead(card, eyes))]] = index
    return owners


def visible_faces(cards: Cards, samples: VisibilitySamples) -> NDArray[np.int64]:
    """The face that each hit lies on, [H]: 2 i is the front of card i, 2 i + 1 its back; -1 for none."""
    owners = visible_cards(cards, samples)
    faces = np.where(owners < 0, -1, 2 * owners)
    for index, card in enumerate(cards.cards):
        at = np.flatnonzero(owners == index)
        faces[at] += ~is_ahead(card, samples.cameras.eyes[samples.seen_from[at]])
    return faces


def overlaps_of(samples: VisibilitySamples, thing: NDArray[np.int64]) -> Overlaps:
    """The overlaps of different things, given the thing that each hit lies on, [H], -1 for none; those of one camera and pair add up."""
    real = (thing[samples.front] >= 0) & (thing[samples.back] >= 0)
    hits = Overlaps(samples.camera[real], samples.front[real], samples.back[real], samples.weight[real])
    return hits.grouped(thing)


def is_ahead(card: Card, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points, [N, 3], lie on the side of a card's plane that its normal points to, [N]."""
    return (points - card.corners.mean(0)) @ card.normal > 0
