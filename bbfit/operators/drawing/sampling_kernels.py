"""Warp functions for a sample of a texture, and their adjoints.

**Forward.** A sample at texel (i + fx, j + fy) is S = sum over its four texels of w_c t_c with the bilinear weights w = (1 - fx)(1 - fy),
fx (1 - fy), (1 - fx) fy, fx fy. Alpha is 0 in texels beyond the border.

**Backward.** For a derivative g in S, texel c receives w_c g (:func:`scatter`). The derivative in the texel coordinates is, with the
products k_c = t_c . g,

    by u: (k_1 - k_0)(1 - fy) + (k_3 - k_2) fy,    by v: (k_2 - k_0)(1 - fx) + (k_3 - k_1) fx

(:func:`slope`). Opacity is a step or a ramp of filtered alpha; where it is steeper than
:data:`~bbfit.operators.drawing.compositing.STEEPEST`, :func:`opacity_slope` is a straight-through estimate.
"""

# mypy: ignore-errors

import warp as wp

from bbfit.operators.drawing.compositing import HASH
from bbfit.operators.drawing.compositing import LEAST_CONTRAST as LEAST_CONTRAST_VALUE
from bbfit.operators.drawing.compositing import STEEPEST as STEEPEST_VALUE
from bbfit.operators.launching import FLAGS

BLOCK = 4
"""Consecutive texels that share one byte of occupancy and that Adam updates together."""
BLOCK_BITS = wp.constant(2)
LEAST_CONTRAST, STEEPEST = wp.constant(LEAST_CONTRAST_VALUE), wp.constant(STEEPEST_VALUE)
SMOOTH, COVERAGE = wp.constant(1.0), wp.constant(2.0)
"""An antialiased mask, and coverage, in the last place of the vector that :func:`opacity` takes."""
OF_X, OF_Y, OF_TEXTURE, FIRST_ROUND, SECOND_ROUND = (wp.constant(wp.uint32(factor)) for factor in HASH)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


# Warp's own indexing multiplies by strides and supports negative indices, which costs more than the rest of a sample.
@wp.func_native("return texels.data[index];")
def texel(texels: wp.array(dtype=wp.vec4), index: int) -> wp.vec4:
    """Texel ``index``."""


@wp.func_native("wp::atomic_add(gradient.data + index, value);")
def accumulate(gradient: wp.array(dtype=wp.vec4), index: int, value: wp.vec4):
    """Add ``value`` to texel ``index``."""


@wp.func_native("return flags.data[index];")
def flag(flags: wp.array(dtype=wp.uint8), index: int) -> wp.uint8:
    """Flag ``index``."""


# Without this type the compiler splits these sums into single floats.
_ROW = "typedef float row __attribute__((vector_size(16), aligned(4), may_alias));"


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const auto upper = wp::add(texels.data[i], wp::mul(wp::sub(texels.data[i + 1], texels.data[i]), fx));
    const auto lower = wp::add(texels.data[j], wp::mul(wp::sub(texels.data[j + 1], texels.data[j]), fx));
    return wp::add(upper, wp::mul(wp::sub(lower, upper), fy));
#else
    {_ROW}
    const row *p = (const row*)(texels.data + i), *q = (const row*)(texels.data + j);
    const row upper = p[0] + (p[1] - p[0]) * fx, lower = q[0] + (q[1] - q[0]) * fx;
    const row mixed = upper + (lower - upper) * fy;
    return wp::vec_t<4, wp::float32>(mixed[0], mixed[1], mixed[2], mixed[3]);
#endif
""")
def bilinear(texels: wp.array(dtype=wp.vec4), i: int, j: int, fx: float, fy: float) -> wp.vec4:
    """The mean of texels i, i + 1, j and j + 1, weighted by ``fx`` to the right and ``fy`` down."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const auto right = wp::mul(g, fx), left = wp::sub(g, right);
    wp::atomic_add(gradient.data + i, wp::mul(left, 1.0f - fy));
    wp::atomic_add(gradient.data + i + 1, wp::mul(right, 1.0f - fy));
    wp::atomic_add(gradient.data + j, wp::mul(left, fy));
    wp::atomic_add(gradient.data + j + 1, wp::mul(right, fy));
#else
    {_ROW}
    row *p = (row*)(gradient.data + i), *q = (row*)(gradient.data + j);
    const row all = {{g.c[0], g.c[1], g.c[2], g.c[3]}};
    const row right = all * fx, left = all - right;
    p[0] += left * (1.0f - fy);
    p[1] += right * (1.0f - fy);
    q[0] += left * fy;
    q[1] += right * fy;
