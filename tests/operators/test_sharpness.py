"""The difference in sharpness: what it means, and the kernels against the formula."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import avg_pool2d

from bbfit.images import premultiply
from bbfit.operators.sharpness.fused import add_sharpness_gradient
from bbfit.operators.sharpness.reference import BLOCK, sharpness_reference


def picture(seed: int, height: int = 37, width: int = 53, views: int = 2) -> torch.Tensor:
    """Random premultiplied RGBA with holes and flat parts."""
    image = torch.rand(views, height, width, 4, generator=torch.Generator().manual_seed(seed))
    image[:, 5:20, 10:30] = 0
    image[:, 25:30, 30:45, 3] = 1
    return premultiply(image)


def test_one_edge_counts_as_stated() -> None:
    """A black column on white: eight differences of 1 across in each channel, within one block of two."""
    target = torch.zeros(1, BLOCK, 2 * BLOCK, 4)
    render = target.clone()
    render[:, :, 0, 3] = 1
    assert sharpness_reference(render, target).item() == pytest.approx((8 / 64) ** 2 / 2)
    assert sharpness_reference(render.transpose(1, 2), target.transpose(1, 2)).item() == pytest.approx((8 / 64) ** 2 / 2)


def test_detail_elsewhere_in_the_block_is_as_good_and_blur_is_not() -> None:
    sharp = torch.zeros(1, 32, 32, 4)
    sharp[:, :, 2::8, 3] = 1
    moved = sharp.roll(2, 2)
    blurred = avg_pool2d(sharp.permute(0, 3, 1, 2), 5, 1, 2).permute(0, 2, 3, 1)
    assert sharpness_reference(moved, sharp).item() == pytest.approx(0, abs=1e-12)
    assert sharpness_reference(blurred, sharp).item() > 0.01
    assert (moved - sharp).square().mean() > 1.5 * (blurred - sharp).square().mean()


@pytest.mark.parametrize(("height", "width"), [(37, 53), (8, 8), (11, 16), (130, 257)])
def test_kernels_equal_the_formula(height: int, width: int) -> None:
    render, target = picture(0, height, width), picture(1, height, width)
    wanted = render.double().requires_grad_()
    value = sharpness_reference(wanted, target.double())
    value.backward()
    before = torch.randn(render.shape, generator=torch.Generator().manual_seed(2))
    gradient = before.clone()
    found = add_sharpness_gradient(render, target, 3.0, gradient)
    assert found.item() == pytest.approx(value.item(), rel=1e-5)
    assert wanted.grad is not None
    # Roundings of a difference of nearly 0 have a sign or none, so a few of the pixels may differ.
    wrong = (gradient - before - 3 * wanted.grad.float()).abs() > 1e-6 + 1e-4 * wanted.grad.abs().max()
    assert wrong.float().mean() < 2e-3 and wanted.grad.abs().max() > 0


def test_equal_bytes_whatever_the_number_of_threads() -> None:
    render, target, before = picture(0, 200, 300), picture(1, 200, 300), torch.get_num_threads()
    results = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            gradient = torch.zeros_like(render)
            results.append((add_sharpness_gradient(render, target, 1.0, gradient), gradient))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])
