"""Warp kernels for the structural similarity and its gradient; one source for the CPU and CUDA.

**Forward.** Let s = a + b and d = a - b. Because 4 cov(a, b) = var(s) - var(d) and 2 (var(a) + var(b)) = var(s) + var(d), equation 13 of
Wang et al. (2004) becomes

    SSIM = (1 - p) (1 - q),    p = 2 var(d) / (var(s) + var(d) + 2 C2),    q = 2 mean(d)^2 / (mean(s)^2 + mean(d)^2 + 2 C1),

with var(s) = G[s^2] - G[s]^2, where G is the Gaussian blur. Four maps are blurred (s, d, s^2, d^2) instead of five. Equal pictures give
exactly 1 and a zero gradient in float32.

**Backward.** Write m_s = G[s], m_d = G[d], V = 2 C2 + var(s) + var(d), M = 2 C1 + m_s^2 + m_d^2. The derivatives of a window's SSIM are

    by G[s^2]:  A = (1 - q) p / V,
    by G[d^2]:  B = -2 (1 - q) (var(s) + 2 C2) / V^2,
    by m_s:     4 (1 - p) m_s m_d^2 / M^2 - 2 m_s A,
    by m_d:     -4 (1 - p) m_d (m_s^2 + 2 C1) / M^2 - 2 m_d B.

The picture a enters both s and d with derivative 1, so the last two are added before they are blurred: let D be their sum. The window
is symmetric, so the adjoint is a blur too, of maps that are zero where there is no window. The gradient in a is

    G'[D] + 2 s G'[A] + 2 d G'[B],

with G' the adjoint of G: three maps are blurred.

**Schedule.** A pair of rows of windows passes through four stages: blur twelve rows of pixels into two; blur along these, compare and
differentiate; blur the derivatives along the rows; blur twelve rows of derivatives into the two rows of pixels that are now complete. On a
CPU one thread takes a pair through all stages, which keeps intermediate rows in its cache, and four pixels fill a vector register. On CUDA
each stage is a launch, and a thread takes two pixels, one below the other.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - int(0) declares a variable of a kernel, 0 a constant.

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.operators.launching import FLAGS, PIXEL
from bbfit.operators.ssim.reference import RADIUS, SIGMA

_WEIGHTS = [math.exp(-((tap - RADIUS) ** 2) / (2 * SIGMA**2)) for tap in range(2 * RADIUS + 1)]
_WEIGHTS = [weight / sum(_WEIGHTS) for weight in _WEIGHTS]
REACH = wp.constant(len(_WEIGHTS) - 1)
"""Number of pixels minus number of windows, along a row or a column."""
PAIRS_REACH = len(_WEIGHTS) // 2
"""REACH in pairs of rows. The first pair holds the rows -REACH and -REACH + 1, which have no windows."""
STAGES = 4


@wp.func
def joint(extents: wp.array(dtype=wp.vec2i), view: int, height: int, first: int, last: int):
    """Union of the extents of rows ``first`` to ``last`` of a view, as far as they exist."""
    extent = extents[view * height + wp.clamp(first, 0, height - 1)]
    for y in range(wp.max(first, 0), wp.min(last + 1, height)):
        other = extents[view * height + y]
        extent = wp.vec2i(wp.min(extent[0], other[0]), wp.max(extent[1], other[1]))
    return extent


@wp.func
def within(extent: wp.vec2i, before: int, after: int, count: int, step: int):
    """An extent, longer by ``before`` and ``after``, within ``count`` places, and widened until both ends are multiples of ``step`` or
    ``count``; (0, 0) if it is empty."""
    if extent[1] <= extent[0]:
        return wp.vec2i(0, 0)
    begin = wp.max(wp.min(extent[0] - before, count - step), 0)
    end = (wp.max(extent[1] + after, step) + step - 1) // step * step
    return wp.vec2i(begin - begin % step, wp.where(end > count - step, count, end))


_CODE = f"""
    constexpr int TAPS = {len(_WEIGHTS)};
    constexpr float WEIGHTS[] = {{{", ".join(f"{weight!r}f" for weight in _WEIGHTS)}}};
    auto at = [](const auto& array, int first, int second, int x) {{
        return (pixel*)((char*)array.data + first * (long long)array.strides[0] + second * (long long)array.strides[1]) + x;
    }};
