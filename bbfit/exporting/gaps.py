"""Alpha of the texels between an atlas's pictures, so that the mip levels that programs compute show the tree from afar.

Programs compute the mip levels of a PNG as plain means. A texel of a coarse level mixes the picture of a card with the transparent texels
around it, so small cards fade: an acer of 384 masked billboards keeps 0.70 of its density at an eighth of the views' size, and 0.08 at a
sixteenth. From near, no card shows the texels around its outline. So their alpha is free, and coarse levels show it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate
from torch.optim.adam import adam

from bbfit.exporting.mip_matching import densities
from bbfit.exporting.mips import plain_chain
from bbfit.fitting.palette import nearest_means
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.orbit import Orbit
from bbfit.geometry.polygons import sides
from bbfit.images import PALETTE, distinct, shrunk
from bbfit.operators.cards.reference import Hits, beside, hits, opacities, pictures
from bbfit.operators.cards.sampling import Footprint, joined, sampled
from bbfit.operators.cards.sampling import footprint as footprint_of
from bbfit.operators.cards.sheets import sheets_of
from bbfit.rendering.cards import CardRenderer
from bbfit.threads import one_thread

# Cameras, the number of groups of which a step compares one, and the largest side of the near pictures in pixels.
_ORBIT, _GROUPS, _NEAR = Orbit(12, (0.0, 25.0, 50.0)), 3, 256
# How often the size at which a texel is a pixel is halved for pictures from afar, and the smallest of them in pixels.
_HALVINGS, _LEAST_SIDE = (3, 4), 8
# Level of detail whose texels have an alpha of their own. Coarser texels are their means; finer ones are not needed from so far.
_LEVEL = 2
# Steps of Adam, its rate, its decay rates, and the alpha to start from.
_STEPS, _RATE, _DECAY, _START = 40, 0.12, (0.9, 0.95), 0.2
# Weights beside the squared error: of the error's change when the camera turns by a degree, where alpha is tested, so that it flickers
# more, and where it is blended; and of the error in density.
_TURN_TESTED, _TURN_BLENDED, _DENSITY = 20.0, 5.0, 1.0
# Share of the density from near; gaps stay empty if all sizes have it.
_ENOUGH = 0.85
# Width in texels of the rim around a card that stays empty, because filtering shows it at fine levels.
_RIM = 3
# Fewest colors that a palette must have left.
_LEAST_COLORS = 4


@dataclass(frozen=True)
class _View:
    """What some cameras see from afar, whatever alpha is: M hits in V pictures. The second half of the cameras is the first, turned."""

    hits: Hits
    footprint: Footprint
    beside: tuple[Footprint, ...]
    """Those of the pixels beside each hit, whose difference of alpha is the width of a mask's smooth edge; otherwise none."""
    colors: Tensor
    """[M, 3]."""
    target: Tensor
    """The near pictures, averaged to this size, premultiplied RGBA [V, h, w, 4]."""


def with_filled_gaps(cards: Cards, on_step: Callable[[int, int], None] = lambda done, total: None) -> Cards:
    """Cards with the mip levels that programs compute, which look with them from afar as they do from near.

    ``cards`` have the levels of :func:`~bbfit.exporting.mips.plain_chain`, and so do the returned ones.

    Only texels change that no card shows at level 0: their alpha, and their colors where a palette needs fewer of them. Cards that keep
    0.85 of their density from afar stay as they are, as do those that would not look better, and those of an atlas whose palette has no
    room.

    Adam (Kingma and Ba 2015) finds the alpha of blocks of 4 x 4 such texels. It compares the cards with their own near pictures, averaged
    to an eighth and a sixteenth of the size at which a texel is a pixel. The loss is the squared difference over backgrounds, that of its
    change when the camera turns by a degree, because cards that come and go flicker, and that of the mean alpha. Masks are drawn with
    smooth edges. ``on_step`` is called after each step with its number and their total.
    """
    with one_thread(), torch.inference_mode(False), torch.enable_grad():  # a model is often made as it is first drawn
        return _filled(cards, on_step)


