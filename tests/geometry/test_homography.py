"""Plane homographies against texel centers placed in space by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.homography import pixel_depth, signed_distance, texel_to_pixel, texel_to_world


def tilted_cloud() -> BillboardCloud:
    """Three rectangles in general position with textures of different sizes, float64."""
    generator = torch.Generator().manual_seed(3)
    axes = torch.linalg.qr(torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)).Q
    sizes = torch.tensor([[4, 7], [1, 3], [5, 5]])
    return BillboardCloud(
        torch.rand(3, 3, generator=generator, dtype=torch.float64),
        axes[:, 0],
        axes[:, 1],
        torch.rand(3, 2, generator=generator, dtype=torch.float64) + 0.5,
        sizes,
        torch.zeros(3, dtype=torch.bool),
        torch.zeros(int(sizes.prod(-1).sum()), 4, dtype=torch.float64),
    )


def cameras(orthographic: bool) -> Camera:
    position = torch.tensor([[3.0, 2, 5], [-4, 1, 2]], dtype=torch.float64)
    intrinsics = orthographic_intrinsics(4.0, 20, 15) if orthographic else pinhole_intrinsics(50, 20, 15)
    return Camera(look_at(position, torch.zeros(3, dtype=torch.float64)), intrinsics.repeat(2, 1, 1), 20, 15, orthographic)


def texel_center(cloud: BillboardCloud, n: int, column: int, row: int) -> torch.Tensor:
    """The world point of a texel's center: texels divide the rectangle evenly, row 0 at the top."""
    height, width = cloud.texture_sizes[n].tolist()
    across = cloud.rights[n] * cloud.half_extents[n, 0] * (2 * (column + 0.5) / width - 1)
    down = cloud.ups[n] * cloud.half_extents[n, 1] * (1 - 2 * (row + 0.5) / height)
    return cloud.centers[n] + across + down


@pytest.mark.parametrize("orthographic", [False, True])
def test_texels_land_where_their_points_in_space_project(orthographic: bool) -> None:
    cloud, camera = tilted_cloud(), cameras(orthographic)
    matrices, places, (numerator, denominator) = texel_to_pixel(cloud, camera), texel_to_world(cloud), pixel_depth(cloud, camera)
    for n, (height, width) in enumerate(cloud.texture_sizes.tolist()):
        for column, row in ((0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)):
            texel = torch.tensor([column, row, 1.0], dtype=torch.float64)
            point = texel_center(cloud, n, column, row)
            assert torch.allclose((places[n] @ texel)[:3], point)
            for v in range(2):
                pixel = matrices[v, n] @ texel
                pixel = pixel / pixel[2]
                assert torch.allclose(pixel[:2], camera[v].project(point[None])[0])
                depth = (camera.world_to_camera[v] @ torch.cat([point, point.new_ones(1)]))[2]
                assert torch.allclose(numerator[v, n] @ pixel / (denominator[v, n] @ pixel), depth)


@pytest.mark.parametrize("orthographic", [False, True])
def test_signed_distance_is_positive_in_front(orthographic: bool) -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    cloud = even_upright(2, axis=zero, half_extents=torch.ones(2).double(), texture_sizes=torch.tensor([2, 2]))
    position = torch.tensor([[0.0, 0, 3], [0, 0, -3], [3, 0, 0]], dtype=torch.float64)
    camera = Camera(look_at(position, zero), torch.eye(3, dtype=torch.float64).repeat(3, 1, 1), 4, 4, orthographic)
    scale = 1 if orthographic else 3
    # Billboard 0 faces +Z, billboard 1 faces +X.
    expected = scale * torch.tensor([[1.0, 0], [-1, 0], [0, 1]], dtype=torch.float64)
    assert torch.allclose(signed_distance(cloud, camera), expected, atol=1e-15)


def test_coincident_planes_have_exactly_equal_depths() -> None:
    """Whatever the textures' sizes, and in float32, so that the order of a tie is the index."""
    one = tilted_cloud()
    for dtype in (torch.float32, torch.float64):
        for count in (2, 17):
            index = torch.zeros(count, dtype=torch.long)
            sizes = torch.arange(1, count + 1)[:, None].expand(count, 2)
            cloud = BillboardCloud(
                *(t[index] for t in (one.centers, one.rights, one.ups, one.half_extents)),
                sizes,
                torch.zeros(count, dtype=torch.bool),
                torch.zeros(int(sizes.prod(-1).sum()), 4),
            ).to(dtype)
            for rows in pixel_depth(cloud, cameras(False).to(dtype)):
                assert torch.equal(rows, rows[:, :1].expand_as(rows))


def test_depth_does_not_depend_on_which_way_a_plane_faces() -> None:
    cloud, camera = tilted_cloud(), cameras(False)
    turned = replace(cloud, rights=-cloud.rights)
    quotient = [(a @ torch.ones(3).double()) / (b @ torch.ones(3).double()) for a, b in (pixel_depth(c, camera) for c in (cloud, turned))]
    assert torch.equal(*quotient)
