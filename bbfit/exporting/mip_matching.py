"""Mip levels that keep the coverage of all cards together on the screen, at every distance.

Levels that keep the coverage of each texture (:func:`~bbfit.exporting.mips.mip_chain`) are not enough. The trilinear mix of two levels,
which precedes the alpha test, loses what is visible in only one of them. And cards overlap: coarser texels keep the densest parts of each
card, which are in the same places of the picture, so together the cards cover less and less. Blended cards cover more instead, because
the averages no longer have leaves and gaps in different places. One factor on the alpha of each level compensates for all of this.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import fail
from bbfit.exporting.atlas import palettized_picture
from bbfit.exporting.mips import mip_chain, surface_chain
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Atlas, Cards
from bbfit.geometry.orbit import Orbit
from bbfit.images import PALETTE, distinct
from bbfit.operators.cards.reference import hits
from bbfit.operators.cards.sampling import Footprint, filtered, footprint, joined, sampled
from bbfit.operators.cards.sheets import sheets_of
from bbfit.operators.drawing.compositing import opacity
from bbfit.threads import one_thread

# Largest side in pixels of the pictures in which coverage is measured.
_SIDE = 96
# Cameras of those pictures.
_ORBIT = Orbit(24)
# Width in pixels of the smallest views whose levels get their own factor; coarser levels get the factor of the last one.
_LEAST_WIDTH = 8
# Number of passes over the levels, as the factors depend on each other; in the first pass one factor holds for all coarser levels too.
_SWEEPS = 2
# Range of the search for a factor in doublings around 1 and number of halvings, the same in later passes around the last factor, and the
# accepted relative error of coverage.
_FIRST, _LATER, _TOLERANCE = (2.0, 8), (0.25, 5), 0.002


@dataclass(frozen=True)
class _VisibleTexels:
    """What V cameras see of the cards: the M hits on all sheets, of all views in one list."""

    pixels: Tensor
    """Index of each hit's pixel among the pixels of all views, int64 [M]."""
    uvs: Tensor
    """Texture coordinates, float64 [M, 2]."""
    details: Tensor
    """Level of detail minus the median over all hits, float64 [M]."""
    count: int
    """Number of pixels of all views."""


def with_mips(cards: Cards, on_level: Callable[[int, int], None] = lambda done, total: None) -> Cards:
    """Cards with mip levels that are as dense from afar as the cards are from near, in views from all around.

    ``on_level`` is that of :func:`matched_chain`.
    """
    surface = None if cards.atlas.surface is None else tuple(surface_chain(cards.atlas.surface, cards.atlas.image[..., 3]))
    with one_thread():
        chain = matched_chain(cards, _chain(cards), _around(cards), on_level)
    return replace(cards, chain=tuple(chain), surface_chain=surface)


def reduced(cards: Cards, halvings: int) -> Cards:
    """Cards whose textures have sides of 2^-halvings and are as dense as before in views from all around.

    If the atlas's colors fit into the palette of a PNG, those of the result do. The padding of the atlas shrinks too, so it must be at
    least 2^halvings texels, and the sides of the atlas multiples of 2^halvings blocks.
    """
    if halvings == 0:
        return cards
    image = _chain(cards)[halvings]
    visible, _ = _visible_texels(cards, _around(cards))
    wanted = _coverage(visible, [cards.atlas.image[..., 3:]], 0, cards.alpha)

    def excess(factor: float) -> float:
        return _coverage(visible, _scaled([image[..., 3:]], np.array([factor])), 0, cards.alpha) / wanted - 1

    factor = _root(excess, 1.0, *_FIRST) if wanted else 1.0
    image = np.concatenate([image[..., :3], *_scaled([image[..., 3:]], np.array([factor]))], -1)
    if len(distinct(cards.atlas.image)) <= PALETTE:
        image = palettized_picture(image, cards.alpha)
    surface = cards.atlas.surface
    if surface is not None:
        surface = surface_chain(surface, cards.atlas.image[..., 3])[halvings]
    atlas = Atlas(image, cards.atlas.corners >> halvings, -(-cards.atlas.sizes >> halvings), surface)
    return replace(cards, atlas=atlas)


def densities(cards: Cards, chain: Sequence[NDArray[np.uint8]], levels: Sequence[int]) -> list[float]:
    """How dense cards are from afar with the mip levels of a chain, relative to level 0, where half of their pixels use each of ``levels``.

    Nothing is returned for cards of which nothing shows.
    """
    visible, _ = _visible_texels(cards, _around(cards))
    alphas = [level[..., 3:] for level in chain]
    near = _coverage(visible, alphas[:1], 0, cards.alpha)
    return [_coverage(visible, alphas, level, cards.alpha) / near for level in levels] if near else []


def _chain(cards: Cards) -> list[NDArray[np.uint8]]:
    return mip_chain(cards.atlas, cards.alpha.cutoff if cards.alpha.kind == "mask" else None)


def _around(cards: Cards) -> Camera:
    """Views of the cards from all around."""
    points = np.concatenate([card.corners for card in cards.cards])
    target = torch.from_numpy((points.min(0) + points.max(0)) / 2)
    return _ORBIT.frame(points, target=target, width=_SIDE, height=_SIDE)


