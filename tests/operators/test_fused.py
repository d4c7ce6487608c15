"""The fused renderer against the reference in float64: pictures, gradients, losses, and what it promises beyond."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from scenes import CORNERS, PLACEMENT, camera_on_z, cloud_of, facing_cloud, noise, random_scene, ring, ring_of, rolled, tracked
from torch import Tensor

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit
from bbfit.operators.drawing import fused
from bbfit.operators.drawing.fused import differentiate, render_fused, render_projection
from bbfit.operators.drawing.kernels import kernels
from bbfit.operators.drawing.projection import Projection, project
from bbfit.operators.drawing.reference import render_reference
from bbfit.operators.image_loss.fused import PixelLoss
from bbfit.rendering.dispatch import render

# Relative L2 of a picture and of each of its gradients, for all scenes here. Float32 rounds texel coordinates to about 1e-7 of the texture,
# a hundred times more on planes seen at a degree, and a gradient in the placement differentiates noise: 2e-6 is usual (the median is held
# to TYPICAL), 2.4e-4 was the most over 230 random scenes, in two where a sample lies as near as that to a kink of the filter.
ALLOWED, TYPICAL = 5e-4, 3e-6
NAMES = ("image", "texels", *PLACEMENT)


def drawn(renderer: Callable[[BillboardCloud, Camera], Tensor], cloud: BillboardCloud, camera: Camera, seed: int = 0) -> dict[str, Tensor]:
    """The picture, and the gradients of a random linear functional of it, by the names in NAMES."""
    followed, leaves = tracked(cloud)
    image = renderer(followed, camera)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    (image * weights.to(image.dtype)).sum().backward()
    gradients = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    return {"image": image.detach(), **gradients}


def error(ours: Tensor, exact: Tensor) -> float:
    """Relative L2, after the cosine was found to be as near to 1 as ALLOWED implies; nothing must stay exactly nothing."""
    ours, exact = ours.double().flatten(), exact.double().flatten()
    assert ours.isfinite().all()
    if not exact.any():
        assert not ours.any()
        return 0.0
    assert float(ours @ exact) >= (1 - ALLOWED**2) * float(ours.norm() * exact.norm())
    return float((ours - exact).norm() / exact.norm())


def launched(**launch: int) -> Callable[[BillboardCloud, Camera], Tensor]:
    """The fused renderer with another way of launching its kernels, by fields of the projection."""

    def renderer(cloud: BillboardCloud, camera: Camera) -> Tensor:
        image = render_projection(cloud.texels, replace(project(cloud, camera), **launch))
        return image if camera.batched else image[0]

    return renderer


def errors(cloud: BillboardCloud, camera: Camera, renderer: Callable[[BillboardCloud, Camera], Tensor] = render_fused) -> dict[str, float]:
    """Relative L2 of the picture and of every gradient, none above ALLOWED."""
    exact = drawn(render_reference, cloud.to(torch.float64), camera)
    ours = drawn(renderer, cloud.to(torch.float32), camera)
    assert ours["image"].shape == exact["image"].shape and ours["image"].dtype == torch.float32
    found = {name: error(ours[name], exact[name]) for name in NAMES}
    assert max(found.values()) <= ALLOWED, found
    return found


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("count", [0, 1, 3, 17])
def test_random_scenes(count: int, orthographic: bool) -> None:
    """One- and two-sided, 1x1 to 8x8 texels, a quarter each opaque and transparent, odd sizes, behind and about the camera."""
    found, covered = [], 0
    for seed in range(20):
        cloud, camera = random_scene(seed, count, orthographic=orthographic)
        found += list(errors(cloud, camera).values())
        covered += bool(render_fused(cloud.to(torch.float32), camera).any())
    assert covered >= (14 if count else 0)
    assert torch.tensor(found).median() <= TYPICAL  # measured 1.2e-6


@pytest.mark.parametrize("orthographic", [False, True])
def test_more_than_sixty_four_billboards(orthographic: bool) -> None:
    errors(*random_scene(3, 65, orthographic=orthographic))


@pytest.mark.parametrize("alpha", [AlphaMode(), AlphaMode("coverage", 0.4, samples=0), AlphaMode("mask", hardness=2.0, antialiased=True)])
@pytest.mark.parametrize("orthographic", [False, True])
def test_billboards_smaller_than_a_tile(alpha: AlphaMode, orthographic: bool) -> None:
    """Most pixels of a tile meet few of its layers, which are then sorted for each pixel alone."""
    cloud, camera = random_scene(5, 150, orthographic=orthographic)
    errors(replace(cloud, half_extents=0.2 * cloud.half_extents, alpha=alpha), camera)


@pytest.mark.parametrize("count", [4, 5])
def test_as_many_layers_in_a_pixel_as_a_kernel_has_room_for(count: int) -> None:
    cloud = facing_cloud([3.0 + n for n in range(count)][::-1], [(4, 6)] * count, (5.0, 5.0))
    faint = cloud.texels.clone()
    faint[:, 3] *= 0.3
    found = errors(cloud.with_texels(faint), camera_on_z(10, 6, fov=53.0))
    assert found["image"] < 1e-6  # measured 1.4e-7


def test_a_batch_of_views_is_its_views_one_by_one() -> None:
    cloud, _ = random_scene(1, 3, orthographic=False)
    position = 4 * torch.rand(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2
    camera = Camera(look_at(position, torch.zeros(3).double()), pinhole_intrinsics(60, 13, 6).repeat(5, 1, 1), 13, 6)
    errors(cloud, camera)
    images = render_fused(cloud.to(torch.float32), camera)
    assert images.shape == (5, 6, 13, 4)
    for v in range(5):
        single = render_fused(cloud.to(torch.float32), camera[v])
        assert single.shape == (6, 13, 4) and torch.equal(single, images[v])


def aside(width: int, height: int, *, fov: float | None = 60.0) -> Camera:
    """``camera_on_z`` a little off the axis, lest rows of texels and of pixels coincide: the filter has its kinks there."""
    camera = camera_on_z(width, height, fov=fov)
    return replace(camera, intrinsics=camera.intrinsics + torch.tensor([[0, 0, 0.137], [0, 0, -0.223], [0, 0, 0]]).double())


class Scene(NamedTuple):
    cloud: BillboardCloud
    camera: Camera


def turned(sine: float) -> BillboardCloud:
    """A plane through the optical axis of ``camera_on_z``, ``sine`` away from edge-on, in front of one that faces it."""
    cloud = facing_cloud([3.0, 4.0], [(4, 4), (3, 6)])
    rights = cloud.rights.clone()
    rights[0] = torch.tensor([sine, 0, (1 - sine**2) ** 0.5])
    return replace(cloud, rights=rights)


def floor_and_ceiling(sizes: list[tuple[int, int]], heights: list[float]) -> BillboardCloud:
    """Level planes that run below and above ``camera_on_z``, at an angle to it, each about a center of its own."""
    n, turn = len(sizes), torch.tensor(0.7)
    right = torch.stack([turn.cos(), torch.zeros(()), turn.sin()])
    up = torch.stack([-turn.sin(), torch.zeros(()), turn.cos()])
    centers = torch.stack([torch.arange(n) * -2.3 + 0.4, torch.tensor(heights), torch.arange(n) * 1.1 + 2.1], -1)
    return cloud_of(centers, right.expand(n, 3), up.expand(n, 3), torch.full((n, 2), 50.0), sizes)


def crossing(count: int) -> BillboardCloud:
    """Upright planes through an axis that lies in the middle column of an odd picture; no row of texels lies in a row of pixels."""
    axis, half_extents = torch.tensor([0.0, 0, -4]).double(), torch.ones(2).double()
    return noise(even_upright(count, axis=axis, half_extents=half_extents, texture_sizes=torch.tensor([8, 6])))


def with_alpha(cloud: BillboardCloud, alphas: list[float]) -> BillboardCloud:
    """The cloud with a uniform opacity on each billboard."""
    texels = cloud.texels.clone()
    texels[:, 3] = torch.tensor(alphas).double().repeat_interleave(cloud.texture_sizes.prod(-1))
    return cloud.with_texels(texels)


def sparse(cloud: BillboardCloud) -> BillboardCloud:
    """The cloud with one texel in a hundred; the others are transparent."""
    chosen = torch.rand(len(cloud.texels), generator=torch.Generator().manual_seed(0)) < 0.01
    return cloud.with_texels(torch.where(chosen[:, None], cloud.texels, 0))


SCENES: dict[str, Callable[[], Scene]] = {
    "wide": lambda: Scene(noise(turned(0.6)), aside(31, 5)),
    "tall": lambda: Scene(noise(turned(0.6)), aside(4, 33)),
    "one pixel": lambda: Scene(turned(0.6), aside(1, 1)),
    "edge-on": lambda: Scene(turned(0.0), aside(9, 7)),
    "edge-on, even size": lambda: Scene(turned(0.9e-5), aside(8, 6)),
    "three degrees off": lambda: Scene(noise(turned(0.05)), aside(33, 7, fov=10.0)),
    "behind": lambda: Scene(facing_cloud([-3.0, 4.0], [(4, 4), (3, 6)]), aside(9, 7)),
    "all behind": lambda: Scene(facing_cloud([-3.0, -4.0], [(4, 4), (3, 6)]), aside(9, 7)),
    "all behind, parallel": lambda: Scene(facing_cloud([-3.0, -4.0], [(4, 4), (3, 6)]), aside(9, 7, fov=None)),
    "partly behind": lambda: Scene(floor_and_ceiling([(6, 6), (5, 8)], [-1.0, 1.0]), rolled(aside(24, 17), 33)),
    "camera on a plane": lambda: Scene(facing_cloud([0.0, 4.0], [(4, 4), (3, 6)]), aside(9, 7)),
    "no area": lambda: Scene(
        replace(turned(0.6), half_extents=torch.tensor([[0.0, 1], [1, 1]]).double()), aside(9, 7)
    ),
    "narrow and sparse": lambda: Scene(
        sparse(facing_cloud([3.0, 4.0], [(99, 14), (120, 21)], (0.4, 2.4))), rolled(aside(64, 64), 10)
    ),
    "off-screen": lambda: Scene(replace(turned(0.6), centers=torch.tensor([[500.0, 0, -3], [0, 70, -3]]).double()), aside(9, 7)),
    "one texel": lambda: Scene(facing_cloud([3.0], [(1, 1)]), aside(12, 7)),
    "one row, one column": lambda: Scene(facing_cloud([3.0, 4.0], [(1, 6), (6, 1)]), aside(12, 7)),
    "opaque behind opaque": lambda: Scene(
        with_alpha(facing_cloud([4.0, 3.0, 5.0], [(4, 4), (3, 6), (5, 5)]), [1, 1, 1]), aside(16, 12)
    ),
    "transparent": lambda: Scene(with_alpha(facing_cloud([4.0, 3.0], [(4, 4), (3, 6)]), [0, 0]), aside(16, 12)),
    "opaque behind transparent": lambda: Scene(
        with_alpha(facing_cloud([4.0, 3.0, 5.0], [(4, 4), (3, 6), (5, 5)]), [1, 0, 0.5]), aside(16, 12)
    ),
    "crossing at pixel centers": lambda: Scene(crossing(5), camera_on_z(33, 17, fov=40.0)),
    "many crossing at pixel centers": lambda: Scene(crossing(16), camera_on_z(65, 5, fov=40.0)),
    "crossing at pixel centers, parallel": lambda: Scene(crossing(5), camera_on_z(33, 17, fov=None)),
    "coincident": lambda: Scene(floor_and_ceiling([(6, 6), (5, 8), (9, 2)], [-1.0, -1.0, -1.0]), rolled(aside(24, 17), 33)),
    "coincident, parallel": lambda: Scene(facing_cloud([3.0, 3.0], [(4, 4), (3, 6)]), aside(17, 12, fov=None)),
}  # fmt: skip


@pytest.mark.parametrize("scene", SCENES)
def test_special_scenes(scene: str) -> None:
    cloud, camera = SCENES[scene]()
    errors(cloud, camera)


def test_each_side_of_a_two_sided_billboard() -> None:
    axes = torch.eye(3)
    cloud = cloud_of(torch.tensor([[0.0, 0, -3]]), axes[:1], axes[1:2], torch.ones(1, 2), [(3, 4)], two_sided=True)
    for right, hidden in ((cloud.rights, slice(12, 24)), (-cloud.rights, slice(0, 12))):
        shown = replace(cloud, rights=right)
        errors(shown, aside(9, 7))
        gradient = drawn(render_fused, shown.to(torch.float32), aside(9, 7))["texels"]
        assert not gradient[hidden].any() and gradient.any()


def test_planes_at_the_edge_on_threshold_give_finite_pictures_and_gradients() -> None:
    """Their slivers' texels are uncertain in float32, as they are in the reference in float32."""
    for sine in (1.1e-5, 1e-4, 1e-3):
        for camera in (camera_on_z(9, 7), camera_on_z(8, 6), camera_on_z(9, 7, fov=None)):
            assert all(tensor.isfinite().all() for tensor in drawn(render_fused, turned(sine).to(torch.float32), camera).values())


