"""The losses that the fused backward pass takes along, against autograd of their specification; skipping of empty texels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import camera_on_z, facing_cloud, ring_of
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.images import premultiply
from bbfit.operators.drawing.fused import differentiate, draw, occupancy
from bbfit.operators.drawing.projection import project
from bbfit.operators.drawing.reference import render_reference
from bbfit.operators.image_loss.fused import PixelLoss, unpacked
from bbfit.operators.image_loss.reference import image_loss_reference

LOSSES = ("l1", "l2", "backgrounds")


def pictures(camera: Camera, straight: bool) -> tuple[Tensor, Tensor]:
    """Random 8-bit targets with empty and opaque pixels, and what they mean, float64."""
    generator = torch.Generator().manual_seed(0)
    views, height, width = len(camera), camera.height, camera.width
    packed = torch.randint(0, 256, (views, height, width, 4), generator=generator, dtype=torch.uint8)
    packed[..., 3] = torch.randint(-150, 400, (views, height, width), generator=generator).clamp(0, 255).to(torch.uint8)
    exact = packed.double() / 255
    if straight:
        return packed, premultiply(exact)
    packed = (premultiply(exact) * 255).round().to(torch.uint8)
    return packed, packed.double() / 255


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("kind", LOSSES)
def test_a_loss_and_its_gradient_are_autograds(kind: str, straight: bool) -> None:
    """With and without another gradient on top; measured 4e-7 of the sums and 6e-6 of the gradient's norm."""
    cloud, camera = ring_of(24, billboards=3, views=3)
    texels = cloud.texels.clone()
    texels[:, 3] = (2 * texels[:, 3] - 0.5).clamp(0, 1)
    camera = replace(camera.resized(23, 30), intrinsics=camera.resized(23, 30).intrinsics * torch.tensor([[1.3], [1.3], [1]]).double())
    packed, target = pictures(camera, straight)
    of_image = torch.randn(target.shape, generator=torch.Generator().manual_seed(1)) / target.numel()
    projection, pixels = project(cloud, camera), target[..., 0].numel()
    leaf = texels.double().requires_grad_()
    image = render_reference(cloud.to(torch.float64).with_texels(leaf), camera)
    expected = torch.stack([image_loss_reference(image[v], target[v], kind, 0.0) for v in range(3)])
    assert expected.mean().item() == pytest.approx(image_loss_reference(image, target, kind, 0.0).item())
    for extra in (None, of_image):
        objective = image_loss_reference(image, target, kind, 0.0) + (0 if extra is None else (image * extra).sum())
        (exact,) = torch.autograd.grad(objective, leaf, retain_graph=True)
        gradient = torch.zeros_like(texels)
        loss = PixelLoss(packed, straight, kind, 1 / pixels)
        sums, _ = differentiate(texels, projection, gradient, image_gradient=extra, loss=loss)
        assert sums is not None and sums.shape == (3,)
        assert torch.allclose(sums * 3 / pixels, expected, rtol=2e-6, atol=0)
        assert float((gradient - exact).norm() / exact.norm()) < 2e-5


@pytest.mark.parametrize("kind", LOSSES)
def test_gradients_are_added_to_what_is_there(kind: str) -> None:
    cloud, camera = ring_of(16)
    target = torch.zeros(2, 16, 16, 4, dtype=torch.uint8)
    gradient, doubled = torch.zeros_like(cloud.texels), torch.zeros_like(cloud.texels)
    for weight, into in ((0.5, gradient), (0.25, doubled), (0.25, doubled)):
        differentiate(cloud.texels, project(cloud, camera), into, loss=PixelLoss(target, True, kind, weight))
    assert gradient.any()
    torch.testing.assert_close(gradient, doubled, rtol=1e-5, atol=1e-6)


def texel_a_pixel(values: Tensor) -> tuple[Tensor, Tensor]:
    """Opaque 8-bit colors [16 * 16, 3] as a target [1, 16, 16, 4], and the texels that are exactly they; seen one texel a pixel."""
    target = torch.cat([values, torch.full_like(values[:, :1], 255)], -1)
    return target.view(1, 16, 16, 4), target.float() / 255


def matching(values: Tensor, kind: str, straight: bool) -> tuple[float, Tensor]:
    """Sum and gradient of a loss of opaque grays, uint8 [256], drawn one texel a pixel, that are the target exactly."""
    target, texels = texel_a_pixel(torch.stack([values, values.flip(0), values], -1))
    cloud, camera = facing_cloud([3.0], [(16, 16)], (2.0, 2.0)).to(torch.float32), camera_on_z(16, 16, fov=None, extent=4.0)
    projection, gradient = project(cloud, camera), torch.zeros_like(texels)
    assert torch.equal(draw(texels, projection)[0], texels.view(16, 16, 4))
    sums, _ = differentiate(texels, projection, gradient, loss=PixelLoss(target, straight, kind, 1.0))
    assert sums is not None
    return float(sums), gradient


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("kind", LOSSES)
def test_black_and_white_texels_that_are_the_target_have_no_gradient(kind: str, straight: bool) -> None:
    """Where texels end up in a fit, since they are clamped; there the differences must vanish exactly."""
    loss, gradient = matching(255 * (torch.arange(256, dtype=torch.uint8) % 2), kind, straight)
    assert loss == 0 and not gradient.any()


