"""Renderer of exported cards: what a graphics card shows, with bilinear or trilinear filtering and the alpha mode.

Unlike the renderer of clouds it knows what files add: 8-bit textures, polygons smaller than their rectangles, culling, mip levels. It does
not model that graphics cards round the level of detail and the filter weights to about 8 bits, and that they compute derivatives from
differences between neighboring pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.checks import fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Card, Cards, texture_axes
from bbfit.geometry.light import Light
from bbfit.geometry.polygons import area, sides
from bbfit.operators.drawing.compositing import composite_fragments, coverage, opacity, thresholds
from bbfit.operators.drawing.reference import EDGE_ON
from bbfit.operators.shading.reference import decode, encode
from bbfit.rendering.sampling import MipChain, filtered, joined

# Distance outside a polygon, as a share of the atlas, at which a pixel's center still counts as inside, so that rounding opens no seams.
_SLACK = 1e-9
# Relative error of corners up to which a card belongs to a sheet.
_SAME = 1e-6
# Most pixels that are compared with polygons at once, and of cameras that are drawn together.
_AT_ONCE, _TOGETHER = 1 << 21, 1 << 18


@dataclass(frozen=True)
class Sheets:
    """The S textured planes of cards, and their Q pieces: convex parts of a plane of which a ray meets at most one.

    Coordinates are float64. Corners and sides are padded to K by repetition.
    """

    to_world: Tensor
    """From (u, v, 1) to homogeneous world points, [S, 4, 3]."""
    normals: Tensor
    """[S, 3]."""
    centers: Tensor
    """Mean of the corners, [S, 3]."""
    axes: Tensor
    """Axes of the normals in a texture, in the world: right, up, and towards the visible side, [S, 3, 3]. NaN for cards without maps."""
    culled: Tensor
    """Whether only the front is drawn, bool [S]."""
    first: Tensor
    """Index of a texture's first texel among the texels of all textures, which seeds the mode ``hash``, int64 [S]."""
    of_piece: Tensor
    """The plane of each piece, int64 [Q]. Pieces of a plane keep the order of the cards."""
    corners: Tensor
    """Homogeneous, [Q, K, 4]."""
    sides: Tensor
    """Coefficients (a, b, c) with a u + b v <= c inside, [Q, K, 3]."""

    def __len__(self) -> int:
        """The number S of planes."""
        return len(self.first)


@dataclass(frozen=True)
class Hits:
    """The M places where the rays of the pixels of V cameras meet S sheets on a side that is shown."""

    view: Tensor
    """Which camera, int64 [M], ascending."""
    sheet: Tensor
    """Which sheet, int64 [M], ascending for each camera."""
    x: Tensor
    """Columns, int64 [M]; no pixel of a sheet occurs twice."""
    y: Tensor
    """Rows, int64 [M]."""
    uv: Tensor
    """Texture coordinates, float64 [M, 2]."""
    detail: Tensor
    """Level of detail, float64 [M]; negative where texels are magnified."""
    depth: Tensor
    """Depth in meters, float64 [M]."""
    to_uv: Tensor
    """From a pixel (x, y, 1) to homogeneous texture coordinates of each sheet in each camera, [V, S, 3, 3]."""


