"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from bbfit.evaluation.report import Cost, Report
from bbfit.exporting.lod import LodLevel
from bbfit.reporting.comparison_summary import summaries
from bbfit.reporting.comparison_tables import CompareRow
from bbfit.reporting.frame_tables import FrameRow
from bbfit.reporting.sweep_tables import MEASURES, SweepRow, label_names
from bbfit.reporting.text import percent
from bbfit.trees.species import Species

if TYPE_CHECKING:
    from rich.table import Table

# Reports with more rings than this are shown without rings.
_MOST_RINGS = 8
_MEANS = "PSNR, SSIM and FLIP: means over four backgrounds"
# Costs of a comparison over trees, with their digits.
_COSTS = (("vertices", 0), ("bytes", 0), ("shaded", 1), ("seconds", 1))
_UP, _DOWN, _ONE = "↑", "↓", "→ 1"


def species_table(species: Sequence[Species]) -> Table:
    """A ``rich`` table of species: name, height and levels of stems."""
    from rich.text import Text

    table = _table(["species"], ["height, m", "levels of stems"])
    for one in species:
        table.add_row(Text(one.name), f"{one.scale:g} ± {one.scale_v:g}", str(one.levels))
    return table


def report_table(report: Report, title: str = "Held-out views", *, thesis: bool = True) -> Table:
    """A ``rich`` table of the mean measures and the costs, at most 100 columns wide.

    An arrow shows which direction is better. With ``thesis`` a last column has the thesis scale, for comparison with the thesis's figures.
    """
    mean, count = report.mean, len(report.views)
    from rich.text import Text

    table = _table(["measure"], [])
    table.title, table.title_style = f"{title}: mean of {count}" if count > 1 else f"{title}: one view", "bold"
    table.add_column("better", justify="center", style="dim")
    for name in ("mean over\nbackgrounds", "over\nwhite", "RGBA"):
        table.add_column(name, justify="right")
    table.add_column("thesis\nscale" if thesis else "", justify="right", style="dim")

    def cell(text: str) -> str:
        return text if thesis else ""

    over, white, rgba, scale, color = mean.over.mean, mean.over_white, mean.rgba, mean.thesis_scale, mean.colour
    table.add_row("PSNR, dB", _UP, f"{over.psnr:.2f}", f"{white.psnr:.2f}", f"{rgba.psnr:.2f}", cell(f"{scale.psnr:.3f}"))
    table.add_row("SSIM", _UP, f"{over.ssim:.4f}", f"{white.ssim:.4f}", "", cell(f"{scale.ssim:.7f}"))
    table.add_row("FLIP", _DOWN, f"{over.flip:.4f}", f"{white.flip:.4f}", "", "")
    table.add_row("RMSE", _DOWN, "", "", f"{rgba.rmse:.4f}", cell(f"{scale.rmse:.2e}"))
    if thesis:
        table.add_row("SRE, dB", _UP, "", "", "", f"{scale.sre:.3f}")
    table.add_row("silhouette IoU", _UP, "", "", f"{rgba.iou:.4f}", "")
    table.add_row("sharpness", _ONE, "", _share(mean.sharpness), "", "")
    table.add_row("color ΔE", _DOWN, "", "", "-" if color.delta_e is None else f"{color.delta_e:.2f}", "")
    table.add_row("color chroma", _ONE, "", "", _share(color.chroma), "")
    table.add_row("color brightness", _ONE, "", "", _share(color.brightness), "")
    table.add_row("... with holes", _ONE, "", "", _share(mean.brightness), "")

    if report.trunk is not None:
        trunk = report.trunk
        table.add_row("trunk's IoU, worst view", _UP, "", "", f"{trunk.iou:.4f}, {trunk.worst.iou:.4f}", "")

    if report.light is not None:
        table.add_section()
        table.add_row("under other suns", "", "", "", "", "", style="bold")
        light = report.light
        table.add_row("PSNR, dB", _UP, f"{light.psnr:.2f}", "", "", "")
        table.add_row("FLIP", _DOWN, f"{light.flip:.4f}", "", "", "")
        table.add_row("PSNR of blocks, dB", _UP, "", "", "-" if light.low is None else f"{light.low:.2f}", "")
        table.add_row("change of light, R2", _ONE, "", "", _share(light.r2), "")
        for name, value, digits, unit in (
            ("drift, turned by 90°", light.drift, 4, ""),
            ("base color of blocks", light.albedo, 4, ""),
            ("normals of blocks", light.normal_degrees, 1, "°"),
        ):
            if value is not None:
                table.add_row(name, _DOWN, "", "", f"{value:.{digits}f}{unit}", "")

    if report.antialiased is not None:
        table.add_section()
        table.add_row("with alpha to coverage", "", "", "", "", "", style="bold")
        smooth = report.antialiased
        for name, better, field, digits in (("PSNR, dB", _UP, "psnr", 2), ("SSIM", _UP, "ssim", 4), ("FLIP", _DOWN, "flip", 4)):
            values = [f"{getattr(one, field):.{digits}f}" for one in (smooth.over.mean, smooth.over_white)]
            table.add_row(name, better, *values, "", "")

    if 1 < len(report.rings) <= _MOST_RINGS:
        table.add_section()
        for ring in report.rings:
            measures = ring.measures
            values = [f"{one.psnr:.2f}" for one in (measures.over.mean, measures.over_white, measures.rgba)]
            table.add_row(f"PSNR, dB, at {ring.elevation_degrees:.0f}°", _UP, *values, cell(f"{measures.thesis_scale.psnr:.3f}"))

    if report.sizes:
        table.add_section()
        for title, each in (("as exported", "measures"), ("... with alpha to coverage", "antialiased")):
            if getattr(report.sizes[0], each) is None:
                continue
            table.add_row(title, "", "PSNR, dB", "", "coverage", "", style="bold")
            for size in report.sizes:
                one = getattr(size, each)
                table.add_row(f"{size.width} x {size.height} pixels", f"{_UP} {_ONE}", f"{one.psnr:.2f}", "", _share(one.coverage), "")

    if report.shimmer:
        table.add_section()
        smooth_title = "" if report.shimmer[0].antialiased is None else "alpha to\ncoverage"
        table.add_row("shimmer, over the tree's", "", "", "", "ratio", smooth_title, style="bold")
        for one in report.shimmer:
            smooth_ratio = "" if one.antialiased is None else _share(one.antialiased)
            table.add_row(f"{one.width} x {one.height} pixels", _ONE, "", "", _share(one.ratio), smooth_ratio)

    table.add_section()
    table.add_row("cost", "", "model", "", "original", Text("ratio", style="not dim"), style="bold")
    for name, cost in (("vertices", report.vertices), ("file, bytes", report.bytes)):
        table.add_row(name, _DOWN, _count(cost.model), "", _count(cost.original), _percent(cost))
    if report.overdraw is not None:
        table.add_row("empty area drawn", _DOWN, f"{100 * report.overdraw:.3g} %", "", "", "")
    if report.shaded is not None:
        table.add_row("shaded / covered pixels", _DOWN, f"{report.shaded:.2f}", "", "", "")
    if report.seconds:
        table.caption = "seconds: " + "  ·  ".join(f"{stage} {seconds:,.1f}" for stage, seconds in report.seconds.items())
        table.caption_justify = "left"
    return table


