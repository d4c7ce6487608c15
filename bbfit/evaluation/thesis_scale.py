"""The four measures of the thesis (section 6 and figure 11) on its own scale.

The thesis used the package ``image-similarity-measures``, whose default peak of 4095 is meant for 12-bit satellite pictures, on pictures
in [0, 1]. This divides each RMSE by 4095, adds 20 log10(4095) = 72.25 dB to each PSNR and moves each SSIM to within a few
hundred-thousandths of 1. These measures serve only the comparison with the thesis's figures.

All functions take premultiplied RGBA pictures [H, W, 4] in [0, 1], the target first, and treat alpha like the other channels. They
compute in float64, where the package rounds to float32, and stay finite where it does not: a root mean squared error counts as at least
:data:`ERROR_FLOOR`, a signal-to-error ratio as at least :data:`RATIO_FLOOR`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_shape
from bbfit.evaluation.metrics import MSE_FLOOR, Image, mean_similarity

PEAK = 4095.0
"""The package's default ``max_p``."""
ERROR_FLOOR = MSE_FLOOR**0.5
"""Smallest root mean squared error in a logarithm or a denominator; identical pictures have a PSNR of 192.25 dB."""
RATIO_FLOOR = 1e-12
"""Smallest signal-to-error ratio in a logarithm; the SRE of an empty signal is -120 dB."""


def rmse(target: Image, render: Image) -> float:
    """Root mean squared error over the peak: ``sqrt(mean((x - y)^2)) / 4095`` of each channel, averaged over channels."""
    return float(np.sqrt(_channel_mse(target, render)).mean() / PEAK)


def psnr(target: Image, render: Image) -> float:
    """Peak signal-to-noise ratio in dB: ``20 log10(4095) - 10 log10(mse)``, the mean squared error averaged over channels."""
    return float(20 * np.log10(PEAK) - 10 * np.log10(max(_channel_mse(target, render).mean(), MSE_FLOOR)))


def ssim(target: Image, render: Image) -> float:
    """Structural similarity with scikit-image's defaults (a flat 7 x 7 window) and a data range of 4095.

    Raises InputError if the picture is too small (:func:`bbfit.evaluation.metrics.check_size`).
    """
    return mean_similarity(target, render, 7, data_range=PEAK)


def sre(target: Image, render: Image) -> float:
    """Signal-to-reconstruction-error ratio in dB: ``10 log10(mean over channels of mean(x)^2 / (|x - y| / (H W)))``.

    x is the target, y the render, |.| the Euclidean norm over a channel's pixels. As in the package the norm is not squared, so the value
    grows with the picture's size; Lanaras et al. 2018, who defined SRE, square it.

    The thesis's figures suggest that its x was the *render*: for one tree at nearly equal RMSE they differ by up to 15 dB (acer, figure
    11), which is impossible with the mean of a fixed target. Compare SRE with this in mind.
    """
    pixels = target.shape[0] * target.shape[1]
    # The norm over H W is the root mean squared error over sqrt(H W).
    error = np.maximum(np.sqrt(_channel_mse(target, render)), ERROR_FLOOR) / np.sqrt(pixels)
    signal = np.square(target.mean(axis=(0, 1), dtype=np.float64))
    return float(10 * np.log10(max((signal / error).mean(), RATIO_FLOOR)))


def _channel_mse(target: Image, render: Image) -> NDArray[np.float64]:
    """Mean squared error of each channel, [C]."""
    check_shape("render", render.shape, target.shape)
    return np.square(np.subtract(target, render, dtype=np.float64)).mean(axis=(0, 1))
