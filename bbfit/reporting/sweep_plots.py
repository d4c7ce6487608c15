"""The picture of a sweep: the quality of each configuration, tree by tree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bbfit.reporting.plots import write_figure
from bbfit.reporting.sweep_tables import BILLBOARDS, MEASURES, SweepRow, count_order, label_names

_MEASURES = (MEASURES[0], MEASURES[2])
# Line styles distinguish losses, colors the other labels.
_STYLES = ("-", "--", ":", "-.")
# Markers of ten colors each.
_MARKERS = "os^Dv*"


def sweep_plot(rows: Sequence[SweepRow], path: Path) -> None:
    """Write a PNG: PSNR and FLIP, means over the backgrounds, against the number of billboards, with a column for each tree and a line for
    each configuration.

    If all runs have the same number of billboards, the axis shows the labels instead. Without finished runs no file is written.
    """
    done = [row for row in rows if row.reason is None]
    if not done:
        return
    from matplotlib.figure import Figure

    names = [name for name in label_names(done) if name != BILLBOARDS]
    dashed = next((name for name in names if name == "loss"), None)
    trees = list(dict.fromkeys(row.tree for row in done))
    counts = sorted({row.labels.get(BILLBOARDS, "") for row in done}, key=count_order)
    counted, shown = len(counts) > 1, dict[str, Any]()
    figure = Figure(figsize=(1.5 + 3.4 * len(trees), 6.6), dpi=110, layout="constrained")
    axes = figure.subplots(len(_MEASURES), len(trees), squeeze=False, sharex=True)
    colors = {key: f"C{number}" for number, key in enumerate(dict.fromkeys(_key(row, names, dashed) for row in done))}
    styles = {value: _STYLES[number % 4] for number, value in enumerate(dict.fromkeys(row.labels.get(dashed or "") for row in done))}
    for (line, measure), (column, tree) in ((a, b) for a in enumerate(_MEASURES) for b in enumerate(trees)):
        axis = axes[line][column]
        for (key, style), group in _groups([row for row in done if row.tree == tree], names, dashed).items():
            points = sorted(
                (counts.index(row.labels.get(BILLBOARDS, "")), value) for row in group if (value := measure.of(row)) is not None
            )
            label = ", ".join(filter(None, (key, style)))
            where = [point[0] for point in points] if counted else [label or "runs"] * len(points)
            look = {"color": colors[key], "marker": _MARKERS[int(colors[key][1:]) // 10 % len(_MARKERS)], "markersize": 3}
            (shown[label],) = axis.plot(where, [point[1] for point in points], styles[style], **look)
        axis.grid(alpha=0.3)
        if line == 0:
            axis.set_title(tree)
        if column == 0:
            axis.set_ylabel(f"{measure.name}, mean over backgrounds" + ("\nless is better" if measure.more is False else ""))
        if not counted:
            axis.tick_params(axis="x", rotation=60)
        else:
            axis.set_xticks(range(len(counts)), counts)
            if line == len(_MEASURES) - 1:
                axis.set_xlabel(BILLBOARDS)
    if counted and len(shown) > 1:
        figure.legend(shown.values(), shown, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    write_figure(figure, path)


def _key(row: SweepRow, names: Sequence[str], dashed: str | None) -> str:
    """The labels that decide the color of a run."""
    return ", ".join(row.labels.get(name, "") for name in names if name != dashed)


def _groups(rows: Sequence[SweepRow], names: Sequence[str], dashed: str | None) -> dict[tuple[str, str | None], list[SweepRow]]:
    """The runs of each line, by color and line style."""
    found: dict[tuple[str, str | None], list[SweepRow]] = {}
    for row in rows:
        found.setdefault((_key(row, names, dashed), row.labels.get(dashed or "")), []).append(row)
    return found
