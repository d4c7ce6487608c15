"""From which distances a model looks like its tree: a verdict from its silhouettes and from its density in small pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bbfit.exporting.config import LodConfig
from bbfit.geometry.camera import focal_pixels

SCREEN = LodConfig()
"""The screen: 1080 lines with a vertical field of view of 50 degrees, and an error of at most one pixel, as in levels of detail."""
MOST_OFF = 0.2
"""Largest relative error of coverage at which a small picture still counts as equally dense."""


@dataclass(frozen=True)
class Distances:
    """The distances between which a model looks like its tree, in meters from the tree's axis, on the screen :data:`SCREEN`."""

    silhouette_pixels: float
    """Error of the silhouette (:func:`bbfit.evaluation.metrics.silhouette_distance`) in the worst held-out view, in pixels of the view."""
    near_meters: float
    """From here on this error is at most a pixel of the screen. Never nearer than the views show the tree: that was not measured."""
    far_meters: float | None
    """Up to here the model is as dense as the tree, within :data:`MOST_OFF`. ``None`` if it is so in the smallest pictures too, and 0 if
    it is so in none."""

    @property
    def good(self) -> bool:
        """Whether there is a distance at which the model looks like the tree."""
        return self.far_meters is None or self.far_meters >= self.near_meters

    @property
    def verdict(self) -> str:
        """The verdict in a sentence, and what to do next."""
        screen, size = f"on a screen of {SCREEN.screen_height} lines", f"{self.near_meters:.3g} m"
        if not self.good:
            said = f"Not right at any distance {screen}: outlines are right to a pixel from {size} on"
            return f"{said}, but its density is off there. Try another --alpha, or --textures ktx2."
        said = f"Outlines, to a pixel, and density are right from {size}"
        if self.far_meters is None:
            said += f" {screen}."
        else:
            said += f" to {self.far_meters:.3g} m {screen}. From afar, --textures ktx2 has mip levels that keep the density."
        if self.silhouette_pixels <= SCREEN.error_pixels:
            return f"{said} The views do not show it closer: for that, render them larger (--size)."
        return f"{said} For closer views, allow more --billboards, or make levels with bbfit lod."


def viewing_distances(silhouette_pixels: float, pixels_per_meter: float, coverages: Sequence[tuple[int, float | None]]) -> Distances:
    """The verdict on a model.

    ``silhouette_pixels`` is the error in the worst held-out view, and ``pixels_per_meter`` the scale of these views at the tree's axis
    (:func:`bbfit.fitting.initialize.pixels_per_meter`), above 0. ``coverages`` are the widths in pixels of smaller and smaller pictures,
    the largest first, at least one, with the ratio of the model's coverage to the tree's (:class:`~bbfit.evaluation.report.SizeScore`). A
    picture of half the size shows the tree as from twice the distance.
    """
    nearest = focal_pixels(SCREEN.screen_height, SCREEN.screen_fov_degrees) / pixels_per_meter
    far = list[float]()
    for width, coverage in coverages:
        if coverage is None or abs(coverage - 1) > MOST_OFF:
            break
        far.append(nearest * coverages[0][0] / width)
    reached = None if len(far) == len(coverages) else max(far, default=0.0)
    return Distances(silhouette_pixels, nearest * max(1.0, silhouette_pixels / SCREEN.error_pixels), reached)