def _filled(cards: Cards, on_step: Callable[[int, int], None]) -> Cards:
    assert cards.chain is not None
    image, chain = cards.atlas.image, cards.chain
    cameras, side = _around(cards)
    halvings = [count for count in _HALVINGS if side >> count >= _LEAST_SIDE]
    fades = [density < _ENOUGH for density in densities(cards, chain, halvings)] if halvings else []
    if not any(fades):
        return cards
    free, shapes = _free(cards), [level.shape[:2] for level in chain[_LEVEL:]]
    # A hash shows on average what a blend shows.
    mode = AlphaMode() if cards.alpha.kind == "hash" else replace(cards.alpha, antialiased=cards.alpha.kind == "mask")
    alpha, share = torch.from_numpy(image[..., 3] / np.float32(255)), torch.from_numpy(free.astype(np.float32))
    fixed, share = _means(alpha * (1 - share), shapes[0]), _means(share, shapes[0])

    def levels(values: Tensor) -> Tensor:
        """Alpha of all texels of all levels from :data:`_LEVEL` on, [T, 1], for that of the blocks."""
        parts = [fixed + share * values]
        for shape in shapes[1:]:
            parts.append(_means(parts[-1], shape))
        return torch.cat([part.flatten() for part in parts])[:, None]

    sizes = _views(cards, mode, chain, cameras, [side >> count for count in halvings])
    values, turn = torch.full(shapes[0], _START, requires_grad=True), _TURN_TESTED if mode.tested else _TURN_BLENDED
    moments = [torch.zeros(shapes[0]), torch.zeros(shapes[0])]
    for step in range(_STEPS):
        rate = _RATE * 0.5 * (1 + math.cos(math.pi * step / _STEPS))
        texels, loss = levels(values), torch.zeros(())
        for views in sizes:
            view = views[step % len(views)]
            error = _drawn(texels, view, mode) - view.target
            here, turned = error.chunk(2)
            loss = loss + _visible(error) + turn * _visible(here - turned) + _DENSITY * error[..., 3].mean((1, 2)).square().mean()
        if loss.requires_grad:  # otherwise nothing shows
            (gradient,) = torch.autograd.grad(loss, values)
            with torch.no_grad():
                # torch.optim.Adam does the same, but imports the compiler of torch, for a second and a half.
                adam(
                    [values], [gradient], [moments[0]], [moments[1]], [], [torch.tensor(float(step))],
                    amsgrad=False, beta1=_DECAY[0], beta2=_DECAY[1], lr=rate, weight_decay=0.0, eps=1e-8, maximize=False,
                )  # fmt: skip
                values.clamp_(0, 1)
        on_step(step + 1, _STEPS)

    with torch.no_grad():
        before, after = (
            sum(float(_visible(_drawn(texels, view, mode) - view.target)) for views in sizes for view in views)
            for texels in (levels(torch.zeros_like(values)), levels(values))
        )
    if after >= before:
        return cards
    blocks = (values.detach() * 255).round().to(torch.uint8).numpy().repeat(1 << _LEVEL, 0).repeat(1 << _LEVEL, 1)
    filled = np.concatenate([image[..., :3], np.where(free, blocks, image[..., 3])[..., None]], -1)
    filled = _within_palette(filled, image)
    return replace(cards, atlas=replace(cards.atlas, image=filled), chain=tuple(plain_chain(filled)))


