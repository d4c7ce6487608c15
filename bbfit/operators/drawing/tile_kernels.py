"""Warp functions for a tile of pixels and the layers that it meets; one source for the CPU and CUDA.

A tile has 2 rows of 8 pixels on a CPU, which fill its vector registers, and one pixel on CUDA. Its layers go through these functions:

1. :func:`meet` computes texel coordinates, and :func:`arrange` sorts the layers of each pixel.
2. :func:`sample` filters a layer's texture for all pixels. A sample at texel (i + fx, j + fy) is S = sum over its four texels of w_c t_c
   with the bilinear weights w = (1 - fx)(1 - fy), fx (1 - fy), (1 - fx) fy, fx fy. Alpha is 0 in texels beyond the border.
3. :func:`blend` composites a layer.
4. :func:`pull_back` differentiates the picture in the samples, and :func:`scatter` the samples in the texels: for a derivative g in S,
   texel c receives w_c g. The derivative in the texel coordinates is, with the products k_c = t_c . g,

    by u: (k_1 - k_0)(1 - fy) + (k_3 - k_2) fy,    by v: (k_2 - k_0)(1 - fx) + (k_3 - k_1) fx.

**Order.** Layers begin in the order that they have in the tile to the left, which is mostly right. They are sorted by insertion: all pixels
at a time, or, where small billboards leave out most of a tile's pixels, for each pixel only those that it meets.

**Opacity** is a step or a ramp of filtered alpha (:func:`bbfit.operators.drawing.compositing.opacity`). The contrast of an antialiased mask
compares pixels of a square of 2 x 2; a tile of a CPU has them all. Where a ramp is steeper than
:data:`~bbfit.operators.drawing.compositing.STEEPEST`, its derivative is a straight-through estimate.
"""

# mypy: ignore-errors

from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.operators.drawing import tile_backward as backward
from bbfit.operators.drawing import tile_forward as forward
from bbfit.operators.image_loss.kernels import COMPARISON
from bbfit.operators.launching import FLAGS, PIXEL

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.struct
class Plane:
    """A billboard in a view (:class:`bbfit.operators.drawing.projection.Projection`)."""

    to_texel: wp.mat33
    nearness: wp.vec3
    texture: wp.vec3i
    box: wp.vec4i


