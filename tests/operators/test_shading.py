"""Shading of texels: the reference against glTF's formulas by hand, and the kernels against the reference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bbfit.checks import InputError
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.light import Light
from bbfit.images import linear_to_srgb, srgb_to_linear
from bbfit.operators.shading.fused import shade_fused
from bbfit.operators.shading.reference import TextureLight, decode, encode, shade_reference, texture_lights
from bbfit.rendering.dispatch import lit, render

SUN = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)


def cloud_with_maps(count: int = 3, sides: str = "one", seed: int = 0, dtype: torch.dtype = torch.float64) -> BillboardCloud:
    """Upright billboards with random maps; some normals lie outside the unit disk."""
    half, sizes = torch.tensor([1.0, 1.5], dtype=dtype), torch.tensor([5, 7])
    cloud = even_upright(count, axis=torch.tensor([0.1, 1.0, 0.2], dtype=dtype), half_extents=half, texture_sizes=sizes, sides=sides)
    generator = torch.Generator().manual_seed(seed)
    texels, surface = (torch.rand(len(cloud.texels), 4, generator=generator, dtype=dtype) for _ in range(2))
    return replace(cloud, texels=texels, surface=surface, light=Light.of(SUN, 2.5, 1.0))


def cameras(dtype: torch.dtype = torch.float64, *, orthographic: bool = False) -> Camera:
    positions = torch.tensor([[4.0, 2.0, 1.0], [-3.0, 1.0, -4.0], [0.5, 5.0, -1.0]], dtype=dtype)
    k = orthographic_intrinsics(5.0, 24, 20) if orthographic else pinhole_intrinsics(50.0, 24, 20)
    return Camera(look_at(positions, torch.tensor([0.1, 1.0, 0.2], dtype=dtype)), k.to(dtype).repeat(3, 1, 1), 24, 20, orthographic)


def by_hand(texel: Tensor, surface: Tensor, normal_axes: Tensor, light: Light) -> list[float]:
    """The color of one texel from its world normal, straight from the specification of glTF; ``normal_axes``: right, up, visible side."""
    base = srgb_to_linear(texel[:3].numpy())
    x, y = (2 * surface[:2] - 1).tolist()
    long = max(math.hypot(x, y), 1.0)
    x, y = x / long, y / long
    world = torch.tensor([x, y, math.sqrt(max(1 - x * x - y * y, 1e-4))]).double() @ normal_axes
    cosine = float(world @ light.sun_directions[0])
    transmitted = float(surface[3])
    sun = light.sun_strengths.item() / math.pi * ((1 - transmitted) * max(cosine, 0) + transmitted * max(-cosine, 0))
    radiance = base * (sun * light.sun_colors[0].numpy() + light.ambients.item() * float(surface[2]))
    return linear_to_srgb(np.minimum(radiance, 1)).tolist()


@pytest.mark.parametrize("sides", ["one", "two"])
@pytest.mark.parametrize("orthographic", [False, True])
def test_reference_is_the_formula(sides: str, orthographic: bool) -> None:
    """Every texel of every view; a one-sided texture faces the camera, a back texture faces back."""
    cloud, camera = cloud_with_maps(sides=sides), cameras(orthographic=orthographic)
    light = Light(SUN, torch.tensor([2.5]).double(), torch.tensor([[1.0, 0.9, 0.7]]).double(), torch.tensor([0.8]).double())
    for view, shown in enumerate(lit(cloud, camera, light)):
        assert shown.surface is None and shown.light is None
        for n, texture in enumerate(shown.textures()):
            towards = -camera.forward[view] if orthographic else camera.position[view] - cloud.centers[n]
            for side in range(len(texture)):
                toward_viewer = cloud.normals[n] * (1 if (towards @ cloud.normals[n] >= 0 if sides == "one" else side == 0) else -1)
                axes = torch.stack([cloud.rights[n], cloud.ups[n], toward_viewer])
                texels, maps = (values[n][side].reshape(-1, 4) for values in (cloud.textures(), cloud.textures(cloud.surface)))
                for index in (0, 9, 21, 34):
                    got = texture[side].reshape(-1, 4)[index]
                    assert got[:3].tolist() == pytest.approx(by_hand(texels[index], maps[index], axes, light), abs=1e-7)
                    assert got[3] == texels[index, 3]


def test_plane_that_faces_the_sun_and_its_back() -> None:
    """White in a sun of pi watts is white; its back is black, or white too if all light passes through, and the sky is the same."""
    cloud = replace(
        cloud_with_maps(1), texels=torch.ones(35, 4).double(), surface=torch.tensor([0.5, 0.5, 0.5, 0.0]).double().repeat(35, 1)
    )
    half = Light.of(cloud.normals, math.pi / 2, 0.0)
    front, back = (Camera(look_at(4 * s * cloud.normals, cloud.centers[0]), cameras().intrinsics[:1], 24, 20) for s in (1, -1))
    values = [float(lit(cloud, camera, half)[0].texels[0, 0]) for camera in (front, back)]
    assert values == pytest.approx([float(linear_to_srgb(np.array(0.5))), 0.0], abs=1e-4)
    leaf = replace(cloud, surface=torch.tensor([0.5, 0.5, 0.5, 1.0]).double().repeat(35, 1))
    values = [float(lit(leaf, camera, half)[0].texels[0, 0]) for camera in (front, back)]
    assert values == pytest.approx([0.0, float(linear_to_srgb(np.array(0.5)))], abs=1e-4)
    sky = Light.of(cloud.normals, 0.0, 0.5)
    assert float(lit(cloud, back, sky)[0].texels[0, 0]) == pytest.approx(float(linear_to_srgb(np.array(0.25))))


def test_leaf_that_looks_up_does_so_from_both_sides() -> None:
    """A normal along the plane's up axis is as bright from behind, under a sun straight above."""
    maps = torch.tensor([0.5, 1.0, 0.0, 0.0]).double().repeat(35, 1)
    cloud = replace(cloud_with_maps(1), texels=0.5 * torch.ones(35, 4).double(), surface=maps)
    front, back = (Camera(look_at(4 * s * cloud.normals, cloud.centers[0]), cameras().intrinsics[:1], 24, 20) for s in (1, -1))
    above = Light.of(torch.tensor([[0.0, 1.0, 0.0]]), math.pi, 0.0)
    values = [float(lit(cloud, camera, above)[0].texels[0, 0]) for camera in (front, back)]
    assert values[0] == pytest.approx(0.5, abs=1e-3) and values[0] == pytest.approx(values[1], abs=1e-12)


