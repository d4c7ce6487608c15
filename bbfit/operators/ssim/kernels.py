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

from bbfit.operators.launching import FLAGS
from bbfit.operators.ssim.reference import RADIUS, SIGMA

_WEIGHTS = [math.exp(-((tap - RADIUS) ** 2) / (2 * SIGMA**2)) for tap in range(2 * RADIUS + 1)]
_WEIGHTS = [weight / sum(_WEIGHTS) for weight in _WEIGHTS]
_taps = wp.types.vector(length=len(_WEIGHTS) + 1, dtype=wp.float32)
TAPS = wp.constant(len(_WEIGHTS))
UPPER, LOWER = wp.constant(_taps(*_WEIGHTS, 0.0)), wp.constant(_taps(0.0, *_WEIGHTS))
"""Weights of the first and the second row of windows of a pair, over the twelve rows that the pair reads."""
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
    options = {"module": "unique", "enable_backward": False, "module_options": {"cpu_compiler_flags": FLAGS}}

    @wp.func
    def blur_columns(
        begin: int, end: int, thread: int, threads: int, view: int, y: int, row: int,
        a: wp.array3d(dtype=vector), b: wp.array3d(dtype=vector), blurred: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Blur s, d, s^2 and d^2 along columns, for the windows that begin in rows y and y + 1."""
        bottom = a.shape[1] - 1
        for i in range(thread, (end - begin + step - 1) // step, threads):
            x = wp.min(begin + step * i, end - step)
            upper_s = vector()
            upper_d = vector()
            upper_ss = vector()
            upper_dd = vector()
            lower_s = vector()
            lower_d = vector()
            lower_ss = vector()
            lower_dd = vector()
            for k in range(TAPS + 1):
                p = a[view, wp.min(y + k, bottom), x]
                q = b[view, wp.min(y + k, bottom), x]
                s = p + q
                d = p - q
                ss = wp.cw_mul(s, s)
                dd = wp.cw_mul(d, d)
                upper_s += UPPER[k] * s
                upper_d += UPPER[k] * d
                upper_ss += UPPER[k] * ss
                upper_dd += UPPER[k] * dd
                lower_s += LOWER[k] * s
                lower_d += LOWER[k] * d
                lower_ss += LOWER[k] * ss
                lower_dd += LOWER[k] * dd
            blurred[0, row, x] = upper_s
            blurred[1, row, x] = upper_d
            blurred[2, row, x] = upper_ss
            blurred[3, row, x] = upper_dd
            blurred[0, row + 1, x] = lower_s
            blurred[1, row + 1, x] = lower_d
            blurred[2, row + 1, x] = lower_ss
            blurred[3, row + 1, x] = lower_dd

    @wp.func
    def compare(
        begin: int, end: int, thread: int, threads: int, row: int,
        blurred: wp.array3d(dtype=vector), fresh: wp.array(dtype=vector), slopes: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Return the sum of 1 - SSIM over a row of windows; write D, 2 A and 2 B to ``slopes``, REACH pixels to the right."""
        total = vector()
        for i in range(thread, (end - begin + step - 1) // step, threads):
            x = wp.min(begin + step * i, end - step)
            mean_s = vector()
            mean_d = vector()
            mean_ss = vector()
            mean_dd = vector()
            for k in range(TAPS):
                mean_s += UPPER[k] * blurred[0, row, x + k]
                mean_d += UPPER[k] * blurred[1, row, x + k]
                mean_ss += UPPER[k] * blurred[2, row, x + k]
                mean_dd += UPPER[k] * blurred[3, row, x + k]
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
            of_s = vector()
            of_ss = vector()
            of_dd = vector()
            if row >= 0:
                for k in range(TAPS):
                    of_s += UPPER[k] * slopes[0, row, x + k]
                    of_ss += UPPER[k] * slopes[1, row, x + k]
                    of_dd += UPPER[k] * slopes[2, row, x + k]
            spread[0, to_row, x] = of_s
            spread[1, to_row, x] = of_ss
            spread[2, to_row, x] = of_dd

    @wp.func
    def spread_columns(
        begin: int, end: int, thread: int, threads: int, view: int, y: int, scale: float,
        a: wp.array3d(dtype=vector), b: wp.array3d(dtype=vector), spread: wp.array3d(dtype=vector), gradient: wp.array3d(dtype=vector),
    ):  # fmt: skip
        """Adjoint of the blur along columns; writes the gradient in rows y and y + 1 of ``a``, zero outside the range."""
        below = wp.min(y + 1, a.shape[1] - 1)
        for i in range(thread, (end - begin + step - 1) // step, threads):
            x = wp.min(begin + step * i, end - step)
            upper_s = vector()
            upper_ss = vector()
            upper_dd = vector()
            lower_s = vector()
            lower_ss = vector()
            lower_dd = vector()
            for k in range(TAPS + 1):
                row = (y + k) % spread.shape[1]
                of_s = spread[0, row, x]
                of_ss = spread[1, row, x]
                of_dd = spread[2, row, x]
                upper_s += UPPER[k] * of_s
                upper_ss += UPPER[k] * of_ss
                upper_dd += UPPER[k] * of_dd
                lower_s += LOWER[k] * of_s
                lower_ss += LOWER[k] * of_ss
                lower_dd += LOWER[k] * of_dd
            if below > y:
                p = a[view, below, x]
                q = b[view, below, x]
                gradient[view, below, x] = scale * (lower_s + wp.cw_mul(p + q, lower_ss) + wp.cw_mul(p - q, lower_dd))
            p = a[view, y, x]
            q = b[view, y, x]
            gradient[view, y, x] = scale * (upper_s + wp.cw_mul(p + q, upper_ss) + wp.cw_mul(p - q, upper_dd))
        width = a.shape[2] + step - 1
        for i in range(thread, begin // step, threads):
            gradient[view, y, step * i] = vector()
            gradient[view, below, step * i] = vector()
        for i in range(thread, (width - end + step - 1) // step, threads):
            x = wp.min(end + step * i, width - step)
            gradient[view, y, x] = vector()
            gradient[view, below, x] = vector()

    @wp.kernel(**options)
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
