"""The losses against their formulas and against kornia."""

from __future__ import annotations

import kornia
import pytest
import torch

from bbfit.images import over_color, premultiply
from bbfit.operators.image_loss.reference import image_loss_reference
from bbfit.operators.ssim.reference import ssim_reference


def test_l1_and_l2_are_sums_over_channels_averaged_over_pixels() -> None:
    render, target = torch.zeros(2, 3, 5, 4), torch.zeros(2, 3, 5, 4)
    render[1, 2, 3] = torch.tensor([0.5, -0.25, 0.0, 1.0])
    assert image_loss_reference(render, target, "l1", 0.0).item() == pytest.approx((0.5 + 0.25 + 1.0) / 30)
    assert image_loss_reference(render, target, "l2", 0.0).item() == pytest.approx((0.25 + 0.0625 + 1.0) / 30)


def test_backgrounds_is_the_expected_difference_over_random_opaque_ones() -> None:
    """Exactly, by Simpson's rule, since the difference is quadratic in the background; and as a mean over random ones."""
    generator = torch.Generator().manual_seed(0)
    a, b = (premultiply(torch.rand(2, 5, 7, 4, generator=generator, dtype=torch.float64)) for _ in range(2))

    def over(background: torch.Tensor | float) -> torch.Tensor:
        return (over_color(a, background) - over_color(b, background)).square().sum(-1).mean()

    stated = image_loss_reference(a, b, "backgrounds", 0.0).item()
    assert stated == pytest.approx(((over(0.0) + 4 * over(0.5) + over(1.0)) / 6).item(), rel=1e-12)
    samples = torch.stack([over(torch.rand(3, generator=generator, dtype=torch.float64)) for _ in range(4000)])
    deviation = samples.std().item() / 4000**0.5
    assert deviation < 0.01 * stated and abs(samples.mean().item() - stated) < 4 * deviation
    assert image_loss_reference(a, a, "backgrounds", 0.0).item() == 0


def test_ssim_equals_kornias() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(2, 17, 23, 4, generator=generator, dtype=torch.float64)
    b = (a + 0.2 * torch.rand(a.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    expected = kornia.metrics.ssim(a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2), 11, padding="valid").mean()
    # kornia computes its window in float32 and adds 1e-12 to the denominator.
    assert ssim_reference(a, b).item() == pytest.approx(expected.item(), abs=1e-6)
    assert ssim_reference(a, a).item() == pytest.approx(1)


def test_ssim_weight_adds_the_dissimilarity() -> None:
    a, b = torch.rand(1, 12, 12, 4), torch.rand(1, 12, 12, 4)
    plain, weighted = (image_loss_reference(a, b, "l2", weight) for weight in (0.0, 0.5))
    assert (weighted - plain).item() == pytest.approx(0.5 * (1 - ssim_reference(a, b).item()), rel=1e-4)


def test_gradient_of_ssim() -> None:
    a = torch.rand(1, 12, 13, 2, dtype=torch.float64, requires_grad=True)
    b = torch.rand(1, 12, 13, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim_reference(x, b), (a,))
