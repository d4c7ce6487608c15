"""Structural similarity in torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

SIGMA, RADIUS = 1.5, 5
"""Standard deviation and radius of the Gaussian window, in pixels."""


def ssim_reference(render: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM over all windows that lie inside the picture (Wang et al. 2004, equation 13).

    The window is a Gaussian of 11 pixels with sigma 1.5; the data range is 1. Equals :func:`kornia.metrics.ssim` on these windows at half
    the cost, because the Gaussian is applied along one axis at a time. A scalar of at most 1, differentiable in both pictures.

    Parameters
    ----------
    render, target
        Premultiplied RGBA in [0, 1], [V, H, W, 4]; at least 11 pixels high and wide.
    """
    a, b = render.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2)
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = _blur(a), _blur(b)
    variances = _blur(a * a) + _blur(b * b) - mean_a.square() - mean_b.square()
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    return (luminance * (2 * covariance + c2) / (variances + c2)).mean()


def _blur(planes: Tensor) -> Tensor:
    """Gaussian mean of every whole window, [V, C, H - 10, W - 10]."""
    channels, taps = planes.shape[1], 2 * RADIUS + 1
    offset = torch.arange(-RADIUS, RADIUS + 1, dtype=planes.dtype, device=planes.device)
    window = torch.softmax(-offset.square() / (2 * SIGMA**2), 0)
    planes = conv2d(planes, window.view(1, 1, 1, taps).expand(channels, 1, 1, taps), groups=channels)
    return conv2d(planes, window.view(1, 1, taps, 1).expand(channels, 1, taps, 1), groups=channels)
