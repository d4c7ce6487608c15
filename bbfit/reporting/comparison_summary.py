"""Tables and pictures of a comparison over trees: means, spreads, and who is best at which cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, geometric_mean, stdev
from typing import Any

from bbfit.budget.choice import pareto_front
from bbfit.reporting.comparison_tables import FAR, CompareCosts, CompareRow, far_figures, far_markdown
from bbfit.reporting.plots import write_figure
from bbfit.reporting.text import csv_bytes, markdown

COSTS = {
    "bytes": "bytes",
    "vertices": "vertices",
    "shaded": "shaded pixels for each covered pixel",
    "seconds": "seconds to make",
    "drawing": "drawing from afar: shaded pixels and triangles, in pixels",
}
"""The costs that fronts are drawn against, with their names in pictures. The quality at the cost of drawing is that from afar."""
_QUALITIES = {"psnr": "PSNR, dB, mean over backgrounds", "flip": "FLIP, mean over backgrounds, lower is better"}


@dataclass(frozen=True)
class Spread:
    """The mean of a figure over trees, and how far the trees are from it."""

    mean: float
    """The mean; for costs the geometric mean."""
    deviation: float
    """The standard deviation over the trees, 0 for one tree."""


@dataclass(frozen=True)
class FarSummary:
    """The scores of one system from afar, over trees."""

    psnr: Spread
    """PSNR in dB, a mean over backgrounds and views."""
    flip: Spread
    """FLIP in [0, 1], a mean over backgrounds and views."""
    triangles: Spread | None
    """Triangles that are drawn; ``None`` if not known."""
    fragments: Spread | None
    """Fragments that a graphics card shades for a picture; ``None`` if not known."""


@dataclass(frozen=True)
class SystemSummary:
    """The results of one system over trees."""

    system: str
    """Its short name."""
    title: str
    """What the system does, for the reader."""
    trees: int
    """Number of trees that it was scored on."""
    shader: bool
    """Whether a program needs a shader or a decoder of its own to show it."""
    psnr: Spread
    """PSNR in dB, a mean over backgrounds and views."""
    flip: Spread
    """FLIP in [0, 1], a mean over backgrounds and views."""
    costs: Mapping[str, Spread | None]
    """By the names of :data:`COSTS`; ``None`` where one is not known for all trees."""
    far: FarSummary | None
    """The same from afar; ``None`` where it was not scored on all trees."""

    @property
    def marked(self) -> str:
        """The title, with a star if a program needs a shader or a decoder of its own."""
        return self.title + ("*" if self.shader else "")

    def quality(self, name: str, cost: str) -> Spread | None:
        """``psnr`` or ``flip`` in the pictures that a cost of :data:`COSTS` is about."""
        scores = self.far if cost == "drawing" else self
        quality: Spread | None = None if scores is None else getattr(scores, name)
        return quality


def summaries(rows: Mapping[str, Sequence[CompareRow]]) -> list[SystemSummary]:
    """The summary of each system that was drawn on every tree, in the order of the first tree's rows. ``rows`` are by the trees' names."""
    by_tree = [{row.system: row for row in of_tree if row.measures is not None} for of_tree in rows.values()]
    names = by_tree[0] if by_tree else {}
    return [_summary([of_tree[name] for of_tree in by_tree]) for name in names if all(name in each for each in by_tree)]


def _summary(rows: Sequence[CompareRow]) -> SystemSummary:
    over = [row.measures.over.mean for row in rows if row.measures is not None]
    return SystemSummary(
        rows[0].system,
        rows[0].title,
        len(rows),
        rows[0].costs.shader,
        _spread([each.psnr for each in over]),
        _spread([each.flip for each in over]),
        {name: _cost([getattr(row.costs, name) for row in rows]) for name in COSTS},
        _far(rows),
    )


def _far(rows: Sequence[CompareRow]) -> FarSummary | None:
    scores = [row.far for row in rows if row.far is not None]
    if len(scores) < len(rows):
        return None
    return FarSummary(
        _spread([score.psnr for score in scores]),
        _spread([score.flip for score in scores]),
        _cost([row.costs.triangles for row in rows]),
        _cost([score.fragments for score in scores]),
    )


def _cost(values: Sequence[float | None]) -> Spread | None:
    known = [value for value in values if value]
    return _spread(known, costs=True) if len(known) == len(values) else None


def _spread(values: Sequence[float], *, costs: bool = False) -> Spread:
    return Spread((geometric_mean if costs else fmean)(values), stdev(values) if len(values) > 1 else 0.0)


def front(systems: Sequence[SystemSummary], cost: str, quality: str) -> list[SystemSummary]:
    """The systems on the Pareto front of a cost (:data:`COSTS`) and ``psnr`` or ``flip``, by increasing cost.

    Those that need a shader or a decoder of their own and those without this cost are left out.
    """
    known = [(each, *point) for each in systems if not each.shader and (point := _point(each, cost, quality)) is not None]
    sign = 1 if quality == "psnr" else -1
    return [known[index][0] for index in pareto_front([(spent.mean, sign * value.mean) for _, spent, value in known])]


def _point(system: SystemSummary, cost: str, quality: str) -> tuple[Spread, Spread] | None:
    """A cost and the quality in the pictures that it is about; ``None`` if one is not known."""
    spent, value = system.costs[cost], system.quality(quality, cost)
    return None if spent is None or value is None else (spent, value)


def summary_csv(rows: Mapping[str, Sequence[CompareRow]]) -> bytes:
    """CSV with one line for each system of each tree: its costs, PSNR and FLIP over the backgrounds and over white, and its note."""
    names = list(CompareCosts.__dataclass_fields__)
    table: list[list[Any]] = [
        ["tree", "system", *names, "psnr", "flip", "white_psnr", "white_flip", *(f"far_{name}" for name in FAR), "note"]
    ]
    for tree, row in ((tree, row) for tree, of_tree in rows.items() for row in of_tree):
        over = None if row.measures is None else row.measures.over
        figures = [None] * 4 if over is None else [over.mean.psnr, over.mean.flip, over.white.psnr, over.white.flip]
        table.append([tree, row.system, *vars(row.costs).values(), *figures, *far_figures(row.far), row.note])
    return csv_bytes(table)


def summary_markdown(rows: Mapping[str, Sequence[CompareRow]], failures: Mapping[str, str]) -> str:
    """A Markdown document: means and spreads of each system, the fronts, PSNR on each tree, and the trees that failed with the reasons."""
    systems = summaries(rows)
    head = ["system", "vertices", "bytes", "shaded", "seconds", "PSNR, dB", "±", "FLIP", "±"]
    table = []
    for each in systems:
        costs = [_number(each.costs[name]) for name in ("vertices", "bytes", "shaded", "seconds")]
        scores = [f"{each.psnr.mean:.2f}", f"{each.psnr.deviation:.2f}", f"{each.flip.mean:.4f}", f"{each.flip.deviation:.4f}"]
        table.append([each.marked, *costs, *scores])
    parts = [
        "# Comparison over trees",
        f"Means over {len(rows)} trees; costs are geometric means, and ± is the standard deviation over the trees. PSNR and FLIP are means "
        "over four backgrounds. Systems with a star need a shader or a decoder of their own in every program.",
        markdown(head, table),
        _far_part(rows, systems),
        "## Fronts",
        "Which systems does no other match that costs no more? Systems with a star are left out. From cheap to dear:",
        "\n".join(
            f"- {quality.upper()} and {cost}: {', '.join(each.system for each in front(systems, cost, quality)) or 'none'}"
            for cost in COSTS
            for quality in _QUALITIES
        ),
        "## PSNR on each tree",
        markdown(["system", *rows], [[each.title, *_psnrs(rows, each.system)] for each in systems]),
    ]
    if failures:
        parts += ["## Trees that failed", "\n".join(f"- {name}: {reason}" for name, reason in failures.items())]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def _far_part(rows: Mapping[str, Sequence[CompareRow]], systems: Sequence[SystemSummary]) -> str:
    """The part of the document about pictures from afar."""
    heights = [row.far.tree_pixels for of_tree in rows.values() for row in of_tree if row.far is not None]
    scored = [(each, each.far) for each in systems if each.far is not None]
    lines = [
        (each.marked, _mean(far.triangles), _mean(far.fragments), _mean(each.costs["drawing"]), far.psnr.mean, far.flip.mean)
        for each, far in scored
    ]
    return far_markdown(max(heights, default=0.0), lines)


def _mean(spread: Spread | None) -> float | None:
    return None if spread is None else spread.mean


def _psnrs(rows: Mapping[str, Sequence[CompareRow]], system: str) -> list[str]:
    found = [next(row for row in of_tree if row.system == system) for of_tree in rows.values()]
    return ["" if row.measures is None else f"{row.measures.over.mean.psnr:.2f}" for row in found]


def _number(spread: Spread | None) -> str:
    if spread is None:
        return ""
    return f"{spread.mean:,.0f}" if spread.mean >= 100 else f"{spread.mean:.1f}"


def compare_plot(systems: Sequence[SystemSummary], path: Path) -> None:
    """Write a PNG with PSNR and FLIP against each cost, and their fronts: one point for each system, with its spread over trees.

    Points have numbers, which the legend explains. Systems that need a shader or a decoder of their own are hollow, and not part of the
    fronts.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    colors = [color for name in ("tab10", "Dark2", "tab20b") for color in colormaps[name](range(colormaps[name].N))]
    figure, points = Figure(figsize=(27, 11), dpi=100, layout="constrained"), dict[str, Any]()
    axes = figure.subplots(len(_QUALITIES), len(COSTS), sharex="col", sharey="row")
    for line, quality in enumerate(_QUALITIES):
        for column, cost in enumerate(COSTS):
            axis = axes[line][column]
            best = front(systems, cost, quality)
            axis.set_xscale("log")
            known = [spread.mean for each in systems if (spread := each.costs[cost]) is not None]
            if known:
                axis.set_xlim(min(known) / 2, max(known) * 2)
            if len(best) > 1:
                axis.step(*_corners(best, cost, quality), where="post", color="#9aa3ad", linewidth=1, zorder=1)
            for number, each in enumerate(systems):
                point, own = _point(each, cost, quality), each.system.startswith("bbfit")
                if point is None:
                    continue
                spread, value = point
                color, at = colors[number % len(colors)], (spread.mean, value.mean)
                axis.errorbar(*at, value.deviation, color=color, elinewidth=0.6, alpha=0.5, zorder=2)
                face = "none" if each.shader else color
                label, marker = f"{number + 1}  {each.system}", "*" if own else "o"
                points[label] = axis.scatter(*at, s=110 if own else 45, marker=marker, edgecolor=color, facecolor=face, zorder=3)
                axis.annotate(str(number + 1), at, (5, 4), textcoords="offset points", fontsize=8, color="#70767e")
            axis.grid(alpha=0.3)
            if cost == "drawing":
                axis.set_ylabel(f"from afar: {_QUALITIES[quality]}")
            if line == len(_QUALITIES) - 1:
                axis.set_xlabel(COSTS[cost])
        axes[line][0].set_ylabel(_QUALITIES[quality])
    in_order = sorted(points, key=lambda label: int(label.split()[0]))
    figure.legend([points[label] for label in in_order], in_order, loc="outside lower center", ncols=7, fontsize=9, frameon=False)
    write_figure(figure, path)


def _corners(systems: Sequence[SystemSummary], cost: str, quality: str) -> tuple[list[float], list[float]]:
    points = [point for each in systems if (point := _point(each, cost, quality)) is not None]
    return [spent.mean for spent, _ in points], [value.mean for _, value in points]
