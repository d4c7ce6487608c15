"""Public renderer of billboard clouds."""

from __future__ import annotations

import torch
from torch import Tensor

from bbfit.checks import check_choice
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.config import Backend
from bbfit.operators.drawing.reference import render_reference


def render(cloud: BillboardCloud, camera: Camera, *, backend: Backend = "auto") -> Tensor:
    """Draw a billboard cloud, differentiably in its texels and its placement.

    Parameters
    ----------
    cloud
        N >= 0 billboards.
    camera
        One camera or V cameras.
    backend
        ``fused``: Warp kernels in float32; ``reference``: kornia and autograd in any precision; ``auto``: the reference for a float64
        cloud and the kernels for any other.

    Returns
    -------
    Tensor
        Premultiplied RGBA in [0, 1], [H, W, 4] for one camera and [V, H, W, 4] for a batch, in the cloud's dtype and on its device;
        defined by :func:`bbfit.operators.drawing.reference.render_reference`.
    """
    check_choice("backend", backend, ("auto", "reference", "fused"))
    if backend == "reference" or (backend == "auto" and cloud.texels.dtype == torch.float64):
        return render_reference(cloud, camera)
    from bbfit.operators.drawing.fused import render_fused  # warp takes a while to start

    return render_fused(cloud, camera).to(cloud.texels.dtype)
