"""Tables of many runs: CSV with one line per run, and Markdown with measures, costs and the comparison with the thesis."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from bbfit.evaluation.measures import ThesisScale
from bbfit.evaluation.published import RATIOS_PERCENT, Experiment, published_figures
from bbfit.reporting.text import csv_bytes, markdown, percent

BILLBOARDS = "billboards"
_MEANS = "Means over the held-out views. PSNR, SSIM and FLIP are also means over four backgrounds: white, black, grass and sky."


@dataclass(frozen=True)
class SweepRow:
    """One run of a sweep, or the reason of its failure."""

    tree: str
    """Name of the tree."""
    labels: Mapping[str, str]
    """Its place in the grid: names and values in the order of the grid."""
    steps: int
    """Optimizer steps."""
    facts: Mapping[str, Any] | None
    """Its results: ``report`` (:meth:`bbfit.evaluation.report.Report.to_json` without views and rings), ``billboards`` and ``texels``;
    ``None`` if it failed."""
    reason: str | None
    """Why it failed."""
    seconds: float
    """Time of the run."""
    folder: str
    """Folder of its results within the sweep's folder."""

    @property
    def published(self) -> ThesisScale | None:
        """The thesis's result for this tree's species and configuration, if there is one."""
        count = self.labels.get(BILLBOARDS, "")
        variant, loss = self.labels.get("variant", "base"), self.labels.get("loss", "l2")
        return published_figures().get(Experiment(self.tree, int(count), variant, loss)) if count.isdecimal() else None


@dataclass(frozen=True)
class Measure:
    """A number of a run."""

    name: str
    """Heading in tables."""
    path: tuple[str, ...]
    """Keys in the report."""
    digits: str
    """Format specification."""
    more: bool | None
    """Whether more is better (True), less is better (False), or neither (None)."""

    def of(self, row: SweepRow) -> float | None:
        """The run's value, if it has one."""
        value = _at(row.facts and row.facts["report"], self.path)
        return None if value is None else float(value)

    def published(self, row: SweepRow) -> float | None:
        """The thesis's value, if it has one."""
        figures = row.published
        return float(getattr(figures, self.path[-1])) if figures is not None and self.path[0] == "thesis_scale" else None

    def best(self, values: Sequence[float]) -> float | None:
        """The best of two or more values."""
        if self.more is None or len(values) < 2:
            return None
        return max(values) if self.more else min(values)


THESIS_SCALE = (
    Measure("RMSE", ("thesis_scale", "rmse"), ".2e", False),
    Measure("SSIM", ("thesis_scale", "ssim"), ".7f", True),
    Measure("PSNR", ("thesis_scale", "psnr"), ".2f", True),
    Measure("SRE", ("thesis_scale", "sre"), ".2f", True),
)
MEASURES = (
    Measure("PSNR, dB", ("over", "mean", "psnr"), ".2f", True),
    Measure("SSIM", ("over", "mean", "ssim"), ".4f", True),
    Measure("FLIP", ("over", "mean", "flip"), ".4f", False),
    Measure("PSNR over white, dB", ("over_white", "psnr"), ".2f", True),
    Measure("silhouette IoU", ("rgba", "iou"), ".3f", True),
    Measure("sharpness", ("sharpness",), ".2f", None),
    Measure("color ΔE", ("colour", "delta_e"), ".2f", False),
    Measure("color chroma", ("colour", "chroma"), ".2f", None),
    Measure("color brightness", ("colour", "brightness"), ".2f", None),
    Measure("brightness with holes", ("brightness",), ".2f", None),
)
_COLUMNS = {
    **{name: ("over", "mean", name) for name in ("psnr", "ssim", "flip")},
    **{f"white_{name}": ("over_white", name) for name in ("psnr", "ssim", "flip")},
    "rgba_rmse": ("rgba", "rmse"),
    "rgba_psnr": ("rgba", "psnr"),
    "iou": ("rgba", "iou"),
    "sharpness": ("sharpness",),
    "brightness": ("brightness",),
    **{f"color_{name}": ("colour", name) for name in ("delta_e", "chroma", "brightness")},
    "vertices": ("vertices", "model"),
    "original_vertices": ("vertices", "original"),
    "vertex_ratio": ("vertices", "ratio"),
    "bytes": ("bytes", "model"),
    "original_bytes": ("bytes", "original"),
    "fit_seconds": ("seconds", "fit"),
    **{f"thesis_{name}": ("thesis_scale", name) for name in ("rmse", "ssim", "psnr", "sre")},
}


