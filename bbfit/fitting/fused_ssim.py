"""Structural similarity with its gradient as one sweep over the pictures' rows, by Warp kernels for CPU and CUDA.

It means what :func:`bbfit.fitting.losses.structural_similarity` says. With s = a + b and d = a - b, Wang et al.'s (2004) equation 13 is

    SSIM = (1 - p) (1 - q),    p = 2 var(d) / (var(s) + var(d) + 2 C2),    q = 2 mean(d)^2 / (mean(s)^2 + mean(d)^2 + 2 C1),

since 4 cov(a, b) = var(s) - var(d) and 2 (var(a) + var(b)) = var(s) + var(d). So four blurred maps do instead of five (s, d and their
squares), three go back, and float32 loses nothing where the pictures agree: equal ones have a similarity of exactly 1 and no gradient.
"""

from __future__ import annotations

from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.fitting.ssim_kernels import PAIRS_REACH, REACH, STAGES, kernels
from bbfit.rendering.launching import in_parallel, pieces_of, worker_count

# Pairs of rows that are worth a thread's while, since it begins PAIRS_REACH early.
_LEAST_PAIRS = 48


def similarity_and_gradient(a: Tensor, b: Tensor, weight: float, out: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The mean structural similarity, float64, and ``weight`` times its gradient in ``a``.

    Computes :func:`bbfit.fitting.losses.structural_similarity` in float32. On a CPU equal inputs give equal bytes, whatever the number of
    threads.

    Parameters
    ----------
    a, b : float32 [V, H, W, 4] in [0, 1], contiguous, at least 11 pixels high and wide.
    out : memory for the gradient, all of which is overwritten; float32 and contiguous like ``a``.
    """
    assert a.shape == b.shape and a.shape[3] == 4 and min(a.shape[1:3]) > REACH and len(a)
    assert a.dtype == b.dtype == torch.float32 and a.is_contiguous() and b.is_contiguous() and a.device == b.device
    a, b, on_gpu, device = a.detach(), b.detach(), a.is_cuda, wp.device_from_torch(a.device)
    views, height, width, channels = a.shape
    pairs, terms = (height + 1) // 2, views * (height - REACH) * (width - REACH) * channels
    own = kernels(1 if on_gpu or width - REACH < 4 else 4)
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
        spare: SimpleQueue[list[Any]] = SimpleQueue()
        for _ in range(worker_count()):
            spare.put(_scratch(a, own, 2, REACH + 2))

        def sweep(begin: int, end: int) -> None:
            scratch = spare.get()
            for view in range(begin // pairs, (end - 1) // pairs + 1):
                first, last = max(begin - view * pairs, 0), min(end - view * pairs, pairs)
                arguments = [view, first, last + PAIRS_REACH, 0, STAGES, *fixed, *scratch]
                wp.launch(own.sweep, (1, 1), arguments, outputs, device=device)
            spare.put(scratch)

        own.sweep.module.load(device)  # lest every thread compile it
        in_parallel(sweep, pieces_of(views * pairs, _LEAST_PAIRS))
    return 1 - sums.sum(dtype=torch.float64) / terms, gradient


def _ranges(a: Tensor, b: Tensor, own: SimpleNamespace) -> list[Any]:
    """First and end of the windows, and of the pixels, that pairs of rows are swept over: [V, pairs + PAIRS_REACH] each.

    Outside, both pictures are zero: the similarity is exactly 1, and neither a derivative nor the gradient there is anything but zero.
    """
    views, height, width, _ = a.shape
    device, rows = wp.device_from_torch(a.device), views * height
    # On CUDA all threads run anyway.
    extents = wp.from_torch(torch.tensor([0, width], dtype=torch.int32, device=a.device).repeat(rows, 1), dtype=wp.vec2i)
    if not a.is_cuda:
        bits = [_overlapping(picture.view(torch.int32).flatten(0, 1), own, own.bits) for picture in (a, b)]

        def find(begin: int, end: int) -> None:
            wp.launch(own.find_extents, end - begin, [begin, width, *bits], [extents], device=device)

        own.find_extents.module.load(device)
        in_parallel(find, pieces_of(rows, 2 * _LEAST_PAIRS))
    shape = (views, (height + 1) // 2 + PAIRS_REACH)
    ranges = [wp.empty(shape, dtype=wp.vec2i, device=device) for _ in range(2)]
    wp.launch(own.widen_extents, shape, [height, width, extents], ranges, device=device)
    return ranges


def _scratch(like: Tensor, own: SimpleNamespace, rows: int, spread_rows: int) -> list[Any]:
    """Memory for blurred rows, for derivatives, and for derivatives spread along rows."""
    # An odd number of cache lines to a row, lest rows that are read together fall on the same places in the cache.
    row = 4 * ((like.shape[2] + REACH + 3) // 4 | 1)
    shapes = ((4, rows, row, 4), (3, rows, row, 4), (3, spread_rows, row, 4))
    return [_overlapping(like.new_empty(shape), own, own.vector) for shape in shapes]


def _overlapping(pictures: Tensor, own: SimpleNamespace, vector: Any) -> Any:
    """A view [..., H, W'] of [..., H, W, 4] whose element x is the vector of the pixels from x on."""
    return wp.from_torch(pictures.flatten(-2).unfold(-1, 4 * own.step, 4), dtype=vector)
