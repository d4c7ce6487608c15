"""Tables and pictures of a comparison: one tree, several systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import check_record
from bbfit.evaluation.afar import FarScore
from bbfit.evaluation.measures import Measures
from bbfit.evaluation.scoring import OriginalTree, view_angles
from bbfit.files import write_bytes
from bbfit.images import encode_png, over_color, premultiply, read_rgba, to_bytes
from bbfit.reporting.plots import FAINT, INK, PAPER, picture_font, spread_views
from bbfit.reporting.text import csv_bytes, markdown
from bbfit.views.view_set import ViewSet

# Tiles of the picture: side in pixels, tiles per row, size of the text.
_TILE, _COLUMNS, _TEXT = 340, 5, 13
# Columns of compare.csv.
_MEASURES = (
    *("psnr", "ssim", "flip", "white_psnr", "white_ssim", "white_flip", "rgba_rmse", "rgba_psnr", "iou", "sharpness", "brightness"),
    *("color_delta_e", "color_chroma", "color_brightness", "thesis_psnr"),
)
_LIGHT = ("psnr", "flip", "low", "r2")
FAR = tuple(entry.name for entry in fields(FarScore))
"""The names of the figures of a score from afar."""
_INTRO = """Means over the held-out views, which are the same for all systems. PSNR, SSIM and FLIP are also means over four backgrounds.
*Shaded* is the number of pixels that a graphics card shades for each pixel that the tree covers. Systems with a star need a
shader or a decoder of their own in every program."""
_FAR_INTRO = """Means over the held-out views, each averaged to the size at which the tree is that high (`--tree-height`).
*Shaded pixels* are those that a graphics card shades for a picture. *Drawing* adds the number that it could shade in the
time that the triangles take (`--fragments-per-triangle`)."""
_FAR_HEAD = ("system", "triangles", "shaded pixels", "drawing", "PSNR, dB", "FLIP")
# Headings of the measures in compare.md.
_SHOWN = ("PSNR, dB", "SSIM", "FLIP", "PSNR over white", "silhouette IoU", "sharpness", "color ΔE", "chroma", "brightness")


@dataclass(frozen=True)
class CompareCosts:
    """What the result of a system costs; ``None`` where that is unknown or does not exist."""

    planes: int | None = None
    """Number of planes; ``None`` for a mesh."""
    vertices: int | None = None
    """Vertices of its model."""
    bytes: int | None = None
    """Size of its model as GLB, or of its own file."""
    seconds: float | None = None
    """Time of making the model, without rendering the views."""
    shaded: float | None = None
    """Fragments that a graphics card shades over the pixels that the tree covers (:func:`bbfit.evaluation.shading.score_shading`)."""
    shader: bool = False
    """Whether a program needs a shader or a decoder of its own to show it."""
    triangles: int | None = None
    """Triangles that are drawn for a picture."""
    drawing: float | None = None
    """Cost of drawing it from afar, in fragments (:func:`bbfit.evaluation.afar.drawing_cost`)."""


@dataclass(frozen=True)
class CompareRow:
    """The result of one system."""

    system: str
    """Its short name."""
    title: str
    """What the system does, for the reader."""
    costs: CompareCosts
    """What the result costs."""
    measures: Measures | None
    """Means over the held-out views; ``None`` where nothing was drawn."""
    note: str
    """A remark for the reader."""
    light: Mapping[str, float | None] | None
    """PSNR, FLIP, PSNR of blocks and R2 under the suns of held-out views (``LightScore.figures``); ``None`` where that was not scored."""
    far: FarScore | None
    """The score from afar; ``None`` where nothing was drawn."""

    @property
    def marked(self) -> str:
        """The title, with a star if a program needs a shader or a decoder of its own."""
        return self.title + ("*" if self.costs.shader else "")

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON holds them."""
        measures = None if self.measures is None else self.measures.to_json()
        far = None if self.far is None else asdict(self.far)
        return vars(self) | {"costs": asdict(self.costs), "measures": measures, "far": far}

    @staticmethod
    def from_json(content: dict[str, Any]) -> CompareRow:
        """The row that :meth:`to_json` returned. Errors of any kind if it is damaged, to be caught where it is read."""
        costs = CompareCosts(**content["costs"])
        measures = None if content["measures"] is None else Measures.from_json(content["measures"])
        far = None if content["far"] is None else FarScore(**content["far"])
        row = CompareRow(**{**content, "costs": costs, "measures": measures, "far": far})
        check_record("row", row, CompareRow)
        return row


