"""Gradients of the reference renderer: right where the picture is smooth, finite everywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scenes import PLACEMENT, camera_on_z, cloud_of, facing_cloud, random_scene, rolled, tracked
from torch import Tensor

from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.homography import pixel_depth, texel_to_pixel
from bbfit.operators.drawing.reference import render_reference


def placed(centers: Tensor, angles: Tensor, half_extents: Tensor, texels: Tensor, like: BillboardCloud) -> BillboardCloud:
    """Rectangles turned by an azimuth and tilted by an elevation, [N, 2]: their axes stay orthonormal under any change."""
    (cos_a, cos_b), (sin_a, sin_b) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rights = torch.stack([cos_a, torch.zeros_like(cos_a), -sin_a], -1)
    ups = torch.stack([sin_a * sin_b, cos_b, cos_a * sin_b], -1)
    return replace(like, centers=centers, rights=rights, ups=ups, half_extents=half_extents, texels=texels)


def distance_to_kinks(cloud: BillboardCloud, camera: Camera) -> float:
    """How near a sample comes to a texel center's row or column, in texels, or two planes' depths to each other, in meters.

    Bilinear filtering has a kink at the one and the picture a jump at the other, so finite differences need some room.
    """
    x, y = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).double().flatten(0, 1)
    texels = pixels @ torch.linalg.inv(texel_to_pixel(cloud, camera)).mT
    texels = texels[..., :2] / texels[..., 2:]  # [V, N, pixels, 2]
    near = ((texels > -2) & (texels < cloud.texture_sizes.flip(-1)[:, None] + 1)).all(-1)
    numerator, denominator = pixel_depth(cloud, camera)
    depths = (pixels @ numerator.mT) / (pixels @ denominator.mT)  # [V, pixels, N]
    gaps = depths.sort(-1).values.diff(dim=-1)
    return min(float((texels - texels.round()).abs()[near].min()), float(gaps.min()))


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("two_sided", [False, True])
def test_gradcheck(orthographic: bool, two_sided: bool) -> None:
    """Three crossing planes, two cameras, in float64, with respect to everything that can be fitted."""
    centers = torch.tensor([[0.03, 0.11, -0.02], [-0.21, 0.05, 0.13], [0.17, -0.08, 0.07]], dtype=torch.float64)
    angles = torch.tensor([[0.3, 0.1], [1.5, -0.2], [2.4, 0.05]], dtype=torch.float64)
    half_extents = torch.tensor([[1.1, 0.9], [0.8, 1.2], [1.3, 0.7]], dtype=torch.float64)
    axes = torch.eye(3).expand(3, 3, 3)
    like = cloud_of(centers, axes[:, 0], axes[:, 1], half_extents, [(3, 2), (2, 3), (2, 2)], two_sided=two_sided)
    position = torch.tensor([[1.0, 0.7, 3.1], [-2.2, 1.1, 1.9]], dtype=torch.float64)
    intrinsics = orthographic_intrinsics(3.1, 5, 4) if orthographic else pinhole_intrinsics(53, 5, 4)
    camera = Camera(look_at(position, torch.tensor([0.05, 0.02, 0.0]).double()), intrinsics.repeat(2, 1, 1), 5, 4, orthographic)
    leaves = [t.clone().requires_grad_() for t in (centers, angles, half_extents, like.texels)]
    # Finite differences move a sample by about 1e-5 texels.
    assert distance_to_kinks(placed(centers, angles, half_extents, like.texels, like), camera) > 1e-4

    def draw(*values: Tensor) -> Tensor:
        return render_reference(placed(*values, like), camera)

    for leaf in leaves:
        (gradient,) = torch.autograd.grad(draw(*leaves).square().sum(), leaf)
        assert (gradient != 0).any()
    assert torch.autograd.gradcheck(draw, leaves, eps=1e-6, atol=1e-7, rtol=1e-5)


def finite_gradients(cloud: BillboardCloud, camera: Camera) -> dict[str, Tensor]:
    """Gradients of a quadratic loss, after checking that they and the picture are finite."""
    cloud, leaves = tracked(cloud)
    image = render_reference(cloud, camera)
    assert image.isfinite().all()
    (image - 0.3).square().sum().backward()
    gradients = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    for name, gradient in gradients.items():
        assert gradient.isfinite().all(), name
    return gradients


def turned(sine: float) -> BillboardCloud:
    """A plane through the optical axis of ``camera_on_z``, ``sine`` away from edge-on, in front of one that faces it."""
    cloud = facing_cloud([3.0, 4.0], [(4, 4), (3, 5)])
    rights = cloud.rights.clone()
    rights[0] = torch.tensor([sine, 0, (1 - sine**2) ** 0.5])
    return replace(cloud, rights=rights)


def pairs() -> BillboardCloud:
    """Two pairs, one seen end-on by ``camera_on_z``: its planes lie beside the optical axis."""
    axis, half_extents = torch.tensor([0.0, 0, -6]).double(), torch.full((2,), 2.0).double()
    return even_upright(2, axis=axis, half_extents=half_extents, texture_sizes=torch.tensor([4, 4]), sides="pair", gap=0.4)


def floor_and_ceiling() -> BillboardCloud:
    """Two level planes that run below and above ``camera_on_z``."""
    axes = torch.eye(3)
    centers = torch.tensor([[0.0, -1, 0], [0, 1, 0]])
    return cloud_of(centers, axes[:1].expand(2, 3), axes[2:].expand(2, 3), torch.full((2, 2), 50.0), [(6, 6), (6, 6)])


SCENES: dict[str, Callable[[], BillboardCloud]] = {
    "no billboards": lambda: facing_cloud([], []),
    "edge-on": lambda: turned(0.0),
    "at the edge-on threshold": lambda: turned(1.1e-5),
    "nearly edge-on": lambda: turned(1e-3),
    "camera on the plane": lambda: facing_cloud([0.0, 4.0], [(4, 4), (4, 4)]),
    "behind": lambda: facing_cloud([-3.0, 4.0], [(4, 4), (4, 4)]),
    "all behind": lambda: facing_cloud([-3.0], [(4, 4)]),
    "off-screen": lambda: replace(facing_cloud([3.0], [(4, 4)]), centers=torch.tensor([[500.0, 0, -3]]).double()),
    "coincident": lambda: facing_cloud([3.0, 3.0], [(4, 4), (4, 4)]),
    "no size": lambda: replace(facing_cloud([3.0, 4.0], [(4, 4), (4, 4)]), half_extents=torch.tensor([[0.0, 1], [1, 1]]).double()),
    "one texel": lambda: facing_cloud([3.0], [(1, 1)]),
    "pairs parallel to the axis": pairs,
    "floor and ceiling": floor_and_ceiling,
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite(scene: str, dtype: torch.dtype) -> None:
    cloud = SCENES[scene]().to(dtype)
    extremes = cloud.texels.clone()
    extremes[::3, 3], extremes[1::3, 3] = 0, 1
    for camera in (
        camera_on_z(8, 6, fov=60),
        camera_on_z(9, 7, fov=60),
        rolled(camera_on_z(9, 9, fov=60), 45),
        camera_on_z(9, 7, fov=None),
        camera_on_z(1, 1),
    ):
        for texels in (cloud.texels, extremes):
            finite_gradients(cloud.with_texels(texels), camera)


def test_gradients_are_finite_among_the_planes() -> None:
    for seed in range(25):
        cloud, camera = random_scene(seed, 17, orthographic=False)
        finite_gradients(cloud.to(torch.float32), camera)


def test_a_plane_on_a_pixel_center_horizon_still_has_a_gradient() -> None:
    """Its other pixels keep theirs, equal to those in a picture where the horizon misses all pixels by a little."""
    cloud = floor_and_ceiling()
    camera = camera_on_z(9, 9, fov=90)
    beside = replace(camera, intrinsics=camera.intrinsics + torch.tensor([[0.0, 0, 1e-7], [0, 0, 1e-7], [0, 0, 0]]).double())
    ours, theirs = finite_gradients(cloud, camera), finite_gradients(cloud, beside)
    for name in (*PLACEMENT, "texels"):
        assert theirs[name].norm() > 0
        assert (ours[name] - theirs[name]).norm() < 1e-5 * theirs[name].norm(), name  # measured 5e-7, of a shift by 1e-7 pixels


def test_float32_gradients_agree_with_float64() -> None:
    """Relative L2, in a scene without kinks and ties; measured 9e-7 for texels and at most 4e-6 for placement."""
    position = torch.tensor([[1.0, 0.7, 3.1], [-2.2, 1.1, 1.9]], dtype=torch.float64)
    camera = Camera(look_at(position, torch.zeros(3).double()), pinhole_intrinsics(53, 15, 12).repeat(2, 1, 1), 15, 12)
    axis = torch.tensor([0.03, -0.05, 0.02]).double()
    cloud = even_upright(3, axis=axis, half_extents=torch.ones(2).double(), texture_sizes=torch.tensor([6, 7]))
    cloud = cloud.with_texels(torch.rand(cloud.texels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    assert distance_to_kinks(cloud, camera) > 1e-5
    exact, rounded = finite_gradients(cloud, camera), finite_gradients(cloud.to(torch.float32), camera)
    for name, gradient in exact.items():
        error = float((rounded[name].double() - gradient).norm() / gradient.norm())
        assert error < (5e-6 if name == "texels" else 5e-5), name


def test_an_opaque_layer_hides_what_is_behind_it_and_takes_its_gradient() -> None:
    cloud = facing_cloud([3.0, 4.0], [(4, 4), (4, 4)], (5.0, 5.0))  # both cover the whole picture
    texels = cloud.texels.clone()
    texels[:16, 3] = 1
    camera = camera_on_z(9, 7)
    gradients = finite_gradients(cloud.with_texels(texels), camera)
    assert (gradients["texels"][16:] == 0).all() and (gradients["centers"][1] == 0).all()
    assert (gradients["texels"][:16, :3] != 0).any()
    hidden = texels.clone()
    hidden[16:] = 0
    assert torch.equal(render_reference(cloud.with_texels(texels), camera), render_reference(cloud.with_texels(hidden), camera))


def test_each_side_learns_only_from_the_views_on_its_side() -> None:
    cloud = cloud_of(torch.tensor([[0.0, 0, -3]]), torch.eye(3)[:1], torch.eye(3)[1:2], torch.ones(1, 2), [(3, 3)], two_sided=True)
    front = finite_gradients(cloud, camera_on_z(7, 7))["texels"]
    assert (front[:9] != 0).any() and (front[9:] == 0).all()
    back = finite_gradients(replace(cloud, rights=-cloud.rights), camera_on_z(7, 7))["texels"]
    assert (back[:9] == 0).all() and (back[9:] != 0).any()


def test_the_picture_is_linear_in_the_colors() -> None:
    cloud, camera = random_scene(2, 3, orthographic=False)
    one, other = cloud.texels, cloud.texels.clone()
    other[:, :3] = torch.rand(other[:, :3].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mixed = cloud.with_texels(0.25 * one + 0.75 * other)
    images = [render_reference(cloud.with_texels(texels), camera) for texels in (one, other)]
    assert images[0][..., 3].max() > 0
    assert torch.allclose(render_reference(mixed, camera), 0.25 * images[0] + 0.75 * images[1], atol=1e-14)


def test_colors_never_exceed_alpha_and_alpha_never_exceeds_one() -> None:
    for seed in range(10):
        cloud, camera = random_scene(seed, 17, orthographic=False)
        image = render_reference(cloud.to(torch.float32), camera)
        assert image.min() >= -1e-6 and image[..., 3].max() <= 1 + 1e-6
        assert (image[..., :3] <= image[..., 3:] + 1e-6).all()


def test_the_same_bytes_twice_and_with_any_number_of_threads() -> None:
    generator = torch.Generator().manual_seed(0)
    cloud = even_upright(4, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([64, 64]))
    cloud = cloud.with_texels(torch.rand(cloud.texels.shape, generator=generator))
    position = 3 * torch.nn.functional.normalize(torch.randn(3, 3, generator=generator, dtype=torch.float64), dim=-1)
    camera = Camera(look_at(position, torch.zeros(3).double()), pinhole_intrinsics(50, 96, 80).repeat(3, 1, 1), 96, 80)

    def everything(threads: int) -> list[bytes]:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            tracked_cloud, leaves = tracked(cloud)
            image = render_reference(tracked_cloud, camera)
            image.square().mean().backward()
        finally:
            torch.set_num_threads(before)
        gradients = [leaf.grad for leaf in leaves.values() if leaf.grad is not None]
        assert len(gradients) == 5
        return [t.detach().numpy().tobytes() for t in (image, *gradients)]

    alone = everything(1)
    assert alone == everything(1) == everything(2)
