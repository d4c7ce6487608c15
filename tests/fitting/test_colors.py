"""The colors of a finished fit: their mean is that of the views, near and far."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from billboard_scene import crossing_billboards

from bbfit.exporting.mips import plain_chain
from bbfit.fitting.colors import matched_colors, smoothed_colors
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply
from bbfit.rendering.dispatch import render
from bbfit.views.dataset import ViewDataset


def speckled(alpha: AlphaMode) -> BillboardCloud:
    """Green where it is opaque and gray where it is faint, texel by texel."""
    cloud = crossing_billboards()
    opaque = (torch.rand(len(cloud.texels), 1, generator=torch.Generator().manual_seed(0)) < 0.4).float()
    green, gray = torch.tensor([0.1, 0.8, 0.1, 1.0]), torch.tensor([0.5, 0.5, 0.5, 0.1])
    return replace(cloud.with_texels(opaque * green + (1 - opaque) * gray), alpha=alpha)


@pytest.mark.parametrize("alpha", [AlphaMode("blend"), AlphaMode("mask", 0.5)])
def test_opaque_texels_keep_their_color_and_all_their_alpha(alpha: AlphaMode) -> None:
    cloud = speckled(alpha)
    smoothed = smoothed_colors(cloud)
    opaque = cloud.texels[:, 3] == 1
    assert torch.equal(smoothed.texels[opaque], cloud.texels[opaque]) and torch.equal(smoothed.texels[:, 3], cloud.texels[:, 3])
    faint = smoothed.texels[~opaque, :3]
    assert float((faint[:, 1] - faint[:, 0]).mean()) > 0.4  # green instead of gray


def test_texels_from_the_cutoff_on_are_opaque_in_a_mask() -> None:
    cloud = speckled(AlphaMode("mask", 0.1))
    torch.testing.assert_close(smoothed_colors(cloud).texels, cloud.texels)


def test_mip_levels_have_the_color_of_the_texture() -> None:
    cloud = speckled(AlphaMode("blend"))

    def chroma(cloud: BillboardCloud, level: int) -> float:
        """Green over red of the mean premultiplied color in a mip level of the first texture."""
        texture = next(iter(cloud.textures()))[0]
        image = torch.from_numpy(plain_chain((texture * 255).round().to(torch.uint8).numpy())[level]) / 255
        red, green, _, _ = premultiply(image).mean((0, 1)).tolist()
        return green / red

    kept = [chroma(each, 2) / chroma(each, 0) for each in (cloud, smoothed_colors(cloud))]
    assert kept[0] < 0.5 and kept[1] > 0.65  # a mean in linear light is whiter


def test_transparent_textures_stay_as_they_are() -> None:
    cloud = crossing_billboards()
    cloud = cloud.with_texels(torch.cat([cloud.texels[:, :3], torch.zeros(len(cloud.texels), 1)], 1))
    assert torch.equal(smoothed_colors(cloud).texels, cloud.texels)


def test_the_mean_color_becomes_that_of_the_views() -> None:
    """Whatever tint the billboards had."""
    cloud, views = crossing_billboards(), ViewDataset.load(Path(__file__).resolve().parents[2] / "data" / "views").train
    matched = matched_colors(cloud, views)
    drawn = render(matched, views.cameras).double().sum((0, 1, 2))
    wanted = views.targets(range(len(views)), torch.float64).sum((0, 1, 2))
    torch.testing.assert_close(drawn[:3] / drawn[3], wanted[:3] / wanted[3], rtol=0.02, atol=0)
    assert torch.equal(matched.texels[:, 3], cloud.texels[:, 3])
