"""Conventions of bbfit.geometry.camera, each checked against a projection written out here."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bbfit.checks import InputError
from bbfit.geometry.camera import (
    Camera,
    camera_from_nerf,
    camera_to_nerf,
    convergence_point,
    look_at,
    orthographic_intrinsics,
    pinhole_intrinsics,
)
from bbfit.geometry.orbit import Orbit

EXACT = 1e-12  # float64 rounding on numbers of the order of one to a hundred; measured at most 2e-13


def random_rigid(count: int) -> Tensor:
    """Random camera-to-world matrices, [count, 4, 4] float64."""
    generator = torch.Generator().manual_seed(count)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    rotation[torch.linalg.det(rotation) < 0] *= -1
    matrices = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    matrices[:, :3, :3] = rotation
    matrices[:, :3, 3] = 5 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return matrices


def nerf_pixel(camera_to_world: Tensor, point: Tensor, focal: float, width: int, height: int) -> Tensor:
    """Where the NeRF-synthetic layout puts a Z-up world point: from the picture's corner, camera looking along -Z with +Y up."""
    x, y, z = (torch.linalg.inv(camera_to_world) @ torch.cat([point, point.new_ones(1)]))[:3]
    return torch.stack([width / 2 + focal * x / -z, height / 2 - focal * y / -z])


def test_nerf_matrices_round_trip() -> None:
    matrices = random_rigid(20)
    assert (camera_to_nerf(camera_from_nerf(matrices)) - matrices).abs().max() < EXACT
    assert (camera_from_nerf(camera_to_nerf(matrices)) - matrices).abs().max() < EXACT


def test_nerf_camera_projects_as_the_layout_says() -> None:
    width, height, fov = 31, 20, 50.0
    focal = 0.5 * width / math.tan(0.5 * math.radians(fov))
    compared = 0
    for pose in random_rigid(40):
        point_here = 3 * torch.randn(3, generator=torch.Generator().manual_seed(compared), dtype=torch.float64)
        camera = Camera(camera_from_nerf(pose[None])[0], pinhole_intrinsics(fov, width, height), width, height)
        x, y, z = point_here
        projected = camera.project(torch.stack([x, z, -y])[None])[0]  # (x, y, z)_glTF = (x, z, -y)_here
        in_front = (torch.linalg.inv(pose) @ torch.cat([point_here, point_here.new_ones(1)]))[2] < 0
        assert projected.isfinite().all() == in_front
        if in_front:
            compared += 1
            # The layout counts from the corner of the top-left pixel, we from its center.
            expected = nerf_pixel(pose, point_here, focal, width, height) - 0.5
            assert torch.allclose(projected, expected, rtol=1e-9, atol=1e-9)
    assert compared > 10


def test_nerf_camera_south_of_the_tree_looks_north() -> None:
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -22], [0, 1, 0, 5], [0, 0, 0, 1]], dtype=torch.float64)
    world_to_camera = camera_from_nerf(pose[None])[0]
    camera = Camera(world_to_camera, pinhole_intrinsics(40, 8, 8), 8, 8)
    assert camera.position.tolist() == [0, 5, 22]
    assert world_to_camera[:3, :3].tolist() == [[1, 0, 0], [0, -1, 0], [0, 0, -1]]  # right +X, down -Y, forward -Z


def test_shared_views_form_a_ring_that_looks_at_the_axis(shared: Path) -> None:
    frames = json.loads((shared / "views/acer/transforms_train.json").read_text())["frames"]
    poses = torch.tensor([frame["transform_matrix"] for frame in frames], dtype=torch.float64)
    camera = Camera(camera_from_nerf(poses), pinhole_intrinsics(40, 512, 512).expand(len(poses), 3, 3), 512, 512)
    meeting = convergence_point(camera)
    assert torch.allclose(meeting[[0, 2]], torch.zeros(2, dtype=torch.float64), atol=1e-6)
    assert meeting[1] == pytest.approx(5.120891571044922)
    assert torch.allclose(camera.position[:, 1], meeting[1].expand(len(poses)))


@pytest.mark.parametrize(("width", "height"), [(512, 512), (31, 20), (1, 7)])
def test_field_of_view_spans_pixel_edges(width: int, height: int) -> None:
    intrinsics = pinhole_intrinsics(40, width, height)
    assert (intrinsics[0, 2], intrinsics[1, 2]) == ((width - 1) / 2, (height - 1) / 2)
    camera = Camera(torch.eye(4, dtype=torch.float64), intrinsics, width, height)
    slope, depth = math.tan(math.radians(20)), 7.0
    right, down = slope * depth, slope * depth * height / width
    corners = camera.project(torch.tensor([[-right, -down, depth], [right, down, depth], [0, 0, depth]], dtype=torch.float64))
    expected = [[-0.5, -0.5], [width - 0.5, height - 0.5], [(width - 1) / 2, (height - 1) / 2]]
    assert torch.allclose(corners, torch.tensor(expected, dtype=torch.float64), atol=1e-10)


