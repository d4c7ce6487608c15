"""Warp kernel that draws cards: rows of pixels, whose fragments are kept in lists until all pieces have been visited.

A row visits the pieces that it crosses. Every pixel of a piece with a sample in the polygon adds a fragment to the pixel's linked list,
which is ordered front to back (an A-buffer; Carpenter 1984, "The A-buffer, an Antialiased Hidden Surface Method"). Then the lists are
blended, for each sample. Textures are filtered only now, so what opaque fragments hide costs nothing.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - int(0) declares a variable of a kernel, 0 a constant.

import warp as wp

from bbfit.operators.cards.sheets import SAMPLES
from bbfit.operators.cards.sheets import SLACK as SLACK_VALUE
from bbfit.operators.drawing.compositing import HASH, LEAST_CONTRAST, TIE
from bbfit.operators.drawing.tile_forward import BLENDED, COVERAGE, HASHED, SMOOTH
from bbfit.operators.launching import FLAGS
from bbfit.operators.shading.kernels import lit

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})

TIED = wp.constant(wp.float64(1 + TIE))
SLACK = wp.constant(wp.float64(SLACK_VALUE))
LEAST = wp.constant(LEAST_CONTRAST)
RIGHT, DOWN = (wp.constant(wp.vec4d(*offsets)) for offsets in zip(*SAMPLES, strict=True))
OF_X, OF_Y, OF_TEXTURE, FIRST_ROUND, SECOND_ROUND = (wp.constant(wp.uint32(factor)) for factor in HASH)
NO_CUTOFF, HASH_CUTOFF, IS_SMOOTH, IS_COVERAGE = (wp.constant(float(value)) for value in (BLENDED, HASHED, SMOOTH, COVERAGE))


@wp.struct
class Fragment:
    """What a pixel sees of a sheet. The host allocates its memory."""

    u: wp.float64
    v: wp.float64
    scale: wp.float64
    """The third homogeneous coordinate of (u, v)."""
    depth: wp.float64
    sheet: int
    covered: int
    """The pixel's samples in polygons of the sheet, a bit each."""
    following: int
    """Index of the next fragment of the pixel, farther away; -1 after the last."""


@wp.func
def texel(texels: wp.array(dtype=wp.vec4ub), index: int):
    """A texel in [0, 255]."""
    value = texels[index]
    return wp.vec4(float(value[0]), float(value[1]), float(value[2]), float(value[3]))


@wp.func
def within(place: wp.float64, size: int) -> wp.float64:
    """A place clamped to the centers of the outer texels; the first one for NaN."""
    if place > wp.float64(0.0):
        return wp.min(place, wp.float64(size - 1))
    return wp.float64(0.0)


@wp.func
def bilinear(texels: wp.array(dtype=wp.vec4ub), levels: wp.array(dtype=wp.vec3i), level: int, u: wp.float64, v: wp.float64):
    """A sample in [0, 255] of one mip level, clamped to the edge."""
    start, width, height = levels[level][0], levels[level][1], levels[level][2]
    half = wp.float64(0.5)
    x, y = within(u * wp.float64(width) - half, width), within(v * wp.float64(height) - half, height)
    left, top = int(x), int(y)
    right, down = int(0), int(0)
    if left + 1 < width:
        right = 1
    if top + 1 < height:
        down = width
    at = start + top * width + left
    a, b, c, d = texel(texels, at), texel(texels, at + right), texel(texels, at + down), texel(texels, at + down + right)
    fx, fy = float(x - wp.float64(left)), float(y - wp.float64(top))
    upper, lower = a + (b - a) * fx, c + (d - c) * fx
    return upper + (lower - upper) * fy


@wp.func
def trilinear(texels: wp.array(dtype=wp.vec4ub), levels: wp.array(dtype=wp.vec3i), u: wp.float64, v: wp.float64, detail: wp.float64):
    """A sample in [0, 1] between the two mip levels around a level of detail, which exists."""
    level = int(detail)
    share = float(detail - wp.float64(level))
    sample = bilinear(texels, levels, level, u, v)
    if share > 0.0:
        sample += (bilinear(texels, levels, level + 1, u, v) - sample) * share
    return sample / 255.0


@wp.func
def alpha_beside(
    texels: wp.array(dtype=wp.vec4ub), levels: wp.array(dtype=wp.vec3i), to_uv: wp.mat33d, detail: wp.float64, x: int, y: int
) -> float:
    """Filtered alpha of a plane in another pixel, at a given level of detail."""
    place = to_uv * wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(1.0))
    return trilinear(texels, levels, place[0] / place[2], place[1] / place[2], detail)[3]


