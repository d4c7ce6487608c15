"""What a graphics card shows of exported cards, near and from afar: bilinear and trilinear filtering, then the alpha mode.

It differs from the renderer of clouds in what files add to a cloud: textures of 8 bits, polygons that may be smaller than their
rectangles, culling, mip levels. Graphics cards also round the level and filter weights, to 8 bits or so, and take the derivatives from
differences of neighboring pixels; that is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.polygons import area, sides
from bbfit.operators.drawing.compositing import composite, opacity, thresholds
from bbfit.operators.drawing.reference import EDGE_ON

# How far outside a polygon, in shares of the atlas, a pixel's center counts as in it, so that no rounding opens a seam between two.
_SLACK = 1e-9
# Pieces belong to one sheet if their corners lie where its map takes them, but for this share of their distance from the origin.
_SAME = 1e-6


@dataclass(frozen=True)
class Sheet:
    """Cards that are parts of one textured plane, as cutting leaves them: they share no area, and a ray meets one of them at most."""

    pieces: list[Card]
    """At least one card."""
    to_world: NDArray[np.float64]
    """From (u, v, 1) to homogeneous world points, [4, 3]."""
    first: int
    """Number of its texture's first texel among those of all textures, which the mode hash is seeded with."""


@dataclass(frozen=True)
class Hits:
    """Where the rays through the centers of a camera's pixels meet a sheet from a side that is shown: M of them."""

    x: Tensor
    """Columns of the pixels, int64 [M]; no pixel occurs twice."""
    y: Tensor
    """Their rows, int64 [M]."""
    uv: Tensor
    """Texture coordinates, float64 [M, 2]."""
    detail: Tensor
    """Level of detail, float64 [M], negative where texels are magnified."""
    depth: Tensor
    """Meters along the camera's axis, float64 [M]."""


@dataclass(frozen=True)
class MipChain:
    """A mip chain as one list of texels."""

    texels: Tensor
    """uint8 [T, C]."""
    starts: Tensor
    """First texel of each level, int64 [L]."""
    widths: Tensor
    """In texels, int64 [L]."""
    heights: Tensor
    """In texels, int64 [L]."""


def draw_cards(cards: Cards, camera: Camera) -> Tensor:
    """Draw cards as a graphics card does, one sample a pixel.

    Without mip levels the picture is that of :func:`~bbfit.rendering.dispatch.render` up to the rounding of textures to 8 bits, for cards
    that show all of their rectangles. Filtering, like blending, is done on display-referred values, which is what fits are made for;
    programs that filter in linear light show slightly lighter colors, and the same alpha.

    With mip levels the level of detail is log2 of the longer of the texel coordinates' two derivatives along the screen's axes (OpenGL
    4.6, section 8.14.1), exact for every pixel; it is held within the levels that there are. The bilinear samples of the two nearest
    levels are mixed by it (LINEAR_MIPMAP_LINEAR), color and alpha apart, and what comes out is tested or blended. Beyond the atlas its
    outermost texels go on.

    A pixel shows a card if its center lies in the polygon. Layers are ordered by depth in every pixel, as in
    :func:`~bbfit.operators.drawing.compositing.composite`. A plane shows nothing edge-on and behind the camera.

    Parameters
    ----------
    cards : polygons, their atlas, and their mip levels; there need not be all down to one texel. Without any, the atlas is filtered
        bilinearly at every distance (sampler LINEAR).
    camera : one camera, or V of them.

    Returns
    -------
    Premultiplied RGBA over nothing in [0, 1], float32 [H, W, 4] for one camera and [V, H, W, 4] for a batch, on the CPU.

    Raises
    ------
    InputError
        if a level is not half the one before, rounded down, or not of bytes.
    """
    levels, sheets = joined([cards.atlas.image] if cards.chain is None else cards.chain, cards.atlas.image.shape), sheets_of(cards)
    cameras = camera.batch()
    with torch.no_grad():
        image = torch.stack([_view(cards, sheets, levels, cameras[index]) for index in range(len(cameras))])
    return image if camera.batched else image[0]