def table_csv(rows: Sequence[SweepRow]) -> bytes:
    """CSV with one line per run: tree, labels, status, measures, costs, and the thesis's results (``published_``)."""
    labels = label_names(rows)
    published = ("rmse", "ssim", "psnr", "sre")
    last = ("billboards_fitted", "texels", "seconds", "folder")
    table: list[list[Any]] = [
        ["tree", *labels, "status", "reason", "steps", *_COLUMNS, *(f"published_{name}" for name in published), *last]
    ]
    for row in rows:
        facts = row.facts or {}
        start = [row.tree, *(row.labels.get(name, "") for name in labels), "failed" if row.reason else "done", row.reason or "", row.steps]
        values = [_at(facts.get("report"), path) for path in _COLUMNS.values()]
        figures = asdict(row.published) if row.published else {}
        end = [*map(figures.get, published), facts.get("billboards"), facts.get("texels"), row.seconds, row.folder]
        table.append([*start, *values, *end])
    return csv_bytes(table)


def table_markdown(rows: Sequence[SweepRow]) -> str:
    """The results as Markdown: measures, effects of each option, vertices and ratios, failures, and the thesis scale last.

    Tables have a column for each tree and number of billboards. Bold marks the best number of billboards of a tree, and in the last
    column the best mean, as in figure 11 of the thesis.
    """
    done = [row for row in rows if row.reason is None]
    parts = ["# Sweep\n", f"{len(done)} of {len(rows)} runs done, {_steps(done)} steps each. {_MEANS}\n"]
    if done:
        parts += ["## Measures\n", pivot(done, MEASURES)]
        if changes := effects(done):
            parts += ["## Effects\n\nMean differences between runs that differ in one option only.\n", effect_table(changes)]
        parts += [
            "## Vertices\n\nVertices of the model, and their ratio to the tree's; the thesis's ratio is in parentheses.\n",
            vertex_table(done),
        ]
    if failed := [row for row in rows if row.reason]:
        parts.append("## Failed\n")
        parts.append("\n".join(f"- {row.tree}, {', '.join(row.labels.values()) or 'its one run'}: {row.reason}" for row in failed) + "\n")
    if done:
        note = "; the thesis's results for its own trees are in parentheses" if any(row.published for row in done) else ""
        parts += [f"## Thesis scale\n\nRMSE, SSIM, PSNR and SRE with a peak of 4095{note}.\n", pivot(done, THESIS_SCALE)]
    return "\n".join(parts)


def count_order(label: str) -> tuple[int, int]:
    """The key by which labels of numbers of billboards are sorted: other labels, such as that of a number left to the fit, come last."""
    return (0, int(label)) if label.isdecimal() else (1, 0)


def pivot(rows: Sequence[SweepRow], measures: Sequence[Measure]) -> str:
    """A table with a line per configuration and measure, and a column per tree and number of billboards."""
    columns = list(dict.fromkeys((row.tree, row.labels.get(BILLBOARDS, "")) for row in rows))
    trees = list(dict.fromkeys(tree for tree, _ in columns))
    columns.sort(key=lambda column: (trees.index(column[0]), count_order(column[1])))
    lines = list(dict.fromkeys(_line(row) for row in rows))
    cells = {(_line(row), (row.tree, row.labels.get(BILLBOARDS, ""))): row for row in rows}
    head = ["configuration", "measure", *(f"{tree} {count}".strip() for tree, count in columns), "mean"]
    means: dict[tuple[str, Measure], float] = {}
    for line, measure in itertools.product(lines, measures):
        values = _values(cells, line, columns, measure.of)
        if len(values) == len(columns):
            means[line, measure] = sum(values.values()) / len(values)
    table = []
    for line, measure in itertools.product(lines, measures):
        ours, theirs = (_values(cells, line, columns, of) for of in (measure.of, measure.published))
        shown = [line, measure.name]
        for column in columns:
            best = measure.best([ours[other] for other in columns if other[0] == column[0] and other in ours])
            shown.append(_cell(ours.get(column), theirs.get(column), measure.digits, best))
        best = measure.best([value for (_, other), value in means.items() if other == measure])
        whole = len(theirs) == len(columns)
        shown.append(_cell(means.get((line, measure)), sum(theirs.values()) / len(theirs) if whole else None, measure.digits, best))
        table.append(shown)
    return markdown(head, table)


@dataclass(frozen=True)
class Effect:
    """The effect of one label on a tree's runs: mean differences between pairs of runs that differ only in this label."""

    change: str
    """The label, its old and its new value."""
    tree: str
    """Tree of the runs."""
    pairs: int
    """Number of pairs."""
    thesis_psnr: float | None
    """Difference in PSNR on the thesis scale, in dB."""
    published_psnr: float | None
    """The same difference between the thesis's results."""
    psnr: float | None
    """Difference in PSNR, the mean over the backgrounds, in dB."""
    ssim: float | None
    """Difference in SSIM, the mean over the backgrounds."""
    flip: float | None
    """Difference in FLIP, the mean over the backgrounds."""