#endif
""")
def accumulate_bilinear(gradient: wp.array(dtype=wp.vec4), i: int, j: int, fx: float, fy: float, g: wp.vec4):
    """The adjoint of :func:`bilinear`."""


@wp.func
def corners(texture: wp.vec3i, left: int, top: int) -> wp.vec4i:
    """Indices of the four texels around a sample, row by row; clamped at borders."""
    x0 = wp.max(left, 0)
    x1 = wp.min(left + 1, texture[2] - 1)
    above = texture[0] + wp.max(top, 0) * texture[2]
    below = texture[0] + wp.min(top + 1, texture[1] - 1) * texture[2]
    return wp.vec4i(above + x0, above + x1, below + x0, below + x1)


@wp.func
def present(texture: wp.vec3i, left: int, top: int) -> wp.vec4:
    """1 for each of the :func:`corners` inside the texture, 0 for those beyond its border, whose alpha is 0."""
    in_l = wp.where(left < 0, 0.0, 1.0)
    in_r = wp.where(left + 1 >= texture[2], 0.0, 1.0)
    in_t = wp.where(top < 0, 0.0, 1.0)
    in_b = wp.where(top + 1 >= texture[1], 0.0, 1.0)
    return wp.vec4(in_l * in_t, in_r * in_t, in_l * in_b, in_r * in_b)


@wp.func
def weights(fx: float, fy: float) -> wp.vec4:
    """Bilinear weights of the :func:`corners`."""
    return wp.vec4((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy)


@wp.func
def fetch(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, left: int, top: int, fx: float, fy: float) -> wp.vec4:
    """Bilinear straight RGBA; beyond the outermost texel centers the color is constant and alpha fades to 0. ``left`` and ``top`` are the
    whole parts of the texel coordinates, at least -1, ``fx`` and ``fy`` the rest."""
    if left >= 0 and left + 1 < texture[2] and top >= 0 and top + 1 < texture[1]:
        i = texture[0] + top * texture[2] + left
        return bilinear(texels, i, i + texture[2], fx, fy)
    at = corners(texture, left, top)
    there = present(texture, left, top)
    weight = weights(fx, fy)
    mixed = wp.vec4()
    for i in range(4):
        t = texel(texels, at[i])
        mixed += wp.vec4(t[0], t[1], t[2], t[3] * there[i]) * weight[i]
    return mixed


@wp.func
def alpha_at(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, to_texel: wp.mat33, column: int, row: int) -> float:
    """Filtered alpha of a texture at a pixel; 0 where the pixel misses the plane."""
    x = float(column)
    y = float(row)
    w = to_texel[2, 0] * x + to_texel[2, 1] * y + to_texel[2, 2]
    u = (to_texel[0, 0] * x + to_texel[0, 1] * y + to_texel[0, 2]) / w
    v = (to_texel[1, 0] * x + to_texel[1, 1] * y + to_texel[1, 2]) / w
    if not (w > 0.0 and u > -1.0 and u < float(texture[2]) and v > -1.0 and v < float(texture[1])):
        return 0.0
    left = int(wp.floor(u))
    top = int(wp.floor(v))
    fx = u - float(left)
    fy = v - float(top)
    at = corners(texture, left, top)
    there = present(texture, left, top)
    weight = weights(fx, fy)
    alpha = float(0.0)  # noqa: UP018 - declares a variable
    for c in range(4):
        alpha += texel(texels, at[c])[3] * there[c] * weight[c]
    return alpha


@wp.func
def contrast(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, to_texel: wp.mat33, column: int, row: int, alpha: float) -> float:
    """How far alpha changes to the other pixels of the same row and column in its square of 2 x 2 pixels: ``fwidth`` of GLSL."""
    across = alpha_at(texels, texture, to_texel, column ^ 1, row) - alpha
    down = alpha_at(texels, texture, to_texel, column, row ^ 1) - alpha
    return wp.abs(across) + wp.abs(down)


@wp.func
def ramp_rate(contrast: float, test: wp.vec4) -> float:
    """Slope of the ramp of an antialiased mask: one over the contrast of a pixel, at most the mask's hardness."""
    rate = 1.0 / wp.max(contrast, LEAST_CONTRAST)
    return wp.where(test[1] == 0.0, rate, wp.min(rate, test[1]))


