"""How far off a cloud's silhouette is, and from where on that does not show."""

from __future__ import annotations

import math
from collections.abc import Callable

from bbfit.evaluation.metrics import silhouette_distance
from bbfit.evaluation.scoring import held_out
from bbfit.geometry.cloud import BillboardCloud
from bbfit.views import ViewSet

# Between the training views errors are a little larger than in them: of an acer's four clouds by up to 11 % in the worst held-out view.
_MARGIN = 1.15


def worst_silhouette(cloud: BillboardCloud, views: ViewSet, *, stop: Callable[[], bool] = lambda: False) -> float:
    """The largest distance between a cloud's silhouette and that of a view, in pixels of the views; 0 without any.

    It is :func:`~bbfit.evaluation.metrics.silhouette_distance` in the view in which that is most.

    Once ``stop`` says so, no more views are looked at.
    """
    worst = 0.0
    for index in range(len(views)):
        if stop():
            break
        target, render = (picture.numpy() for picture in held_out(cloud, views, index))
        worst = max(worst, silhouette_distance(target, render))
    return worst


def scale_within(error: float, error_pixels: float) -> float:
    """Pixels a meter up to which an error in meters, measured in training views, stays within so many pixels, also between those views."""
    return error_pixels / (_MARGIN * error) if error else math.inf