def effects(rows: Sequence[SweepRow]) -> list[Effect]:
    """Mean differences between runs that differ only in one label: between successive numbers of billboards, and from the first value of
    any other label to each other value."""
    changes = []
    (psnr, ssim, flip), thesis_psnr = MEASURES[:3], THESIS_SCALE[2]
    for name in label_names(rows):
        values = list(dict.fromkeys(row.labels[name] for row in rows if name in row.labels))
        if name == BILLBOARDS:
            values.sort(key=count_order)
        for old, new in itertools.pairwise(values) if name == BILLBOARDS else [(values[0], value) for value in values[1:]]:
            for tree in dict.fromkeys(row.tree for row in rows):
                pairs = list(_pairs([row for row in rows if row.tree == tree], name, old, new))
                if pairs:
                    of = (thesis_psnr.of, thesis_psnr.published, psnr.of, ssim.of, flip.of)
                    changes.append(Effect(f"{name} {old} → {new}", tree, len(pairs), *(_mean_gain(one, pairs) for one in of)))
    return changes


def effect_table(changes: Sequence[Effect]) -> str:
    """A Markdown table with one line per effect."""

    def shown(value: float | None, digits: int) -> str:
        return "" if value is None else f"{value:+.{digits}f}"

    head = ["change", "tree", "pairs", "PSNR, dB", "SSIM", "FLIP", "PSNR, thesis scale", "thesis's own"]
    lines = []
    for one in changes:
        numbers = [shown(one.psnr, 2), shown(one.ssim, 4), shown(one.flip, 4), shown(one.thesis_psnr, 2), shown(one.published_psnr, 2)]
        lines.append([one.change, one.tree, str(one.pairs), *numbers])
    return markdown(head, lines)


def vertex_table(rows: Sequence[SweepRow]) -> str:
    """Vertices of the models relative to those of their trees, as in table 1 of the thesis."""
    trees = list(dict.fromkeys(row.tree for row in rows))
    originals = {row.tree: _at(row.facts and row.facts["report"], ("vertices", "original")) for row in rows}
    kinds = sorted({int(_at(row.facts and row.facts["report"], ("vertices", "model")) or 0) for row in rows})
    table = [["the tree", *("" if originals[tree] is None else f"{originals[tree]:,}" for tree in trees)]]
    for count in kinds:
        line = [str(count)]
        for tree in trees:
            theirs = RATIOS_PERCENT.get(tree, {}).get(count)
            ours = "" if not originals[tree] else percent(count / originals[tree])
            line.append(ours + ("" if theirs is None else f" ({theirs:g} %)"))
        table.append(line)
    return markdown(["vertices", *trees], table)


def label_names(rows: Sequence[SweepRow]) -> list[str]:
    """Names of all labels, in the order of the grid."""
    return list(dict.fromkeys(name for row in rows for name in row.labels))


def _at(value: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        value = None if value is None else value.get(name)
    return value


def _steps(rows: Sequence[SweepRow]) -> str:
    counts = sorted({row.steps for row in rows})
    return " or ".join(f"{count:,}" for count in counts) or "no"


def _line(row: SweepRow) -> str:
    return ", ".join(value for name, value in row.labels.items() if name != BILLBOARDS) or "all"


def _values(
    cells: Mapping[tuple[str, tuple[str, str]], SweepRow],
    line: str,
    columns: Sequence[tuple[str, str]],
    of: Callable[[SweepRow], float | None],
) -> dict[tuple[str, str], float]:
    """A measure's values in one line, by column; columns without a value are left out."""
    values = {column: of(cells[line, column]) for column in columns if (line, column) in cells}
    return {column: value for column, value in values.items() if value is not None}


def _cell(ours: float | None, theirs: float | None, digits: str, best: float | None) -> str:
    if ours is None:
        return ""
    shown = f"{ours:{digits}}"
    return (f"**{shown}**" if ours == best else shown) + ("" if theirs is None else f" ({theirs:{digits}})")


def _pairs(rows: Sequence[SweepRow], name: str, old: str, new: str) -> Iterator[tuple[SweepRow, SweepRow]]:
    """Runs that have ``old`` and ``new`` of a label and are otherwise the same."""
    others = {tuple((n, v) for n, v in row.labels.items() if n != name): row for row in rows if row.labels.get(name) == new}
    for row in rows:
        rest = tuple((n, v) for n, v in row.labels.items() if n != name)
        if row.labels.get(name) == old and rest in others:
            yield row, others[rest]


def _mean_gain(of: Callable[[SweepRow], float | None], pairs: Sequence[tuple[SweepRow, SweepRow]]) -> float | None:
    """Mean difference in a measure; ``None`` if a run lacks it."""
    gains = [after - before for one, other in pairs if (before := of(one)) is not None and (after := of(other)) is not None]
    return sum(gains) / len(gains) if len(gains) == len(pairs) else None
