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

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from bbfit.operators.image_loss.kernels import ROUNDING
from bbfit.operators.launching import FLAGS, PIXEL
from bbfit.operators.sharpness.reference import BLOCK

Pictures, Excess = wp.array3d(dtype=wp.vec4), wp.array4d(dtype=wp.vec4)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


def _lanes(of: Callable[[int], int]) -> str:
    """The lanes of four pixels that a shuffle takes."""
    return ", ".join(str(of(lane)) for lane in range(16))


# Four pixels fill a register of a CPU. `over_white` is for differences of pixels; it gives 0 in alpha.
_CODE = f"""{PIXEL}
    constexpr int BLOCK = {BLOCK};
    constexpr float ROUNDING = {ROUNDING!r}f;
    const int height = render.shape[1], width = render.shape[2];
#if defined(__CUDA_ARCH__)
    auto over_white = [](pixel d) {{ return d - pixel{{d[3], d[3], d[3], d[3]}}; }};
    auto contrast = [&](pixel d) {{
        const pixel w = over_white(d);
        return pixel{{fabsf(w[0]), fabsf(w[1]), fabsf(w[2]), 0.0f}};
    }};
    auto sign = [](float x) {{ return x > ROUNDING ? 1.0f : x < -ROUNDING ? -1.0f : 0.0f; }};
    auto signs = [&](pixel d) {{
        const pixel w = over_white(d);
        return pixel{{sign(w[0]), sign(w[1]), sign(w[2]), 0.0f}};
    }};
#else
    typedef float four __attribute__((vector_size(64), aligned(4), may_alias));
    auto load = [](const pixel* from) {{ return *(const four*)from; }};
    auto over_white = [](auto d) {{
        if constexpr (sizeof(d) == sizeof(four)) return d - __builtin_shufflevector(d, d, {_lanes(lambda lane: lane | 3)});
        else return d - __builtin_shufflevector(d, d, 3, 3, 3, 3);
    }};
    auto contrast = [&](auto d) {{ return __builtin_elementwise_abs(over_white(d)); }};
    auto signs = [&](auto d) {{  // 0 for what may be rounding
        const auto w = over_white(d);
        return __builtin_convertvector((w < -ROUNDING) - (w > ROUNDING), decltype(d));
    }};
#endif
"""


@wp.func_native(f"""{_CODE}
    const pixel none = {{0.0f, 0.0f, 0.0f, 0.0f}};
    pixel across[4] = {{none, none, none, none}}, down[4] = {{none, none, none, none}};
    const int right = width < block * BLOCK + BLOCK ? width : block * BLOCK + BLOCK;
    const int bottom = height < row * BLOCK + BLOCK ? height : row * BLOCK + BLOCK;
    for (int y = row * BLOCK; y < bottom; ++y) {{
        const long long start = (long long)(view * height + y) * width;
        const pixel *a = (const pixel*)render.data + start, *b = (const pixel*)target.data + start;
        const int below = y + 1 < height ? width : 0;  // 0: no difference
        int x = block * BLOCK;
#if !defined(__CUDA_ARCH__)
        for (; x + 4 <= right && x + 4 < width; x += 4) {{
            const four u = load(a + x), v = load(b + x);
            *(four*)across += contrast(load(a + x + 1) - u) - contrast(load(b + x + 1) - v);
            *(four*)down += contrast(load(a + x + below) - u) - contrast(load(b + x + below) - v);
        }}
#endif
        for (; x < right; ++x) {{
            const int next = x + 1 < width;
            across[0] = across[0] + (contrast(a[x + next] - a[x]) - contrast(b[x + next] - b[x]));
            down[0] = down[0] + (contrast(a[x + below] - a[x]) - contrast(b[x + below] - b[x]));
        }}
    }}
    pixel* to = (pixel*)excess.data + 2 * ((view * excess.shape[1] + row) * excess.shape[2] + block);
    to[0] = ((across[0] + across[1]) + (across[2] + across[3])) * (1.0f / (BLOCK * BLOCK));
    to[1] = ((down[0] + down[1]) + (down[2] + down[3])) * (1.0f / (BLOCK * BLOCK));
    const pixel squares = to[0] * to[0] + to[1] * to[1];
    return squares[0] + squares[1] + squares[2];
""")
def measure_block(render: Pictures, target: Pictures, excess: Excess, view: int, row: int, block: int) -> float:
    """Write e_B for rows and columns of a block; return the sum of their squares."""


