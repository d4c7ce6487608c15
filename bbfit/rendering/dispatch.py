"""Public renderer of billboard clouds."""

from __future__ import annotations

import torch
from torch import Tensor

from bbfit.checks import check_choice, fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.operators.config import Backend
from bbfit.operators.drawing.reference import render_reference
from bbfit.operators.shading.reference import shade_reference, texture_lights


def render(cloud: BillboardCloud, camera: Camera, *, light: Light | None = None, backend: Backend = "auto") -> Tensor:
    """Draw a billboard cloud, differentiably in its texels, its maps and its placement.

    Parameters
    ----------
    cloud
        N >= 0 billboards.
    camera
        One camera or V cameras.
    light
        For a cloud with maps: the light of each view, or one light for all. Default: ``cloud.light``. Without maps, the light is in the
        texels, and there may be none.
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
    if cloud.surface is not None:
        baked = lit(cloud, camera, light, backend=backend)
        pictures = [render(each, one, backend=backend) for each, one in zip(baked, _each(camera.batch()), strict=True)]
        return torch.stack(pictures) if camera.batched else pictures[0]
    if light is not None:
        fail("light", "the light of this cloud is baked into its texels", "leave it out, or fit maps")
    if _in_torch(cloud, backend):
        return render_reference(cloud, camera)
    from bbfit.operators.drawing.fused import render_fused  # warp takes a while to start

    return render_fused(cloud, camera).to(cloud.texels.dtype)


def lit(cloud: BillboardCloud, camera: Camera, light: Light | None = None, *, backend: Backend = "auto") -> list[BillboardCloud]:
    """What each of V views shows of a cloud with maps: a cloud without maps, in whose texels the light is. Arguments as for :func:`render`.

    Texels are shaded (:func:`~bbfit.operators.shading.reference.shade_reference`), and then filtered. A graphics card filters the maps, and
    then shades.
    """
    views = len(camera.batch())
    light = cloud.light if light is None else light
    assert cloud.surface is not None and light is not None
    lights = texture_lights(cloud, camera, light[[0] * views] if len(light) == 1 else light)
    if _in_torch(cloud, backend):
        return [cloud.baked(shade_reference(cloud.texels, cloud.surface, each)) for each in lights]
    from bbfit.operators.shading.fused import shade_fused  # warp takes a while to start

    return [cloud.baked(shade_fused(cloud.texels, cloud.surface, each).to(cloud.texels.dtype)) for each in lights]


def _in_torch(cloud: BillboardCloud, backend: Backend) -> bool:
    return backend == "reference" or (backend == "auto" and cloud.texels.dtype == torch.float64)


def _each(cameras: Camera) -> list[Camera]:
    return [cameras[index] for index in range(len(cameras))]
