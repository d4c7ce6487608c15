"""Which of a set of cards is in front, where, and the points by which sorting them gives that order from every side.

Programs sort transparent objects from back to front by one number each: three.js by the depth of the center of the object's bounds along
the viewing direction, Babylon.js and Unity by the camera's distance from it. Only the order of layers that overlap on the screen
matters, and for a camera that looks along f, card i in front of card j is drawn right by depth if f . (o_j - o_i) > 0: linear in the
points o, and by distance nearly so.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.hulls import bilinear, rimmed_alpha, texel_corners
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import sides
from bbfit.rendering.compositing import TIE

# A ray's pair of layers that matters less than this is left out.
_FAINT = 1e-4
# Wrong share that an origin's distance from its card's middle is worth, for all cards at one radius of the tree.
_PULL = 1e-2
# Softness of the order that origins are fitted by, in radii of the tree, and the most steps with each.
_SOFTNESS = (0.1, 0.05, 0.02)
_STEPS = 50
# The same for one origin among others that stay, and the most pairs of hits that it is fitted to.
_SOFTNESS_ALONE, _STEPS_ALONE, _PAIRS_ALONE = 0.03, 12, 3000


@dataclass(frozen=True)
class Misordered:
    """How much of the visible picture is drawn in the wrong order."""

    depth: float
    """Share when sorted by depth along the viewing direction, in [0, 1]."""
    distance: float
    """Share when sorted by distance from the camera, in [0, 1]."""

    @property
    def mean(self) -> float:
        """Of both ways to sort."""
        return (self.depth + self.distance) / 2


@dataclass(frozen=True)
class Rig:
    """Cameras around the cards, as far as orders depend on them."""

    eyes: NDArray[np.float64]
    """Positions in meters, [V, 3]."""
    forwards: NDArray[np.float64]
    """Unit viewing directions, [V, 3]."""


@dataclass(frozen=True)
class VisibilitySamples:
    """What the rays of some cameras meet: per ray all layers in their true order, and of those every two."""

    cameras: Rig
    """The cameras."""
    rectangle: NDArray[np.int64]
    """Which texture each hit lies on, [H]."""
    points: NDArray[np.float64]
    """Where on it, in texels, [H, 2]."""
    camera: NDArray[np.int64]
    """Whose ray a pair of hits lies on, [N]."""
    front: NDArray[np.int64]
    """The nearer hit of each pair, [N]."""
    back: NDArray[np.int64]
    """The farther hit of each pair, [N]."""
    weight: NDArray[np.float64]
    """Share of the visible picture in which these two are the first two opaque layers, were alpha the chance of being opaque, [N]. It is
    what the picture gets wrong if they are drawn the other way round; all weights together are at most 1."""


def frame(cards: Cards) -> tuple[NDArray[np.float64], float]:
    """Middle of the cards' bounds, [3], and the distance of the corner farthest from it."""
    corners = np.concatenate([card.corners for card in cards.cards])
    middle = (corners.min(0) + corners.max(0)) / 2
    return middle, float(np.linalg.norm(corners - middle, axis=-1).max())