def test_transfer_functions_are_those_of_the_pictures() -> None:
    values = torch.linspace(0, 1, 501, dtype=torch.float64)
    np.testing.assert_allclose(decode(values), srgb_to_linear(values.numpy()), atol=1e-12)
    np.testing.assert_allclose(encode(values), linear_to_srgb(values.numpy()), atol=1e-12)


def test_reference_has_the_right_derivatives() -> None:
    """Away from the corners at the horizon, at the edge of the disk and at the joint of the transfer function."""
    cloud = cloud_with_maps(2, seed=3)
    texels, surface = (0.1 + 0.8 * cloud.texels).requires_grad_(), (0.25 + 0.5 * cloud.surface).requires_grad_()  # type: ignore[operator]
    light = texture_lights(cloud, cameras()[[0]], Light.of(SUN, 1.0, 0.2))[0]
    assert torch.autograd.gradcheck(lambda *values: shade_reference(*values, light), (texels, surface))


def test_too_bright_texels_can_become_darker() -> None:
    texels = torch.ones(35, 4).double().requires_grad_()
    light = texture_lights(cloud_with_maps(1), cameras()[[0]], Light.of(SUN, 20.0, 3.0))[0]
    shown = shade_reference(texels, torch.tensor([0.5, 0.5, 1.0, 0.0]).double().repeat(35, 1), light)
    assert (shown == 1).all()
    shown.sum().backward()
    assert texels.grad is not None and (texels.grad[:, :3] > 0.5).all()


@pytest.mark.parametrize("count", [1, 3, 17])
@pytest.mark.parametrize("sides", ["one", "two"])
def test_kernels_agree_with_the_reference(count: int, sides: str) -> None:
    """Measured on a CPU: colors to 2e-7, gradients to 1.3e-5 (relative L2), where a normal is near the horizon of the sun."""
    cloud = cloud_with_maps(count, sides)
    for light in texture_lights(cloud, cameras(), Light.of(SUN.repeat(3, 1), 3.0, 0.5, (1.0, 0.9, 0.7))):
        generator = torch.Generator().manual_seed(count)
        weight = torch.randn(len(cloud.texels), 4, generator=generator, dtype=torch.float64)
        weight[::3] = 0  # the kernel skips texels without a gradient
        results = []
        for shade, dtype in ((shade_reference, torch.float64), (shade_fused, torch.float32)):
            assert cloud.surface is not None
            inputs = [values.to(dtype, copy=True).requires_grad_() for values in (cloud.texels, cloud.surface)]
            shown = shade(*inputs, light)
            (shown * weight.to(dtype)).sum().backward()
            results.append([shown.detach().double(), *(value.grad.double() for value in inputs)])  # type: ignore[union-attr]
        assert (results[0][0] - results[1][0]).abs().max() < 1e-6
        for expected, got in zip(results[0][1:], results[1][1:], strict=True):
            assert (expected - got).norm() < 2e-5 * expected.norm()


