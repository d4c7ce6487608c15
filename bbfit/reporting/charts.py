"""Charts of a run as SVG. The page decides the colors, so the charts are readable on light and on dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bbfit.checks import fail
from bbfit.evaluation.report import SizeScore, ViewScore
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import corners
from bbfit.reporting.plots import draw_losses, plain_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Each color in a figure is replaced by the page's custom property.
_THEME = {"#000001": "--ink", "#70767e": "--faint", "#e4e7ea": "--grid", "#1f5f8b": "--accent", "#a9c6da": "--soft", "#c8501e": "--worst"}
_INK, _FAINT, _GRID, _ACCENT, _SOFT, _WORST = _THEME
# Width in inches, of 72 units of the SVG each: that of a phone, so that pages on phones do not shrink the charts.
_WIDTH = 5.4
# Least distance between the elevations beside the lines of a chart, in points.
_LABEL = 9.0


@dataclass(frozen=True)
class Chart:
    """A chart and the places of its marks."""

    svg: str
    """An ``<svg>`` element with custom properties in place of colors; all of its ids begin with the chart's name."""
    marks: Mapping[str, float]
    """Positions and lengths in the SVG's units, with which a script moves the marks."""


MEASURES = (("psnr", "PSNR, dB", max), ("ssim", "SSIM", max), ("flip", "FLIP", min))
"""Measures that are means over the backgrounds: name, title, and the function that gives the better of two values."""
FEW = 24
"""Most billboards that have numbers in the plan; the numbers of more would cover it."""
# Hues of medium lightness, which contrast with white and with black.
_HUES = ("#3b82c4", "#d9702b", "#3f9e4d", "#c94f4f", "#8f6bc1", "#a06a4e", "#d066a8", "#7d8590", "#a3a21f", "#2aa6b5")


def billboard_color(index: int) -> str:
    """The color of a billboard in all pictures; after ten billboards the colors repeat."""
    return _HUES[index % len(_HUES)]


def worst_views(views: Sequence[ViewScore]) -> dict[str, int]:
    """The index of the worst view by each of :data:`MEASURES`."""
    worst = {}
    for name, _, better in MEASURES:
        values = [float(getattr(view.measures.over.mean, name)) for view in views]
        worst[name] = values.index(min(values) if better is max else max(values))
    return worst


def azimuth_chart(views: Sequence[ViewScore]) -> Chart:
    """PSNR, SSIM and FLIP, means over the backgrounds, of every view against its azimuth, with the worst view of each measure marked.

    The id of a point is ``azimuth-MEASURE-INDEX``, with the view's index in ``views``. Lines join views of one elevation, which is written
    at their end if there are several elevations; with fewer than four views per elevation on average there are no lines.
    ``azimuth-cursor-MEASURE`` is a line at 0 degrees, and the mark ``degree`` is the width of one degree. Raises InputError without views.
    """
    if not views:
        fail("views", "there is none to draw")
    figure = _figure(5.6, len(MEASURES))
    worst = worst_views(views)
    panels = figure.subplots(len(MEASURES), 1, sharex=True)
    rings: dict[int, list[int]] = {}
    for index in sorted(range(len(views)), key=lambda index: views[index].azimuth_degrees):
        rings.setdefault(round(views[index].elevation_degrees), []).append(index)
    for axes, (name, title, _) in zip(panels, MEASURES, strict=True):
        values = [float(getattr(view.measures.over.mean, name)) for view in views]
        angles = [view.azimuth_degrees for view in views]
        axes.axvline(0, color=_FAINT, linewidth=1, gid=f"cursor-{name}")
        ends = list[tuple[float, int]]()
        if len(rings) <= len(views) / 4:
            for elevation, ring in rings.items():
                # The circle is closed: the line continues beyond both ends.
                around = [*((angles[i] - 360, values[i]) for i in ring[-1:]), *((angles[i], values[i]) for i in ring)]
                around += [(angles[i] + 360, values[i]) for i in ring[:1]]
                axes.plot(*zip(*around, strict=True), color=_SOFT, linewidth=1.5)
                ends.append((float(np.interp(365, *np.array(around).T)), elevation))
        for index, (angle, value) in enumerate(zip(angles, values, strict=True)):
            bad = index == worst[name]
            axes.plot([angle], [value], "o", markersize=7 if bad else 5, color=_WORST if bad else _ACCENT, gid=f"{name}-{index}")
        low = worst[name]
        axes.annotate(
            f"worst: {values[low]:.{2 if name == 'psnr' else 3}f}",
            (angles[low], values[low]),
            (-6 if angles[low] > 270 else 6, -6 if name != "flip" else 6),
            textcoords="offset points",
            ha="right" if angles[low] > 270 else "left",  # beside the line that marks the view
            va="top" if name != "flip" else "bottom",
            color=_WORST,
        )
        axes.set_title(title, loc="left", fontsize=10, color=_INK, pad=9)
        axes.margins(y=0.3)
        _plain(axes)
        if len(ends) > 1:
            _label_ends(axes, ends)
    panels[-1].set_xlim(-5, 365)
    panels[-1].set_xticks(range(0, 361, 45), [f"{angle}°" for angle in range(0, 361, 45)])
    panels[-1].set_xlabel("azimuth that the view looks from")
    svg = _svg(figure, "azimuth")
    zero, one = (panels[-1].transData.transform((degree, 0))[0] * 72 / figure.dpi for degree in (0, 1))
    return Chart(svg, {"degree": float(one - zero)})


