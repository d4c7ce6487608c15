"""Differences between a render and a view, both premultiplied RGBA."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from bbfit.fitting.config import Loss

SHARPNESS_BLOCK = 8
"""Pixels across and down over which :func:`sharpness_difference` averages."""
_SIGMA, _RADIUS = 1.5, 5


def image_loss(render: Tensor, target: Tensor, kind: Loss, ssim_weight: float, sharpness_weight: float = 0.0) -> Tensor:
    """The thesis's L1 or L2 loss (section 4.4), or the one over random backgrounds, plus ``ssim_weight`` times (1 - SSIM), plus
    ``sharpness_weight`` times :func:`sharpness_difference`.

    Differences are summed over the four channels and averaged over pixels, as the thesis's ``1/p * sum`` does.

    ``backgrounds`` is what the squared difference of colors over an opaque background is in expectation, if every channel b of the
    background is uniform in [0, 1]. With the differences c of premultiplied color and a of alpha it has a closed form,

        sum over channels of E[(c - a b)^2] = sum of (c^2 - a c) + a^2,

    the L2 loss but for one term: color that is missing is worth less where alpha is missing with it, since the background shows instead.

    Parameters
    ----------
    render, target : [V, H, W, 4] premultiplied RGBA in [0, 1].

    Returns
    -------
    A scalar.
    """
    loss = pixel_losses(render, target, kind).mean()
    if ssim_weight:
        loss = loss + ssim_weight * (1 - structural_similarity(render, target))
    if sharpness_weight:
        loss = loss + sharpness_weight * sharpness_difference(render, target)
    return loss


def pixel_losses(render: Tensor, target: Tensor, kind: Loss) -> Tensor:
    """The loss of every pixel, without SSIM, [V, H, W]; see :func:`image_loss`."""
    difference = render - target
    loss = (difference.abs() if kind == "l1" else difference.square()).sum(-1)
    if kind == "backgrounds":
        loss = loss - difference[..., 3] * difference[..., :3].sum(-1)
    return loss


def structural_similarity(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM (Wang et al. 2004, equation 13; Gaussian window of 11 pixels, sigma 1.5; data range 1) over whole windows.

    Equals :func:`kornia.metrics.ssim` there, at half its cost, since the Gaussian is applied one axis at a time.

    Parameters
    ----------
    a, b : [V, H, W, C] in [0, 1], at least 11 pixels high and wide.
    """
    a, b = a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2)
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = _blur(a), _blur(b)
    variances = _blur(a * a) + _blur(b * b) - mean_a.square() - mean_b.square()
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    return (luminance * (2 * covariance + c2) / (variances + c2)).mean()


def sharpness_difference(render: Tensor, target: Tensor) -> Tensor:
    """How differently sharp two pictures are over white, block by block: 0 if each has as much contrast between neighbors as the other.

    For blocks of 8 x 8 pixels the mean absolute difference of neighbors, across and down, is compared by its square, and that is averaged
    over blocks, channels and views and summed over both directions. A squared difference of the pictures alone is least for a blur
    wherever a detail cannot be in the right place in every view; this asks for as much detail as there is, wherever it is.

    Parameters
    ----------
    render, target : [V, H, W, 4] premultiplied RGBA in [0, 1].

    Returns
    -------
    A scalar.
    """
    total = render.new_zeros(())
    white = [(image[..., :3] + 1 - image[..., 3:]).permute(0, 3, 1, 2) for image in (render, target)]
    for axis, margin in ((3, (0, 1)), (2, (0, 0, 0, 1))):
        across = [pad(image.diff(dim=axis).abs(), margin) for image in white]
        height, width = across[0].shape[2:]
        spare = (0, -width % SHARPNESS_BLOCK, 0, -height % SHARPNESS_BLOCK)
        first, second = (avg_pool2d(pad(image, spare), SHARPNESS_BLOCK) for image in across)
        total = total + (first - second).square().mean()
    return total


def binarization_loss(texels: Tensor) -> Tensor:
    """How much of the texels is neither there nor not: the sum of alpha (1 - alpha); texels without alpha have no derivative. A scalar."""
    alpha = texels[:, 3]
    return torch.where(alpha > 0, alpha * (1 - alpha), 0).sum()


def _blur(planes: Tensor) -> Tensor:
    """The Gaussian window's weighted mean around every pixel that has a whole window, [V, C, H - 10, W - 10]."""
    channels, taps = planes.shape[1], 2 * _RADIUS + 1
    offset = torch.arange(-_RADIUS, _RADIUS + 1, dtype=planes.dtype, device=planes.device)
    window = torch.softmax(-offset.square() / (2 * _SIGMA**2), 0)
    planes = conv2d(planes, window.view(1, 1, 1, taps).expand(channels, 1, 1, taps), groups=channels)
    return conv2d(planes, window.view(1, 1, taps, 1).expand(channels, 1, taps, 1), groups=channels)
