"""One origin for each card, such that programs that sort by origins draw the cards in the right order from all around.

Programs sort transparent objects from back to front by one number each: three.js by the depth of the center of the object's bounds along
the viewing direction, Babylon.js and Unity by its distance from the camera. For a camera that looks along f, sorting by depth draws card i
in front of card j correctly if f . (o_j - o_i) > 0. This is linear in the origins o; sorting by distance is nearly so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.visibility import Rig, VisibilitySamples, check_rig, sample_visibility, visible_cards
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards

# Penalty on the distance of origins from their cards' centers: the wrong share that all cards at one radius of the tree are worth.
_PULL = 1e-2
# Softness of the order in the fit of origins, in radii of the tree, from step to step, and the most iterations of each step.
_SOFTNESS = (0.1, 0.05, 0.02)
_STEPS = 50
# The same for the fit of one origin while the others stay, and the most pairs of hits that it uses.
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
        """The mean of both."""
        return (self.depth + self.distance) / 2


def sort_keys(cameras: Rig, origins: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The numbers that programs sort by: the depth and the distance of P points from V cameras in meters, both [V, P]."""
    depth = cameras.forwards @ origins.T - (cameras.forwards * cameras.eyes).sum(-1, keepdims=True)
    squared = (origins**2).sum(-1) - 2 * cameras.eyes @ origins.T + (cameras.eyes**2).sum(-1, keepdims=True)
    return depth, np.sqrt(np.maximum(squared, 1e-12))


def card_origins(cards: Cards) -> NDArray[np.float64]:
    """The points that programs sort the cards by, [P, 3]: their origins, or the centers of their bounds where they have none."""
    return np.stack([(card.corners.min(0) + card.corners.max(0)) / 2 if card.origin is None else card.origin for card in cards.cards])


def misordered(cards: Cards, cameras: Camera | None = None) -> Misordered:
    """Measure the error of a picture whose cards are drawn one after another, from back to front by their origins.

    The shares are those of what all cameras see; each camera has the same weight at any distance. Cameras are pinholes, of which only the
    positions and viewing directions are used, because their pictures are framed around the cards; by default they are those of
    :func:`~bbfit.exporting.visibility.check_rig`. A card without an origin is sorted by the center of its bounds.

    The true order of a pixel is that of the depths along its ray; layers whose depths differ by less than a relative 1e-5 are right in
    either order. A pair of layers in the wrong order counts with the share of the pixel in which these two are the first two opaque layers,
    if alpha is the probability of being opaque: for two layers, the product of their alphas.
    """
    if cameras is None:
        rig = check_rig(cards)
    else:
        rig = Rig(*(part.double().cpu().numpy() for part in (cameras.batch().position, cameras.batch().forward)))
    samples = sample_visibility(cards, rig)
    return measure_order(samples, visible_cards(cards, samples), card_origins(cards))[0]


def measure_order(
    samples: VisibilitySamples, card: NDArray[np.int64], origins: NDArray[np.float64]
) -> tuple[Misordered, NDArray[np.float64]]:
    """The wrong shares, and the contribution of each pair of hits to their mean, [N]; ``card`` is the card of each hit, [H]."""
    front, back = card[samples.front], card[samples.back]
    real = (front >= 0) & (back >= 0)
    wrong = [
        samples.weight * (real & (key[samples.camera, front] >= key[samples.camera, back])) for key in sort_keys(samples.cameras, origins)
    ]
    return Misordered(float(wrong[0].sum()), float(wrong[1].sum())), (wrong[0] + wrong[1]) / 2


