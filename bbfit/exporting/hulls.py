"""Cards trimmed to convex polygons around their visible part, so that fewer transparent fragments are shaded."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_count, check_range
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import area, following, kept_half, sides

MARGIN = 1 / 64
"""Margin of a polygon around the visible part in texels, far more than the rounding of float32 and the vertex snapping of graphics
cards."""
ANY = 1e-9
"""The least alpha above 0. Bilinear filtering between alpha 1/255 and 0 reaches it within a millionth of a texel from the 0."""
# Candidate directions of sides: this many around the circle, and those of the hull's longest edges.
_AROUND, _EDGES = 36, 32
# Samples of all cards that overdraw is measured with.
_SAMPLES = 500_000


def texel_corners(cards: Cards, card: Card) -> NDArray[np.float64]:
    """A card's corners in texels of its texture, [K, 2]: x to the right, y down, (0, 0) at the center of the top-left texel."""
    return card.uvs * np.array(cards.atlas.image.shape[1::-1]) - 0.5 - cards.atlas.corners[card.rectangle]


def rimmed_alpha(cards: Cards, rectangle: int) -> NDArray[np.float64]:
    """Alpha of a texture in [0, 1] with one transparent texel around it, [h + 2, w + 2]; its texel (0, 0) is at row 1, column 1."""
    (x, y), (width, height) = cards.atlas.corners[rectangle].tolist(), cards.atlas.sizes[rectangle].tolist()
    return np.pad(cards.atlas.image[y : y + height, x : x + width, 3] / 255.0, 1)


