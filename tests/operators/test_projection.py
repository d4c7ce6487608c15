"""What the kernels are told about every billboard and view, against rays met with planes one by one in float64."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch
from scenes import CORNERS, camera_on_z, cloud_of, facing_cloud, random_scene, ring, scenes, upright
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.orbit import Orbit
from bbfit.operators.drawing.fused import Piece, schedule
from bbfit.operators.drawing.projection import Projection, project


def samples(cloud: BillboardCloud, camera: Camera) -> tuple[Tensor, Tensor]:
    """Where the ray of every pixel meets every plane: texel column and row [V, N, H, W, 2], and depth [V, N, H, W]; NaN where nowhere."""
    x, y = torch.meshgrid(torch.arange(camera.width).double(), torch.arange(camera.height).double(), indexing="xy")
    found, depths = [], []
    for pose, k in zip(camera.batch().world_to_camera, camera.batch().intrinsics, strict=True):
        flat = torch.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1]], -1)
        zero, one = torch.zeros_like(flat), torch.ones_like(flat[..., :1])
        starts = torch.cat([flat if camera.orthographic else zero, 0 * one], -1)
        rays = torch.cat([zero if camera.orthographic else flat, one], -1)
        starts, rays = (starts - pose[:3, 3]) @ pose[:3, :3], rays @ pose[:3, :3]
        for center, right, up, half, size in zip(
            cloud.centers, cloud.rights, cloud.ups, cloud.half_extents, cloud.texture_sizes.flip(-1), strict=True
        ):
            normal = torch.linalg.cross(right, up)
            depth = (center - starts) @ normal / (rays @ normal)
            hit = starts + rays * depth[..., None] - center
            texel = (torch.stack([hit @ right, -(hit @ up)], -1) / half + 1) * size / 2 - 0.5
            met = (depth > 0) & texel.isfinite().all(-1)
            found.append(torch.where(met[..., None], texel, torch.nan))
            depths.append(torch.where(met, depth, torch.nan))
    shape = (len(camera.batch()), len(cloud), camera.height, camera.width)
    return torch.stack(found).view(*shape, 2), torch.stack(depths).view(shape)


def within(texels: Tensor, cloud: BillboardCloud, slack: float = 0.0) -> Tensor:
    """Which samples lie on the texture or in its margin of one texel, [V, N, H, W]; ``slack`` is in texels."""
    last = cloud.texture_sizes.flip(-1)[:, None, None]
    return ((texels > -1 - slack) & (texels < last + slack)).all(-1)


def shown(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Which planes are not seen edge-on, [V, N]."""
    normals, poses = torch.linalg.cross(cloud.rights, cloud.ups), camera.batch().world_to_camera
    if camera.orthographic:
        return (poses[:, 2, :3] @ normals.mT).abs() > 1e-4
    eyes = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]
    return ((eyes[:, None] - cloud.centers) * normals).sum(-1).abs() > 1e-4


def touched(cloud: BillboardCloud, camera: Camera) -> list[Tensor]:
    """The rows of pixels that read each texel of each billboard, of every view: V tensors of int64 [texel, row] pairs, [K, 2]."""
    texels, _ = samples(cloud, camera)
    hit = within(texels, cloud) & shown(cloud, camera)[..., None, None]
    first = cloud.texture_sizes.prod(-1).cumsum(0) - cloud.texture_sizes.prod(-1)
    pairs = []
    for v in range(len(hit)):
        found = []
        for n, (height, width) in enumerate(cloud.texture_sizes.tolist()):
            rows = hit[v, n].nonzero()[:, 0]
            corner = texels[v, n][hit[v, n]].floor().long()
            for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
                x, y = (corner[:, 0] + dx).clamp(0, width - 1), (corner[:, 1] + dy).clamp(0, height - 1)
                found.append(torch.stack([first[n] + y * width + x, rows], -1))
        pairs.append(torch.cat(found))
    return pairs


