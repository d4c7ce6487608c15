"""Depth order per pixel and the over operator."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bbfit.geometry.alpha import AlphaMode

STEEPEST = 6.0
"""Largest slope of a mask's gradient, which is nonzero within 1 / (2 slope) of the cutoff; a step has no gradient of its own."""
LEAST_CONTRAST = 1e-4
"""Least change of alpha from pixel to pixel that the ramp of an antialiased mask divides by."""
HASH = (0x8DA6B343, 0xD8163841, 0xCB1AB31F, 0x7FEB352D, 0x846CA68B)
"""Factors of :func:`thresholds`: for a pixel's column and row, for a texture, and for the two rounds of mixing."""
TIE = 1e-5
"""Relative difference of depths below which layers count as equally deep. It is far above rounding and far below what is visible: where two
planes cross exactly at a pixel's center, their order must not depend on rounding."""


def composite(colors: list[Tensor], alphas: list[Tensor], depths: list[Tensor], *, nested: bool = False) -> Tensor:
    """Blend N >= 1 layers, each pixel in its own depth order, to premultiplied RGBA, [V, 4, H, W].

    The layers have straight colors [V, 3, H, W]; the rest is as for :func:`layer_weights`.
    """
    weights = layer_weights(alphas, depths, nested=nested)
    color = colors[0] * weights[0]
    for n in range(1, len(colors)):
        color = torch.addcmul(color, colors[n], weights[n])
    return torch.cat([color, sum(weights[1:], weights[0])], 1)


