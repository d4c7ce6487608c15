"""What the stages before a fit must give it, derived from their options before anything is rendered."""

from __future__ import annotations

from itertools import count

import torch

from bbfit.blender.config import ViewsConfig
from bbfit.budget.choice import LEAST_VIEWS, validation_split
from bbfit.fitting.config import FitConfig
from bbfit.fitting.requirements import check_cameras
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.layout import split_rings, split_views


def check_planned_views(views: ViewsConfig, fit: FitConfig, *, mesh: bool, budget: bool) -> None:
    """Require that views that are not rendered yet will suffice for a fit, on a ``mesh`` or without one, and for trials of a ``budget``."""
    cameras = planned_cameras(views)
    if all(abs(elevation) == 90 for elevation in views.rings):
        hint = "add a ring around the tree, as in --elevations 0 90"
    else:
        hint = f"give a larger --count than {views.count}"
    check_training(cameras, fit, mesh=mesh, budget=budget, hint=hint)


def check_training(cameras: Camera, fit: FitConfig, *, mesh: bool, budget: bool, hint: str = "") -> None:
    """Require that V training cameras suffice, as :func:`check_planned_views`. ``hint`` says what to do if not."""
    check_cameras(cameras, fit, mesh=mesh, hint=hint)
    if budget:
        enough = next(number for number in count(2) if len(split_views(number, 0)[0]) >= LEAST_VIEWS)
        fitted, _ = validation_split(len(cameras), hint and f"give a --count of at least {enough}")
        check_cameras(cameras[fitted], fit, mesh=mesh, hint=hint)


def planned_cameras(config: ViewsConfig) -> Camera:
    """The training cameras of views that are not rendered yet, at a distance of one meter."""
    directions = config.orbit.directions[split_rings(config.orbit.ring_counts, config.seed)[0]]
    intrinsics = pinhole_intrinsics(config.fov_degrees, config.size, config.size).repeat(len(directions), 1, 1)
    transforms = look_at(directions, torch.zeros(3, dtype=directions.dtype))
    return Camera(transforms, intrinsics, config.size, config.size, config.orthographic)
