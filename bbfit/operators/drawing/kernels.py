"""Warp kernels that draw billboard clouds and differentiate the picture; one source for the CPU and CUDA.

**Forward.** A pixel meets the layers 1 to K, front to back, with straight colors c_k and opacities a_k. With the transmittance
T_k = product over j < k of (1 - a_j), the over operator (Porter and Duff 1984, section 4.3) gives

    color = sum of T_k a_k c_k,    alpha = sum of T_k a_k.

Texel coordinates are u = m_1 p / w and v = m_2 p / w, w = m_3 p, where m_i are the rows of the homography and p = (x, y, 1).

**Backward.** Let (g, h) be the derivative in the pixel's color and alpha, and e_k = g . c_k + h. A layer's opacity scales its own
contribution and dims the layers behind it, so

    dL/dc_k = T_k a_k g,    dL/da_k = T_k v_k,    v_k = e_k - s_k,    s_k = sum over j > k of a_j e_j product over k < i < j of (1 - a_i).

s_K = 0 and s_(k-1) = s_k + a_k v_k: one pass back to front gives all v_k without a division by 1 - a_k, which opaque layers would make
zero. A second pass, front to back, multiplies by T_k and scatters to texels (:mod:`bbfit.operators.drawing.sampling_kernels`). For a
derivative (t_u, t_v) in texel coordinates the rows of the homography receive

    dL/dm_1 = t_u p / w,    dL/dm_2 = t_v p / w,    dL/dm_3 = -(u t_u + v t_v) p / w.

**Alpha to coverage.** Every layer gets the same samples of a pixel first, so a layer shows where those in front leave samples free. With
m_k = max over j < k of a_j, its weight is max(a_k - m_k, 0) instead of T_k a_k. If a layer shows, the next layer that shows loses what it
gains: dL/da_k = e_k - e_next, where e_next is 0 if there is none. Otherwise it is 0.

**Colors of their own.** With ``own_colors``, the colors do not minimize the picture's loss but the squared difference to the view's
straight color C, weighted by the view's alpha A and by the layer's weight w_k (which is held constant):

    sum of w_k A |c_k - C|^2,    with the derivative 2 w_k (A c_k - A C) in c_k.

Colors have this gradient in place of that of the pixel loss, and that of ``image_gradient`` besides. Alpha has all gradients in any case.

**Schedule.** A thread processes a run of pixels in a row: a whole row on a CPU, one pixel on CUDA. Layers are sorted per pixel. The
backward kernel blends again instead of reading stored layers.

The kernels share little code: a function that returned a pixel's layers would copy them, in 1.5 times the time. ``range`` hides that an
index is not negative: ``while`` saves a tenth. Vectors that two loops assign are kept in memory: names of their own save half.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - int(0) declares a variable of a kernel, 0 a constant.

from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.operators.drawing.compositing import TIE as TIE_VALUE
from bbfit.operators.drawing.sampling_kernels import (
    SMOOTH,
    contrast,
    empty,
    fetch,
    next_row,
    opacity,
    opacity_slope,
    prefetch,
    ramp_rate,
    reaches,
    scatter,
    slope,
    threshold,
)
from bbfit.operators.image_loss.kernels import add_pixel_loss, color_slope, premultiplied
from bbfit.operators.launching import FLAGS

TIE = wp.constant(TIE_VALUE)
MISS = wp.constant(-2)
OPAQUE = wp.constant(-(1 << 24))

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.struct
class Plane:
    """A billboard in a view (:class:`bbfit.operators.drawing.projection.Projection`)."""

    to_texel: wp.mat33
    nearness: wp.vec3
    texture: wp.vec3i
    box: wp.vec4i


@cache
def kernels(capacity: int = 4, lanes: int = 1) -> SimpleNamespace:
    """The kernels ``draw`` and ``differentiate``, compiled for at most ``capacity`` billboards and ``lanes`` pixels at a time: 1 on CUDA,
    more on a CPU, which computes their texel coordinates at once, in vector registers."""
    floats = wp.types.vector(length=capacity, dtype=wp.float32)
    ints = wp.types.vector(length=capacity, dtype=wp.int32)
    wide = wp.types.vector(length=lanes, dtype=wp.float32)
    wide_ints = wp.types.vector(length=lanes, dtype=wp.int32)
    wides = wp.types.matrix(shape=(capacity, lanes), dtype=wp.float32)
    wides_ints = wp.types.matrix(shape=(capacity, lanes), dtype=wp.int32)

    @wp.struct
    class Hits:
        left: wide_ints
        top: wide_ints
        fx: wide
        fy: wide
        near: wide

    @wp.func
    def locate(plane: Plane, column: int, row: int, orthographic: int) -> Hits:
        """Texel coordinates at which pixels from ``column`` on meet a plane; ``left`` is :data:`MISS` where they miss it."""
        hits = Hits()
        y = float(row)
        m = plane.to_texel
        u0 = m[0, 1] * y + m[0, 2]
        v0 = m[1, 1] * y + m[1, 2]
        w0 = m[2, 1] * y + m[2, 2]
        last_u = float(plane.texture[2])
        last_v = float(plane.texture[1])
        for c in range(lanes):
            x = float(column + c)
            w = m[2, 0] * x + w0
            scale = 1.0 / w
            u = (m[0, 0] * x + u0) * scale
            v = (m[1, 0] * x + v0) * scale
            hit = w > 0.0 and u > -1.0 and u < last_u and v > -1.0 and v < last_v  # false for NaN
            u = wp.where(hit, u, float(MISS))
            v = wp.where(hit, v, float(MISS))
            fu = wp.floor(u)
            fv = wp.floor(v)
            hits.left[c] = int(fu)
            hits.top[c] = int(fv)
            hits.fx[c] = u - fu
            hits.fy[c] = v - fv
            hits.near[c] = w
        if orthographic != 0:
            for c in range(lanes):
                near = plane.nearness[0] * float(column + c) + plane.nearness[1] * y + plane.nearness[2]
                hits.near[c] = near
                if near >= 0.0:
                    hits.left[c] = MISS
        return hits

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def draw(
        first_row: int,
        run: int,
        width: int,
        orthographic: int,
        count: int,
        test: wp.vec4,
        planes: wp.array(dtype=Plane),
        texels: wp.array(dtype=wp.vec4),
        occupied: wp.array(dtype=wp.uint8),
        image: wp.array3d(dtype=wp.vec4),
    ):
        """Write ``image`` [V, H, W]; launched over views, rows from ``first_row`` on, and runs of pixels."""
        view, row, piece = wp.tid()
        row += first_row
        firsts = ints()
        heights = ints()
        widths = ints()
        ids = ints()
        left = wides_ints()
        top = wides_ints()
        fx = wides()
        fy = wides()
        nears = wides()
        order = ints()
        near = floats()
        end = wp.min(piece * run + run, width)
        for column in range(piece * run, end, lanes):
            active = int(0)
            n = int(0)
            while n < count:
                plane = planes[view * count + n]
                if reaches(plane.box, column, row, lanes):
                    hits = locate(plane, column, row, orthographic)
                    ids[active] = n
                    firsts[active] = plane.texture[0]
                    heights[active] = plane.texture[1]
                    widths[active] = plane.texture[2]
                    left[active] = hits.left
                    top[active] = hits.top
                    fx[active] = hits.fx
                    fy[active] = hits.fy
                    nears[active] = hits.near
                    for lane in range(lanes):
                        if hits.left[lane] > MISS:
                            prefetch(texels, next_row(plane.texture, hits.left[lane], hits.top[lane]))
                    active += 1
                n += 1
            c = int(0)
            while c < wp.min(end - column, lanes):
                hit = int(0)
                k = int(0)
                while k < active:
                    if left[k, c] > MISS:
                        if not empty(occupied, wp.vec3i(firsts[k], heights[k], widths[k]), left[k, c], top[k, c]):
                            place = int(hit)
                            while place > 0 and near[place - 1] < nears[k, c] - TIE * wp.abs(nears[k, c]):
                                near[place] = near[place - 1]
                                order[place] = order[place - 1]
                                place -= 1
                            near[place] = nears[k, c]
                            order[place] = k
                            hit += 1
                    k += 1
                color = wp.vec4()
                through = float(1.0)
                i = int(0)
                while i < hit:
                    if through > 0.0:
                        layer = order[i]
                        texture = wp.vec3i(firsts[layer], heights[layer], widths[layer])
                        s = fetch(texels, texture, left[layer, c], top[layer, c], fx[layer, c], fy[layer, c])
                        rate = float(0.0)
                        if test[3] == SMOOTH:
                            matrix = planes[view * count + ids[layer]].to_texel
                            rate = ramp_rate(contrast(texels, texture, matrix, column + c, row, s[3]), test)
                        alpha = opacity(s[3], test, rate)
                        if test[0] < 0.0:
                            alpha = wp.where(s[3] >= threshold(column + c, row, firsts[layer]), 1.0, 0.0)
                        weight = wp.where(test[3] != 0.0, wp.max(alpha + through - 1.0, 0.0), through * alpha)
                        through -= weight
                        color += wp.vec4(s[0] * weight, s[1] * weight, s[2] * weight, weight)
                    i += 1
                image[view, row, column + c] = color
                c += 1

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def differentiate(
        first_view: int,
        first_row: int,
        run: int,
        width: int,
        orthographic: int,
        count: int,
        test: wp.vec4,
        planes: wp.array(dtype=Plane),
        texels: wp.array(dtype=wp.vec4),
        occupied: wp.array(dtype=wp.uint8),
        image_gradient: wp.array3d(dtype=wp.vec4),
        target: wp.array3d(dtype=wp.int32),
        straight: int,
        pixel_loss: int,
        weight: float,
        own_colors: int,
        loss: wp.array2d(dtype=wp.float32),
        texel_gradient: wp.array(dtype=wp.vec4),
        matrix_gradient: wp.array4d(dtype=wp.vec3d),
    ):
        """Add to ``texel_gradient`` [P] and, unless empty, to ``matrix_gradient`` [V, H, N, 3], a sum for every row of pixels.

        The picture's gradient is ``image_gradient`` [V, H, W], unless empty, plus ``weight`` times that of the pixel loss against
        ``target`` [V, H, W], unless empty. The loss is added to ``loss`` [V, H]. ``own_colors`` fits colors to the target's own.
        """
        view, row, piece = wp.tid()
        view += first_view
        row += first_row
        firsts = ints()
        heights = ints()
        widths = ints()
        ids = ints()
        left = wides_ints()
        top = wides_ints()
        fx = wides()
        fy = wides()
        nears = wides()
        order = ints()
        near = floats()
        reds = floats()
        greens = floats()
        blues = floats()
        alphas = floats()
        shares = floats()
        slopes = floats()
        values = floats()
        total = float(0.0)
        given_target = target.shape[0] != 0
        given_gradient = image_gradient.shape[0] != 0
        wanted_placement = matrix_gradient.shape[0] != 0
        end = wp.min(piece * run + run, width)
        for column in range(piece * run, end, lanes):
            active = int(0)
            n = int(0)
            while n < count:
                plane = planes[view * count + n]
                if reaches(plane.box, column, row, lanes):
                    hits = locate(plane, column, row, orthographic)
                    ids[active] = n
                    firsts[active] = plane.texture[0]
                    heights[active] = plane.texture[1]
                    widths[active] = plane.texture[2]
                    left[active] = hits.left
                    top[active] = hits.top
                    fx[active] = hits.fx
                    fy[active] = hits.fy
                    nears[active] = hits.near
                    for lane in range(lanes):
                        if hits.left[lane] > MISS:
                            ahead = next_row(plane.texture, hits.left[lane], hits.top[lane])
                            prefetch(texels, ahead)
                            prefetch(texel_gradient, ahead)
                    active += 1
                n += 1
            c = int(0)
            while c < wp.min(end - column, lanes):
                packed = int(0)
                if given_target:
                    packed = target[view, row, column + c]
                g = wp.vec4()
                # Where picture and target are both empty there is neither a loss nor a gradient.
                anything = (packed & OPAQUE) != 0
                if given_gradient:
                    g = image_gradient[view, row, column + c]
                    anything = anything or g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0
                hit = int(0)
                k = int(0)
                while k < active:
                    if left[k, c] > MISS:
                        place = int(hit)
                        while place > 0 and near[place - 1] < nears[k, c] - TIE * wp.abs(nears[k, c]):
                            near[place] = near[place - 1]
                            order[place] = order[place - 1]
                            place -= 1
                        near[place] = nears[k, c]
                        order[place] = k
                        hit += 1
                        if not anything:
                            anything = not empty(occupied, wp.vec3i(firsts[k], heights[k], widths[k]), left[k, c], top[k, c])
                    k += 1
                if anything:
                    color = wp.vec4()
                    through = float(1.0)
                    i = int(0)
                    while i < hit:
                        layer = order[i]
                        texture = wp.vec3i(firsts[layer], heights[layer], widths[layer])
                        s = fetch(texels, texture, left[layer, c], top[layer, c], fx[layer, c], fy[layer, c])
                        rate = float(0.0)
                        if test[3] == SMOOTH:
                            matrix = planes[view * count + ids[layer]].to_texel
                            rate = ramp_rate(contrast(texels, texture, matrix, column + c, row, s[3]), test)
                        alpha = opacity(s[3], test, rate)
                        slopes[i] = opacity_slope(s[3], test, rate)
                        share = wp.where(test[3] != 0.0, wp.max(alpha + through - 1.0, 0.0), through * alpha)
                        through -= share
                        shares[i] = share
                        color += wp.vec4(s[0] * share, s[1] * share, s[2] * share, share)
                        reds[i] = s[0]
                        greens[i] = s[1]
                        blues[i] = s[2]
                        alphas[i] = alpha
                        i += 1
                    seen = wp.vec4()
                    of_image = wp.vec4(g[0], g[1], g[2], 0.0)
                    if given_target:
                        seen = premultiplied(packed, straight)
                        total, g = add_pixel_loss(color - seen, pixel_loss, weight, total, g)
                    if own_colors != 0 or g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
                        behind = float(0.0)  # s_k of the docstring above
                        b = int(hit)
                        while b > 0:
                            b -= 1
                            difference = reds[b] * g[0] + greens[b] * g[1] + blues[b] * g[2] + g[3] - behind
                            values[b] = difference
                            if test[3] == 0.0:
                                behind += alphas[b] * difference
                            elif shares[b] > 0.0:
                                behind += difference
                        reaching = float(1.0)
                        f = int(0)
                        while f < hit:
                            if reaching > 0.0:
                                own = order[f]
                                part = shares[f]
                                exposed = float(reaching)
                                if test[3] != 0.0:
                                    exposed = wp.where(part > 0.0, 1.0, 0.0)
                                of_alpha = exposed * values[f] * slopes[f]
                                of_sample = wp.vec4(g[0] * part, g[1] * part, g[2] * part, of_alpha)
                                if own_colors != 0:
                                    own_loss = color_slope(wp.vec3(reds[f], greens[f], blues[f]), seen) * (weight * part)
                                    of_sample = of_image * part + wp.vec4(own_loss[0], own_loss[1], own_loss[2], of_alpha)
                                whose = wp.vec3i(firsts[own], heights[own], widths[own])
                                scatter(texel_gradient, whose, left[own, c], top[own, c], fx[own, c], fy[own, c], of_sample)
                                if wanted_placement:
                                    t = slope(texels, whose, left[own, c], top[own, c], fx[own, c], fy[own, c], of_sample)
                                    m = planes[view * count + ids[own]].to_texel
                                    x = float(column + c)
                                    y = float(row)
                                    scale = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
                                    of_u = t[0] * scale
                                    of_v = t[1] * scale
                                    of_w = -((float(left[own, c]) + fx[own, c]) * of_u + (float(top[own, c]) + fy[own, c]) * of_v)
                                    pixel = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(1.0))
                                    wp.atomic_add(matrix_gradient, view, row, ids[own], 0, pixel * wp.float64(of_u))
                                    wp.atomic_add(matrix_gradient, view, row, ids[own], 1, pixel * wp.float64(of_v))
                                    wp.atomic_add(matrix_gradient, view, row, ids[own], 2, pixel * wp.float64(of_w))
                                reaching -= part
                            f += 1
                c += 1
        if target.shape[0] != 0:
            wp.atomic_add(loss, view, row, total)

    return SimpleNamespace(draw=draw, differentiate=differentiate)
