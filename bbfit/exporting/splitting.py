"""Cards split into pieces, and few nodes of them, that programs draw one after another in the right order from every side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.exporting.hulls import rimmed_alpha, shown_cells, texel_corners
from bbfit.exporting.layers import Layers, misordered_share, node_keys, placements, wrong_shares
from bbfit.exporting.node_joining import joined, settled
from bbfit.exporting.node_order import fit_origins
from bbfit.exporting.visibility import (
    Overlaps,
    VisibilitySamples,
    bounding_sphere,
    check_rig,
    fit_rig,
    overlaps_of,
    sample_visibility,
    visible_faces,
)
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import kept_half
from bbfit.operators.drawing.compositing import TIE

# Share of the pieces that are split before origins are fitted again.
_AT_ONCE = 0.2
# Share of the most pieces up to which each is a node of its own while pieces are split.
_APART = 0.5
# Number of partners whose planes a piece may be split along, and how far it must reach beyond them on both sides, in radii of the tree.
_PARTNERS, _BEYOND = 4, 0.02
# Rows and columns of rays from each camera of the fit.
_ACROSS = 22
# The most pairs of hits that a cut is chosen by.
_PAIRS = 3000


def split(cards: Cards, wrong: float = 1e-3, most: int = 260, nodes: int = 24, *, apart: bool = False) -> Cards:
    """Split cards and distribute the pieces over nodes, such that programs that sort nodes draw all in the right order.

    Programs sort the nodes by the depth or the distance of their origins. A node draws the fronts and backs of its pieces, each culled, in
    one order (``Card.ranks``). ``wrong``, in [0, 1], is the accepted share of the visible picture: the mean of sorting by
    depth and by distance. Splitting also ends at ``most`` >= 1 pieces; cards are never joined, so more cards than this stay as they are.
    There are at most ``nodes`` >= 1 nodes; with ``apart`` each piece is one, for programs that do not cull what is blended. InputError if
    one is out of range. Neighboring pieces of one card share no vertices.

    Two flat convex pieces have an order from every camera if neither passes through the other, so for one pair it is enough to split one
    piece along the other's plane (Fuchs, Kedem and Naylor 1980, "On visible surface generation by a priori tree structures"). One node can
    even have that order for all cameras (:mod:`~bbfit.exporting.layers`), unless the orders of several pieces go in a circle. Then they
    need several nodes, whose origins must serve all cameras (:func:`~bbfit.exporting.node_order.fit_origins`). On the other hand, pieces
    may cross where almost nothing is visible.

    The algorithm therefore splits where the picture is wrong. While there are few pieces, each is a node. It fits the origins, takes the
    pieces with the largest wrong share, and splits those that gain most, along the plane of a partner or across their length. Then it joins
    nodes (:func:`~bbfit.exporting.node_joining.joined`), and splits further within them. It ends when the wrong share is at most ``wrong``,
    both with the cameras of the fit and with others. Fully transparent pieces are dropped.
    """
    check_range("wrong share", wrong, 0, 1)
    check_count("most pieces", most)
    check_count("nodes", nodes)
    rimmed = {card.rectangle: rimmed_alpha(cards, card.rectangle) for card in cards.cards}

    def shows(card: Card) -> bool:
        return len(shown_cells(rimmed[card.rectangle], texel_corners(cards, card), 1e-9)) > 0

    sheets, pairs = _sheets(cards)
    pieces = [card for card in sheets if shows(card)] or sheets[:1]
    whole = cards.with_cards(sheets)
    middle, radius = bounding_sphere(whole)
    fitted, checked = sample_visibility(whole, fit_rig(whole), _ACROSS), sample_visibility(whole, check_rig(whole))
    layers = Layers(np.arange(len(pieces)), np.arange(2 * len(pieces)), _middles(pieces))
    is_joined = False
    while True:
        now, middles = cards.with_cards(pieces), _middles(pieces)
        face = visible_faces(now, fitted)
        found, others = overlaps_of(fitted, face), overlaps_of(checked, visible_faces(now, checked))
        if is_joined:
            layers = settled(found, layers, fitted.cameras, middles, radius)
        else:
            starts = [middles, _on_a_circle(middles, middle), layers.origins]
            between = found.grouped(np.arange(2 * len(pieces)) // 2)
            layers = replace(layers, origins=fit_origins(fitted.cameras, between, middles, starts, radius))
        shares = [misordered_share(each, layers, rig.cameras).mean for each, rig in ((found, fitted), (others, checked))]
        chosen = _cuts(now, fitted, face, layers, found, most) if max(shares) > wrong else {}
        if not apart and not is_joined and (not chosen or len(pieces) > _APART * most):
            layers, is_joined = joined(found, layers, fitted.cameras, nodes), True
        elif not chosen:
            break
        else:
            pieces, layers = _cut(pieces, layers, chosen, TIE * radius, shows, in_nodes=is_joined)
    rank = layers.rank.reshape(-1, 2).tolist()
    made = [
        replace(piece, origin=layers.origins[node], ranks=(front, back))
        for piece, node, (front, back) in zip(pieces, layers.node, rank, strict=True)
    ]
    return cards.with_cards([side for piece in made for side in (_both_sides(piece) if piece.rectangle in pairs else [piece])])


def centered(node: list[Card], radius: float | None = None) -> NDArray[np.float64]:
    """Two points, which no triangle uses and which center the bounds of a node's cards on its origin, [2, 3].

    Programs that sort by the center of the bounds then sort by the origin. They are opposite corners of the smallest such box, or of one
    like it whose half diagonal is ``radius`` meters.
    """
    origin = node[0].origin
    assert origin is not None, "only cards with an origin are centered on it"
    reach = abs(np.concatenate([card.corners for card in node]) - origin).max(0)
    reach *= 1.0 if radius is None else radius / np.linalg.norm(reach)
    return np.stack([origin - reach, origin + reach])


def _sheets(cards: Cards) -> tuple[list[Card], set[int]]:
    """The cards with pairs of a front and a back that show one texture as single cards, and the textures of these pairs."""
    made, pairs = dict[tuple[int, bool], Card](), set[int]()
    for card in cards.cards:
        first = made.get((card.rectangle, True))
        if card.culled and first is not None:
            assert first.normal @ card.normal < 0, "a pair faces both ways"
            made[card.rectangle, True] = replace(first, culled=False)
            pairs.add(card.rectangle)
        else:
            made[card.rectangle, card.culled] = card
    return list(made.values()), pairs


def _both_sides(piece: Card) -> list[Card]:
    """A piece as a pair of a front and a back that show one texture."""
    front, back = piece.ranks
    turned = replace(piece, corners=piece.corners[::-1], uvs=piece.uvs[::-1], normal=-piece.normal)
    return [replace(card, culled=True, ranks=(rank, rank)) for card, rank in ((piece, front), (turned, back))]


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
            made.append(replace(card, corners=kept[:, :3], uvs=kept[:, 3:]))
    return made


def _middles(pieces: list[Card]) -> NDArray[np.float64]:
    return np.stack([piece.corners.mean(0) for piece in pieces])


def _on_a_circle(middles: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points around the upright axis in the pieces' directions, at one height and radius: the right origins for half planes at the axis."""
    outwards = (middles - center) * [1.0, 0.0, 1.0]
    radius = np.linalg.norm(outwards, axis=-1, keepdims=True)
    return center + outwards * (radius.mean() / np.maximum(radius, 1e-3 * radius.max() + 1e-12))


