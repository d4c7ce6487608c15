"""Drawing by Warp kernels: all views and billboards at once, with a hand-written backward pass."""

from __future__ import annotations

import ctypes
import math
import threading
from itertools import chain, zip_longest
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.compositing import STEEPEST
from bbfit.operators.drawing.kernels import STRIP, kernels
from bbfit.operators.drawing.projection import Projection, project
from bbfit.operators.drawing.tile_forward import BLENDED, BLOCK, COVERAGE, HASHED, SMOOTH
from bbfit.operators.drawing.tile_kernels import Plane
from bbfit.operators.image_loss.fused import PixelLoss
from bbfit.operators.image_loss.kernels import LOSSES
from bbfit.operators.launching import in_parallel, pieces_of, repeated, struct_array, warp_array, worker_count

# Most bands of rows that a picture is cut into. Independent of the number of threads, which must not change the order of sums.
MOST_BANDS = 32
# Most parts of the views that are differentiated at once, each with a gradient of its own, and most texels of further gradients for each
# pixel. Both are independent of the number of threads too.
MOST_GRADIENTS, MOST_TEXELS = 4, 3
# Least room for layers of a single pixel; the same of a tile, and what is added to a power of two.
_LAYERS, _ROOM, _ASIDE = 4, 512, 8
_kept = threading.local()


def render_fused(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """:func:`~bbfit.operators.drawing.reference.render_reference` in float32.

    Differentiable in texels and placement, except in the alpha mode ``hash``. On a CPU equal inputs give equal bytes, whatever the number
    of threads; on CUDA gradients are summed in no fixed order.
    """
    image = render_projection(cloud.texels, project(cloud, camera))
    return image if camera.batched else image[0]


def render_projection(texels: Tensor, projection: Projection) -> Tensor:
    """:func:`render_fused` of a projected cloud with texels [P, 4]: premultiplied RGBA, float32 [V, H, W, 4]."""
    texels = texels.to(torch.float32)
    if projection.alpha.kind == "hash":
        return draw(texels.detach().contiguous(), projection)
    return _Drawing.apply(texels, projection.to_texel, projection)


class Piece(NamedTuple):
    """A part of a backward pass for one thread."""

    gradient: int
    """Index of the gradient that it adds to."""
    view: int
    """First view."""
    views: int
    """Number of views."""
    begin: int
    """First row, with which a strip begins."""
    end: int
    """Row after the last one."""


class _Drawing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texels: Tensor, to_texel: Tensor, projection: Projection) -> Tensor:
        texels = texels.contiguous()
        ctx.save_for_backward(texels, to_texel)
        ctx.projection = projection
        return draw(texels, projection)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        texels, to_texel = ctx.saved_tensors
        of_texels = torch.zeros_like(texels)
        image_gradient, (of_texture, of_placement, _) = gradients[0].contiguous(), ctx.needs_input_grad
        of_matrices = differentiate(texels, ctx.projection, of_texels, image_gradient=image_gradient, placement=of_placement)[1]
        return (of_texels if of_texture else None), (of_matrices.to(to_texel) if of_matrices is not None else None), None


def occupancy(texels: Tensor) -> Tensor:
    """Whether each block of :data:`BLOCK` texels [P, 4] has one with alpha above 0, uint8 [ceil(P / BLOCK)]."""
    alpha = torch.nn.functional.pad(texels[:, 3], (0, -len(texels) % BLOCK))
    return (alpha.view(-1, BLOCK) != 0).any(-1).to(torch.uint8)


