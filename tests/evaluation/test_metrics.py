"""Every honest measure against a case worked out by hand, and against scikit-image where it has one."""

from __future__ import annotations

import math

import flip_evaluator
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from bbfit.checks import InputError
from bbfit.evaluation import metrics, thesis_scale


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """Two different random RGB pictures [24, 31, 3], neither square nor even."""
    rng = np.random.default_rng(3)
    target = rng.random((24, 31, 3))
    return target, np.clip(target + rng.normal(0, 0.1, target.shape), 0, 1)


def rgba(alpha: np.ndarray, color: float = 0.5) -> np.ndarray:
    """Premultiplied picture of one gray, [H, W, 4]."""
    return np.concatenate([np.repeat(alpha[..., None] * color, 3, -1), alpha[..., None]], -1)


def test_constant_offset() -> None:
    """An offset of d everywhere is an RMSE of d and a PSNR of -20 log10 d."""
    target = np.full((12, 15, 4), 0.25)
    for offset in (0.5, 0.1, 1 / 255):
        assert metrics.mean_squared_error(target, target + offset) == pytest.approx(offset**2, rel=1e-12)
        assert metrics.root_mean_squared_error(target, target + offset) == pytest.approx(offset, rel=1e-12)
        assert metrics.psnr(target, target + offset) == pytest.approx(-20 * math.log10(offset), abs=1e-9)


def test_one_wrong_channel_counts_as_its_share() -> None:
    target, render = np.zeros((16, 16, 4)), np.zeros((16, 16, 4))
    render[..., 3] = 0.5
    assert metrics.psnr(target, render) == pytest.approx(-10 * math.log10(0.25 / 4), abs=1e-9)


def test_psnr_is_scikit_images(pair: tuple[np.ndarray, np.ndarray]) -> None:
    assert metrics.psnr(*pair) == pytest.approx(peak_signal_noise_ratio(*pair, data_range=1), abs=1e-9)


def test_ssim_is_scikit_images_and_has_eleven_taps(pair: tuple[np.ndarray, np.ndarray]) -> None:
    expected = structural_similarity(
        *pair, data_range=1, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )  # fmt: skip
    assert metrics.ssim(*pair) == pytest.approx(expected, abs=1e-12)
    # The only window inside an 11 x 11 picture: Wang et al. 2004, equations 13 to 16, written out.
    x, y = (image[:11, :11, :1] for image in pair)
    taps = np.exp(-np.square(np.arange(-5, 6)) / (2 * 1.5**2))
    weight = np.outer(taps, taps)[..., None] / taps.sum() ** 2
    mean_x, mean_y = (weight * x).sum(), (weight * y).sum()
    var_x, var_y = (weight * (x - mean_x) ** 2).sum(), (weight * (y - mean_y) ** 2).sum()
    covariance = (weight * (x - mean_x) * (y - mean_y)).sum()
    c1, c2 = 0.01**2, 0.03**2
    by_hand = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    assert metrics.ssim(x, y) == pytest.approx(by_hand, abs=1e-9)


def test_float32_pictures_are_summed_in_float64() -> None:
    target = np.full((512, 512, 3), 0.1, np.float32)
    expected = (float(np.float32(0.3)) - float(np.float32(0.1))) ** 2
    assert metrics.mean_squared_error(target, np.full_like(target, 0.3)) == pytest.approx(expected, rel=1e-12)


def test_flip(pair: tuple[np.ndarray, np.ndarray], capfd: pytest.CaptureFixture[str]) -> None:
    """Zero for equal pictures, where pictures differ only near there, larger for larger errors; in [0, 1]; and silent."""
    target, render = pair
    assert metrics.flip(target, target) == 0
    assert 0 < metrics.flip(target, target + 0.2 * (render - target)) < metrics.flip(target, render) < 1
    white, spot = np.ones((40, 60, 3)), np.ones((40, 60, 3))
    spot[20, 50] = 0
    error = metrics.flip_map(white, spot)
    assert error.shape == (40, 60) and error.dtype == np.float64
    assert np.unravel_index(error.argmax(), error.shape) == (20, 50)
    assert error[:, :35].max() == 0 and 0.2 < error.max() <= 1  # measured 0.283: a viewer blurs a single pixel
    assert metrics.flip(white, spot) == pytest.approx(error.mean(), rel=1e-12)
    assert capfd.readouterr() == ("", "")


def test_flip_black_on_white() -> None:
    """Without edges only the color difference counts, the same everywhere; measured 0.967 (saturated green on black has 0.997)."""
    error = metrics.flip_map(np.ones((16, 16, 3)), np.zeros((16, 16, 3)))
    assert np.ptp(error) < 1e-5
    assert error.mean() == pytest.approx(0.967, abs=1e-3)


@pytest.mark.parametrize(
    ("columns", "expected"), [((0, 8), 1.0), ((8, 16), 0.0), ((4, 12), 1 / 3), ((0, 4), 0.5), ((0, 16), 0.5), ((0, 0), 0.0)]
)
def test_iou(columns: tuple[int, int], expected: float) -> None:
    """The left half against other upright strips."""
    target, render = np.zeros((16, 16)), np.zeros((16, 16))
    target[:, :8], render[:, slice(*columns)] = 1, 1
    assert metrics.alpha_iou(rgba(target), rgba(render)) == pytest.approx(expected, abs=1e-12)


def test_iou_threshold_and_empty() -> None:
    half, less, none = np.full((12, 12), 0.5), np.full((12, 12), 0.499), np.zeros((12, 12))
    assert metrics.alpha_iou(rgba(half), rgba(half)) == 1
    assert metrics.alpha_iou(rgba(half), rgba(less)) == 0
    assert metrics.alpha_iou(rgba(none), rgba(none)) == 1