@pytest.mark.parametrize("strength", [0.0, 1e-4, 0.1, 1.0, 20.0, 1e6])
def test_kernels_agree_for_dark_and_bright_texels(strength: float) -> None:
    """Over the whole range of colors, and in light that is too bright to show. Measured: colors to 2.5e-7, gradients to 1e-7."""
    colors = torch.linspace(0, 1, 1001, dtype=torch.float64)[:, None].repeat(1, 4)
    maps = torch.tensor([0.6, 0.7, 0.8, 0.0], dtype=torch.float64).repeat(len(colors), 1)
    (light,) = texture_lights(cloud_with_maps(1), cameras()[[0]], Light.of(SUN, strength * math.pi, strength / 3))
    light = replace(light, texture=torch.zeros(len(colors), dtype=torch.int32))
    results = []
    for shade, dtype in ((shade_reference, torch.float64), (shade_fused, torch.float32)):
        texels = colors.to(dtype, copy=True).requires_grad_()
        shown = shade(texels, maps.to(dtype), light)
        shown.sum().backward()
        assert texels.grad is not None
        results.append((shown.detach().double(), texels.grad.double()))
    assert (results[0][0] - results[1][0]).abs().max() < 1e-6
    assert (results[0][1] - results[1][1]).norm() < 1e-6 * results[0][1].norm()


def test_clouds_are_drawn_in_a_light() -> None:
    """Both backends, one light or one for each view, and the cloud's own by default; a cloud without maps takes none."""
    cloud, camera = cloud_with_maps(), cameras()
    lights = Light.joined([Light.of(SUN, strength, 0.5) for strength in (0.5, 2.0, 4.0)])
    expected = render(cloud, camera, light=lights)
    got = render(cloud.to(torch.float32), camera, light=lights)
    assert (expected - got).abs().max() < 1e-4 and got.dtype == torch.float32
    for index in range(3):
        one = render(cloud, camera[index], light=lights[[index]])
        torch.testing.assert_close(one, expected[index])
        torch.testing.assert_close(one, render(lit(cloud, camera[[index]], lights[[index]])[0], camera[index]))
    torch.testing.assert_close(render(cloud, camera), render(cloud, camera, light=Light.of(SUN, 2.5, 1.0)))
    with pytest.raises(InputError, match="light: the light of this cloud is baked"):
        render(cloud.baked(cloud.texels), camera, light=lights)
    with pytest.raises(InputError, match="light: expected shape"):
        render(cloud, camera, light=lights[[0, 1]])


def test_no_billboards() -> None:
    cloud = cloud_with_maps().take([])
    assert render(cloud, cameras()).abs().sum() == 0
    light = TextureLight(torch.zeros(0, dtype=torch.int32), torch.zeros(0, 3), torch.zeros(4).double())
    assert shade_fused(torch.zeros(0, 4), torch.zeros(0, 4), light).shape == (0, 4)


def test_a_translucent_texel_makes_no_light() -> None:
    """It reflects and transmits together what an opaque one of the same color reflects, in linear light, and shows as much sky."""
    cloud = cloud_with_maps(2)
    assert cloud.surface is not None
    opposite = Light.of(-SUN, 1.0, 0.0)

    def shown(light: Light, surface: Tensor) -> Tensor:
        (each,) = texture_lights(cloud, cameras()[[0]], light)
        return decode(shade_reference(cloud.texels, surface, each)[:, :3])

    opaque = cloud.surface * torch.tensor([1, 1, 1, 0])
    both = [sum(shown(light, surface) for light in (Light.of(SUN, 1.0, 0.0), opposite)) for surface in (cloud.surface, opaque)]
    assert (cloud.surface[:, 3] > 0.1).any() and torch.allclose(both[0], both[1], atol=1e-9)
    assert torch.equal(shown(Light.of(SUN, 0.0, 1.0), cloud.surface), shown(Light.of(SUN, 0.0, 1.0), opaque))
