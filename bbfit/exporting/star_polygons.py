"""Small star-shaped polygons around boxes in the plane."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.geometry.polygons import area

# Directions around a center in which the reach of the boxes is known, a multiple of two.
_DIRECTIONS = 1440
_STEP = 2 * np.pi / _DIRECTIONS
# Every polygon contains the disc of this radius around its center, in texels: corners need an angle.
LEAST_RADIUS = 0.5
# A chord over one step is closer to the center than its ends by this factor.
_SAG = np.cos(_STEP / 2)
# Directions of the corners of the polygon that is simplified.
_AROUND = 24
# With this many corners or fewer, corners move after each simplification, by these shares of the size of the polygon.
_FEW, _SHIFTS = 12, (0.04, 0.015)
# A refinement exchanges this many corners at a time, at most so many times.
_EXCHANGED, _EXCHANGES = 2, 1
# Places of a new notch: shares of the way along a side, and then towards the center.
_NOTCH_ALONG, _NOTCH_DEPTH = np.array([0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9]), np.array([0.02, 0.06, 0.12, 0.2, 0.3, 0.45, 0.6, 0.75])
# Looser ends of a side with a notch: sectors that they turn towards each other, and the factor of their distance from the center.
_LOOSER = ((0.0, 1.04), (2.5, 1.0), (2.5, 1.04), (8.0, 1.0))
# Largest turn between neighboring corners as seen from the center.
_MOST_TURN = np.pi - 1e-3
# The refinement moves corners by at most this share of the size of the boxes, then by half of it, and so on down to a share of a texel.
_LARGEST, _SMALLEST = 0.04, 0.2
# Moves of one size end when the area has fallen by less than this share in as many rounds. The moves of each round have other directions.
_GAIN, _ROUNDS, _TURN = 5e-3, 2, 0.4


@dataclass(frozen=True)
class Boxes:
    """N axis-aligned boxes that a polygon must contain."""

    low: NDArray[np.float64]
    """Corners with the smallest coordinates, [N, 2]."""
    high: NDArray[np.float64]
    """Corners with the largest coordinates, [N, 2]."""

    def __len__(self) -> int:
        return len(self.low)

    def take(self, index: NDArray) -> Boxes:
        """Some of the boxes, by index or mask."""
        return Boxes(self.low[index], self.high[index])


@dataclass(frozen=True)
class Stars:
    """The convex region and the boxes of a search for polygons that are star-shaped about one center."""

    center: NDArray[np.float64]
    """From here each point of a polygon is visible, [2]. Other points in this class are relative to it."""
    normals: NDArray[np.float64]
    """Unit normals of the region's sides, [S, 2]."""
    offsets: NDArray[np.float64]
    """Inside the region ``normals . p <= offsets`` holds, [S]."""
    reach: NDArray[np.float64]
    """Least radius that a polygon needs in each of M equal sectors around the center; sector 0 starts at +X, [M]."""

    def fits(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points [..., 2] can be corners: not nearer than the boxes, and in the region."""
        sector = (_angles(points) // _STEP).astype(np.int64) % _DIRECTIONS
        return (np.hypot(*np.moveaxis(points, -1, 0)) >= self.reach[sector]) & (points @ self.normals.T <= self.offsets).all(-1)

    def clipped(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [..., 2] drawn towards the center into the region."""
        beyond = (points @ self.normals.T / np.maximum(self.offsets, 1e-9)).max(-1, keepdims=True)
        inside: NDArray[np.float64] = points / np.maximum(beyond * (1 + 1e-12), 1.0)
        return inside

    def costs(self, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
        """Areas of the triangles of the center and each edge, from [..., A, 2] to [..., B, 2]: [..., A, B].

        The area is infinite for an edge that cuts off a part of a box, or that does not turn counter-clockwise around the center.
        """
        first, last = _angles(starts), _angles(ends)
        from_sector, to_sector = (first // _STEP).astype(np.int64), (last // _STEP).astype(np.int64)
        passed = (to_sector[..., None, :] - from_sector[..., None]) % _DIRECTIONS
        turn = (last[..., None, :] - first[..., None]) % (2 * np.pi)
        allowed = (turn > 1e-9) & (turn < _MOST_TURN)
        farthest = int(passed[allowed].max(initial=0))
        outwards, edges = starts[..., None, :], ends[..., None, :, :] - starts[..., None, :]
        # The edge must leave its start to the right of all points that it has to pass.
        steepest = np.take_along_axis(self._steepest(starts, from_sector, farthest), np.minimum(passed, farthest), -1)
        allowed &= (outwards * edges).sum(-1) >= steepest * np.where(allowed, _cross(outwards, edges), 1.0)
        return np.where(allowed, 0.5 * _cross(outwards, ends[..., None, :, :]), np.inf)

    def _steepest(self, starts: NDArray[np.float64], sectors: NDArray[np.int64], farthest: int) -> NDArray[np.float64]:
        """The largest cotangents of the directions, relative to the outward one, to points in the next 0, 1, .. F sectors, [..., F + 1]."""
        rays = np.maximum(self.reach, np.roll(self.reach, 1))  # where a sector starts, both it and the one before must be covered
        angles = np.arange(_DIRECTIONS) * _STEP
        ahead = (sectors[..., None] + np.arange(1, farthest + 1)) % _DIRECTIONS
        x, y = (rays * np.cos(angles))[ahead], (rays * np.sin(angles))[ahead]
        out_x, out_y = starts[..., :1], starts[..., 1:]
        outwards, across = x * out_x + y * out_y - (out_x**2 + out_y**2), out_x * y - out_y * x
        # Half a turn ahead, a point is behind the start.
        behind = across <= 1e-12
        cotangents = np.where(behind, -np.inf, outwards / np.where(behind, 1.0, across))
        start = np.full((*cotangents.shape[:-1], 1), -np.inf)
        return np.maximum.accumulate(np.concatenate([start, cotangents], -1), -1)


def stars_around(boxes: Boxes, center: NDArray[np.float64], normals: NDArray[np.float64], offsets: NDArray[np.float64]) -> Stars:
    """The problem of polygons that contain boxes, inside the convex region ``normals . p <= offsets``, which contains the
    disc of :data:`LEAST_RADIUS` around the center."""
    low, high = boxes.low - center, boxes.high - center
    x, y = np.stack([low[:, 0], high[:, 0], high[:, 0], low[:, 0]], -1), np.stack([low[:, 1], low[:, 1], high[:, 1], high[:, 1]], -1)
    middle = np.arctan2(low[:, 1] + high[:, 1], low[:, 0] + high[:, 0])
    turn = (np.arctan2(y, x) - middle[:, None] + np.pi) % (2 * np.pi) - np.pi
    around = ((low <= 0) & (high >= 0)).all(-1)
    first = np.where(around, 0, np.floor((middle + turn.min(-1)) / _STEP - 1e-9)).astype(np.int64)
    last = np.where(around, _DIRECTIONS - 1, np.floor((middle + turn.max(-1)) / _STEP + 1e-9)).astype(np.int64)
    count = last - first + 1
    sectors = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
    reach = np.full(_DIRECTIONS, LEAST_RADIUS)
    np.maximum.at(reach, sectors % _DIRECTIONS, np.repeat(np.hypot(x, y).max(-1), count))
    return Stars(center, normals, offsets - normals @ center, reach / _SAG)


def rough_polygons(stars: Stars, most: int) -> dict[int, NDArray[np.float64]]:
    """Small polygons of 3 to ``most`` corners, by their number of corners; points relative to the center, counter-clockwise.

    A polygon of about 40 corners is simplified corner by corner, by the change that adds the least area: either a corner is left out, or a
    side, whose neighbors then meet.
    """
    polygon, made = _fine_polygon(stars), dict[int, NDArray[np.float64]]()
    while len(polygon) > 3:
        simpler = _simplified(stars, polygon)
        if simpler is None:
            break
        polygon, size = simpler, float(np.ptp(simpler, axis=0).max())
        for turned, shift in enumerate(_SHIFTS if len(polygon) <= _FEW else ()):
            moved = _moved(stars, polygon, shift * size * _moves(turned * _TURN))
            polygon = polygon if moved is None or area(moved) > area(polygon) else moved
        if len(polygon) <= most:
            made[len(polygon)] = polygon
    return made


def _fine_polygon(stars: Stars) -> NDArray[np.float64]:
    """A polygon with many corners: as near as its directions allow where that suffices, and elsewhere at the border of the region."""
    normals, offsets = stars.normals, stars.offsets
    meet = [np.linalg.solve(normals[[i, j]], offsets[[i, j]]) for i, j in _crossing(normals)]
    corners = np.array([point for point in meet if (normals @ point <= offsets + 1e-9).all()]).reshape(-1, 2)
    angles = np.sort(np.concatenate([np.arange(_AROUND) * (2 * np.pi / _AROUND), _angles(corners)]))
    angles = angles[np.diff(angles, prepend=angles[-1] - 2 * np.pi) > 1e-6]
    directions = np.stack([np.cos(angles), np.sin(angles)], -1)
    along = directions @ normals.T
    border = np.where(along > 1e-12, offsets / np.where(along > 1e-12, along, 1.0), np.inf).min(-1) * (1 - 1e-12)
    ends = (np.append(angles, angles[0] + 2 * np.pi) // _STEP).astype(np.int64)
    wedges = [stars.reach[np.arange(start, end + 1) % _DIRECTIONS].max() for start, end in itertools.pairwise(ends)]
    near = np.maximum(wedges, np.roll(wedges, 1)) / np.cos(np.pi / _AROUND)
    radius = np.minimum(near, border)
    while True:
        polygon = radius[:, None] * directions
        cut = ~np.isfinite(_edge_costs(stars, polygon, np.roll(polygon, -1, 0))) & (
            (radius < border) | (np.roll(radius, -1) < np.roll(border, -1))
        )
        if not cut.any():
            return polygon
        radius = np.where(cut | np.roll(cut, 1), border, radius)


def _crossing(normals: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs of sides that are not parallel."""
    pairs = [(i, j) for i in range(len(normals)) for j in range(i)]
    return [(i, j) for i, j in pairs if abs(normals[i, 0] * normals[j, 1] - normals[i, 1] * normals[j, 0]) > 1e-6]


def _simplified(stars: Stars, polygon: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The smallest polygon with one corner less that arises if a corner or a side is left out; ``None`` if none contains the boxes."""
    before, after, second = (np.roll(polygon, -shift, 0) for shift in (-1, 1, 2))
    doubled = polygon[:, 0] * after[:, 1] - polygon[:, 1] * after[:, 0]
    without_corner = _edge_costs(stars, before, after) - 0.5 * (np.roll(doubled, 1) + doubled)
    # Where the lines through the sides before and after the one from a corner to the next meet.
    first, last, apart = polygon - before, second - after, after - polygon
    across = first[:, 0] * last[:, 1] - first[:, 1] * last[:, 0]
    share = (apart[:, 0] * last[:, 1] - apart[:, 1] * last[:, 0]) / np.where(abs(across) > 1e-9, across, np.inf)
    meet = polygon + share[:, None] * first
    around = _edge_costs(stars, before, meet) + _edge_costs(stars, meet, second)
    around -= 0.5 * (np.roll(doubled, 1) + doubled + np.roll(doubled, -1))
    without_side = np.where((abs(across) > 1e-9) & stars.fits(meet), around, np.inf)
    if min(without_corner.min(), without_side.min()) == np.inf:
        return None
    if without_corner.min() <= without_side.min():
        return np.delete(polygon, without_corner.argmin(), 0)
    index = int(without_side.argmin())
    made = polygon.copy()
    made[index] = meet[index]
    return np.delete(made, (index + 1) % len(polygon), 0)


def _edge_costs(stars: Stars, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """:meth:`Stars.costs` of the edges from each point to one other, [K, 2] each: [K]."""
    costs: NDArray[np.float64] = stars.costs(starts[:, None], ends[:, None])[:, 0, 0]
    return costs


def refined(stars: Stars, polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make a polygon smaller without more corners.

    All corners move at the same time as long as the area falls. Then the polygon gets more notches, loses as many other corners, and its
    corners move again. This repeats as long as it helps.
    """
    polygon = _settled(stars, polygon)
    for _ in range(_EXCHANGES):
        other: NDArray[np.float64] | None = polygon
        for change in (_notched,) * _EXCHANGED + (_simplified,) * _EXCHANGED:
            other = None if other is None else change(stars, other)
            if other is not None:
                size = float(np.ptp(other, axis=0).max())
                for turned, shift in enumerate(_SHIFTS):
                    moved = _moved(stars, other, shift * size * _moves(turned * _TURN))
                    other = other if moved is None or area(moved) > area(other) else moved
        if other is None or len(other) > len(polygon):
            break
        other = _settled(stars, other)
        if area(other) > area(polygon) * (1 - _GAIN):
            break
        polygon = other
    return polygon


def _settled(stars: Stars, polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move the corners of a polygon, all at the same time, as long as its area falls."""
    best, step, turned = area(polygon), _LARGEST * float(np.ptp(polygon, axis=0).max()), 0.0
    while step > _SMALLEST:
        before = best
        for _ in range(_ROUNDS):
            turned += _TURN
            moved = _moved(stars, polygon, step * _moves(turned))
            if moved is not None and area(moved) < best:
                polygon, best = moved, area(moved)
        if best > before * (1 - _GAIN):
            step /= 2
    return polygon


def _notched(stars: Stars, polygon: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The smallest polygon with one corner more, between a side and the center; ``None`` if none is smaller.

    Corners that touch a box leave no room for a notch beside it, so both ends of the side move a little outwards and towards each other.
    """
    before, after, second = (np.roll(polygon, -shift, 0) for shift in (-1, 1, 2))
    old = 0.5 * sum(
        start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0] for start, end in itertools.pairwise((before, polygon, after, second))
    )
    along, depth = (grid.reshape(-1, 1, 1) for grid in np.meshgrid(_NOTCH_ALONG, _NOTCH_DEPTH))
    best, made = 0.0, None
    for turn, scale in _LOOSER:
        start, end = stars.clipped(_rotated(polygon, turn * _STEP) * scale), stars.clipped(_rotated(after, -turn * _STEP) * scale)
        places = (start + (end - start) * along) * (1 - depth)  # [L, K, 2]
        fixed = _edge_costs(stars, before, start) + _edge_costs(stars, end, second)
        flat = places.reshape(-1, 2)
        starts, ends = (np.broadcast_to(points, places.shape).reshape(-1, 2) for points in (start, end))
        costs = fixed + (_edge_costs(stars, starts, flat) + _edge_costs(stars, flat, ends)).reshape(places.shape[:2])
        gain = np.where(stars.fits(places) & stars.fits(start) & stars.fits(end), old - costs, -np.inf)
        place, side = np.unravel_index(gain.argmax(), gain.shape)
        if gain[place, side] > best:
            best, made = float(gain[place, side]), polygon.copy()
            made[side], made[(side + 1) % len(made)] = start[side], end[side]
            made = np.insert(made, side + 1, places[place, side], 0)
    return made


def _rotated(points: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    turned: NDArray[np.float64] = points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return turned


def _moves(turned: float) -> NDArray[np.float64]:
    """No move, and moves of two lengths in directions all around, [L, 2]."""
    angles = turned + np.arange(8) * (np.pi / 4)
    around = np.stack([np.cos(angles), np.sin(angles)], -1)
    return np.concatenate([np.zeros((1, 2)), around, 0.4 * around])


def _moved(stars: Stars, polygon: NDArray[np.float64], moves: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The smallest polygon whose corners each make one of the moves; ``None`` if there is none."""
    count = len(polygon)
    places = polygon[:, None] + moves
    fits = stars.fits(places)
    costs = stars.costs(places, np.roll(places, -1, 0))
    costs = np.where(fits[:, :, None] & np.roll(fits, -1, 0)[:, None], costs, np.inf)
    paths, through = costs[0], list[NDArray[np.int64]]()
    for following in costs[1:]:
        joined = paths[:, :, None] + following
        through.append(joined.argmin(1))
        paths = np.take_along_axis(joined, through[-1][:, None], 1)[:, 0]
    first = int(np.diagonal(paths).argmin())
    if not np.isfinite(paths[first, first]):
        return None
    chosen = [first]
    for back in through[::-1]:
        chosen.insert(0, int(back[first, chosen[0]]))
    chosen = chosen[-1:] + chosen[:-1]
    moved: NDArray[np.float64] = places[np.arange(count), chosen]
    angles = _angles(moved)
    once = abs(((np.roll(angles, -1) - angles) % (2 * np.pi)).sum() - 2 * np.pi) < 1e-6
    return moved if once else None


def _angles(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles of points [..., 2] in [0, 2 pi)."""
    angles = np.arctan2(points[..., 1], points[..., 0]) % (2 * np.pi)
    return np.where(angles >= 2 * np.pi, 0.0, angles)


def _cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    product: NDArray[np.float64] = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return product
