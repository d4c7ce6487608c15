"""Differences between a render and a view, both premultiplied RGBA."""

from __future__ import annotations

from kornia.metrics import ssim
from torch import Tensor

from bbfit.fitting.config import Loss


def image_loss(render: Tensor, target: Tensor, kind: Loss, ssim_weight: float) -> Tensor:
    """The thesis's L1 or L2 loss (section 4.4), plus ``ssim_weight`` times (1 - SSIM).

    Both differences are summed over the four channels and averaged over pixels, as the thesis's ``1/p * sum`` does. SSIM is that of
    Wang et al. 2004 with the usual Gaussian window (11 pixels, sigma 1.5), averaged over the four channels.

    Parameters
    ----------
    render, target : [V, H, W, 4] premultiplied RGBA in [0, 1].

    Returns
    -------
    A scalar.
    """
    difference = render - target
    loss = (difference.abs() if kind == "l1" else difference.square()).sum(-1).mean()
    if ssim_weight:
        similarity = ssim(render.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2), window_size=11)
        loss = loss + ssim_weight * (1 - similarity.mean())
    return loss
