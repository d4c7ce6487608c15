"""Warp kernels that draw billboard clouds and differentiate the picture; one source for the CPU and CUDA.

**Forward.** A pixel meets the layers 1 to K, front to back, with straight colors c_k and opacities a_k. With the transmittance
T_k = product over j < k of (1 - a_j), the over operator (Porter and Duff 1984, section 4.3) gives

    color = sum of T_k a_k c_k,    alpha = sum of T_k a_k.

Texel coordinates are u = m_1 p / w and v = m_2 p / w, w = m_3 p, where m_i are the rows of the homography and p = (x, y, 1).

**Backward.** Let (g, h) be the derivative in the pixel's color and alpha, and e_k = g . c_k + h. A layer's opacity scales its own
contribution and dims the layers behind it, so

    dL/dc_k = T_k a_k g,    dL/da_k = T_k v_k,    v_k = e_k - s_k,    s_k = sum over j > k of a_j e_j product over k < i < j of (1 - a_i).

s_K = 0 and s_(k-1) = s_k + a_k v_k: one pass back to front gives all v_k without a division by 1 - a_k, which opaque layers would make
zero. A second pass, front to back, multiplies by T_k and scatters to texels (:mod:`bbfit.operators.drawing.tile_kernels`). For a
derivative (t_u, t_v) in texel coordinates the rows of the homography receive

    dL/dm_1 = t_u p / w,    dL/dm_2 = t_v p / w,    dL/dm_3 = -(u t_u + v t_v) p / w.

**Alpha to coverage.** Every layer gets the same samples of a pixel first, so a layer shows where those in front leave samples free. With
m_k = max over j < k of a_j, its weight is max(a_k - m_k, 0) instead of T_k a_k. If a layer shows, the next layer that shows loses what it
gains: dL/da_k = e_k - e_next, where e_next is 0 if there is none. Otherwise it is 0.

**Colors of their own.** With ``own_colors``, the colors do not minimize the picture's loss but the squared difference to the view's
straight color C, weighted by the view's alpha A and by the layer's weight w_k (which is held constant):

    sum of w_k A |c_k - C|^2,    with the derivative 2 w_k (A c_k - A C) in c_k.

Colors have this gradient in place of that of the pixel loss, and that of ``image_gradient`` besides. Alpha has all gradients in any case.

**Schedule.** A thread processes a run of tiles (:mod:`bbfit.operators.drawing.tile_kernels`): all tiles of two rows on a CPU, one pixel on
CUDA. Layers are sorted per pixel. The backward kernel blends again instead of reading stored layers.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - int(0) declares a variable of a kernel, 0 a constant.

from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.operators.drawing.tile_forward import SPAN as SPAN_VALUE
from bbfit.operators.drawing.tile_kernels import Plane, tiles
from bbfit.operators.launching import FLAGS

SPAN = wp.constant(SPAN_VALUE)
STRIP = wp.constant(8)
"""Rows of pixels whose losses and derivatives in the placement are added up. A row of tiles is in one strip."""

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@cache
def kernels(capacity: int = 4, lanes: int = 1) -> SimpleNamespace:
    """The kernels ``draw`` and ``differentiate``, compiled for tiles of ``lanes`` pixels: 1 on CUDA, 16 on a CPU.

    A tile has room for ``capacity`` billboards, a single pixel for as many layers.
    """
    own = tiles(capacity, lanes)
    Tile, restart, narrow, meet, arrange, sample, blend = own.Tile, own.restart, own.narrow, own.meet, own.arrange, own.sample, own.blend
    vacant, store, anything, compare, pull_back, scatter = own.vacant, own.store, own.anything, own.compare, own.pull_back, own.scatter
    columns, rows = own.columns, lanes // own.columns

    @wp.func
    def draw_row(
        tile: wp.ref[Tile], view: int, line: int, begin: int, end: int, orthographic: int, count: int, test: wp.vec4,
        planes: wp.array(dtype=Plane), texels: wp.array(dtype=wp.vec4), occupied: wp.array(dtype=wp.uint8),
        image: wp.array3d(dtype=wp.vec4),
    ):  # fmt: skip
        """Draw a row of tiles from column ``begin`` to ``end``."""
        row = line * rows
        base = view * count
        nested = int(test[3])
        restart(tile, planes, base, count, row, begin, end)
        for column in range(begin, end, columns):
            if (column - begin) % SPAN == 0:
                narrow(tile, planes, base, column)
            meet(tile, planes, base, column, row, orthographic, texels, texels)
            arrange(tile)
            position = int(0)
            while position < tile.depth:
                sample(tile, position, 1, test, planes, base, column, row, texels, occupied)
                position += 1
                if not blend(tile, position - 1, nested):
                    position = tile.depth
            store(tile, image, view, column, row)

    @wp.func
    def differentiate_row(
        tile: wp.ref[Tile], view: int, line: int, begin: int, end: int, orthographic: int, count: int, test: wp.vec4,
        planes: wp.array(dtype=Plane), texels: wp.array(dtype=wp.vec4), occupied: wp.array(dtype=wp.uint8),
        width: int, height: int, image_gradient: wp.array3d(dtype=wp.vec4), target: wp.array3d(dtype=wp.int32), straight: int,
        pixel_loss: int, weight: float, own_colors: int, strips: int, texel_gradient: wp.array(dtype=wp.vec4),
        matrices: wp.array(dtype=wp.mat33d),
    ) -> float:  # fmt: skip
        """Differentiate a row of tiles from column ``begin`` to ``end``. Returns the loss."""
        row = line * rows
        base = view * count
        nested = int(test[3])
        total = float(0.0)
        restart(tile, planes, base, count, row, begin, end)
        for column in range(begin, end, columns):
            if (column - begin) % SPAN == 0:
                narrow(tile, planes, base, column)
            meet(tile, planes, base, column, row, orthographic, texels, texel_gradient)
            # Where picture and target are both empty there is neither a loss nor a gradient.
            if anything(target, image_gradient, view, column, row, width, height) or not vacant(tile, planes, base, occupied):
                arrange(tile)
                position = int(0)
                while position < tile.depth:
                    sample(tile, position, 0, test, planes, base, column, row, texels, occupied)
                    blend(tile, position, nested)
                    position += 1
                total += compare(tile, target, image_gradient, view, column, row, width, height, straight, pixel_loss, weight)
                pull_back(tile, nested, own_colors, weight)
                moving = matrices.shape[0] != 0
                scatter(tile, planes, base, column, row, texels, texel_gradient, moving, matrices, view * strips + row // STRIP, count)
        return total

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def draw(
        first_line: int,
        thread: int,
        scratch: wp.array(dtype=Tile),
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
        """Write ``image`` [V, H, W]; launched over views, rows of tiles from ``first_line`` on, and runs of pixels."""
        view, line, piece = wp.tid()
        line += first_line
        begin = piece * run
        end = wp.min(begin + run, width)
        if wp.static(lanes > 1):
            draw_row(scratch[thread], view, line, begin, end, orthographic, count, test, planes, texels, occupied, image)
        else:
            tile = Tile()
            draw_row(tile, view, line, begin, end, orthographic, count, test, planes, texels, occupied, image)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": FLAGS})
    def differentiate(
        first_view: int,
        first_line: int,
        texel_gradient: wp.array(dtype=wp.vec4),
        thread: int,
        scratch: wp.array(dtype=Tile),
        run: int,
        width: int,
        orthographic: int,
        count: int,
        test: wp.vec4,
        planes: wp.array(dtype=Plane),
        texels: wp.array(dtype=wp.vec4),
        occupied: wp.array(dtype=wp.uint8),
        height: int,
        image_gradient: wp.array3d(dtype=wp.vec4),
        target: wp.array3d(dtype=wp.int32),
        straight: int,
        pixel_loss: int,
        weight: float,
        own_colors: int,
        loss: wp.array2d(dtype=wp.float32),
        matrices: wp.array(dtype=wp.mat33d),
        strips: int,
    ):
        """Add to ``texel_gradient`` [P] and, unless empty, to ``matrices`` [V * ``strips`` * N].

        The picture's gradient is ``image_gradient`` [V, H, W], unless empty, plus ``weight`` times that of the pixel loss against
        ``target`` [V, H, W], unless empty. The loss is added to ``loss`` [V, ``strips``]. ``own_colors`` fits colors to the target's.
        """
        view, line, piece = wp.tid()
        view += first_view
        line += first_line
        begin = piece * run
        end = wp.min(begin + run, width)
        total = float(0.0)
        if wp.static(lanes > 1):
            total = differentiate_row(
                scratch[thread], view, line, begin, end, orthographic, count, test, planes, texels, occupied, width, height,
                image_gradient, target, straight, pixel_loss, weight, own_colors, strips, texel_gradient, matrices,
            )  # fmt: skip
        else:
            tile = Tile()
            total = differentiate_row(
                tile, view, line, begin, end, orthographic, count, test, planes, texels, occupied, width, height,
                image_gradient, target, straight, pixel_loss, weight, own_colors, strips, texel_gradient, matrices,
            )  # fmt: skip
        if target.shape[0] != 0:
            wp.atomic_add(loss, view, line * rows // STRIP, total)

    return SimpleNamespace(draw=draw, differentiate=differentiate, Tile=Tile, rows=rows)
