"""Shading of texels in torch: what a program computes from the maps of a billboard, before filtering."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import check_shape
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light

LEAST_Z_SQUARED = 1e-4
"""Least square of a normal's component towards the viewer's side, so that its derivative is finite."""


@dataclass(frozen=True)
class TextureLight:
    """The light of one view in the axes of each of the T textures of a cloud."""

    texture: Tensor
    """Index of each texel's texture, int32 [P]."""
    suns: Tensor
    """Direction towards the sun in the axes (right, up, towards the visible side) of each texture, float32 or float64 [T, 3]."""
    strengths: Tensor
    """Linear color of a matte white surface that faces the sun, and under the sky alone, float64 [4], on the CPU."""


def shade_reference(texels: Tensor, surface: Tensor, light: TextureLight) -> Tensor:
    """Shade texels for one view, differentiably in ``texels`` and ``surface``: straight display-referred RGBA, [P, 4].

    A surface is matte (Lambert 1760), and a leaf is thin and transmits light diffusely (glTF, KHR_materials_diffuse_transmission). In
    linear light, a texel of base color b, normal n, occlusion o and translucency t shows

        b (sun ((1 - t) max(n . l, 0) + t max(-n . l, 0)) + sky o),

    where l points towards the sun. Occlusion weakens the sky alone, as glTF prescribes. More than 1 shows as 1, but has the derivative
    that it would have without this limit, or a texel that is too bright could not become darker.

    Parameters
    ----------
    texels
        Base color, display-referred sRGB, and alpha, [P, 4] in [0, 1]. Alpha is passed through.
    surface
        Maps (``BillboardCloud.surface``), [P, 4] in [0, 1].
    light
        The light of the view.
    """
    strengths = light.strengths.to(texels)
    x, y, occlusion, translucency = surface.unbind(-1)
    x, y = 2 * x - 1, 2 * y - 1
    inside = (x * x + y * y).clamp_min(1).rsqrt()
    x, y = x * inside, y * inside
    z = (1 - x * x - y * y).clamp_min(LEAST_Z_SQUARED).sqrt()
    cosine = (torch.stack([x, y, z], -1) * light.suns.to(texels)[light.texture.long()]).sum(-1)
    of_sun = (1 - translucency) * cosine.clamp_min(0) + translucency * (-cosine).clamp_min(0)
    irradiance = of_sun[:, None] * strengths[:3] + (strengths[3] * occlusion)[:, None]
    color = encode(decode(texels[:, :3]) * irradiance)
    return torch.cat([color + (color.clamp_max(1) - color).detach(), texels[:, 3:]], -1)


def decode(value: Tensor) -> Tensor:
    """Display-referred sRGB to linear light (IEC 61966-2-1), differentiably."""
    high = value > 0.04045
    return torch.where(high, ((torch.where(high, value, 1) + 0.055) / 1.055) ** 2.4, value / 12.92)


def encode(value: Tensor) -> Tensor:
    """Linear light to display-referred sRGB (IEC 61966-2-1), differentiably, also above 1."""
    high = value > 0.0031308
    return torch.where(high, 1.055 * torch.where(high, value, 1) ** (1 / 2.4) - 0.055, 12.92 * value)


def texture_lights(cloud: BillboardCloud, camera: Camera, light: Light) -> list[TextureLight]:
    """The light of each of V views of a cloud; ``light`` has V lights.

    The texture of a one-sided billboard shows the side that the camera is on: from behind, only the component of a normal along the plane's
    normal turns, so that a leaf that looks up does so from both sides. A back texture shows the back.
    """
    check_shape("light", (len(light),), (len(camera.batch()),))
    device, dtype = cloud.centers.device, cloud.centers.dtype
    camera, suns = camera.batch().to(dtype).to(device), light.sun_directions.to(dtype).to(device)
    if camera.orthographic:
        facing = -(camera.forward @ cloud.normals.mT)
    else:
        facing = ((camera.position[:, None] - cloud.centers) * cloud.normals).sum(-1)
    sides = torch.where(cloud.two_sided | (facing >= 0), 1.0, -1.0).to(dtype)
    along = suns @ cloud.normals.mT
    front = torch.stack([suns @ cloud.rights.mT, suns @ cloud.ups.mT, sides * along], -1)
    back = torch.stack([front[..., 0], front[..., 1], -along], -1)
    exists = torch.stack([torch.ones_like(cloud.two_sided), cloud.two_sided], -1).flatten()
    of_textures = torch.stack([front, back], 2).flatten(1, 2)[:, exists]
    counts = cloud.texture_sizes.prod(-1).repeat_interleave(1 + cloud.two_sided.long())
    texture = torch.repeat_interleave(torch.arange(len(counts), device=device), counts).to(torch.int32)
    strengths = torch.cat([light.sun_colors * light.sun_strengths[:, None] / math.pi, light.ambients[:, None]], -1)
    return [TextureLight(texture, *each) for each in zip(of_textures, strengths, strict=True)]