@pytest.mark.parametrize("straight", [True, False])
def test_texels_of_every_level_that_are_the_target_have_no_gradient_in_l1(straight: bool) -> None:
    """One rounding apart is a whole sign of gradient."""
    loss, gradient = matching(torch.arange(256, dtype=torch.uint8), "l1", straight)
    assert loss < 1e-4 and not gradient.any()  # measured 1.5e-5, a rounding for each of 1024 values


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("kind", ["l2", "backgrounds"])
def test_texels_of_every_level_that_are_the_target_have_next_to_no_gradient(kind: str, straight: bool) -> None:
    loss, gradient = matching(torch.arange(256, dtype=torch.uint8), kind, straight)
    assert loss < 1e-11 and gradient.abs().max() < 1e-6  # roundings; measured 8e-13 and 4e-7, where a texel that is off by 1/255 has 8e-3


@pytest.mark.parametrize("kind", LOSSES)
def test_nothing_where_nothing_is_wanted_has_no_gradient(kind: str) -> None:
    cloud, camera = ring_of(16)
    texels, gradient = cloud.texels.clone(), torch.zeros_like(cloud.texels)
    texels[:, 3] = 0
    target = torch.full((2, 16, 16, 4), 200, dtype=torch.uint8)
    target[..., 3] = 0
    sums, _ = differentiate(texels, project(cloud, camera), gradient, loss=PixelLoss(target, True, kind, 1.0))
    assert sums is not None and not sums.any() and not gradient.any()


def test_a_loss_of_no_billboards_is_that_of_an_empty_picture() -> None:
    cloud = facing_cloud([], []).to(torch.float32)
    target = torch.full((1, 6, 8, 4), 51, dtype=torch.uint8)
    loss = PixelLoss(target, False, "l2", 1.0)
    sums, _ = differentiate(cloud.texels, project(cloud, camera_on_z(8, 6)), torch.zeros(0, 4), loss=loss)
    assert sums is not None and sums.tolist() == pytest.approx([48 * 4 * 0.04])


def test_skipping_what_is_empty_changes_nothing() -> None:
    cloud, camera = ring_of(48, views=2)
    texels, projection = cloud.texels.clone(), project(cloud, camera)
    texels.view(4, 48, 48, 4)[:, 10:41, 5:39, 3] = 0
    texels[::37, 3] = 0
    everything, some = torch.ones(len(texels) // 4, dtype=torch.uint8), occupancy(texels)
    assert 0.3 < some.float().mean() < 0.7
    image = draw(texels, projection, some)
    assert torch.equal(image, draw(texels, projection, everything)) and torch.equal(image, draw(texels, projection))
    target = torch.randint(0, 256, image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    target[:, 13:30, 5:40] = 0
    of_image = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    of_image[:, 8:20] = 0
    loss = PixelLoss(target, True, "l1", 0.3)
    for given in ({"image_gradient": of_image}, {"loss": loss}, {"image_gradient": of_image, "loss": loss}):
        results = []
        for occupied in (everything, some, None):
            gradient = torch.zeros_like(texels)
            sums, matrices = differentiate(texels, projection, gradient, occupied=occupied, placement=True, **given)
            assert matrices is not None
            results.append((gradient, matrices, *([] if sums is None else [sums])))
        for other in results[1:]:
            assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_occupancy_is_by_blocks_of_four_texels() -> None:
    texels = torch.ones(10, 4)
    texels[:, 3] = torch.tensor([0, 0, 0, 0, 0, 1e-30, 0, 0, 0, 0.5])
    assert occupancy(texels).tolist() == [0, 1, 1]
    assert occupancy(texels[:9]).tolist() == [0, 1, 0]
    assert occupancy(texels[:0]).tolist() == []


@pytest.mark.parametrize("straight", [True, False])
def test_packed_pictures_unpack_to_premultiplied_floats(straight: bool) -> None:
    packed = torch.randint(0, 256, (2, 37, 53, 4), generator=torch.Generator().manual_seed(1)).to(torch.uint8)
    exact = packed.double() / 255
    exact = premultiply(exact) if straight else exact
    out = torch.full(packed.shape, torch.nan)
    assert unpacked(packed, straight, out) is out
    assert (out - exact).abs().max() < 1.5e-7  # two roundings
    assert torch.equal(unpacked(packed, straight), out)
