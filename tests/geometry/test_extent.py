"""Where billboards reach to, and where they show something."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bbfit.checks import InputError
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import corners, shown_bounds


def test_corners_go_around_each_rectangle(known_cloud: BillboardCloud) -> None:
    around = corners(known_cloud)
    assert around.shape == (2, 4, 3) and around.dtype == torch.float64
    torch.testing.assert_close(around.mean(1), known_cloud.centers.double())
    torch.testing.assert_close(around[:, 1] - around[:, 0], (2 * known_cloud.half_extents[:, :1] * known_cloud.rights).double())
    torch.testing.assert_close(around[:, 3] - around[:, 0], (2 * known_cloud.half_extents[:, 1:] * known_cloud.ups).double())
    assert corners(known_cloud.take([])).shape == (0, 4, 3)


def test_bounds_are_of_what_shows(known_cloud: BillboardCloud) -> None:
    """A rectangle whose lower half is empty reaches down to its middle only."""
    textures = [texture.clone() for texture in known_cloud.take([0]).textures()]
    textures[0][...] = 1.0
    textures[0][:, 18:] = 0.0  # of 36 rows
    half = known_cloud.take([0]).with_texels(textures[0].reshape(-1, 4))
    low, high = shown_bounds(half)
    assert low[1] == pytest.approx(1.2 + 1.2 / 36, abs=1e-6)  # the middle of the last row that shows
    assert high[1] == pytest.approx(2.4 - 1.2 / 36, abs=1e-6)
    with pytest.raises(InputError, match="no billboards"):
        shown_bounds(half.take([]))


def test_stray_texels_may_be_spared(known_cloud: BillboardCloud) -> None:
    texels = torch.zeros_like(known_cloud.texels)
    height, width = known_cloud.texture_sizes[0].tolist()
    front = texels[: height * width].view(height, width, 4)
    front[10:30, 10:20, 3] = 1.0
    front[0, 15, 3] = 1.0
    stray = known_cloud.with_texels(texels)
    strict, spared = shown_bounds(stray), shown_bounds(stray, spared=0.01)
    assert strict[1, 1] > spared[1, 1]
    torch.testing.assert_close(spared[1, 1], torch.tensor(1.2 + 1.2 * (1 - 2 * 10.5 / height), dtype=torch.float64))
    torch.testing.assert_close(spared[0, 1], strict[0, 1])


def test_texel_density(known_cloud: BillboardCloud) -> None:
    """36 x 30 texels on 2.4 x 2 meters."""
    assert known_cloud.texel_density == pytest.approx(15.0)
    assert replace(
        known_cloud.take([0]), two_sided=torch.tensor([True]), texels=torch.zeros(2 * 36 * 30, 4)
    ).texel_density == pytest.approx(15.0)
    assert known_cloud.take([]).texel_density == 0.0
