"""Cards cut to tight outlines around their visible part, so that few empty fragments are shaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.exporting.hulls import ANY, MARGIN, enclosing, hull_within, rimmed_alpha, texel_corners, with_hulls, with_texel_corners
from bbfit.exporting.star_polygons import LEAST_RADIUS, Boxes, Stars, refined, rough_polygons, stars_around
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import area, kept_half, sides

CORNERS = 8
"""Most corners of a card's outline in exported files."""
# A texel of a texture with shorter sides than this is divided into boxes, at most this many along a side.
_FINE, _PARTS = 512, 4
# Centers are chosen on a grid of so many places along a side, by the least area that is seen from them, for at most so many boxes.
_GRID, _SEEN = 5, 1000
# Number of centers that are tried, and of those whose polygons are refined.
_CENTERS, _REFINED = 3, 1
# Directions of lines between two polygons, least width of the gap around such a line in texels, and number of lines that are tried.
_LINES, _GAP, _TRIED = 24, 1.0, 4
# Fewest corners of a polygon.
_FEWEST = 3

_Rough = list[tuple[Stars, dict[int, NDArray[np.float64]]]]


def with_outlines(cards: Cards, corners: int, least: float) -> Cards:
    """Replace each rectangle by one or two polygons around its visible part with together at most ``corners`` >= 4 corners.

    The polygons contain each point of the card where the bilinearly filtered alpha reaches ``least``, and lie inside the card. They may
    have notches, which mapbox_earcut triangulates. Two polygons of a card share no area. ``least``, in [0, 1], is as in
    :func:`~bbfit.exporting.hulls.with_hulls`, and so is what holds for mip levels.

    The smallest of three candidates is taken: the convex polygon of :func:`~bbfit.exporting.hulls.with_hulls`; a polygon that is
    star-shaped about one of several centers; and two convex polygons on the two sides of a straight gap. A search for a shortest
    cycle finds the star-shaped polygons roughly. Then their corners move as long as the area falls. A still smaller polygon may exist.

    Cards keep their order, normals, winding, textures and origins. A card with an origin or of another shape, as splitting makes them,
    gets the convex polygon. A card with no visible part shrinks to about one texel. Raises InputError if an argument is out of range.
    """
    check_count("outline corners", corners, 4)
    check_range("least alpha", least, 0, 1)
    made = list[Card]()
    for card, hull in zip(cards.cards, with_hulls(cards, corners, least).cards, strict=True):
        region, largest = texel_corners(cards, card), abs(area(texel_corners(cards, hull)))
        found = list[NDArray[np.float64]]()
        if card.origin is None and abs(area(region)) > (1 - 1e-9) * np.ptp(region, axis=0).prod():
            boxes = visible_boxes(rimmed_alpha(cards, card.rectangle), region, least)
            found = smallest_outline(boxes, region, corners) if len(boxes) else []
        smaller = found and sum(map(area, found)) < (1 - 1e-9) * largest
        made += [_cut(cards, card, polygon) for polygon in found] if smaller else [hull]
    return cards.with_cards(made)


