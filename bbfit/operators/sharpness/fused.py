"""Difference in sharpness by Warp kernels."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from bbfit.operators.launching import LEAST_PIXELS, differentiable, launch, warp_array
from bbfit.operators.sharpness.kernels import differentiate, measure
from bbfit.operators.sharpness.reference import BLOCK


def sharpness_fused(render: Tensor, target: Tensor) -> Tensor:
    """:func:`~bbfit.operators.sharpness.reference.sharpness_reference` in float32, differentiable in ``render`` alone."""
    gradient = torch.zeros_like(render)
    return differentiable(add_sharpness_gradient(render, target, 1.0, gradient), render, gradient)


def add_sharpness_gradient(render: Tensor, target: Tensor, weight: float, gradient: Tensor) -> Tensor:
    """The difference in sharpness, a float64 scalar, whose gradient in ``render``, times ``weight``, is added to ``gradient``.

    All three pictures are float32 [V, H, W, 4], contiguous; render and target are premultiplied RGBA in [0, 1]. On a CPU equal inputs give
    equal bytes, whatever the number of threads.
    """
    views, height, width, _ = render.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    on = wp.device_from_torch(render.device)
    excess = torch.empty(views, rows, columns, 2, 4, dtype=torch.float32, device=render.device)
    sums = torch.zeros(views, rows, dtype=torch.float32, device=render.device)
    pictures = [warp_array(picture, wp.vec4) for picture in (render, target, gradient)]
    blocks, totals = warp_array(excess, wp.vec4), warp_array(sums, wp.float32)
    terms = views * rows * columns * 3
    factor = weight * 2 / terms / BLOCK**2
    for kernel, (down, along, pixels), inputs, written in (
        (measure, (rows, columns, width * BLOCK), [rows, *pictures[:2]], [blocks, totals]),
        (differentiate, (height, width, width), [height, factor, pictures[0], blocks], [pictures[2]]),
    ):
        run = 1 if on.is_cuda else along
        launch(kernel, views * down, -(-LEAST_PIXELS // pixels), [run, *inputs], written, across=-(-along // run), on=on)
    return sums.sum(dtype=torch.float64) / terms
