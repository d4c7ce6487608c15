"""Warp kernels for the difference in sharpness and its gradient; one source for the CPU and CUDA.

**Forward.** Let x be a channel of the render over white, c + 1 - a for premultiplied color c and alpha a, and y the same of the target.
For a block B of n = 64 pixels and the direction of rows,

    e_B = 1/n sum over i in B of (|x_(i+1) - x_i| - |y_(i+1) - y_i|),    L = 1/N sum over B of e_B^2,

where N counts blocks, channels and views; pixels without a right neighbor contribute 0. Columns are treated in the same way.

**Backward.** Only the differences to the two neighbors contain x_i:

    dL/dx_i = 2 / (N n) (e_B(i-1) sign(x_i - x_(i-1)) - e_B(i) sign(x_(i+1) - x_i)),

where B(i) is the block of pixel i. Over white dx/dc = 1 and dx/da = -1, so the gradient in alpha is minus the sum of the three channels'.
"""

# mypy: ignore-errors
# ruff: noqa: UP018 - int(0) declares a variable of a kernel, 0 a constant.

from __future__ import annotations

import warp as wp

from bbfit.operators.image_loss.kernels import sign
from bbfit.operators.launching import FLAGS
from bbfit.operators.sharpness.reference import BLOCK as BLOCK_VALUE

BLOCK = wp.constant(BLOCK_VALUE)
Pictures, Excess = wp.array3d(dtype=wp.vec4), wp.array4d(dtype=wp.vec3)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.func
def over_white(c: wp.vec4) -> wp.vec3:
    """A premultiplied color over white."""
    through = 1.0 - c[3]
    return wp.vec3(c[0] + through, c[1] + through, c[2] + through)


@wp.func
def signs(d: wp.vec3) -> wp.vec3:
    """Sign of every channel; 0 for what may be rounding."""
    return wp.vec3(sign(d[0]), sign(d[1]), sign(d[2]))


@wp.kernel
def measure(first_row: int, run: int, rows: int, render: Pictures, target: Pictures, excess: Excess, sums: wp.array2d(dtype=wp.float32)):
    """Write e_B for rows and columns to ``excess`` [V, H', W', 2]; add its squares to ``sums`` [V, H']; launched over rows and runs of
    blocks."""
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
def differentiate(first_row: int, run: int, height: int, weight: float, render: Pictures, excess: Excess, gradient: Pictures):
    """Add ``weight``, a multiple of 2 / (N n), times the bracket of the backward pass to ``gradient``; launched over rows and runs of
    pixels."""
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