def _within_palette(filled: NDArray[np.uint8], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A filled picture, [H, W, 4], with few colors in its gaps if ``image``, without them, fits into the palette of a PNG."""
    changed = filled[..., 3] != image[..., 3]
    if len(distinct(image)) > PALETTE or len(distinct(filled)) <= PALETTE:
        return filled
    left = PALETTE - len(distinct(image[~changed]))
    if left < _LEAST_COLORS:
        return image
    gaps = torch.from_numpy(filled[changed])
    filled[changed] = np.rint(nearest_means(gaps, torch.ones(len(gaps), dtype=torch.bool), left).numpy()).astype(np.uint8)
    return filled


def _free(cards: Cards) -> NDArray[np.bool_]:
    """The texels that no card shows at level 0, bool [H, W]."""
    height, width = cards.atlas.image.shape[:2]
    free = np.ones((height, width), np.bool_)
    for card in cards.cards:
        polygon = card.uvs * (width, height) - 0.5
        left, top = np.floor(polygon.min(0) - _RIM).astype(np.int64).clip(0).tolist()
        right, bottom = np.ceil(polygon.max(0) + _RIM).astype(np.int64).tolist()
        around = free[top : bottom + 1, left : right + 1]
        normals, offsets = sides(polygon)
        beyond = (np.indices(around.shape).T[..., ::-1] + (left, top)) @ normals.T - offsets
        around &= (beyond > _RIM).any(-1).T
    return free


def _around(cards: Cards) -> tuple[Camera, int]:
    """Cameras around the cards, and the side of their pictures at which a pixel is as large as a texel; 0 if they see nothing."""
    points = np.concatenate([card.corners for card in cards.cards])
    cameras = _ORBIT.frame(points, target=_center(points), width=64, height=64)
    detail = hits(cards, sheets_of(cards), cameras).detail
    return cameras, round(cameras.width * 2.0 ** float(detail.median())) if len(detail) else 0


def _center(points: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy((points.min(0) + points.max(0)) / 2)


def _views(cards: Cards, mode: AlphaMode, chain: Sequence[NDArray[np.uint8]], cameras: Camera, widths: Sequence[int]) -> list[list[_View]]:
    """What is compared in pictures of each width, for each group of cameras."""
    near = widths[0] * 2 ** max(0, math.floor(math.log2(_NEAR / widths[0])))
    plain = replace(cards, atlas=replace(cards.atlas, surface=None), chain=None, surface_chain=None, light=None, alpha=mode)
    center = _center(np.concatenate([card.corners for card in cards.cards]))
    both, sheets = [cameras, cameras.turned(1.0, center)], sheets_of(cards)
    close = [CardRenderer(plain).draw(each.resized(near, near)).double() for each in both]
    levels = joined([np.ascontiguousarray(level[..., :3]) for level in chain[_LEVEL:]], (*chain[_LEVEL].shape[:2], 3))
    colors = levels.texels.float() / 255
    sizes = []
    for width in widths:
        views = []
        for some in (list(range(first, len(cameras), _GROUPS)) for first in range(_GROUPS)):
            far = Camera.joined([each.resized(width, width)[some] for each in both])
            met = hits(cards, sheets, far, multisampled=mode.multisampled)
            places = [met.uv, *(beside(met) if mode.antialiased else [])]
            footprint, *neighbors = (footprint_of(levels, uv, met.detail - _LEVEL) for uv in places)
            target = torch.stack([shrunk(picture[index], width, width) for picture in close for index in some]).float()
            views.append(_View(met, footprint, tuple(neighbors), sampled(colors, footprint), target))
        sizes.append(views)
    return sizes


def _drawn(alphas: Tensor, view: _View, mode: AlphaMode) -> Tensor:
    """The pictures, [V, h, w, 4], for the alpha of all texels, [T, 1]."""
    here, *near = (sampled(alphas, place)[:, 0] for place in (view.footprint, *view.beside))
    count, height, width, _ = view.target.shape
    return pictures(view.colors, opacities(here, near, view.hits, mode), view.hits, (count, height, width), nested=mode.nested)


def _visible(error: Tensor) -> Tensor:
    """The mean squared difference of pictures over uniform gray backgrounds, given that of their premultiplied values, [..., 4]."""
    return (error[..., :3] - error[..., 3:] / 2).square().mean() + error[..., 3].square().mean() / 12


def _means(values: Tensor, size: tuple[int, ...]) -> Tensor:
    """Means over the areas of the texels of a coarser level, [H, W] -> ``size``."""
    return interpolate(values[None, None], size, mode="area")[0, 0]