def _label_ends(axes: Axes, ends: Sequence[tuple[float, int]]) -> None:
    """Write elevations in degrees where the lines of rings end, (value, elevation) each, moved apart if they would overlap."""
    low, high = axes.get_ylim()
    points = axes.get_window_extent().height * 72 / axes.figure.dpi / (high - low)
    ends, places = sorted(ends), list[float]()
    for value, _ in ends:
        places.append(max(value * points, places[-1] + _LABEL if places else -np.inf))
    shift = float(np.mean([value * points - place for (value, _), place in zip(ends, places, strict=True)]))
    for (value, elevation), place in zip(ends, places, strict=True):
        offset = place + shift - value * points
        axes.annotate(f"{elevation}°", (365, value), (3, offset), textcoords="offset points", va="center", color=_FAINT, fontsize=8)


def plan_chart(cloud: BillboardCloud) -> Chart:
    """The rectangles of the billboards from above, in meters, with azimuth 0 at the bottom. Up to :data:`FEW` are numbered from 1.

    Lower edges are thick, unless there are more; upright billboards are lines. ``plan-eye`` is a camera at azimuth 0. It orbits the center,
    at the marks ``x`` and ``y``.
    """
    from matplotlib.patches import Polygon

    figure = _figure(_WIDTH, left=0.72)
    axes = figure.subplots()
    quads = corners(cloud).cpu().numpy()
    middle = (quads.min((0, 1)) + quads.max((0, 1))) / 2 if len(cloud) else np.zeros(3)
    reach = float(np.linalg.norm((quads - middle)[..., [0, 2]], axis=-1).max()) if len(cloud) else 1.0
    few = len(cloud) <= FEW
    for index, quad in enumerate(quads):
        flat, color = quad[:, [0, 2]], billboard_color(index)
        axes.add_patch(Polygon(flat, facecolor=color, edgecolor=color, linewidth=1, alpha=0.22 if few else 0.1))
        lowest = np.argsort(quad[:, 1], kind="stable")[:2]
        axes.plot(*flat[lowest].T, color=color, linewidth=2.6 if few else 0.8, solid_capstyle="round")
        if not few:
            continue
        # The number is at the outer end of the lower edge, where lines do not cross.
        ends = flat[lowest] - middle[[0, 2]]
        end = ends[np.linalg.norm(ends, axis=-1).argmax()]
        x, z = middle[[0, 2]] + end * (1 + 0.09 * reach / max(float(np.linalg.norm(end)), 1e-9))
        axes.text(x, z, str(index + 1), ha="center", va="center", fontsize=10, color=color, fontweight="bold")
    out = 1.32 * reach
    eye = np.array([[0, 0.86], [-0.07, 1.0], [0.07, 1.0]]) * out
    axes.add_patch(Polygon(eye + middle[[0, 2]], facecolor=_WORST, edgecolor="none", gid="eye"))
    axes.set_xlim(middle[0] - out, middle[0] + out)
    axes.set_ylim(middle[2] + out, middle[2] - out)  # +Z, where azimuth 0 looks from, is at the bottom
    axes.set_aspect("equal")
    axes.set_xlabel("x, meters")
    axes.set_ylabel("z, meters")
    _plain(axes)
    svg = _svg(figure, "plan")
    x, y = axes.transData.transform(middle[[0, 2]]) * 72 / figure.dpi
    return Chart(svg, {"x": float(x), "y": float(figure.get_figheight() * 72 - y)})


