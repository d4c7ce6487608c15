"""From longitude and latitude to the local frame in meters, and from there to the Earth.

The local frame is the plane that touches the ellipsoid WGS 84 at the origin: +X is east, -Z north, +Y up. A tree's place on it is the
parallel projection of its place on the ellipsoid along the origin's vertical. At 10 km from the origin, distances on it are 1.2 mm shorter
each kilometer than on the ground. Programs that show a globe need the way back: where the vertical meets the ellipsoid.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.forest.columns import Coordinates

# A code, as in EPSG:4326, urn:ogc:def:crs:EPSG::4326, urn:ogc:def:crs:EPSG:9.9.1:4326 and http://www.opengis.net/def/crs/EPSG/0/4326.
_CODE = r"(?:EPSG|ESRI)(?:[:/][\d.]*)?[:/]"
_CODES = re.compile(_CODE, re.IGNORECASE)
_DEGREES = re.compile(rf"CRS8[34]|{_CODE}(?:4326|4258|4269|4267|4283|7844|4674|4171|4490|4230)(?!\d)", re.IGNORECASE)
# Web Mercator, whose meters are longer than those on the ground, and the frame of the whole Earth.
_NO_METERS = re.compile(rf"{_CODE}(?:3857|3785|900913|102100|102113|4978)(?!\d)", re.IGNORECASE)
# The ellipsoid of WGS 84: half the axes, in meters.
_A, _B = 6378137.0, 6356752.314245179
_SQUARES = np.array([_A * _A, _A * _A, _B * _B])
# From glTF's axes (east, up, south) to those of tiles (east, north, up).
TO_TILES = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Turns glTF's axes (Y up) to those of 3D Tiles (Z up), [3, 3]."""


def coordinates_of(system: str | None) -> Coordinates | None:
    """The unit of the coordinates of a GeoJSON whose member ``crs`` names a system, or of one without it (RFC 7946, section 4).

    ``None`` for a projected system, whose unit is most often the meter, and for one that is not known. Raises ``ValueError`` for a system
    whose unit is not a meter on the ground.
    """
    if system is None or _DEGREES.search(system):
        return "degrees"
    if _NO_METERS.search(system):
        raise ValueError(f"is in {system[:60]}, whose unit is not the meter on the ground")
    return None


def is_projected(system: str | None) -> bool:
    """Whether a system has a code, and is not known to be one of degrees. The name of a plot says nothing about its coordinates."""
    return system is not None and bool(_CODES.search(system)) and not _DEGREES.search(system)


def like_degrees(places: NDArray[np.float64]) -> bool:
    """Whether coordinates, [P, 2], may be longitudes and latitudes."""
    return bool((np.abs(places) <= [180, 90]).all())


@dataclass(frozen=True)
class Origin:
    """Where the local frame's origin is."""

    longitude: float | None = None
    """Degrees east; ``None`` for plain meters, whose place on the Earth is not known."""
    latitude: float | None = None
    """Degrees north, or ``None``."""
    east: float = 0.0
    """Meters that were subtracted from projected coordinates; 0 for degrees."""
    north: float = 0.0
    """Meters that were subtracted from projected coordinates; 0 for degrees."""

    @property
    def on_earth(self) -> bool:
        """Whether its place on the Earth is known."""
        return self.longitude is not None and self.latitude is not None


def kilometers_on_earth(places: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of longitudes and latitudes, [P, 2], from others, [P, 2] or [1, 2], straight through the Earth, in kilometers, [P]."""
    distances: NDArray[np.float64] = np.linalg.norm(_on_ellipsoid(places) - _on_ellipsoid(others), axis=-1) / 1000
    return distances


def earth_matrix(origin: Origin) -> NDArray[np.float64]:
    """From (east, north, up) at the origin to the Earth's axes (ECEF), [4, 4]; the identity if its place is not known."""
    matrix = np.eye(4)
    if origin.on_earth:
        place = np.array([[origin.longitude, origin.latitude]])
        matrix[:3, :3], matrix[:3, 3] = _axes(place)[0].T, _on_ellipsoid(place)[0]
    return matrix


def local_from_degrees(origin: Origin, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longitudes and latitudes, [P, 2], as (east, north) of the local frame in meters, [P, 2]."""
    center = np.array([[origin.longitude, origin.latitude]])
    return (_on_ellipsoid(places) - _on_ellipsoid(center)) @ _axes(center)[0, :2].T


def on_globe(origin: Origin, positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions of the local frame on the Earth: (east, north, up) at the origin, [P, 3], and the directions up there, [P, 3].

    ``positions`` have glTF's axes, [P, 3]; their Y is the height above the ellipsoid. Without a place on the Earth, they are just turned.
    """
    turned = positions @ TO_TILES.T
    if not origin.on_earth:
        return turned, np.tile([0.0, 0, 1], (len(positions), 1))
    to_earth = earth_matrix(origin)
    flat = turned * [1, 1, 0] @ to_earth[:3, :3].T + to_earth[:3, 3]
    axis = to_earth[:3, 2]
    # Where flat + t axis is on the ellipsoid: a t² + 2 b t + c = 0; the upper of both places.
    a, b, c = np.sum(axis * axis / _SQUARES), flat / _SQUARES @ axis, np.sum(flat * flat / _SQUARES, -1) - 1
    below = -c / (b + np.sqrt(np.maximum(b * b - a * c, 0)))
    normals = (flat + below[:, None] * axis) / _SQUARES
    up = normals / np.linalg.norm(normals, axis=-1, keepdims=True) @ to_earth[:3, :3]
    return turned * [1, 1, 0] + below[:, None] * [0, 0, 1] + turned[:, 2:] * up, up


def _on_ellipsoid(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the ellipsoid's surface, [P, 3], at longitudes and latitudes, [P, 2]."""
    up = _axes(places)[:, 2]
    scaled = up * _SQUARES
    return scaled / np.sqrt(np.sum(scaled * up, -1, keepdims=True))


def _axes(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vectors east, north and up at longitudes and latitudes, [P, 3, 3]."""
    longitudes, latitudes = np.radians(places).T
    zeros, cos, sin = np.zeros(len(places)), np.cos, np.sin
    east = [-sin(longitudes), cos(longitudes), zeros]
    north = [-sin(latitudes) * cos(longitudes), -sin(latitudes) * sin(longitudes), cos(latitudes)]
    up = [cos(latitudes) * cos(longitudes), cos(latitudes) * sin(longitudes), sin(latitudes)]
    return np.moveaxis(np.array([east, north, up]), 2, 0)
