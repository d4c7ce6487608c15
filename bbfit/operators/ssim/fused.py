"""Structural similarity by Warp kernels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.operators.launching import differentiable, in_parallel, launch, pieces_of, repeated
from bbfit.operators.ssim.kernels import PAIRS_REACH, REACH, STAGES, kernels

# Least pairs of rows for a thread, which starts PAIRS_REACH pairs early.
_LEAST_PAIRS = 48


def ssim_fused(render: Tensor, target: Tensor) -> Tensor:
    """:func:`~bbfit.operators.ssim.reference.ssim_reference` in float32, differentiable in ``render`` alone."""
    value, gradient = ssim_and_gradient(render, target, 1.0)
    return differentiable(value, render, gradient)


def ssim_and_gradient(a: Tensor, b: Tensor, weight: float, out: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Mean structural similarity, a float64 scalar, and ``weight`` times its gradient in ``a``, float32 [V, H, W, 4].

    ``a`` and ``b`` are float32 [V, H, W, 4] in [0, 1], contiguous, at least 11 pixels high and wide. ``out`` is memory for the gradient,
    like ``a``; it is overwritten completely. On a CPU equal inputs give equal bytes, whatever the number of threads.
    """
    assert a.shape == b.shape and a.shape[3] == 4 and min(a.shape[1:3]) > REACH and len(a)
    assert a.dtype == b.dtype == torch.float32 and a.is_contiguous() and b.is_contiguous() and a.device == b.device
    a, b, on_gpu, device = a.detach(), b.detach(), a.is_cuda, wp.device_from_torch(a.device)
    views, height, width, channels = a.shape
    pairs, terms = (height + 1) // 2, views * (height - REACH) * (width - REACH) * channels
    own = kernels_for(width, on_gpu)
    vector = own.vector
    down, along = (pairs + PAIRS_REACH, -(-width // own.step)) if on_gpu else (1, 1)

    gradient = torch.empty_like(a) if out is None else out
    assert gradient.is_contiguous() and gradient.dtype == torch.float32 and gradient.shape == a.shape
    sums = a.new_zeros(views, height - REACH, along, channels * own.step)
    pixels = torch.arange(own.step, device=a.device)
    fresh = (pixels >= pixels[:, None]).float().repeat_interleave(channels, 1)
    pictures = [_overlapping(picture, own, vector) for picture in (a, b)]
    fixed = [down, along, weight / terms, *_ranges(a, b, own), *pictures, wp.from_torch(fresh, dtype=vector)]
    outputs = [wp.from_torch(sums, dtype=vector), _overlapping(gradient, own, vector)]
    if on_gpu:
        scratch = _scratch(a, own, 2 * down, 2 * down)
        for view in range(views):
            for stage in range(STAGES):
                wp.launch(own.sweep, (down, along), [view, 0, down, stage, stage + 1, *fixed, *scratch], outputs, device=device)
    else:
        again = repeated(own.sweep, lambda thread: [0, STAGES, *fixed, *_scratch(a, own, 2, REACH + 2)], outputs, device)

        def sweep(begin: int, end: int) -> None:
            for view in range(begin // pairs, (end - 1) // pairs + 1):
                first, last = max(begin - view * pairs, 0), min(end - view * pairs, pairs)
                again((1, 1), view, first, last + PAIRS_REACH)

        in_parallel(sweep, pieces_of(views * pairs, _LEAST_PAIRS))
    return 1 - sums.sum(dtype=torch.float64) / terms, gradient


def kernels_for(width: int, on_gpu: bool = False) -> SimpleNamespace:
    """The kernels for pictures of a width in pixels."""
    return kernels(1 if on_gpu or width - REACH < 4 else 4)


def _ranges(a: Tensor, b: Tensor, own: SimpleNamespace) -> list[Any]:
    """Ranges of windows and of pixels that each pair of rows visits, [V, pairs + PAIRS_REACH] each.

    Outside of them both pictures are zero: the similarity is exactly 1, and derivatives and gradient are zero.
    """
    views, height, width, _ = a.shape
    device, rows = wp.device_from_torch(a.device), views * height
    # On CUDA skipping saves nothing.
    extents = wp.from_torch(torch.tensor([0, width], dtype=torch.int32, device=a.device).repeat(rows, 1), dtype=wp.vec2i)
    if not a.is_cuda:
        bits = [_overlapping(picture.view(torch.int32).flatten(0, 1), own, own.bits) for picture in (a, b)]
        launch(own.find_extents, rows, 2 * _LEAST_PAIRS, [width, *bits], [extents], on=device)
    shape = (views, (height + 1) // 2 + PAIRS_REACH)
    ranges = [wp.from_torch(torch.empty(*shape, 2, dtype=torch.int32, device=a.device), dtype=wp.vec2i) for _ in range(2)]
    wp.launch(own.widen_extents, shape, [height, width, extents], ranges, device=device)
    return ranges


def _scratch(like: Tensor, own: SimpleNamespace, rows: int, spread_rows: int) -> list[Any]:
    """Memory for blurred rows, derivatives, and derivatives blurred along rows."""
    # An odd number of cache lines in a row: rows that are read together then map to different cache sets.
    row = 4 * ((like.shape[2] + REACH + 3) // 4 | 1)
    shapes = ((4, rows, row, 4), (3, rows, row, 4), (3, spread_rows, row, 4))
    return [_overlapping(like.new_empty(shape), own, own.vector) for shape in shapes]


def _overlapping(pictures: Tensor, own: SimpleNamespace, vector: Any) -> Any:
    """A view [..., H, W'] of [..., H, W, 4] whose element x is the vector of pixels from x on."""
    return wp.from_torch(pictures.flatten(-2).unfold(-1, 4 * own.step, 4), dtype=vector)