def lod_table(levels: Sequence[LodLevel]) -> Table:
    """A ``rich`` table of levels of detail: costs, the distance of each and those that silhouette and colors ask for, and errors.

    Where speed counts, one column has the larger of these two distances, and the next one that of speed.
    """
    timed = any(level.fragments is not None for level in levels)
    asking = ["errors", "speed"] if timed else ["outline", "colors"]
    table = _table(["level"], ["planes", "vertices", "bytes", "from, m", *asking, "px", "error", "FLIP"], no_wrap=True)
    table.caption = f"{', '.join(asking)}: distances that they ask for, m; px: height of the tree; error: of the outline, px"
    table.caption_justify = "left"
    for level in levels:
        costs = ["thinned" if level.planes is None and level.psnr else level.content, _count(level.vertices), _count(level.bytes)]
        cells = [f"{level.distance_meters:.1f}", *["-"] * (len(asking) + 3)]
        if level.content != "tree":
            distances = [level.silhouette_distance_meters, level.color_distance_meters]
            distances = [max(distances), level.speed_distance_meters] if timed else distances
            asked = [f"{distance:.1f}" for distance in distances]
            below = "-" if level.tree_pixels is None else f"{level.tree_pixels:.0f}"
            cells[1:] = [*asked, below, f"{level.error_pixels:.2f}", f"{level.color_error:.2f}"]
        table.add_row(level.name.rsplit("_", 1)[-1], *costs, *cells)
    return table


