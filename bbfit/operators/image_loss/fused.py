"""Losses of a render against a view by Warp kernels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from bbfit.operators.config import Loss
from bbfit.operators.image_loss.kernels import LOSSES, compare, unpack
from bbfit.operators.launching import LEAST_PIXELS, differentiable, launch, warp_array
from bbfit.operators.sharpness.fused import add_sharpness_gradient
from bbfit.operators.ssim.fused import ssim_and_gradient


@dataclass(frozen=True)
class PixelLoss:
    """A loss of every pixel that the backward pass of drawing computes, so that the picture itself is never stored."""

    target: Tensor
    """8-bit RGBA, uint8 [V, H, W, 4], contiguous."""
    straight: bool
    """Whether the target's alpha is straight; premultiplied otherwise."""
    kind: Loss
    """Loss of a pixel (:func:`~bbfit.operators.image_loss.reference.pixel_loss_reference`)."""
    weight: float
    """Factor of the loss, summed over pixels, in the gradient."""
    own_colors: bool = False
    """Whether the colors of layers are compared with the target's color instead, and only alpha has the gradient of the picture
    (:func:`~bbfit.operators.image_loss.reference.color_loss_reference`)."""


def image_loss_fused(render: Tensor, target: Tensor, kind: Loss, ssim_weight: float, sharpness_weight: float = 0.0) -> Tensor:
    """:func:`~bbfit.operators.image_loss.reference.image_loss_reference` in float32, differentiable in ``render`` alone."""
    gradient = torch.empty_like(render)
    structure = add_structure(render, target, ssim_weight, sharpness_weight, gradient)
    pixels, losses = render.numel() // 4, torch.empty(render.shape[:-1], device=render.device)
    arrays = [warp_array(picture.view(-1, 4), wp.vec4) for picture in (render, target, gradient)]
    arguments = [LOSSES[kind], 1 / pixels, *arrays, warp_array(losses.view(-1), wp.float32)]
    wp.launch(compare, pixels, arguments, device=wp.device_from_torch(render.device))
    return differentiable(losses.mean(dtype=torch.float64) + structure, render, gradient)


def add_structure(render: Tensor, target: Tensor, ssim_weight: float, sharpness_weight: float, out: Tensor) -> Tensor | float:
    """The weighted terms for structure and sharpness of :func:`image_loss_fused`, a float64 scalar; ``out`` becomes their gradient in
    ``render``. All pictures are float32 [V, H, W, 4], contiguous."""
    lost: Tensor | float = 0.0
    if ssim_weight:
        lost = ssim_weight * (1 - ssim_and_gradient(render, target, -ssim_weight, out)[0])
    else:
        out.zero_()
    if sharpness_weight:
        lost = lost + sharpness_weight * add_sharpness_gradient(render, target, sharpness_weight, out)
    return lost


def unpacked(packed: Tensor, straight: bool, out: Tensor | None = None) -> Tensor:
    """8-bit RGBA, straight or premultiplied, uint8 [V, H, W, 4], as premultiplied RGBA, float32, in ``out`` if given; all contiguous."""
    image = torch.empty(packed.shape, dtype=torch.float32, device=packed.device) if out is None else out
    run, on = 1 if packed.is_cuda else 1 << 10, wp.device_from_torch(packed.device)
    arguments = [run, warp_array(packed.view(torch.int32).flatten(), wp.int32), int(straight)]
    launch(unpack, -(-packed.numel() // 4 // run), LEAST_PIXELS // run, arguments, [warp_array(image.view(-1, 4), wp.vec4)], on=on)
    return image
