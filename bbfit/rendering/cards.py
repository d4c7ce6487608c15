"""Renderer of exported cards: what a graphics card shows, with bilinear or trilinear filtering and the alpha mode.

Unlike the renderer of clouds it knows what files add: 8-bit textures, polygons smaller than their rectangles, culling, mip levels. It does
not model that graphics cards round the level of detail and the filter weights to about 8 bits, and that they compute derivatives from
differences between neighboring pixels.
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
from bbfit.operators.drawing.compositing import composite_fragments, coverage, opacity, thresholds
from bbfit.operators.drawing.reference import EDGE_ON

# Distance outside a polygon, as a share of the atlas, at which a pixel's center still counts as inside, so that rounding opens no seams.
_SLACK = 1e-9
# Relative error of corners up to which a card belongs to a sheet.
_SAME = 1e-6


@dataclass(frozen=True)
class Sheet:
    """Cards that are disjoint parts of one textured plane; a ray meets at most one of them."""

    pieces: list[Card]
    """At least one card."""
    to_world: NDArray[np.float64]
    """From (u, v, 1) to homogeneous world points, [4, 3]."""
    first: int
    """Index of its texture's first texel among the texels of all textures, which seeds the mode ``hash``."""


@dataclass(frozen=True)
class Hits:
    """The M pixels of a camera whose rays meet a sheet on a side that is shown."""

    x: Tensor
    """Columns, int64 [M]; no pixel occurs twice."""
    y: Tensor
    """Rows, int64 [M]."""
    uv: Tensor
    """Texture coordinates, float64 [M, 2]."""
    detail: Tensor
    """Level of detail, float64 [M]; negative where texels are magnified."""
    depth: Tensor
    """Depth in meters, float64 [M]."""
    to_uv: Tensor
    """From a pixel (x, y, 1) to homogeneous texture coordinates, [3, 3]."""


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


def draw_cards(cards: Cards, camera: Camera) -> Tensor:
    """Draw cards on the CPU as a graphics card does, with one sample per pixel: premultiplied RGBA in [0, 1], float32 [H, W, 4] for one
    camera and [V, H, W, 4] for a batch.

    Without mip levels, and for cards that show their whole rectangles, the picture equals that of :func:`~bbfit.rendering.dispatch.render`
    up to the rounding of textures to 8 bits. Filtering and blending use display-referred values, as fits do. Programs that filter in linear
    light show slightly lighter colors and the same alpha.

    With mip levels the level of detail is log2 of the larger norm of the texel coordinates' derivatives along the screen's two axes (OpenGL
    4.6, section 8.14.1), exact for every pixel and clamped to the existing levels. The bilinear samples of the two nearest levels are
    interpolated (LINEAR_MIPMAP_LINEAR), straight color and alpha separately, and the result is tested or blended. Beyond its border the
    atlas is clamped.

    A pixel shows a card if its center lies in the polygon. Layers are ordered by depth in every pixel, as in
    :func:`~bbfit.operators.drawing.compositing.composite`. A plane shows nothing edge-on and behind the camera.

    Parameters
    ----------
    cards
        Polygons, their atlas and their mip levels, which need not reach down to one texel. Without levels the atlas is filtered bilinearly
        at every distance (sampler LINEAR).
    camera
        One camera or V cameras.

    Raises
    ------
    InputError
        If a level is not uint8 or not half as large as the level before, rounded down.
    """
    levels, sheets = joined([cards.atlas.image] if cards.chain is None else cards.chain, cards.atlas.image.shape), sheets_of(cards)
    cameras = camera.batch()
    with torch.no_grad():
        image = torch.stack([_view(cards, sheets, levels, cameras[index]) for index in range(len(cameras))])
    return image if camera.batched else image[0]


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


def sheets_of(cards: Cards) -> list[Sheet]:
    """The textured planes of cards, in the order of their first cards; cards without an area are left out."""
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
    """The pixels in which a single camera meets one of the cards' sheets, whatever its alpha."""
    camera = camera.to("cpu").to(torch.float64)
    to_world = torch.from_numpy(sheet.to_world)
    to_pixel, to_depth = camera.world_to_pixel @ to_world, camera.world_to_camera[2] @ to_world
    shown = _faces(sheet, camera)
    # [u, v, 1] / depth for a pinhole, [u, v, 1] for parallel projection, from a pixel [x, y, 1]
    to_uv = torch.linalg.inv(to_pixel) if shown else torch.eye(3, dtype=torch.float64)
    free = torch.full((camera.height, camera.width), shown)
    parts = [_hits(piece, camera, to_uv, to_depth, free) for piece in (sheet.pieces if shown else sheet.pieces[:1])]
    x, y, u, v, scale, depth = (torch.cat(column) for column in zip(*parts, strict=True))
    uv = torch.stack([u, v], -1)
    # d(a / c) = (da - (a / c) dc) / c, in x and in y
    size = torch.tensor(cards.atlas.image.shape[1::-1], dtype=torch.float64)
    rates = [((to_uv[:2, axis] - uv * to_uv[2, axis]) * size).norm(dim=-1) for axis in (0, 1)]
    return Hits(x, y, uv, (torch.maximum(*rates) / scale.abs()).log2(), depth, to_uv)


