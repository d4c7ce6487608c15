"""The fast renderer: Warp kernels that draw all views and billboards at once, with a backward pass written by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.compositing import STEEPEST
from bbfit.rendering.kernels import NORMS, Plane, kernels, unpack
from bbfit.rendering.launching import in_parallel, pieces_of
from bbfit.rendering.projection import Projection, project
from bbfit.rendering.sampling import BLOCK

# Pixels that are worth a CPU thread's while.
LEAST_PIXELS = 1 << 14
# Bands of rows that a picture is cut into at most. Not by the number of threads, which would decide over the order of sums.
MOST_BANDS = 32
# Pixels whose texel coordinates fit a CPU's vector registers.
LANES = 16


def render_fused(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Draw a billboard cloud as :func:`bbfit.rendering.reference.render_reference` does, in float32.

    Differentiable in the texels and in the placement, save in the mode hash. On a CPU equal inputs give equal bytes, whatever the number
    of threads; on CUDA the gradients are summed in no fixed order.

    Returns
    -------
    Premultiplied RGBA, float32 [V, H, W, 4] ([H, W, 4] for a single camera).
    """
    projection, texels = project(cloud, camera), cloud.texels.to(torch.float32)
    if cloud.alpha.kind == "hash":
        image = draw(texels.detach().contiguous(), projection)
    else:
        image = _Drawing.apply(texels, projection.to_texel, projection)
    return image if camera.batched else image[0]


@dataclass(frozen=True)
class PixelLoss:
    """A distance to target pictures that the backward pass takes along, so that the picture itself is never stored."""

    target: Tensor
    """8-bit RGBA, uint8 [V, H, W, 4], contiguous."""
    straight: bool
    """Whether the target's alpha is straight; premultiplied otherwise."""
    norm: str
    """``"l1"`` or ``"l2"``: absolute or squared differences of premultiplied RGBA, summed; ``"backgrounds"``: the squared difference over a
    background whose channels are uniformly random, in expectation."""
    weight: float
    """Factor of the summed differences in the loss."""


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
        of_matrices = differentiate(
            texels, ctx.projection, of_texels, image_gradient=gradients[0].contiguous(), placement=ctx.needs_input_grad[1]
        )[1]
        return (of_texels if ctx.needs_input_grad[0] else None), (of_matrices.to(to_texel) if of_matrices is not None else None), None


def occupancy(texels: Tensor) -> Tensor:
    """Which blocks of :data:`BLOCK` texels hold one that is not fully transparent, uint8 [ceil(P / BLOCK)]."""
    alpha = torch.nn.functional.pad(texels[:, 3], (0, -len(texels) % BLOCK))
    return (alpha.view(-1, BLOCK) != 0).any(-1).to(torch.uint8)