def visible_boxes(rimmed: NDArray[np.float64], rectangle: NDArray[np.float64], least: float) -> Boxes:
    """Boxes in texels that contain all points of a rectangle [4, 2] where bilinearly filtered alpha reaches ``least``, with a margin.

    ``rimmed`` is the texture's alpha with its rim, [h + 2, w + 2]. Each box has such a point, but for the margin.
    """
    parts, least = int(np.clip(_FINE // max(rimmed.shape), 1, _PARTS)), max(least, ANY)
    reached = rimmed >= least
    row, column = np.nonzero(reached[:-1, :-1] | reached[1:, :-1] | reached[:-1, 1:] | reached[1:, 1:])
    a, b, c, d = (rimmed[row + y, column + x][:, None, None] for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)))
    x, y = np.meshgrid(*[np.arange(parts + 1) / parts] * 2)
    values = (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y
    # Over a box, bilinear alpha is largest at one of its corners.
    highest = np.maximum(np.maximum(values[:, :-1, :-1], values[:, 1:, :-1]), np.maximum(values[:, :-1, 1:], values[:, 1:, 1:]))
    cell, down, across = np.nonzero(highest >= least - 1e-12)
    low = np.stack([column[cell] - 1 + across / parts, row[cell] - 1 + down / parts], -1)
    start, end = rectangle.min(0), rectangle.max(0)
    boxes = Boxes(np.maximum(low - MARGIN, start), np.minimum(low + 1 / parts + MARGIN, end))
    return boxes.take((boxes.low < boxes.high).all(-1))


def smallest_outline(boxes: Boxes, rectangle: NDArray[np.float64], corners: int) -> list[NDArray[np.float64]]:
    """The smallest outline of boxes that is found, as one or two polygons [K, 2] in texels of positive area; empty if none is found."""
    normals, offsets = sides(rectangle)
    found = [_finished(_rough(boxes, normals, offsets, corners, _CENTERS), corners)]
    for normal, place, first in _gaps(boxes) if corners >= 2 * _FEWEST else []:
        height = rectangle @ normal - place
        halves = [(boxes.take(part), kept_half(rectangle, sign * height)) for part, sign in ((first, 1.0), (~first, -1.0))]
        sizes = range(_FEWEST, corners - _FEWEST + 1)
        made = [{count: _convex(part, half, count) for count in sizes} for part, half in halves]
        pairs = [[made[0][count], made[1][corners - count]] for count in sizes]
        found += [[polygon for polygon in pair if polygon is not None] for pair in pairs if not any(polygon is None for polygon in pair)]
    return min((polygons for polygons in found if polygons), key=lambda polygons: sum(map(area, polygons)), default=[])


def _convex(boxes: Boxes, region: NDArray[np.float64], most: int) -> NDArray[np.float64] | None:
    """The smallest convex polygon around boxes in a convex region, of positive area; ``None`` if none has at most ``most`` corners."""
    points = np.concatenate(
        [boxes.low, boxes.high, np.stack([boxes.low[:, 0], boxes.high[:, 1]], -1), np.stack([boxes.high[:, 0], boxes.low[:, 1]], -1)]
    )
    polygon = enclosing(hull_within(points, region), region, most)
    return polygon if polygon is None or area(polygon) > 0 else polygon[::-1]


def _rough(boxes: Boxes, normals: NDArray[np.float64], offsets: NDArray[np.float64], most: int, count: int) -> _Rough:
    """Rough polygons about the ``count`` best centers."""
    low, high = boxes.low.min(0), boxes.high.max(0)
    places = (np.arange(_GRID) + 0.5) / _GRID
    centers = low + np.stack(np.meshgrid(places, places), -1).reshape(-1, 2) * (high - low)
    centers = np.concatenate([centers, [(boxes.low + boxes.high).mean(0) / 2]])
    centers = centers[(centers @ normals.T < offsets - 2 * LEAST_RADIUS).all(-1)]
    some = boxes.take(np.arange(0, len(boxes), -(-len(boxes) // _SEEN)))
    seen = [float((stars_around(some, center, normals, offsets).reach ** 2).sum()) for center in centers]
    chosen = centers[np.argsort(seen, kind="stable")[:count]]
    made = [(stars, rough_polygons(stars, most)) for stars in (stars_around(boxes, center, normals, offsets) for center in chosen)]
    return [(stars, polygons) for stars, polygons in made if polygons]


def _finished(rough: _Rough, most: int) -> list[NDArray[np.float64]]:
    """The smallest refined polygon of at most ``most`` corners, as a list of one; empty if there is none."""
    known = [(stars, min((polygon for count, polygon in made.items() if count <= most), key=area, default=None)) for stars, made in rough]
    tried = sorted(((area(polygon), index) for index, (_, polygon) in enumerate(known) if polygon is not None))[:_REFINED]
    made = [refined(known[index][0], known[index][1]) + known[index][0].center for _, index in tried]  # type: ignore[arg-type]
    return sorted(made, key=area)[:1]


def _gaps(boxes: Boxes) -> list[tuple[NDArray[np.float64], float, NDArray[np.bool_]]]:
    """Lines n . p = d in gaps between boxes, with the boxes where n . p < d; those between the smallest convex hulls come first."""
    from scipy.spatial import ConvexHull

    middles, halves = (boxes.low + boxes.high) / 2, (boxes.high - boxes.low) / 2
    made = list[tuple[float, NDArray[np.float64], float, NDArray[np.bool_]]]()
    for angle in np.arange(_LINES) * np.pi / _LINES:
        normal = np.array([np.cos(angle), np.sin(angle)])
        place, reach = middles @ normal, halves @ abs(normal)
        order = np.argsort(place - reach)
        ends, starts = np.maximum.accumulate((place + reach)[order])[:-1], (place - reach)[order][1:]
        for index in np.flatnonzero(starts - ends >= _GAP):
            line = float(ends[index] + starts[index]) / 2
            first = place < line
            corners = [np.concatenate([boxes.low[part], boxes.high[part]]) for part in (first, ~first)]
            made.append((sum(ConvexHull(points).volume for points in corners), normal, line, first))
    return [found[1:] for found in sorted(made, key=lambda found: found[0])[:_TRIED]]


def _cut(cards: Cards, card: Card, polygon: NDArray[np.float64]) -> Card:
    """The part of a card inside a simple polygon in texels, [K, 2]."""
    import mapbox_earcut

    made = with_texel_corners(cards, card, polygon if area(texel_corners(cards, card)) > 0 else polygon[::-1])
    at = texel_corners(cards, made)
    faces = mapbox_earcut.triangulate_float64(np.ascontiguousarray(at), np.array([len(at)], np.uint32)).reshape(-1, 3).astype(np.int64)
    turned = np.array([area(at[face]) for face in faces]) * area(at) < 0
    faces[turned] = faces[turned][:, ::-1]
    return replace(made, faces=faces)