def test_every_pixel_that_hits_lies_in_its_box() -> None:
    hits = 0
    for cloud, camera in scenes(12):
        texels, _ = samples(cloud, camera)
        hit = within(texels, cloud) & shown(cloud, camera)[..., None, None]
        for (v, n), box in zip(
            torch.cartesian_prod(*map(torch.arange, hit.shape[:2])), project(cloud, camera).boxes.view(-1, 4), strict=True
        ):
            rows, columns = hit[v, n].nonzero().unbind(-1)
            left, right, top, bottom = box.tolist()
            assert ((columns >= left) & (columns <= right) & (rows >= top) & (rows <= bottom)).all()
            assert left >= 0 and right < camera.width and top >= 0 and bottom < camera.height
            hits += len(rows)
    assert hits > 30_000


def test_the_most_layers_are_those_of_the_pixel_that_is_in_most_boxes() -> None:
    most = 0
    for cloud, camera in scenes(12):
        projection = project(cloud, camera)
        y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        left, right, top, bottom = projection.boxes[..., None, None].unbind(2)
        inside = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        assert projection.most_layers == int(inside.sum(1).max())
        most = max(most, projection.most_layers)
    assert most == 3
    assert project(cloud.take([]), camera).most_layers == 0


def test_boxes_are_no_larger_than_they_must_be() -> None:
    """A rectangle of 2 m at 3 m, seen at 4 pixels a meter: its corners and its margins of a quarter meter are known."""
    cloud, camera = facing_cloud([3.0], [(8, 8)]), camera_on_z(33, 21, fov=None, extent=33 / 4)
    assert project(cloud, camera).boxes.tolist() == [[[16 - 4 - 1, 16 + 4 + 1, 10 - 4 - 1, 10 + 4 + 1]]]
    right = replace(cloud, centers=cloud.centers + torch.tensor([2.5, 0.0, 0.0]).double())
    assert project(right, camera).boxes.tolist() == [[[21, 31, 5, 15]]]
    clipped = replace(cloud, centers=cloud.centers + torch.tensor([4.0, 2.0, 0.0]).double())
    assert project(clipped, camera).boxes.tolist() == [[[27, 32, 0, 7]]]