def _between(overlaps: Overlaps, wrong: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """The wrong share of each pair of pieces, [P, P], symmetric."""
    pairs = overlaps.front // 2 * count + overlaps.back // 2
    found = np.bincount(pairs, wrong, count * count).reshape(count, count)
    return found + found.T


def _cuts(
    cards: Cards, samples: VisibilitySamples, face: NDArray[np.int64], layers: Layers, overlaps: Overlaps, most: int
) -> dict[int, NDArray[np.float64]]:
    """The pieces to cut, with the distances of their corners from the cut, [K] each."""
    count, wrong = len(cards.cards), wrong_shares(overlaps, layers, node_keys(samples.cameras, layers)).mean(0)
    between = _between(overlaps, wrong, count)
    room = min(max(1, int(_AT_ONCE * count)), most - count)
    worst = [index for index in np.argsort(-between.sum(1), kind="stable")[: 2 * max(room, 0)].tolist() if between[index].any()]
    gains = [_best_cut(cards, samples, face, layers, index, between[index]) for index in worst]
    chosen = dict[int, NDArray[np.float64]]()
    for _, index, height in sorted(gains, key=lambda gain: (-gain[0], gain[1])):
        # After a split of the partner with which its order is most wrong, a piece may be right as it is.
        if int(between[index].argmax()) not in chosen and len(chosen) < room:
            chosen[index] = height
    return chosen


def _best_cut(
    cards: Cards, samples: VisibilitySamples, face: NDArray[np.int64], layers: Layers, index: int, wrong: NDArray[np.float64]
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
    front, back = face[samples.front], face[samples.back]
    rows = np.flatnonzero(((front // 2 == index) | (back // 2 == index)) & (front >= 0) & (back >= 0))
    every = 1 + len(rows) // _PAIRS
    rows = rows[::every]
    against = Overlaps(samples.camera[rows], front[rows], back[rows], samples.weight[rows] * every)
    points = samples.points[np.where(front[rows] // 2 == index, samples.front[rows], samples.back[rows])]
    at, keys = texel_corners(cards, card), node_keys(samples.cameras, layers)
    best = (-np.inf, index, tried[0])
    for height in tried:
        slope = np.linalg.lstsq(at - at.mean(0), height - height.mean(), rcond=None)[0]
        above = (points - at.mean(0)) @ slope + height.mean() > 0
        left = sum(placements(against.take(part), layers, keys, index)[0].min() for part in (above, ~above) if part.any())
        best = max(best, (float(wrong.sum()) - left, index, height), key=lambda gain: gain[0])
    return best


def _cut(
    pieces: list[Card],
    layers: Layers,
    chosen: dict[int, NDArray[np.float64]],
    slack: float,
    shows: Callable[[Card], bool],
    *,
    in_nodes: bool,
) -> tuple[list[Card], Layers]:
    """The pieces after the cuts, without those that show nothing.

    With ``in_nodes`` both parts stay in the node, otherwise each gets its own.
    """
    parts = [_halves(piece, chosen[index], slack) if index in chosen else [piece] for index, piece in enumerate(pieces)]
    kept = [(part, index) for index, made in enumerate(parts) for part in made if part is pieces[index] or shows(part)]
    owner, made = np.array([index for _, index in kept]), [part for part, _ in kept]
    order = np.argsort(layers.rank.reshape(-1, 2)[owner].ravel(), kind="stable")
    if in_nodes:
        return made, Layers(layers.node[owner], order, layers.origins)
    return made, Layers(np.arange(len(made)), order, layers.origins[owner] + _middles(made) - _middles(pieces)[owner])