"""
# Element x of a row begins at its pixel x, so the next vector of pixels is STEP elements further.
_BLUR_COLUMNS = """
    const int bottom = a.shape[1] - 1;
    const float *p[TAPS + 1], *q[TAPS + 1];
    for (int k = 0; k <= TAPS; ++k) {
        p[k] = (const float*)at(a, view, y + k < bottom ? y + k : bottom, 0);
        q[k] = (const float*)at(b, view, y + k < bottom ? y + k : bottom, 0);
    }
    for (int i = thread; i < (end - begin + STEP - 1) / STEP; i += threads) {
        const int x = begin + STEP * i < end - STEP ? begin + STEP * i : end - STEP;
        pixel upper[4] = {}, lower[4] = {};
        for (int k = 0; k <= TAPS; ++k) {
            const pixel u = *(const pixel*)(p[k] + 4 * x), v = *(const pixel*)(q[k] + 4 * x), s = u + v, d = u - v;
            const pixel maps[4] = {s, d, s * s, d * d};
            for (int m = 0; m < 4; ++m) {
                if (k < TAPS) upper[m] = upper[m] + maps[m] * WEIGHTS[k];
                if (k > 0) lower[m] = lower[m] + maps[m] * WEIGHTS[k - 1];
            }
        }
        for (int m = 0; m < 4; ++m) {
            *(pixel*)((float*)at(blurred, m, row, 0) + 4 * x) = upper[m];
            *(pixel*)((float*)at(blurred, m, row + 1, 0) + 4 * x) = lower[m];
        }
    }
"""
_SPREAD_COLUMNS = """
    const int below = y + 1 < a.shape[1] ? y + 1 : y, width = a.shape[2] + STEP - 1;
    const float* maps[3][TAPS + 1];
    for (int k = 0; k <= TAPS; ++k) {
        for (int m = 0; m < 3; ++m) maps[m][k] = (const float*)at(spread, m, (y + k) % spread.shape[1], 0);
    }
    const float *p = (const float*)at(a, view, y, 0), *q = (const float*)at(b, view, y, 0);
    const float *p_below = (const float*)at(a, view, below, 0), *q_below = (const float*)at(b, view, below, 0);
    float *to = (float*)at(gradient, view, y, 0), *to_below = (float*)at(gradient, view, below, 0);
    for (int i = thread; i < (end - begin + STEP - 1) / STEP; i += threads) {
        const int x = 4 * (begin + STEP * i < end - STEP ? begin + STEP * i : end - STEP);
        pixel upper[3] = {}, lower[3] = {};
        for (int k = 0; k <= TAPS; ++k) {
            for (int m = 0; m < 3; ++m) {
                const pixel of = *(const pixel*)(maps[m][k] + x);
                if (k < TAPS) upper[m] = upper[m] + of * WEIGHTS[k];
                if (k > 0) lower[m] = lower[m] + of * WEIGHTS[k - 1];
            }
        }
        const pixel u = *(const pixel*)(p + x), v = *(const pixel*)(q + x);
        const pixel u_below = *(const pixel*)(p_below + x), v_below = *(const pixel*)(q_below + x);
        if (below > y) {
            const pixel sum = (u_below + v_below) * lower[1], difference = (u_below - v_below) * lower[2];
            *(pixel*)(to_below + x) = (lower[0] + sum + difference) * scale;
        }
        *(pixel*)(to + x) = (upper[0] + (u + v) * upper[1] + (u - v) * upper[2]) * scale;
    }
    const pixel none = {};
    for (int i = thread; i < begin / STEP; i += threads) *(pixel*)(to + 4 * STEP * i) = *(pixel*)(to_below + 4 * STEP * i) = none;
    for (int i = thread; i < (width - end + STEP - 1) / STEP; i += threads) {
        const int x = 4 * (end + STEP * i < width - STEP ? end + STEP * i : width - STEP);
        *(pixel*)(to + x) = *(pixel*)(to_below + x) = none;
    }
"""


@cache
def kernels(pixels: int = 1) -> SimpleNamespace:
    """Kernels that process ``pixels`` pixels of a row at a time: 1 on CUDA, 4 on a CPU.

    Arrays of vectors overlap: element x holds the pixels from x on. The last vector of a row ends with the row and may repeat pixels of the
    vector before it.
    """
    lanes = 4 * pixels
    vector = wp.types.vector(length=lanes, dtype=wp.float32)
    bits = wp.types.vector(length=lanes, dtype=wp.int32)
    step = wp.constant(pixels)
    one, c1, c2 = (wp.constant(vector(value)) for value in (1.0, 2 * 0.01**2, 2 * 0.03**2))
    code = (PIXEL if pixels == 1 else "typedef float pixel __attribute__((vector_size(64), aligned(4), may_alias));") + _CODE
    code += f"constexpr int STEP = {pixels};"
    # Aligned loads and shuffles: most loads that begin at any pixel would cross cache lines.
    taps = range(len(_WEIGHTS))
    moved = [
        f"__builtin_shufflevector(v[{k // 4}], v[{k // 4 + 1}], {', '.join(str(k % 4 * 4 + c) for c in range(lanes))})"
        if pixels > 1
        else f"v[{k}]"
        for k in taps
    ]
    blur_along = f"""
    const pixel* v = (const pixel*)((const float*)at(rows, map, row, 0) + 4 * x);
    pixel sum = {" + ".join(f"{moved[k]} * WEIGHTS[{k}]" for k in taps)};
    wp::vec_t<{lanes}, wp::float32> blurred;
    *(pixel*)blurred.c = sum;
    return blurred;
