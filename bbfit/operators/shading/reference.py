"""Shading of texels in torch: what a program computes from the maps of a billboard, before filtering."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import check_shape
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import signed_distance
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


def textures_of_texels(cloud: BillboardCloud) -> Tensor:
    """Index of each texel's texture, int32 [P]: a one-sided billboard has one texture, a two-sided one has a front and then a back."""
    counts = cloud.texture_sizes.prod(-1)[billboards_of_textures(cloud)]
    return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts).to(torch.int32)


def billboards_of_textures(cloud: BillboardCloud) -> Tensor:
    """Index of each texture's billboard, int64 [T]."""
    return torch.repeat_interleave(1 + cloud.two_sided.long())


def shown_sides(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """1 for each texture that shows the front of its billboard to each of V cameras, and -1 for one that shows the back, [V, T].

    The texture of a one-sided billboard shows the side that the camera is on.
    """
    owner = billboards_of_textures(cloud)
    is_back = torch.zeros_like(owner, dtype=torch.bool)
    is_back[1:] = owner[1:] == owner[:-1]
    front = torch.where(cloud.two_sided[owner], ~is_back, signed_distance(cloud, camera)[:, owner] >= 0)
    return torch.where(front, 1.0, -1.0).to(cloud.centers)


def texture_lights(cloud: BillboardCloud, camera: Camera, light: Light) -> list[TextureLight]:
    """The light of each of V views of a cloud; ``light`` has V lights.

    From behind, only the component of a normal along the plane's normal turns, so that a leaf that looks up does so from both sides.
    """
    check_shape("light", (len(light),), (len(camera.batch()),))
    device, dtype = cloud.centers.device, cloud.centers.dtype
    suns, sides = light.sun_directions.to(dtype).to(device), shown_sides(cloud, camera.to(dtype).to(device))
    along = [suns @ axes[billboards_of_textures(cloud)].mT for axes in (cloud.rights, cloud.ups, cloud.normals)]
    of_textures = torch.stack([*along[:2], sides * along[2]], -1)
    strengths = torch.cat([light.sun_colors * light.sun_strengths[:, None] / math.pi, light.ambients[:, None]], -1)
    texture = textures_of_texels(cloud)
    return [TextureLight(texture, *each) for each in zip(of_textures, strengths, strict=True)]
