"""The projection by kernels against the one by torch, there and back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields, replace

import pytest
import torch
from scenes import (
    CORNERS,
    PLACEMENT,
    camera_on_z,
    cloud_of,
    facing_cloud,
    noise,
    placed_at,
    placement_of,
    random_scene,
    ring,
    scenes,
    upright,
)
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.fused import differentiate, draw
from bbfit.operators.drawing.projection import Projection, project
from bbfit.operators.drawing.projector import Projector
from bbfit.operators.drawing.reference import drawable

PARALLEL_OR_NOT = pytest.mark.parametrize("fov", [60.0, None])


def assert_same(found: Projection, wanted: Projection) -> None:
    """Whole numbers to the bit, and so are all others on the machine that this was measured on; float64 may round otherwise elsewhere."""
    for field in fields(Projection):
        ours, theirs = getattr(found, field.name), getattr(wanted, field.name)
        if not isinstance(theirs, Tensor):
            assert ours == theirs, field.name
        elif theirs.is_floating_point():
            torch.testing.assert_close(ours, theirs.detach(), atol=1e-9, rtol=1.2e-7)
        else:
            assert ours.dtype == theirs.dtype and torch.equal(ours, theirs), field.name


def orders(count: int) -> Iterable[list[int]]:
    """Views in order, in reverse, some of them more than once, a single one."""
    return [*range(count)], [*range(count)][::-1], [count - 1, 0, count - 1, count // 2, 0], [count // 2]


def test_random_scenes_are_projected_as_torch_projects_them() -> None:
    """Views in any order and number, of billboards that lie elsewhere than those that the projector was made of."""
    backs, everywhere, nowhere = 0, 0, 0
    for cloud, camera in [*scenes(12), *(random_scene(seed, 17, orthographic=seed % 2 == 1) for seed in range(12))]:
        elsewhere = replace(cloud, centers=cloud.centers + 7, rights=cloud.ups, ups=cloud.rights, half_extents=2 * cloud.half_extents)
        projector, placement, cameras = Projector(elsewhere.without_textures(), camera), placement_of(cloud), camera.batch()
        before, owned = placement.clone(), cloud.texture_sizes.prod(-1) * (1 + cloud.two_sided.long())
        first = owned.cumsum(0) - owned
        for chosen in orders(len(cameras)):
            found, wanted = projector.project(placement, chosen), project(cloud, cameras[chosen])
            assert_same(found, wanted)
            left, right, top, bottom = found.boxes.unbind(-1)
            backs += int((found.textures[..., 0] > first).sum())
            everywhere += int(((left == 0) & (right == camera.width - 1) & (top == 0) & (bottom == camera.height - 1)).sum())
            nowhere += int(((left > right) | (top > bottom)).sum())
        assert torch.equal(placement, before)
    assert backs > 500 and everywhere > 400 and nowhere >= 5


def test_cameras_in_float32_are_projected_as_torch_projects_them() -> None:
    for cloud, camera in scenes(3):
        cameras = camera.batch().to(torch.float32)
        assert_same(Projector(cloud, cameras).project(placement_of(cloud), range(len(cameras))), project(cloud, cameras))


def special_planes() -> dict[str, BillboardCloud]:
    """Planes in front of ``camera_on_z`` of which little or nothing is seen."""
    plane, axes = facing_cloud([3.0], [(4, 6)]), torch.eye(3).double()
    return {
        "facing": plane,
        "edge-on": replace(plane, rights=-axes[2:]),
        "edge-on, two sides": replace(plane, rights=-axes[2:], two_sided=torch.tensor([True]), texels=torch.zeros(48, 4).double()),
        "level": replace(plane, ups=-axes[2:]),
        "nearly edge-on": replace(plane, rights=torch.tensor([[0.9e-5, 0, -1]]).double()),
        "hardly seen": replace(plane, rights=torch.tensor([[1.2e-5, 0, -1]]).double(), centers=torch.tensor([[0.0, 0.3, -3]]).double()),
        "flat": replace(plane, half_extents=torch.tensor([[1.0, 0]]).double()),
        "thin": replace(plane, half_extents=torch.tensor([[0.0, 1]]).double()),
        "above": replace(plane, centers=torch.tensor([[0.0, 90, -3]]).double()),
        "below": replace(plane, centers=torch.tensor([[0.0, -90, -3]]).double()),
        "left": replace(plane, centers=torch.tensor([[-90.0, 0, -3]]).double()),
        "right": replace(plane, centers=torch.tensor([[90.0, 0, -3]]).double()),
        "cut off": replace(plane, centers=torch.tensor([[1.3, -0.9, -3]]).double()),
        "behind": facing_cloud([-3.0], [(4, 6)]),
        "behind, up to beside": cloud_of(torch.tensor([[0, 2, 0.75]]), axes[:1], (axes[1:2] - axes[2:]) / 2, torch.ones(1, 2), [(2, 2)]),
        "right before the camera": facing_cloud([5e-10], [(4, 6)], (1e-10, 1e-10)),
        "around the camera": facing_cloud([0.0], [(4, 6)]),
        "under the camera": cloud_of(torch.tensor([[0.0, -1, 0]]), axes[:1], -axes[2:], torch.full((1, 2), 50.0), [(9, 9)]),
        "from the back": replace(plane, rights=-plane.rights, two_sided=torch.tensor([True]), texels=torch.zeros(48, 4).double()),
    }


@PARALLEL_OR_NOT
@pytest.mark.parametrize("name", special_planes())
def test_planes_of_which_little_or_nothing_is_seen(name: str, fov: float | None) -> None:
    cloud, camera = special_planes()[name], camera_on_z(9, 7, fov=fov)
    found = Projector(cloud, camera).project(placement_of(cloud), [0])
    assert_same(found, project(cloud, camera))
    assert found.to_texel.isfinite().all() and found.nearness.isfinite().all()


@PARALLEL_OR_NOT
def test_all_of_these_planes_side_by_side(fov: float | None) -> None:
    """Each has its own texels, and the row distance is that of the worst of them."""
    planes, camera = special_planes(), camera_on_z(9, 7, fov=fov)
    cloud = BillboardCloud.joined([*planes.values()])
    found = Projector(cloud, camera).project(placement_of(cloud), [0, 0])
    assert_same(found, project(cloud, camera.batch()[[0, 0]]))
    boxes = zip(planes, found.boxes[0].tolist(), strict=True)
    hidden = {name for name, (left, right, top, bottom) in boxes if left > right or top > bottom}
    assert {"edge-on", "level", "nearly edge-on", "flat", "thin", "above", "below", "left", "right"} <= hidden
    assert not {"facing", "hardly seen", "cut off", "from the back"} & hidden


@pytest.mark.parametrize(("count", "chosen"), [(0, [1, 0]), (4, []), (0, [])])
def test_no_billboards_or_no_views(count: int, chosen: list[int]) -> None:
    cloud, camera = upright(8).take(range(count)), ring(CORNERS, 16, 12)
    projector = Projector(cloud, camera)
    found = projector.project(placement_of(cloud), chosen)
    assert_same(found, project(cloud, camera[chosen]))
    assert len(found) == len(chosen) and found.count == count and found.rows_apart.tolist() == [1] * len(chosen)
    back = projector.pull_back(torch.zeros(len(chosen), count, 3, 3, dtype=torch.float64))
    assert back.shape == (count, 11) and not back.any()


def test_what_was_projected_before_stays() -> None:
    cloud, camera = upright(8), ring(CORNERS, 16, 12)
    projector, placement = Projector(cloud, camera), placement_of(cloud)
    first = projector.project(placement, [0, 1])
    projector.project(placement + 0.1, [2, 0])
    assert_same(first, project(cloud, camera[[0, 1]]))


@PARALLEL_OR_NOT
def test_pictures_and_gradients_are_the_same_bytes(fov: float | None) -> None:
    """Of the projection that kernels have made, by the kernels that draw."""
    cloud, _ = random_scene(4, 6, orthographic=False)
    camera, chosen = ring(2 * CORNERS, 40, 30, 20.0, fov), [2, 0, 2]
    texels = noise(cloud).texels.float()
    projections = (Projector(cloud, camera).project(placement_of(cloud), chosen), project(cloud, camera[chosen]))
    images, gradients, matrices = [], [], []
    for projection in projections:
        images.append(draw(texels, projection))
        gradients.append(torch.zeros_like(texels))
        matrices.append(differentiate(texels, projection, gradients[-1], image_gradient=images[-1], placement=True)[1])
    assert images[0].any() and gradients[0].any()
    torch.testing.assert_close(images[0], images[1], atol=1e-4, rtol=0)
    assert torch.equal(*images) and torch.equal(*gradients) and torch.equal(*matrices)


def weights_of(shape: Sequence[int], seed: int = 0) -> Tensor:
    """A random gradient in ``to_texel``: float64, but of values that float32 has, in which autograd passes it on."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def through_torch(cloud: BillboardCloud, cameras: Camera, of_matrices: Tensor) -> Tensor:
    """What autograd makes of it, [N, 11]."""
    leaf = placement_of(cloud).requires_grad_()
    matrices = project(placed_at(cloud, leaf), cameras).to_texel
    return torch.autograd.grad(matrices, leaf, of_matrices.to(matrices))[0]


