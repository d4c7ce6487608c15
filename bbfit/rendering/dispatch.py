"""Choosing a renderer."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from bbfit.checks import check_choice
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.reference import render_reference

Backend = Literal["auto", "reference"]


def render(cloud: BillboardCloud, camera: Camera, *, backend: Backend = "auto") -> Tensor:
    """Draw a billboard cloud, differentiably in its texels and its placement.

    Parameters
    ----------
    cloud : N billboards, N >= 0.
    camera : one camera, or V of them.
    backend : ``"reference"``, or ``"auto"`` for the fastest one that is there.

    Returns
    -------
    Premultiplied RGBA over nothing in [0, 1], [H, W, 4] for one camera and [V, H, W, 4] for a batch, in the cloud's dtype and on its
    device. See :func:`bbfit.rendering.reference.render_reference` for what it means.
    """
    check_choice("backend", backend, ("auto", "reference"))
    return render_reference(cloud, camera)
