"""The Warp kernels that draw billboard clouds and differentiate the picture; one source for CPU and CUDA.

They mean what :mod:`bbfit.rendering.reference` says. A thread walks a run of pixels along a row: a whole row on a CPU, one pixel on a GPU.
In every pixel the layers that it hits are put in depth order and blended front to back. The backward pass blends again instead of
keeping layers in memory, then goes back to front for the derivatives in the opacities and front to back to scatter all.
"""

# mypy: ignore-errors
# ruff: noqa: UP018 - float(0) declares a variable of a kernel, 0.0 a constant.

from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.rendering.compositing import TIE as TIE_VALUE

wp.config.log_level = wp.LOG_ERROR  # a library does not print, and a machine without a GPU is nothing to warn of
wp.init()

FLAGS = "-march=native -ffp-contract=fast"
"""Clang's flags for CPU kernels: without them multiplications and additions are not fused."""
TIE = wp.constant(TIE_VALUE)
BLOCK = 4
"""Consecutive texels whose being empty is known by one byte, and that Adam takes together."""
BLOCK_BITS = wp.constant(2)
NORMS = {"l1": 1, "l2": 2, "backgrounds": 3}
"""How differences of premultiplied RGBA are measured; see :func:`bbfit.rendering.fused.PixelLoss`."""
L1, BACKGROUNDS = wp.constant(NORMS["l1"]), wp.constant(NORMS["backgrounds"])

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.func
def locate(box: wp.vec4i, to_texel: wp.mat33, nearness: wp.vec3, texture: wp.vec3i, column: int, row: int, orthographic: int) -> wp.vec3:
    """Texel coordinates and nearness of a layer at a pixel; nearness 0 where it is not hit."""
    missed = wp.vec3(0.0, 0.0, 0.0)
    if column < box[0] or column > box[1] or row < box[2] or row > box[3]:
        return missed
    x = float(column)
    y = float(row)
    w = to_texel[2, 0] * x + to_texel[2, 1] * y + to_texel[2, 2]
    near = w
    if orthographic != 0:
        near = nearness[0] * x + nearness[1] * y + nearness[2]
        if near >= 0.0:
            return missed
    if w <= 0.0:
        return missed
    scale = 1.0 / w
    u = (to_texel[0, 0] * x + to_texel[0, 1] * y + to_texel[0, 2]) * scale
    v = (to_texel[1, 0] * x + to_texel[1, 1] * y + to_texel[1, 2]) * scale
    if u > -1.0 and u < float(texture[2]) and v > -1.0 and v < float(texture[1]):  # false for NaN
        return wp.vec3(u, v, near)
    return missed


@wp.func
def empty(occupied: wp.array(dtype=wp.uint8), texture: wp.vec3i, u: float, v: float) -> bool:
    """Whether all texels that a sample is made of are known to be transparent."""
    left = int(wp.floor(u))
    top = int(wp.floor(v))
    above = texture[0] + wp.max(top, 0) * texture[2]
    below = texture[0] + wp.min(top + 1, texture[1] - 1) * texture[2]
    x0 = wp.max(left, 0)
    x1 = wp.min(left + 1, texture[2] - 1)
    any_above = occupied[(above + x0) >> BLOCK_BITS] | occupied[(above + x1) >> BLOCK_BITS]
    any_below = occupied[(below + x0) >> BLOCK_BITS] | occupied[(below + x1) >> BLOCK_BITS]
    return (any_above | any_below) == wp.uint8(0)