def assert_same_gradient(found: Tensor, wanted: Tensor, limit: float = 1e-12) -> None:
    """Of every billboard, in its center, its right, its up and its half extents each."""
    assert found.shape == wanted.shape and found.dtype == torch.float64
    for name, ours, theirs in zip(PLACEMENT, *(gradient.split((3, 3, 3, 2), -1) for gradient in (found, wanted)), strict=True):
        error, size = (ours - theirs).norm(dim=-1), theirs.norm(dim=-1)
        assert (error <= limit * size).all(), (name, float((error / size).max()))


def test_gradients_are_autograds() -> None:
    """Also of views that were chosen more than once, which count as often."""
    for cloud, camera in scenes(12):
        projector, placement, cameras = Projector(cloud.without_textures(), camera), placement_of(cloud), camera.batch()
        for seed, chosen in enumerate(orders(len(cameras))):
            weights = weights_of((len(chosen), 3, 3, 3), seed)
            projector.project(placement, chosen)
            assert_same_gradient(projector.pull_back(weights), through_torch(cloud, cameras[chosen], weights))


@PARALLEL_OR_NOT
def test_gradients_of_special_planes_are_autograds(fov: float | None) -> None:
    """What is not drawn has no gradient, and adds none. Of a plane half a nanometre away rounding leaves seven digits."""
    planes, camera = special_planes(), camera_on_z(9, 7, fov=fov)
    del planes["right before the camera"]
    cloud = BillboardCloud.joined([*planes.values()])
    seen = drawable(cloud, camera.batch())[0]
    weights = weights_of((1, len(cloud), 3, 3)) * seen[:, None, None]
    projector = Projector(cloud, camera)
    projector.project(placement_of(cloud), [0])
    found, wanted = projector.pull_back(weights), through_torch(cloud, camera.batch(), weights)
    assert 5 < int(seen.sum()) < len(seen) and not found[~seen].any() and not wanted[~seen].any()
    assert_same_gradient(found[seen], wanted[seen], 1e-9)


