"""The reference renderer against a second one that shares nothing with it, and against pictures known in advance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ray_caster import cast
from scenes import camera_on_z, cloud_of, facing_cloud, random_scene

from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.images import premultiply
from bbfit.operators.drawing.reference import EDGE_ON, render_reference

# Rounding only. Measured over 400 random scenes: at most 3.2e-14 in float64 and 3e-5 in float32, where a texel coordinate of a plane
# seen at a few degrees carries about a hundred times the rounding of its matrix.
FLOAT64, FLOAT32 = 1e-11, 2e-4


def difference(cloud: BillboardCloud, camera: Camera) -> float:
    """Largest difference from the ray caster over all pixels and channels of a single camera."""
    image = render_reference(cloud, camera)
    assert image.shape == (camera.height, camera.width, 4) and image.dtype == cloud.texels.dtype and image.isfinite().all()
    return float(np.abs(image.double().numpy() - cast(cloud, camera)).max())


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("count", [0, 1, 3, 17])
def test_random_scenes(count: int, orthographic: bool) -> None:
    covered = 0
    for seed in range(15):
        cloud, camera = random_scene(seed, count, orthographic=orthographic)
        assert difference(cloud, camera) < FLOAT64
        covered += bool((render_reference(cloud, camera)[..., 3] > 0).any())
    assert covered >= (5 if count else 0)


@pytest.mark.parametrize("count", [1, 3, 17])
def test_float32_agrees_with_float64(count: int) -> None:
    for seed in range(15):
        cloud, camera = random_scene(seed, count, orthographic=False)
        exact = render_reference(cloud, camera)
        assert (render_reference(cloud.to(torch.float32), camera).double() - exact).abs().max() < FLOAT32


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_units_do_not_matter(scale: float) -> None:
    """A tree in millimeters or in kilometers is the same picture."""
    for seed in range(8):
        cloud, camera = random_scene(seed, 3, orthographic=False)
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= scale
        scaled = replace(cloud, centers=cloud.centers * scale, half_extents=cloud.half_extents * scale)
        for dtype, allowed in ((torch.float64, FLOAT64), (torch.float32, FLOAT32)):
            image = render_reference(scaled.to(dtype), replace(camera, world_to_camera=pose))
            assert (image.double() - render_reference(cloud, camera)).abs().max() < allowed


@pytest.mark.parametrize(("dtype", "allowed"), [(torch.float32, 5e-6), (torch.float64, 1e-14)])  # measured 1.3e-6 and 2e-15
@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize(("width", "height"), [(16, 16), (9, 14), (31, 8), (1, 5)])
def test_one_texel_a_pixel_is_the_texture_itself(dtype: torch.dtype, allowed: float, orthographic: bool, width: int, height: int) -> None:
    depth, extent = 3.0, 4.0
    fov = None if orthographic else 2 * np.degrees(np.arctan(0.5 * extent / depth))
    cloud = facing_cloud([depth], [(height, width)], (extent / 2, extent / 2 * height / width)).to(dtype)
    texture = premultiply(cloud.textures()[0][0])
    camera = camera_on_z(width, height, fov=fov, extent=extent)
    assert (render_reference(cloud, camera) - texture).abs().max() < allowed

    # One texel to the right and two down.
    texel = extent / width
    moved = replace(cloud, centers=cloud.centers + texel * torch.tensor([1.0, -2, 0], dtype=dtype))
    expected = torch.zeros_like(texture)
    expected[2:, 1:] = texture[: height - 2, : width - 1]
    assert (render_reference(moved, camera) - expected).abs().max() < 4 * allowed


def test_half_a_texel_beyond_the_outermost_center_half_is_left() -> None:
    """The margin: alpha fades to nothing over one texel while the color stays, so nothing dark is mixed in."""
    cloud = facing_cloud([2.0], [(4, 4)]).with_texels(torch.tensor([0.2, 0.4, 0.8, 1.0]).double().expand(16, 4))
    camera = camera_on_z(6, 6, fov=None, extent=3.0)  # half a meter a pixel and a texel, so the rectangle's edge is at pixel 0.5
    image = render_reference(replace(cloud, centers=cloud.centers + torch.tensor([0.25, 0, 0])), camera)
    assert torch.allclose(image[2, :, 3], torch.tensor([0, 0.5, 1, 1, 1, 0.5]).double())
    assert torch.allclose(image[2, 1:, :3] / image[2, 1:, 3:], torch.tensor([0.2, 0.4, 0.8]).double())


def test_crossing_planes_swap_order_within_a_picture() -> None:
    cloud = even_upright(2, axis=torch.zeros(3).double(), half_extents=torch.ones(2).double(), texture_sizes=torch.tensor([1, 1]))
    red, blue = torch.tensor([[1.0, 0, 0, 1], [0, 0, 1, 1]], dtype=torch.float64)
    cloud = cloud.with_texels(torch.stack([red, blue]))
    position = torch.tensor([[2.0, 0, 4]], dtype=torch.float64)  # both planes seen from their front
    camera = Camera(look_at(position, torch.zeros(3).double())[0], pinhole_intrinsics(30, 16, 5), 16, 5)
    assert difference(cloud, camera) < FLOAT64
    row = render_reference(cloud, camera)[2]
    # Only the red plane's middle texel is opaque, so compare which color leads on either side of the crossing.
    assert row[6, 2] != row[6, 0] and (row[6, 2] > row[6, 0]) != (row[9, 2] > row[9, 0])


@pytest.mark.parametrize("sizes", [[(3, 3), (3, 3)], [(3, 3), (5, 7)]])
def test_of_coincident_planes_the_lower_index_is_in_front(sizes: list[tuple[int, int]]) -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        axes = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
        cloud = cloud_of(torch.tensor([0.1, 0.2, -3]).expand(2, 3), axes[0].expand(2, 3), axes[1].expand(2, 3), torch.ones(2, 2), sizes)
        counts = [h * w for h, w in sizes]
        red, blue = torch.tensor([[1.0, 0, 0, 1], [0, 0, 1, 1]]).double()
        cloud = cloud.with_texels(torch.cat([red.expand(counts[0], 4), blue.expand(counts[1], 4)]))
        for dtype in (torch.float32, torch.float64):
            image = render_reference(cloud.to(dtype), camera_on_z(17, 13))
            inner = image[..., 0] > 0.999  # away from the red one's fading edge
            assert inner.any() and (image[..., 2][inner] < 1e-3).all()


def test_a_two_sided_billboard_shows_each_texture_to_its_own_side() -> None:
    cloud = even_upright(1, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([1, 2]), sides="two")
    front = torch.tensor([[1.0, 0, 0, 1], [0, 1, 0, 1]])
    back = torch.tensor([[0, 0, 1, 1], [1, 1, 0, 1.0]])
    cloud = cloud.with_texels(torch.cat([front, back]))
    position = torch.tensor([[0.0, 0, 3], [0, 0, -3]], dtype=torch.float64)
    intrinsics = pinhole_intrinsics(37, 2, 2).repeat(2, 1, 1)  # the rectangle fills the picture
    camera = Camera(look_at(position, torch.zeros(3).double()), intrinsics, 2, 2)
    image = render_reference(cloud, camera)
    color = image[..., :3] / image[..., 3:]
    assert torch.allclose(color[0, 0], front[:, :3], atol=0.02)
    # Both textures are stored as seen from the front, so from behind they appear mirrored.
    assert torch.allclose(color[1, 0], back.flip(0)[:, :3], atol=0.02)
    for v in range(2):
        assert np.abs(image[v].double().numpy() - cast(cloud.to(torch.float64), camera[v])).max() < FLOAT32


def test_a_batch_of_cameras_is_its_cameras_one_by_one() -> None:
    cloud, _ = random_scene(1, 3, orthographic=False)
    generator = torch.Generator().manual_seed(0)
    position = 4 * torch.rand(5, 3, generator=generator, dtype=torch.float64) - 2
    camera = Camera(look_at(position, torch.zeros(3).double()), pinhole_intrinsics(60, 11, 6).repeat(5, 1, 1), 11, 6)
    images = render_reference(cloud, camera)
    assert images.shape == (5, 6, 11, 4)
    for v in range(5):
        assert (images[v] - render_reference(cloud, camera[v])).abs().max() < 1e-12
    assert torch.equal(render_reference(cloud, camera[2:3])[0], render_reference(cloud, camera[2]))


@pytest.mark.parametrize("sine", [0.0, 0.9 * EDGE_ON])
def test_a_plane_seen_edge_on_is_invisible(sine: float) -> None:
    for dtype in (torch.float32, torch.float64):
        for width in (8, 9):
            cloud = facing_cloud([3.0], [(4, 4)])
            tilt = torch.tensor([[sine, 0, (1 - sine**2) ** 0.5]], dtype=torch.float64)
            image = render_reference(replace(cloud, rights=tilt).to(dtype), camera_on_z(width, 7))
            assert (image == 0).all()


def test_planes_seen_nearly_edge_on() -> None:
    """In float64 right down to the threshold; in float32 the sliver's texel is uncertain, and the picture finite."""
    for sine in (1.1 * EDGE_ON, 1e-4, 1e-3, 1e-2):
        for width in (8, 9):
            cloud = facing_cloud([3.0], [(16, 16)])
            cloud = replace(cloud, rights=torch.tensor([[sine, 0, (1 - sine**2) ** 0.5]], dtype=torch.float64))
            assert difference(cloud, camera_on_z(width, 7)) < 1e-8  # measured 2e-10
            assert render_reference(cloud.to(torch.float32), camera_on_z(width, 7)).isfinite().all()


