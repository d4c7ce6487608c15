"""Mip levels of pictures, and trilinear samples of them as graphics cards take them (LINEAR_MIPMAP_LINEAR)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import fail


@dataclass(frozen=True)
class MipChain:
    """The texels of all levels of a mip chain."""

    texels: Tensor
    """uint8 [T, C]."""
    starts: Tensor
    """First texel of each level, int64 [L]."""
    widths: Tensor
    """In texels, int64 [L]."""
    heights: Tensor
    """In texels, int64 [L]."""


@dataclass(frozen=True)
class Footprint:
    """The texels that M trilinear samples mix, whatever their values."""

    fine: tuple[Tensor, Tensor]
    """Indices of the four texels in the finer level, int64 [4, M], and the place between them across and down, float32 [2, M, 1]."""
    coarse: tuple[Tensor, Tensor]
    """The same in the coarser level, for the samples between two levels."""
    mixed: Tensor
    """Which samples those are, int64."""
    share: Tensor
    """The share of the coarser level in each of them, float32 [, 1]."""


def joined(chain: Sequence[NDArray[np.uint8]], shape: tuple[int, ...]) -> MipChain:
    """Concatenate mip levels, uint8 [h, w, C] each, level 0 first, which has the given shape.

    Raises InputError if there is no level, or a level is not uint8 or not half as large as the level before, rounded down.
    """
    if not chain:
        fail("chain", "has no levels", "level 0 is the atlas's picture")
    for number, level in enumerate(chain):
        expected = (max(1, shape[0] >> number), max(1, shape[1] >> number), *shape[2:])
        if level.shape != expected or level.dtype != np.uint8:
            fail("chain", f"level {number} is {level.dtype} {list(level.shape)}", f"expected uint8 {list(expected)}")
    heights, widths = torch.tensor([level.shape[:2] for level in chain]).unbind(-1)
    texels = torch.from_numpy(np.concatenate([level.reshape(-1, shape[-1]) for level in chain]))
    return MipChain(texels, (heights * widths).cumsum(0) - heights * widths, widths, heights)


def filtered(levels: MipChain, uv: Tensor, detail: Tensor) -> Tensor:
    """Trilinear samples in [0, 255] at points [M, 2] by level of detail [M]: float32 [M, C]."""
    return sampled(levels.texels.float(), footprint(levels, uv, detail))


def footprint(levels: MipChain, uv: Tensor, detail: Tensor) -> Footprint:
    """The texels that trilinear samples at points [M, 2] by level of detail [M] mix."""
    detail = detail.clamp(0, len(levels.starts) - 1)
    level = detail.long()
    share = (detail - level).float()
    mixed = share.nonzero()[:, 0]
    return Footprint(_square(levels, uv, level), _square(levels, uv[mixed], level[mixed] + 1), mixed, share[mixed, None])


def sampled(texels: Tensor, place: Footprint) -> Tensor:
    """The samples of a footprint from the texels of all levels, float32 [T, C]: [M, C]."""
    sample, coarser = (_bilinear(texels, *square) for square in (place.fine, place.coarse))
    sample[place.mixed] += (coarser - sample[place.mixed]) * place.share
    return sample


def _square(levels: MipChain, uv: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """The four texels around points [M, 2] in levels int64 [M], clamped to the edge, [4, M], and the place between them, [2, M, 1]."""
    width, height = levels.widths[level], levels.heights[level]
    x, y = (uv[:, 0] * width - 0.5).clamp_min(0), (uv[:, 1] * height - 0.5).clamp_min(0)
    left, top = torch.minimum(x.long(), width - 1), torch.minimum(y.long(), height - 1)
    right, down = (left + 1 < width).long(), (top + 1 < height).long() * width
    start = levels.starts[level] + top * width + left
    # Beyond the last texel both neighbors are that one.
    return torch.stack([start, start + right, start + down, start + down + right]), torch.stack([x - left, y - top]).float()[..., None]


def _bilinear(texels: Tensor, corners: Tensor, at: Tensor) -> Tensor:
    """Samples between four texels each, of float32 [T, C]: [M, C]."""
    a, b, c, d = (texels[corner] for corner in corners)
    x, y = at
    # In this form equal texels give their own value exactly, whatever the weights: alpha at the cutoff stays at the cutoff.
    upper, lower = a + (b - a) * x, c + (d - c) * x
    return upper + (lower - upper) * y