def test_noise_a_texel_a_pixel() -> None:
    """Every texel random, so the picture's error is that of the texel coordinates: measured 1.3e-5, and 2.6e-5 by the reference."""
    cloud, camera = ring_of(256)
    exact = drawn(render_reference, cloud.to(torch.float64), camera)
    ours, reference = (drawn(renderer, cloud, camera) for renderer in (render_fused, render_reference))
    for name in ("image", "texels"):  # in the placement so many samples are near to kinks that neither has a gradient in float32
        assert error(ours[name], exact[name]) < min(1e-4, error(reference[name], exact[name]))


def test_the_same_bytes_again() -> None:
    cloud, camera = ring_of(256)
    once, again = (drawn(render_fused, cloud, camera) for _ in range(2))
    assert all(torch.equal(once[name], again[name]) for name in NAMES)


@pytest.mark.usefixtures("threads")
def test_the_same_bytes_with_any_number_of_threads() -> None:
    """Large enough for eight bands of rows on two threads and four on one."""
    cloud, camera = ring_of(256)
    results = []
    for number in (1, 2, 3, 2):
        torch.set_num_threads(number)
        results.append(drawn(render_fused, cloud, camera))
    for other in results[1:]:
        assert [name for name in NAMES if not torch.equal(other[name], results[0][name])] == []


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("seed", range(3))
def test_bands_of_rows_lose_nothing(seed: int) -> None:
    """Pictures cut as finely as their planes allow, on four threads: no addition to a texel of two bands is lost."""
    torch.set_num_threads(4)
    cloud, _ = random_scene(seed, 3, orthographic=False)
    corners = 2 * CORNERS
    camera = Orbit(5, (30.0,)).frame(corners, target=torch.zeros(3).double(), width=45, height=150, fov_x_degrees=None if seed == 1 else 40)
    assert (project(cloud, camera).rows_apart < 35).any()
    finely = launched(least_pixels=1)
    results = [drawn(finely, cloud.to(torch.float32), camera) for _ in range(3)]
    assert all(torch.equal(results[0][name], other[name]) for other in results[1:] for name in NAMES)
    errors(cloud, camera, finely)


