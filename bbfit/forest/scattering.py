"""Trees scattered over an area: random places that are no closer than a spacing, row by row, so that they need not fit in memory.

The places are a Poisson-disk sample, whose spectrum is blue noise. ``scipy.stats.qmc.PoissonDisk`` makes such samples one point at a time
with all of them in memory. Here each square of a grid takes one of several random points, squares that are far enough apart at the same
time (L.-Y. Wei 2008, "Parallel Poisson disk sampling").
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_file, fail
from bbfit.files import read_json
from bbfit.forest.columns import number
from bbfit.forest.config import ForestConfig, ScatterConfig
from bbfit.forest.georeference import Origin, coordinates_of, is_projected, like_degrees, local_from_degrees
from bbfit.forest.planting import uniform
from bbfit.forest.registers import ROW
from bbfit.inputs import reading

_TRIALS = 24
# Rows of squares that are filled at a time.
_STRIP = 126
_MOST_CORNERS, _MOST_SQUARES = 1_000_000, 1 << 33
_HINT = "export the area as GeoJSON with polygons"
# Squares with points closer than the spacing, of side 1 / sqrt(2): those up to two away, save the corners.
_NEAR = [(i, j) for i, j in itertools.product(range(-2, 3), repeat=2) if 0 < abs(i) + abs(j) < 4]


@dataclass(frozen=True)
class Area:
    """An area on the ground in the local frame."""

    origin: Origin
    low: tuple[float, float]
    """Its least (east, north) in meters."""
    high: tuple[float, float]
    """Its greatest (east, north) in meters."""
    polygons: tuple[tuple[NDArray[np.float64], ...], ...] = ()
    """Its polygons, which may overlap: the corners of each and of its holes, each [C, 2]; none for the whole rectangle."""


def scatter_area(config: ScatterConfig, forest: ForestConfig) -> Area:
    """The area of a configuration. Raises InputError or MissingFileError if the file of polygons cannot be read."""
    if config.scatter_area is None:
        width, depth = config.scatter
        origin = Origin(*forest.origin) if forest.origin else Origin()
        return Area(origin, (-width / 2, -depth / 2), (width / 2, depth / 2))
    path = check_file("scatter_area", config.scatter_area)
    polygons, degrees = _polygons(path)
    corners = _corners(polygons)
    middle = (corners.min(0) + corners.max(0)) / 2
    if degrees:
        origin = Origin(*(forest.origin or np.round(middle, 6).tolist()))
        polygons = [tuple(local_from_degrees(origin, ring) for ring in polygon) for polygon in polygons]
    else:
        offset = forest.origin_meters or (np.round(middle).tolist() if np.abs(corners).max() > 1e5 else (0.0, 0.0))
        origin = Origin(*(forest.origin or (None, None)), *offset)
        polygons = [tuple(ring - offset for ring in polygon) for polygon in polygons]
    corners = _corners(polygons)
    low, high = corners.min(0), corners.max(0)
    if np.abs(corners).max() > 2e5:
        fail("scatter_area", f"{path} reaches {np.abs(corners).max() / 1000:,.0f} km from the origin, expected at most 200", _HINT)
    return Area(origin, tuple(low.tolist()), tuple(high.tolist()), tuple(polygons))


def scattered(area: Area, config: ScatterConfig, seed: int) -> Iterator[tuple[NDArray[np.void], float]]:
    """Trees on an area as records of the type ``ROW``, and the share of the area that is done.

    Their ``x`` and ``y`` are (east, north) in meters in the local frame. Their species is the number of the entry of the mix, -1 without a
    mix. Raises InputError if the area is too large for the spacing, or has no trees.
    """
    shares = np.cumsum([share for _, share in config.shares])
    count = 0
    for places, done in _strips(np.array(area.low), np.array(area.high), config.spacing, seed):
        if area.polygons:
            inside = np.zeros(len(places), bool)
            for polygon in area.polygons:
                inside |= _inside(places, polygon)
            places = places[inside]
        rows = np.zeros(len(places), ROW)
        for name in ("height", "crown", "turn", "scale"):
            rows[name] = np.nan
        rows["x"], rows["y"], rows["row"] = places[:, 0], places[:, 1], np.arange(count + 1, count + len(places) + 1)
        random = uniform(rows["row"], seed, "mix")
        rows["species"] = np.searchsorted(shares, random * shares[-1], "right") if len(shares) else -1
        count += len(places)
        yield rows, done
    if not count:
        fail("scatter", f"no tree fits on the area with a spacing of {config.spacing:g} m", "give a larger area or a smaller spacing")


def _strips(low: NDArray[np.float64], high: NDArray[np.float64], spacing: float, seed: int) -> Iterator[tuple[NDArray[np.float64], float]]:
    side = spacing / math.sqrt(2)
    columns, rows = (max(1, math.ceil(length / side)) for length in high - low)
    if columns * rows > _MOST_SQUARES or columns > 1 << 20:
        width, depth = high - low
        fail("spacing", f"{spacing:g} m is too small for an area of {width:,.0f} by {depth:,.0f} m", "choose a larger one")
    wide = columns + 4
    points = np.full((_STRIP + 4, wide, 2), np.inf)  # in squares, with two rows of the strip before and two empty ones around
    shifts = np.array([i * wide + j for i, j in _NEAR])
    for start in range(0, rows, _STRIP):
        points[:2], points[2:] = points[-4:-2].copy(), np.inf
        flat = points.reshape(-1, 2)
        random = np.random.default_rng([seed, start])
        for phase in random.permutation(9):
            i, j = np.meshgrid(
                np.arange(phase // 3, min(_STRIP, rows - start), 3), np.arange(phase % 3, columns, 3), indexing="ij", copy=False
            )
            squares = ((i + 2) * wide + j + 2).ravel()
            corners = np.stack([j.ravel(), i.ravel() + start], -1).astype(float)
            for _ in range(_TRIALS):
                tried = corners + random.random(corners.shape)
                fits = np.ones(len(tried), bool)
                for shift in shifts:
                    apart = flat[squares + shift] - tried
                    fits &= apart[:, 0] ** 2 + apart[:, 1] ** 2 >= 2.0
                flat[squares[fits]] = tried[fits]
                squares, corners = squares[~fits], corners[~fits]
        found = points[2:-2, 2:-2].reshape(-1, 2)
        places = low + found[np.isfinite(found[:, 0])] * side
        yield places[(places < high).all(1)], min(1.0, (start + _STRIP) / rows)


def _inside(places: NDArray[np.float64], rings: Sequence[NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Whether points lie in an odd number of the rings of a polygon, [P]."""
    inside = np.zeros(len(places), bool)
    if not len(places):
        return inside
    (x, y), least, most = places.T, places.min(0), places.max(0)
    for ring in rings:
        if (ring.min(0) > most).any() or (ring.max(0) < least).any():
            continue
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, 0), strict=True):
            if max(y0, y1) <= least[1] or min(y0, y1) > most[1]:
                continue
            crosses = (y0 > y) != (y1 > y)
            inside[crosses] ^= x[crosses] < (x1 - x0) * (y[crosses] - y0) / (y1 - y0) + x0
    return inside


