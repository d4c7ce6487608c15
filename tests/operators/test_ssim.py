"""The fused structural similarity against its specification in float64, and what it promises beyond."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bbfit.operators.ssim.fused import ssim_and_gradient
from bbfit.operators.ssim.reference import ssim_reference


def reference(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The value and the gradient, in float64."""
    a = a.double().requires_grad_()
    value = ssim_reference(a, b.double())
    return value.detach(), torch.autograd.grad(value, a)[0]


def assert_equals_reference(a: Tensor, b: Tensor) -> None:
    """Measured over all scenes here: value off by 1.7e-8, gradient by 4.9e-7 of its norm and 6.3e-7 of its largest; allowed thrice that."""
    expected, expected_gradient = reference(a, b)
    value, gradient = ssim_and_gradient(a, b, 1.0)
    assert value.shape == () and value.dtype == torch.float64
    assert value.item() == pytest.approx(expected.item(), abs=5e-8)
    error = gradient.double() - expected_gradient
    assert error.norm() <= 1.5e-6 * expected_gradient.norm()
    assert error.abs().max() <= 1.9e-6 * expected_gradient.abs().max()


def noise(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two random pictures that resemble each other."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(*shape, 4, generator=generator)
    return a, (a + 0.3 * torch.rand(a.shape, generator=generator)).clamp(0, 1)


# The last one is cut among threads; 11 to 13 pixels are too narrow for a vector of windows.
@pytest.mark.parametrize("shape", [(2, 32, 48), (1, 11, 11), (2, 12, 13), (1, 15, 14), (1, 23, 37), (1, 40, 34), (3, 101, 19)])
def test_value_and_gradient_are_the_references(shape: tuple[int, int, int]) -> None:
    assert_equals_reference(*noise(*shape))


@pytest.mark.parametrize("seed", range(12))
def test_empty_surroundings_change_nothing(seed: int) -> None:
    """Each picture holds one rectangle somewhere, often at an edge; windows and rows without either are skipped."""
    generator = torch.Generator().manual_seed(seed)
    pictures = torch.zeros(2, 2, 75, 90 + seed % 4, 4)
    for picture in pictures.flatten(0, 1):
        top, left, height, width = (
            int(torch.randint(low, high, (), generator=generator)) for low, high in [(0, 75), (0, 90), (1, 30), (1, 30)]
        )
        part = picture[top : top + height, left : left + width]
        part.copy_(torch.rand(part.shape, generator=generator))
    assert_equals_reference(*pictures)


@pytest.mark.parametrize(("y", "x"), [(0, 0), (0, 40), (24, 40), (24, 0), (12, 20)])
def test_a_single_pixel(y: int, x: int) -> None:
    a, b = torch.zeros(2, 1, 25, 41, 4)
    a[0, y, x] = 0.5
    assert_equals_reference(a, b)
    b[0, y, x, 3] = 1e-30  # counts as something, though its square is 0
    assert_equals_reference(a, b)


def test_equal_pictures_have_similarity_one_and_no_gradient() -> None:
    a, _ = noise(1, 30, 41)
    for picture in (a, torch.zeros_like(a), torch.ones_like(a)):
        value, gradient = ssim_and_gradient(picture, picture.clone(), 1.0)
        assert value.item() == 1 and not gradient.any()


def test_weight_and_memory_given() -> None:
    a, b = noise(2, 30, 41)
    a[:, :12], b[:, :12] = 0, 0
    a[:, :, 30:], b[:, :, 30:] = 0, 0
    plain = ssim_and_gradient(a, b, 1.0)[1]
    out = torch.full_like(a, torch.nan)
    weighted = ssim_and_gradient(a, b, -0.5, out)[1]
    assert weighted is out
    torch.testing.assert_close(out, -0.5 * plain, rtol=1e-6, atol=0)


@pytest.mark.usefixtures("threads")
def test_same_bytes_again_and_with_other_numbers_of_threads() -> None:
    a, b = noise(2, 221, 50)
    results = []
    for number in (1, 2, 3, 2):
        torch.set_num_threads(number)
        results.append(ssim_and_gradient(a, b, 1.0))
    for value, gradient in results[1:]:
        assert torch.equal(value, results[0][0]) and torch.equal(gradient, results[0][1])