def joined(chain: Sequence[NDArray[np.uint8]], shape: tuple[int, ...]) -> MipChain:
    """Mip levels in one list.

    Parameters
    ----------
    chain : uint8 [h, w, C] each, level 0 first.
    shape : that of level 0.

    Raises
    ------
    InputError
        if a level is not half the one before, rounded down, or not of bytes.
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


def sheets_of(cards: Cards) -> list[Sheet]:
    """The planes that cards are parts of, in the order of their first cards; a card without an area shows nothing."""
    sheets: list[Sheet] = []
    areas = cards.atlas.sizes.prod(-1)
    for card in cards.cards:
        if area(card.uvs) == 0:
            continue
        for sheet in sheets:
            one = sheet.pieces[0]
            if (one.rectangle, one.culled) == (card.rectangle, card.culled) and one.normal @ card.normal > 0:
                off = _homogeneous(card.uvs) @ sheet.to_world[:3].T - card.corners
                if abs(off).max() <= _SAME * abs(card.corners).max():
                    sheet.pieces.append(card)
                    break
        else:
            middle, center = card.uvs.mean(0), card.corners.mean(0)
            slopes = (np.linalg.pinv(card.uvs - middle) @ (card.corners - center)).T
            to_world = np.concatenate([np.column_stack([slopes, center - slopes @ middle]), [[0.0, 0.0, 1.0]]])
            sheets.append(Sheet([card], to_world, int(areas[: card.rectangle].sum())))
    return sheets


def hits(cards: Cards, sheet: Sheet, camera: Camera) -> Hits:
    """What a single camera sees of one of the cards' sheets, whatever its alpha."""
    camera = camera.to("cpu").to(torch.float64)
    to_world = torch.from_numpy(sheet.to_world)
    to_pixel, to_depth = camera.world_to_pixel @ to_world, camera.world_to_camera[2] @ to_world
    shown = _faces(sheet, camera)
    # [u, v, 1] / depth for a pinhole, [u, v, 1] for parallel projection, from a pixel [x, y, 1]
    to_uv = torch.linalg.inv(to_pixel) if shown else torch.eye(3, dtype=torch.float64)
    free = torch.full((camera.height, camera.width), shown)
    found = [_hits(piece, camera, to_uv, to_depth, free) for piece in (sheet.pieces if shown else sheet.pieces[:1])]
    x, y, u, v, scale, depth = (torch.cat(parts) for parts in zip(*found, strict=True))
    uv = torch.stack([u, v], -1)
    # d(a / c) = (da - (a / c) dc) / c, in x and in y
    size = torch.tensor(cards.atlas.image.shape[1::-1], dtype=torch.float64)
    rates = [((to_uv[:2, axis] - uv * to_uv[2, axis]) * size).norm(dim=-1) for axis in (0, 1)]
    return Hits(x, y, uv, (torch.maximum(*rates) / scale.abs()).log2(), depth)


def filtered(levels: MipChain, uv: Tensor, detail: Tensor) -> Tensor:
    """Trilinear samples in [0, 255] at points [M, 2] by level of detail [M]: float32 [M, C]."""
    detail = detail.clamp(0, len(levels.starts) - 1)
    level = detail.long()
    share = (detail - level).float()
    found = _bilinear(levels, uv, level)
    mixed = share > 0
    further = _bilinear(levels, uv[mixed], level[mixed] + 1)
    found[mixed] += (further - found[mixed]) * share[mixed, None]
    return found