def draw_cards(cards: Cards, camera: Camera, light: Light | None = None) -> Tensor:
    """Draw cards on the CPU as a graphics card does, with one sample per pixel: premultiplied RGBA in [0, 1], float32 [H, W, 4] for one
    camera and [V, H, W, 4] for a batch.

    Without mip levels, and for cards that show their whole rectangles, the picture equals that of :func:`~bbfit.rendering.dispatch.render`
    up to the rounding of textures to 8 bits. Filtering and blending use display-referred values, as fits do. Programs that filter in linear
    light show slightly lighter colors and the same alpha.

    With mip levels the level of detail is log2 of the larger norm of the texel coordinates' derivatives along the screen's two axes (OpenGL
    4.6, section 8.14.1), exact for every pixel and clamped to the existing levels. The bilinear samples of the two nearest levels are
    interpolated (LINEAR_MIPMAP_LINEAR), straight color and alpha separately, and the result is tested or blended. Beyond its border the
    atlas is clamped.

    Cards with maps are shaded after filtering, per pixel, as graphics cards do (:mod:`bbfit.operators.shading` shades texels instead), or
    as a path tracer does (``cards.traced``). From behind, a card that shows both sides has opposite normals.

    A pixel shows a card if its center lies in the polygon. Layers are ordered by depth in every pixel, as in
    :func:`~bbfit.operators.drawing.compositing.composite`. A plane shows nothing edge-on and behind the camera.

    Parameters
    ----------
    cards
        Polygons, their atlas and their mip levels, which need not reach down to one texel. Without levels the atlas is filtered bilinearly
        at every distance (sampler LINEAR).
    camera
        One camera or V cameras.
    light
        For cards with maps: the light of each view, or one for all. Default: ``cards.light``.

    Raises
    ------
    InputError
        If a level is not uint8 or not half as large as the level before, rounded down.
    """
    return CardRenderer(cards).draw(camera, light)


