"""The table on the screen."""

from __future__ import annotations

import pytest
from rich.console import Console

from bbfit.evaluation.measures import Colour, Measures, Over, OverBackground, Rgba, ThesisScale
from bbfit.evaluation.report import Cost, Report, ShimmerScore, SizeMeasures, SizeScore, ViewScore
from bbfit.evaluation.trunk import TrunkScore, TrunkView
from bbfit.reporting.tables import report_table

OTHER = OverBackground(17.234, 0.7125, 0.2061)
COLOUR = Colour((40, 50, 20, 100), (20, 25, 10, 50), (40, 50, 20, 100), (16, 20, 8, 50))
MEASURES = Measures(
    Over(OverBackground(21.234, 0.8125, 0.1061), OTHER, OTHER, OTHER),
    Rgba(0.0712, 23.456, 0.7345),
    ThesisScale(2.24e-5, 0.9999966, 92.605, 17.28),
    COLOUR,
    0.9,
    None,
)
REPORT = Report(
    (ViewScore("0000", 0, 0, MEASURES), ViewScore("0001", 90, 0, MEASURES)),
    Cost(32, 10_525_153),
    Cost(123_456, None),
    {"views": 1234.56, "fit": 60, "export": 0.4, "evaluate": 15.04},
    sizes=(SizeScore(1024, 1024, SizeMeasures(19.87, 1.012, 0.1), SizeMeasures(20.76, 0.976, 0.1)),),
    shimmer=(ShimmerScore(512, 384, 0.02, 1.2345, 0.987), ShimmerScore(256, 192, 0.0, None, None)),
    trunk=TrunkScore((TrunkView("0000", 0.9312, 2.5), TrunkView("0001", 0.8512, 1.5))),
)


@pytest.mark.parametrize("width", [80, 100])
def test_every_figure_is_there_and_nothing_is_cut(width: int) -> None:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(report_table(REPORT, "willow"))
    text = capture.get()
    for figure in (
        "willow: mean of 2", "18.23", "0.7375", "0.1811", "0.00", "1.000", "0.800", "19.87", "1.012", "20.76", "0.976", "0.8912, 0.8512",
        "21.23", "23.46", "92.605", "0.0712", "2.24e-05", "0.8125", "0.9999966", "17.280", "0.1061", "0.7345",
        "1.234", "0.987", "0.900", "10,525,153", "0.000304 %", "123,456", "views 1,234.6", "evaluate 15.0",
    ):  # fmt: skip
        assert figure in text, figure
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    rows = {line.split("  ")[0].strip(): line for line in text.splitlines()}
    assert "↑" in rows["PSNR, dB"] and "↓" in rows["FLIP"] and "→ 1" in rows["sharpness"]
    assert rows["... with holes"].rstrip().endswith("-") and "None" not in text


def test_the_thesis_scale_may_be_left_out() -> None:
    console = Console(width=100)
    with console.capture() as capture:
        console.print(report_table(REPORT, thesis=False))
    text = capture.get()
    assert "21.23" in text and "0.000304 %" in text
    assert not [gone for gone in ("thesis", "92.605", "2.24e-05", "0.9999966", "SRE") if gone in text]


def test_one_view() -> None:
    assert report_table(Report(REPORT.views[:1])).title == "Held-out views: one view"


def test_rings_have_rows_of_their_own_if_there_are_some() -> None:
    console = Console(width=100)
    several = tuple(ViewScore(str(elevation), 0, elevation, MEASURES) for elevation in (0, 30, 60))
    for report, rows in ((REPORT, 0), (Report(several), 3)):
        with console.capture() as capture:
            console.print(report_table(report))
        assert capture.get().count("°") == rows
    assert "PSNR, dB, at 60°" in capture.get()