def sizes_chart(sizes: Sequence[SizeScore]) -> Chart:
    """PSNR and coverage of the exported model in pictures of the views' size, half of it and so on.

    Dashed lines are those of a mask with alpha to coverage.
    """
    figure = _figure(3.9, 2)
    panels = figure.subplots(2, 1, sharex=True)
    ticks = [f"{size.width}" if number == 0 else f"1/{round(sizes[0].width / size.width)}" for number, size in enumerate(sizes)]
    panels[1].axhline(1, color=_FAINT, linewidth=1, linestyle=":")
    smooth = [size.antialiased for size in sizes if size.antialiased is not None]
    for measures, style in (([size.measures for size in sizes], "o-"), (smooth, "o--")):
        panels[0].plot(range(len(measures)), [one.psnr for one in measures], style, color=_ACCENT)
        known = [(place, one.coverage) for place, one in enumerate(measures) if one.coverage is not None]
        panels[1].plot([place for place, _ in known], [coverage for _, coverage in known], style, color=_ACCENT)
    panels[0].set_title("PSNR, dB", loc="left", fontsize=10, color=_INK, pad=9)
    low, high = panels[1].get_ylim()
    panels[1].set_ylim(min(low, 0.9), max(high, 1.1))
    panels[1].set_title("coverage, 1 is as much as the tree's", loc="left", fontsize=10, color=_INK, pad=9)
    panels[1].set_xticks(range(len(sizes)), ticks)
    panels[1].set_xlabel("width of the pictures in pixels, and parts of it")
    for axes in panels:
        axes.margins(y=0.25)
        _plain(axes)
    return Chart(_svg(figure, "sizes"), {})


def loss_chart(losses: Sequence[float]) -> Chart:
    """The loss of each step (:func:`~bbfit.reporting.plots.draw_losses`)."""
    figure = _figure(3.4, left=0.72)
    axes = figure.subplots()
    draw_losses(axes, losses)
    _plain(axes)
    return Chart(_svg(figure, "loss"), {})


def times_chart(seconds: Mapping[str, float]) -> Chart:
    """The seconds of each stage as a Gantt chart: stages run one after another, and each bar begins where the one before ends."""
    figure = _figure(0.85 + 0.3 * len(seconds), left=0.72)
    axes, begun, total = figure.subplots(), 0.0, max(sum(seconds.values()), 1e-9)
    for place, spent in enumerate(seconds.values()):
        axes.barh(place, spent, left=begun, height=0.62, color=_ACCENT)
        outside, at = (-4, begun) if begun + spent > 0.75 * total else (4, begun + spent)
        said = f"{spent:,.1f}" if spent < 100 else f"{spent:,.0f}"
        style: dict[str, Any] = {"va": "center", "ha": "left" if outside > 0 else "right", "fontsize": 9, "color": _FAINT}
        axes.annotate(said, (at, place), (outside, 0), textcoords="offset points", **style)
        begun += spent
    axes.set_yticks(range(len(seconds)), list(seconds))
    axes.invert_yaxis()
    axes.set_xlim(0, total)
    axes.set_xlabel("seconds since the start")
    _plain(axes)
    return Chart(_svg(figure, "times"), {})


def _figure(height: float, panels: int = 1, *, left: float = 0.52) -> Figure:
    """A figure with panels below each other and a margin of ``left`` inches."""
    return plain_figure((_WIDTH, height), 72, panels=(panels, 1), margins=(left, 0.15, 0.52, 0.33), between=0.45)


def _plain(axes: Axes) -> None:
    axes.grid(True, color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GRID)
    axes.tick_params(length=0, colors=_FAINT, labelsize=9)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=_FAINT, fontsize=9)
    axes.set_facecolor("none")


def _svg(figure: Figure, name: str) -> str:
    """The figure as an element for a page: colors as custom properties, text as text, ids that begin with ``name``."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figure.patch.set_visible(False)
    style: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": name, "font.family": "sans-serif"}
    buffer = io.StringIO()
    with rc_context(style):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'((?:xlink:)?href="#|url\(#)', rf"\g<1>{name}-", svg)
    svg = svg.replace("fill: #000000", f"fill: {_INK}").replace("stroke: #000000", f"stroke: {_INK}")
    for color, variable in _THEME.items():
        svg = svg.replace(color, f"var({variable})")
    return svg
