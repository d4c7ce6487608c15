"""A picture of a library: a row for each tree, with the tree and its levels of detail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.files import write_bytes
from bbfit.images import encode_png
from bbfit.reporting.plots import FAINT, INK, PAPER, picture_font

_SIDE, _GAP, _TEXT = 256, 16, 13  # pixels


@dataclass(frozen=True)
class SheetLevel:
    """A level of a tree on a contact sheet."""

    title: str
    """Its name."""
    notes: tuple[str, ...]
    """Lines of text under its picture."""
    picture: NDArray[np.uint8]
    """RGB, [H, W, 3]."""


@dataclass(frozen=True)
class SheetTree:
    """A tree on a contact sheet."""

    name: str
    """Its name."""
    notes: tuple[str, ...]
    """Lines of text under its picture."""
    picture: NDArray[np.uint8]
    """The tree itself, RGB, [H, W, 3]."""
    levels: tuple[SheetLevel, ...]
    """Its levels, finest first."""


def contact_sheet(trees: Sequence[SheetTree], path: str | Path) -> None:
    """Write a PNG with a row for each tree, completely or not at all: the tree, and its levels from the same side."""
    from PIL import Image, ImageDraw

    columns = 1 + max(len(tree.levels) for tree in trees)
    lines = max(len(notes) for tree in trees for notes in (tree.notes, *(level.notes for level in tree.levels)))
    row = 2 * _TEXT + _SIDE + (lines + 1) * _TEXT * 5 // 4
    sheet = Image.new("RGB", (_GAP + columns * (_SIDE + _GAP), _GAP + len(trees) * (row + _GAP)), PAPER)
    draw, font, bold = ImageDraw.Draw(sheet), picture_font("DejaVuSans.ttf", _TEXT), picture_font("DejaVuSans-Bold.ttf", _TEXT)
    for number, tree in enumerate(trees):
        top = _GAP + number * (row + _GAP)
        cells = [(tree.name, tree.notes, tree.picture), *((level.title, level.notes, level.picture) for level in tree.levels)]
        for column, (title, notes, picture) in enumerate(cells):
            left, scale = _GAP + column * (_SIDE + _GAP), _SIDE / max(picture.shape[:2])
            size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
            smooth = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX
            draw.text((left, top), _fitting(title, bold.getlength), INK, bold)
            sheet.paste(Image.fromarray(picture).resize(size, smooth), (left + (_SIDE - size[0]) // 2, top + 2 * _TEXT - _TEXT // 2))
            for line, note in enumerate(notes):
                place = left, top + 2 * _TEXT + _SIDE + line * _TEXT * 5 // 4
                draw.text(place, _fitting(note, font.getlength), FAINT, font)
    write_bytes(path, encode_png(np.asarray(sheet)))


def _fitting(text: str, length: Callable[[str], float]) -> str:
    """A text that fits under a picture; the end of a longer one is left out."""
    while length(text) > _SIDE:
        text = text[:-2] + "…"
    return text
