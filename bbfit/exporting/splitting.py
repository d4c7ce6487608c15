"""Cards split into pieces that programs can draw one after another in the right order from every side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.exporting.hulls import rimmed_alpha, shown_cells, texel_corners
from bbfit.exporting.node_order import Overlaps, fit_origins, measure_order, overlaps, remaining_error
from bbfit.exporting.visibility import VisibilitySamples, bounding_sphere, check_rig, fit_rig, sample_visibility, visible_cards
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import kept_half
from bbfit.operators.drawing.compositing import TIE

# Share of the pieces that are split before origins are fitted again.
_AT_ONCE = 0.2
# Number of partners whose planes a piece may be split along, and how far it must reach beyond them on both sides, in radii of the tree.
_PARTNERS, _BEYOND = 4, 0.02


def split(cards: Cards, wrong: float = 1e-3, most: int = 200) -> Cards:
    """Split cards and give each piece an origin, such that sorting the origins by depth or by distance gives the right order.

    ``wrong``, in [0, 1], is the accepted share of the visible picture: the mean of sorting by depth and by distance. Splitting also ends at
    ``most`` >= 1 pieces; cards are never joined, so more cards than this stay as they are. InputError if either is out of range.
    Neighboring pieces of one card share no vertices.

    Two flat convex pieces have an order from every camera if neither passes through the other, so for one pair it is enough to split one
    piece along the other's plane (Fuchs, Kedem and Naylor 1980, "On visible surface generation by a priori tree structures"). But one
    origin per piece must serve all pairs and all cameras (:func:`~bbfit.exporting.node_order.fit_origins`), which needs more splits. On the
    other hand, pieces may cross where almost nothing is visible.

    The algorithm therefore splits where the picture is wrong. It fits the origins, takes the pieces with the largest wrong share, and
    splits those that gain most, along the plane of a partner or across their length. It repeats this until the wrong share is at most
    ``wrong``, both with the cameras of the fit and with others (:func:`~bbfit.exporting.node_order.misordered`). Fully transparent pieces
    are dropped. Four planes through one axis become eight half planes.
    """
    check_range("wrong share", wrong, 0, 1)
    check_count("most pieces", most)
    middle, radius = bounding_sphere(cards)
    rimmed = {card.rectangle: rimmed_alpha(cards, card.rectangle) for card in cards.cards}

    def shows(card: Card) -> bool:
        return len(shown_cells(rimmed[card.rectangle], texel_corners(cards, card), 1e-9)) > 0

    pieces = [card for card in cards.cards if shows(card)] or [cards.cards[0]]
    fitted, checked = sample_visibility(cards, fit_rig(cards)), sample_visibility(cards, check_rig(cards))
    origins = _middles(pieces)
    while True:
        now = cards.with_cards(pieces)
        card, middles = visible_cards(now, fitted), _middles(pieces)
        origins = fit_origins(fitted, card, middles, [middles, _on_a_circle(middles, middle), origins], radius)
        share, each = measure_order(fitted, card, origins)
        unseen = measure_order(checked, visible_cards(now, checked), origins)[0]
        if max(share.mean, unseen.mean) <= wrong or len(pieces) >= most:
            break
        between = _between(fitted, card, each, len(pieces))
        room = min(max(1, int(_AT_ONCE * len(pieces))), most - len(pieces))
        worst = [index for index in np.argsort(-between.sum(1), kind="stable")[: 2 * room].tolist() if between[index].any()]
        gains = [_best_cut(now, index, between[index], overlaps(fitted, card, origins, index), origins[index]) for index in worst]
        chosen = dict[int, NDArray[np.float64]]()
        for _, index, height in sorted(gains, key=lambda gain: (-gain[0], gain[1])):
            # After a split of the partner with which its order is most wrong, a piece may be right as it is.
            if int(between[index].argmax()) not in chosen and len(chosen) < room:
                chosen[index] = height
        if not chosen:
            break
        parts = [_halves(piece, chosen[index], TIE * radius) if index in chosen else [piece] for index, piece in enumerate(pieces)]
        found = [
            (part, origin + part.corners.mean(0) - piece.corners.mean(0))
            for piece, origin, made in zip(pieces, origins, parts, strict=True)
            for part in made
            if part is piece or shows(part)
        ]
        pieces, origins = [part for part, _ in found], np.stack([origin for _, origin in found])
    return cards.with_cards([replace(piece, origin=origin) for piece, origin in zip(pieces, origins, strict=True)])


def centered(card: Card) -> NDArray[np.float64]:
    """A card's corners and two more points, which no triangle uses and which center its bounds on its origin, [K + 2, 3].

    Programs that sort by the center of the bounds then sort by the origin. The two points are opposite corners of the smallest such box.
    """
    assert card.origin is not None, "only cards with an origin are centered on it"
    reach = abs(card.corners - card.origin).max(0)
    return np.concatenate([card.corners, [card.origin - reach, card.origin + reach]])


def _heights(card: Card, other: Card) -> NDArray[np.float64]:
    """Signed distances of a card's corners from the plane of another card in meters, positive in front of it, [K]."""
    return (card.corners - other.corners.mean(0)) @ other.normal