@wp.func
def opacity(alpha: float, test: wp.vec4, rate: float) -> float:
    """Opacity of a sample (:func:`bbfit.operators.drawing.compositing.opacity`). ``test`` encodes the alpha mode: the cutoff (0: blend,
    -1: hash), the hardness (0: a step), the slope of the gradient, and :data:`SMOOTH` for an antialiased mask, with the ramp's slope
    ``rate``, or :data:`COVERAGE`, with the samples of a pixel (0: any number) in place of the hardness."""
    if test[0] == 0.0:
        return alpha
    if test[3] == COVERAGE:
        return wp.where(test[1] == 0.0, alpha, wp.floor(alpha * test[1] + 0.5) / wp.max(test[1], 1.0))
    if test[3] != 0.0:
        return wp.where(alpha > 0.0, wp.clamp(0.5 + (alpha - test[0]) * rate, 0.0, 1.0), 0.0)
    if test[1] == 0.0:
        return wp.where(alpha >= test[0], 1.0, 0.0)
    return wp.clamp(0.5 + (alpha - test[0]) * test[1], 0.0, 1.0)


@wp.func
def opacity_slope(alpha: float, test: wp.vec4, rate: float) -> float:
    """Derivative of :func:`opacity`, or its straight-through estimate."""
    if test[0] == 0.0 or test[3] == COVERAGE:
        return 1.0
    slope = wp.where(test[3] != 0.0, wp.min(rate, STEEPEST), test[2])
    return wp.where(wp.abs(alpha - test[0]) * slope <= 0.5 and (alpha > 0.0 or test[3] == 0.0), slope, 0.0)


@wp.func
def threshold(x: int, y: int, texture: int) -> float:
    """The same as :func:`bbfit.operators.drawing.compositing.thresholds`."""
    mixed = (wp.uint32(x) * OF_X) ^ (wp.uint32(y) * OF_Y) ^ (wp.uint32(texture) * OF_TEXTURE)
    mixed = (mixed ^ (mixed >> wp.uint32(16))) * FIRST_ROUND
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * SECOND_ROUND
    mixed = mixed ^ (mixed >> wp.uint32(16))
    return (float(mixed >> wp.uint32(9)) + 0.5) / 8388608.0


@wp.func
def empty(occupied: wp.array(dtype=wp.uint8), texture: wp.vec3i, left: int, top: int) -> bool:
    """Whether all blocks that a sample reads are transparent."""
    at = corners(texture, left, top)
    above = flag(occupied, at[0] >> BLOCK_BITS) | flag(occupied, at[1] >> BLOCK_BITS)
    below = flag(occupied, at[2] >> BLOCK_BITS) | flag(occupied, at[3] >> BLOCK_BITS)
    return (above | below) == wp.uint8(0)


@wp.func
def scatter(gradient: wp.array(dtype=wp.vec4), texture: wp.vec3i, left: int, top: int, fx: float, fy: float, g: wp.vec4):
    """The adjoint of :func:`fetch` in the texels."""
    if left >= 0 and left + 1 < texture[2] and top >= 0 and top + 1 < texture[1]:
        i = texture[0] + top * texture[2] + left
        accumulate_bilinear(gradient, i, i + texture[2], fx, fy, g)
    else:
        at = corners(texture, left, top)
        there = present(texture, left, top)
        weight = weights(fx, fy)
        for c in range(4):
            accumulate(gradient, at[c], wp.vec4(g[0], g[1], g[2], g[3] * there[c]) * weight[c])


@wp.func
def slope(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, left: int, top: int, fx: float, fy: float, g: wp.vec4) -> wp.vec2:
    """The adjoint of :func:`fetch` in the texel coordinates."""
    at = corners(texture, left, top)
    there = present(texture, left, top)
    gains = wp.vec4()
    for c in range(4):
        t = texel(texels, at[c])
        gains[c] = wp.dot(wp.vec4(t[0], t[1], t[2], t[3] * there[c]), g)
    of_u = (gains[1] - gains[0]) * (1.0 - fy) + (gains[3] - gains[2]) * fy
    of_v = (gains[2] - gains[0]) * (1.0 - fx) + (gains[3] - gains[1]) * fx
    return wp.vec2(of_u, of_v)


@wp.func
def reaches(box: wp.vec4i, column: int, row: int, lanes: int) -> bool:
    """Whether ``lanes`` pixels of a row from ``column`` on overlap a box."""
    return row >= box[2] and row <= box[3] and column <= box[1] and column + lanes > box[0]


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(texels.data + index);
#endif
""")
def prefetch(texels: wp.array(dtype=wp.vec4), index: int):
    """Load texel ``index`` into the cache; the hardware does not predict jumps between rows of a texture."""


@wp.func
def next_row(texture: wp.vec3i, left: int, top: int) -> int:
    """Index of the texel below a sample, which a pixel in the next row probably reads."""
    return texture[0] + wp.min(top + 2, texture[1] - 1) * texture[2] + wp.max(left, 0)