def draw(texels: Tensor, projection: Projection, occupied: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    """Draw textures, float32 [P, 4], contiguous: premultiplied RGBA, float32 [V, H, W, 4].

    Parameters
    ----------
    occupied : :func:`occupancy` of the texels; worked out when left out.
    out : memory for the picture, float32 [V, H, W, 4], contiguous, all of which is overwritten.
    """
    views, height, width = len(projection), projection.height, projection.width
    image = torch.empty(views, height, width, 4, dtype=torch.float32, device=texels.device) if out is None else out
    if not len(texels) or not views:
        return image.zero_()
    occupied = occupancy(texels.detach()) if occupied is None else occupied
    run, device = _run(projection, texels.device), wp.device_from_torch(texels.device)
    kernel, packed = kernels(_capacity(projection.count), _lanes(texels.device)).draw, _packed_planes(projection)
    kernel.module.load(device)  # or every thread would compile it
    arguments = [run, width, int(projection.orthographic), projection.count, _test(projection.alpha), _planes(packed)]
    arguments += [_array(texels, wp.vec4), _array(occupied, wp.uint8)]
    outputs = [_array(image, wp.vec4)]

    def launch(begin: int, end: int) -> None:
        wp.launch(kernel, (views, end - begin, -(-width // run)), [begin, *arguments], outputs, device=device)

    in_parallel(launch, [(0, height)] if texels.is_cuda else pieces_of(height, -(-LEAST_PIXELS // (width * views)), MOST_BANDS))
    return image


def unpacked(packed: Tensor, straight: bool, out: Tensor | None = None) -> Tensor:
    """8-bit RGBA, uint8 [V, H, W, 4], contiguous, as premultiplied RGBA in [0, 1], float32; ``out`` as :func:`draw` takes it."""
    image = torch.empty(packed.shape, dtype=torch.float32, device=packed.device) if out is None else out
    run, device = 1 if packed.is_cuda else 1 << 10, wp.device_from_torch(packed.device)
    arguments = [run, _array(packed.view(torch.int32).flatten(), wp.int32), int(straight)]
    outputs, runs = [_array(image.view(-1, 4), wp.vec4)], -(-packed.numel() // 4 // run)
    unpack.module.load(device)  # or every thread would compile it

    def launch(begin: int, end: int) -> None:
        wp.launch(unpack, end - begin, [begin, *arguments], outputs, device=device)

    in_parallel(launch, [(0, runs)] if packed.is_cuda else pieces_of(runs, LEAST_PIXELS // run))
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
    """Add the gradient in the textures to ``texel_gradient``, float32 [P, 4].

    Parameters
    ----------
    image_gradient : gradient of a loss in the picture, float32 [V, H, W, 4], contiguous.
    loss : one more loss, of the picture, whose gradient is worked out on the way.
    occupied : :func:`occupancy` of the texels; worked out when left out.
    placement : whether the gradient in ``projection.to_texel`` is wanted.

    Returns
    -------
    The summed differences per view of ``loss``, float64 [V], and the gradient in the matrices, float64 [V, N, 3, 3]; ``None`` for what was
    not asked for.
    """
    views, height, width, count = len(projection), projection.height, projection.width, projection.count
    device = texels.device
    sums = torch.zeros(views if loss else 0, height, dtype=torch.float32, device=device)
    matrices = torch.zeros(views if placement else 0, height, count, 3, 3, dtype=torch.float64, device=device)
    if views and (len(texels) or loss):
        nothing = torch.zeros(0, 0, 0, 4, dtype=torch.float32, device=device)
        target = loss.target if loss else nothing.to(torch.uint8)
        occupied = occupancy(texels.detach()) if occupied is None else occupied
        run, packed = _run(projection, device), _packed_planes(projection)
        arguments = [
            run,
            width,
            int(projection.orthographic),
            count,
            _test(projection.alpha),
            _planes(packed),
            _array(texels, wp.vec4),
            _array(occupied, wp.uint8),
            _array(nothing if image_gradient is None else image_gradient, wp.vec4),
            _array(target.view(torch.int32).squeeze(-1), wp.int32),
            int(loss.straight) if loss else 0,
            NORMS[loss.norm] if loss else 0,
            loss.weight if loss else 0.0,
        ]
        outputs = [_array(sums, wp.float32), _array(texel_gradient, wp.vec4), _array(matrices, wp.vec3d)]
        kernel, pieces = kernels(_capacity(count), _lanes(device)).differentiate, -(-width // run)

        on = wp.device_from_torch(device)
        kernel.module.load(on)  # or every thread would compile it

        def launch(view: int, number: int, begin: int, end: int) -> None:
            wp.launch(kernel, (number, end - begin, pieces), [view, begin, *arguments], outputs, device=on)

        for phase in _schedule(projection, device):
            in_parallel(launch, phase)
    return (sums.sum(-1, dtype=torch.float64) if loss else None), (matrices.sum(1) if placement else None)


def _schedule(projection: Projection, device: torch.device) -> list[list[tuple[int, int, int, int]]]:
    """How launches that add to texels are cut up: phases of pieces that can go at once, each a view, how many, and a band of rows.

    On a CPU bands of equal parity touch different texels, so no two threads ever add to the same one, and every texel's sum has one
    order. A GPU adds atomically. Small pictures are not worth the cutting.
    """
    views, height, width = len(projection), projection.height, projection.width
    if device.type == "cuda":
        return [[(0, views, 0, height)]]
    if projection.groups > 1:
        share = views // projection.groups
        return [[(group * share, share, 0, height) for group in range(projection.groups)]]
    phases = list[list[tuple[int, int, int, int]]]()
    for view, apart in enumerate(projection.rows_apart.tolist()):
        bands = pieces_of(height, max(apart, -(-LEAST_PIXELS // width)), MOST_BANDS)
        if len(bands) > 3:
            phases += [[(view, 1, *band) for band in bands[parity::2]] for parity in (0, 1)]
        elif phases and len(phases[-1]) == 1:  # views that are not cut up go together
            phases[-1] = [(phases[-1][0][0], phases[-1][0][1] + 1, 0, height)]
        else:
            phases.append([(view, 1, 0, height)])
    return phases


def _test(mode: AlphaMode) -> Any:
    """An alpha mode for a kernel: the cutoff (0: blend, -1: hash), the hardness (0: a step) and the slope of its gradient."""
    if mode.kind != "mask":
        return wp.vec3(0.0 if mode.kind == "blend" else -1.0, 0.0, 0.0)
    return wp.vec3(mode.cutoff, 0.0 if math.isinf(mode.hardness) else mode.hardness, min(mode.hardness, STEEPEST))


def _capacity(count: int) -> int:
    """Billboards that a kernel is compiled for: the next power of two, at least 4."""
    return max(4, 1 << (count - 1).bit_length())


def _lanes(device: torch.device) -> int:
    """Pixels that a thread takes at a time."""
    return 1 if device.type == "cuda" else LANES


def _run(projection: Projection, device: torch.device) -> int:
    """Pixels that a thread walks along a row."""
    return 1 if device.type == "cuda" else projection.width


def _packed_planes(projection: Projection) -> Tensor:
    """The memory of an array of :class:`bbfit.rendering.kernels.Plane`, int32 [V, N, 19]."""
    views, count = projection.boxes.shape[:2]
    numbers = [projection.to_texel.detach().reshape(views, count, 9), projection.nearness]
    return torch.cat([*(part.contiguous().view(torch.int32) for part in numbers), projection.textures, projection.boxes], -1)


def _planes(packed: Tensor) -> Any:
    """A Warp view of :func:`_packed_planes`, which must outlive it."""
    return wp.array(ptr=packed.data_ptr(), shape=packed.shape[0] * packed.shape[1], dtype=Plane, device=wp.device_from_torch(packed.device))


def _array(tensor: Tensor, dtype: Any) -> Any:
    """A Warp view of a contiguous tensor's memory."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