def matched_chain(
    cards: Cards, chain: Sequence[NDArray[np.uint8]], cameras: Camera, on_level: Callable[[int, int], None] = lambda done, total: None
) -> list[NDArray[np.uint8]]:
    """Scale the alpha of each mip level such that the cards cover as much of the picture from afar as with level 0.

    ``chain`` holds the levels of :func:`~bbfit.exporting.mips.mip_chain`, with the cutoff if there is one. ``cards`` are in the alpha mode
    in which they are shown; blend and hash get the same levels, because a hash covers as much as a blend on average. ``cameras`` are views
    of the tree other than those of the evaluation: about twenty from all around are enough and take a few seconds, four are too few. Raises
    InputError if none of them sees a card.

    For each level there is a distance at which half of the cards' pixels use this or coarser levels. Coverage is measured as seen from
    there, in all views together; the pictures have more pixels than at that distance, so that single pixels matter less. Bisection gives
    the level's factor. Level 0 stays the same array. Alpha is clipped at 1; colors do not change. ``on_level`` is called after the search
    for each factor with its number and their total.
    """
    cameras = cameras.batch()
    levels = joined(chain, cards.atlas.image.shape)
    reduction = max(1.0, max(cameras.width, cameras.height) / _SIDE)
    width, height = (max(1, round(side / reduction)) for side in (cameras.width, cameras.height))
    visible, detail = _visible_texels(cards, cameras.resized(width, height))
    # Pictures a quarter as large have a median level of detail that is two more, and so on.
    last = min(len(chain) - 1, math.ceil(detail + math.log2(width / _LEAST_WIDTH)))
    factors = np.ones(len(chain))
    alphas, texels = [level[..., 3:] for level in chain], levels.texels[:, 3:].float()
    wanted = _coverage(visible, alphas[:1], 0, cards.alpha)
    if wanted == 0:
        return list(chain)  # nothing shows, near or far
    for sweep in range(_SWEEPS):
        for level in range(1, last + 1):
            beyond = len(chain) if sweep == 0 or level == last else level + 1
            place = footprint(levels, visible.uvs, visible.details + level)

            def excess(factor: float, level: int = level, beyond: int = beyond, place: Footprint = place) -> float:
                factors[level:beyond] = factor
                for start, alpha in zip(levels.starts[level:beyond], _scaled(alphas[level:beyond], factors[level:beyond]), strict=True):
                    texels[start : start + alpha.size, 0] = torch.from_numpy(alpha.reshape(-1))
                return _covered(visible, sampled(texels, place)[:, 0], cards.alpha) / wanted - 1

            factors[level:beyond] = _root(excess, factors[level], *(_LATER if sweep else _FIRST))
            on_level(sweep * last + level, _SWEEPS * last)
    scaled = _scaled(alphas, factors)
    return [chain[0], *(np.concatenate([level[..., :3], alpha], -1) for level, alpha in zip(chain[1:], scaled[1:], strict=True))]


def _visible_texels(cards: Cards, cameras: Camera) -> tuple[_VisibleTexels, float]:
    """What the cameras see of the cards, and the median level of detail."""
    count, sheets = cameras.width * cameras.height, sheets_of(cards)
    seen = [hits(cards, sheets, cameras[index]) for index in range(len(cameras))]
    detail = torch.cat([met.detail for met in seen])
    if not len(detail):
        fail("cameras", "none sees a card", "give those of the views that the cards were fitted to")
    median = float(detail.median())
    pixels = torch.cat([index * count + met.y * cameras.width + met.x for index, met in enumerate(seen)])
    return _VisibleTexels(pixels, torch.cat([met.uv for met in seen]), detail - median, count * len(cameras)), median


def _scaled(alphas: list[NDArray[np.uint8]], factors: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
    return [
        alpha if factor == 1 else np.rint(np.minimum(alpha * np.float32(factor), 255)).astype(np.uint8)
        for alpha, factor in zip(alphas, factors, strict=True)
    ]


def _coverage(visible: _VisibleTexels, alphas: list[NDArray[np.uint8]], level: int, mode: AlphaMode) -> float:
    """Mean alpha of the pictures in [0, 1], with ``level`` as the median level of detail; ``alphas`` are those of the levels, [h, w, 1]."""
    return _covered(visible, filtered(joined(alphas, alphas[0].shape), visible.uvs, visible.details + level)[:, 0], mode)


def _covered(visible: _VisibleTexels, alpha: Tensor, mode: AlphaMode) -> float:
    """Mean alpha of the pictures in [0, 1], given the filtered alpha of the hits in [0, 255], [M]."""
    alpha = alpha / 255
    if mode.kind == "coverage":  # all layers cover the same samples of a pixel first
        return float(torch.zeros(visible.count).scatter_reduce_(0, visible.pixels, opacity(alpha, mode), "amax").double().mean())
    alpha = opacity(alpha, mode) if mode.kind == "mask" else alpha
    clear = torch.ones(visible.count).scatter_reduce_(0, visible.pixels, 1 - alpha, "prod")  # in any order of depth
    return 1 - float(clear.double().mean())


def _root(excess: Callable[[float], float], around: float, doublings: float, halvings: int) -> float:
    """The factor at which an increasing excess is 0, or the nearer bound, by bisection of the factor's logarithm."""
    low, high = -doublings, doublings
    for _ in range(halvings + 1):
        middle = (low + high) / 2
        now = excess(around * 2.0**middle)
        if abs(now) <= _TOLERANCE:
            break
        low, high = (middle, high) if now < 0 else (low, middle)
    return around * 2.0**middle