def test_sharpness(pair: tuple[np.ndarray, np.ndarray]) -> None:
    target, _ = pair
    assert metrics.sharpness(target, target) == 1
    assert metrics.sharpness(target, 0.25 + 0.5 * target) == pytest.approx(0.5, rel=1e-12)
    assert metrics.sharpness(target, np.ones_like(target)) == 0
    assert metrics.sharpness(np.ones_like(target), target) is None
    # A ramp rises by 1/16 between neighbors along rows only, a checkerboard changes by 1 between all neighbors.
    ramp, board = np.zeros((16, 17, 3)), np.zeros((16, 17, 3))
    ramp += np.linspace(0, 1, 17)[None, :, None]
    board[::2, ::2] = board[1::2, 1::2] = 1
    assert metrics.sharpness(ramp, board) == pytest.approx((1 + 1) / (1 / 16 + 0), rel=1e-12)


def test_brightness() -> None:
    rng = np.random.default_rng(5)
    alpha = np.zeros((16, 16))
    alpha[4:12, 4:12] = 1
    target = rgba(alpha) * np.array([*rng.random(3), 1])
    darker = target * np.array([0.5, 0.5, 0.5, 1])
    assert metrics.brightness(target, target) == 1
    assert metrics.brightness(target, darker) == pytest.approx(0.5, rel=1e-12)
    outside = darker.copy()
    outside[0] = 1  # what lies outside the target's silhouette does not count
    assert metrics.brightness(target, outside) == metrics.brightness(target, darker)
    assert metrics.brightness(target, np.zeros_like(target)) == 0
    assert metrics.brightness(np.zeros_like(target), target) is None
    assert metrics.brightness(rgba(alpha, 0.0), target) is None


def test_identical_pictures_stay_finite(pair: tuple[np.ndarray, np.ndarray]) -> None:
    target, _ = pair
    assert metrics.psnr(target, target) == 120
    assert metrics.ssim(target, target) == pytest.approx(1, abs=1e-12)
    assert metrics.root_mean_squared_error(target, target) == 0


@pytest.mark.parametrize("shape", [(10, 40, 3), (40, 10, 3)])
def test_too_small_for_the_window(shape: tuple[int, ...]) -> None:
    image = np.zeros(shape)
    with pytest.raises(InputError, match=f"{shape[1]} x {shape[0]} pixels are too small.*at least 11 x 11"):
        metrics.ssim(image, image)


@pytest.mark.parametrize("measure", [metrics.psnr, metrics.ssim, metrics.flip, metrics.alpha_iou, metrics.sharpness, metrics.brightness])
def test_unequal_shapes(measure: object) -> None:
    """Never broadcast: one row must not pass for a picture."""
    channels = 4 if measure in (metrics.alpha_iou, metrics.brightness) else 3
    assert callable(measure)
    with pytest.raises(InputError, match="render: expected shape"):
        measure(np.zeros((16, 16, channels)), np.zeros((1, 16, channels)))


def test_silhouettes_are_as_far_apart_as_most_of_their_pixels() -> None:
    """A block moved by three pixels; a speck that is less than a twentieth of it does not count, a hole that is more does."""
    target = np.zeros((40, 60, 4))
    target[10:30, 10:30, 3] = 0.5
    moved = np.roll(target, 3, 1)
    assert metrics.silhouette_distance(target, target) == 0
    # Of 20 columns one each is 1, 2 and 3 pixels off, so that 19 of 20 are within 2.
    assert metrics.silhouette_distance(target, moved) == metrics.silhouette_distance(moved, target) == 2
    assert metrics.silhouette_distance(target, np.roll(target, 1, 0)) == 0
    speck = target.copy()
    speck[2, 50, 3] = 1
    assert metrics.silhouette_distance(target, speck) == 0
    faint = target * 0.9
    assert metrics.silhouette_distance(target, faint) == np.hypot(40, 60) == metrics.silhouette_distance(faint, target)
    assert metrics.silhouette_distance(faint, faint) == 0
    holed = target.copy()
    holed[16:24, 16:24] = 0
    assert metrics.silhouette_distance(target, holed) == metrics.silhouette_distance(holed, target) >= 2
    with pytest.raises(InputError, match="render"):
        metrics.silhouette_distance(target, target[:-1])


@pytest.mark.parametrize("place", [(0, 0, 9, 13), (70, 60, 21, 4), (100, 90, 20, 30), (40, 37, 1, 1), (0, 0, 120, 120)])
@pytest.mark.parametrize("noisy", [False, True])
def test_what_is_equal_may_be_left_out_of_ssim_and_flip(place: tuple[int, int, int, int], noisy: bool) -> None:
    """Pictures that differ in a rectangle, at corners and borders too, before a plain or a noisy background."""
    rng = np.random.default_rng(3)
    target = rng.random((120, 120, 3)) if noisy else np.full((120, 120, 3), (0.25, 0.35, 0.12))
    row, column, height, width = place
    render = target.copy()
    render[row : row + height, column : column + width] = rng.random((height, width, 3))
    found, _, _ = flip_evaluator.evaluate(
        target.astype(np.float32), render.astype(np.float32), "LDR", applyMagma=False, computeMeanError=False, parameters={}
    )
    np.testing.assert_allclose(metrics.flip_map(target, render), found[..., 0], rtol=0, atol=1e-9)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": 2, "data_range": 1.0}
    assert metrics.ssim(target, render) == pytest.approx(structural_similarity(target, render, **options), abs=1e-12)
    flat = structural_similarity(target, render, data_range=4095, channel_axis=2)
    assert thesis_scale.ssim(target, render) == pytest.approx(flat, abs=1e-12)
