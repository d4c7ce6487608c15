"""Tiny scenes with a known answer: two crossing billboards and a views folder that holds exactly what they look like; a lit column."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.light import Light
from bbfit.geometry.orbit import Orbit
from bbfit.images import to_bytes, unpremultiply, write_png
from bbfit.layout import write_transforms
from bbfit.rendering.dispatch import render
from bbfit.views.dataset import ViewDataset


def crossing_billboards(count: int = 2) -> BillboardCloud:
    """Upright billboards of 2 x 3 meters with blotches of random color and alpha, float32."""
    cloud = even_upright(
        count,
        axis=torch.tensor([0.0, 1.5, 0.0]),
        half_extents=torch.tensor([1.0, 1.5]),
        texture_sizes=torch.tensor([12, 8]),
    )
    return cloud.with_texels(torch.rand(cloud.texels.shape, generator=torch.Generator().manual_seed(1)))


def framed_billboards() -> BillboardCloud:
    """The crossing billboards with transparent rims of one color, so that files show what fits draw: they mix in other colors beyond rims,
    and samples of a pixel smooth an outline that is not transparent."""
    cloud = crossing_billboards()
    texels = torch.tensor([128 / 255, 0.2, 0.6, 1.0]).repeat(2, 12, 8, 1)
    texels[:, [0, -1], :, 3], texels[:, :, [0, -1], 3] = 0, 0
    texels[:, 2:-2, 2:-2] = cloud.texels.unflatten(0, (2, 12, 8))[:, 2:-2, 2:-2]
    return cloud.with_texels(texels.flatten(0, 2))


def column(light: Light, color: tuple[float, float, float] = (0.6, 0.5, 0.3)) -> BillboardCloud:
    """A billboard that looks to +Z, 2 x 3 meters, of one color, with the normals of an upright cylinder: at its left they point left."""
    plane = even_upright(1, axis=torch.tensor([0.0, 1.5, 0.0]), half_extents=torch.tensor([1.0, 1.5]), texture_sizes=torch.tensor([48, 36]))
    across = 0.95 * torch.linspace(-1, 1, 36).repeat(48)
    surface = torch.stack([(across + 1) / 2, torch.full_like(across, 0.5), torch.ones_like(across), torch.zeros_like(across)], -1)
    return replace(plane, texels=torch.tensor([*color, 1.0]).repeat(len(across), 1), surface=surface, light=light)


def write_views(folder: Path, cloud: BillboardCloud, *, count: int = 8, width: int = 40, height: int = 32) -> ViewDataset:
    """Render views at azimuths k * 360 / count into a folder; every other one, from the first, is a test view."""
    corners = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (0.0, 3.0) for z in (-1.0, 1.0)])
    target = torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64)
    camera = Orbit(count).frame(corners.double().numpy(), target=target, width=width, height=height)
    for index, image in enumerate(render(cloud, camera)):
        write_png(folder / f"{index:04d}.png", to_bytes(unpremultiply(image)))
    names = [f"{index:04d}.png" for index in range(count)]
    write_transforms(folder, camera, names, list(range(1, count, 2)), list(range(0, count, 2)))
    return ViewDataset.load(folder)
