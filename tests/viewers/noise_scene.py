"""Clouds of smooth noise, and what the independent viewer makes of their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from glb_viewer import view_glb
from numpy.typing import NDArray

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud

# Texels between the random values that noise is interpolated from.
GRAIN = 8


def noise_cloud(count: int, *, texels: int, two_sided: bool = False) -> BillboardCloud:
    """Squares of 2 x 2 meters that cross near (0, 1, 0), turned about the vertical and leaning a little; float64.

    Color and alpha are smooth noise; alpha passes through 1/2 on long curves and is 0 or 1 in parts.
    """
    generator = torch.Generator().manual_seed(0)

    def texture() -> torch.Tensor:
        coarse = torch.rand(1, 4, texels // GRAIN + 1, texels // GRAIN + 1, generator=generator, dtype=torch.float64)
        fine = torch.nn.functional.interpolate(coarse, (texels, texels), mode="bicubic", align_corners=True)[0]
        fine[3] = 2 * fine[3] - 0.5
        return fine.clamp(0, 1).permute(1, 2, 0).reshape(-1, 4)

    azimuth = 0.05 + torch.arange(count, dtype=torch.float64) * torch.pi / count
    lean = 0.3 * (torch.rand(count, generator=generator, dtype=torch.float64) - 0.5)
    level = torch.zeros_like(azimuth)
    outward = torch.stack([azimuth.sin(), level, azimuth.cos()], -1)
    return BillboardCloud(
        centers=torch.tensor([0.0, 1.0, 0.0]) + 0.3 * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5),
        rights=torch.stack([azimuth.cos(), level, -azimuth.sin()], -1),
        ups=lean.sin()[:, None] * outward + lean.cos()[:, None] * torch.tensor([0.0, 1.0, 0.0]),
        half_extents=torch.ones(count, 2, dtype=torch.float64),
        texture_sizes=torch.full((count, 2), texels),
        two_sided=torch.full((count,), two_sided),
        texels=torch.cat([texture() for _ in range(count * (1 + two_sided))]),
    )


def expected(glb: Path, camera: Camera) -> NDArray[np.float64]:
    """The independent viewer's pictures over white, [V, H, W, 3]; a view that shows next to nothing would prove nothing."""
    images = np.stack([view_glb(glb, camera[index]) for index in range(len(camera))])
    assert images[..., 3].mean(axis=(1, 2)).min() > 0.01
    return images[..., :3] + 1 - images[..., 3:]
