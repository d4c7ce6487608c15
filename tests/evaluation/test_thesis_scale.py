"""The thesis's measures against their formulas, hand-worked cases and figures from the package that the thesis used."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from bbfit.checks import InputError
from bbfit.evaluation import metrics, thesis_scale


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """Two premultiplied random pictures [13, 17, 4]."""
    rng = np.random.default_rng(7)
    target = rng.random((13, 17, 4))
    render = np.clip(target + rng.normal(0, 0.1, target.shape), 0, 1)
    for image in (target, render):
        image[..., :3] *= image[..., 3:]
    return target, render


def test_equal_to_the_package(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """``image-similarity-measures`` 0.3.6 on the same two pictures; it rounds to float32, so seven digits agree."""
    assert thesis_scale.rmse(*pair) == pytest.approx(1.9072452776835643e-05, rel=1e-7)
    assert thesis_scale.ssim(*pair) == pytest.approx(0.9999994901505942, abs=1e-13)
    assert thesis_scale.psnr(*pair) == pytest.approx(94.3752929784741, rel=1e-8)
    assert thesis_scale.sre(*pair) == pytest.approx(12.562255330035041, rel=1e-8)


def test_formulas(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Band by band with explicit loops, and scikit-image for SSIM."""
    target, render = pair
    height, width, bands = target.shape
    squares = [sum((target[r, c, b] - render[r, c, b]) ** 2 for r in range(height) for c in range(width)) for b in range(bands)]
    mse = [total / (height * width) for total in squares]
    assert thesis_scale.rmse(*pair) == pytest.approx(sum(math.sqrt(m / 4095**2) for m in mse) / bands, rel=1e-12)
    assert thesis_scale.psnr(*pair) == pytest.approx(20 * math.log10(4095) - 10 * math.log10(sum(mse) / bands), abs=1e-9)
    ratios = [target[..., b].mean() ** 2 / (math.sqrt(squares[b]) / (height * width)) for b in range(bands)]
    assert thesis_scale.sre(*pair) == pytest.approx(10 * math.log10(sum(ratios) / bands), abs=1e-9)
    expected = structural_similarity(target, render, data_range=4095, channel_axis=2)
    assert thesis_scale.ssim(*pair) == pytest.approx(expected, abs=1e-13)


def test_psnr_is_the_honest_one_plus_72_decibels(pair: tuple[np.ndarray, np.ndarray]) -> None:
    assert thesis_scale.psnr(*pair) - metrics.psnr(*pair) == pytest.approx(72.2451, abs=1e-4)


def test_rmse_averages_roots_over_channels() -> None:
    """Errors of 0.3 and 0.1 in two of four channels: their mean, not the root of their mean square."""
    target, render = np.zeros((11, 11, 4)), np.zeros((11, 11, 4))
    render[..., 0], render[..., 3] = 0.3, 0.1
    assert thesis_scale.rmse(target, render) == pytest.approx(0.4 / 4 / 4095, rel=1e-12)


def test_sre_of_two_by_two_pixels() -> None:
    """One channel: mean 0.5, error norm sqrt(4 * 0.1^2) = 0.2, over 4 pixels 0.05, so 10 log10(0.25 / 0.05)."""
    target = np.array([[0.2, 0.8], [0.4, 0.6]])[..., None]
    assert thesis_scale.sre(target, target + 0.1) == pytest.approx(10 * math.log10(5), abs=1e-9)
    # A second channel with mean 0.25 and twice the error: ratio 0.0625 / 0.1; the ratios are averaged before the logarithm.
    both = np.concatenate([target, target / 2], -1)
    assert thesis_scale.sre(both, both + np.array([0.1, 0.2])) == pytest.approx(10 * math.log10((5 + 0.625) / 2), abs=1e-9)


def test_the_scale_explains_the_thesis_figures() -> None:
    """Aspen, two billboards, L2 (figure 11): PSNR 92.605 and RMSE 2.24e-05 are 20.4 dB in [0, 1], the RMSE being a mean over views."""
    honest = 92.605 - 20 * math.log10(4095)
    assert honest == pytest.approx(20.36, abs=0.01)
    assert 10 ** (-honest / 20) / 4095 == pytest.approx(2.24e-5, rel=0.06)  # measured 4.6 %: channels are averaged after the root


def test_nothing_is_infinite() -> None:
    picture, empty = np.full((12, 12, 4), 0.5), np.zeros((12, 12, 4))
    assert thesis_scale.psnr(picture, picture) == pytest.approx(192.2451, abs=1e-4)
    assert thesis_scale.rmse(picture, picture) == 0
    assert thesis_scale.ssim(picture, picture) == pytest.approx(1, abs=1e-12)
    assert thesis_scale.sre(picture, picture) == pytest.approx(10 * math.log10(0.25 / (1e-6 / 12)), abs=1e-9)
    assert thesis_scale.sre(empty, empty) == thesis_scale.sre(empty, picture) == -120
    assert math.isfinite(thesis_scale.sre(picture, empty))


def test_bad_shapes() -> None:
    with pytest.raises(InputError, match="too small"):
        thesis_scale.ssim(np.zeros((6, 20, 4)), np.zeros((6, 20, 4)))
    for measure in (thesis_scale.rmse, thesis_scale.psnr, thesis_scale.ssim, thesis_scale.sre):
        with pytest.raises(InputError, match="render: expected shape"):
            measure(np.zeros((12, 12, 4)), np.zeros((12, 12, 3)))
