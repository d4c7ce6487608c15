"""Nodes joined with others, as long as the order of drawing stays right, so that programs draw and sort few."""

from __future__ import annotations

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
# Numbers that are computed at once.
_CHUNK = 1 << 22


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
    change = _moved(overlaps.grouped(np.repeat(node, 2)), node_keys(cameras, layers))
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


def _moved(between: Overlaps, keys: NDArray[np.float64]) -> NDArray[np.float64]:
    """How the wrong share changes if a node is sorted by the origin of another, without their own overlaps, [K, K]; inf on the diagonal."""
    count = keys.shape[-1]
    change = np.zeros((count, count))
    rows = max(1, _CHUNK // count)
    for start in range(0, len(between.weight), rows):
        part = between.take(np.arange(start, min(start + rows, len(between.weight))))
        line, half = np.arange(len(part.weight)), part.weight[:, None] / 2
        for key in keys[:, part.camera]:
            front, back = key[line, part.front], key[line, part.back]
            as_front, as_back = half * (key >= back[:, None]), half * (front[:, None] >= key)
            as_front[line, part.back] = as_back[line, part.front] = 0.0
            now = half * (front >= back)[:, None]
            for group, wrong in ((part.front, as_front - now), (part.back, as_back - now)):
                order = np.argsort(group, kind="stable")
                first = np.flatnonzero(np.diff(group[order], prepend=-1))
                change[group[order][first]] += np.add.reduceat(wrong[order], first)
    np.fill_diagonal(change, np.inf)
    return change