def _polygons(path: Path) -> tuple[list[tuple[NDArray[np.float64], ...]], bool]:
    """The polygons of a GeoJSON with their rings, and whether they are in degrees."""
    content = read_json("scatter_area", path)
    with reading("scatter_area", path, _HINT):
        system = (content.get("crs") or {}).get("properties", {})
        name = system.get("name") or (f"EPSG:{system['code']}" if "code" in system else None)
        polygons = [tuple(map(_ring, polygon)) for geometry in _geometries(content) for polygon in _polygons_of(geometry)]
        if not polygons or sum(len(ring) for polygon in polygons for ring in polygon) > _MOST_CORNERS:
            fail("scatter_area", f"{path} has {'no polygons' if not polygons else f'more than {_MOST_CORNERS:,} corners'}", _HINT)
        corners = _corners(polygons)
        try:
            degrees = coordinates_of(name) == "degrees"
        except ValueError as error:
            fail("scatter_area", f"{path} {error}", "export it in EPSG:4326")
        if degrees and not like_degrees(corners):
            fail("scatter_area", f"{path} has corners beyond 180 and 90 degrees", "name the reference system of meters in its member crs")
        if is_projected(name) and like_degrees(corners):
            fail("scatter_area", f"{path} names the system {str(name)[:60]}, and its corners look like degrees", "export it in EPSG:4326")
        if np.abs(corners).max() > 1e8:
            fail("scatter_area", f"{path} has corners beyond 100,000,000 meters", _HINT)
    return polygons, degrees


def _corners(polygons: Sequence[Sequence[NDArray[np.float64]]]) -> NDArray[np.float64]:
    """The corners of all rings, [C, 2]."""
    return np.concatenate([ring for polygon in polygons for ring in polygon])


def _geometries(content: Any) -> Iterator[Any]:
    if content["type"] == "FeatureCollection":
        for feature in content["features"]:
            yield feature["geometry"]
    else:
        yield content["geometry"] if content["type"] == "Feature" else content


def _polygons_of(geometry: Any) -> Iterator[Any]:
    yield from {"Polygon": lambda: [geometry["coordinates"]], "MultiPolygon": lambda: geometry["coordinates"]}[geometry["type"]]()


def _ring(corners: Any) -> NDArray[np.float64]:
    ring = np.array([[number(value, comma=False) for value in corner[:2]] for corner in corners], float)
    if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3:
        raise ValueError("a polygon has fewer than three corners")
    return ring
