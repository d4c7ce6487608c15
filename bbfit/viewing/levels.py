"""Levels of detail in the viewer: the size on the screen below which each may be shown."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from bbfit.evaluation.silhouettes import scale_within, worst_silhouette
from bbfit.exporting.config import LodConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.views.view_set import ViewSet

# Textures are halved for far trees while their shortest side has this many texels, and at most so often.
_MIN_SIDE, _MAX_HALVINGS = 24, 4


@dataclass(frozen=True)
class ViewerLevel:
    """A level of detail."""

    cloud: BillboardCloud | None
    """Its billboards; ``None`` for the original tree."""
    scale: float | None
    """Pixels per meter on the screen below which it may be shown: infinity for the finest level, ``None`` if that is not known."""
    halvings: int = 0
    """How many times the sides of its textures are halved."""

    @property
    def name(self) -> str:
        """The level's name on the page."""
        if self.cloud is None:
            return "original"
        return f"{len(self.cloud)} billboard{'s' if len(self.cloud) > 1 else ''}"


def field_levels(levels: Sequence[ViewerLevel]) -> tuple[ViewerLevel, ...]:
    """The levels of trees in a field, finest first: all billboards, then the last of them with halved textures for far trees.

    Textures are halved where they still have a texel for each pixel.
    """
    clouds = [level for level in levels if level.cloud is not None]
    chosen = [replace(clouds[0], scale=math.inf, halvings=0)]
    chosen += [level for level in clouds[1:] if level.scale is not None]
    last = chosen[-1]
    assert last.cloud is not None and last.scale is not None
    density, shortest = last.cloud.texel_density, int(last.cloud.texture_sizes.min())
    for halvings in range(last.halvings + 1, _MAX_HALVINGS + 1):
        if shortest >> halvings < _MIN_SIDE:
            break
        chosen.append(replace(last, scale=min(density / 2**halvings, last.scale), halvings=halvings))
    return tuple(chosen)


def largest_scale(cloud: BillboardCloud, views: ViewSet, is_stopped: Callable[[], bool] = lambda: False) -> float:
    """Pixels per meter below which a cloud's silhouette is off by less than a pixel in the worst of the views.

    It is at most the scale of the views: nothing is known of larger sizes. Once ``is_stopped`` returns true, no more views are drawn.
    """
    scale = float(pixels_per_meter(views.cameras))
    return min(scale, scale_within(worst_silhouette(shipped_model(cloud).draw, views, stop=is_stopped) / scale, LodConfig().error_pixels))