@wp.func_native(f"""{_CODE}
    const pixel* a = (const pixel*)render.data + (long long)(view * height + y) * width;
    pixel* to = (pixel*)gradient.data + (long long)(view * height + y) * width;
    const pixel* blocks = (const pixel*)excess.data + 2LL * (view * excess.shape[1] + y / BLOCK) * excess.shape[2];
    const pixel* upper = y % BLOCK || !y ? blocks : blocks - 2 * excess.shape[2];
    const int below = y + 1 < height ? width : 0, above = y > 0 ? width : 0;  // 0: no difference
    int x = begin;
#if !defined(__CUDA_ARCH__)
    for (; x % 4 == 0 && x + 4 <= end && x + 4 < width; x += 4) {{
        const int block = 2 * (x / BLOCK), left = x > 0 ? 2 * ((x - 1) / BLOCK) : 0;
        auto spread = [](pixel first, pixel others) {{
            return __builtin_shufflevector(first, others, {_lanes(lambda lane: lane if lane < 4 else 4 + lane % 4)});
        }};
        const four here = load(a + x), to_right = signs(load(a + x + 1) - here);
        const pixel before = signs(a[x] - a[x - (x > 0)]);
        // The step to the left of a pixel is that to the right of the pixel before it.
        const four to_left = __builtin_shufflevector(
            __builtin_shufflevector(before, before, {_lanes(lambda lane: lane % 4)}), to_right,
            {_lanes(lambda lane: lane if lane < 4 else 12 + lane)}
        );
        four g = spread(blocks[left], blocks[block]) * to_left - spread(blocks[block], blocks[block]) * to_right;
        g = g + spread(upper[block + 1], upper[block + 1]) * signs(here - load(a + x - above));
        g = (g - spread(blocks[block + 1], blocks[block + 1]) * signs(load(a + x + below) - here)) * weight;
        const four pairs = g + __builtin_shufflevector(g, g, {_lanes(lambda lane: lane ^ 1)});
        const four sums = pairs + __builtin_shufflevector(pairs, pairs, {_lanes(lambda lane: lane ^ 2)});
        *(four*)(to + x) += __builtin_shufflevector(g, -sums, {_lanes(lambda lane: lane if lane % 4 < 3 else 16 + lane)});
    }}
#endif
    for (; x < end; ++x) {{
        const int block = 2 * (x / BLOCK), before = x > 0, left = 2 * ((x - before) / BLOCK), next = x + 1 < width;
        pixel g = blocks[left] * signs(a[x] - a[x - before]) - blocks[block] * signs(a[x + next] - a[x]);
        g = (g + upper[block + 1] * signs(a[x] - a[x - above]) - blocks[block + 1] * signs(a[x + below] - a[x])) * weight;
        g[3] = -(g[0] + g[1] + g[2]);
        to[x] = to[x] + g;
    }}
""")
def add_gradient(render: Pictures, excess: Excess, gradient: Pictures, weight: float, view: int, y: int, begin: int, end: int):
    """Add to the gradient of the pixels ``begin`` to ``end`` of a row."""


@wp.kernel
def measure(first_row: int, run: int, rows: int, render: Pictures, target: Pictures, excess: Excess, sums: wp.array2d(dtype=wp.float32)):
    """Write e_B for rows and columns to ``excess`` [V, H', W', 2]; add its squares to ``sums`` [V, H']; launched over rows and runs of
    blocks."""
    tid, piece = wp.tid()
    view = (first_row + tid) // rows
    row = (first_row + tid) % rows
    total = float(0.0)  # noqa: UP018 - declares a variable of the kernel
    for block in range(piece * run, wp.min(piece * run + run, excess.shape[2])):
        total += measure_block(render, target, excess, view, row, block)
    wp.atomic_add(sums, view, row, total)


@wp.kernel
def differentiate(first_row: int, run: int, height: int, weight: float, render: Pictures, excess: Excess, gradient: Pictures):
    """Add ``weight``, a multiple of 2 / (N n), times the bracket of the backward pass to ``gradient``; launched over rows and runs of
    pixels."""
    tid, piece = wp.tid()
    view = (first_row + tid) // height
    y = (first_row + tid) % height
    add_gradient(render, excess, gradient, weight, view, y, piece * run, wp.min(piece * run + run, render.shape[2]))
