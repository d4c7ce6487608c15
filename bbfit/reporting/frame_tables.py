"""Tables and pictures of frame times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from bbfit.checks import check_record
from bbfit.files import read_json
from bbfit.inputs import reading
from bbfit.reporting.plots import write_figure
from bbfit.reporting.text import csv_bytes, markdown

FRAMES_FILE = "frames.json"
"""The file of all rows, of the machine, and of what frames take time for."""
ModelKind = Literal["mesh", "impostor", "levels"]
"""One model, an octahedral impostor, or several levels of detail."""


@dataclass(frozen=True)
class FrameRow:
    """The frame time of a field of one model."""

    program: str
    """The program that drew, with its version."""
    model: str
    """The model's short name."""
    title: str
    """What the model is, for the reader."""
    kind: ModelKind
    """What it consists of."""
    tree_pixels: int
    """Height of a tree in the picture, in pixels."""
    count: int
    """Number of trees."""
    ms: float
    """Median time of a frame in milliseconds."""
    update_ms: float
    """The part of it in which levels are chosen and trees are sorted."""
    frames: int
    """Number of frames of the median."""
    calls: int
    """Draw calls of a frame."""
    triangles: int
    """Triangles of a frame."""
    fragments: float | None
    """Fragments of these triangles, hidden and transparent ones included; ``None`` where they were not counted."""
    card_bytes: int | None
    """Bytes of vertices, indices, matrices and textures on the graphics card; ``None`` where they were not counted."""
    file_bytes: int
    """Bytes of the model's files."""
    flip: float | None
    """FLIP at this height in three.js, the mean over backgrounds and held-out views; 0 of the tree itself, ``None`` if not known."""
    psnr: float | None
    """PSNR in dB at this height; ``None`` if a picture shows the tree itself, or if not known."""
    error_pixels: float | None
    """The height of the tree in the pictures of ``flip``, which is at most that in the views."""


@dataclass(frozen=True)
class Machine:
    """What drew the frames."""

    processor: str
    """The processor, with its number of cores."""
    renderer: str
    """What the browser says that it draws with."""
    browser: str
    """The browser and its version."""
    picture: str
    """Size and samples of the picture."""
    load: float
    """Mean number of processes that wanted a core in the minute before the measurement."""


@dataclass(frozen=True)
class FrameCosts:
    """What the frames of a program take time for."""

    program: str
    """The program that drew, with its version."""
    tree_ns: float
    """Nanoseconds of a tree, whatever it consists of."""
    triangle_ns: float
    """Nanoseconds of a triangle."""
    fragment_ns: float
    """Nanoseconds of a fragment, whether it is hidden or not."""
    error: float
    """Median relative error of the frames' times that these three explain."""
    fields: int
    """Number of fields that they were found from."""

    @property
    def fragments_per_triangle(self) -> float | None:
        """Fragments that take as long as a triangle; ``None`` where fragments take no time."""
        return self.triangle_ns / self.fragment_ns if self.fragment_ns else None


def fastest(rows: Sequence[FrameRow]) -> set[str]:
    """The models of one program and height that no other model beats in both time and FLIP, at the largest number of trees of all models.

    A model that is as good in one and better in the other beats it too. Models without FLIP do not take part.
    """
    scored = [row for row in rows if row.flip is not None]
    counts = [{row.count for row in scored if row.model == name} for name in {row.model for row in scored}]
    count = max(set.intersection(*counts), default=None) if counts else None
    points = {row.model: (row.ms, row.flip or 0.0) for row in scored if row.count == count}

    def beaten(own: tuple[float, float]) -> bool:
        return any(all(a <= b for a, b in zip(other, own, strict=True)) and other != own for other in points.values())

    return {name for name, point in points.items() if not beaten(point)}


def frames_csv(rows: Sequence[FrameRow]) -> bytes:
    """CSV with one line for each field."""
    return csv_bytes([[field.name for field in fields(FrameRow)], *([*vars(row).values()] for row in rows)])


def frames_json(rows: Sequence[FrameRow], costs: Sequence[FrameCosts], machine: Machine) -> dict[str, Any]:
    """The machine, all rows, and what frames take time for."""
    return {"machine": asdict(machine), "rows": [asdict(row) for row in rows], "costs": [asdict(cost) for cost in costs]}


def read_costs(path: Path) -> tuple[FrameCosts, ...]:
    """What frames take time for, from the file of :func:`frames_json`. Raises ``InputError`` if it cannot be read."""
    stored = read_json("frames", path)
    with reading("frames", path, "start bbfit frames again"):
        costs = tuple(FrameCosts(**cost) for cost in stored["costs"])
        check_record("costs", costs, tuple[FrameCosts, ...])
    return costs