def bilinear(rimmed: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Alpha at points in texels, [..., 2] -> [...], filtered bilinearly; 0 outside the texel centers of the rim."""
    height, width = rimmed.shape
    x, y = points[..., 0] + 1, points[..., 1] + 1
    outside = ~((x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1))  # also NaN
    x, y = np.where(outside, 0, x), np.where(outside, 0, y)
    left, top = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    x, y = x - left, y - top
    flat, start = rimmed.ravel(), top * width + left
    upper = flat[start] * (1 - x) + flat[start + 1] * x
    lower = flat[start + width] * (1 - x) + flat[start + width + 1] * x
    return np.where(outside, 0.0, upper * (1 - y) + lower * y)


def shown_cells(rimmed: NDArray[np.float64], polygon: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Rows and columns of the squares of four texel centers that overlap a convex polygon and where alpha reaches ``least``, [C, 2].

    The square of row r and column c has its top-left corner at (c - 1, r - 1). The overlap is exact, by the separating axis theorem.
    """
    reached = rimmed >= least
    cells = np.argwhere(reached[:-1, :-1] | reached[1:, :-1] | reached[:-1, 1:] | reached[1:, 1:])
    centers = cells[:, ::-1] - 0.5
    normals, offsets = sides(polygon)
    low, high = polygon.min(0) - 0.5 + 1e-9, polygon.max(0) + 0.5 - 1e-9
    overlaps = ((centers > low) & (centers < high)).all(-1)
    cells, centers = cells[overlaps], centers[overlaps]
    nearest = centers @ normals.T - 0.5 * abs(normals).sum(-1)  # of the square's corners, the farthest inside
    return cells[(nearest < offsets - 1e-9).all(-1)]


def with_hulls(cards: Cards, vertices: int, least: float) -> Cards:
    """Replace each card by a convex polygon around its visible part with at most ``vertices`` >= 4 corners.

    The polygon contains each point of the card where the bilinearly filtered alpha reaches ``least``, and lies inside the card. ``least``,
    in [0, 1], is the cutoff of MASK, or 0 for any alpha above 0, as BLEND shows it. The visible part is larger in
    mip levels: there the polygon may cut off up to half a texel of the level in use.

    The polygon's sides touch the convex hull of the visible part. It is the smallest of all such polygons whose sides have one of about 70
    directions and whose corners lie in the card. Areas add up corner by corner, so the search is for a shortest cycle (after Aggarwal,
    Chang and Yap 1985, "Minimum area circumscribing polygons"). More vertices never give a larger polygon.

    Cards keep their order, normals, winding, textures and origins. A card with no more than ``vertices`` corners stays as it is if no
    smaller polygon exists; one with no visible part shrinks to about one texel around its center. Raises InputError if an argument is out
    of range.
    """
    check_count("hull vertices", vertices, 4)
    check_range("least alpha", least, 0, 1)
    return cards.with_cards([trimmed(cards, card, vertices, least) for card in cards.cards])


def trimmed(cards: Cards, card: Card, vertices: int, least: float, box: NDArray[np.float64] | None = None, beyond: float = MARGIN) -> Card:
    """A card as :func:`with_hulls` trims it; with ``box``, the part of a rectangular card for the squares of texel centers in a box.

    The box is [4, 2] in texels, along texel centers. The part may reach ``beyond`` the box by so many texels.
    """
    polygon = inside = texel_corners(cards, card)
    region = polygon
    if box is not None:
        grown = box + beyond * np.sign(box - box.mean(0))
        inside, region = (np.clip(corners, polygon.min(0), polygon.max(0)) for corners in (box, grown))
    points = _shown_points(rimmed_alpha(cards, card.rectangle), inside, max(least, ANY))
    hull = _hull_within(points, region) if len(points) else points
    if len(hull) >= 3 and area(hull) > 0:
        smaller = _enclosing(hull, region, vertices)
        smaller = region if smaller is None else smaller
    else:
        shrunk = min(1.0, abs(area(polygon)) ** -0.5)
        smaller = polygon.mean(0) + (polygon[:vertices] - polygon.mean(0)) * shrunk
    if abs(area(smaller)) > (1 - 1e-9) * abs(area(polygon)):
        return card
    return with_texel_corners(cards, card, smaller if area(smaller) * area(polygon) > 0 else smaller[::-1])


def with_texel_corners(cards: Cards, card: Card, polygon: NDArray[np.float64]) -> Card:
    """The same card with other corners in texels, [K, 2], of the same winding."""
    at = texel_corners(cards, card)
    middle, flat = card.corners.mean(0), at.mean(0)
    to_world = np.linalg.lstsq(at - flat, card.corners - middle, rcond=None)[0]
    uvs = (polygon + 0.5 + cards.atlas.corners[card.rectangle]) / np.array(cards.atlas.image.shape[1::-1])
    return replace(card, corners=(polygon - flat) @ to_world + middle, uvs=uvs)


def overdraw(cards: Cards, least: float) -> float:
    """Share of the cards' area in texels, in [0, 1], that is shaded although nothing is visible there.

    ``least``, in [0, 1], is as in :func:`with_hulls`; InputError if it is out of range.
    """
    check_range("least alpha", least, 0, 1)
    shaded = shown = 0.0
    for card in cards.cards:
        polygon = texel_corners(cards, card)
        low, size = polygon.min(0), np.ptp(polygon, axis=0)
        counts = np.maximum(np.ceil(size * np.sqrt(_SAMPLES / len(cards.cards) / size.prod())).astype(int), 8)
        x, y = (start + (np.arange(count) + 0.5) * extent / count for start, count, extent in zip(low, counts, size, strict=True))
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        normals, offsets = sides(polygon)
        points = points[(points @ normals.T <= offsets).all(-1)]
        reached = bilinear(rimmed_alpha(cards, card.rectangle), points) >= max(least, ANY)
        shaded += abs(area(polygon))
        shown += abs(area(polygon)) * float(reached.mean()) if len(points) else 0.0
    return 1 - shown / shaded


def _shown_points(rimmed: NDArray[np.float64], polygon: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Points in texels, [N, 2], whose convex hull contains the part of the polygon where alpha reaches ``least``."""
    cells = shown_cells(rimmed, polygon, least)
    row, column = cells.T
    # For each side of the square: its first corner and the value there, the point where the value passes the limit, and the gradient there.
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    values = np.stack([rimmed[row + y, column + x] for x, y in steps], -1)  # [C, 4]
    top_left = cells[:, ::-1] - 1.0
    corners = (top_left[:, None] + steps)[values >= least]
    others = values[:, [1, 2, 3, 0]]
    passes = (values >= least) != (others >= least)
    share = np.where(passes, (values - least) / np.where(passes, values - others, 1.0), 0.0)
    local = steps + share[..., None] * (following(steps) - steps)  # [C, 4, 2]
    points = [corners, (top_left[:, None] + local)[passes]]
    # The border of the visible part is a hyperbola, which may bulge outwards between two such points. Its tangents there meet outside.
    a, b, c, d = values.T[..., None]  # clockwise from the top left
    x, y = local[..., 0], local[..., 1]
    gradient = np.stack([(b - a) * (1 - y) + (c - d) * y, (d - a) * (1 - x) + (c - b) * x], -1)
    for i in range(4):
        for j in range(i + 1, 4):
            both = passes[:, i] & passes[:, j]
            first, second, at = gradient[both, i], gradient[both, j], local[both, i]
            across = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
            offset = ((local[both, j] - at) * second).sum(-1)
            safe = abs(across) > 1e-12
            meet = at + np.stack([-first[:, 1], first[:, 0]], -1) * (offset / np.where(safe, across, 1.0))[:, None]
            meet = np.where(safe[:, None], meet, at)
            within = ((meet >= -1e-9) & (meet <= 1 + 1e-9)).all(-1)
            points.append((top_left[both] + meet)[within])
    return np.concatenate(points)


def _hull_within(points: NDArray[np.float64], polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """The convex hull of the points plus the margin, clipped to the convex polygon, counter-clockwise, [N, 2]."""
    from scipy.spatial import ConvexHull

    if np.linalg.eigvalsh(np.cov(points.T, bias=True))[0] > 1e-3:  # points on one line have no hull of their own
        points = points[ConvexHull(points).vertices]
    hull = (points[:, None] + MARGIN * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])).reshape(-1, 2)
    hull = hull[ConvexHull(hull).vertices]
    for normal, offset in zip(*sides(polygon), strict=True):
        hull = kept_half(hull, hull @ normal - offset)
    return hull


def _enclosing(hull: NDArray[np.float64], polygon: NDArray[np.float64], vertices: int) -> NDArray[np.float64] | None:
    """The smallest polygon around the hull and inside the convex polygon with at most ``vertices`` corners; None if there is none."""
    middle = hull.mean(0)
    hull, (normals, offsets) = hull - middle, sides(polygon - middle)
    along = following(hull) - hull
    longest = np.argsort(-(along**2).sum(-1), kind="stable")[:_EDGES]
    outwards = np.stack([along[:, 1], -along[:, 0]], -1)[longest]
    edges, fixed = np.arctan2(*outwards.T[::-1]), np.append(np.arctan2(*normals.T[::-1]), np.arange(_AROUND) * (2 * np.pi / _AROUND))
    # A side almost, but not quite, along one of the polygon's would leave the polygon where both touch the hull.
    apart = abs((edges[:, None] - fixed + np.pi) % (2 * np.pi) - np.pi).min(1) > 1e-6
    angles = np.sort(np.append(edges[apart], fixed) % (2 * np.pi))
    angles = angles[np.diff(angles, prepend=angles[-1] - 2 * np.pi) > 1e-7]

    normal = np.stack([np.cos(angles), np.sin(angles)], -1)
    height = (hull @ normal.T).max(0)
    turn = (angles[None] - angles[:, None]) % (2 * np.pi)  # from a side to the next
    sine, cosine = np.sin(turn), np.cos(turn)
    possible = (turn > 1e-7) & (turn < np.pi - 1e-3)
    reach = (height[None] - height[:, None] * cosine) / np.where(possible, sine, 1.0)  # along a side to its corner with the next
    corner = height[:, None, None] * normal[:, None] + reach[..., None] * np.stack([-normal[:, 1], normal[:, 0]], -1)[:, None]
    possible &= (corner @ normals.T <= offsets + 1e-9).all(-1)
    # The quadrangle between the center, its feet on both sides and their corner; these quadrangles make up the polygon.
    share = (2 * height[:, None] * height[None] - (height[:, None] ** 2 + height[None] ** 2) * cosine) / np.where(possible, 2 * sine, 1.0)
    chosen = _shortest_cycle(np.where(possible, share, np.inf), vertices)
    return None if chosen is None else corner[chosen, np.roll(chosen, -1)] + middle


def _shortest_cycle(cost: NDArray[np.float64], length: int) -> NDArray[np.int64] | None:
    """The cheapest cycle once around a circle of n nodes that visits 3 to ``length`` of them; ``cost`` [n, n] is that of each step."""
    upwards = np.where(np.triu(np.ones_like(cost, np.bool_), 1), cost, np.inf)
    starts = np.flatnonzero(np.tril(np.isfinite(cost), -1).any(0))  # the first nodes of cycles: a later one has a step back to them
    back, onwards = cost.T[starts], np.ascontiguousarray(upwards.T)  # the least of a row is found sooner than that of a column
    paths, through, joined = upwards[starts], [], np.empty((len(starts), *cost.shape))
    best, chosen = sys.float_info.max, None
    for count in range(3, length + 1):
        np.add(paths[:, None], onwards, out=joined)  # from a start, [S], to a node, [n], by another, [n]
        through.append(joined.argmin(-1))
        paths = np.take_along_axis(joined, through[-1][..., None], -1)[..., 0]
        closed = paths + back
        if closed.min(initial=np.inf) < best * (1 - 1e-9):
            first, last = np.unravel_index(closed.argmin(), closed.shape)
            best, chosen = float(closed.min()), [int(last)]
            for step in through[::-1]:
                chosen.insert(0, int(step[first, chosen[0]]))
            chosen.insert(0, int(starts[first]))
            assert len(chosen) == count
    return None if chosen is None else np.array(chosen)