def test_the_gradient_in_the_placement_costs_the_texels_nothing() -> None:
    cloud, camera = ring_of(32)
    projection, of_image = project(cloud, camera), torch.randn(2, 32, 32, 4, generator=torch.Generator().manual_seed(0))
    gradients = [torch.zeros_like(cloud.texels) for _ in range(2)]
    for gradient, placement in zip(gradients, (False, True), strict=True):
        sums, matrices = differentiate(cloud.texels, projection, gradient, image_gradient=of_image, placement=placement)
        assert sums is None and (matrices is not None) == placement
    assert gradients[0].any() and torch.equal(*gradients)


class Backward(NamedTuple):
    texels: Tensor
    sums: Tensor
    matrices: Tensor


def backward(texels: Tensor, projection: Projection, pictures: Tensor, norm: str = "l2") -> Backward:
    """All that the backward pass tells of a loss against pictures, plus a linear functional made of them."""
    of_texels, of_image = torch.zeros_like(texels), pictures.float().roll(3, 1) - 100
    loss = PixelLoss(pictures, True, norm, 30.0)
    sums, matrices = differentiate(texels, projection, of_texels, image_gradient=of_image, loss=loss, placement=True)
    assert sums is not None and matrices is not None
    return Backward(of_texels, sums, matrices)


