"""Tables of a comparison, by rows whose numbers are known."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from bbfit.evaluation.afar import FarScore
from bbfit.evaluation.measures import Colour, Measures, Over, OverBackground, Rgba, ThesisScale
from bbfit.evaluation.scoring import OriginalTree
from bbfit.reporting.comparison_summary import compare_plot, summaries
from bbfit.reporting.comparison_tables import CompareCosts, CompareRow, compare_csv, compare_markdown
from bbfit.reporting.frame_tables import FrameRow, frames_plot

OVER = Over(*(OverBackground(20.0 + step, 0.7 + step / 100, 0.1 + step / 100) for step in range(4)))
COLOUR = Colour((40, 50, 20, 100), (20, 25, 10, 50), (40, 50, 20, 100), (16, 20, 8, 50))
MEASURES = Measures(OVER, Rgba(0.07, 23.5, 0.75), ThesisScale(2e-5, 0.99, 92.6, 17.3), COLOUR, 0.9, 0.4)
ROWS = [
    CompareRow(
        "bbfit",
        "bbfit, 8 billboards",
        CompareCosts(8, 32, 1000, 2.5, 4.25, triangles=16, drawing=1234.4),
        MEASURES,
        "",
        {"psnr": 19.5, "flip": 0.2, "low": 25.25, "r2": None},
        FarScore(99.75, 24.5, 0.0625, 1180.0),
    ),
    CompareRow("draco", "the tree, with Draco", CompareCosts(None, 9000, 500, 0.1, shader=True), None, "not drawn", None, None),
]


def test_csv_has_means_over_backgrounds_scores_over_white_and_colors() -> None:
    drawn, other = csv.DictReader(io.StringIO(compare_csv(ROWS).decode()))
    wanted = {
        "psnr": 21.5,
        "ssim": 0.715,
        "flip": 0.115,
        "white_psnr": 20,
        "white_ssim": 0.7,
        "white_flip": 0.1,
        "rgba_psnr": 23.5,
        "iou": 0.75,
    }
    wanted |= {"sharpness": 0.9, "brightness": 0.4, "color_delta_e": 0, "color_chroma": 1, "color_brightness": 0.8, "thesis_psnr": 92.6}
    assert {name: float(drawn[name]) for name in wanted} == pytest.approx(wanted, abs=1e-12)
    assert {other[name] for name in wanted} == {""} and other["note"] == "not drawn"
    lights = [f"light_{name}" for name in ("psnr", "flip", "low", "r2")]
    assert [drawn[name] for name in lights] == ["19.5", "0.2", "25.25", ""] and {other[name] for name in lights} == {""}
    afar = ["far_tree_pixels", "far_psnr", "far_flip", "far_fragments", "triangles", "drawing"]
    assert [drawn[name] for name in afar] == ["99.75", "24.5", "0.0625", "1180.0", "16", "1234.4"]
    assert {other[name] for name in afar} == {""}


def test_points_of_charts_have_numbers_that_the_legend_explains(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also those of systems that occur in a panel alone, and without any system."""
    figures: list[Figure] = []
    monkeypatch.setattr("bbfit.reporting.comparison_summary.write_figure", lambda figure, path: figures.append(figure))
    monkeypatch.setattr("bbfit.reporting.frame_tables.write_figure", lambda figure, path: figures.append(figure))
    names = [f"system {number}" for number in range(12)]
    costs = [CompareCosts(8, None if number == 3 else 32 + number, 1000 + number, 2.5, 4.25) for number in range(12)]
    compare_plot(summaries({"oak": [replace(ROWS[0], system=name, costs=cost) for name, cost in zip(names, costs, strict=True)]}), tmp_path)
    frame = FrameRow("three.js", "", "", "billboards", 100, 1, 2.0, 0.0, 3, 1, 2, None, None, 1000, 0.1, None, None)
    frames_plot([replace(frame, model=name, tree_pixels=100 if name == names[5] else 30) for name in names], tmp_path)
    for figure in figures:
        shown = [text.get_text().split(maxsplit=1) for text in figure.legends[0].get_texts()]
        assert sorted(shown, key=lambda pair: int(pair[0])) == [[str(number), name] for number, name in enumerate(names, 1)]
        assert {text.get_text() for axis in figure.axes for text in axis.texts} == {number for number, _ in shown}
    compare_plot([], tmp_path)
    assert len(figures) == 3 and not figures[2].legends[0].get_texts()


def test_markdown_shows_them_too() -> None:
    head, line, tree, drawn, other = (
        [cell.strip() for cell in text.strip("| ").split("|")]
        for text in compare_markdown(ROWS, OriginalTree(9000, 10_000)).partition("## From afar")[0].splitlines()
        if text.startswith("|")
    )
    shown = dict(zip(head, drawn, strict=True))
    assert (shown["PSNR, dB"], shown["FLIP"], shown["PSNR over white"]) == ("21.50", "0.1150", "20.00")
    assert (shown["color ΔE"], shown["chroma"], shown["brightness"]) == ("0.00", "1.00", "0.80")
    assert set(line) == {"---"} and tree[:2] == ["the tree", ""] and other[0] == "the tree, with Draco*"  # it needs a decoder
    assert shown["shaded"] == "4.2"


def test_markdown_lists_what_was_scored_from_afar() -> None:
    text = compare_markdown(ROWS, OriginalTree(9000, 10_000)).partition("## From afar: 100 pixels high")[2].partition("## Under")[0]
    _, _, line = [line for line in text.splitlines() if line.startswith("| ")]
    assert line == "| bbfit, 8 billboards | 16 | 1,180 | 1,234 | 24.50 | 0.0625 |"
    assert "## From afar" not in compare_markdown(ROWS[1:], OriginalTree(9000, 10_000))


def test_markdown_lists_what_was_scored_under_other_suns() -> None:
    text = compare_markdown(ROWS, OriginalTree(9000, 10_000)).partition("## Under other suns")[2]
    assert [line for line in text.splitlines() if line.startswith("| ")][2:] == ["| bbfit, 8 billboards | 19.50 | 0.2000 | 25.25 |  |"]
    assert "## Under other suns" not in compare_markdown(ROWS[1:], OriginalTree(9000, 10_000))


def test_rows_go_through_json() -> None:
    for row in ROWS:
        assert CompareRow.from_json(json.loads(json.dumps(row.to_json(), allow_nan=False))) == row