@wp.func
def sample(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, u: float, v: float) -> wp.vec4:
    """Bilinear straight RGBA; beyond the outermost texel centres the colour stays and the alpha fades."""
    left = int(wp.floor(u))
    top = int(wp.floor(v))
    fx = u - float(left)
    fy = v - float(top)
    if left >= 0 and left + 1 < texture[2] and top >= 0 and top + 1 < texture[1]:
        i = texture[0] + top * texture[2] + left
        j = i + texture[2]
        upper = texels[i] + (texels[i + 1] - texels[i]) * fx
        lower = texels[j] + (texels[j + 1] - texels[j]) * fx
        return upper + (lower - upper) * fy
    x0 = wp.max(left, 0)
    x1 = wp.min(left + 1, texture[2] - 1)
    above = texture[0] + wp.max(top, 0) * texture[2]
    below = texture[0] + wp.min(top + 1, texture[1] - 1) * texture[2]
    a = texels[above + x0]
    b = texels[above + x1]
    c = texels[below + x0]
    d = texels[below + x1]
    upper = a + (b - a) * fx
    lower = c + (d - c) * fx
    mixed = upper + (lower - upper) * fy
    weight_l = wp.where(left < 0, 0.0, 1.0 - fx)
    weight_r = wp.where(left + 1 >= texture[2], 0.0, fx)
    weight_t = wp.where(top < 0, 0.0, 1.0 - fy)
    weight_b = wp.where(top + 1 >= texture[1], 0.0, fy)
    alpha = (a[3] * weight_l + b[3] * weight_r) * weight_t + (c[3] * weight_l + d[3] * weight_r) * weight_b
    return wp.vec4(mixed[0], mixed[1], mixed[2], alpha)


@wp.func
def scatter(gradient: wp.array(dtype=wp.vec4), texture: wp.vec3i, u: float, v: float, g: wp.vec4):
    """The adjoint of :func:`sample` in the texels."""
    left = int(wp.floor(u))
    top = int(wp.floor(v))
    fx = u - float(left)
    fy = v - float(top)
    right = g * fx
    a = (g - right) * (1.0 - fy)
    b = right * (1.0 - fy)
    c = (g - right) * fy
    d = right * fy
    if left >= 0 and left + 1 < texture[2] and top >= 0 and top + 1 < texture[1]:
        i = texture[0] + top * texture[2] + left
        j = i + texture[2]
        wp.atomic_add(gradient, i, a)
        wp.atomic_add(gradient, i + 1, b)
        wp.atomic_add(gradient, j, c)
        wp.atomic_add(gradient, j + 1, d)
    else:
        x0 = wp.max(left, 0)
        x1 = wp.min(left + 1, texture[2] - 1)
        above = texture[0] + wp.max(top, 0) * texture[2]
        below = texture[0] + wp.min(top + 1, texture[1] - 1) * texture[2]
        in_l = wp.where(left < 0, 0.0, 1.0)
        in_r = wp.where(left + 1 >= texture[2], 0.0, 1.0)
        in_t = wp.where(top < 0, 0.0, 1.0)
        in_b = wp.where(top + 1 >= texture[1], 0.0, 1.0)
        wp.atomic_add(gradient, above + x0, wp.vec4(a[0], a[1], a[2], a[3] * in_l * in_t))
        wp.atomic_add(gradient, above + x1, wp.vec4(b[0], b[1], b[2], b[3] * in_r * in_t))
        wp.atomic_add(gradient, below + x0, wp.vec4(c[0], c[1], c[2], c[3] * in_l * in_b))
        wp.atomic_add(gradient, below + x1, wp.vec4(d[0], d[1], d[2], d[3] * in_r * in_b))


@wp.func
def slope(texels: wp.array(dtype=wp.vec4), texture: wp.vec3i, u: float, v: float, g: wp.vec4) -> wp.vec2:
    """The adjoint of :func:`sample` in the texel coordinates."""
    left = int(wp.floor(u))
    top = int(wp.floor(v))
    fx = u - float(left)
    fy = v - float(top)
    x0 = wp.max(left, 0)
    x1 = wp.min(left + 1, texture[2] - 1)
    above = texture[0] + wp.max(top, 0) * texture[2]
    below = texture[0] + wp.min(top + 1, texture[1] - 1) * texture[2]
    in_l = wp.where(left < 0, 0.0, 1.0)
    in_r = wp.where(left + 1 >= texture[2], 0.0, 1.0)
    in_t = wp.where(top < 0, 0.0, 1.0)
    in_b = wp.where(top + 1 >= texture[1], 0.0, 1.0)
    a = texels[above + x0]
    b = texels[above + x1]
    c = texels[below + x0]
    d = texels[below + x1]
    a[3] = a[3] * in_l * in_t
    b[3] = b[3] * in_r * in_t
    c[3] = c[3] * in_l * in_b
    d[3] = d[3] * in_r * in_b
    ga = wp.dot(a, g)
    gb = wp.dot(b, g)
    gc = wp.dot(c, g)
    gd = wp.dot(d, g)
    return wp.vec2((gb - ga) * (1.0 - fy) + (gd - gc) * fy, (gc - ga) * (1.0 - fx) + (gd - gb) * fx)


