"""Nodes joined with others, as long as the order of drawing stays right, so that programs draw and sort few."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.layers import Layers, drawing_order, face_weights, node_keys, order_cost, rearranged, reordered, wrong_shares
from bbfit.exporting.node_order import fit_origins
from bbfit.exporting.visibility import Overlaps, Rig

# Share of the nodes that is joined before costs are computed again, and pairs of nodes for each node whose common order is tried.
_AT_ONCE, _TRIED = 0.2, 3
# Rounds of changes of cards, orders and origins at the end.
_ROUNDS = 3


def joined(overlaps: Overlaps, layers: Layers, cameras: Rig, nodes: int) -> Layers:
    """The same cards in at most ``nodes`` nodes, such that little is drawn in the wrong order.

    The overlaps are those of faces in the pictures of the cameras. Nodes are joined pair by pair, each time those that cost least: the
    cards of one are sorted by the origin of the other from then on, and get places in its order
    (:func:`~bbfit.exporting.layers.drawing_order`).
    """
    while len(layers.origins) > nodes:
        layers = _with_pairs_joined(overlaps, layers, cameras, len(layers.origins) - nodes)
    return layers


def settled(overlaps: Overlaps, layers: Layers, cameras: Rig, middles: NDArray[np.float64], scale: float) -> Layers:
    """The same number of nodes, after cards have changed to others, and orders and origins have been fitted in turn.

    ``middles`` holds the centers of the cards, [P, 3], and ``scale`` is the tree's radius, both in meters.
    """
    best, least = layers, np.inf
    for _ in range(_ROUNDS):
        layers = rearranged(overlaps, reordered(overlaps, layers), cameras, middles)
        between = overlaps.grouped(np.repeat(layers.node, 2))
        layers = replace(layers, origins=fit_origins(cameras, between, layers.origins, [layers.origins], scale))
        wrong = float(wrong_shares(overlaps, layers, node_keys(cameras, layers)).sum())
        if wrong < least:
            best, least = layers, wrong
    return best


def _with_pairs_joined(overlaps: Overlaps, layers: Layers, cameras: Rig, most: int) -> Layers:
    """The same with at most ``most`` pairs of nodes joined, those that cost least."""
    count, node, room = len(layers.origins), layers.node, max(1, min(most, int(_AT_ONCE * len(layers.origins))))
    weight = face_weights(overlaps, len(layers.order))
    faces = [np.flatnonzero(np.repeat(node == index, 2)) for index in range(count)]

    def inside(members: NDArray[np.int64]) -> float:
        own = weight[np.ix_(members, members)]
        return order_cost(own, drawing_order(own))

    alone = [inside(members) for members in faces]
    change = moving_costs(overlaps.grouped(np.repeat(node, 2)), node_keys(cameras, layers))
    costs = []
    for at in np.argsort(change, axis=None, kind="stable")[: _TRIED * count].tolist():
        moved, kept = divmod(at, count)
        if moved != kept:
            together = inside(np.concatenate([faces[moved], faces[kept]]))
            costs.append((float(change[moved, kept]) + together - alone[moved] - alone[kept], moved, kept))
    target, busy = np.arange(count), set[int]()
    for _, moved, kept in sorted(costs):
        if not {moved, kept} & busy and len(busy) < 2 * room:
            busy |= {moved, kept}
            target[moved] = kept
    left, target = np.unique(target, return_inverse=True)
    return Layers(target[node], layers.order, layers.origins[left])


def moving_costs(between: Overlaps, keys: NDArray[np.float64]) -> NDArray[np.float64]:
    """How the wrong share changes if a node is sorted by the origin of another, and both no longer overlap, [K, K]; inf on the diagonal.

    ``between`` are overlaps of nodes, one for each camera and pair, ordered by camera; ``keys`` are those of the nodes, [2, V, K], from
    which the farther is drawn first.
    """
    count = keys.shape[-1]
    change = np.zeros((count, count))
    starts = np.searchsorted(between.camera, np.arange(keys.shape[1] + 1))
    for camera, (start, end) in enumerate(itertools.pairwise(starts.tolist())):
        front, back, half = between.front[start:end], between.back[start:end], between.weight[start:end] / 2
        for key in keys[:, camera]:
            places, rank = np.unique(key, return_inverse=True)
            # What each place makes wrong: overlaps with nodes behind that have no larger key, and with nodes in front that have no smaller.
            size = (count, len(places))
            as_front = np.bincount(front * size[1] + rank[back], half, count * size[1]).reshape(size).cumsum(1)
            as_back = np.bincount(back * size[1] + rank[front], half, count * size[1]).reshape(size)[:, ::-1].cumsum(1)[:, ::-1]
            now = half * (key[front] >= key[back])
            change += (as_front + as_back)[:, rank] - (np.bincount(front, now, count) + np.bincount(back, now, count))[:, None]
            change[front, back] -= half
            change[back, front] -= half
    np.fill_diagonal(change, np.inf)
    return change