def test_planes_behind_beside_and_of_no_size_are_not_drawn() -> None:
    for fov in (60.0, None):
        camera = camera_on_z(7, 5, fov=fov)
        assert (render_reference(facing_cloud([-3.0], [(4, 4)]), camera) == 0).all()
        beside = facing_cloud([3.0], [(4, 4)])
        assert (render_reference(replace(beside, centers=beside.centers + 100), camera) == 0).all()
        assert (render_reference(replace(beside, half_extents=0 * beside.half_extents), camera) == 0).all()


def test_a_floor_that_runs_under_the_camera_is_drawn_ahead_of_it_only() -> None:
    axes = torch.eye(3)
    floor = cloud_of(torch.tensor([[0.0, -1, 0]]), axes[:1], -axes[2:], torch.full((1, 2), 50.0), [(40, 40)])
    floor = floor.with_texels(torch.ones_like(floor.texels))
    for width, height in ((9, 9), (8, 8)):
        camera = camera_on_z(width, height, fov=90.0)
        image = render_reference(floor, camera)[..., 3]
        assert difference(floor, camera) < FLOAT64
        assert (image[: height // 2] == 0).all() and (image[-1] == 1).all()


def test_horizons_that_run_through_pixel_centers() -> None:
    """kornia divides by zero there; planes beside the optical axis and parallel to it, as pairs seen end-on in odd pictures are."""
    cloud = even_upright(
        2, axis=torch.tensor([0.0, 0, -6]).double(), half_extents=torch.full((2,), 2.0).double(),
        texture_sizes=torch.tensor([8, 8]), sides="pair", gap=0.4,
    )  # fmt: skip
    cloud = cloud.with_texels(torch.rand(cloud.texels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    for fov in (30.0, 60.0, 90.0):
        camera = camera_on_z(33, 17, fov=fov)
        assert difference(cloud, camera) < FLOAT64
        # Moved by a millionth of the picture where a pixel is as wide as several texels.
        assert difference(cloud.to(torch.float32), camera) < 1e-3  # measured 3e-4
