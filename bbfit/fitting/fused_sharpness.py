"""The difference in sharpness with its gradient by Warp kernels, for CPU and CUDA; :func:`bbfit.fitting.losses.sharpness_difference`."""

# mypy: ignore-errors
# ruff: noqa: UP018 - int(0) declares a variable of a kernel, 0 a constant.

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from bbfit.fitting.losses import SHARPNESS_BLOCK
from bbfit.rendering.launching import FLAGS, in_parallel, pieces_of
from bbfit.rendering.sampling import sign

BLOCK = wp.constant(SHARPNESS_BLOCK)
# Pixels that are worth a CPU thread's while.
_LEAST_PIXELS = 1 << 14

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.func
def over_white(c: wp.vec4) -> wp.vec3:
    """A premultiplied color over white."""
    through = 1.0 - c[3]
    return wp.vec3(c[0] + through, c[1] + through, c[2] + through)


@wp.func
def signs(d: wp.vec3) -> wp.vec3:
    """The sign of every channel; 0 for what may be rounding."""
    return wp.vec3(sign(d[0]), sign(d[1]), sign(d[2]))


@wp.kernel
def measure(
    first_row: int,
    run: int,
    rows: int,
    render: wp.array3d(dtype=wp.vec4),
    target: wp.array3d(dtype=wp.vec4),
    excess: wp.array4d(dtype=wp.vec3),
    sums: wp.array2d(dtype=wp.float32),
):
    """Write by how much blocks of ``render`` are sharper, across and down, [V, H', W', 2], and add its squares up by rows, [V, H'].

    Launched over rows of blocks of all views, from ``first_row``, and runs of blocks.
    """
    tid, piece = wp.tid()
    view = (first_row + tid) // rows
    row = (first_row + tid) % rows
    bottom = wp.min(row * BLOCK + BLOCK, render.shape[1])
    total = float(0.0)
    block = piece * run
    while block < wp.min(piece * run + run, excess.shape[2]):
        right = wp.min(block * BLOCK + BLOCK, render.shape[2])
        across = wp.vec3()
        down = wp.vec3()
        y = row * BLOCK
        while y < bottom:
            x = block * BLOCK
            while x < right:
                a = over_white(render[view, y, x])
                b = over_white(target[view, y, x])
                if x + 1 < render.shape[2]:
                    across += wp.abs(over_white(render[view, y, x + 1]) - a) - wp.abs(over_white(target[view, y, x + 1]) - b)
                if y + 1 < render.shape[1]:
                    down += wp.abs(over_white(render[view, y + 1, x]) - a) - wp.abs(over_white(target[view, y + 1, x]) - b)
                x += 1
            y += 1
        across *= 1.0 / float(BLOCK * BLOCK)
        down *= 1.0 / float(BLOCK * BLOCK)
        excess[view, row, block, 0] = across
        excess[view, row, block, 1] = down
        total += wp.dot(across, across) + wp.dot(down, down)
        block += 1
    wp.atomic_add(sums, view, row, total)


@wp.kernel
def differentiate(
    first_row: int,
    run: int,
    height: int,
    weight: float,
    render: wp.array3d(dtype=wp.vec4),
    excess: wp.array4d(dtype=wp.vec3),
    gradient: wp.array3d(dtype=wp.vec4),
):
    """Add the gradient in ``render``, times ``weight``, to ``gradient``; launched over rows of all views and runs of pixels."""
    tid, piece = wp.tid()
    view = (first_row + tid) // height
    y = (first_row + tid) % height
    x = piece * run
    while x < wp.min(piece * run + run, render.shape[2]):
        here = over_white(render[view, y, x])
        g = wp.vec3()
        if x + 1 < render.shape[2]:
            g -= wp.cw_mul(excess[view, y // BLOCK, x // BLOCK, 0], signs(over_white(render[view, y, x + 1]) - here))
        if x > 0:
            g += wp.cw_mul(excess[view, y // BLOCK, (x - 1) // BLOCK, 0], signs(here - over_white(render[view, y, x - 1])))
        if y + 1 < height:
            g -= wp.cw_mul(excess[view, y // BLOCK, x // BLOCK, 1], signs(over_white(render[view, y + 1, x]) - here))
        if y > 0:
            g += wp.cw_mul(excess[view, (y - 1) // BLOCK, x // BLOCK, 1], signs(here - over_white(render[view, y - 1, x])))
        g *= weight
        gradient[view, y, x] += wp.vec4(g[0], g[1], g[2], -(g[0] + g[1] + g[2]))
        x += 1


def add_sharpness_gradient(render: Tensor, target: Tensor, weight: float, gradient: Tensor) -> Tensor:
    """The difference in sharpness, float64; ``weight`` times its gradient in ``render`` is added to ``gradient``.

    Computes :func:`bbfit.fitting.losses.sharpness_difference` in float32. On a CPU equal inputs give equal bytes.

    Parameters
    ----------
    render, target, gradient : float32 [V, H, W, 4], contiguous.
    """
    views, height, width, _ = render.shape
    rows, columns = -(-height // SHARPNESS_BLOCK), -(-width // SHARPNESS_BLOCK)
    device, on_gpu = wp.device_from_torch(render.device), render.is_cuda
    excess = torch.empty(views, rows, columns, 2, 3, dtype=torch.float32, device=render.device)
    sums = torch.zeros(views, rows, dtype=torch.float32, device=render.device)
    pictures = [wp.from_torch(picture.detach(), dtype=wp.vec4, requires_grad=False) for picture in (render, target, gradient)]
    blocks, totals = wp.from_torch(excess, dtype=wp.vec3), wp.from_torch(sums)
    terms = views * rows * columns * 3
    factor = weight * 2 / terms / SHARPNESS_BLOCK**2
    measure.module.load(device)  # or every thread would compile it

    def measured(begin: int, end: int) -> None:
        run = 1 if on_gpu else columns
        arguments = [begin, run, rows, pictures[0], pictures[1]]
        wp.launch(measure, (end - begin, -(-columns // run)), arguments, [blocks, totals], device=device)

    def differentiated(begin: int, end: int) -> None:
        run = 1 if on_gpu else width
        arguments = [begin, run, height, factor, pictures[0], blocks]
        wp.launch(differentiate, (end - begin, -(-width // run)), arguments, [pictures[2]], device=device)

    for work, count, pixels in ((measured, views * rows, width * SHARPNESS_BLOCK), (differentiated, views * height, width)):
        in_parallel(work, [(0, count)] if on_gpu else pieces_of(count, -(-_LEAST_PIXELS // pixels)))
    return sums.sum(dtype=torch.float64) / terms
