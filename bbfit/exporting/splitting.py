"""Cards cut into pieces that can be drawn whole, one after another, in the right order from every side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.exporting.hulls import rimmed_alpha, shown_cells, texel_corners
from bbfit.exporting.node_order import (
    Overlaps,
    VisibilitySamples,
    check_rig,
    fit_origins,
    fit_rig,
    frame,
    left_wrong,
    measure_order,
    overlaps,
    sample_visibility,
    shown_by,
)
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import kept_half
from bbfit.rendering.compositing import TIE

# Share of the pieces that are cut before origins are fitted again.
_AT_ONCE = 0.2
# A piece may be cut along the planes of so many partners, if it reaches this far beyond them on both sides, in radii of the tree.
_PARTNERS, _BEYOND = 4, 0.02


def split(cards: Cards, wrong: float = 1e-3, most: int = 200) -> Cards:
    """Cut cards and give every piece an origin, so that sorting by depth or distance of the origins draws them in the right order.

    Two flat convex pieces have an order from every camera once neither passes through the other, so for a pair it is enough to cut one of
    them along the other's plane (Fuchs, Kedem and Naylor 1980, "On visible surface generation by a priori tree structures"). But one
    origin each must then do for all pairs and all cameras (:func:`~bbfit.exporting.node_order.fit_origins`), which asks for more cuts,
    and crossings where next to nothing shows ask for none: such pieces may still cross. So cuts are made where the picture is wrong.
    Origins are fitted; of the pieces that most of the wrong order belongs to, those are cut that it helps most, along the plane of a
    partner or across their length; and so on until ``wrong`` is kept, by the cameras that origins are fitted to and by others
    (:func:`~bbfit.exporting.node_order.misordered`). Pieces that are wholly transparent are dropped.

    Four planes through one axis become eight half planes.

    Parameters
    ----------
    wrong : share of the visible picture, in [0, 1], mean of sorting by depth and by distance.
    most : pieces at which cutting ends, at least 1; cards are never joined, so there may be more if there were more.

    Returns
    -------
    The pieces, each with an origin. Pieces of one card that lie next to each other share no vertices.

    Raises
    ------
    InputError
        if an argument is out of range.
    """
    check_range("wrong share", wrong, 0, 1)
    check_count("most pieces", most)
    middle, radius = frame(cards)
    rimmed = {card.rectangle: rimmed_alpha(cards, card.rectangle) for card in cards.cards}

    def shows(card: Card) -> bool:
        return len(shown_cells(rimmed[card.rectangle], texel_corners(cards, card), 1e-9)) > 0

    pieces = [card for card in cards.cards if shows(card)] or [cards.cards[0]]
    fitted, checked = sample_visibility(cards, fit_rig(cards)), sample_visibility(cards, check_rig(cards))
    origins = _middles(pieces)
    while True:
        now = cards.with_cards(pieces)
        card, middles = shown_by(now, fitted), _middles(pieces)
        origins = fit_origins(fitted, card, middles, [middles, _on_a_circle(middles, middle), origins], radius)
        share, each = measure_order(fitted, card, origins)
        unseen = measure_order(checked, shown_by(now, checked), origins)[0]
        if max(share.mean, unseen.mean) <= wrong or len(pieces) >= most:
            break
        between = _between(fitted, card, each, len(pieces))
        room = min(max(1, int(_AT_ONCE * len(pieces))), most - len(pieces))
        worst = [index for index in np.argsort(-between.sum(1), kind="stable")[: 2 * room].tolist() if between[index].any()]
        gains = [_best_cut(now, index, between[index], overlaps(fitted, card, origins, index), origins[index]) for index in worst]
        chosen = dict[int, NDArray[np.float64]]()
        for _, index, height in sorted(gains, key=lambda gain: (-gain[0], gain[1])):
            # Once the partner that it is most wrong with is cut, a piece may be right as it is.
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


def centerd(card: Card) -> NDArray[np.float64]:
    """A card's corners and two points more, for no triangle to use, that center its bounds on its origin, [K + 2, 3].

    Programs that sort by the center of the bounds then sort by the origin. The two are opposite corners of the smallest such box.
    """
    assert card.origin is not None, "only cards with an origin are centerd on it"
    reach = abs(card.corners - card.origin).max(0)
    return np.concatenate([card.corners, [card.origin - reach, card.origin + reach]])


def _heights(card: Card, other: Card) -> NDArray[np.float64]:
    """How far a card's corners lie in front of another's plane, in meters, [K]."""
    return (card.corners - other.corners.mean(0)) @ other.normal


def _halves(card: Card, height: NDArray[np.float64], slack: float) -> list[Card]:
    """A card cut where a height is zero, which is linear in space and given at its corners; those within ``slack`` are on the cut."""
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
    """The pieces' directions from the upright axis, all at one height and radius, which is right for half planes that end at the axis."""
    outwards = (middles - center) * [1.0, 0.0, 1.0]
    radius = np.linalg.norm(outwards, axis=-1, keepdims=True)
    return center + outwards * (radius.mean() / np.maximum(radius, 1e-3 * radius.max() + 1e-12))


def _between(sight: VisibilitySamples, card: NDArray[np.int64], each: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """How much of the wrong order lies between every two pieces, [P, P], symmetric."""
    bad = np.flatnonzero(each)
    pairs = card[sight.front[bad]] * count + card[sight.back[bad]]
    found = np.bincount(pairs, each[bad], count * count).reshape(count, count)
    return found + found.T


def _best_cut(
    cards: Cards, index: int, wrong: NDArray[np.float64], against: Overlaps, origin: NDArray[np.float64]
) -> tuple[float, int, NDArray[np.float64]]:
    """How much of the wrong share goes if a card is cut where that helps most, its index, and its corners' heights over the cut.

    Tried are the planes of the cards that it is most wrong with and a cut across its length.
    """
    card, radius = cards.cards[index], frame(cards)[1]
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
        left = sum(left_wrong(against, part, origin, radius) for part in (above, ~above) if part.any())
        best = max(best, (float(wrong.sum()) - left, index, height), key=lambda gain: gain[0])
    return best