def composite_fragments(colors: Tensor, alphas: Tensor, depths: Tensor, pixels: Tensor, count: int, *, nested: bool = False) -> Tensor:
    """Do what :func:`composite` does for M fragments in place of whole layers: premultiplied values and alpha of ``count`` pixels.

    A fragment is what one layer shows in one pixel: straight color or other values [M, C], opacity [M], depth [M] and the index of the
    pixel, int64 [M]. The result is [count, C + 1], for colors RGBA. Fragments are in the order of their layers. For sparse layers this is
    many times faster.
    """
    order = depths.sort(stable=True).indices
    order = order[pixels[order].sort(stable=True).indices]
    while True:  # within a pixel, the order of neighbors of equal depth is that of the layers; neighbors are swapped until it is
        near, far = order[:-1], order[1:]
        wrong = (pixels[near] == pixels[far]) & (depths[far] <= depths[near] * (1 + TIE)) & (far < near)
        wrong[1:] &= ~wrong[:-1]  # pairs that share no fragment
        if not wrong.any():
            break
        at = wrong.nonzero()[:, 0]
        order[at], order[at + 1] = order[at + 1], order[at]
    pixel, number = pixels[order], torch.arange(len(order), device=order.device)
    first = torch.ones_like(number, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    rank = number - torch.where(first, number, 0).cummax(0).values
    by_rank = rank.sort(stable=True).indices  # no pixel occurs twice in a rank
    shown, hidden = colors.new_zeros(count, colors.shape[1] + 1), colors.new_zeros(count)
    for some in by_rank.split(torch.bincount(rank).tolist()):
        where, chosen = pixel[some], order[some]
        alpha, behind = alphas[chosen], hidden[where]
        weight = (alpha - behind).clamp_min(0) if nested else alpha * (1 - behind)
        hidden[where] = behind + weight
        shown[where] += weight[:, None] * torch.nn.functional.pad(colors[chosen], (0, 1), value=1.0)
    return shown


def layer_weights(alphas: list[Tensor], depths: list[Tensor], *, nested: bool = False) -> list[Tensor]:
    """The weights of N >= 1 layers in a picture, N of [V, 1, H, W], by Porter and Duff's over operator (1984, section 4.3).

    A layer contributes its alpha times the transmittance of all layers in front of it, ``prod(1 - alpha_j)``. The product is formed pair by
    pair, without sorting: crossing planes have no order for a whole picture, and sorting and gathering per pixel costs several times as
    much on a CPU. Among layers of equal depth (within :data:`TIE`) the lower index is in front.

    With ``nested``, alpha is the share of a pixel's samples that a layer covers, and all layers cover the same samples first, as graphics
    cards do for alpha to coverage (OpenGL 4.6, section 17.3.1). Of a layer then shows what the layers in front leave:
    ``max(alpha - max(alpha_j), 0)``.

    Layers have opacities [V, 1, H, W] in [0, 1] and depths [V, 1, H, W], which are smaller where nearer and not differentiated.
    """
    weights, hidden = list(alphas), [torch.zeros_like(alpha) for alpha in alphas]
    for j in range(1, len(alphas)):
        for i in range(j):
            i_in_front = depths[i] <= depths[j] * (1 + TIE)
            if nested:
                hidden[j] = torch.where(i_in_front & (alphas[i] > hidden[j]), alphas[i], hidden[j])
                hidden[i] = torch.where(~i_in_front & (alphas[j] > hidden[i]), alphas[j], hidden[i])
            else:
                weights[j] = weights[j] * (1 - alphas[i] * i_in_front)
                weights[i] = weights[i] * (1 - alphas[j] * ~i_in_front)
    if nested:
        weights = [torch.where(alpha > under, alpha - under, 0) for alpha, under in zip(alphas, hidden, strict=True)]
    return weights


def opacity(alpha: Tensor, mode: AlphaMode) -> Tensor:
    """Opacity of texture samples for their filtered alpha, [..., H, W], in all modes but ``hash``; the same shape.

    A mask is a ramp around its cutoff, or a step. An antialiased mask is a ramp that rises over one pixel: its slope is one over the
    :func:`contrast` of the pixel, at most the mode's hardness (Golus 2017, "Anti-aliased Alpha Test: The Esoteric Alpha To Coverage"; the
    slope is not differentiated). Where the ramp is steeper than :data:`STEEPEST`, the derivative is that of a ramp of this slope (a
    straight-through estimator; Bengio et al. 2013, section 4). Coverage is alpha, rounded to a whole number of the pixel's samples; the
    derivative is 1.
    """
    if mode.kind == "blend":
        return alpha
    if mode.kind == "coverage":
        return (alpha.detach() * mode.samples + 0.5).floor() / mode.samples + (alpha - alpha.detach()) if mode.samples else alpha
    if mode.antialiased:
        return coverage(alpha, contrast(alpha.detach()), mode)
    steepness = min(mode.hardness, STEEPEST)
    ramp = (0.5 + (alpha - mode.cutoff) * steepness).clamp(0, 1)
    if mode.hardness == steepness:
        return ramp
    hard = (alpha >= mode.cutoff).to(alpha) if math.isinf(mode.hardness) else (0.5 + (alpha - mode.cutoff) * mode.hardness).clamp(0, 1)
    return ramp + (hard - ramp).detach()


def covered_samples(alpha: Tensor, count: int) -> Tensor:
    """How much of each of a pixel's samples alpha covers, in the mode ``coverage``: 1 of the first ones, which are as many as alpha times
    their number, rounded, and 0 of the rest. The derivative is 1. From [...] it is [..., count]."""
    first = (alpha.detach()[..., None] * count >= torch.arange(count, device=alpha.device) + 0.5).to(alpha)
    return first + (alpha - alpha.detach())[..., None]


def coverage(alpha: Tensor, contrast: Tensor, mode: AlphaMode) -> Tensor:
    """The share of a pixel that an antialiased mask covers, for the filtered alpha at its center and the :func:`contrast`, of one shape."""
    rate = (1 / contrast.clamp_min(LEAST_CONTRAST)).clamp_max(mode.hardness)
    gentle, ramp = ((0.5 + (alpha - mode.cutoff) * slope).clamp(0, 1) for slope in (rate.clamp_max(STEEPEST), rate))
    return torch.where(alpha > 0, gentle + (ramp - gentle).detach(), 0)


def contrast(alpha: Tensor) -> Tensor:
    """How far alpha changes within each square of 2 x 2 pixels, as ``fwidth`` of GLSL computes it (GLSL 4.60, section 8.14.1).

    It is the sum of the absolute differences to the other pixel of the same row and to that of the same column. Squares begin at even
    coordinates; ``alpha`` is [..., H, W] with even H and W.
    """
    across = (alpha[..., 1::2] - alpha[..., ::2]).abs().repeat_interleave(2, -1)
    return across + (alpha[..., 1::2, :] - alpha[..., ::2, :]).abs().repeat_interleave(2, -2)


def thresholds(x: Tensor, y: Tensor, texture: int | Tensor) -> Tensor:
    """Pseudo-random thresholds of alpha in (0, 1) for the mode ``hash``, one for each pixel, int64 (x, y), and texture, by its first texel.

    An integer hash of 32 bits (lowbias32, C. Wellons, "Prospecting for Hash Functions", 2018).
    """
    bits, (of_x, of_y, of_texture, first_round, second_round) = 0xFFFFFFFF, HASH
    mixed = (x * of_x & bits) ^ (y * of_y & bits) ^ (texture * of_texture & bits)
    mixed = ((mixed ^ mixed >> 16) * first_round) & bits
    mixed = ((mixed ^ mixed >> 15) * second_round) & bits
    mixed = mixed ^ mixed >> 16
    return ((mixed >> 9).to(torch.float32) + 0.5) / (1 << 23)