def compare_csv(rows: Sequence[CompareRow]) -> bytes:
    """CSV with one line per system: all measures and costs."""
    costs = [entry.name for entry in fields(CompareCosts)]
    names = [*_MEASURES, *(f"far_{name}" for name in FAR), *(f"light_{name}" for name in _LIGHT)]
    table: list[list[Any]] = [["system", "title", *costs, *names, "note"]]
    for row in rows:
        light = [None if row.light is None else row.light[name] for name in _LIGHT]
        scores = [*_measures(row.measures), *far_figures(row.far), *light]
        table.append([row.system, row.title, *vars(row.costs).values(), *scores, row.note])
    return csv_bytes(table)


def far_figures(score: FarScore | None) -> list[float | None]:
    """The figures of a score from afar by the names in :data:`FAR`."""
    return [None if score is None else getattr(score, name) for name in FAR]


def _measures(measures: Measures | None) -> list[float | None]:
    if measures is None:
        return [None] * len(_MEASURES)
    over, white, rgba, color = measures.over.mean, measures.over_white, measures.rgba, measures.colour
    own = [over.psnr, over.ssim, over.flip, white.psnr, white.ssim, white.flip, rgba.rmse, rgba.psnr, rgba.iou]
    colors = [color.delta_e, color.chroma, color.brightness]
    return [*own, measures.sharpness, measures.brightness, *colors, measures.thesis_scale.psnr]


def compare_markdown(rows: Sequence[CompareRow], original: OriginalTree) -> str:
    """A Markdown document with a table of all systems, the tree itself first."""
    table = [["the tree", "", _count(original.vertices), _count(original.bytes), "", "", *[""] * len(_SHOWN)]]
    for row in rows:
        costs = row.costs
        seconds, shaded = ("" if value is None else f"{value:,.1f}" for value in (costs.seconds, costs.shaded))
        counts = [_count(costs.planes), _count(costs.vertices), _count(costs.bytes)]
        table.append([row.marked, *counts, shaded, seconds, *_shown(row.measures)])
    head = ["system", "planes", "vertices", "bytes", "shaded", "seconds", *_SHOWN]
    notes = "".join(f"- {row.title}: {row.note}\n" for row in rows if row.note)
    return f"# Comparison\n\n{_INTRO}\n\n{markdown(head, table)}\n{_far_markdown(rows)}{_light_markdown(rows)}{notes}"


def far_markdown(tree_pixels: float, lines: Sequence[tuple[str, float | None, float | None, float | None, float, float]]) -> str:
    """The part of a document about pictures in which the tree has a height in pixels; nothing without lines.

    A line has the title of a system, its triangles, its shaded pixels and the cost of drawing both, PSNR and FLIP.
    """
    table = []
    for title, *costs, psnr, flip in lines:
        counts = [_count(value if value is None else round(value)) for value in costs]
        table.append([title, *counts, f"{psnr:.2f}", f"{flip:.4f}"])
    return f"## From afar: {tree_pixels:.0f} pixels high\n\n{_FAR_INTRO}\n\n{markdown([*_FAR_HEAD], table)}\n" if table else ""


def _far_markdown(rows: Sequence[CompareRow]) -> str:
    scored = [(row, row.far) for row in rows if row.far is not None]
    lines = [(row.marked, row.costs.triangles, far.fragments, row.costs.drawing, far.psnr, far.flip) for row, far in scored]
    return far_markdown(max((far.tree_pixels for _, far in scored), default=0.0), lines)


def _light_markdown(rows: Sequence[CompareRow]) -> str:
    """The part of the document about light; nothing if no system was scored under other suns."""
    table, digits = [], dict(zip(_LIGHT, (2, 4, 2, 2), strict=True))
    for row in rows:
        if row.light is not None:
            known = {name: row.light[name] for name in _LIGHT}
            table.append([row.title, *("" if value is None else f"{value:.{digits[name]}f}" for name, value in known.items())])
    if not table:
        return ""
    head = ["system", "PSNR, dB", "FLIP", "PSNR of blocks, dB", "R²"]
    intro = "Held-out cameras under four suns that no training view had, on a sunny day. R² is the share of the change of light that shows."
    return f"## Under other suns\n\n{intro}\n\n{markdown(head, table)}\n"