def test_orthographic_extent_spans_pixel_edges_at_every_depth() -> None:
    camera = Camera(torch.eye(4, dtype=torch.float64), orthographic_intrinsics(6.0, 12, 8), 12, 8, orthographic=True)
    points = torch.tensor([[-3.0, -2, 1], [3, 2, 100], [0, 0, -5]], dtype=torch.float64)
    expected = torch.tensor([[-0.5, -0.5], [11.5, 7.5], [5.5, 3.5]], dtype=torch.float64)
    assert torch.allclose(camera.project(points), expected)


def test_a_pinhole_does_not_project_what_is_at_or_behind_it() -> None:
    camera = Camera(torch.eye(4), pinhole_intrinsics(40, 8, 8).float(), 8, 8)
    assert camera.project(torch.tensor([[1.0, 1, 0], [0, 0, -1]])).isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_look_at_is_a_rotation_that_puts_the_target_on_the_axis(dtype: torch.dtype) -> None:
    target = torch.tensor([0.5, 2, -1], dtype=dtype)
    directions = torch.nn.functional.normalize(
        torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [1e-8, 1, 0], [0.02, 1, 0.01], [1, -2, 3]], dtype=dtype), dim=-1
    )
    position = target + 3 * directions
    transform = look_at(position, target)
    rotation, tolerance = transform[:, :3, :3], 100 * torch.finfo(dtype).eps
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=dtype).expand(7, 3, 3), atol=tolerance)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(7, dtype=dtype), atol=tolerance)
    seen = (transform @ torch.cat([target, target.new_ones(1)]))[:, :3]
    assert torch.allclose(seen, torch.tensor([0, 0, 3], dtype=dtype).expand(7, 3), atol=10 * tolerance)
    camera = Camera(transform, pinhole_intrinsics(40, 8, 8).to(dtype).expand(7, 3, 3), 8, 8)
    assert torch.allclose(camera.position, position, atol=10 * tolerance)
    assert torch.allclose(camera.forward, -directions, atol=tolerance)
    # Up in the picture (-Y of the camera) never points below the horizon; straight down it is the world's -Z.
    assert (-rotation[:, 1, 1] >= -tolerance).all()
    assert torch.allclose(-rotation[2, 1], torch.tensor([0.0, 0, -1], dtype=dtype), atol=tolerance)
    assert torch.allclose(-rotation[3, 1], torch.tensor([0.0, 0, -1], dtype=dtype), atol=tolerance)


def test_camera_to_world_is_the_inverse() -> None:
    matrices = random_rigid(5)
    camera = Camera(matrices, pinhole_intrinsics(40, 8, 8).expand(5, 3, 3), 8, 8)
    assert torch.allclose(camera.camera_to_world, torch.linalg.inv(matrices), atol=EXACT)


def test_indexing_and_batching() -> None:
    camera = Camera(random_rigid(5), pinhole_intrinsics(40, 9, 8).expand(5, 3, 3), 9, 8)
    assert len(camera) == 5 and len(camera[1:3]) == 2 and len(camera[[4, 0]]) == 2
    one = camera[-1]
    assert not one.batched and one.batch().batched and torch.equal(one.world_to_camera, camera.world_to_camera[4])
    points = torch.rand(6, 3, dtype=torch.float64)
    assert camera.project(points).shape == (5, 6, 2)
    assert torch.allclose(camera[2].project(points), camera.project(points)[2], equal_nan=True)
    assert camera.to(torch.float32).intrinsics.dtype == torch.float32
    with pytest.raises(TypeError, match="single camera"):
        len(one)
    with pytest.raises(TypeError, match="single camera"):
        one[0]


@pytest.mark.parametrize(
    ("world_to_camera", "intrinsics", "width"),
    [((3, 4), (3, 3), 8), ((2, 4, 4), (3, 3), 8), ((2, 2, 4, 4), (2, 2, 3, 3), 8), ((4, 4), (3, 3), 0)],
)
def test_bad_shapes_are_refused(world_to_camera: tuple[int, ...], intrinsics: tuple[int, ...], width: int) -> None:
    with pytest.raises(InputError, match=r"expected (shape|at least)"):
        Camera(torch.zeros(world_to_camera), torch.zeros(intrinsics), width, 8)


