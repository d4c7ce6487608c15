"""Drawing of cards in torch: what graphics cards show with bilinear or trilinear filtering."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.light import Light
from bbfit.operators.cards.sampling import MipChain, filtered
from bbfit.operators.cards.sheets import CENTER, SAMPLES, SLACK, PreparedCards, Sheets, seen_axes, seen_sheets
from bbfit.operators.drawing.compositing import composite_fragments, coverage, covered_samples, opacity, thresholds
from bbfit.operators.shading.reference import decode, encode

Sampler = Callable[[MipChain, Tensor, Tensor], Tensor]
"""As :func:`~bbfit.operators.cards.sampling.filtered`."""
# Most pixels that are compared with polygons at once, and of cameras that are drawn together.
_AT_ONCE, _TOGETHER = 1 << 21, 1 << 18


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
    covered: Tensor
    """Which of the pixel's samples lie in the polygons of the sheet, bool [M, 1 or 4]; at least one does."""
    to_uv: Tensor
    """From a pixel (x, y, 1) to homogeneous texture coordinates of each sheet in each camera, [V, S, 3, 3]."""


def draw_cards_reference(prepared: PreparedCards, camera: Camera, light: Light | None = None) -> Tensor:
    """Draw cards for V cameras: premultiplied RGBA in [0, 1], float32 [V, H, W, 4], as :func:`~bbfit.rendering.cards.draw_cards`.

    ``light``, for cards with maps, is that of each view, or one for all. Without it they show their base color.
    """
    return draw_cards_by(filtered, prepared, camera, light)


