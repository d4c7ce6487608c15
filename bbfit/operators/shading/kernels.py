"""Warp kernels that shade texels, and their derivative; one source for the CPU and CUDA.

**Forward.** With the normal n = (x, y, z) of a texel, z = sqrt(1 - x^2 - y^2), the direction l towards the sun in the texture's axes,
c = n . l, base color B in linear light, occlusion o, translucency t, sun s and sky a,

    E = s ((1 - t) max(c, 0) + t max(-c, 0)) + a o,    color = encode(B E).

**Backward.** For the derivative g of the loss in the color of a channel, and e = encode'(B E),

    dL/dB = g e E,    dL/dE = g e B,    dL/do = sum a dL/dE,    dL/dt = sum s (max(-c, 0) - max(c, 0)) dL/dE,
    dL/dc = sum s dL/dE (1 - t if c > 0, else -t).

z depends on x and y: dc/dx = l_x - l_z x / z, and the same for y; where z is at its least value, dc/dx = l_x. Normals outside the unit
disk are scaled onto it by r = 1 / sqrt(x^2 + y^2): then the derivative in the unscaled (x, y) is r times the part of the derivative in the
scaled (x, y) that is perpendicular to it.
"""

# mypy: ignore-errors
# ruff: noqa: UP018 - float(0) declares a variable of a kernel, 0 a constant.

from __future__ import annotations

import warp as wp

from bbfit.operators.launching import FLAGS, PIXEL
from bbfit.operators.shading.reference import LEAST_Z_SQUARED as LEAST_VALUE

LEAST_Z_SQUARED = wp.constant(LEAST_VALUE)
FOOT = wp.constant(wp.vec4(0.055))
LEAST = wp.constant(wp.vec4(1e-30))
Texels = wp.array(dtype=wp.vec4)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


# The C library has no power of several floats at once, and ten of its powf would be most of a texel's time. With x = 2^k m and m in
# [sqrt(1/2), sqrt(2)), log2(x) = k + 2 / ln(2) artanh((m - 1) / (m + 1)); both series end where float32 does.
@wp.func_native(
    PIXEL
    + """
    wp::vec_t<4, float> result;
#if defined(__CUDA_ARCH__)
    for (int c = 0; c < 4; ++c) result.c[c] = powf(base.c[c], exponent);
#else
    typedef int whole __attribute__((vector_size(16), aligned(4), may_alias));
    const pixel x = *(const pixel*)base.c;
    const whole bits = (whole)x, k = (bits - 0x3f3504f3) >> 23;
    const pixel m = (pixel)(bits - (k << 23)), s = (m - 1.0f) / (m + 1.0f), t = s * s;
    const pixel series = 2.88539008f + t * (0.96179669f + t * (0.57707802f + t * (0.41219858f + t * 0.32059890f)));
    const pixel y = (__builtin_convertvector(k, pixel) + s * series) * exponent;
    const pixel shifted = y + 12582912.0f, f = y - (shifted - 12582912.0f);  // to the nearest whole number, and the rest
    const pixel power = 1.0f + f * (0.69314718f + f * (0.24022651f + f * (0.05550411f + f * (0.00961813f
                             + f * (0.00133336f + f * 0.00015404f)))));
    *(pixel*)result.c = (pixel)((whole)power + ((whole)shifted << 23));
#endif
    return result;
"""
)
def power(base: wp.vec4, exponent: float) -> wp.vec4:
    """Each number of ``base``, which are at least 1e-30, to the power of ``exponent``, at most 3, to 1e-6 of it."""


@wp.func
def decoded(color: wp.vec4) -> wp.vec4:
    """Display-referred sRGB to linear light."""
    linear = power((color + FOOT) / 1.055, 2.4)
    for k in range(4):
        linear[k] = wp.where(color[k] > 0.04045, linear[k], color[k] / 12.92)
    return linear


@wp.func
def encoded(linear: wp.vec4) -> wp.vec4:
    """Linear light to display-referred sRGB."""
    color = 1.055 * power(wp.max(linear, LEAST), 1.0 / 2.4) - FOOT
    for k in range(4):
        color[k] = wp.where(linear[k] > 0.0031308, color[k], 12.92 * linear[k])
    return color


@wp.func
def decoded_slope(color: float, linear: float) -> float:
    """Derivative of :func:`decoded` in a channel, given its value ``linear``."""
    return wp.where(color > 0.04045, 2.4 * linear / (color + 0.055), 1.0 / 12.92)