"""
    options = {"module": "unique", "enable_backward": False, "module_options": {"cpu_compiler_flags": FLAGS}}

    @wp.func_native(code + blur_along)
    def blur_row(rows: wp.array3d(dtype=vector), map: int, row: int, x: int) -> vector:
        """Blur a map along a row, for the windows that begin at x and the pixels to its right."""

    @wp.func_native(code + _BLUR_COLUMNS)
    def blur_columns(
        begin: int, end: int, thread: int, threads: int, view: int, y: int, row: int,
        a: wp.array3d(dtype=vector), b: wp.array3d(dtype=vector), blurred: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Blur s, d, s^2 and d^2 along columns, for the windows that begin in rows y and y + 1."""

    @wp.func
    def compare(
        begin: int, end: int, thread: int, threads: int, row: int,
        blurred: wp.array3d(dtype=vector), fresh: wp.array(dtype=vector), slopes: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Return the sum of 1 - SSIM over a row of windows; write D, 2 A and 2 B to ``slopes``, REACH pixels to the right."""
        total = vector()
        for i in range(thread, (end - begin + step - 1) // step, threads):
            x = wp.min(begin + step * i, end - step)
            mean_s = blur_row(blurred, 0, row, x)
            mean_d = blur_row(blurred, 1, row, x)
            mean_ss = blur_row(blurred, 2, row, x)
            mean_dd = blur_row(blurred, 3, row, x)
            square_s = wp.cw_mul(mean_s, mean_s)
            square_d = wp.cw_mul(mean_d, mean_d)
            variance_s = mean_ss - square_s + c2
            variance_d = mean_dd - square_d
            square_s += c1
            per_variance = wp.cw_div(one, variance_s + variance_d)
            per_square = wp.cw_div(one, square_s + square_d)
            p = 2.0 * wp.cw_mul(variance_d, per_variance)
            q = 2.0 * wp.cw_mul(square_d, per_square)
            structure = one - p
            luminance = one - q
            total += wp.cw_mul(fresh[begin + step * i - x], p + wp.cw_mul(q, structure))
            of_ss = wp.cw_mul(wp.cw_mul(luminance, p), per_variance)
            of_dd = -2.0 * wp.cw_mul(wp.cw_mul(luminance, variance_s), wp.cw_mul(per_variance, per_variance))
            # The derivative of the luminance 1 - q by s and d.
            of_means = wp.cw_mul(mean_d, wp.cw_mul(mean_s, mean_d) - square_s)
            of_means = 4.0 * wp.cw_mul(wp.cw_mul(of_means, structure), wp.cw_mul(per_square, per_square))
            slopes[0, row, x + REACH] = of_means - 2.0 * (wp.cw_mul(mean_s, of_ss) + wp.cw_mul(mean_d, of_dd))
            slopes[1, row, x + REACH] = 2.0 * of_ss
            slopes[2, row, x + REACH] = 2.0 * of_dd
        if thread == 0:  # no window beside the range contributes
            for i in range(0, REACH, step):
                aside = wp.min(i, REACH - step)
                for m in range(3):
                    slopes[m, row, begin + aside] = vector()
                    slopes[m, row, end + REACH + aside] = vector()
        return total

    @wp.func
    def spread_row(
        begin: int, end: int, thread: int, threads: int, row: int, to_row: int,
        slopes: wp.array3d(dtype=vector), spread: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Adjoint of the blur along a row: a blur of the row with REACH zeros on both sides. Row -1 gives zero."""
        for i in range(thread, (end - begin + step - 1) // step, threads):
            x = wp.min(begin + step * i, end - step)
            for m in range(3):
                if row >= 0:
                    spread[m, to_row, x] = blur_row(slopes, m, row, x)
                else:
                    spread[m, to_row, x] = vector()

    @wp.func_native(code + _SPREAD_COLUMNS)
    def spread_columns(
        begin: int, end: int, thread: int, threads: int, view: int, y: int, scale: float,
        a: wp.array3d(dtype=vector), b: wp.array3d(dtype=vector), spread: wp.array3d(dtype=vector), gradient: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Adjoint of the blur along columns; writes the gradient in rows y and y + 1 of ``a``, zero outside the range."""

    @wp.kernel(**options, launch_bounds=(256, 2))
    def sweep(
        view: int, first: int, last: int, first_stage: int, last_stage: int, threads_down: int, threads_along: int, scale: float,
        window_ranges: wp.array2d(dtype=wp.vec2i), pixel_ranges: wp.array2d(dtype=wp.vec2i),
        a: wp.array3d(dtype=vector), b: wp.array3d(dtype=vector), fresh: wp.array(dtype=vector),
        blurred: wp.array3d(dtype=vector), slopes: wp.array3d(dtype=vector), spread: wp.array3d(dtype=vector),
        sums: wp.array3d(dtype=vector), gradient: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Take the pairs of rows ``first`` to ``last`` (excluded) through the stages ``first_stage`` to ``last_stage`` (excluded).

        Launched over ``threads_down``, which share the pairs, and ``threads_along``, which share a row. Gradients are written from the
        first pair on whose windows have all been visited. ``fresh`` [pixels] masks the lanes of a vector that repeat earlier pixels.
        """
        down, along = wp.tid()
        for pair in range(first + down, last, threads_down):
            y = 2 * pair - REACH
            windows = window_ranges[view, pair]
            pixels = pixel_ranges[view, pair]
            row = 2 * pair % blurred.shape[1]
            inside = int(0)  # rows of the pair that have windows
            if y >= 0:
                inside = wp.clamp(a.shape[1] - REACH - y, 0, 2)
            if windows[1] > windows[0]:
                if first_stage <= 0 and inside > 0:
                    blur_columns(windows[0], windows[1] + REACH, along, threads_along, view, y, row, a, b, blurred)
                if first_stage <= 1 and last_stage > 1:
                    for r in range(inside):
                        sums[view, y + r, along] = compare(windows[0], windows[1], along, threads_along, row + r, blurred, fresh, slopes)
                if first_stage <= 2 and last_stage > 2:
                    for r in range(wp.max(inside, 2)):  # 2, but not unrolled
                        from_row = wp.where(r < inside, row + r, -1)
                        to_row = (2 * pair + r) % spread.shape[1]
                        spread_row(windows[0], windows[1] + REACH, along, threads_along, from_row, to_row, slopes, spread)
            if last_stage > 3 and y >= 2 * first:
                spread_columns(pixels[0], pixels[1], along, threads_along, view, y, scale, a, b, spread, gradient)

    @wp.func
    def zero(a: wp.array2d(dtype=bits), b: wp.array2d(dtype=bits), row: int, x: int):
        """Whether a vector of pixels is zero in both pictures."""
        u = a[row, x]
        v = b[row, x]
        either = int(0)
        for j in range(wp.static(lanes)):
            either = either | u[j] | v[j]
        return either == 0

    @wp.kernel(**options)
    def find_extents(first: int, width: int, a: wp.array2d(dtype=bits), b: wp.array2d(dtype=bits), extents: wp.array(dtype=wp.vec2i)):
        """Write a range that contains all pixels of a row that are not zero in both pictures; (width, 0) if there are none."""
        tid, _ = wp.tid()
        row = first + tid
        begin = int(0)
        while begin < width and zero(a, b, row, wp.min(begin, width - step)):
            begin += step
        end = int(width)
        while end > begin and zero(a, b, row, wp.max(end - step, 0)):
            end -= step
        extents[row] = wp.where(begin < width, wp.vec2i(begin, end), wp.vec2i(width, 0))

    @wp.kernel(**options)
    def widen_extents(
        height: int, width: int, extents: wp.array(dtype=wp.vec2i),
        window_ranges: wp.array2d(dtype=wp.vec2i), pixel_ranges: wp.array2d(dtype=wp.vec2i),
    ):  # fmt: skip
        """Write the ranges that ``sweep`` visits in each pair of rows: pixels that share a window with a pixel that is not zero, and the
        windows that contain such pixels."""
        view, pair = wp.tid()
        y = 2 * pair - REACH
        extent = joint(extents, view, height, y - REACH, y + 1 + REACH)
        pixel_ranges[view, pair] = within(extent, REACH, REACH, width, step)
        extent = joint(extents, view, height, y - REACH, y + 1 + 2 * REACH)
        # One vector more, because the range of pixels is rounded up.
        window_ranges[view, pair] = within(extent, REACH, step, width - REACH, step)

    return SimpleNamespace(vector=vector, bits=bits, step=pixels, sweep=sweep, find_extents=find_extents, widen_extents=widen_extents)
