"""Cards cut into convex pieces around their visible parts, so that few empty fragments are shaded."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.exporting.hulls import ANY, MARGIN, rimmed_alpha, shown_cells, texel_corners, trimmed
from bbfit.geometry.cards import Cards
from bbfit.geometry.polygons import area

# Least share of all cards' area that a cut must save. A graphics card sets up the triangles of a piece for about as much as some dozens of
# pixels; where the rectangles draw 200 000 pixels, that is this share.
_LEAST_SAVED = 0.0003


@dataclass(frozen=True, eq=False)
class _Part:
    """The smallest box around visible squares of four texel centers, as :func:`~bbfit.exporting.hulls.shown_cells` counts them."""

    card: int
    """Index of its card."""
    start: NDArray[np.int64]
    """Row and column of its first square, [2]."""
    shown: NDArray[np.bool_]
    """Which of its squares are visible, [h, w]; no row or column at the border is empty."""


def with_pieces(cards: Cards, pieces: int, corners: int, least: float) -> Cards:
    """Replace each card by convex pieces around its visible parts: on average at most ``pieces`` >= 1 of at most ``corners`` >= 4 corners.

    The pieces contain each point of the card where the bilinearly filtered alpha reaches ``least``, and lie inside the card. ``least``, in
    [0, 1], is as in :func:`~bbfit.exporting.hulls.with_hulls`, and so is what holds for mip levels.

    Cuts along rows and columns of texel centers divide the textures. Each cut is the one that saves most area in all cards: the boxes
    around the visible texels on its two sides are smaller than the box around both. At the end each part is trimmed to a convex polygon.

    Pieces of a ``mask`` that meet at a cut through visible texels overlap by two margins, 1/32 texel. Sides with different corners would
    leave gaps there, because graphics cards round corners to fractions of a pixel, and a pixel that is drawn twice after an alpha test
    looks the same. It would not where programs blend, so for other modes pieces end exactly at the cut. A corner is then off by up to 1/512
    pixel, and so a pixel of every few hundred along a cut may be drawn twice or not at all.

    Pieces keep the order of the cards, and their normals, winding and textures. A card with an origin or of another shape, as splitting
    makes them, stays one piece. A card with no visible part shrinks to about one texel. Raises InputError if an argument is out of range.
    """
    check_count("pieces", pieces)
    check_count("corners", corners, 4)
    check_range("least alpha", least, 0, 1)
    boxes = _boxes_of_parts(cards, pieces, least)
    margin, made = MARGIN if cards.alpha.kind == "mask" else 0.0, []
    for card, own in zip(cards.cards, boxes, strict=True):
        made += [trimmed(cards, card, corners, least, box, margin) for box in (own if own[1:] else [None])]
    return cards.with_cards(made)


def count_pieces(cards: Cards, pieces: int, least: float) -> int:
    """How many pieces :func:`with_pieces` makes of cards. Nearly all of them have as many corners as are allowed."""
    return sum(max(1, len(own)) for own in _boxes_of_parts(cards, pieces, least))


def _boxes_of_parts(cards: Cards, pieces: int, least: float) -> list[list[NDArray[np.float64]]]:
    """The boxes of each card's parts in texels, [4, 2] each; one or none where a card stays one piece."""
    areas = np.array([_area(card.corners) for card in cards.cards])
    scales, order = areas / [abs(area(texel_corners(cards, card))) for card in cards.cards], itertools.count()

    def entry(part: _Part) -> tuple[float, int, _Part, list[_Part]]:
        saved, halves = _best_cut(part)
        return -saved * float(scales[part.card]), next(order), part, halves

    queue = [entry(part) for index in range(len(cards.cards)) for part in _whole(cards, index, max(least, ANY))]
    heapq.heapify(queue)
    most = len(queue) + (pieces - 1) * len(cards.cards)
    while queue and len(queue) < most and -queue[0][0] > _LEAST_SAVED * areas.sum():
        for half in heapq.heappop(queue)[-1]:
            heapq.heappush(queue, entry(half))

    boxes: list[list[NDArray[np.float64]]] = [[] for _ in cards.cards]
    for _, _, part, _ in sorted(queue, key=lambda entry: tuple(entry[2].start)):
        boxes[part.card].append(_box(part))
    return boxes


def _area(corners: NDArray[np.float64]) -> float:
    """Area of a flat polygon in space, [K, 3]."""
    return float(np.linalg.norm(np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0]).sum(0))) / 2


def _whole(cards: Cards, index: int, least: float) -> Iterator[_Part]:
    """The box around all that a card shows; none if it shows nothing or stays one piece."""
    card, polygon = cards.cards[index], texel_corners(cards, cards.cards[index])
    rimmed = rimmed_alpha(cards, card.rectangle)
    shown = np.zeros((rimmed.shape[0] - 1, rimmed.shape[1] - 1), bool)
    shown[tuple(shown_cells(rimmed, polygon, least).T)] = True
    if shown.any() and card.origin is None and abs(area(polygon)) > (1 - 1e-9) * np.ptp(polygon, axis=0).prod():
        yield _cropped(_Part(index, np.zeros(2, np.int64), shown))


def _cropped(part: _Part) -> _Part:
    """The part without empty rows and columns at its border."""
    at = np.argwhere(part.shown)
    low, high = at.min(0), at.max(0) + 1
    return replace(part, start=part.start + low, shown=part.shown[low[0] : high[0], low[1] : high[1]])


def _best_cut(part: _Part) -> tuple[float, list[_Part]]:
    """The area in square texels that the best cut of a part saves, and its halves; no halves if no cut saves area."""
    best, halves = 0.0, list[_Part]()
    for axis, shown in enumerate((part.shown, part.shown.T)):
        (deep, before), (rest, after) = _boxes(shown), (values[::-1] for values in _boxes(shown[::-1]))
        saved = np.where(deep[:-1] + rest[1:] <= len(shown), shown.size - before[:-1] - after[1:], 0)
        if saved.max(initial=0) > best:
            best, cut = float(saved.max()), int(saved.argmax()) + 1
            parts = shown[:cut], shown[cut:]
            step = np.eye(2, dtype=np.int64)[axis] * cut
            halves = [
                _cropped(replace(part, start=part.start + move, shown=half.T if axis else half))
                for move, half in zip((0 * step, step), parts, strict=True)
            ]
    return best, halves


def _boxes(shown: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For the first 1, 2, ... n rows of squares [n, w]: the height and the area of the box around the visible ones, [n] each."""
    some, width = shown.any(1), shown.shape[1]
    height = np.maximum.accumulate(np.where(some, np.arange(len(shown)), 0)) + 1
    left = np.minimum.accumulate(np.where(some, shown.argmax(1), width))
    right = np.maximum.accumulate(np.where(some, width - shown[:, ::-1].argmax(1), 0))
    return height, height * (right - left)


def _box(part: _Part) -> NDArray[np.float64]:
    """Corners of a part in texels, [4, 2]."""
    (top, left), (height, width) = part.start - 1.0, part.shown.shape
    return np.array([[left, top], [left + width, top], [left + width, top + height], [left, top + height]])
