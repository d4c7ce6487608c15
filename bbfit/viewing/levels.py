"""Levels of detail: from which size on the screen each is shown."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.evaluation.silhouettes import scale_within, worst_silhouette
from bbfit.exporting.config import LodConfig
from bbfit.fitting.initialize import pixels_a_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.views import ViewSet

# Textures are halved for far trees until their shortest side is this long, and so often at most.
_LEAST_SIDE, _MOST_HALVINGS = 24, 4
_MARKS = itertools.count()


@dataclass(frozen=True)
class Level:
    """One level of detail."""

    cloud: BillboardCloud | None
    """Its billboards; ``None`` for the tree itself."""
    scale: float | None
    """Pixels a meter on the screen below which it is shown: infinity for the finest level, ``None`` if that is not known."""
    halvings: int = 0
    """How often the sides of its textures are halved."""
    mark: int = field(default_factory=lambda: next(_MARKS), compare=False)
    """Tells billboards from all others; copies keep it."""

    @property
    def name(self) -> str:
        """What the page calls it."""
        if self.cloud is None:
            return "original"
        return f"{len(self.cloud)} billboard{'s' if len(self.cloud) > 1 else ''}"

    def distance(self, focal: float) -> float | None:
        """Distance in meters from which on it is shown by a camera of a focal length in pixels; ``None`` if that is not known."""
        return None if self.scale is None else focal / self.scale


def choose_level(levels: Sequence[Level], scale: float) -> int:
    """Which level is shown at so many pixels a meter: the coarsest that may be; those not known are passed over.

    ``levels`` stand finest first.
    """
    return max((index for index, level in enumerate(levels) if level.scale is not None and scale < level.scale), default=0)


def choose_levels(levels: Sequence[Level], scales: NDArray[np.floating]) -> NDArray[np.int64]:
    """:func:`choose_level` for many trees at once: pixels a meter [N] to indices [N]."""
    chosen = np.zeros(len(scales), np.int64)
    for index, level in enumerate(levels):
        if level.scale is not None:
            chosen[scales < level.scale] = index
    return chosen


def field_levels(levels: Sequence[Level]) -> tuple[Level, ...]:
    """The levels of trees in a field, finest first: the billboards alone, and for far trees the last with halved textures.

    A texture is halved from where it keeps a texel for each pixel.
    """
    clouds = [level for level in levels if level.cloud is not None]
    found = [replace(clouds[0], scale=math.inf, halvings=0)]
    found += [level for level in clouds[1:] if level.scale is not None]
    last = found[-1]
    assert last.cloud is not None and last.scale is not None
    density, shortest = last.cloud.texel_density, int(last.cloud.texture_sizes.min())
    for halvings in range(last.halvings + 1, _MOST_HALVINGS + 1):
        if shortest >> halvings < _LEAST_SIDE:
            break
        found.append(replace(last, scale=min(density / 2**halvings, last.scale), halvings=halvings))
    return tuple(found)


def takes_over(cloud: BillboardCloud, views: ViewSet, stop: Callable[[], bool] = lambda: False) -> float:
    """Pixels a meter below which a cloud's silhouette is off by less than a pixel in the training view in which it is worst.

    Never more than in the views: larger than that it was not measured. Once ``stop`` says so, no more views are looked at.
    """
    scale = float(pixels_a_meter(views.cameras))
    return min(scale, scale_within(worst_silhouette(cloud, views, stop=stop) / scale, LodConfig().error_pixels))
