"""Clouds and cameras for the export's tests."""

from __future__ import annotations

import pytest
import torch

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit

SIDES = {"one": (False, False, False), "two": (True, True, True), "mixed": (False, True, False)}


@pytest.fixture(scope="session")
def clouds() -> dict[str, BillboardCloud]:
    """One-sided, two-sided and mixed: three tilted, shifted rectangles of different sizes, noise for textures, nothing transparent."""
    generator = torch.Generator().manual_seed(0)
    frames, _ = torch.linalg.qr(torch.randn(3, 3, 3, generator=generator, dtype=torch.float64))
    sizes = torch.tensor([[20, 13], [9, 31], [16, 16]])
    made = {}
    for name, two_sided in SIDES.items():
        two = torch.tensor(two_sided)
        texels = torch.rand(int((sizes.prod(-1) * (1 + two.long())).sum()), 4, generator=generator, dtype=torch.float64)
        texels[:, 3] = 0.1 + 0.9 * texels[:, 3]
        made[name] = BillboardCloud(
            centers=torch.tensor([[0.3, 1.2, -0.2], [-0.1, 1.5, 0.4], [0.1, 0.7, 0.1]], dtype=torch.float64),
            rights=frames[:, 0].contiguous(),
            ups=frames[:, 1].contiguous(),
            half_extents=torch.tensor([[0.8, 1.1], [1.0, 0.4], [0.5, 0.5]], dtype=torch.float64),
            texture_sizes=sizes,
            two_sided=two,
            texels=texels,
        )
    return made


@pytest.fixture(scope="session")
def orbit() -> Camera:
    """Six views from around, above and below, so that every rectangle is seen from both sides."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.5, 1.5])] * 3) + torch.tensor([0.1, 1.1, 0.1])
    target = torch.tensor([0.1, 1.1, 0.1], dtype=torch.float64)
    return Orbit(6, (10.0, -35.0)).frame(corners.double().numpy(), target=target, width=48, height=40)


@pytest.fixture(scope="session")
def crossed() -> BillboardCloud:
    """Two crossed upright billboards, float32: discs that fade out, in noise that goes on where they are transparent."""
    planes = even_upright(
        2,
        axis=torch.tensor([0.1, 1.1, 0.1]),
        half_extents=torch.tensor([0.9, 1.1]),
        texture_sizes=torch.tensor([36, 30]),
    )
    y, x = torch.meshgrid(torch.linspace(-1, 1, 36), torch.linspace(-1, 1, 30), indexing="ij")
    alpha = (1.6 * (1 - (x**2 + y**2).sqrt() / 0.8)).clamp(0, 1).flatten().repeat(2)
    color = torch.rand(len(alpha), 3, generator=torch.Generator().manual_seed(0))
    return planes.with_texels(torch.cat([color, alpha[:, None]], -1))