def draw_cards_by(sample: Sampler, prepared: PreparedCards, camera: Camera, light: Light | None = None) -> Tensor:
    """:func:`draw_cards_reference` as a program draws that reads textures by ``sample``."""
    together = 1 if light is not None else max(1, _TOGETHER // (camera.width * camera.height))
    pictures = list[Tensor]()
    for index in range(0, len(camera), together):
        some = camera[index : index + together]
        met, straight = shown(prepared, some, sample)
        colors = straight[:, :3]
        if light is not None:
            axes, own = seen_axes(prepared.sheets, some)[0, met.sheet], light[[index if len(light) > 1 else 0]]
            colors = _lit(colors, straight[:, 4:], axes, own, traced=prepared.cards.traced)
        pictures.append(composited(colors, straight[:, 3], met, prepared, some))
    return torch.cat(pictures)


def shown(prepared: PreparedCards, camera: Camera, sample: Sampler = filtered) -> tuple[Hits, Tensor]:
    """The places that cameras see, and the filtered values of the atlas there, [M, C]."""
    met = hits(prepared.cards, prepared.sheets, camera, multisampled=prepared.multisampled)
    return met, sample(prepared.levels, met.uv, met.detail) / 255


def composited(values: Tensor, alphas: Tensor, met: Hits, prepared: PreparedCards, camera: Camera) -> Tensor:
    """The pictures of places with values [M, C] and alpha [M] in V cameras, [V, H, W, C + 1]."""
    mode = prepared.cards.alpha
    if mode.kind == "hash":
        shown = (alphas >= thresholds(met.x, met.y, prepared.sheets.first[met.sheet])).to(alphas)[:, None]
    else:
        near = [filtered(prepared.levels, uv, met.detail)[:, 3] / 255 for uv in beside(met)] if mode.antialiased else []
        shown = opacities(alphas, near, met, mode)
    return pictures(values, shown, met, (len(camera), camera.height, camera.width), nested=mode.nested)


def opacities(alphas: Tensor, near: Sequence[Tensor], met: Hits, mode: AlphaMode) -> Tensor:
    """The opacities of hits with alpha [M], in all modes but hash: [M, 1], or [M, S] where samples of a pixel have their own.

    ``near`` is for an antialiased mask, alpha at the two places :func:`beside` each hit, [M] each.
    """
    if mode.antialiased:
        across, down = ((other - alphas).abs().detach() for other in near)
        return coverage(alphas, across + down, mode)[:, None]
    if mode.kind == "coverage" and mode.samples == met.covered.shape[1]:
        return covered_samples(alphas, mode.samples)
    return opacity(alphas, mode)[:, None]


def pictures(values: Tensor, opacities: Tensor, met: Hits, shape: tuple[int, int, int], *, nested: bool) -> Tensor:
    """The pictures of places with values [M, C] and opacities [M, 1 or S] in V cameras of H x W pixels, [V, H, W, C + 1].

    A pixel is the mean of its S samples, each of which has layers of its own. ``shape`` is V, H, W.
    """
    place, sample = (met.covered & (opacities > 0)).nonzero().unbind(-1)
    samples = met.covered.shape[1]
    pixels = ((met.view * shape[1] + met.y) * shape[2] + met.x)[place] * samples + sample
    fragments = values[place], opacities.expand(-1, samples)[place, sample], met.depth[place], pixels
    return composite_fragments(*fragments, math.prod(shape) * samples, nested=nested).unflatten(0, (*shape, samples)).mean(-2)


def hits(cards: Cards, sheets: Sheets, camera: Camera, *, multisampled: bool = False) -> Hits:
    """The pixels in which one camera or V cameras meet the cards' sheets, whatever their alpha.

    A pixel has one sample, its center, or, ``multisampled``, :data:`~bbfit.operators.cards.sheets.SAMPLES`. Texture coordinates and depth
    are those of the center, even if it lies outside the polygon, as graphics cards compute them (OpenGL 4.6, section 14.3.1).
    """
    samples = SAMPLES if multisampled else CENTER
    seen, views = seen_sheets(sheets, camera), len(camera.batch())
    low, high = seen.low.flatten(0, 1), seen.high.flatten(0, 1)  # from here on each camera has pieces and sheets of its own
    of_piece = (len(sheets) * torch.arange(views)[:, None] + sheets.of_piece).flatten()
    own_to_uv, own_to_depth = seen.to_uv.flatten(0, 1), seen.to_depth.flatten(0, 1)

    def within(polygon: Tensor, u: Tensor, v: Tensor) -> Tensor:
        kept = torch.ones_like(u, dtype=torch.bool)
        for along_u, along_v, offset in sheets.sides.permute(1, 2, 0):
            kept &= u * along_u[polygon] + v * along_v[polygon] <= offset[polygon] + SLACK
        return kept

    extent, areas, found = high - low, (high - low).prod(-1), list[tuple[Tensor, ...]]()
    for some in torch.arange(len(areas)).split(_pieces_at_once(areas)):
        piece = some.repeat_interleave(areas[some])
        inside = torch.arange(len(piece)) - (areas[some].cumsum(0) - areas[some]).repeat_interleave(areas[some])
        x, y = low[piece, 0] + inside % extent[piece, 0], low[piece, 1] + inside // extent[piece, 0]
        sheet = of_piece[piece]
        polygon, (u, v, scale) = piece % max(1, len(sheets.of_piece)), seen_at(own_to_uv[sheet], x, y)
        depth = own_to_depth[sheet, 0] * u + own_to_depth[sheet, 1] * v + own_to_depth[sheet, 2]
        covered = torch.stack([within(polygon, *seen_at(own_to_uv[sheet], x + right, y + down)[:2]) for right, down in samples], -1)
        met = covered.any(-1) & (depth > 0) & depth.isfinite()
        found.append(tuple(values[met] for values in (sheet, x, y, u, v, scale, depth, covered)))
    sheet, x, y, u, v, scale, depth, covered = (torch.cat(values) for values in zip(*found, strict=True))
    # Where pieces of a sheet meet in a pixel, each covers some of its samples; where they overlap, they are one.
    places, order = ((sheet * camera.height + y) * camera.width + x).sort(stable=True)
    first = torch.ones_like(places, dtype=torch.bool)
    first[1:] = places[1:] != places[:-1]
    number = (first.cumsum(0) - 1)[:, None].expand(-1, len(samples))
    covered = torch.zeros(int(first.sum()), len(samples), dtype=torch.bool).scatter_reduce_(0, number, covered[order], "amax")
    sheet, x, y, u, v, scale, depth = (values[order[first]] for values in (sheet, x, y, u, v, scale, depth))
    uv = torch.stack([u, v], -1)
    # d(a / c) = (da - (a / c) dc) / c, in x and in y
    size = torch.tensor(cards.atlas.image.shape[1::-1], dtype=torch.float64)
    rates = [((own_to_uv[sheet, :2, axis] - uv * own_to_uv[sheet, 2, axis, None]) * size).norm(dim=-1) for axis in (0, 1)]
    detail = (torch.maximum(*rates) / scale.abs()).log2()
    count = max(1, len(sheets))
    return Hits(sheet // count, sheet % count, x, y, uv, detail, depth, covered, seen.to_uv)


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


def seen_at(to_uv: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Texture coordinates u and v, and their divisor, [M] each, that planes [M, 3, 3] have at points (x, y) of the screen, [M] each."""
    u, v, scale = (to_uv[:, row, 0] * x + to_uv[:, row, 1] * y + to_uv[:, row, 2] for row in range(3))
    return u / scale, v / scale, scale


def beside(met: Hits) -> list[Tensor]:
    """Texture coordinates, [M, 2], at the other pixel of each hit's row and at that of its column in its square of 2 x 2 pixels."""
    rows = met.to_uv[met.view, met.sheet]
    places = [torch.stack([x, y, torch.ones_like(x)], -1).double() for x, y in ((met.x ^ 1, met.y), (met.x, met.y ^ 1))]
    found = [(rows @ place[:, :, None])[..., 0] for place in places]
    return [place[:, :2] / place[:, 2:] for place in found]


def _pieces_at_once(areas: Tensor) -> list[int]:
    """Numbers of consecutive pieces with at most :data:`_AT_ONCE` pixels in their boxes together, or single ones."""
    counts, total = [0], 0
    for pixels in areas.tolist():
        if total + pixels > _AT_ONCE and counts[-1]:
            counts, total = [*counts, 0], 0
        counts[-1], total = counts[-1] + 1, total + pixels
    return counts
