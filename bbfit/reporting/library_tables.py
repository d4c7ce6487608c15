"""Tables of a library: its trees and levels, and the seconds of each stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from bbfit.exporting.lod import LodLevel
from bbfit.reporting.text import markdown

if TYPE_CHECKING:
    from rich.table import Table

_ORDER = ("grow", "convert", "views", "fit", "evaluate", "export", "report", "join", "cards")


def stage_sums(times: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Seconds of each stage, summed over trees, in the order of the stages."""
    names = {name for seconds in times.values() for name in seconds}
    order = [*(name for name in _ORDER if name in names), *sorted(names.difference(_ORDER))]
    return {name: sum(seconds.get(name, 0.0) for seconds in times.values()) for name in order}


def times_markdown(times: Mapping[str, Mapping[str, float]], after: Mapping[str, float]) -> str:
    """Seconds of each tree's stages as a table, and those of the work ``after`` all trees."""
    sums = stage_sums(times)
    rows = {name: [seconds.get(stage, 0.0) for stage in sums] for name, seconds in times.items()} | {"all trees": list(sums.values())}
    table = [[name, *(f"{value:.1f}" for value in (*seconds, sum(seconds)))] for name, seconds in rows.items()]
    trees = markdown(["tree", *sums, "together"], table)
    others = markdown(["after the trees", "seconds"], [[name, f"{seconds:.1f}"] for name, seconds in after.items()])
    note = "Trees that are made at the same time share the cores of the machine."
    return f"# Seconds of each stage\n\n{note}\n\n{trees}\n{others}"


def library_table(trees: Mapping[str, tuple[float, Sequence[LodLevel]]]) -> Table:
    """A ``rich`` table of the heights in meters and the levels of trees by their names."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("tree", "height, m"):
        table.add_column(name, justify="left" if name == "tree" else "right")
    for name in ("billboards", "vertices", "bytes", "from, m", "PSNR, dB"):
        table.add_column(name, justify="right")
    for tree, (height, levels) in trees.items():
        for number, level in enumerate(levels):
            table.add_row(
                Text(tree if number == 0 else ""),
                f"{height:.1f}" if number == 0 else "",
                level.content,
                f"{level.vertices:,}",
                f"{level.bytes:,}",
                f"{level.distance_meters:,.0f}",
                "-" if level.psnr is None else f"{level.psnr:.2f}",
            )
    return table


def times_table(times: Mapping[str, Mapping[str, float]], after: Mapping[str, float]) -> Table:
    """A ``rich`` table of the seconds of each stage over all trees and of the work ``after`` them, with their shares."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("stage")
    for name in ("seconds", "share"):
        table.add_column(name, justify="right")
    sums = stage_sums(times) | dict(after)
    total = sum(sums.values())
    for name, seconds in (*sums.items(), ("together", total)):
        table.add_row(name, f"{seconds:,.1f}", f"{seconds / max(total, 1e-9):.0%}")
    return table