def _bilinear(levels: MipChain, uv: Tensor, level: Tensor) -> Tensor:
    """Samples at points [M, 2] of levels int64 [M], clamped to the edge: float32 [M, C]."""
    width, height = levels.widths[level], levels.heights[level]
    x, y = (uv[:, 0] * width - 0.5).clamp_min(0), (uv[:, 1] * height - 0.5).clamp_min(0)
    left, top = torch.minimum(x.long(), width - 1), torch.minimum(y.long(), height - 1)
    right, down = (left + 1 < width).long(), (top + 1 < height).long() * width
    x, y = (x - left).float()[:, None], (y - top).float()[:, None]  # beyond the last texel both neighbors are that one
    start = levels.starts[level] + top * width + left
    a, b, c, d = (levels.texels[start + step].float() for step in (0, right, down, down + right))
    # So written, equal texels give their own value exactly, whatever the weights: alpha at the cutoff stays there.
    upper, lower = a + (b - a) * x, c + (d - c) * x
    return upper + (lower - upper) * y


def _view(cards: Cards, sheets: list[Sheet], levels: MipChain, camera: Camera) -> Tensor:
    """One camera's picture, [H, W, 4]."""
    height, width = camera.height, camera.width
    colors, alphas, depths = [], [], []
    for sheet in sheets:
        met = hits(cards, sheet, camera)
        straight = filtered(levels, met.uv, met.detail) / 255
        if cards.alpha.kind == "hash":
            straight[:, 3] = (straight[:, 3] >= thresholds(met.x, met.y, sheet.first)).to(straight)
        else:
            straight[:, 3] = opacity(straight[:, 3], cards.alpha)
        if (straight[:, 3] > 0).any():
            layer, depth = torch.zeros(4, height, width), torch.full((height, width), torch.inf)
            layer[:, met.y, met.x] = straight.mT
            depth[met.y, met.x] = met.depth.float()
            colors.append(layer[None, :3])
            alphas.append(layer[None, 3:])
            depths.append(depth[None, None])
    return composite(colors, alphas, depths)[0].permute(1, 2, 0) if colors else torch.zeros(height, width, 4)


def _faces(sheet: Sheet, camera: Camera) -> bool:
    """Whether the camera sees the plane from a side that is shown, and not edge-on."""
    normal = torch.from_numpy(sheet.pieces[0].normal)
    towards = camera.position - torch.from_numpy(np.concatenate([piece.corners for piece in sheet.pieces]).mean(0))
    if camera.orthographic:
        towards = -camera.forward
    distance = float(towards @ normal)
    return abs(distance) > EDGE_ON * float(towards.norm()) and (distance > 0 or not sheet.pieces[0].culled)


def _hits(piece: Card, camera: Camera, to_uv: Tensor, to_depth: Tensor, free: Tensor) -> tuple[Tensor, ...]:
    """Pixels in which rays meet a piece: x, y, u, v, the third coordinate and the depth there, [M] each.

    Only those count that are ``free``, bool [H, W], which they are not any more.
    """
    low, high = torch.zeros(2, dtype=torch.int64), torch.tensor([camera.width, camera.height])
    corners = torch.from_numpy(_homogeneous(piece.corners)) @ camera.world_to_pixel.mT
    if bool((corners[:, 2] > 1e-9).all()):  # else the piece is not wholly before the camera, and reaches who knows where
        at = corners[:, :2] / corners[:, 2:]
        low, high = (torch.minimum(edge.clamp_min(0), high.double()).long() for edge in (at.amin(0).floor(), at.amax(0).floor() + 2))
    y, x = torch.meshgrid(torch.arange(int(low[1]), int(high[1])), torch.arange(int(low[0]), int(high[0])), indexing="ij")
    x, y = x.flatten(), y.flatten()
    u, v, scale = (row[0] * x + row[1] * y + row[2] for row in to_uv)
    u, v = u / scale, v / scale
    depth = to_depth[0] * u + to_depth[1] * v + to_depth[2]
    met = free[y, x] & (depth > 0) & depth.isfinite()
    for (along_u, along_v), offset in zip(*sides(piece.uvs), strict=True):
        met &= u * float(along_u) + v * float(along_v) <= float(offset) + _SLACK
    free[y[met], x[met]] = False
    return x[met], y[met], u[met], v[met], scale[met], depth[met]


def _homogeneous(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([points, np.ones(len(points))])
