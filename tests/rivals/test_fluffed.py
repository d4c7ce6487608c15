"""Spherical normals point away from the middle of the crown, as far as the side of a plane that a viewer sees allows."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.rivals.fluffed import fluffed


def crossing(two_sided: bool) -> BillboardCloud:
    """Two crossing opaque planes of 2 x 2 m."""
    texels = torch.full((2 * (1 + int(two_sided)) * 64, 4), 0.5)
    texels[:, 3] = 1
    return BillboardCloud(
        centers=torch.tensor([[3.0, 1.0, 2.0]]).repeat(2, 1),
        rights=torch.tensor([[1.0, 0, 0], [0, 0, -1.0]]),
        ups=torch.tensor([[0.0, 1.0, 0.0]]).repeat(2, 1),
        half_extents=torch.ones(2, 2),
        texture_sizes=torch.full((2, 2), 8),
        two_sided=torch.full((2,), two_sided),
        texels=texels,
        surface=torch.tensor([[0.5, 0.5, 0.7, 0.0]]).repeat(len(texels), 1),
        light=Light.of(torch.tensor([[0.0, 1.0, 0.0]]), 1.0, 1.0),
    )


def normals(cloud: BillboardCloud) -> list[torch.Tensor]:
    """The normals in each texture, [S, 8, 8, 3]."""
    return cloud.textures(cloud.tangent_normals)


def tangents(up: float = 0.0) -> torch.Tensor:
    """Directions from a point on the vertical of the planes to the 8 x 8 texels of one of them, in its axes, [8, 8, 3]."""
    at = (torch.arange(8) + 0.5) / 4 - 1
    y, x = torch.meshgrid(-at - up, at, indexing="ij")
    return normalize(torch.stack([x, y, torch.zeros_like(x)], -1), dim=-1)


@pytest.mark.parametrize("two_sided", [False, True])
def test_normals_point_away_from_the_middle(two_sided: bool) -> None:
    cloud = crossing(two_sided)
    result = fluffed(cloud)
    assert result.surface is not None and cloud.surface is not None
    assert torch.equal(result.surface[:, 2:], cloud.surface[:, 2:]) and torch.equal(result.texels, cloud.texels)
    for texture in normals(result):
        torch.testing.assert_close(texture, tangents().expand(1 + int(two_sided), 8, 8, 3), atol=1e-3, rtol=0)


def test_middle_is_that_of_what_shows() -> None:
    """The lower halves are transparent, so the middle lies half a meter higher."""
    cloud = crossing(False)
    for texture in cloud.textures():
        texture[:, 4:, :, 3] = 0
    result = fluffed(cloud)
    for texture in normals(result):
        torch.testing.assert_close(texture[0], tangents(up=0.5), atol=1e-3, rtol=0)


def test_normals_off_the_plane_turn_to_the_viewer() -> None:
    """A plane in front of the other and one behind it: in the texture, both point to the viewer's side."""
    cloud = crossing(False)
    apart = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    cloud = BillboardCloud(**{**vars(cloud), "centers": cloud.centers + apart, "rights": torch.tensor([[1.0, 0, 0]]).repeat(2, 1)})
    result = fluffed(cloud)
    front, back = normals(result)
    torch.testing.assert_close(front, back)
    assert (front[..., 2] > 0.5).all()
