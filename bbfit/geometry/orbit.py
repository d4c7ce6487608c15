"""Rings of cameras around a tree, framed so that every vertex is in every picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import check_count, check_range, fail
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics

# Weight of the ring nearest to the horizon, where people are, among rings of cameras (docs/results.md, "From above").
_EYE_LEVEL = 3.0
# No vertex is nearer to a camera, and no orthographic image narrower, than this share of the tree's radius.
NEAREST = 1e-3


@dataclass(frozen=True)
class Orbit:
    """Camera directions on horizontal rings around a vertical axis.

    Azimuth 0 looks from +Z; azimuths grow counter-clockwise seen from above, so 90 degrees looks from +X.
    """

    count: int = 90
    """Number of views, divided among the rings in proportion to the square roots of their circumferences: in proportion to the
    circumferences, a fit to a dome is visibly worse at 60 degrees than at eye level. The ring nearest to the horizon counts three times."""
    elevations_degrees: tuple[float, ...] = (0.0,)
    """Elevation of each ring, in [-90, 90]."""

    def __post_init__(self) -> None:
        if not self.elevations_degrees:
            fail("elevations", "expected at least one ring")
        check_count("count", self.count, len(self.elevations_degrees))
        for elevation in self.elevations_degrees:
            check_range("elevations", elevation, -90, 90)

    @property
    def ring_counts(self) -> tuple[int, ...]:
        """Number of views on each ring, at least one, by the method of largest remainders."""
        heights = np.abs(self.elevations_degrees)
        weights = np.sqrt(np.cos(np.radians(heights)).clip(1e-18)) * np.where(heights == heights.min(), _EYE_LEVEL, 1)
        quotas = (self.count - len(weights)) * weights / weights.sum()  # one of each ring's views is certain
        counts = 1 + np.floor(quotas + 1e-9).astype(int)
        largest = np.argsort(-(quotas - (counts - 1)).round(9), kind="stable")[: self.count - counts.sum()]
        counts[largest] += 1
        return tuple(counts.tolist())

    @property
    def angles_degrees(self) -> NDArray[np.float64]:
        """Azimuth and elevation of every view, [V, 2]; rings one after another, successive rings turned by half a step."""
        rows = []
        for ring, (n, elevation) in enumerate(zip(self.ring_counts, self.elevations_degrees, strict=True)):
            azimuth = (np.arange(n) + 0.5 * (ring % 2)) * 360.0 / n
            rows.append(np.stack([azimuth, np.full(n, float(elevation))], -1))
        return np.concatenate(rows)

    @property
    def directions(self) -> Tensor:
        """Unit vectors from the target towards each camera, [V, 3] float64."""
        azimuth, elevation = torch.from_numpy(np.radians(self.angles_degrees)).unbind(-1)
        return torch.stack([elevation.cos() * azimuth.sin(), elevation.sin(), elevation.cos() * azimuth.cos()], -1)

    def frame(
        self,
        points: NDArray[np.floating],
        *,
        target: Tensor,
        width: int,
        height: int,
        fov_x_degrees: float | None = 40.0,
        margin: float = 0.02,
    ) -> Camera:
        """Cameras of one distance (or one scale) at which every point lies inside every image.

        Parameters
        ----------
        points
            Vertices in meters, [P, 3].
        target
            Point that the cameras look at, [3].
        width, height
            Size of the images in pixels.
        fov_x_degrees
            Horizontal field of view in (0, 170]; ``None`` for orthographic cameras.
        margin
            Share of the image kept free on each side, in [0, 0.4].

        Returns
        -------
        Camera
            V = ``count`` views, float64.

        Raises
        ------
        InputError
            If there are no points, a coordinate is not finite, or all points lie at the target.
        """
        check_range("margin", margin, 0, 0.4)
        if not len(points) or not np.isfinite(points).all():
            fail("points", "expected finite coordinates of at least one vertex", "check the mesh")
        direction = self.directions
        rotation = look_at(target + direction, target)[:, :3, :3].numpy()
        # Only hull vertices can touch the frame; the hull of a million-vertex tree has a few hundred.
        relative = hull_vertices(np.asarray(points, dtype=np.float64)) - target.numpy()
        local = np.einsum("vij,pj->vpi", rotation, relative)
        aspect = height / width
        radius = float(np.linalg.norm(relative, axis=-1).max())
        if radius == 0:
            fail("points", "all vertices lie in one point", "check the mesh")
        lateral = np.maximum(np.abs(local[..., 0]), np.abs(local[..., 1]) / aspect) / (1 - 2 * margin)
        if fov_x_degrees is None:
            extent = max(2 * float(lateral.max()), NEAREST * radius)
            distance = 2 * radius
            intrinsics = orthographic_intrinsics(extent, width, height)
        else:
            check_range("fov_degrees", fov_x_degrees, 0, 170, open_low=True)
            slope = math.tan(math.radians(fov_x_degrees) / 2)
            distance = float((np.maximum(lateral / slope, NEAREST * radius) - local[..., 2]).max())
            intrinsics = pinhole_intrinsics(fov_x_degrees, width, height)
        views = len(direction)
        return Camera(
            look_at(target + distance * direction, target),
            intrinsics.repeat(views, 1, 1),
            width,
            height,
            fov_x_degrees is None,
        )


def hull_vertices(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The vertices of the convex hull of points, [P, 3], which bound them in every picture.

    Barber et al. 1996, "The Quickhull Algorithm for Convex Hulls". Of a flat or tiny set, which has no three-dimensional hull, all points
    are kept.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 8:
        return points
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points