def fragments(cards: Cards, camera: Camera) -> int:
    """How many fragments a graphics card shades for a single camera: the pixel centers inside the polygons of all layers.

    Parts behind the camera and culled sides do not count. Early depth tests, which may save some, are not assumed: an alpha test prevents
    them. The further pixels of 2 x 2 blocks that only serve derivatives are left out.
    """
    return sum(len(hits(cards, sheet, camera).x) for sheet in sheets_of(cards))


def filtered(levels: MipChain, uv: Tensor, detail: Tensor) -> Tensor:
    """Trilinear samples in [0, 255] at points [M, 2] by level of detail [M]: float32 [M, C]."""
    detail = detail.clamp(0, len(levels.starts) - 1)
    level = detail.long()
    share = (detail - level).float()
    sample = _bilinear(levels, uv, level)
    mixed = share > 0
    coarser = _bilinear(levels, uv[mixed], level[mixed] + 1)
    sample[mixed] += (coarser - sample[mixed]) * share[mixed, None]
    return sample


def _bilinear(levels: MipChain, uv: Tensor, level: Tensor) -> Tensor:
    """Samples at points [M, 2] of levels int64 [M], clamped to the edge: float32 [M, C]."""
    width, height = levels.widths[level], levels.heights[level]
    x, y = (uv[:, 0] * width - 0.5).clamp_min(0), (uv[:, 1] * height - 0.5).clamp_min(0)
    left, top = torch.minimum(x.long(), width - 1), torch.minimum(y.long(), height - 1)
    right, down = (left + 1 < width).long(), (top + 1 < height).long() * width
    x, y = (x - left).float()[:, None], (y - top).float()[:, None]  # beyond the last texel both neighbors are that one
    start = levels.starts[level] + top * width + left
    a, b, c, d = (levels.texels[start + step].float() for step in (0, right, down, down + right))
    # In this form equal texels give their own value exactly, whatever the weights: alpha at the cutoff stays at the cutoff.
    upper, lower = a + (b - a) * x, c + (d - c) * x
    return upper + (lower - upper) * y


def _view(cards: Cards, sheets: list[Sheet], levels: MipChain, camera: Camera) -> Tensor:
    """Picture of a single camera, [H, W, 4]."""
    count = camera.height * camera.width
    met = [hits(cards, sheet, camera) for sheet in sheets]
    straight = filtered(levels, torch.cat([each.uv for each in met]), detail := torch.cat([each.detail for each in met])) / 255
    colors, alphas = straight[:, :3], straight[:, 3]
    if cards.alpha.kind == "hash":
        drawn = torch.cat([thresholds(each.x, each.y, sheet.first) for each, sheet in zip(met, sheets, strict=True)])
        alphas = (alphas >= drawn).to(alphas)
    elif cards.alpha.antialiased:
        beside = (torch.cat(places) for places in zip(*map(_beside, met), strict=True))
        across, down = ((filtered(levels, uv, detail)[:, 3] / 255 - alphas).abs() for uv in beside)
        alphas = coverage(alphas, across + down, cards.alpha)
    else:
        alphas = opacity(alphas, cards.alpha)
    pixels, depths = torch.cat([each.y * camera.width + each.x for each in met]), torch.cat([each.depth for each in met])
    shown = alphas > 0
    image = composite_fragments(colors[shown], alphas[shown], depths[shown], pixels[shown], count, nested=cards.alpha.antialiased)
    return image.unflatten(0, (camera.height, camera.width))


def _beside(met: Hits) -> list[Tensor]:
    """Texture coordinates, [M, 2], at the other pixel of each hit's row and at that of its column in its square of 2 x 2 pixels."""
    places = [(met.x ^ 1, met.y), (met.x, met.y ^ 1)]
    rows = [torch.stack([row[0] * x + row[1] * y + row[2] for row in met.to_uv], -1) for x, y in places]
    return [row[:, :2] / row[:, 2:] for row in rows]


def _faces(sheet: Sheet, camera: Camera) -> bool:
    """Whether the camera sees a side of the plane that is shown, and not edge-on."""
    normal = torch.from_numpy(sheet.pieces[0].normal)
    towards = camera.position - torch.from_numpy(np.concatenate([piece.corners for piece in sheet.pieces]).mean(0))
    if camera.orthographic:
        towards = -camera.forward
    distance = float(towards @ normal)
    return abs(distance) > EDGE_ON * float(towards.norm()) and (distance > 0 or not sheet.pieces[0].culled)


def _hits(piece: Card, camera: Camera, to_uv: Tensor, to_depth: Tensor, free: Tensor) -> tuple[Tensor, ...]:
    """The ``free`` pixels, bool [H, W], whose rays meet a piece, which then are not free: x, y, u, v, the third homogeneous coordinate
    and the depth, [M] each."""
    low, high = torch.zeros(2, dtype=torch.int64), torch.tensor([camera.width, camera.height])
    corners = torch.from_numpy(_homogeneous(piece.corners)) @ camera.world_to_pixel.mT
    if bool((corners[:, 2] > 1e-9).all()):  # otherwise a part is behind the camera, and the corners bound nothing
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
