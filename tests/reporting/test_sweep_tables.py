"""Tables of many runs, by rows whose numbers are known."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from bbfit.evaluation.published import Experiment, published_figures
from bbfit.images import read_rgba
from bbfit.reporting.sweep_plots import sweep_plot
from bbfit.reporting.sweep_tables import THESIS_SCALE, SweepRow, effects, percent, pivot, table_csv, table_markdown
from bbfit.reporting.tables import sweep_table


def report(psnr: float, vertices: int, original: int | None = 1000) -> dict[str, Any]:
    return {
        "over_white": {"psnr": psnr - 1, "ssim": psnr / 200, "flip": 2 / psnr},
        "over": {"mean": {"psnr": psnr, "ssim": psnr / 100, "flip": 1 / psnr}},
        "colour": {"delta_e": 3.0, "chroma": 0.75, "brightness": 0.9},
        "rgba": {"rmse": 0.1, "psnr": psnr + 1, "iou": 0.5},
        "thesis_scale": {"rmse": 1 / psnr, "ssim": 0.99, "psnr": psnr + 72, "sre": 3.0},
        "sharpness": 0.5,
        "brightness": None,
        "vertices": {"model": vertices, "original": original, "ratio": None if original is None else vertices / original},
        "bytes": {"model": 10, "original": 100, "ratio": 0.1},
        "seconds": {"fit": 1.5},
    }


def row(tree: str, psnr: float | None, **labels: str) -> SweepRow:
    count = int(labels.get("billboards", "1"))
    facts = None if psnr is None else {"report": report(psnr, 4 * count), "billboards": count, "texels": 64}
    return SweepRow(tree, labels, 20, facts, "no memory" if psnr is None else None, 2.0, "runs/x")


ROWS = [
    row(tree, 10.0 + 4 * (tree == "oak") + count - 3 * (loss == "l1"), variant="base", loss=loss, billboards=str(count))
    for tree in ("acer", "oak")
    for loss in ("l2", "l1")
    for count in (2, 3, 4)
]


WANTED = [Experiment("acer", count, "base", "l2") for count in (2, 3, 4)]


def cells(text: str) -> list[list[str]]:
    """The lines of a table in Markdown."""
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if line.startswith("|")]


def test_csv_has_a_row_a_run_with_the_theses_figures() -> None:
    table = list(csv.DictReader(io.StringIO(table_csv([*ROWS, row("acer", None, variant="base", loss="l2", billboards="9")]).decode())))
    assert len(table) == 13
    first, last = table[0], table[-1]
    assert (first["tree"], first["variant"], first["loss"], first["billboards"]) == ("acer", "base", "l2", "2")
    assert (float(first["psnr"]), float(first["thesis_psnr"]), int(first["vertices"])) == (12.0, 84.0, 8)
    assert (float(first["published_psnr"]), float(first["published_sre"])) == (90.117, 11.776)
    assert [float(first[name]) for name in ("white_psnr", "color_delta_e", "color_chroma", "color_brightness")] == [11, 3, 0.75, 0.9]
    assert (first["brightness"], first["fit_seconds"], first["status"], first["reason"]) == ("", "1.5", "done", "")
    assert (last["status"], last["reason"], last["psnr"], last["vertices"]) == ("failed", "no memory", "", "")
    assert table[6]["tree"] == "oak" and table[6]["published_psnr"] == "", "the thesis has no oak"


def test_the_pivot_marks_the_best_number_of_billboards_and_the_best_mean() -> None:
    head, _, *lines = cells(pivot(ROWS, THESIS_SCALE[2:3]))
    assert head == ["configuration", "measure", "acer 2", "acer 3", "acer 4", "oak 2", "oak 3", "oak 4", "mean"]
    theirs = {experiment.billboards: f"{figures.psnr:.2f}" for experiment, figures in published_figures().items() if experiment in WANTED}
    assert lines[0] == [
        "base, l2",
        "PSNR",
        f"84.00 ({theirs[2]})",
        f"85.00 ({theirs[3]})",
        f"**86.00** ({theirs[4]})",
        "88.00",
        "89.00",
        "**90.00**",
        "**87.00**",
    ]
    assert lines[1][-1] == "84.00" and lines[1][4].startswith("**83.00**")


def test_less_is_better_where_it_is() -> None:
    (_, _, line) = cells(pivot(ROWS[:3], THESIS_SCALE[:1]))
    assert [cell.startswith("**") for cell in line[2:]] == [False, False, True, False], "one mean is not the best of anything"


def test_effects_are_mean_differences_of_runs_that_are_otherwise_the_same() -> None:
    found = {(one.change, one.tree): one for one in effects(ROWS)}
    assert set(found) == {(c, t) for c in ("loss l2 → l1", "billboards 2 → 3", "billboards 3 → 4") for t in ("acer", "oak")}
    loss, more = found["loss l2 → l1", "acer"], found["billboards 2 → 3", "oak"]
    assert loss.pairs == 3 and loss.psnr == pytest.approx(-3) and loss.thesis_psnr == pytest.approx(-3)
    assert loss.published_psnr == pytest.approx(np.mean([89.279 - 90.117, 89.462 - 90.422, 89.537 - 90.373]))
    assert loss.flip == pytest.approx(np.mean([1 / (9 + n) - 1 / (12 + n) for n in range(3)]))
    assert more.pairs == 2 and more.psnr == pytest.approx(1) and more.published_psnr is None
    assert {one.change for one in effects(ROWS[:1])} == set()


def test_the_whole_text() -> None:
    text = table_markdown([*ROWS, row("acer", None, variant="double", loss="l2", billboards="2")])
    assert "12 of 13 runs done, 20 steps each" in text
    assert "- acer, double, l2, 2: no memory" in text
    assert "| 8 | 0.8 % (0.0071 %) | 0.8 % |" in text and "| the tree | 1,000 | 1,000 |" in text
    for heading in ("## Measures", "## Effects", "## Vertices", "## Failed", "## Thesis scale"):
        assert heading in text


def test_other_grids_have_tables_too() -> None:
    """No billboards, no labels at all, an unknown tree, nothing done."""
    assert cells(pivot([row("oak", 20.0)], THESIS_SCALE[2:3]))[2] == ["all", "PSNR", "92.00", "92.00"]
    by_seed = [row("oak", 20.0 + seed, seed=str(seed)) for seed in range(2)]
    assert [line[0] for line in cells(pivot(by_seed, THESIS_SCALE[2:3]))[2:]] == ["0", "1"]
    assert [one.change for one in effects(by_seed)] == ["seed 0 → 1"]
    assert "0 of 1 runs done, no steps each" in table_markdown([row("oak", None)])
    assert table_csv([]).decode().startswith("tree,status")


@pytest.mark.parametrize("rows", [ROWS, [row("oak", 20.0)], [row("oak", 20.0, seed="1"), row("oak", 21.0, seed="2")]])
def test_the_plot_shows_something(rows: list[SweepRow], tmp_path: Path) -> None:
    sweep_plot(rows, tmp_path / "plot.png")
    assert np.unique(read_rgba(tmp_path / "plot.png")[..., :3].reshape(-1, 3), axis=0).shape[0] > 20
    sweep_plot([row("oak", None)], tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_the_screen_shows_names_and_reasons_as_they_are() -> None:
    """Brackets of a path are no markup, on any console."""
    failed = replace(row("c/[/b]", None, variant="[red]"), reason="tree: c/[/b].glb is empty")
    out = io.StringIO()
    Console(file=out, width=150, emoji=False).print(sweep_table([failed]))
    assert "c/[/b] " in out.getvalue() and "[red]" in out.getvalue() and "failed: tree: c/[/b].glb is empty" in out.getvalue()


def test_numbers_of_billboards_are_in_order_and_one_may_be_left_to_the_fit(tmp_path: Path) -> None:
    """Tables and the picture, also where a configuration or a number failed for the first tree."""
    labels = ("default", "16", "2", "12")
    rows = [replace(row("acer", 20.0, loss="l2"), labels={"loss": "l2", "billboards": label}) for label in labels if label != "2"]
    rows += [replace(row("oak", 20.0, loss=loss), labels={"loss": loss, "billboards": label}) for loss in ("l2", "l1") for label in labels]
    head, *_ = cells(pivot(rows, THESIS_SCALE[2:3]))
    numbers = ["2", "12", "16", "default"]
    assert head[2:-1] == [f"acer {label}" for label in numbers[1:]] + [f"oak {label}" for label in numbers]
    changes = [one.change for one in effects(rows) if one.tree == "oak" and one.change.startswith("billboards")]
    assert changes == ["billboards 2 → 12", "billboards 12 → 16", "billboards 16 → default"]
    figures: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bbfit.reporting.sweep_plots.write_figure", lambda figure, path: figures.append(figure))
        sweep_plot(rows, tmp_path / "table.png")
    (figure,) = figures
    assert [text.get_text() for text in figure.axes[-1].get_xticklabels()] == numbers
    assert all((np.diff(line.get_xdata()) > 0).all() for axis in figure.axes for line in axis.get_lines())
    assert sorted(text.get_text() for text in figure.legends[0].get_texts()) == ["l1", "l2"]


@pytest.mark.parametrize(
    ("ratio", "shown"),
    [
        (51.24, "5,124 %"),
        (0.0411872, "4.12 %"),
        (1, "100 %"),
        (9.37e-7, "< 0.0001 %"),
        (3.04e-6, "0.000304 %"),
        (0, "0 %"),
        (1.2e-5, "0.0012 %"),
        (0.5, "50 %"),
    ],
)
def test_a_ratio_is_in_percent_without_powers_of_ten(ratio: float, shown: str) -> None:
    assert percent(ratio) == shown
