"""Difference in sharpness by Warp kernels."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from bbfit.operators.launching import LEAST_PIXELS, in_parallel, pieces_of
from bbfit.operators.precomputed import differentiable
from bbfit.operators.sharpness.kernels import differentiate, measure
from bbfit.operators.sharpness.reference import BLOCK


def sharpness_fused(render: Tensor, target: Tensor) -> Tensor:
    """:func:`~bbfit.operators.sharpness.reference.sharpness_reference` in float32, differentiable in ``render`` alone."""
    gradient = torch.zeros_like(render)
    return differentiable(add_sharpness_gradient(render, target, 1.0, gradient), render, gradient)


def add_sharpness_gradient(render: Tensor, target: Tensor, weight: float, gradient: Tensor) -> Tensor:
    """Add ``weight`` times the gradient of the difference in sharpness to ``gradient``.

    On a CPU equal inputs give equal bytes, whatever the number of threads.

    Parameters
    ----------
    render, target : Tensor
        Premultiplied RGBA in [0, 1], float32 [V, H, W, 4], contiguous.
    weight : float
        Factor of the gradient.
    gradient : Tensor
        Gradient in ``render`` to add to, float32 [V, H, W, 4], contiguous.

    Returns
    -------
    Tensor
        The difference in sharpness, a float64 scalar.
    """
    views, height, width, _ = render.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    device, on_gpu = wp.device_from_torch(render.device), render.is_cuda
    excess = torch.empty(views, rows, columns, 2, 3, dtype=torch.float32, device=render.device)
    sums = torch.zeros(views, rows, dtype=torch.float32, device=render.device)
    pictures = [wp.from_torch(picture.detach(), dtype=wp.vec4, requires_grad=False) for picture in (render, target, gradient)]
    blocks, totals = wp.from_torch(excess, dtype=wp.vec3), wp.from_torch(sums)
    terms = views * rows * columns * 3
    factor = weight * 2 / terms / BLOCK**2
    measure.module.load(device)  # or every thread would compile it

    def measured(begin: int, end: int) -> None:
        run = 1 if on_gpu else columns
        arguments = [begin, run, rows, pictures[0], pictures[1]]
        wp.launch(measure, (end - begin, -(-columns // run)), arguments, [blocks, totals], device=device)

    def differentiated(begin: int, end: int) -> None:
        run = 1 if on_gpu else width
        arguments = [begin, run, height, factor, pictures[0], blocks]
        wp.launch(differentiate, (end - begin, -(-width // run)), arguments, [pictures[2]], device=device)

    for work, count, pixels in ((measured, views * rows, width * BLOCK), (differentiated, views * height, width)):
        in_parallel(work, [(0, count)] if on_gpu else pieces_of(count, -(-LEAST_PIXELS // pixels)))
    return sums.sum(dtype=torch.float64) / terms