def draw(texels: Tensor, projection: Projection, occupied: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    """Draw texels, float32 [P, 4], contiguous: premultiplied RGBA, float32 [V, H, W, 4], into ``out``, contiguous, if given.

    ``occupied`` is the :func:`occupancy` of the texels, computed if omitted.
    """
    views, height, width = len(projection), projection.height, projection.width
    image = torch.empty(views, height, width, 4, dtype=torch.float32, device=texels.device) if out is None else out
    if not len(texels) or not views:
        return image.zero_()
    compiled, runs, arguments = _prepared(texels, projection, occupied)
    on, outputs = wp.device_from_torch(texels.device), [warp_array(image, wp.vec4)]
    again = repeated(compiled.draw, lambda thread: [thread, *arguments], outputs, on)

    def launch(begin: int, end: int) -> None:
        again((views, end - begin, runs), begin)

    lines = -(-height // compiled.rows)
    least = -(-projection.least_pixels // (width * views * compiled.rows))
    in_parallel(launch, [(0, lines)] if on.is_cuda else pieces_of(lines, least))
    return image


def differentiate(
    texels: Tensor,
    projection: Projection,
    texel_gradient: Tensor,
    *,
    image_gradient: Tensor | None = None,
    loss: PixelLoss | None = None,
    occupied: Tensor | None = None,
    placement: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Backward pass of :func:`draw` for texels [P, 4], which adds their gradient to ``texel_gradient``; both float32, contiguous.

    The picture's gradient is ``image_gradient``, float32 [V, H, W, 4], contiguous, plus that of ``loss``, which is computed on the way.
    ``occupied`` is the :func:`occupancy` of the texels, computed if omitted.

    Returns
    -------
    tuple[Tensor or None, Tensor or None]
        The sum of ``loss`` over each view's pixels, float64 [V], if there is a loss; the gradient in ``projection.to_texel``, float64
        [V, N, 3, 3], if ``placement``.
    """
    views, count, device = len(projection), projection.count, texels.device
    strips = -(-projection.height // STRIP)
    sums = torch.zeros(views if loss else 0, strips, dtype=torch.float32, device=device)
    matrices = torch.zeros(views if placement else 0, strips, count, 3, 3, dtype=torch.float64, device=device)
    if views and (len(texels) or loss):
        nothing = torch.zeros(0, 0, 0, 4, dtype=torch.float32, device=device)
        target = loss.target if loss else nothing.to(torch.uint8)
        compiled, runs, arguments = _prepared(texels, projection, occupied)
        on = wp.device_from_torch(device)
        arguments += [projection.height, warp_array(nothing if image_gradient is None else image_gradient, wp.vec4)]
        arguments.append(warp_array(target.view(torch.int32).squeeze(-1), wp.int32))
        arguments += [int(loss.straight), LOSSES[loss.kind], loss.weight, int(loss.own_colors)] if loss else [0, 0, 0.0, 0]
        most = min(MOST_GRADIENTS, 1 + MOST_TEXELS * views * projection.height * projection.width // max(len(texels), 1))
        phases = schedule(projection, device, most)
        further = torch.zeros(max(piece.gradient for phase in phases for piece in phase), *texels.shape, dtype=torch.float32, device=device)
        gradients = [warp_array(gradient, wp.vec4) for gradient in (texel_gradient, *further)]
        outputs = [warp_array(sums, wp.float32), warp_array(matrices.view(-1, 3, 3), wp.mat33d), strips]
        again = repeated(compiled.differentiate, lambda thread: [thread, *arguments], outputs, on)

        def launch(gradient: int, view: int, number: int, begin: int, end: int) -> None:
            again((number, -(-(end - begin) // compiled.rows), runs), view, begin // compiled.rows, gradients[gradient])

        for phase in phases:
            in_parallel(launch, phase)
        for gradient in further:
            texel_gradient += gradient
    return (sums.sum(-1, dtype=torch.float64) if loss else None), (matrices.sum(1) if placement else None)


def schedule(projection: Projection, device: torch.device, gradients: int = 1) -> list[list[Piece]]:
    """Phases of a backward pass, whose pieces run at the same time.

    On a CPU, no two threads add to the same texel of a gradient, and every sum has one order: the views are divided among ``gradients``,
    and a view's bands of equal parity touch different texels. CUDA adds atomically. Pictures are not cut into bands of fewer than
    ``projection.least_pixels``.
    """
    views, height = len(projection), projection.height
    if device.type == "cuda":
        return [[Piece(0, 0, views, 0, height)]]
    share = views // projection.groups
    parts = pieces_of(share, 1, gradients)
    if projection.groups > 1:
        starts = range(0, views, share)
        return [[Piece(n, start + begin, end - begin, 0, height) for start in starts for n, (begin, end) in enumerate(parts)]]
    of_parts = [_phases(projection, n, *part) for n, part in enumerate(parts)]
    return [list(chain(*phases)) for phases in zip_longest(*of_parts, fillvalue=[])]


def _phases(projection: Projection, gradient: int, first: int, last: int) -> list[list[Piece]]:
    """The phases of the views from ``first`` to before ``last``, which add to one gradient."""
    height, width = projection.height, projection.width
    phases = list[list[Piece]]()
    for view, apart in enumerate(projection.rows_apart[first:last].tolist(), first):
        strips = pieces_of(-(-height // STRIP), -(-max(apart, -(-projection.least_pixels // width)) // STRIP), MOST_BANDS)
        bands = [Piece(gradient, view, 1, STRIP * begin, min(STRIP * end, height)) for begin, end in strips]
        if len(bands) > 3:
            phases += [bands[::2], bands[1::2]]
        elif phases and len(phases[-1]) == 1:  # views that are not cut form one piece
            phases[-1] = [phases[-1][0]._replace(views=phases[-1][0].views + 1)]
        else:
            phases.append([Piece(gradient, view, 1, 0, height)])
    return phases


def kernels_for(layers: int, lanes: int = Projection.lanes) -> SimpleNamespace:
    """The kernels for tiles of ``lanes`` pixels, with room for as many layers: of a single pixel, or for all billboards of a tile.

    Few numbers of billboards need kernels of their own: room doubles, and on a CPU room that is not used costs nothing. There it is no
    power of two, with which the arrays of a tile would share the sets of the processor's caches.
    """
    room = 1 << (layers - 1).bit_length()
    return kernels(max(_LAYERS, room), lanes) if lanes == 1 else kernels(max(_ROOM, room) + _ASIDE, lanes)


def _tiles(compiled: SimpleNamespace, device: torch.device) -> Any:
    """Memory for a tile of each thread that launches, which the calling thread keeps. On CUDA a thread has its own."""
    if device.type == "cuda":
        return struct_array(torch.empty(0, 1, dtype=torch.int32, device=device), compiled.Tile)
    shape = (worker_count() + 1, ctypes.sizeof(compiled.Tile.ctype) // 4)
    if getattr(_kept, "tiles", torch.empty(0)).shape != shape:
        _kept.tiles = torch.empty(shape, dtype=torch.int32)
    return struct_array(_kept.tiles, compiled.Tile)


def _prepared(texels: Tensor, projection: Projection, occupied: Tensor | None) -> tuple[SimpleNamespace, int, list[Any]]:
    """Compiled kernels, the number of threads for a row of tiles, and the arguments that both kernels begin with after their offsets."""
    lanes = 1 if texels.is_cuda else projection.lanes
    run = 1 if lanes == 1 else projection.width
    few = lanes > 1 or projection.count <= _LAYERS  # else a GPU has to finish what it does, to count them
    compiled = kernels_for(projection.count if few else projection.most_layers, lanes)
    numbers = [projection.to_texel.detach().flatten(2), projection.nearness]
    planes = torch.cat([*(part.contiguous().view(torch.int32) for part in numbers), projection.textures, projection.boxes], -1)
    occupied = occupancy(texels.detach()) if occupied is None else occupied
    arguments = [
        _tiles(compiled, texels.device),
        run,
        projection.width,
        int(projection.orthographic),
        projection.count,
        encoded_alpha(projection.alpha),
    ]
    arguments += [struct_array(planes.flatten(0, 1), Plane), warp_array(texels, wp.vec4), warp_array(occupied, wp.uint8)]
    return compiled, -(-projection.width // run), arguments


def encoded_alpha(mode: AlphaMode) -> Any:
    """An alpha mode as :func:`~bbfit.operators.drawing.tile_kernels.tiles` expects it."""
    if not mode.tested:
        return wp.vec4(BLENDED if mode.kind == "blend" else HASHED, 0.0, 0.0, 0.0)
    if mode.kind == "coverage":
        return wp.vec4(mode.cutoff, float(mode.samples), 0.0, COVERAGE)
    hardness = 0.0 if math.isinf(mode.hardness) else mode.hardness
    return wp.vec4(mode.cutoff, hardness, min(mode.hardness, STEEPEST), SMOOTH if mode.antialiased else 0.0)
