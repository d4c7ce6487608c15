"""Where the vertices of a tree may be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.inputs import LARGEST, SMALLEST


def check_points(path: Path, points: NDArray[np.floating]) -> None:
    """Require positions in meters, [P, 3], that are finite, near the origin and not all in one place."""
    check_finite(path, points)
    if len(points):
        check_box(path, points.min(0).astype(np.float64), points.max(0).astype(np.float64))


def check_finite(path: Path, points: NDArray[np.floating]) -> None:
    """Require positions, of any shape, without NaN and infinities."""
    if not np.isfinite(points).all():
        fail("tree", f"{path} has vertices that are NaN or infinite", "export the tree again")


def check_box(path: Path, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """Require corners of a tree's bounding box in meters, [3] each, that are near the origin, and neither too close nor too far apart."""
    farthest, size = float(np.maximum(np.abs(low), np.abs(high)).max()), float((high - low).max())
    if not farthest <= LARGEST:
        fail("tree", f"{path} reaches {farthest:.3g} meters from the origin, more than {LARGEST:g}", "export the tree in meters")
    if not size >= SMALLEST:
        fail("tree", f"{path} has zero size or is smaller than {SMALLEST:g} meters", "export the tree again, at its real size")