def rings(cards: Cards, elevations: tuple[float, ...], azimuths: int, distances: tuple[float, ...]) -> Rig:
    """Cameras on rings that look at the cards' middle, ``azimuths`` a ring, elevations in degrees, distances in radii."""
    middle, radius = frame(cards)
    towards = []
    for number, (_, elevation) in enumerate(itertools.product(distances, elevations)):
        azimuth = (np.arange(azimuths) + 0.21 + 0.37 * number) * (2 * np.pi / azimuths)
        across, height = np.cos(np.radians(elevation)), np.sin(np.radians(elevation))
        towards.append(np.stack([across * np.sin(azimuth), np.full(azimuths, height), across * np.cos(azimuth)], -1))
    directions = np.concatenate(towards)
    return Rig(middle + np.repeat(distances, len(directions) // len(distances))[:, None] * radius * directions, -directions)


def fit_rig(cards: Cards, count: int = 420) -> Rig:
    """The cameras that origins are fitted to: from 22 degrees below the horizon to straight above, at 1.5, 2.5 and 6 radii in turn.

    Directions lie on a spiral that turns by the golden angle, so that no two have one height or one azimuth: what is right from regular
    rings is more often wrong between them.
    """
    middle, radius = frame(cards)
    index = np.arange(count) + 0.5
    height = np.sin(np.radians(-22)) + (1 - np.sin(np.radians(-22))) * index / count
    azimuth = index * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - height**2)
    towards = np.stack([across * np.sin(azimuth), height, across * np.cos(azimuth)], -1)
    distance = np.resize([1.5, 2.5, 6.0], count) * radius
    return Rig(middle + distance[:, None] * towards, -towards)


def check_rig(cards: Cards) -> Rig:
    """The cameras that orders are judged by, none of them among those of :func:`fit_rig`."""
    return rings(cards, (-12.0, 8.0, 31.0, 58.0, 82.0), 13, (1.8, 4.0))


def sample_visibility(cards: Cards, cameras: Rig, across: int = 32) -> VisibilitySamples:
    """Send ``across`` x ``across`` rays from every camera over the cards.

    Cards of one texture count as parts of one sheet, as :func:`~bbfit.exporting.cards.cloud_cards` makes it, which a ray meets once.
    Layers whose depths differ by less than :data:`~bbfit.rendering.compositing.TIE` have no order.
    """
    eyes = cameras.eyes
    rays, cell = _rays(np.concatenate([card.corners for card in cards.cards]), cameras, across)
    largest: dict[int, Card] = {}
    for card in sorted(cards.cards, key=_extent):
        largest[card.rectangle] = card
    depth, alpha, points = [], [], []
    for card in largest.values():
        middle = card.corners.mean(0)
        at = texel_corners(cards, card)
        to_texel = np.linalg.pinv(card.corners - middle) @ (at - at.mean(0))
        normal, facing = card.normal, (eyes - middle) @ card.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -facing[:, None] / (rays @ normal)
            where = (((eyes - middle) @ to_texel)[:, None] + t[..., None] * (rays @ to_texel)) + at.mean(0)
        shown = (t > 0) & np.isfinite(t) & (facing > 0 if card.culled else facing != 0)[:, None]
        opacity = np.where(shown, bilinear(rimmed_alpha(cards, card.rectangle), where), 0.0)
        depth.append(np.where(opacity > 0, t, np.inf).astype(np.float32))
        alpha.append(opacity.astype(np.float32))
        points.append(np.where((opacity > 0)[..., None], where, 0.0).astype(np.float32))
    rectangle = np.array(list(largest))
    return _paired(cameras, cell, rectangle, np.stack(depth), np.stack(alpha), np.stack(points))


def _extent(card: Card) -> float:
    return float(np.linalg.norm(np.cross(*(card.corners[1:] - card.corners[0])[[0, -1]])))


def _rays(points: NDArray, cameras: Rig, across: int) -> tuple[NDArray, NDArray]:
    """Directions, one meter deep, through the middles of a grid over the points' picture, [V, R, 3], and a cell's size, [V]."""
    eyes, forwards = cameras.eyes, cameras.forwards
    helper = np.where(abs(forwards[:, 1:2]) < 0.99, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    right = np.cross(forwards, helper)
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
    cell *= (np.linalg.norm(eyes - points.mean(0), axis=-1)) ** 2  # every camera counts the same, however far away
    rays = forwards[:, None, None] + grid[0][:, None, :, None] * right[:, None, None] + grid[1][:, :, None, None] * up[:, None, None]
    return rays.reshape(len(eyes), -1, 3), cell


def _paired(cameras: Rig, cell: NDArray, rectangle: NDArray, depth: NDArray, alpha: NDArray, points: NDArray) -> VisibilitySamples:
    """Sort each ray's layers, given as [S, V, R] (and [S, V, R, 2]) for S sheets and R rays of V cameras, and list the pairs."""
    camera, ray = np.nonzero((alpha > 0).any(0))
    depth, alpha, points, cell = depth[:, camera, ray], alpha[:, camera, ray], points[:, camera, ray], cell[camera]
    order = np.argsort(depth, 0, kind="stable")
    depth, alpha = np.take_along_axis(depth, order, 0), np.take_along_axis(alpha, order, 0)
    through = np.cumprod(1.0 - alpha, 0)
    visible = max(float(((1 - through[-1]) * cell).sum()), 1e-300)
    before = np.concatenate([np.ones_like(through[:1]), through[:-1]])
    found = []
    for i in range(len(depth)):
        light = before[i] * alpha[i]
        for j in range(i + 1, len(depth)):
            weight = light * alpha[j]
            kept = np.flatnonzero((weight > _FAINT) & (depth[j] > depth[i] * (1 + TIE)))
            found.append((np.full(len(kept), i), np.full(len(kept), j), kept, weight[kept] * cell[kept] / visible))
            light = light * (1 - alpha[j])
    empty = (np.zeros(0, np.int64),) * 3 + (np.zeros(0),)
    front, back, ray, weight = (np.concatenate(parts) for parts in zip(empty, *found, strict=True))
    used, index = np.unique(np.stack([front, back]) * len(camera) + ray, return_inverse=True)
    index = index.reshape(2, -1)
    layer, at = np.divmod(used, max(len(camera), 1))
    sheet = order[layer, at]
    return VisibilitySamples(cameras, rectangle[sheet], points[sheet, at], camera[ray], index[0], index[1], weight)


def shown_by(cards: Cards, sight: VisibilitySamples) -> NDArray[np.int64]:
    """Which card shows each hit, [H]; -1 for none. To a thousandth of a texel, as hits are in float32."""
    found = np.full(len(sight.points), -1)
    for rectangle in {card.rectangle for card in cards.cards}:
        at = np.flatnonzero(sight.rectangle == rectangle)
        points = sight.points[at]
        for index, card in enumerate(cards.cards):
            if card.rectangle == rectangle:
                normals, offsets = sides(texel_corners(cards, card))
                found[at[(points @ normals.T <= offsets + 1e-3).all(-1)]] = index
    return found


def keys(cameras: Rig, origins: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What programs sort by: depth and distance of every point from every camera, both [V, P]."""
    depth = cameras.forwards @ origins.T - (cameras.forwards * cameras.eyes).sum(-1, keepdims=True)
    squared = (origins**2).sum(-1) - 2 * cameras.eyes @ origins.T + (cameras.eyes**2).sum(-1, keepdims=True)
    return depth, np.sqrt(np.maximum(squared, 1e-12))


def card_origins(cards: Cards) -> NDArray[np.float64]:
    """The points that the cards are sorted by, where they have none the middles of their bounds, [P, 3]."""
    made = [(card.corners.min(0) + card.corners.max(0)) / 2 if card.origin is None else card.origin for card in cards.cards]
    return np.stack(made)


def misordered(cards: Cards, cameras: Camera | None = None) -> Misordered:
    """How wrong a picture gets whose cards are drawn whole, one after another, from back to front by their origins.

    Every pixel's true order is that of depth along its ray; layers equally deep to a relative 1e-5 count as right either way. Each pair
    of layers drawn in the wrong order counts by the share of the pixel in which these two would be the first two opaque layers, were
    alpha the chance of being opaque: for two layers, the product of their alphas. A card without an origin is sorted by the middle of
    its bounds.

    Parameters
    ----------
    cameras : pinholes whose places and viewing directions are used; their pictures are framed anew around the cards. By default cameras
        on five rings around the cards at 1.8 and 4 radii, none of which origins are fitted to.

    Returns
    -------
    Shares of what all cameras see, each camera's picture taken as large as if all were equally far away.
    """
    if cameras is None:
        rig = check_rig(cards)
    else:
        rig = Rig(*(part.double().cpu().numpy() for part in (cameras.batch().position, cameras.batch().forward)))
    sight = sample_visibility(cards, rig)
    return measure_order(sight, shown_by(cards, sight), card_origins(cards))[0]


def measure_order(
    sight: VisibilitySamples, card: NDArray[np.int64], origins: NDArray[np.float64]
) -> tuple[Misordered, NDArray[np.float64]]:
    """The shares, and per pair of hits what it adds to their mean, [N]; ``card`` says which card shows each hit."""
    front, back = card[sight.front], card[sight.back]
    real = (front >= 0) & (back >= 0)
    wrong = [sight.weight * (real & (key[sight.camera, front] >= key[sight.camera, back])) for key in keys(sight.cameras, origins)]
    return Misordered(float(wrong[0].sum()), float(wrong[1].sum())), (wrong[0] + wrong[1]) / 2


def fit_origins(
    sight: VisibilitySamples, card: NDArray[np.int64], middles: NDArray[np.float64], starts: list[NDArray[np.float64]], scale: float
) -> NDArray[np.float64]:
    """The points by which sorting P cards gives the order that the rays met, by both keys as far as possible, [P, 3].

    From the best start the wrong share is descended (L-BFGS, Byrd et al. 1995) with soft steps in place of right and wrong, which then get
    steeper. Origins are pulled to the cards' middles a little, so that bounds centerd on them stay small. The best point on the way is
    returned.

    Parameters
    ----------
    card : which card shows each hit, as :func:`shown_by` says, [H].
    middles : the cards' middles, [P, 3].
    starts : at least one, [P, 3] each.
    scale : the tree's radius in meters.
    """
    from scipy.optimize import minimize
    from scipy.special import expit

    cameras, count = sight.cameras, len(middles)
    front, back = card[sight.front], card[sight.back]
    real = (front >= 0) & (back >= 0)
    entry = ((sight.camera * count + front) * count + back)[real]
    summed = np.bincount(entry, sight.weight[real], len(cameras.eyes) * count**2)
    used = np.flatnonzero(summed)
    rest, back = np.divmod(used, count)
    camera, front = np.divmod(rest, count)
    weight, front, back = summed[used], camera * count + front, camera * count + back

    def wrong(flat: NDArray[np.float64], softness: float) -> tuple[float, NDArray[np.float64]]:
        origins = flat.reshape(count, 3) * scale
        depth, distance = keys(cameras, origins)
        total, slopes = 0.0, []
        for key in (depth, distance):
            behind = (key.ravel()[front] - key.ravel()[back]) / (softness * scale)  # positive where it is wrong
            chance = expit(behind)
            total += float(weight @ chance) / 2
            slope = weight * chance * (1 - chance) / (2 * softness)
            slopes.append((np.bincount(front, slope, key.size) - np.bincount(back, slope, key.size)).reshape(key.shape))
        by_distance = slopes[1] / distance
        gradient = slopes[0].T @ cameras.forwards + by_distance.sum(0)[:, None] * origins - by_distance.T @ cameras.eyes
        away = flat.reshape(count, 3) - middles / scale
        return total + _PULL * float((away**2).sum()) / count, (gradient + 2 * _PULL / count * away).ravel()

    def exact(origins: NDArray[np.float64]) -> float:
        right = [key.ravel()[front] < key.ravel()[back] for key in keys(cameras, origins)]
        return float(weight @ (2.0 - right[0] - right[1])) / 2 + _PULL * float((((origins - middles) / scale) ** 2).sum()) / count

    origins = best = min(starts, key=exact)
    for softness in _SOFTNESS:
        result = minimize(wrong, (origins / scale).ravel(), (softness,), "L-BFGS-B", jac=True, options={"maxiter": _STEPS, "maxcor": 20})
        origins = result.x.reshape(count, 3) * scale
        best = min(best, origins, key=exact)
    return best


@dataclass(frozen=True)
class Overlaps:
    """What one card overlaps, while all other origins stay."""

    eyes: NDArray[np.float64]
    """Of the camera of each overlap, [N, 3]."""
    forwards: NDArray[np.float64]
    """Its viewing direction, [N, 3]."""
    keys: NDArray[np.float64]
    """Depth and distance of the other card, [2, N]."""
    sign: NDArray[np.float64]
    """1 where the card is in front of the other, else -1, [N]."""
    weight: NDArray[np.float64]
    """As in :class:`Sight`, [N]."""
    points: NDArray[np.float64]
    """Where on the card, in texels, [N, 2]."""


def overlaps(sight: VisibilitySamples, card: NDArray[np.int64], origins: NDArray[np.float64], index: int) -> Overlaps:
    """What the card of that index overlaps, or every few of it if there is much."""
    front, back = card[sight.front], card[sight.back]
    rows = np.flatnonzero(((front == index) & (back >= 0)) | ((back == index) & (front >= 0)))
    every = 1 + len(rows) // _PAIRS_ALONE
    rows = rows[::every]
    ahead, camera = front[rows] == index, sight.camera[rows]
    other = np.where(ahead, back[rows], front[rows])
    return Overlaps(
        sight.cameras.eyes[camera],
        sight.cameras.forwards[camera],
        np.stack([key[camera, other] for key in keys(sight.cameras, origins)]),
        np.where(ahead, 1.0, -1.0),
        sight.weight[rows] * every,
        sight.points[np.where(ahead, sight.front[rows], sight.back[rows])],
    )


def left_wrong(against: Overlaps, part: NDArray[np.bool_], start: NDArray[np.float64], radius: float) -> float:
    """The share that stays wrong if a part of the overlaps belongs to a card of its own, whose origin is fitted from a start, [3]."""
    from scipy.optimize import minimize
    from scipy.special import expit

    eyes, forwards, sign, weight = against.eyes[part], against.forwards[part], against.sign[part], against.weight[part]
    offset = (eyes * forwards).sum(-1)

    def behind(flat: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far each overlap is wrong, by both keys, and the direction in which the distance grows."""
        away = flat * radius - eyes
        distance = np.linalg.norm(away, axis=-1)
        return sign * (np.stack([forwards @ (flat * radius) - offset, distance]) - against.keys[:, part]), away / distance[:, None]

    def wrong(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        far, outwards = behind(flat)
        chance = expit(far / (_SOFTNESS_ALONE * radius))
        slope = sign * weight * chance * (1 - chance) / (2 * _SOFTNESS_ALONE)
        return float((chance @ weight).sum()) / 2, slope[0] @ forwards + slope[1] @ outwards

    found = minimize(wrong, start / radius, method="L-BFGS-B", jac=True, options={"maxiter": _STEPS_ALONE}).x
    return float(((behind(found)[0] >= 0) @ weight).sum()) / 2
