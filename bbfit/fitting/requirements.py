"""What a fit requires of its device and of its training cameras, for checks before long work begins."""

from __future__ import annotations

import torch

from bbfit.checks import InputError, fail
from bbfit.fitting.config import FitConfig
from bbfit.geometry.camera import Camera, convergence_point
from bbfit.views.dataset import ViewDataset

# The devices of the kernels.
_KERNEL_DEVICES = ("cpu", "cuda")


def check_device(config: FitConfig) -> torch.device:
    """Require that torch can compute on the device of a fit, and that its backend runs there. Return the device."""
    name, hint = config.device, "use cpu, or cuda on a machine with a GPU and a CUDA build of torch"
    try:
        torch.zeros(1, device=name).add(1).item()  # the device meta has memory, but no values
        device = torch.device(name)
    except (RuntimeError, AssertionError, ImportError, TypeError):
        fail("device", f"{name!r} is not available", hint)
    if config.backend != "reference" and device.type not in _KERNEL_DEVICES:
        fail("device", f"the kernels do not run on {name!r}", "use cpu, cuda, or --backend reference")
    return device


def check_lights(views: ViewDataset, config: FitConfig) -> None:
    """Require that views show the tree under enough lights for a configuration."""
    if config.light == "maps" and (views.lit_train is None or views.train.light is None):
        fail("light", "maps need views under many lights, and these have one", "render views with --suns 1, or fit with --light baked")


def check_cameras(cameras: Camera, config: FitConfig, *, mesh: bool, hint: str = "") -> None:
    """Require that the training cameras, V of them, determine where the tree is, or that the fit need not know it.

    They do not if all of them look along parallel lines, such as a single camera, two opposite ones, or a ring straight above the tree.
    Parallel projections suffice for clustered billboards on the triangles of a ``mesh``.
    """
    if cameras.orthographic and mesh and config.resolve().placement == "clusters":
        return
    try:
        convergence_point(cameras)
    except InputError:
        count = len(cameras)
        problem = f"all {count} training cameras look along one line" if count > 1 else "there is a single training view"
        fail("views", f"{problem}, so it is not known where the tree is", hint or "give views from around the tree")