@pytest.mark.parametrize("elevations", [(0.0,), (10.0, 35.0)])
def test_convergence_point_of_an_orbit_is_its_target(elevations: tuple[float, ...]) -> None:
    target = torch.tensor([3.0, 5, -2], dtype=torch.float64)
    points = target.numpy() + torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).numpy()
    camera = Orbit(7, elevations).frame(points, target=target, width=8, height=8)
    assert torch.allclose(convergence_point(camera), target, atol=1e-9)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("degrees", [1.0, -30.0, 90.0])
def test_a_turned_camera_sees_what_it_saw_of_a_turned_world(degrees: float, orthographic: bool) -> None:
    """Also from straight above. Its azimuth grows, and its distance from the axis and its height stay."""
    axis, points = torch.tensor([0.4, 1.0, -0.3]).double(), torch.randn(40, 3, generator=torch.Generator().manual_seed(0)).double()
    fov = None if orthographic else 40.0
    camera = Orbit(9, (0.0, 40.0, 90.0)).frame(points.numpy(), target=axis, width=30, height=20, fov_x_degrees=fov)
    turned, angle = camera.turned(degrees, axis), math.radians(degrees)
    turn = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    rotation = torch.tensor(turn, dtype=torch.float64)
    torch.testing.assert_close(turned.project((points - axis) @ rotation.mT + axis), camera.project(points), rtol=0, atol=1e-9)
    torch.testing.assert_close(turned.position - axis, (camera.position - axis) @ rotation.mT, rtol=0, atol=1e-9)
    assert (turned.orthographic, turned.width, turned.height) == (orthographic, 30, 20)
    (x, _, z), (new_x, _, new_z) = (one.position[1] - axis for one in (camera, turned))
    assert (math.atan2(new_x, new_z) - math.atan2(x, z) - angle + math.pi) % (2 * math.pi) == pytest.approx(math.pi)


def test_convergence_point_needs_two_directions() -> None:
    camera = Camera(torch.eye(4).repeat(3, 1, 1), torch.eye(3).repeat(3, 1, 1), 8, 8)
    with pytest.raises(InputError, match="around the tree"):
        convergence_point(camera)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize(("width", "height"), [(31, 20), (62, 40), (7, 5), (15, 60), (1, 1)])
def test_a_resized_camera_covers_the_same_field_of_view(width: int, height: int, single: bool, orthographic: bool) -> None:
    """Places are shares of the picture from its outer edges, also where the principal point is off the center."""
    intrinsics = pinhole_intrinsics(50, 31, 20).repeat(5, 1, 1) + torch.tensor([[3.0, 0, 2.5], [0, -1, -4], [0, 0, 0]]).double()
    camera: Camera = Camera(random_rigid(5), intrinsics, 31, 20, orthographic)
    camera = camera[2] if single else camera
    resized = camera.resized(width, height)
    assert (resized.width, resized.height, resized.orthographic, resized.batched) == (width, height, orthographic, not single)
    points = 20 * torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 10
    before = (camera.project(points) + 0.5) / torch.tensor([31, 20])
    after = (resized.project(points) + 0.5) / torch.tensor([width, height])
    assert before.isfinite().any() and torch.equal(before.isfinite(), after.isfinite())
    torch.testing.assert_close(after, before, rtol=1e-11, atol=1e-11, equal_nan=True)
    back = resized.resized(31, 20)
    assert (back.intrinsics - camera.intrinsics).abs().max() < EXACT and torch.equal(
        camera.intrinsics[..., 2, :], back.intrinsics[..., 2, :]
    )


def test_resizing_is_making_a_camera_of_that_size() -> None:
    pose = torch.eye(4, dtype=torch.float64)
    ours = Camera(pose, pinhole_intrinsics(40, 512, 256), 512, 256).resized(64, 32)
    assert (ours.intrinsics - pinhole_intrinsics(40, 64, 32)).abs().max() < EXACT
    ours = Camera(pose, orthographic_intrinsics(6, 36, 24), 36, 24, True).resized(12, 8)
    assert (ours.intrinsics - orthographic_intrinsics(6, 12, 8)).abs().max() < EXACT
    assert Camera(pose, pinhole_intrinsics(40, 8, 8), 8, 8).to(torch.float32).resized(3, 5).intrinsics.dtype == torch.float32


def test_cameras_and_batches_are_joined() -> None:
    """In their order, with the first one's size."""
    targets = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    world_to_camera = look_at(targets + torch.tensor([0.0, 0, 5], dtype=torch.float64), targets)
    cameras = Camera(world_to_camera, pinhole_intrinsics(40.0, 32, 24).repeat(3, 1, 1), 32, 24)
    joined = Camera.joined([cameras[[1, 2]], cameras[0]])
    assert (joined.width, joined.height, joined.orthographic) == (32, 24, False)
    assert torch.equal(joined.world_to_camera, world_to_camera[[1, 2, 0]])
    assert joined.intrinsics.shape == (3, 3, 3)