def fit_origins(
    samples: VisibilitySamples, card: NDArray[np.int64], middles: NDArray[np.float64], starts: list[NDArray[np.float64]], scale: float
) -> NDArray[np.float64]:
    """Fit the origins of P cards, [P, 3], such that sorting by depth and sorting by distance both give the order along the rays.

    ``card`` is the card of each hit, [H] (:func:`~bbfit.exporting.visibility.visible_cards`). ``middles`` holds the centers of the cards,
    and ``starts`` one or more guesses of the origins, [P, 3] each. ``scale`` is the tree's radius. All are in meters.

    L-BFGS (Byrd et al. 1995) minimizes the wrong share from the best of the starts. Sigmoids of decreasing softness replace the step
    between right and wrong. A penalty keeps origins near the centers of their cards, so that bounds centered on them stay small. The best
    of the starts and of the results of each softness is returned.
    """
    from scipy.optimize import minimize
    from scipy.special import expit

    cameras, count = samples.cameras, len(middles)
    front, back = card[samples.front], card[samples.back]
    real = (front >= 0) & (back >= 0)
    entry = ((samples.camera * count + front) * count + back)[real]
    summed = np.bincount(entry, samples.weight[real], len(cameras.eyes) * count**2)
    used = np.flatnonzero(summed)
    rest, back = np.divmod(used, count)
    camera, front = np.divmod(rest, count)
    weight, front, back = summed[used], camera * count + front, camera * count + back

    def wrong(flat: NDArray[np.float64], softness: float) -> tuple[float, NDArray[np.float64]]:
        origins = flat.reshape(count, 3) * scale
        depth, distance = sort_keys(cameras, origins)
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
        right = [key.ravel()[front] < key.ravel()[back] for key in sort_keys(cameras, origins)]
        return float(weight @ (2.0 - right[0] - right[1])) / 2 + _PULL * float((((origins - middles) / scale) ** 2).sum()) / count

    origins = best = min(starts, key=exact)
    for softness in _SOFTNESS:
        result = minimize(wrong, (origins / scale).ravel(), (softness,), "L-BFGS-B", jac=True, options={"maxiter": _STEPS, "maxcor": 20})
        origins = result.x.reshape(count, 3) * scale
        best = min(best, origins, key=exact)
    return best


@dataclass(frozen=True)
class Overlaps:
    """The N overlaps of one card with others, whose origins stay."""

    eyes: NDArray[np.float64]
    """Position of the camera of each overlap in meters, [N, 3]."""
    forwards: NDArray[np.float64]
    """Viewing direction of that camera, [N, 3]."""
    keys: NDArray[np.float64]
    """Depth and distance of the other card, [2, N]."""
    sign: NDArray[np.float64]
    """1 where the card is in front of the other, else -1, [N]."""
    weight: NDArray[np.float64]
    """As in :class:`~bbfit.exporting.visibility.VisibilitySamples`, [N]."""
    points: NDArray[np.float64]
    """Place on the card in texels, [N, 2]."""


def overlaps(samples: VisibilitySamples, card: NDArray[np.int64], origins: NDArray[np.float64], index: int) -> Overlaps:
    """The overlaps of the card with an index; of many overlaps, an even selection."""
    front, back = card[samples.front], card[samples.back]
    rows = np.flatnonzero(((front == index) & (back >= 0)) | ((back == index) & (front >= 0)))
    every = 1 + len(rows) // _PAIRS_ALONE
    rows = rows[::every]
    ahead, camera = front[rows] == index, samples.camera[rows]
    other = np.where(ahead, back[rows], front[rows])
    return Overlaps(
        samples.cameras.eyes[camera],
        samples.cameras.forwards[camera],
        np.stack([key[camera, other] for key in sort_keys(samples.cameras, origins)]),
        np.where(ahead, 1.0, -1.0),
        samples.weight[rows] * every,
        samples.points[np.where(ahead, samples.front[rows], samples.back[rows])],
    )


def remaining_error(against: Overlaps, part: NDArray[np.bool_], start: NDArray[np.float64], radius: float) -> float:
    """The share that stays wrong if a part of the overlaps, bool [N], gets a card of its own, whose origin is fitted from ``start``."""
    from scipy.optimize import minimize
    from scipy.special import expit

    eyes, forwards, sign, weight = against.eyes[part], against.forwards[part], against.sign[part], against.weight[part]
    offset = (eyes * forwards).sum(-1)

    def behind(flat: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The signed error of each overlap by both keys in meters, and the gradient of the distance."""
        away = flat * radius - eyes
        distance = np.linalg.norm(away, axis=-1)
        return sign * (np.stack([forwards @ (flat * radius) - offset, distance]) - against.keys[:, part]), away / distance[:, None]

    def wrong(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        far, outwards = behind(flat)
        chance = expit(far / (_SOFTNESS_ALONE * radius))
        slope = sign * weight * chance * (1 - chance) / (2 * _SOFTNESS_ALONE)
        return float((chance @ weight).sum()) / 2, slope[0] @ forwards + slope[1] @ outwards

    best = minimize(wrong, start / radius, method="L-BFGS-B", jac=True, options={"maxiter": _STEPS_ALONE}).x
    return float(((behind(best)[0] >= 0) @ weight).sum()) / 2