def _halves(card: Card, height: NDArray[np.float64], slack: float) -> list[Card]:
    """A card split where a linear function is zero, given its values at the corners, [K]; corners within ``slack`` lie on the split."""
    height = np.where(abs(height) <= slack, 0.0, height)
    both = np.concatenate([card.corners, card.uvs], -1)
    made = []
    for side in (height, -height):
        if side.min() < 0:
            kept = kept_half(both, side)
            made.append(replace(card, corners=kept[:, :3], uvs=kept[:, 3:], origin=None))
    return made


def _middles(pieces: list[Card]) -> NDArray[np.float64]:
    return np.stack([piece.corners.mean(0) for piece in pieces])


def _on_a_circle(middles: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points around the upright axis in the pieces' directions, at one height and radius: the right origins for half planes at the axis."""
    outwards = (middles - center) * [1.0, 0.0, 1.0]
    radius = np.linalg.norm(outwards, axis=-1, keepdims=True)
    return center + outwards * (radius.mean() / np.maximum(radius, 1e-3 * radius.max() + 1e-12))


def _between(samples: VisibilitySamples, card: NDArray[np.int64], each: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """The wrong share of each pair of pieces, [P, P], symmetric."""
    bad = np.flatnonzero(each)
    pairs = card[samples.front[bad]] * count + card[samples.back[bad]]
    wrong = np.bincount(pairs, each[bad], count * count).reshape(count, count)
    return wrong + wrong.T


def _best_cut(
    cards: Cards, index: int, wrong: NDArray[np.float64], against: Overlaps, origin: NDArray[np.float64]
) -> tuple[float, int, NDArray[np.float64]]:
    """The gain of the best split of a card in wrong share, the card's index, and its corners' distances from the split, [K].

    The candidates are the planes of the cards with which its order is most wrong, and a split across its length.
    """
    card, radius = cards.cards[index], bounding_sphere(cards)[1]
    away = card.corners - card.corners.mean(0)
    tried = [away @ np.linalg.svd(away)[2][0]]
    for partner in np.argsort(-wrong, kind="stable")[:_PARTNERS]:
        height = _heights(card, cards.cards[partner])
        if wrong[partner] > 0 and min(height.max(), -height.min()) > _BEYOND * radius:
            tried.append(height)
    at = texel_corners(cards, card)
    best = (-np.inf, index, tried[0])
    for height in tried:
        slope = np.linalg.lstsq(at - at.mean(0), height - height.mean(), rcond=None)[0]
        above = (against.points - at.mean(0)) @ slope + height.mean() > 0
        left = sum(remaining_error(against, part, origin, radius) for part in (above, ~above) if part.any())
        best = max(best, (float(wrong.sum()) - left, index, height), key=lambda gain: gain[0])
    return best