def frames_markdown(rows: Sequence[FrameRow], costs: Sequence[FrameCosts], machine: Machine) -> str:
    """A Markdown document: for each program and height a table of milliseconds by the number of trees, and what frames take time for."""
    parts = [
        "# Frame times",
        f"Medians in milliseconds of frames that were drawn to their end, on {machine.processor}, by {machine.renderer} in "
        f"{machine.browser}; {machine.picture}. In the minute before, {machine.load:.1f} processes wanted a core. A dash is a "
        "number of trees that was left out because fewer took too long. *Fragments* are those of a tree's triangles, hidden and "
        "transparent ones included, in thousands. FLIP and PSNR are means over four backgrounds and held-out views, drawn by three.js at "
        "this height, or at that of the views if they are smaller. A star marks the models that no other one beats in both time and FLIP.",
    ]
    if costs:
        parts += ["## What takes the time", markdown(["program", *_COSTS], [_cost_line(cost) for cost in costs])]
        parts.append("Give this folder to `bbfit lod --frames`: levels then take over only where they draw faster.")
    for program in dict.fromkeys(row.program for row in rows):
        for pixels in dict.fromkeys(row.tree_pixels for row in rows):
            of_field = [row for row in rows if (row.program, row.tree_pixels) == (program, pixels)]
            counts = sorted({row.count for row in of_field})
            head = [
                "model",
                *(f"{count:,}" for count in counts),
                "FLIP",
                "PSNR, dB",
                "draw calls",
                "triangles",
                "fragments",
                "MB on the card",
            ]
            names, best = dict.fromkeys(row.model for row in of_field), fastest(of_field)
            table = [_line([row for row in of_field if row.model == name], counts, star=name in best) for name in names]
            parts += [f"## {program}, {pixels} pixels high", markdown(head, table)]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


_COSTS = ("a tree, ns", "a triangle, ns", "a fragment, ns", "fragments that take as long as a triangle", "fields", "typical error")


def _cost_line(cost: FrameCosts) -> list[str]:
    ratio = cost.fragments_per_triangle
    times = [f"{time:,.1f}" for time in (cost.tree_ns, cost.triangle_ns, cost.fragment_ns)]
    return [cost.program, *times, "" if ratio is None else f"{ratio:.2g}", f"{cost.fields}", f"{100 * cost.error:.0f} %"]


def _line(rows: Sequence[FrameRow], counts: Sequence[int], *, star: bool) -> list[str]:
    """A line of a table: the rows of one model by their numbers of trees."""
    times, last = {row.count: row.ms for row in rows}, rows[-1]
    counted = next((row for row in reversed(rows) if row.fragments is not None), last)
    return [
        f"{last.title} *" if star else last.title,
        *(f"{times[count]:,.1f}" if count in times else "-" for count in counts),
        "" if last.flip is None else f"{last.flip:.4f}",
        "" if last.psnr is None else f"{last.psnr:.2f}",
        f"{last.calls:,}",
        f"{last.triangles / last.count:,.0f}",
        "" if counted.fragments is None else f"{counted.fragments / counted.count / 1000:,.1f}",
        "" if last.card_bytes is None else f"{last.card_bytes / 1e6:,.1f}",
    ]


def frames_plot(rows: Sequence[FrameRow], path: Path) -> None:
    """Write a PNG with a panel for each height: FLIP against the time of a frame in three.js, and how it grows with the number of trees.

    The upper row is at the largest number of trees that every model was drawn with. Without errors it is left out, and without rows no file
    is written.
    """
    rows = [row for row in rows if row.program.startswith("three")] or list(rows)
    if not rows:
        return
    from matplotlib.figure import Figure

    heights, names = list(dict.fromkeys(row.tree_pixels for row in rows)), list(dict.fromkeys(row.model for row in rows))
    scored = any(row.flip for row in rows)
    figure = Figure(figsize=(7 * len(heights), 10 if scored else 5.5), dpi=100, layout="constrained")
    panels = figure.subplots(1 + scored, len(heights), squeeze=False)
    for column, pixels in enumerate(heights):
        of_height = [row for row in rows if row.tree_pixels == pixels]
        if scored:
            _errors(panels[0][column], of_height, names, pixels)
        _growth(panels[-1][column], of_height, names, pixels)
    handles = {name: handle for panel in panels[-1] for handle, name in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, fontsize=8, loc="outside lower center", ncols=min(len(names), 4 * len(heights)))
    write_figure(figure, path)


def _errors(axis: Any, rows: Sequence[FrameRow], names: Sequence[str], pixels: int) -> None:
    counts = [{row.count for row in rows if row.model == name} for name in names if any(row.model == name for row in rows)]
    count = max(set.intersection(*counts), default=min(row.count for row in rows))
    for row in rows:
        if row.count == count and row.flip is not None:
            number, own = names.index(row.model), _is_own(row)
            marker = ("*", "P") if own else ("o", "s")
            axis.scatter(row.ms, row.flip, s=120 if own else 50, marker=marker[number // 10 % 2], color=f"C{number % 10}", zorder=3)
            axis.annotate(str(number + 1), (row.ms, row.flip), (6, 4), textcoords="offset points", fontsize=8, color="#70767e")
    axis.set_xscale("log")
    axis.xaxis.set_minor_formatter("")
    axis.set_title(f"{count:,} trees, {pixels} pixels high", fontsize=10)
    axis.set_xlabel("milliseconds a frame")
    axis.set_ylabel("FLIP, mean over backgrounds, lower is better")
    axis.margins(x=0.25)
    axis.grid(alpha=0.3)


def _is_own(row: FrameRow) -> bool:
    """Whether bbfit made the model."""
    return row.model.startswith("bbfit") or row.kind == "levels"


def _growth(axis: Any, rows: Sequence[FrameRow], names: Sequence[str], pixels: int) -> None:
    for number, name in enumerate(names):
        of_model = [row for row in rows if row.model == name]
        if of_model:
            own = _is_own(of_model[0])
            line = {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else "--", "marker": "*" if own else "o"}
            axis.plot(
                [row.count for row in of_model],
                [row.ms for row in of_model],
                label=f"{number + 1} {name}",
                markersize=8 if own else 4,
                **line,
            )
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_title(f"trees of {pixels} pixels", fontsize=10)
    axis.set_xlabel("number of trees")
    axis.set_ylabel("milliseconds a frame")
    axis.grid(alpha=0.3)