@wp.func
def encoded_slope(linear: float, color: float) -> float:
    """Derivative of :func:`encoded` in a channel, given its value ``color``."""
    return wp.where(linear > 0.0031308, (color + 0.055) / (2.4 * linear), 12.92)


@wp.func
def lit(base: wp.vec4, light: wp.vec4) -> wp.vec4:
    """What a display-referred base color shows in a light, which is linear."""
    return wp.min(encoded(wp.cw_mul(decoded(base), light)), wp.vec4(1.0))


@wp.func
def tangent_normal(surface: wp.vec4) -> wp.vec4:
    """The normal of a texel, and the factor that scaled x and y into the unit disk."""
    x = 2.0 * surface[0] - 1.0
    y = 2.0 * surface[1] - 1.0
    inside = 1.0 / wp.sqrt(wp.max(x * x + y * y, 1.0))
    x *= inside
    y *= inside
    return wp.vec4(x, y, wp.sqrt(wp.max(1.0 - x * x - y * y, LEAST_Z_SQUARED)), inside)


@wp.kernel
def shade(
    first: int,
    run: int,
    strengths: wp.vec4,
    texels: Texels,
    surface: Texels,
    texture: wp.array(dtype=wp.int32),
    suns: wp.array(dtype=wp.vec3),
    shaded: Texels,
):
    """Shade texels; launched over runs of ``run`` texels, from run ``first`` on."""
    tid, _ = wp.tid()
    begin = (first + tid) * run
    for i in range(begin, wp.min(begin + run, texels.shape[0])):
        maps = surface[i]
        n = tangent_normal(maps)
        sun = suns[texture[i]]
        c = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
        of_sun = (1.0 - maps[3]) * wp.max(c, 0.0) + maps[3] * wp.max(-c, 0.0)
        base = texels[i]
        color = lit(base, strengths * of_sun + wp.vec4(strengths[3] * maps[2]))
        color[3] = base[3]
        shaded[i] = color


@wp.kernel
def differentiate(
    first: int,
    run: int,
    strengths: wp.vec4,
    texels: Texels,
    surface: Texels,
    texture: wp.array(dtype=wp.int32),
    suns: wp.array(dtype=wp.vec3),
    gradient: Texels,
    of_texels: Texels,
    of_surface: Texels,
):
    """Add the derivative in texels and surface, given that in the shaded texels; launched as :func:`shade`."""
    tid, _ = wp.tid()
    begin = (first + tid) * run
    for i in range(begin, wp.min(begin + run, texels.shape[0])):
        g = gradient[i]
        if wp.dot(g, g) != 0.0:
            maps = surface[i]
            n = tangent_normal(maps)
            sun = suns[texture[i]]
            c = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
            facing = wp.max(c, 0.0)
            through = wp.max(-c, 0.0)
            of_sun = (1.0 - maps[3]) * facing + maps[3] * through
            base = texels[i]
            linear = decoded(base)
            light = strengths * of_sun + wp.vec4(strengths[3] * maps[2])
            shown = wp.cw_mul(linear, light)
            bright = encoded(shown)
            color = wp.vec4()
            from_sun = float(0.0)
            from_sky = float(0.0)
            for k in range(3):
                slope = g[k] * encoded_slope(shown[k], bright[k])
                color[k] = slope * light[k] * decoded_slope(base[k], linear[k])
                from_sun += slope * linear[k] * strengths[k]
                from_sky += slope * linear[k] * strengths[3]
            color[3] = g[3]
            of_texels[i] += color
            of_cosine = from_sun * wp.where(c > 0.0, 1.0 - maps[3], -maps[3])
            free = wp.where(1.0 - n[0] * n[0] - n[1] * n[1] > LEAST_Z_SQUARED, 1.0, 0.0)
            across = of_cosine * (sun[0] - free * sun[2] * n[0] / n[2])
            up = of_cosine * (sun[1] - free * sun[2] * n[1] / n[2])
            if n[3] < 1.0:
                along = across * n[0] + up * n[1]
                across = n[3] * (across - along * n[0])
                up = n[3] * (up - along * n[1])
            of_surface[i] += wp.vec4(2.0 * across, 2.0 * up, from_sky, from_sun * (through - facing))