def six_in_groups(groups: int, width: int, height: int) -> tuple[BillboardCloud, Camera, Tensor]:
    """One- and two-sided billboards with textures of all sizes, three views, and other random pictures for each group, partly empty."""
    cloud, camera = random_scene(4, 6, orthographic=False)[0].to(torch.float32), ring(2 * CORNERS, width, height, 20.0)
    pictures = torch.randint(0, 256, (3 * groups, height, width, 4), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    pictures[:, : height // 3] = 0
    return cloud, camera, pictures


def one_by_one(cloud: BillboardCloud, camera: Camera, pictures: Tensor, norm: str, groups: int) -> Backward:
    """What groups tell that are not side by side, put side by side."""
    parts = zip(cloud.parts(groups), pictures.split(3), strict=True)
    alone = [backward(part.texels, project(part, camera), own, norm) for part, own in parts]
    return Backward(*(torch.cat(tensors) for tensors in zip(*alone, strict=True)))


@pytest.mark.parametrize("norm", ["l1", "l2", "backgrounds"])
@pytest.mark.parametrize("groups", [2, 3, 6])
def test_groups_side_by_side_are_the_groups_one_by_one(groups: int, norm: str) -> None:
    """To the bit, in pictures too small to be cut up."""
    cloud, camera, pictures = six_in_groups(groups, 40, 30)
    found = backward(cloud.texels, project(cloud, camera).grouped(groups), pictures, norm)
    expected = one_by_one(cloud, camera, pictures, norm, groups)
    assert expected.texels.any() and expected.matrices.flatten(1).any(-1).all() and len(expected.sums.unique()) == 3 * groups
    for name, ours, theirs in zip(Backward._fields, found, expected, strict=True):
        assert torch.equal(ours, theirs), name


@pytest.mark.usefixtures("threads")
def test_groups_have_the_same_bytes_with_any_number_of_threads() -> None:
    """In pictures so large that those of a group on its own are cut up, whose sums then have another order."""
    cloud, camera, pictures = six_in_groups(3, 256, 256)
    results = []
    for number in (1, 2, 3, 2):
        torch.set_num_threads(number)
        results.append(backward(cloud.texels, project(cloud, camera).grouped(3), pictures))
    for other in results[1:]:
        assert all(torch.equal(ours, first) for ours, first in zip(other, results[0], strict=True))
    expected = one_by_one(cloud, camera, pictures, "l2", 3)
    assert torch.equal(results[0].sums, expected.sums) and torch.equal(results[0].matrices, expected.matrices)
    assert error(results[0].texels, expected.texels) < 1e-5


def test_only_what_is_asked_for_gets_a_gradient() -> None:
    cloud, camera = ring_of(16)
    followed, leaves = tracked(cloud)
    render_fused(replace(followed, texels=cloud.texels), camera).sum().backward()
    assert leaves["centers"].grad is not None and leaves["texels"].grad is None
    followed, leaves = tracked(cloud)
    render_fused(cloud.with_texels(followed.texels), camera).sum().backward()
    assert leaves["texels"].grad is not None and leaves["centers"].grad is None
    assert not render_fused(cloud, camera).requires_grad


def test_texels_and_gradients_need_not_be_contiguous() -> None:
    cloud, camera = ring_of(16)
    leaf = torch.tensor([0.2, 0.4, 0.6, 0.5], requires_grad=True)
    render_fused(cloud.with_texels(leaf.expand(cloud.texels.shape)), camera).mean().backward()  # of an expanded scalar
    other = leaf.detach().clone().requires_grad_()
    render_fused(cloud.with_texels(other.repeat(len(cloud.texels), 1)), camera).mean().backward()
    assert torch.equal(leaf.grad, other.grad) and leaf.grad.any()


def test_auto_takes_the_reference_for_float64_and_the_kernels_otherwise() -> None:
    cloud, camera = ring_of(16)
    exact = cloud.to(torch.float64)
    assert torch.equal(render(exact, camera), render_reference(exact, camera))
    assert torch.equal(render(cloud, camera), render_fused(cloud, camera))
    assert torch.equal(render(cloud, camera, backend="reference"), render_reference(cloud, camera))
    kernels = render(exact, camera, backend="fused")
    assert kernels.dtype == torch.float64 and torch.equal(kernels, render_fused(cloud, camera).double())


@pytest.mark.parametrize("count", [1, 3, 17])
def test_a_thread_a_pixel_gives_the_same(count: int) -> None:
    """The launch that a GPU gets, on the CPU: what differs between the two is then only the compiler and atomic addition."""
    for seed in range(5):
        for orthographic in (False, True):
            assert max(errors(*random_scene(seed, count, orthographic=orthographic), launched(lanes=1)).values()) < ALLOWED


def test_a_single_pixel_has_room_for_its_layers_not_for_all_billboards(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, where threads have little memory: 60 small billboards are scattered, and a pixel meets at most eight of them."""
    rooms = list[int]()
    monkeypatch.setattr(fused, "kernels", lambda capacity, lanes: rooms.append(capacity) or kernels(capacity, lanes))
    for seed in range(3):
        cloud, _ = random_scene(seed, 60, orthographic=False)
        cloud = replace(cloud, half_extents=0.06 * cloud.half_extents)
        assert max(errors(cloud, camera_on_z(24, 20), launched(lanes=1)).values()) < ALLOWED
    assert set(rooms) == {4, 8}
