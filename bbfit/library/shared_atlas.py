"""One atlas for many models: the textures of all cards side by side, texel for texel, with mip levels that never mix two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.exporting.atlas import BLOCK
from bbfit.exporting.mips import mip_chain, plain_chain, surface_chain
from bbfit.exporting.packing import packed
from bbfit.geometry.cards import Atlas, Card, Cards

_Image = NDArray[np.uint8]
_OPEN = (128, 128, 255, 255, 0)  # what lies in the gaps of a surface: the plane's own normal, in the open, opaque


@dataclass(frozen=True)
class SharedPage:
    """A picture with the textures of several models."""

    models: tuple[int, ...]
    """The numbers of the models."""
    cards: tuple[Cards, ...]
    """The cards of each of them. Their atlases and mip levels are the same pictures; corners and sizes are those of the own textures."""

    @property
    def image(self) -> _Image:
        """The picture, straight-alpha RGBA, [H, W, 4]."""
        return self.cards[0].atlas.image

    @property
    def used(self) -> float:
        """Share of the picture that textures cover, without their padding, in (0, 1]."""
        return sum(cards.atlas.used for cards in self.cards)


def safe_level(padding: int) -> int:
    """The highest mip level that never mixes two textures with ``padding`` texels around each: log2 of the padding, rounded down."""
    return padding.bit_length() - 1


def check_padding(padding: int) -> None:
    """Require the padding of blocks of texels, which textures of several models share a picture with."""
    if padding < BLOCK:
        fail("padding", f"expected at least {BLOCK} for textures that models share, got {padding}", "give --padding 8")


def shared_pages(models: Sequence[Cards], padding: int, most: int, *, own_levels: bool) -> list[SharedPage]:
    """Pack the textures of models into one picture, or into as few as needed if a side would exceed ``most`` texels.

    A model's textures lie in one picture. Each keeps its cell: the texture with at least ``padding`` >= 4 texels of its own dilated
    colors on every side, aligned to blocks of n x n texels, where n is the largest power of two up to ``padding``. So mip levels up to
    log2(n) (:func:`safe_level`) are those of the models, texel for texel, and nothing is resampled. Higher levels are computed of the
    shared picture: with ``own_levels`` as :func:`~bbfit.exporting.mips.mip_chain` does, otherwise as graphics cards do.

    Raises InputError if the textures of one model alone do not fit, or the padding is smaller than 4. All models have maps, or none has,
    and all have mip levels, or none has.
    """
    check_padding(padding)
    cells = [_cells(cards, padding) for cards in models]
    return [
        _page(numbers, models, places, padding, own_levels) for numbers, places in _split(list(range(len(models))), cells, padding, most)
    ]


def _unit(padding: int) -> int:
    """Side in texels of the blocks that cells are aligned to."""
    return 1 << safe_level(padding)


def _cells(cards: Cards, padding: int) -> NDArray[np.int64]:
    """Width and height of the cell of each texture in blocks, int64 [R, 2]."""
    return -(-(cards.atlas.sizes + 2 * padding) // _unit(padding))


def _split(numbers: list[int], cells: list[NDArray[np.int64]], padding: int, most: int) -> list[tuple[list[int], list[NDArray[np.int64]]]]:
    """The models of each page, with the places of their cells in blocks."""
    unit, together = _unit(padding), np.concatenate([cells[number] for number in numbers])
    if together.prod(-1).sum() * unit**2 <= most**2:  # otherwise packing them is in vain
        places = packed(together)
        if ((places + together).max(0) * unit <= most).all():
            return [(numbers, np.split(places, np.cumsum([len(cells[number]) for number in numbers])[:-1]))]
    if len(numbers) == 1:
        side = int(np.ceil(np.sqrt(together.prod(-1).sum()))) * unit
        fail(
            "page_size",
            f"the textures of one level need a picture of more than {side:,} x {side:,} texels, and at most {most:,} are allowed",
            "raise --page-size, or render smaller views with --size",
        )
    half = len(numbers) // 2
    return _split(numbers[:half], cells, padding, most) + _split(numbers[half:], cells, padding, most)


def _page(numbers: list[int], models: Sequence[Cards], places: list[NDArray[np.int64]], padding: int, own_levels: bool) -> SharedPage:
    unit, safe = _unit(padding), safe_level(padding)
    chosen = [models[number] for number in numbers]
    assert all((cards.chain is None) == (chosen[0].chain is None) for cards in chosen)
    cells = [_cells(cards, padding) for cards in chosen]
    width, height = (np.concatenate([place + cell for place, cell in zip(places, cells, strict=True)]).max(0) * unit).tolist()
    atlases = [
        Atlas(np.zeros((0, 0, 4), np.uint8), place * unit + padding, cards.atlas.sizes) for place, cards in zip(places, chosen, strict=True)
    ]

    def assembled(levels: Sequence[Sequence[_Image]], gaps: NDArray[np.uint8]) -> list[_Image]:
        """The pictures of all levels that exist for all models and never mix textures."""
        pictures = []
        for level in range(min(safe + 1, *map(len, levels))):
            picture = np.tile(gaps, (height >> level, width >> level, 1))
            for own, cards, place, cell in zip(levels, chosen, places, cells, strict=True):
                before = cards.atlas.corners - padding
                for (x, y), (left, top), (wide, high) in zip(place * unit >> level, before >> level, cell * unit >> level, strict=True):
                    picture[y : y + high, x : x + wide] = own[level][top : top + high, left : left + wide]
            pictures.append(picture)
        return pictures

    chains = [cards.chain or (cards.atlas.image,) for cards in chosen]
    gap = np.append(_mean_color(chosen), 0).astype(np.uint8)
    levels = assembled(chains, gap)
    surfaces = list[_Image]()
    if chosen[0].atlas.surface is not None:
        own = [cards.surface_chain or (cards.atlas.surface,) for cards in chosen]
        surfaces = assembled(own, np.array(_OPEN[: chosen[0].atlas.surface.shape[-1]], np.uint8))  # type: ignore[arg-type]
    if chosen[0].chain is not None:
        last = len(levels) - 1
        alpha, opacity = chosen[0].alpha, levels[last][..., 3]
        if own_levels:
            corners = np.concatenate([atlas.corners for atlas in atlases]) >> last
            sizes = -(-np.concatenate([atlas.sizes for atlas in atlases]) // 2**last)
            levels += mip_chain(Atlas(levels[last], corners, sizes), alpha.cutoff if alpha.kind == "mask" else None)[1:]
        else:
            levels += plain_chain(levels[last])[1:]
        if surfaces:
            surfaces += surface_chain(surfaces[last], opacity if own_levels else None)[1:]
    averaged = None
    if any(cards.averaged is not None for cards in chosen):
        (averaged,) = assembled([(cards.atlas.image if cards.averaged is None else cards.averaged,) for cards in chosen], gap)
    made = []
    for cards, atlas in zip(chosen, atlases, strict=True):
        shared = replace(atlas, image=levels[0], surface=surfaces[0] if surfaces else None)
        chain = tuple(levels) if cards.chain is not None else None
        surface = tuple(surfaces) if cards.surface_chain is not None else None
        made.append(replace(_moved(cards, shared), chain=chain, surface_chain=surface, averaged=averaged))
    return SharedPage(tuple(numbers), tuple(made))


def _moved(cards: Cards, atlas: Atlas) -> Cards:
    """The cards with the texture coordinates of the same textures in another atlas."""
    old, new = (np.array(picture.shape[1::-1]) for picture in (cards.atlas.image, atlas.image))
    moves = atlas.corners - cards.atlas.corners

    def moved(card: Card) -> Card:
        return replace(card, uvs=(card.uvs * old + moves[card.rectangle]) / new)

    return replace(cards.with_cards([moved(card) for card in cards.cards]), atlas=atlas)


def _mean_color(models: Sequence[Cards]) -> NDArray[np.float64]:
    """Mean color of what is visible, weighted by alpha, [3]."""
    total, weight = np.zeros(3), 0.0
    for cards in models:
        flat = cards.atlas.image.reshape(-1, 4).astype(np.float64)
        total, weight = total + flat[:, 3] @ flat[:, :3], weight + flat[:, 3].sum()
    return np.rint(total / max(weight, 1.0))


def cell_texels(cards: Cards, padding: int) -> int:
    """Texels of a shared atlas that a model takes up, with its padding."""
    return int(_cells(cards, padding).prod(-1).sum()) * _unit(padding) ** 2
