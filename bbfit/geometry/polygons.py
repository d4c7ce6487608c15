"""Convex polygons in the plane, as arrays of their corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def following(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corner after each one, [K, D] -> [K, D]. For small arrays ``np.roll`` takes several times as long."""
    return np.concatenate([corners[1:], corners[:1]])


def sides(polygon: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit normals n, [K, 2], and offsets d, [K], of a convex polygon's sides: inside is n . p <= d. For either winding."""
    along = following(polygon) - polygon
    length = np.linalg.norm(along, axis=-1)
    kept = length > 1e-12 * length.max()  # a doubled corner has no side
    normals = np.stack([along[:, 1], -along[:, 0]], -1)[kept] / length[kept, None]
    normals = normals if area(polygon) > 0 else -normals
    return normals, (normals * polygon[kept]).sum(-1)


def area(polygon: NDArray[np.float64]) -> float:
    """Signed area of a polygon [K, 2]; positive if its corners turn from x to y."""
    x, y = (polygon - polygon[0]).T
    return 0.5 * float(x @ following(y) - y @ following(x))


def kept_half(polygon: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a convex polygon [K, D] where a linear function with given values at the corners is at most 0, [L, D].

    This is one step of the clipping of Sutherland and Hodgman (1974, "Reentrant polygon clipping").
    """
    made = []
    for here, there, low, high in zip(polygon, following(polygon), heights, following(heights), strict=True):
        if low <= 0:
            made.append(here)
        if (low < 0 < high) or (high < 0 < low):
            made.append(here + (there - here) * (low / (low - high)))
    return np.array(made).reshape(-1, polygon.shape[1])