def test_gradients_go_back_to_what_was_projected_last() -> None:
    cloud, camera = facing_cloud([3.0, 4.0], [(4, 4), (3, 6)]), ring(CORNERS, 16, 12, 20.0)
    projector, weights = Projector(cloud, camera), weights_of((2, 2, 3, 3))
    moved = replace(cloud, centers=cloud.centers + 0.1)
    projector.project(placement_of(cloud), [0, 1])
    first = projector.pull_back(weights)
    projector.project(placement_of(moved), [2, 1])
    second, again = projector.pull_back(weights), projector.pull_back(weights)
    assert_same_gradient(first, through_torch(cloud, camera[[0, 1]], weights))
    assert_same_gradient(second, through_torch(moved, camera[[2, 1]], weights))
    assert torch.equal(second, again)


def test_the_gradient_in_the_matrices_need_not_be_contiguous() -> None:
    cloud, camera = facing_cloud([3.0, 4.0], [(4, 4), (3, 6)]), ring(CORNERS, 16, 12, 20.0)
    projector, weights = Projector(cloud, camera), weights_of((3, 2, 3, 3))
    projector.project(placement_of(cloud), [0, 1, 2])
    strided = weights.transpose(0, 1).contiguous().transpose(0, 1)
    assert not strided.is_contiguous()
    assert torch.equal(projector.pull_back(strided), projector.pull_back(weights))