def test_homographies_and_nearness_are_those_of_the_rays() -> None:
    """Measured at most 3e-4 texels of 60 and 2.2e-6 in nearness, of which 1e-5 decides on order; of a depth near 0 it is 3e-6 meters."""
    compared = 0
    for cloud, camera in scenes(12):
        projection, (texels, depth) = project(cloud, camera), samples(cloud, camera)
        pixels = torch.stack(torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy"), -1).float()
        pixels = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
        image = torch.einsum("vnij,hwj->vnhwi", projection.to_texel, pixels).double()
        near = torch.einsum("vni,hwi->vnhw", projection.nearness, pixels).double()
        hit = within(texels, cloud) & shown(cloud, camera)[..., None, None]
        scale = torch.ones_like(depth) if camera.orthographic else 1 / depth
        order = -depth if camera.orthographic else 1 / depth
        limit = 1e-5 * order.abs().clamp_min(1) if camera.orthographic else 5e-6 * order
        assert (((image[..., 2] - scale).abs() <= 5e-6 * scale) | ~hit).all()
        assert (((near - order).abs() <= limit) | ~hit).all()
        assert (((image[..., :2] / image[..., 2:] - texels).abs().amax(-1) < 1e-3) | ~hit).all()
        compared += int(hit.sum())
    assert compared > 30_000


def test_pixels_that_many_rows_apart_share_no_texel() -> None:
    useful, tight = 0, 0.0
    for cloud, camera in scenes(15):
        apart = project(cloud, camera).rows_apart.tolist()
        for rows, pairs in zip(apart, touched(cloud, camera), strict=True):
            assert 1 <= rows <= camera.height
            texel, row = pairs.unbind(-1)
            count = int(cloud.texture_sizes.prod(-1).sum())
            lowest = torch.full((count,), camera.height).scatter_reduce(0, texel, row, "amin")
            highest = torch.full((count,), -1).scatter_reduce(0, texel, row, "amax")
            spread = int((highest - lowest).max())
            assert spread < rows or rows == camera.height
            useful += rows <= camera.height / 4
            tight = max(tight, spread / rows)
    assert useful >= 20 and tight > 0.4


def test_a_floor_that_runs_under_the_camera_is_not_cut_up() -> None:
    """Its nearest texels fill rows without end, and more of the picture than any distance between bands but all of it."""
    axes = torch.eye(3)
    floor = cloud_of(torch.tensor([[0.0, -1, 0]]), axes[:1], -axes[2:], torch.full((1, 2), 50.0), [(9, 9)])
    camera = camera_on_z(20, 40, fov=70.0)
    rows = touched(floor, camera)[0][:, 1]
    assert len(rows.unique()) > 15 and project(floor, camera).rows_apart.tolist() == [40]


@pytest.mark.parametrize("fov", [40.0, None])
def test_upright_planes_on_a_ring_need_few_rows_apart(fov: float | None) -> None:
    """One texel a pixel: two pixels either way, and what perspective and rounding add. Magnified eight times, six times as many."""
    for elevation in (0.0, 30.0):
        camera = ring(CORNERS, 512, 512, elevation, fov)
        assert project(upright(512), camera).rows_apart.max() <= 7  # measured 5
        assert project(upright(64), camera).rows_apart.max() <= 35  # measured 29


CPU = torch.device("cpu")


def test_the_backward_pass_of_an_ordinary_view_runs_on_all_cores() -> None:
    projection = project(upright(512), ring(CORNERS, 512, 512))
    for v in range(len(projection)):
        phases = schedule(projection.take(torch.tensor([v])), CPU)
        bands = sorted((piece.begin, piece.end) for phase in phases for piece in phase)
        assert bands[0][0] == 0 and bands[-1][1] == 512 and all(end == begin for (_, end), (begin, _) in pairwise(bands))
        assert all(piece[:3] == (0, 0, 1) for phase in phases for piece in phase)
        assert all(len(phase) >= 2 for phase in phases)


def test_every_row_of_every_view_is_launched_once() -> None:
    """Views that are not worth cutting up go together, next to others that are cut up, or part by part where each part has its texels."""
    cloud, camera = upright(64), ring(CORNERS, 64, 64)
    wide = replace(project(cloud, camera), rows_apart=torch.tensor([7, 64, 64], dtype=torch.int32), least_pixels=1)
    for order, expected in (([0, 1, 2], 3), ([1, 2, 0], 3), ([1, 0, 2], 4), ([0, 0, 1], 5), ([1, 2, 1], 1)):
        phases = schedule(wide.take(torch.tensor(order)), CPU)
        assert launched(phases, 3) == [[(0, 64)]] * 3 and len(phases) == expected
    for gradients in (2, 3, 9):
        phases = schedule(wide, CPU, gradients)
        assert launched(phases, 3) == [[(0, 64)]] * 3
        assert {piece.gradient for phase in phases for piece in phase} == set(range(min(gradients, 3)))
        assert len(phases) == 2  # those of the view that is cut up, and at the same time the others
    assert schedule(wide.grouped(2), CPU) == [[(0, 0, 3, 0, 64), (0, 3, 3, 0, 64)]]


def launched(phases: list[list[Piece]], views: int) -> list[list[tuple[int, int]]]:
    """The rows of each view that were launched, with bands that meet joined."""
    rows: list[list[tuple[int, int]]] = [[] for _ in range(views)]
    for _, view, number, begin, end in sorted(piece for phase in phases for piece in phase):
        for v in range(view, view + number):
            if rows[v] and rows[v][-1][1] == begin:
                begin = rows[v].pop()[0]
            rows[v].append((begin, end))
    return rows


def test_bands_that_run_at_once_touch_different_texels() -> None:
    parallel = 0
    for cloud, camera in scenes(10):
        for v in range(len(camera.batch())):
            texel, row = touched(cloud, camera.batch()[v : v + 1])[0].unbind(-1)
            projection = replace(project(cloud, camera.batch()[v : v + 1]), least_pixels=1)
            for phase in schedule(projection, CPU):
                seen = [set(texel[(row >= piece.begin) & (row < piece.end)].tolist()) for piece in phase]
                assert len(set().union(*seen)) == sum(map(len, seen))
                parallel += len(phase) > 1
    assert parallel >= 20


def test_each_view_reads_the_texture_on_its_side() -> None:
    axes, n = torch.eye(3), 3
    cloud = cloud_of(torch.zeros(n, 3), axes[:1].expand(n, 3), axes[1:2].expand(n, 3), torch.ones(n, 2), [(2, 3), (4, 5), (1, 2)])
    cloud = replace(cloud, two_sided=torch.tensor([True, False, True]), texels=torch.zeros(2 * 6 + 20 + 2 * 2, 4))
    from_front = [[0, 2, 3], [12, 4, 5], [32, 1, 2]]
    from_back = [[6, 2, 3], [12, 4, 5], [34, 1, 2]]
    for fov in (35.0, None):
        camera = Orbit(4).frame(CORNERS, target=torch.zeros(3).double(), width=8, height=8, fov_x_degrees=fov)
        textures = project(cloud, camera).textures
        assert textures[0].tolist() == from_front and textures[2].tolist() == from_back


@pytest.mark.parametrize("fov", [60.0, None])
def test_what_is_not_drawn_has_an_empty_box(fov: float | None) -> None:
    plane, camera = facing_cloud([3.0], [(4, 4)]), camera_on_z(9, 7, fov=fov)
    left, right, top, bottom = project(plane, camera).boxes[0, 0].tolist()
    assert left < right and top < bottom
    edge_on = replace(plane, rights=torch.tensor([[0, 0, -1.0]]).double())
    level = replace(plane, ups=torch.tensor([[0, 0, -1.0]]).double())
    flat = replace(plane, half_extents=torch.tensor([[1.0, 0]]).double())
    aside = replace(plane, centers=torch.tensor([[0.0, 90, -3]]).double())
    beside = replace(plane, centers=torch.tensor([[-90.0, 0, -3]]).double())
    hidden = [edge_on, level, flat, aside, beside]
    if fov is not None:  # of a parallel projection the kernel itself looks at the depth
        hidden.append(facing_cloud([-3.0], [(4, 4)]))
    for cloud in hidden:
        projection = project(cloud, camera)
        left, right, top, bottom = projection.boxes[0, 0].tolist()
        assert left > right or top > bottom
        assert projection.to_texel.isfinite().all() and projection.nearness.isfinite().all()


def test_taking_views() -> None:
    cloud, camera = upright(8), ring(CORNERS, 16, 12)
    projection, chosen = project(cloud, camera), torch.tensor([2, 0, 2])
    some, expected = projection.take(chosen), project(cloud, camera[[2, 0, 2]])
    assert len(some) == 3 and some.count == 4
    for field in fields(Projection):
        ours, theirs = getattr(some, field.name), getattr(expected, field.name)
        assert torch.equal(ours, theirs) if isinstance(ours, Tensor) else ours == theirs


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("groups", [1, 2, 3, 6])
def test_groups_are_parts_of_the_billboards_in_views_of_their_own(groups: int, orthographic: bool) -> None:
    """Part by part: all views of the first, then all of the second. Textures stay where they are among all texels."""
    cloud, _ = random_scene(4, 6, orthographic=False)
    camera = ring(2 * CORNERS, 24, 40, 20.0, None if orthographic else 35.0)
    whole, first = project(cloud, camera), 0
    found = whole.grouped(groups)
    assert len(found) == 3 * groups and found.count == 6 // groups
    assert (found.width, found.height, found.orthographic) == (24, 40, orthographic)
    for number, part in enumerate(cloud.parts(groups)):
        own, alone = found.take(torch.arange(3 * number, 3 * number + 3)), project(part, camera)
        assert torch.equal(own.to_texel, alone.to_texel) and torch.equal(own.nearness, alone.nearness)
        assert torch.equal(own.textures - torch.tensor([first, 0, 0]), alone.textures) and torch.equal(own.boxes, alone.boxes)
        assert torch.equal(own.rows_apart, whole.rows_apart) and (own.rows_apart >= alone.rows_apart).all()
        first += len(part.texels)
    assert all(getattr(found, field.name).dtype == getattr(whole, field.name).dtype for field in fields(found)[:5])
    assert first == len(cloud.texels)


def test_gradients_of_homographies_reach_the_placement_only() -> None:
    cloud = replace(upright(4), centers=upright(4).centers.requires_grad_(), texels=upright(4).texels.requires_grad_())
    projection = project(cloud, ring(CORNERS, 9, 8))
    assert projection.to_texel.requires_grad and not projection.nearness.requires_grad
    projection.to_texel.sum().backward()
    assert cloud.centers.grad is not None and cloud.centers.grad.any() and cloud.texels.grad is None
