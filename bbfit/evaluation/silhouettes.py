"""The error of a model's silhouette, and the scale up to which it stays invisible."""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor

from bbfit.evaluation.metrics import silhouette_distance
from bbfit.evaluation.scoring import held_out
from bbfit.geometry.camera import Camera
from bbfit.views.view_set import ViewSet

# Errors are a little larger between the training views than in them: for four clouds of an acer by up to 11 % in the worst held-out view.
_MARGIN = 1.15


def worst_silhouette(draw: Callable[[Camera], Tensor], views: ViewSet, *, stop: Callable[[], bool] = lambda: False) -> float:
    """The largest :func:`~bbfit.evaluation.metrics.silhouette_distance` between a model and a view, in pixels; 0 without views.

    ``draw`` is as for :func:`~bbfit.evaluation.scoring.held_out`. ``stop`` is called before each view. Once it returns True, the remaining
    views are left out.
    """
    worst = 0.0
    for index in range(len(views)):
        if stop():
            break
        target, render = (picture.numpy() for picture in held_out(draw, views, index))
        worst = max(worst, silhouette_distance(target, render))
    return worst


def scale_within(error: float, error_pixels: float) -> float:
    """The largest scale, in pixels per meter, that keeps an error within ``error_pixels`` pixels, also between the training views.

    ``error`` is in meters, measured in the training views.
    """
    return error_pixels / (_MARGIN * error) if error else math.inf
