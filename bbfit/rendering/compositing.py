"""Depth order per pixel and the over operator."""

from __future__ import annotations

import torch
from torch import Tensor

TIE = 1e-5
"""Relative difference of depths below which two layers count as equally deep. It is far above rounding and far below what shows: which
of two planes is in front where they cross exactly at a pixel's centre must not depend on rounding."""


def composite(colours: list[Tensor], alphas: list[Tensor], depths: list[Tensor]) -> Tensor:
    """Blend layers by Porter and Duff's over operator (1984, section 4.3), each pixel in its own depth order.

    A layer contributes its alpha times the transmittance of all layers in front of it, ``prod(1 - alpha_j)``. Written pair by pair
    instead of after sorting: crossing planes have no order for a whole image, and per-pixel sorting and gathering costs several times
    as much on a CPU. Layers of equal depth (to :data:`TIE`) keep their index order, the lower index in front.

    Parameters
    ----------
    colours : N >= 1 straight colours, [V, 3, H, W] in [0, 1].
    alphas : N opacities, [V, 1, H, W] in [0, 1].
    depths : N depths, [V, 1, H, W]; smaller is nearer. Not differentiated.

    Returns
    -------
    Premultiplied RGBA, [V, 4, H, W].
    """
    weights = list(alphas)
    for j in range(1, len(alphas)):
        for i in range(j):
            i_in_front = depths[i] <= depths[j] * (1 + TIE)
            weights[j] = weights[j] * (1 - alphas[i] * i_in_front)
            weights[i] = weights[i] * (1 - alphas[j] * ~i_in_front)
    colour = colours[0] * weights[0]
    for n in range(1, len(colours)):
        colour = torch.addcmul(colour, colours[n], weights[n])
    return torch.cat([colour, sum(weights[1:], weights[0])], 1)