def _shown(measures: Measures | None) -> list[str]:
    if measures is None:
        return [""] * len(_SHOWN)
    over, color = measures.over.mean, measures.colour
    scores = [f"{over.psnr:.2f}", f"{over.ssim:.4f}", f"{over.flip:.4f}", f"{measures.over_white.psnr:.2f}", f"{measures.rgba.iou:.3f}"]
    ratios = (measures.sharpness, color.delta_e, color.chroma, color.brightness)
    return [*scores, *("" if value is None else f"{value:.2f}" for value in ratios)]


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"


def compare_picture(rows: Sequence[CompareRow], views: ViewSet, folder: Path) -> None:
    """Write ``systems.png``: one held-out view over white, and the picture of each system that was drawn, with its mean scores.

    ``folder`` holds a folder for each system, with its pictures in ``held_out`` under the views' names.
    """
    from PIL import Image, ImageDraw

    index = spread_views(view_angles(views.cameras).numpy(), 1)[0]
    drawn = [row for row in rows if row.measures is not None]
    pictures = [("the tree", f"held-out view {views.names[index]}", views.targets([index])[0])]
    for row in drawn:
        assert row.measures is not None and row.costs.bytes is not None
        straight = torch.from_numpy(read_rgba(folder / row.system / "held_out" / f"{views.names[index]}.png")).float() / 255
        over = row.measures.over.mean
        caption = f"{over.psnr:.2f} dB  ·  FLIP {over.flip:.3f}  ·  {_vertices(row.costs)}{row.costs.bytes / 1e6:.2g} MB"
        pictures.append((row.title, caption, premultiply(straight)))
    part = _around(views.targets([index])[0][..., 3])
    gap, line = 14, 3 * _TEXT + 8
    rows_of_tiles = -(-len(pictures) // _COLUMNS)
    columns = min(_COLUMNS, len(pictures))
    sheet = Image.new("RGB", (gap + columns * (_TILE + gap), gap + rows_of_tiles * (_TILE + line + gap)), PAPER)
    draw = ImageDraw.Draw(sheet)
    font, bold = picture_font("DejaVuSans.ttf", _TEXT - 2), picture_font("DejaVuSans-Bold.ttf", _TEXT)
    for number, (title, caption, picture) in enumerate(pictures):
        left, top = gap + number % _COLUMNS * (_TILE + gap), gap + number // _COLUMNS * (_TILE + line + gap)
        image = Image.fromarray(to_bytes(over_color(picture))).crop(part)
        scale = _TILE / max(image.size)
        sheet.paste(image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.LANCZOS), (left, top))
        draw.text((left, top + _TILE + 4), title, INK, bold)
        draw.text((left, top + _TILE + 8 + _TEXT), caption, FAINT, font)
    write_bytes(folder / "systems.png", encode_png(np.asarray(sheet)))


def _vertices(costs: CompareCosts) -> str:
    return "" if costs.vertices is None else f"{costs.vertices:,} vertices  ·  "


def _around(alpha: Tensor) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of a square around the visible part of an alpha channel [H, W], with a margin of a tenth, inside the
    picture if that is large enough. If nothing is visible, it is the whole picture."""
    alpha = alpha if alpha.any() else torch.ones_like(alpha)
    rows, columns = (torch.nonzero(alpha.amax(axis) > 0)[:, 0] for axis in (1, 0))
    middle = [(int(line[0]) + int(line[-1]) + 1) / 2 for line in (columns, rows)]
    half = 0.6 * max(int(line[-1]) - int(line[0]) + 1 for line in (columns, rows))
    half = min(half, min(alpha.shape) / 2)
    left, top = (round(min(max(at - half, 0), side - 2 * half)) for at, side in zip(middle, alpha.shape[::-1], strict=True))
    return left, top, left + round(2 * half), top + round(2 * half)