@wp.func
def threshold(x: int, y: int, texture: int) -> float:
    """:func:`bbfit.operators.drawing.compositing.thresholds`"""
    mixed = (wp.uint32(x) * OF_X) ^ (wp.uint32(y) * OF_Y) ^ (wp.uint32(texture) * OF_TEXTURE)
    mixed = (mixed ^ (mixed >> wp.uint32(16))) * FIRST_ROUND
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * SECOND_ROUND
    mixed = mixed ^ (mixed >> wp.uint32(16))
    return (float(mixed >> wp.uint32(9)) + 0.5) / 8388608.0


@wp.func
def opacity(alpha: float, contrast: float, test: wp.vec4) -> float:
    """:func:`bbfit.operators.drawing.compositing.opacity`, without the mode ``hash``; ``contrast`` is for an antialiased mask."""
    if test[3] == IS_COVERAGE:
        return wp.where(test[1] == 0.0, alpha, wp.floor(alpha * test[1] + 0.5) / wp.max(test[1], 1.0))
    if test[0] == NO_CUTOFF:
        return alpha
    slope = test[1]
    if test[3] == IS_SMOOTH:
        if alpha <= 0.0:
            return 0.0
        steep = 1.0 / wp.max(contrast, LEAST)
        slope = wp.where(slope == 0.0, steep, wp.min(steep, slope))
    if slope == 0.0:
        return wp.where(alpha >= test[0], 1.0, 0.0)
    return wp.clamp(0.5 + (alpha - test[0]) * slope, 0.0, 1.0)


@wp.func
def shaded(color: wp.vec3, surface: wp.vec4, through: float, towards: wp.vec3, sun: wp.vec4, traced: int) -> wp.vec3:
    """A base color under a sun in the direction ``towards`` in the texture's axes, and a sky, whose strength follows the sun's color.

    ``surface`` is the filtered normal and occlusion, ``through`` translucency.
    """
    normal = wp.normalize(wp.vec3(2.0 * surface[0] - 1.0, 2.0 * surface[1] - 1.0, 2.0 * surface[2] - 1.0))
    cosine = wp.dot(normal, towards)
    of_sun = (1.0 - through) * wp.max(cosine, 0.0) + through * wp.max(-cosine, 0.0)
    of_sky = surface[3]
    if traced != 0:
        of_sun = wp.where(towards[2] > 0.0, of_sun, 0.0)
        of_sky = (1.0 + normal[2]) / 2.0
    shown = lit(wp.vec4(color[0], color[1], color[2], 0.0), of_sun * sun + wp.vec4(of_sky * sun[3]))
    return wp.vec3(shown[0], shown[1], shown[2])


