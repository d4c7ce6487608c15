"""All textures of a cloud in one atlas, packed by xatlas, with padding that keeps filtering from mixing their colors."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from bbfit.exporting.packing import packed
from bbfit.fitting.palette import few_colors, nearest_means
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cards import Atlas
from bbfit.images import PALETTE, bleed_color, distinct, premultiply

# Side of the blocks in which graphics cards compress textures, in texels.
BLOCK = 4
# Fewest colors that a palette must leave to transparent texels, and the most that they get of those that are left.
_LEAST_FREE, _MOST_HIDDEN = 8, 16
# What lies in the gaps between cells of a surface: the plane's own normal, in the open, opaque.
_PLAIN = (128, 128, 255, 255, 0)


def pack_atlas(
    textures: list[NDArray[np.uint8]], padding: int, surfaces: list[NDArray[np.uint8]] | None = None, halvings: int = 0
) -> Atlas:
    """Pack R >= 1 straight-alpha textures, uint8 [h, w, 4] each, without resampling or rotating them.

    Each texture gets a cell that is at least ``padding`` >= 1 texels larger on every side, which the fade to transparent at a billboard's
    rim needs. Cells are aligned to blocks of n x n texels, where n is the largest power of two up to ``padding`` (at least 4), so no texel
    of a mip level up to log2(n) mixes two textures. Alpha is 0 outside the textures; transparent texels continue the visible colors
    (:func:`fill_cell`), so that programs which ignore alpha show no patches. If that makes more than 256 colors of fewer visible ones,
    similar colors of transparent texels become one, so that the atlas fits into the palette of a PNG.

    ``surfaces`` are further channels of each texture, uint8 [h, w, 4 or 5], packed in the same way; their padding repeats their rims.
    For an atlas whose sides are halved ``halvings`` times later, padding and blocks are as much larger.
    """
    padding <<= halvings
    sizes = np.array([texture.shape[1::-1] for texture in textures], dtype=np.int64)
    unit = max(BLOCK << halvings, 1 << (padding.bit_length() - 1))
    cells = np.maximum(-(-(sizes + 2 * padding) // unit), 2)
    places = _places(cells.tobytes())
    width, height = ((places + cells).max(0) * unit).tolist()
    image = np.zeros((height, width, 4), np.uint8)
    image[..., :3] = _mean_color(textures)  # for empty textures and the gaps between cells, which only the smallest mip levels mix in
    for texture, place, cell in zip(textures, places * unit, cells * unit, strict=True):
        (x, y), (w, h) = place.tolist(), cell.tolist()
        if texture[..., 3].any():
            image[y : y + h, x : x + w] = fill_cell(texture, padding, w, h)
    image[image[..., 3] == 0, :3] = _within_palette(image)
    surface = None
    if surfaces is not None:
        surface = np.tile(np.array(_PLAIN[: surfaces[0].shape[-1]], np.uint8), (height, width, 1))
        for part, place, cell in zip(surfaces, places * unit, cells * unit, strict=True):
            (x, y), (w, h), (rows, columns) = place.tolist(), cell.tolist(), part.shape[:2]
            rims = (padding, h - rows - padding), (padding, w - columns - padding), (0, 0)
            surface[y : y + h, x : x + w] = np.pad(part, rims, "edge")
    return Atlas(image, places * unit + padding, sizes, surface)


@lru_cache(maxsize=64)  # one model is packed for its size in bytes, for its GLB and for its OBJ
def _places(cells: bytes) -> NDArray[np.int64]:
    """:func:`~bbfit.exporting.packing.packed` of the bytes of its argument. Do not change the result."""
    return packed(np.frombuffer(cells, np.int64).reshape(-1, 2))


def fill_cell(texture: NDArray[np.uint8], padding: int, width: int, height: int) -> NDArray[np.uint8]:
    """Place a texture in its cell, uint8 [height, width, 4], with its top-left texel at (``padding``, ``padding``).

    Visible texels are unchanged. Transparent texels next to them, which bilinear filtering mixes in, get the color of the nearest opaque
    one (:func:`~bbfit.images.bleed_color`). Others get a mean over a neighborhood that grows with their distance, as the mip levels of the
    visible texels have it (:func:`_spread`).
    """
    h, w = texture.shape[:2]
    straight = np.pad(texture, ((padding, height - h - padding), (padding, width - w - padding), (0, 0)))
    cell = bleed_color(torch.from_numpy(straight)).numpy()
    away = ~ndimage.binary_dilation(straight[..., 3] > 0, np.ones((3, 3)))
    spread = _spread(premultiply(torch.from_numpy(straight).double() / 255).permute(2, 0, 1))
    cell[away, :3] = np.rint(255 * spread.permute(1, 2, 0).numpy()[away])
    # The rim fades out in its own color, as in the reference renderer.
    inner = cell[padding : padding + h, padding : padding + w, :3]
    cell[padding - 1 : padding + h + 1, padding - 1 : padding + w + 1, :3] = np.pad(inner, ((1, 1), (1, 1), (0, 0)), "edge")
    return cell


def _spread(sums: Tensor) -> Tensor:
    """Straight color everywhere, [3, h, w], of a picture with some visible texels, whose premultiplied RGBA is given, [4, h, w].

    Where alpha is below 1, the same of the picture at half the size fills in (pull-push; Gortler et al. 1996, "The Lumigraph").
    """
    weight = sums[3:]
    share = weight.clamp(max=1)
    color = sums[:3] / weight.clamp_min(1e-9)
    if max(sums.shape[1:]) == 1:
        return color
    _, height, width = sums.shape
    even = functional.pad(sums, (0, width % 2, 0, height % 2))
    halved = even.reshape(4, -1, 2, (width + 1) // 2, 2).sum((2, 4))
    return share * color + (1 - share) * functional.interpolate(_spread(halved)[None], sums.shape[1:], mode="bilinear")[0]


def _within_palette(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The colors of the transparent texels of a picture, [T, 3]; the means of some clusters of them, if all do not fit into a palette."""
    colors = image[image[..., 3] == 0][:, :3]
    free = PALETTE - len(distinct(image[image[..., 3] > 0]))
    if not _LEAST_FREE <= free < len(distinct(np.pad(colors, ((0, 0), (0, 1))))):
        return colors
    all_of_them = torch.ones(len(colors), dtype=torch.bool)
    return np.rint(nearest_means(torch.from_numpy(colors), all_of_them, min(free, _MOST_HIDDEN)).numpy()).astype(np.uint8)


def palettized_picture(image: NDArray[np.uint8], alpha: AlphaMode) -> NDArray[np.uint8]:
    """A straight-alpha picture, uint8 [H, W, 4], whose colors fit into the palette of a PNG (:func:`~bbfit.fitting.palette.few_colors`)."""
    few = few_colors(torch.from_numpy(image).reshape(-1, 4) / 255, alpha, PALETTE)
    image = (few * 255).round().to(torch.uint8).reshape(image.shape).numpy()
    image[image[..., 3] == 0, :3] = _within_palette(image)
    return image


def _mean_color(textures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Alpha-weighted mean color, [3]."""
    flat = [texture.reshape(-1, 4).astype(np.float64) for texture in textures]
    weight = sum(part[:, 3].sum() for part in flat)
    total = sum((part[:, 3] @ part[:, :3] for part in flat), np.zeros(3))
    return np.rint(total / max(weight, 1)).astype(np.uint8)