@cache
def tiles(capacity: int, lanes: int) -> SimpleNamespace:
    """The structure ``Tile`` for at most ``capacity`` layers of ``lanes`` pixels, 1 or a multiple of 4 in two rows, and its functions.

    A tile's place is that of its first pixel, (``column``, ``row``), and ``base`` the first plane of its view. An alpha mode ``test`` is

    - the cutoff, or ``BLENDED`` or ``HASHED`` of :mod:`bbfit.operators.drawing.tile_forward`,
    - the hardness (0: a step), or the samples of a pixel (0: any number),
    - the slope of the gradient,
    - 0, ``SMOOTH`` or ``COVERAGE``.
    """
    columns = max(lanes // 2, 1)
    wide = wp.types.vector(length=lanes, dtype=wp.float32)
    each = wp.types.vector(length=capacity, dtype=wp.int32)
    shared = wp.types.vector(length=capacity if lanes > 1 else 1, dtype=wp.int32)  # what a single pixel does not need
    wides = wp.types.matrix(shape=(capacity, lanes), dtype=wp.float32)
    wides_ints = wp.types.matrix(shape=(capacity, lanes), dtype=wp.int32)
    colors = wp.types.matrix(shape=(lanes, 4), dtype=wp.float32)
    layered = wp.types.matrix(shape=(capacity * lanes, 4), dtype=wp.float32)
    prefix = f"constexpr int CAPACITY = {capacity}, LANES = {lanes}, COLUMNS = {columns};" + forward.CONSTANTS

    @wp.struct
    class Tile:
        reaching: int  # number of planes that reach the row of tiles
        listed: each  # these planes, in the order of the last tile
        close: int  # number of them that reach the next tiles
        span: shared  # their places in ``listed``
        active: int  # number of layers: planes that some pixel meets
        depth: int  # number of positions: most layers of a pixel, or all layers
        slots: shared  # of each layer: its place in ``listed``
        ids: each  # its plane
        met: shared  # the pixels that meet it, a bit for each
        sampled: shared
        same: shared  # of each position: whether all pixels have the same layer there
        place: wides_ints  # of each layer and pixel: the upper left texel, MISS or BORDER
        fx: wides  # texel coordinates, less their whole parts unless ``place`` is BORDER
        fy: wides
        samples: layered  # straight color and 1; in the end the derivative in the sample
        opacities: wides
        slopes: wides  # of opacity
        order: wides_ints  # of each position, front to back, and pixel: the layer
        near: wides  # in the end v_k of kernels.py
        exposed: wides  # transmittance in front
        shares: wides  # weight in the picture
        through: wide  # of each pixel: transmittance so far
        color: colors  # the picture so far
        linear: colors  # derivative that was given
        slope: colors  # derivative in the picture, with that of the pixel loss
        seen: colors  # the view

    @wp.func_native(prefix + forward.RESTART)
    def restart(tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, count: int, row: int, begin: int, end: int):
        """Find the planes that reach a row of tiles between two columns."""

    @wp.func_native(prefix + forward.NARROW)
    def narrow(tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, column: int):
        """Find those of them that reach the next ``SPAN`` columns."""

    @wp.func_native(prefix + forward.MEET)
    def meet(
        tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, column: int, row: int, orthographic: int,
        texels: wp.array(dtype=wp.vec4), gradient: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        """Compute texel coordinates of all pixels on all planes; layers are in the order of the last tile."""

    @wp.func_native(prefix + forward.ARRANGE)
    def arrange(tile: wp.ref[Tile]):
        """Sort the layers of each pixel, front to back."""

    @wp.func_native(prefix + PIXEL + forward.CORNERS + forward.SAMPLE)
    def sample(
        tile: wp.ref[Tile], position: int, shown: int, test: wp.vec4, planes: wp.array(dtype=Plane), base: int, column: int, row: int,
        texels: wp.array(dtype=wp.vec4), occupied: wp.array(dtype=wp.uint8),
    ):  # fmt: skip
        """Filter the textures of the layers at a position, unless done before; with ``shown`` only of those that something shows of."""

    @wp.func_native(prefix + PIXEL + forward.BLEND)
    def blend(tile: wp.ref[Tile], position: int, nested: int) -> bool:
        """Composite the layers at a position. Returns whether anything behind them can show."""

    @wp.func_native(prefix + backward.VACANT)
    def vacant(tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, occupied: wp.array(dtype=wp.uint8)) -> bool:
        """Whether all blocks of texels that the tile reads are transparent."""

    @wp.func_native(prefix + PIXEL + forward.STORE)
    def store(tile: wp.ref[Tile], image: wp.array3d(dtype=wp.vec4), view: int, column: int, row: int):
        """Write the tile to a picture."""

    @wp.func_native(prefix + backward.ANYTHING)
    def anything(
        target: wp.array3d(dtype=wp.int32), gradient: wp.array3d(dtype=wp.vec4), view: int, column: int, row: int, width: int, height: int
    ) -> bool:
        """Whether a view shows anything in the tile, or the picture's gradient is not zero there."""

    @wp.func_native(prefix + COMPARISON + backward.COMPARE)
    def compare(
        tile: wp.ref[Tile], target: wp.array3d(dtype=wp.int32), gradient: wp.array3d(dtype=wp.vec4), view: int, column: int, row: int,
        width: int, height: int, straight: int, loss: int, weight: float,
    ) -> float:  # fmt: skip
        """Set the derivatives in the pixels. Returns the loss, of which ``weight`` times the derivative is added to ``gradient``."""

    @wp.func_native(prefix + PIXEL + backward.PULL_BACK)
    def pull_back(tile: wp.ref[Tile], nested: int, own_colors: int, weight: float):
        """Replace samples by the derivatives in them."""

    @wp.func_native(prefix + PIXEL + backward.ADD + forward.CORNERS + backward.SCATTER)
    def scatter(
        tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, column: int, row: int, texels: wp.array(dtype=wp.vec4),
        gradient: wp.array(dtype=wp.vec4), moving: bool, matrices: wp.array(dtype=wp.mat33d), strip: int, count: int,
    ):  # fmt: skip
        """Add the derivatives in the samples to ``gradient`` and, if the planes are ``moving``, to ``matrices`` [strips, ``count``]."""

    return SimpleNamespace(**{name: value for name, value in locals().items() if not name.startswith("_")})