@wp.func
def premultiplied(packed: int, straight: int) -> wp.vec4:
    """A pixel of 8-bit RGBA as floats."""
    scale = 1.0 / 255.0
    alpha = float((packed >> 24) & 255) * scale
    if straight != 0:
        scale *= alpha
    return wp.vec4(float(packed & 255) * scale, float((packed >> 8) & 255) * scale, float((packed >> 16) & 255) * scale, alpha)


@wp.func
def sign(x: float) -> float:
    """-1, 0 or 1; Warp's own says 1 of zero."""
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@cache
def kernels(capacity: int) -> SimpleNamespace:
    """The kernels ``draw`` and ``differentiate`` with room for ``capacity`` billboards, a constant that they are compiled with."""
    floats = wp.types.vector(length=capacity, dtype=wp.float32)
    ints = wp.types.vector(length=capacity, dtype=wp.int32)

    @wp.struct
    class Layers:
        count: int
        ids: ints
        u: floats
        v: floats
        near: floats

    @wp.func
    def ordered(layers: Layers) -> Layers:
        """The same, nearest first; equally near ones stay in the order of their indices."""
        for i in range(1, layers.count):
            n = layers.ids[i]
            u = layers.u[i]
            v = layers.v[i]
            near = layers.near[i]
            j = int(i)
            while j > 0 and layers.near[j - 1] < near - TIE * wp.abs(near):
                layers.ids[j] = layers.ids[j - 1]
                layers.u[j] = layers.u[j - 1]
                layers.v[j] = layers.v[j - 1]
                layers.near[j] = layers.near[j - 1]
                j -= 1
            layers.ids[j] = n
            layers.u[j] = u
            layers.v[j] = v
            layers.near[j] = near
        return layers

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def draw(
        first_row: int,
        run: int,
        width: int,
        orthographic: int,
        to_texel: wp.array2d(dtype=wp.mat33),
        nearness: wp.array2d(dtype=wp.vec3),
        textures: wp.array2d(dtype=wp.vec3i),
        boxes: wp.array2d(dtype=wp.vec4i),
        texels: wp.array(dtype=wp.vec4),
        occupied: wp.array(dtype=wp.uint8),
        image: wp.array3d(dtype=wp.vec4),
    ):
        """Write ``image`` [V, H, W]; launched over views, rows from ``first_row``, runs of pixels."""
        view, row, piece = wp.tid()
        row += first_row
        layers = Layers()
        for column in range(piece * run, wp.min(piece * run + run, width)):
            layers.count = 0
            for n in range(boxes.shape[1]):
                hit = locate(boxes[view, n], to_texel[view, n], nearness[view, n], textures[view, n], column, row, orthographic)
                if hit[2] != 0.0:
                    if not empty(occupied, textures[view, n], hit[0], hit[1]):
                        layers.ids[layers.count] = n
                        layers.u[layers.count] = hit[0]
                        layers.v[layers.count] = hit[1]
                        layers.near[layers.count] = hit[2]
                        layers.count += 1
            layers = ordered(layers)
            colour = wp.vec4()
            through = float(1.0)
            for i in range(layers.count):
                if through > 0.0:
                    s = sample(texels, textures[view, layers.ids[i]], layers.u[i], layers.v[i])
                    weight = through * s[3]
                    through -= weight
                    colour += wp.vec4(s[0] * weight, s[1] * weight, s[2] * weight, weight)
            image[view, row, column] = colour

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def differentiate(
        first_view: int,
        first_row: int,
        run: int,
        width: int,
        orthographic: int,
        to_texel: wp.array2d(dtype=wp.mat33),
        nearness: wp.array2d(dtype=wp.vec3),
        textures: wp.array2d(dtype=wp.vec3i),
        boxes: wp.array2d(dtype=wp.vec4i),
        texels: wp.array(dtype=wp.vec4),
        occupied: wp.array(dtype=wp.uint8),
        image_gradient: wp.array3d(dtype=wp.vec4),
        target: wp.array3d(dtype=wp.int32),
        straight: int,
        norm: int,
        weight: float,
        loss: wp.array2d(dtype=wp.float32),
        texel_gradient: wp.array(dtype=wp.vec4),
        matrix_gradient: wp.array4d(dtype=wp.vec3d),
    ):
        """Add to ``texel_gradient`` [P] and, unless empty, ``matrix_gradient`` [V, H, N, 3] (rows of ``to_texel``'s, summed a pixel row).

        The picture's gradient is ``image_gradient`` [V, H, W], unless empty, plus that of ``weight`` times the distance to
        ``target`` [V, H, W], unless empty; the distance is added to ``loss`` [V, H].
        """
        view, row, piece = wp.tid()
        view += first_view
        row += first_row
        layers = Layers()
        reds = floats()
        greens = floats()
        blues = floats()
        alphas = floats()
        values = floats()
        total = float(0.0)
        for column in range(piece * run, wp.min(piece * run + run, width)):
            layers.count = 0
            anything = bool(False)
            for n in range(boxes.shape[1]):
                hit = locate(boxes[view, n], to_texel[view, n], nearness[view, n], textures[view, n], column, row, orthographic)
                if hit[2] != 0.0:
                    layers.ids[layers.count] = n
                    layers.u[layers.count] = hit[0]
                    layers.v[layers.count] = hit[1]
                    layers.near[layers.count] = hit[2]
                    layers.count += 1
                    if not anything:
                        anything = not empty(occupied, textures[view, n], hit[0], hit[1])
            wanted = wp.vec4()
            if target.shape[0] != 0:
                wanted = premultiplied(target[view, row, column], straight)
            g = wp.vec4()
            if image_gradient.shape[0] != 0:
                g = image_gradient[view, row, column]
            # Where the picture and the target are both empty there is no difference, and no gradient of one.
            if anything or wanted[3] > 0.0 or g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
                layers = ordered(layers)
                colour = wp.vec4()
                through = float(1.0)
                for i in range(layers.count):
                    s = sample(texels, textures[view, layers.ids[i]], layers.u[i], layers.v[i])
                    opacity = through * s[3]
                    through -= opacity
                    colour += wp.vec4(s[0] * opacity, s[1] * opacity, s[2] * opacity, opacity)
                    reds[i] = s[0]
                    greens[i] = s[1]
                    blues[i] = s[2]
                    alphas[i] = s[3]
                if target.shape[0] != 0:
                    d = colour - wanted
                    if norm == L1:
                        total += wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2]) + wp.abs(d[3])
                        g += wp.vec4(sign(d[0]), sign(d[1]), sign(d[2]), sign(d[3])) * weight
                    else:
                        total += wp.dot(d, d)
                        g += d * (2.0 * weight)
                        if norm == BACKGROUNDS:
                            colours = d[0] + d[1] + d[2]
                            total -= d[3] * colours
                            g -= wp.vec4(d[3], d[3], d[3], colours) * weight
                if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
                    behind = float(0.0)  # what the layers behind add to the loss, to first order, seen unobstructed
                    for k in range(layers.count):
                        i = layers.count - 1 - k
                        difference = reds[i] * g[0] + greens[i] * g[1] + blues[i] * g[2] + g[3] - behind
                        values[i] = difference
                        behind += alphas[i] * difference
                    through = float(1.0)
                    for i in range(layers.count):
                        if through > 0.0:
                            n = layers.ids[i]
                            u = layers.u[i]
                            v = layers.v[i]
                            opacity = through * alphas[i]
                            of_sample = wp.vec4(g[0] * opacity, g[1] * opacity, g[2] * opacity, through * values[i])
                            scatter(texel_gradient, textures[view, n], u, v, of_sample)
                            if matrix_gradient.shape[0] != 0:
                                t = slope(texels, textures[view, n], u, v, of_sample)
                                m = to_texel[view, n]
                                x = float(column)
                                y = float(row)
                                scale = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
                                pixel = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(1.0))
                                of_u = t[0] * scale
                                of_v = t[1] * scale
                                of_w = -(u * of_u + v * of_v)
                                wp.atomic_add(matrix_gradient, view, row, n, 0, pixel * wp.float64(of_u))
                                wp.atomic_add(matrix_gradient, view, row, n, 1, pixel * wp.float64(of_v))
                                wp.atomic_add(matrix_gradient, view, row, n, 2, pixel * wp.float64(of_w))
                            through -= opacity
        if target.shape[0] != 0:
            wp.atomic_add(loss, view, row, total)

    return SimpleNamespace(draw=draw, differentiate=differentiate)
