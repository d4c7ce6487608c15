"""Pictures of a result: ``comparison.png`` (targets beside renders), ``loss.png``, ``pareto.png`` and ``lod.png``."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.budget.choice import Choice, pareto_front
from bbfit.checks import check_count, fail
from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import over_background
from bbfit.evaluation.scoring import held_out, view_angles
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.model import ShippedModel
from bbfit.files import write_bytes
from bbfit.geometry.camera import Camera
from bbfit.images import encode_png, over_color, shrunk, to_bytes
from bbfit.views.view_set import ViewSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

Cost = Literal["vertices", "texels", "bytes"]
"""What a budget can limit."""
INK, FAINT, _LINE, PAPER = (32, 36, 42), (112, 118, 126), (214, 217, 222), (242, 243, 245)
_ROW_BACKGROUNDS = ("white", "grass", "sky", "black")  # of the rows of a comparison, in turn
_CELL_LEAST = 300  # pixels, for the text under a small picture


def comparison_picture(model: ShippedModel, views: ViewSet, path: str | Path, *, count: int = 4, title: str = "") -> None:
    """Write a PNG with one row per view, completely or not at all: target, result, and perceived difference, under a heading ``title``.

    The rows are ``count`` held-out views, spread evenly in azimuth (:func:`spread_views`). Pictures are shown pixel for pixel, the rows in
    turn over white, grass, sky and black (:data:`bbfit.evaluation.backgrounds.BACKGROUNDS`). The difference is the FLIP map over the same
    background (:func:`bbfit.evaluation.metrics.flip_map`) in the colors of magma; black is no difference. The text under each row has the
    view's name, azimuth and background, and PSNR, SSIM and mean FLIP over that background. Raises InputError like
    :func:`bbfit.evaluation.scoring.evaluate`.
    """
    from PIL import Image, ImageDraw

    check_count("count", count)
    if len(views) == 0:
        fail("views", "there is no held-out view to show", "give views with a test split")
    width, height = views.cameras.width, views.cameras.height
    metrics.check_size(width, height)
    angles = view_angles(views.cameras).numpy()
    rows = spread_views(angles, count)

    text = int(np.clip(width // 32, 12, 28))  # pixels
    cell, gap, line = max(width, _CELL_LEAST), text, 2 * text
    head = line * (3 if title else 2) - text // 2
    row = height + 3 * text
    size = (3 * cell + 4 * gap, head + len(rows) * row + text // 2)
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    font, bold = picture_font("DejaVuSans.ttf", text), picture_font("DejaVuSans-Bold.ttf", text)
    left = [gap + column * (cell + gap) for column in range(3)]

    if title:
        draw.text((gap, line // 2), title, INK, picture_font("DejaVuSans-Bold.ttf", text * 5 // 4))
    count = len(model.cloud)
    costs = f"{count} {'billboard' if count == 1 else 'billboards'}, {model.cards.vertex_count} vertices"
    for x, name, note in zip(left, ("Target", "Result", "Difference"), ("", costs, "FLIP"), strict=True):
        draw.text((x, head - text * 3 // 2), name, INK, bold)
        draw.text((x + bold.getlength(name + "  "), head - text * 3 // 2), note, FAINT, font)
    _color_bar(sheet, draw, font, left[2] + cell, head - text * 3 // 2, text)

    for number, index in enumerate(rows):
        top = head + number * row + text // 4
        background = _ROW_BACKGROUNDS[number % len(_ROW_BACKGROUNDS)]
        pair = over_background(*held_out(model.draw, views, index), background)
        error = metrics.flip_map(*pair)
        for x, picture in zip(left, (*(to_bytes(torch.from_numpy(one)) for one in pair), magma(error)), strict=True):
            x += (cell - width) // 2
            draw.rectangle((x - 1, top - 1, x + width, top + height), outline=_LINE)
            sheet.paste(Image.fromarray(picture), (x, top))
        captions = (
            f"{views.names[index]}  ·  azimuth {angles[index, 0]:.0f}°" + _height(angles[index, 1]),
            f"over {background}: PSNR {metrics.psnr(*pair):.2f} dB  ·  SSIM {metrics.ssim(*pair):.3f}",
            f"mean FLIP {error.mean():.3f}",
        )
        for x, caption in zip(left, captions, strict=True):
            draw.text((x, top + height + text // 2), caption, INK, font)
    write_bytes(path, encode_png(np.asarray(sheet)))


def spread_views(angles: NDArray[np.float64], count: int) -> list[int]:
    """Indices of at most ``count`` views that are spread evenly in azimuth, in order of azimuth.

    ``angles`` holds azimuth and elevation in degrees, [V, 2]. Starting from the first view, view k is the unused view nearest to the k-th
    part of a full turn; of equally near views it is the one nearest to the horizon.
    """
    unused = list(range(len(angles)))
    chosen: list[int] = []
    for k in range(min(count, len(angles))):
        wanted = angles[0, 0] + k * 360 / min(count, len(angles))
        away = {i: round(abs((angles[i, 0] - wanted + 180) % 360 - 180), 3) for i in unused}
        chosen.append(min(unused, key=lambda i: (away[i], abs(angles[i, 1]), i)))
        unused.remove(chosen[-1])
    return sorted(chosen, key=lambda i: (angles[i, 0], angles[i, 1]))


def plain_figure(
    size: tuple[float, float],
    dpi: int,
    *,
    panels: tuple[int, int] = (1, 1),
    margins: tuple[float, float, float, float] = (0.8, 0.2, 0.6, 0.4),
    between: float = 0.0,
) -> Figure:
    """A figure of matplotlib of a width and height, with left, right, lower and upper margins and gaps between its panels, in inches.

    ``panels`` is the number of rows and of columns. An automatic layout would measure every text several times, which takes longer than to
    draw the figure.
    """
    from matplotlib.figure import Figure

    (width, height), (left, right, bottom, top), (rows, columns) = size, margins, panels
    wide, high = (width - left - right - between * (columns - 1)) / columns, (height - bottom - top - between * (rows - 1)) / rows
    figure = Figure(figsize=size, dpi=dpi, layout="none")  # type: ignore[arg-type]  # whatever a notebook's settings say
    figure.subplots_adjust(left / width, bottom / height, 1 - right / width, 1 - top / height, between / wide, between / high)
    return figure


def loss_plot(losses: Sequence[float], path: str | Path) -> None:
    """Write a PNG with :func:`draw_losses`, completely or not at all."""
    figure = plain_figure((9, 5), 120)
    axes = figure.add_subplot()
    draw_losses(axes, losses)
    axes.grid(True, color="#e4e7ea", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    write_figure(figure, path)


def draw_losses(axes: Axes, losses: Sequence[float]) -> None:
    """Draw the loss of each step on a logarithmic axis, with its running mean over a fiftieth of the steps; InputError without losses.

    Values that are not finite and positive leave a gap.
    """
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

    values = np.asarray(losses, dtype=np.float64)
    if values.ndim != 1 or len(values) == 0:
        fail("losses", f"expected a list of at least one number, got shape {list(values.shape)}")
    shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    steps = np.arange(1, len(shown) + 1)
    window = max(len(shown) // 50, 1)
    color, raw = "#1f5f8b", "#a9c6da"
    axes.plot(steps, shown, color=raw if window > 1 else color, linewidth=0.8, marker="o" if len(steps) == 1 else None, label="each step")
    if window > 1:
        mean = running_mean(shown, window)
        axes.plot(steps, mean, color=color, linewidth=2, label=f"mean of {window} steps")
        axes.legend(frameon=False)
    if np.isfinite(shown).any():  # a logarithmic axis needs something positive
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
        final = float(np.nanmean(shown[-window:])) if np.isfinite(shown[-window:]).any() else float("nan")
        noun = "step" if len(steps) == 1 else "steps"
        axes.set_title(f"{len(steps):,} {noun}, {final:.4g} at the end", loc="left", fontsize=11)
    axes.set_xlim(0, max(len(steps), 2))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_xlabel("step")
    axes.set_ylabel("loss")


def pareto_plot(choice: Choice, path: str | Path, *, cost: Cost = "vertices") -> None:
    """Write a PNG of every trial's validation PSNR against its vertices, with the front and the choice marked, completely or not at all.

    If the budget limits another ``cost`` than vertices, that gets a second panel.
    """
    costs: list[Cost] = ["vertices"] if cost == "vertices" else ["vertices", cost]
    figure = plain_figure((9 if len(costs) == 1 else 14, 5), 120, panels=(1, len(costs)), between=0.6)
    for axes, name in zip(figure.subplots(1, len(costs), squeeze=False)[0], costs, strict=True):
        _draw_front(axes, choice, name)
    figure.axes[0].set_ylabel("PSNR of validation views, mean over backgrounds, dB")
    figure.axes[0].set_title("Short fits; numbers are billboards", loc="left", fontsize=11)
    figure.axes[0].legend(frameon=False, fontsize=9, loc="lower right")
    write_figure(figure, path)


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure of matplotlib as PNG, completely or not at all."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    write_bytes(path, buffer.getvalue())


def _draw_front(axes: Any, choice: Choice, cost: Cost) -> None:
    """One panel of :func:`pareto_plot`."""
    from matplotlib.ticker import FixedLocator, LogLocator, NullLocator, StrMethodFormatter

    trials, color = choice.trials, "#1f5f8b"
    points = [(float(getattr(trial, cost)), trial.psnr) for trial in trials]
    xs, ys = zip(*(points[index] for index in pareto_front(points)), strict=True)
    axes.plot(xs, ys, color="#a9c6da", linewidth=2, zorder=1, label="best for its cost")
    for placement, (marker, where) in {"clusters": ("o", "where the tree is"), "even": ("s", "even")}.items():
        for sides, many in {"one": "one side", "two": "two sides", "pair": "pairs"}.items():
            own = [point for point, trial in zip(points, trials, strict=True) if (trial.placement, trial.sides) == (placement, sides)]
            if own:
                xs, ys = zip(*own, strict=True)
                face = color if sides == "one" else "white"
                axes.scatter(xs, ys, s=36, marker=marker, facecolor=face, edgecolor=color, zorder=2, label=f"{where}, {many}")
    axes.scatter(*points[choice.chosen], s=220, facecolor="none", edgecolor="#c8501e", linewidth=2.5, zorder=3, label="chosen")
    for point, trial in zip(points, trials, strict=True):
        axes.annotate(str(trial.billboards), point, (0, 8), textcoords="offset points", ha="center", fontsize=8, color="#70767e")
    axes.set_xscale("log")
    doubling = [4 << power for power in range(12) if any(0.5 < (4 << power) / x < 2 for x, _ in points)]
    axes.xaxis.set_major_locator(FixedLocator(doubling) if cost == "vertices" else LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(cost)
    axes.grid(True, color="#e4e7ea", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def lod_picture(levels: Sequence[tuple[LodLevel, Callable[[Camera], Tensor]]], views: ViewSet, path: str | Path) -> None:
    """Write a PNG with one column per level of detail: one held-out view and the level, at the size at which the level takes over.

    Each level comes with what draws it, premultiplied RGBA [H, W, 4]. Pictures are enlarged to the width of the column without smoothing.
    """
    from PIL import Image, ImageDraw

    width, height = views.cameras.width, views.cameras.height
    index = next(filter(views.shows, range(len(views))), 0)
    alpha = views.targets([index])[0][..., 3]
    tall = int(np.ptp(np.flatnonzero(alpha.amax(1).numpy() > 0))) + 1 if views.shows(index) else height
    side, gap, text = 384, 16, 14
    sheet = Image.new("RGB", (gap + len(levels) * (side + gap), 2 * (side + gap) + gap + 3 * text), PAPER)
    draw, font, bold = ImageDraw.Draw(sheet), picture_font("DejaVuSans.ttf", text), picture_font("DejaVuSans-Bold.ttf", text)
    for column, (level, draw_level) in enumerate(levels):
        share = min(1.0, (level.tree_pixels or tall) / tall)
        size = max(metrics.SSIM_WINDOW, round(width * share)), max(metrics.SSIM_WINDOW, round(height * share))
        target = shrunk(views.targets([index])[0], *size)
        image = draw_level(views.cameras[index].resized(*size))
        left = gap + column * (side + gap)
        draw.text((left, gap // 2), level.name, INK, bold)
        draw.text((left, gap // 2 + text * 5 // 4), f"the tree is {tall * share:.0f} pixels high", FAINT, font)
        for row, picture in enumerate((target, image)):
            pixels = Image.fromarray(to_bytes(over_color(picture))).resize((side, side * height // width), Image.Resampling.NEAREST)
            sheet.paste(pixels, (left, 3 * text + gap + row * (side + gap)))
    write_bytes(path, encode_png(np.asarray(sheet)))


def running_mean(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Centered mean over ``window`` values, shorter at the ends, same length; NaN values are ignored, and the mean of none is NaN."""
    valid = np.isfinite(values)
    sums, counts = (np.concatenate([[0.0], np.cumsum(part)]) for part in (np.where(valid, values, 0.0), valid))
    index = np.arange(len(values))
    low, high = np.maximum(index - (window - 1) // 2, 0), np.minimum(index + window // 2 + 1, len(values))
    total, count = sums[high] - sums[low], counts[high] - counts[low]
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def magma(error: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Values in [0, 1] as magma's RGB bytes, [...] -> [..., 3]."""
    from matplotlib import colormaps

    return np.ascontiguousarray(colormaps["magma"](error, bytes=True)[..., :3])


def _color_bar(sheet: Any, draw: ImageDraw, font: FreeTypeFont, right: int, top: int, text: int) -> None:
    """The color scale of the difference, which ends at ``right``."""
    from PIL import Image

    length, thickness = 5 * text, text * 3 // 4
    end = right - int(font.getlength(" 1"))
    bar = np.broadcast_to(magma(np.linspace(0, 1, length)), (thickness, length, 3))
    sheet.paste(Image.fromarray(np.ascontiguousarray(bar)), (end - length, top + text // 4))
    draw.text((end, top), " 1", FAINT, font)
    draw.text((end - length, top), "0 ", FAINT, font, anchor="ra")


def _height(elevation: float) -> str:
    return f", elevation {elevation:.0f}°" if abs(elevation) >= 0.5 else ""


def picture_font(name: str, size: int) -> FreeTypeFont:
    """A font of matplotlib, so pictures look the same on all machines."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(Path(get_data_path(), "fonts", "ttf", name), size)