class CardRenderer:
    """Draws cards as :func:`draw_cards` does, for many cameras: what does not depend on the camera is computed once."""

    def __init__(self, cards: Cards) -> None:
        self._cards, self._sheets = cards, sheets_of(cards)
        self._levels = _levels(cards)

    def draw(self, camera: Camera, light: Light | None = None) -> Tensor:
        """See :func:`draw_cards`."""
        cameras, light = camera.batch(), self._cards.light if light is None else light
        if light is not None and self._cards.atlas.surface is None:
            fail("light", "the light of these cards is in their textures", "leave it out")
        together = max(1, _TOGETHER // (cameras.width * cameras.height)) if light is None else 1
        with torch.no_grad():
            pictures = []
            for index in range(0, len(cameras), together):
                some = cameras[index : index + together]
                met, straight = self._shown(some)
                colors = straight[:, :3]
                if light is not None:
                    own, axes = light[[index if len(light) > 1 else 0]], _axes(self._sheets, some[0])[met.sheet]
                    colors = _lit(colors, straight[:, 4:], axes, own, traced=self._cards.traced)
                pictures.append(self._composited(colors, straight[:, 3], met, some))
            image = torch.cat(pictures)
        return image if camera.batched else image[0]

    def surfaces(self, camera: Camera) -> Tensor:
        """What the surfaces are that cards with maps show to a single camera, without light: premultiplied base color, display-referred,
        premultiplied normals in the world, and alpha, float32 [H, W, 7]."""
        with torch.no_grad():
            met, straight = self._shown(camera)
            normals = normalize(2 * straight[:, 4:7] - 1, dim=-1)
            in_world = (normals[:, None] @ _axes(self._sheets, camera)[met.sheet].float())[:, 0]
            return self._composited(torch.cat([straight[:, :3], in_world], -1), straight[:, 3], met, camera.batch())[0]

    def _shown(self, camera: Camera) -> tuple[Hits, Tensor]:
        """The places that cameras see, and the filtered values of the atlas there, [M, C]."""
        met = hits(self._cards, self._sheets, camera)
        return met, filtered(self._levels, met.uv, met.detail) / 255

    def _composited(self, values: Tensor, alphas: Tensor, met: Hits, camera: Camera) -> Tensor:
        """The pictures of places with values [M, C] and alpha [M] in V cameras, [V, H, W, C + 1]."""
        alpha = self._cards.alpha
        if alpha.kind == "hash":
            alphas = (alphas >= thresholds(met.x, met.y, self._sheets.first[met.sheet])).to(alphas)
        elif alpha.antialiased:
            across, down = ((filtered(self._levels, uv, met.detail)[:, 3] / 255 - alphas).abs() for uv in _beside(met))
            alphas = coverage(alphas, across + down, alpha)
        else:
            alphas = opacity(alphas, alpha)
        shape = len(camera), camera.height, camera.width
        shown, pixels, count = alphas > 0, (met.view * camera.height + met.y) * camera.width + met.x, math.prod(shape)
        image = composite_fragments(values[shown], alphas[shown], met.depth[shown], pixels[shown], count, nested=alpha.nested)
        return image.unflatten(0, shape)

    def fragments(self, camera: Camera) -> int:
        """How many fragments a graphics card shades for a single camera: the pixel centers inside the polygons of all layers.

        Parts behind the camera and culled sides do not count. Early depth tests, which may save some, are not assumed: an alpha test
        prevents them. The further pixels of 2 x 2 blocks that only serve derivatives are left out.
        """
        return len(hits(self._cards, self._sheets, camera).x)


def _levels(cards: Cards) -> MipChain:
    """The levels of the atlas; those of its surface are channels 4 and up."""
    chain: Sequence[NDArray[np.uint8]] = [cards.atlas.image] if cards.chain is None else cards.chain
    if cards.atlas.surface is not None:
        surfaces = [cards.atlas.surface] if cards.surface_chain is None else cards.surface_chain
        chain = [np.concatenate(level, -1) for level in zip(chain, surfaces, strict=True)]
    return joined(chain, (*cards.atlas.image.shape[:2], chain[0].shape[-1] if chain else 4))


def sheets_of(cards: Cards) -> Sheets:
    """The textured planes of cards, in the order of their first cards; cards without an area are left out."""
    planes: list[tuple[list[Card], NDArray[np.float64]]] = []
    known, of_piece, pieces = dict[tuple[int, bool], list[int]](), list[int](), list[Card]()
    for card in cards.cards:
        if area(card.uvs) == 0:
            continue
        numbers = known.setdefault((card.rectangle, card.culled), [])
        number = next((number for number in numbers if _lies_in(card, *planes[number])), len(planes))
        if number == len(planes):
            middle, center = card.uvs.mean(0), card.corners.mean(0)
            slopes = (np.linalg.pinv(card.uvs - middle) @ (card.corners - center)).T
            planes.append(([], np.concatenate([np.column_stack([slopes, center - slopes @ middle]), [[0.0, 0.0, 1.0]]])))
            numbers.append(number)
        planes[number][0].append(card)
        of_piece.append(number)
        pieces.append(card)
    starts, ones = np.concatenate([[0], cards.atlas.sizes.prod(-1).cumsum()]), [own[0] for own, _ in planes]
    return Sheets(
        torch.from_numpy(np.array([to_world for _, to_world in planes], np.float64).reshape(-1, 4, 3)),
        _rows([one.normal for one in ones], 3),
        _rows([np.concatenate([card.corners for card in own]).mean(0) for own, _ in planes], 3),
        torch.from_numpy(np.array([texture_axes(one) for one in ones], np.float64).reshape(-1, 3, 3)),
        torch.tensor([one.culled for one in ones], dtype=torch.bool),
        torch.tensor([int(starts[one.rectangle]) for one in ones], dtype=torch.int64),
        torch.tensor(of_piece, dtype=torch.int64),
        _padded([_homogeneous(card.corners) for card in pieces], 4),
        _padded([np.column_stack(sides(card.uvs)) for card in pieces], 3),
    )


def _lies_in(card: Card, own: list[Card], to_world: NDArray[np.float64]) -> bool:
    """Whether a card lies in the plane of other cards of its texture, and shows its part of the texture."""
    off = _homogeneous(card.uvs) @ to_world[:3].T - card.corners
    return bool(own[0].normal @ card.normal > 0 and abs(off).max() <= _SAME * abs(card.corners).max())


def _rows(vectors: list[NDArray[np.float64]], width: int) -> Tensor:
    return torch.from_numpy(np.array(vectors, np.float64).reshape(-1, width))


def _padded(arrays: list[NDArray[np.float64]], width: int) -> Tensor:
    """Arrays [k, width] with their last rows repeated, [Q, K, width]."""
    longest = max(map(len, arrays), default=1)
    padded = [np.pad(array, ((0, longest - len(array)), (0, 0)), "edge") for array in arrays]
    return torch.from_numpy(np.array(padded, np.float64).reshape(-1, longest, width))


def hits(cards: Cards, sheets: Sheets, camera: Camera) -> Hits:
    """The pixels in which one camera or V cameras meet the cards' sheets, whatever their alpha."""
    camera = camera.batch().to("cpu").to(torch.float64)
    to_pixel = camera.world_to_pixel[:, None] @ sheets.to_world
    to_depth = (camera.world_to_camera[:, None, 2:3] @ sheets.to_world)[..., 0, :]
    shown = torch.stack([_faced(sheets, camera[view]) for view in range(len(camera))])
    # [u, v, 1] / depth for a pinhole, [u, v, 1] for parallel projection, from a pixel [x, y, 1]
    to_uv = torch.linalg.inv(torch.where(shown[..., None, None], to_pixel, torch.eye(3).double()))
    boxes = zip(*(_boxes(sheets, camera[view], shown[view]) for view in range(len(camera))), strict=True)
    low, high = (torch.cat(corners) for corners in boxes)  # from here on each camera has pieces and sheets of its own
    of_piece = (len(sheets) * torch.arange(len(camera))[:, None] + sheets.of_piece).flatten()
    own_to_uv, own_to_depth = to_uv.flatten(0, 1), to_depth.flatten(0, 1)
    extent, areas, found = high - low, (high - low).prod(-1), list[tuple[Tensor, ...]]()
    for some in torch.arange(len(areas)).split(_pieces_at_once(areas)):
        piece = some.repeat_interleave(areas[some])
        inside = torch.arange(len(piece)) - (areas[some].cumsum(0) - areas[some]).repeat_interleave(areas[some])
        x, y = low[piece, 0] + inside % extent[piece, 0], low[piece, 1] + inside // extent[piece, 0]
        sheet = of_piece[piece]
        u, v, scale = (own_to_uv[sheet, row, 0] * x + own_to_uv[sheet, row, 1] * y + own_to_uv[sheet, row, 2] for row in range(3))
        u, v = u / scale, v / scale
        depth = own_to_depth[sheet, 0] * u + own_to_depth[sheet, 1] * v + own_to_depth[sheet, 2]
        met = (depth > 0) & depth.isfinite()
        polygon = piece % max(1, len(sheets.of_piece))
        for along_u, along_v, offset in sheets.sides.permute(1, 2, 0):
            met &= u * along_u[polygon] + v * along_v[polygon] <= offset[polygon] + _SLACK
        found.append(tuple(values[met] for values in (sheet, x, y, u, v, scale, depth)))
    sheet, x, y, u, v, scale, depth = (torch.cat(values) for values in zip(*found, strict=True))
    # Where pieces of a sheet overlap, the first one shows.
    places, order = ((sheet * camera.height + y) * camera.width + x).sort(stable=True)
    first = torch.ones_like(places, dtype=torch.bool)
    first[1:] = places[1:] != places[:-1]
    sheet, x, y, u, v, scale, depth = (values[order[first]] for values in (sheet, x, y, u, v, scale, depth))
    uv = torch.stack([u, v], -1)
    # d(a / c) = (da - (a / c) dc) / c, in x and in y
    size = torch.tensor(cards.atlas.image.shape[1::-1], dtype=torch.float64)
    rates = [((own_to_uv[sheet, :2, axis] - uv * own_to_uv[sheet, 2, axis, None]) * size).norm(dim=-1) for axis in (0, 1)]
    detail = (torch.maximum(*rates) / scale.abs()).log2()
    count = max(1, len(sheets))
    return Hits(sheet // count, sheet % count, x, y, uv, detail, depth, to_uv)


def _lit(colors: Tensor, maps: Tensor, axes: Tensor, light: Light, *, traced: bool) -> Tensor:
    """Shade base colors of fragments, [M, 3], given their filtered maps, [M, 4 or 5], and the axes of the normals, [M, 3, 3].

    The formula is that of :func:`~bbfit.operators.shading.reference.shade_reference`. ``traced`` light comes from the visible side of
    the plane only: no sun from behind it, and of an even sky the share (1 + cos a) / 2 where the normal leans by the angle a.
    """
    normals = normalize(2 * maps[:, :3] - 1, dim=-1)
    towards, open_sky, translucency = (axes @ light.sun_directions[0]).float(), maps[:, 3:4], maps[:, 4:] if maps.shape[1] > 4 else 0
    cosine = (normals * towards).sum(-1, keepdim=True)
    of_sun = (1 - translucency) * cosine.clamp_min(0) + translucency * (-cosine).clamp_min(0)
    if traced:
        of_sun, open_sky = of_sun * (towards[:, 2:] > 0), (1 + normals[:, 2:]) / 2
    sun = (light.sun_colors[0] * light.sun_strengths / math.pi).float()
    return encode(decode(colors) * (of_sun * sun + float(light.ambients) * open_sky)).clamp_max(1)


def _beside(met: Hits) -> list[Tensor]:
    """Texture coordinates, [M, 2], at the other pixel of each hit's row and at that of its column in its square of 2 x 2 pixels."""
    rows = met.to_uv[met.view, met.sheet]
    places = [torch.stack([x, y, torch.ones_like(x)], -1).double() for x, y in ((met.x ^ 1, met.y), (met.x, met.y ^ 1))]
    found = [(rows @ place[:, :, None])[..., 0] for place in places]
    return [place[:, :2] / place[:, 2:] for place in found]


def _axes(sheets: Sheets, camera: Camera) -> Tensor:
    """The axes of the normals of each plane as a single camera sees them, [S, 3, 3]: from behind, those of both sides turn."""
    behind = (_distances(sheets, camera.to("cpu").to(torch.float64))[0] < 0) & ~sheets.culled
    return torch.where(behind[:, None, None], -sheets.axes, sheets.axes)


def _faced(sheets: Sheets, camera: Camera) -> Tensor:
    """Whether the camera sees a side of each plane that is shown, and not edge-on, bool [S]."""
    distance, farthest = _distances(sheets, camera)
    return (distance.abs() > EDGE_ON * farthest) & ((distance > 0) | ~sheets.culled)


def _distances(sheets: Sheets, camera: Camera) -> tuple[Tensor, Tensor]:
    """How far the camera is in front of each plane (negative: behind it), and how far from its center, [S] each."""
    towards = -camera.forward.expand(len(sheets), 3) if camera.orthographic else camera.position - sheets.centers
    return (towards * sheets.normals).sum(-1), towards.norm(dim=-1)


def _boxes(sheets: Sheets, camera: Camera, shown: Tensor) -> tuple[Tensor, Tensor]:
    """The first pixel of the box around each piece, and that after the last, x and y, int64 [Q, 2] each; empty for what is not shown."""
    corners = sheets.corners @ camera.world_to_pixel.mT
    bounded = (corners[..., 2] > 1e-9).all(-1, keepdim=True)  # otherwise a part is behind the camera, and the corners bound nothing
    at, size = corners[..., :2] / corners[..., 2:], torch.tensor([camera.width, camera.height], dtype=torch.float64)
    low, high = (torch.minimum(edge.clamp_min(0), size) for edge in (at.amin(1).floor(), at.amax(1).floor() + 2))
    low, high = torch.where(bounded, low, 0), torch.where(bounded, high, size)
    return low.long(), torch.where(shown[sheets.of_piece, None], torch.maximum(low, high), low).long()


def _pieces_at_once(areas: Tensor) -> list[int]:
    """Numbers of consecutive pieces with at most :data:`_AT_ONCE` pixels in their boxes together, or single ones."""
    counts, total = [0], 0
    for pixels in areas.tolist():
        if total + pixels > _AT_ONCE and counts[-1]:
            counts, total = [*counts, 0], 0
        counts[-1], total = counts[-1] + 1, total + pixels
    return counts


def _homogeneous(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([points, np.ones(len(points))])