@wp.func
def seen_at(matrix: wp.mat33d, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Texture coordinates of a plane in a point of the screen, and their divisor."""
    scale = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / scale
    v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / scale
    return wp.vec3d(u, v, scale)


@wp.func
def is_inside(sides: wp.array2d(dtype=wp.vec3d), piece: int, place: wp.vec3d) -> bool:
    """Whether texture coordinates lie in a piece."""
    u, v = place[0], place[1]
    for side in range(sides.shape[1]):
        edge = sides[piece, side]
        if edge[0] * u + edge[1] * v > edge[2] + SLACK:
            return False
    return True


@wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
def draw_rows(
    first_line: int,
    thread: int,
    heads: wp.array3d(dtype=wp.int32),
    fragments: wp.array2d(dtype=Fragment),
    height: int,
    width: int,
    test: wp.vec4,
    multisampled: int,
    traced: int,
    boxes: wp.array2d(dtype=wp.vec4i),
    of_piece: wp.array(dtype=wp.int32),
    sides: wp.array2d(dtype=wp.vec3d),
    to_uv: wp.array2d(dtype=wp.mat33d),
    to_depth: wp.array2d(dtype=wp.vec3d),
    first_texels: wp.array(dtype=wp.int32),
    levels: wp.array(dtype=wp.vec3i),
    texels: wp.array(dtype=wp.vec4ub),
    maps: wp.array(dtype=wp.vec4ub),
    translucency: wp.array(dtype=wp.vec4ub),
    towards: wp.array2d(dtype=wp.vec3),
    suns: wp.array(dtype=wp.vec4),
    image: wp.array3d(dtype=wp.vec4),
    counts: wp.array2d(dtype=wp.int32),
):
    """Write ``image`` [V, H, W] and the number of fragments of each row, ``counts`` [V, H]; launched over rows of all views.

    Memory of a thread: ``heads``, the first and the latest fragment of each pixel of a row, and the ``fragments`` of a row.
    ``maps`` are normals and occlusion. Without ``suns``, colors are shown as they are. A pixel has one sample, its center, or four.
    """
    line, _ = wp.tid()
    line += first_line
    view, row = line // height, line % height
    y, nothing = wp.float64(row), wp.float64(0.0)
    for column in range(width):
        heads[thread, 0, column] = -1
        heads[thread, 1, column] = -1
    used = int(0)
    for piece in range(of_piece.shape[0]):
        box = boxes[view, piece]
        if row < box[1] or row >= box[3]:
            continue
        sheet = of_piece[piece]
        matrix, away = to_uv[view, sheet], to_depth[view, sheet]
        for column in range(box[0], box[2]):
            x, covered = wp.float64(column), int(0)
            center = seen_at(matrix, x, y)
            depth = away[0] * center[0] + away[1] * center[1] + away[2]
            if depth > nothing and wp.isfinite(depth):
                if multisampled == 0:
                    covered = wp.where(is_inside(sides, piece, center), 1, 0)
                else:
                    for point in range(4):
                        if is_inside(sides, piece, seen_at(matrix, x + RIGHT[point], y + DOWN[point])):
                            covered |= 1 << point
            if covered != 0:
                latest = heads[thread, 1, column]
                if latest >= 0:
                    if fragments[thread, latest].sheet == sheet:  # pieces of a sheet meet in this pixel, or overlap
                        fragments[thread, latest].covered |= covered
                        continue
                before, after = int(-1), int(heads[thread, 0, column])
                while after >= 0:
                    if fragments[thread, after].depth > depth * TIED:
                        break
                    before = after
                    after = int(fragments[thread, after].following)
                fragments[thread, used] = Fragment(center[0], center[1], center[2], depth, sheet, covered, after)
                if before < 0:
                    heads[thread, 0, column] = used
                else:
                    fragments[thread, before].following = used
                heads[thread, 1, column] = used
                used += 1
    counts[view, row] = used
    size = wp.vec2d(wp.float64(levels[0][1]), wp.float64(levels[0][2]))
    last = wp.float64(levels.shape[0] - 1)
    nested, share = test[3] != 0.0, wp.where(multisampled != 0, 0.25, 1.0)
    whole = multisampled != 0 and test[3] == IS_COVERAGE and test[1] == 4.0
    for column in range(width):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        # How much of each sample fragments in front hide.
        hidden = wp.vec4(0.0, 1.0, 1.0, 1.0)
        if multisampled != 0:
            hidden = wp.vec4(0.0, 0.0, 0.0, 0.0)
        at = int(heads[thread, 0, column])
        while at >= 0 and wp.min(hidden) < 1.0:
            seen = fragments[thread, at]
            rows = to_uv[view, seen.sheet]
            # d(a / c) = (da - (a / c) dc) / c, in x and in y
            right = wp.vec2d((rows[0, 0] - seen.u * rows[2, 0]) * size[0], (rows[1, 0] - seen.v * rows[2, 0]) * size[1])
            down = wp.vec2d((rows[0, 1] - seen.u * rows[2, 1]) * size[0], (rows[1, 1] - seen.v * rows[2, 1]) * size[1])
            rate = wp.max(wp.length(right), wp.length(down)) / wp.abs(seen.scale)
            detail = wp.clamp(wp.log2(rate), nothing, last)
            sample = trilinear(texels, levels, seen.u, seen.v, detail)
            contrast = float(0.0)
            if test[3] == IS_SMOOTH:
                across = alpha_beside(texels, levels, rows, detail, column ^ 1, row)
                along = alpha_beside(texels, levels, rows, detail, column, row ^ 1)
                contrast = wp.abs(across - sample[3]) + wp.abs(along - sample[3])
            alpha = opacity(sample[3], contrast, test)
            if test[0] == HASH_CUTOFF:
                alpha = wp.where(sample[3] >= threshold(column, row, first_texels[seen.sheet]), 1.0, 0.0)
            shown = wp.vec4(0.0, 0.0, 0.0, 0.0)
            for point in range(4):
                if (seen.covered >> point) & 1 != 0:
                    part = alpha
                    if whole:  # of coverage, the first samples are covered, and the rest are not
                        part = wp.where(4.0 * alpha > float(point) + 0.5, 1.0, 0.0)
                    shown[point] = wp.where(nested, wp.max(part - hidden[point], 0.0), part * (1.0 - hidden[point]))
            hidden += shown
            weight = share * (shown[0] + shown[1] + shown[2] + shown[3])
            color = wp.vec3(sample[0], sample[1], sample[2])
            if suns.shape[0] > 0 and weight > 0.0:
                surface, through = trilinear(maps, levels, seen.u, seen.v, detail), float(0.0)
                if translucency.shape[0] > 0:
                    through = trilinear(translucency, levels, seen.u, seen.v, detail)[0]
                color = shaded(color, surface, through, towards[view, seen.sheet], suns[view], traced)
            total += wp.vec4(color[0], color[1], color[2], 1.0) * weight
            at = seen.following
        image[view, row, column] = total