def sweep_table(rows: Sequence[SweepRow]) -> Table:
    """A ``rich`` table with one line per run: measures, which are means over the backgrounds, and costs, or the reason of its failure."""
    from rich.text import Text  # of names and reasons, in which brackets are no markup

    labels = label_names(rows)
    table = _table(["tree", *labels], ["PSNR, dB", "SSIM", "FLIP", "vertices", "bytes", "seconds"])
    table.caption, table.caption_justify = _MEANS, "left"
    for row in rows:
        start = [Text(row.tree), *(Text(row.labels.get(name, "")) for name in labels)]
        if row.facts is None:
            table.add_row(*start, Text(f"failed: {row.reason}"), style="yellow")
            continue
        report = row.facts["report"]
        measures = [f"{measure.of(row):{measure.digits}}" for measure in MEASURES[:3]]
        costs = [_count(report[name]["model"]) for name in ("vertices", "bytes")]
        table.add_row(*start, *measures, *costs, f"{row.seconds:.1f}")
    return table


def compare_table(rows: Sequence[CompareRow]) -> Table:
    """A ``rich`` table with one line per system: its costs and its measures on the held-out views, means over the backgrounds."""
    table = _table(["system"], ["PSNR, dB", "SSIM", "FLIP", "lit, dB", "planes", "vertices", "bytes", "seconds"], no_wrap=True)
    table.caption, table.caption_justify = f"{_MEANS}; lit: PSNR under other suns", "left"
    for row in rows:
        over = None if row.measures is None else row.measures.over.mean
        scores = ["-"] * 3 if over is None else [f"{over.psnr:.2f}", f"{over.ssim:.3f}", f"{over.flip:.3f}"]
        costs = row.costs
        seconds = "-" if costs.seconds is None else f"{costs.seconds:,.1f}"
        lit = "-" if row.light is None else f"{row.light['psnr']:.2f}"
        table.add_row(row.title, *scores, lit, _count(costs.planes), _count(costs.vertices), _count(costs.bytes), seconds)
    return table


def summary_table(rows: Mapping[str, Sequence[CompareRow]]) -> Table:
    """A ``rich`` table with one line per system: means of its costs and measures over trees, whose rows are given by their names."""
    head = ["PSNR, dB", "±", "FLIP", "vertices", "bytes", "shaded", "seconds"]
    table = _table(["system"], head, no_wrap=True)
    table.caption, table.caption_justify = f"{_MEANS} and {len(rows)} trees; ±: standard deviation over the trees", "left"
    for each in summaries(rows):
        costs = ("-" if (spread := each.costs[name]) is None else f"{spread.mean:,.{digits}f}" for name, digits in _COSTS)
        table.add_row(each.title, f"{each.psnr.mean:.2f}", f"{each.psnr.deviation:.2f}", f"{each.flip.mean:.3f}", *costs)
    return table


def frames_table(rows: Sequence[FrameRow]) -> list[Table]:
    """A ``rich`` table for each program and height, with one line per model: milliseconds of a frame by the number of trees."""
    tables = []
    for program, pixels in dict.fromkeys((row.program, row.tree_pixels) for row in rows):
        of_field = [row for row in rows if (row.program, row.tree_pixels) == (program, pixels)]
        counts = sorted({row.count for row in of_field})
        table = _table(["model"], [*(f"{count:,}" for count in counts), "FLIP", "triangles"])
        table.title, table.title_justify = f"{program}: ms a frame by the number of trees of {pixels} pixels", "left"
        for name in dict.fromkeys(row.model for row in of_field):
            own = {row.count: row for row in of_field if row.model == name}
            last = own[max(own)]
            times = [f"{own[count].ms:,.1f}" if count in own else "-" for count in counts]
            table.add_row(last.title, *times, "-" if last.flip is None else f"{last.flip:.3f}", f"{last.triangles / last.count:,.0f}")
        tables.append(table)
    return tables


def _table(texts: Sequence[str], numbers: Sequence[str], *, no_wrap: bool = False) -> Table:
    """An empty table with columns of text and columns of numbers, which ``no_wrap`` keeps on one line and close together."""
    from rich import box
    from rich.table import Table

    table = Table(*texts, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=no_wrap)
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=no_wrap)
    return table


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _count(value: int | None) -> str:
    return "-" if value is None else f"{value:,}"


def _percent(cost: Cost) -> str:
    return "-" if cost.ratio is None else percent(cost.ratio)
