"""Alpha modes: what they mean, and that both renderers and their gradients mean the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from scenes import camera_on_z, facing_cloud, ring_of, scenes, tracked

from bbfit.checks import InputError
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.compositing import STEEPEST, layer_weights, opacity, thresholds
from bbfit.operators.drawing.fused import render_fused
from bbfit.operators.drawing.reference import render_reference

MODES = {
    "hard": AlphaMode("mask", 0.4),
    "ramp": AlphaMode("mask", 0.5, 3.0),
    "steep": AlphaMode("mask", 0.3, 11.0),
    "antialiased": AlphaMode("mask", 0.4, antialiased=True),
    "antialiased ramp": AlphaMode("mask", 0.5, 3.0, antialiased=True),
    "coverage": AlphaMode("coverage", samples=0),
    "four samples": AlphaMode("coverage"),
    "hash": AlphaMode("hash"),
}
# Layers that cover equally many samples have no unique gradient, and fits draw coverage with any number of samples.
DIFFERENTIABLE = [name for name in MODES if name not in ("hash", "four samples")]


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES.keys())
def test_both_renderers_draw_the_same(mode: AlphaMode) -> None:
    """A sample whose alpha is within rounding of the cutoff may fall on either side: such pixels are few, all others agree."""
    flipped = pixels = shown = 0
    for cloud, camera in scenes(4):
        cloud = replace(cloud, alpha=mode).to(torch.float32)
        cloud = cloud.with_texels(torch.rand(cloud.texels.shape, generator=torch.Generator().manual_seed(1)))
        difference = (render_fused(cloud, camera) - render_reference(cloud, camera)).abs().amax(-1)
        flipped, pixels = flipped + int((difference > 2e-3).sum()), pixels + difference.numel()
        shown += int((render_fused(cloud, camera)[..., 3] > 0).sum())
    assert shown > 0.1 * pixels
    assert flipped <= 2e-4 * pixels  # measured: at most 4e-5, in the modes with a step


@pytest.mark.parametrize("mode", [MODES[name] for name in DIFFERENTIABLE], ids=DIFFERENTIABLE)
def test_both_renderers_have_the_same_gradients(mode: AlphaMode) -> None:
    for billboards in (1, 3, 6):
        cloud, camera = ring_of(40, billboards)
        weight = torch.randn(2, 40, 40, 4, generator=torch.Generator().manual_seed(2))
        gradients = []
        for draw in (render_reference, render_fused):
            leafy, leaves = tracked(replace(cloud, alpha=mode))
            (draw(leafy, camera) * weight).sum().backward()
            gradients.append({name: leaf.grad.double() for name, leaf in leaves.items() if leaf.grad is not None})
        for name, expected in gradients[0].items():
            error = (gradients[1][name] - expected).norm() / expected.norm()
            assert error < 2e-3, name  # measured: at most 4e-4 (steep), samples at the end of a ramp or at the cutoff
        assert gradients[0]["texels"][:, 3].abs().sum() > 0


def test_a_hashed_picture_has_no_gradient_in_alpha() -> None:
    cloud, camera = ring_of(24, 2)
    leafy, _ = tracked(replace(cloud, alpha=AlphaMode("hash")))
    assert not render_fused(leafy, camera).requires_grad


@pytest.mark.parametrize("draw", [render_reference, render_fused])
def test_a_mask_shows_the_nearest_that_reaches_the_cutoff(draw: object) -> None:
    """Three planes one behind the other, alpha below, at and above the cutoff: the second is seen, in its full color."""
    cloud = facing_cloud([2.0, 3.0, 4.0], [(2, 2)] * 3, (2.0, 2.0)).to(torch.float32)
    texels = torch.tensor([[1.0, 0, 0, 0.2499], [0, 1, 0, 0.25], [0, 0, 1, 1]]).repeat_interleave(4, 0)
    image = draw(replace(cloud, texels=texels, alpha=AlphaMode("mask", 0.25)), camera_on_z(5, 5, fov=30))  # type: ignore[operator]
    assert torch.equal(image[2, 2], torch.tensor([0.0, 1, 0, 1]))


def test_a_hash_is_a_blend_on_average() -> None:
    """Of noise: every pixel is one layer or nothing, and the mean over many pixels is that of the blend."""
    cloud, camera = ring_of(160, 4)
    blended = render_fused(cloud, camera)
    hashed = render_fused(replace(cloud, alpha=AlphaMode("hash")), camera)
    assert set(hashed[..., 3].unique().tolist()) == {0.0, 1.0}
    inside = blended[..., 3] > 0
    assert float((hashed - blended)[inside].mean(0).abs().max()) < 0.01  # measured 0.003; a standard error is 0.003
    assert float((hashed - blended)[inside].abs().mean()) > 0.1


def test_thresholds_are_even_and_unlike_their_neighbors() -> None:
    y, x = torch.meshgrid(torch.arange(256), torch.arange(256), indexing="ij")
    values = thresholds(x, y, 12345)
    assert 0 < float(values.min()) and float(values.max()) < 1
    assert float((values.flatten().sort().values - (torch.arange(65536) + 0.5) / 65536).abs().max()) < 0.01
    for other in (thresholds(x + 1, y, 12345), thresholds(x, y + 1, 12345), thresholds(x, y, 12346)):
        assert abs(float(torch.corrcoef(torch.stack([values.flatten(), other.flatten()]))[0, 1])) < 0.02


def test_the_ramp_ends_at_nothing_and_opaque_and_has_its_slope() -> None:
    alpha = torch.linspace(0, 1, 101, dtype=torch.float64, requires_grad=True)
    for mode in (AlphaMode("mask", 0.5, 1.0), AlphaMode("mask", 0.2, 2.5), AlphaMode("mask", 0.7, 30.0), AlphaMode("mask", 0.7)):
        drawn = opacity(alpha, mode)
        shown = drawn.detach()
        assert float(shown[0]) == 0 and float(shown[-1]) == 1
        assert bool((shown.diff() >= 0).all())
        assert float(opacity(torch.tensor(mode.cutoff - 1e-6), mode)) < 0.51
        (slope,) = torch.autograd.grad(drawn.sum(), alpha)
        steepness = min(mode.hardness, STEEPEST)
        beyond = (alpha.detach() - mode.cutoff).abs() - 0.5 / steepness
        assert torch.allclose(slope[beyond < -1e-9], torch.tensor(steepness).double()) and not slope[beyond > 1e-9].any()
    assert opacity(alpha, AlphaMode()) is alpha


def test_an_antialiased_edge_covers_the_share_of_the_pixel_that_is_inside() -> None:
    """An upright edge, where alpha changes by the same amount from pixel to pixel: opacity is the share of the pixel on the opaque side."""
    for place in torch.linspace(3.0, 5.0, 17, dtype=torch.float64):  # of the contour of the cutoff, in pixels
        alpha = (0.35 + 0.1 * (torch.arange(8, dtype=torch.float64) - place)).expand(8, 8)
        shown = opacity(alpha, AlphaMode("mask", 0.35, antialiased=True))
        inside = (torch.arange(8, dtype=torch.float64) + 0.5 - place).clamp(0, 1).where(alpha[0] > 0, 0)
        assert torch.allclose(shown, inside.expand(8, 8), atol=1e-12)


def test_layers_of_an_antialiased_mask_cover_the_same_samples_first() -> None:
    """Front to back 0.25, 0.75, 0.5 and 1: the second shows half, the third nothing, the last the rest, in any order of the list."""
    depths, alphas = [1.0, 2.0, 3.0, 4.0], [0.25, 0.75, 0.5, 1.0]
    for order in itertools.permutations(range(4)):
        planes = [[torch.full((1, 1, 2, 2), values[i]) for i in order] for values in (alphas, depths)]
        weights = layer_weights(*planes, nested=True)
        assert [float(weights[order.index(i)][0, 0, 0, 0]) for i in range(4)] == [0.25, 0.5, 0, 0.25]


def test_coverage_is_a_whole_number_of_samples() -> None:
    alpha = torch.linspace(0, 1, 1001, dtype=torch.float64, requires_grad=True)
    assert opacity(alpha, AlphaMode("coverage", samples=0)) is alpha
    four = opacity(alpha, AlphaMode("coverage"))
    assert four.detach().unique().tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert float((four - alpha).detach().abs().max()) <= 0.125 + 1e-9
    assert torch.equal(torch.autograd.grad(four.sum(), alpha)[0], torch.ones(1001).double())


def test_an_antialiased_mask_is_what_four_samples_a_pixel_show() -> None:
    """Alpha to coverage estimates the mean of many samples from one; the edges of a mask with one sample are several times farther off."""
    texels = torch.nn.functional.interpolate(torch.rand(1, 4, 9, 9, generator=torch.Generator().manual_seed(5)), (72, 72), mode="bicubic")
    cloud = facing_cloud([3.0], [(72, 72)], (1.0, 1.0)).to(torch.float32).with_texels(texels.clamp(0, 1)[0].permute(1, 2, 0).reshape(-1, 4))
    camera = camera_on_z(64, 64, fov=30)
    pictures = {name: render_fused(replace(cloud, alpha=AlphaMode("mask", antialiased=name == "one")), camera) for name in ("one", "hard")}
    many = render_fused(replace(cloud, alpha=AlphaMode("mask")), camera.resized(512, 512)).view(64, 8, 64, 8, 4).mean((1, 3))
    errors = {name: float((picture - many).square().mean().sqrt()) for name, picture in pictures.items()}
    assert errors["one"] < 0.35 * errors["hard"], errors


def test_the_mode_stays_with_the_cloud(known_cloud: BillboardCloud, tmp_path: object) -> None:
    masked = replace(known_cloud, alpha=AlphaMode("mask", 0.3))
    path = f"{tmp_path}/cloud.safetensors"
    masked.save(path)
    assert BillboardCloud.load(path).alpha == AlphaMode("mask", 0.3)
    for other in (
        masked.to(torch.float64),
        masked.take([1]),
        masked.without_textures(),
        BillboardCloud.joined([masked, masked]),
        masked.parts(2)[1],
    ):
        assert other.alpha == masked.alpha
    assert known_cloud.alpha == AlphaMode("blend")


@pytest.mark.parametrize(
    "bad",
    [
        {"kind": "opaque"},
        {"kind": "blend", "antialiased": True},
        {"kind": "coverage", "antialiased": True},
        {"kind": "coverage", "samples": -1},
        {"cutoff": 0.0},
        {"cutoff": 1},
        {"cutoff": math.nan},
        {"cutoff": "half"},
        {"hardness": 0.9},
    ],
)
def test_bad_modes_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"alpha|hardness|samples"):
        AlphaMode(**bad)  # type: ignore[arg-type]
