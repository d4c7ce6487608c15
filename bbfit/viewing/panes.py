"""The page's picture: how it is shared out between two trees, how large a meter is in it, and the slider of distances."""

from __future__ import annotations

import math
from dataclasses import dataclass

STEPS = 200
"""Steps of the slider of distances."""
# How much of a pane a tree takes up at first.
_FILLED = 0.8


@dataclass(frozen=True)
class Picture:
    """The page's picture of the scene, in the browser's pixels."""

    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    fov: float
    """Vertical field of view of each pane, in radians."""
    split: bool
    """Whether two panes share the picture."""

    @property
    def pane(self) -> tuple[float, float]:
        """Width and height of one pane: halves beside each other, or one above the other where the picture is higher than wide."""
        if not self.split:
            return self.width, self.height
        return (self.width / 2, self.height) if self.width >= self.height else (self.width, self.height / 2)

    def pixels_a_meter(self, distance: float) -> float:
        """Pixels that a meter takes up at a distance in meters along the viewing direction."""
        return self.pane[1] / 2 / math.tan(self.fov / 2) / distance

    def distance_to_fit(self, width: float, height: float) -> float:
        """Distance in meters from which something of a width and height in meters fills most of a pane."""
        across, up = self.pane
        return max(height, width * up / max(across, 1.0)) / (2 * _FILLED * math.tan(self.fov / 2))


@dataclass(frozen=True)
class Reach:
    """The slider of distances: equal steps of it are equal factors."""

    nearest: float
    """Distance in meters at the slider's start."""
    farthest: float
    """Distance in meters at its end."""

    def distance(self, step: float) -> float:
        """Distance in meters at a step, 0 to :data:`STEPS`."""
        return self.nearest * (self.farthest / self.nearest) ** (step / STEPS)

    def step(self, distance: float) -> int:
        """The step next to a distance in meters; the first or last one for those beyond."""
        share = math.log(max(distance, self.nearest) / self.nearest) / math.log(self.farthest / self.nearest)
        return min(STEPS, round(share * STEPS))


def meters(distance: float) -> str:
    """A distance as text of about three digits."""
    return f"{distance:.3g} m" if distance < 1000 else f"{distance:,.0f} m"
