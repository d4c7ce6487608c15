"""Which node draws which card, and in which order a node draws the fronts and the backs of its cards.

A node draws its triangles in the order of its indices, from every side. Is there one order that is right from all sides? Often there is,
because fronts and backs are separate triangles, of which a camera sees one: a card that lies in front of another's plane comes after that
card's front and before its back. Programs sort the nodes. So only cards whose order goes in circles need different nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.node_order import sort_keys
from bbfit.exporting.visibility import Overlaps, Rig, check_rig, overlaps_of, sample_visibility, visible_faces
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards

# The most rounds in which each face moves to its best place.
_ROUNDS = 8
# Gains below this share of the picture do not count.
_NOTHING = 1e-9


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


@dataclass(frozen=True)
class Layers:
    """An order of drawing of P cards in K nodes. Face 2 i is the front of card i, and face 2 i + 1 its back."""

    node: NDArray[np.int64]
    """The node of each card, [P]."""
    order: NDArray[np.int64]
    """All faces from the first that is drawn to the last, [2 P]; it holds among the faces of one node."""
    origins: NDArray[np.float64]
    """The points that nodes are sorted by in meters, [K, 3]."""

    @property
    def rank(self) -> NDArray[np.int64]:
        """The place of each face in the order, [2 P]."""
        return np.argsort(self.order)


def wrong_shares(overlaps: Overlaps, layers: Layers, keys: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share that each overlap draws in the wrong order, sorted by either key, [2, N]; ``keys`` are those of the nodes, [2, V, K]."""
    front, back = layers.node[overlaps.front // 2], layers.node[overlaps.back // 2]
    rank = layers.rank
    inside = rank[overlaps.front] < rank[overlaps.back]
    sorted_wrong = keys[:, overlaps.camera, front] >= keys[:, overlaps.camera, back]
    return overlaps.weight * np.where(front == back, inside, sorted_wrong)


def drawing_order(weight: NDArray[np.float64]) -> NDArray[np.int64]:
    """An order of F faces, [F], with little in the wrong order; ``weight`` [F, F] is the share with the first in front of the second.

    The algorithm of Eades, Lin and Smyth (1993, "A fast and effective heuristic for the feedback arc set problem"), which finds an order
    without error if there is one.
    """
    ahead = np.maximum(weight - weight.T, 0)
    leaving, entering = ahead.sum(1), ahead.sum(0)
    left, first, last = np.ones(len(weight), bool), list[int](), list[int]()
    for _ in range(len(weight)):
        at = np.flatnonzero(left)
        lowest, highest = at[leaving[at].argmin()], at[entering[at].argmin()]
        if leaving[lowest] > _NOTHING and entering[highest] <= _NOTHING:
            chosen = int(highest)
            last.append(chosen)
        else:
            chosen = int(lowest if leaving[lowest] <= _NOTHING else at[(entering[at] - leaving[at]).argmax()])
            first.append(chosen)
        left[chosen] = False
        leaving, entering = leaving - ahead[:, chosen], entering - ahead[chosen]
    return np.array(first + last[::-1], np.int64)


def order_cost(weight: NDArray[np.float64], order: NDArray[np.int64]) -> float:
    """The share that an order of faces, [F], draws wrong."""
    rank = np.argsort(order)
    return float(weight[rank[:, None] < rank].sum())


def face_weights(overlaps: Overlaps, count: int) -> NDArray[np.float64]:
    """The share in which each of ``count`` faces is in front of each other, [F, F]."""
    return np.bincount(overlaps.front * count + overlaps.back, overlaps.weight, count**2).reshape(count, count).astype(np.float64)


def _shifted(weight: NDArray[np.float64], order: NDArray[np.int64]) -> NDArray[np.int64]:
    """The order after each face has moved to its best place, in rounds."""
    for _ in range(_ROUNDS):
        gained = 0.0
        for face in order.copy():
            place = int(np.flatnonzero(order == face)[0])
            rest = np.delete(order, place)
            cost = np.concatenate([[0.0], np.cumsum(weight[rest, face] - weight[face, rest])])
            best = int(cost.argmin())
            if cost[best] < cost[place] - _NOTHING:
                gained += cost[place] - cost[best]
                order = np.insert(rest, best, face)
        if gained <= _NOTHING:
            break
    return order


def reordered(overlaps: Overlaps, layers: Layers) -> Layers:
    """The same nodes with a better order of the faces in each."""
    together = layers.node[overlaps.front // 2] == layers.node[overlaps.back // 2]
    weight = face_weights(overlaps.take(together), len(layers.order))
    tried = [_shifted(weight, order) for order in (layers.order, drawing_order(weight))]
    return replace(layers, order=min(tried, key=lambda order: order_cost(weight, order)))


def placements(overlaps: Overlaps, layers: Layers, keys: NDArray[np.float64], card: int) -> tuple[NDArray, NDArray]:
    """What is wrong if a card lies in each node, [K], and the places of its front and back in the order without it, [K, 2].

    All of the overlaps are the card's.
    """
    ahead = overlaps.front // 2 == card
    own, other = np.where(ahead, overlaps.front, overlaps.back), np.where(ahead, overlaps.back, overlaps.front)
    node, count = layers.node[other // 2], len(layers.order)
    key, partner = keys[:, overlaps.camera], keys[:, overlaps.camera, node][..., None]
    wrong = np.where(ahead[:, None], key >= partner, key <= partner).mean(0)
    kinds = np.arange(keys.shape[-1])
    cost = (overlaps.weight[:, None] * wrong * (node[:, None] != kinds)).sum(0)
    rest = layers.order[layers.order // 2 != card]
    among = layers.node[rest // 2] == kinds[:, None]
    places = []
    for side in (2 * card, 2 * card + 1):
        mine = own == side
        before = np.bincount(other[mine & ~ahead], overlaps.weight[mine & ~ahead], count)[rest]  # wrong if the other is drawn first
        after = np.bincount(other[mine & ahead], overlaps.weight[mine & ahead], count)[rest]
        steps = np.cumsum(np.where(among, before - after, 0.0), 1)
        steps = np.concatenate([np.zeros((len(kinds), 1)), steps], 1)
        places.append(steps.argmin(1))
        cost = cost + np.where(among, after, 0.0).sum(1) + steps.min(1)
    return cost, np.stack(places, -1)


def rearranged(overlaps: Overlaps, layers: Layers, cameras: Rig, middles: NDArray[np.float64]) -> Layers:
    """Move each card in turn, the most wrong first, to the node and the places in its order where least is wrong.

    A node without cards would be at the middle of the card; ``middles``, in meters, are [P, 3].
    """
    keys = node_keys(cameras, layers)
    owners = np.concatenate([overlaps.front // 2, overlaps.back // 2])
    rows = np.concatenate([np.arange(len(overlaps.front))] * 2)
    by_card = np.split(rows[np.argsort(owners, kind="stable")], np.cumsum(np.bincount(owners, minlength=len(layers.node)))[:-1])
    wrong = wrong_shares(overlaps, layers, keys).mean(0)
    for card in np.argsort([-wrong[own].sum() for own in by_card], kind="stable").tolist():
        own = overlaps.take(by_card[card])
        now = float(wrong_shares(own, layers, keys).mean(0).sum())
        if now <= _NOTHING:
            continue
        origins = layers.origins.copy()
        origins[free := np.bincount(layers.node, minlength=len(origins)) == 0] = middles[card]
        keys[:, :, free] = np.stack(sort_keys(cameras, middles[[card]]))
        cost, places = placements(own, layers, keys, card)
        best = int(cost.argmin())
        if cost[best] < now - _NOTHING:
            rest = layers.order[layers.order // 2 != card]
            node = layers.node.copy()
            node[card] = best
            layers = Layers(node, np.insert(rest, places[best], [2 * card, 2 * card + 1]), origins)
    return layers


def node_keys(cameras: Rig, layers: Layers) -> NDArray[np.float64]:
    """The depth and the distance of the nodes from the cameras in meters, [2, V, K]."""
    return np.stack(sort_keys(cameras, layers.origins))


def misordered_share(overlaps: Overlaps, layers: Layers, cameras: Rig) -> Misordered:
    """What the overlaps of faces in the pictures of the cameras draw in the wrong order."""
    return Misordered(*wrong_shares(overlaps, layers, node_keys(cameras, layers)).sum(1).tolist())


def card_layers(cards: Cards) -> Layers:
    """The nodes and the order that cards are exported with. A card without an origin counts as a node at the center of its bounds."""
    places, node = dict[tuple[float, ...], int](), list[int]()
    for index, card in enumerate(cards.cards):
        place = (card.corners.min(0) + card.corners.max(0)) / 2 if card.origin is None else card.origin
        key = (*place.tolist(), *([index] if card.origin is None else []))
        node.append(places.setdefault(key, len(places)))
    order = np.argsort([rank for card in cards.cards for rank in card.ranks], kind="stable")
    return Layers(np.array(node), order, np.array([key[:3] for key in places]))


def misordered(cards: Cards, cameras: Camera | None = None) -> Misordered:
    """Measure the error of a picture whose nodes are drawn one after another, from back to front by their origins.

    The shares are those of what all cameras see; each camera has the same weight at any distance. Cameras are pinholes, of which only the
    positions and viewing directions are used, because their pictures are framed around the cards; by default they are those of
    :func:`~bbfit.exporting.visibility.check_rig`. :func:`card_layers` says what the nodes are.

    The true order of a pixel is that of the depths along its ray; layers whose depths differ by less than a relative 1e-5 are right in
    either order. A pair of layers in the wrong order counts with the share of the pixel in which these two are the first two opaque layers,
    if alpha is the probability of being opaque: for two layers, the product of their alphas.
    """
    if cameras is None:
        rig = check_rig(cards)
    else:
        rig = Rig(*(part.double().cpu().numpy() for part in (cameras.batch().position, cameras.batch().forward)))
    samples, layers = sample_visibility(cards, rig), card_layers(cards)
    return misordered_share(overlaps_of(samples, visible_faces(cards, samples)), layers, samples.cameras)
