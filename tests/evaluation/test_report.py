"""The report: its means, its schema, and the way to disk and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bbfit.checks import InputError, MissingFileError
from bbfit.evaluation.report import Cost, Measures, OverWhite, Report, Rgba, SizeScore, ThesisScale, ViewScore


def score(name: str, scale: float, sharpness: float | None = 1.0) -> ViewScore:
    measures = Measures(
        OverWhite(20 * scale, 0.8, 0.1), Rgba(0.1, 22 * scale, 0.7), ThesisScale(2e-5, 0.99999, 92 * scale, 17), sharpness, 0.5
    )
    return ViewScore(name, 12.0, 0.0, measures)


SIZES = (SizeScore(64, 48, 20.5, 1.01, 0.1), SizeScore(32, 24, 21.5, None, 0.09))
REPORT = Report((score("a", 1.0), score("b", 1.5, None)), Cost(16, 113_152), Cost(None, 5_000), {"fit": 2.0}, sizes=SIZES)
MEASURES = {
    "over_white": {"psnr", "ssim", "flip"},
    "rgba": {"rmse", "psnr", "iou"},
    "thesis_scale": {"rmse", "ssim", "psnr", "sre"},
}


def test_means_are_plain_and_leave_out_what_is_undefined() -> None:
    mean = REPORT.mean
    assert mean.over_white.psnr == 25 and mean.rgba.psnr == pytest.approx(27.5) and mean.thesis_scale.psnr == 115  # dB averaged as dB
    assert mean.sharpness == 1 and mean.brightness == 0.5
    assert replace(REPORT, views=(score("b", 1, None),)).mean.sharpness is None


def test_rings_are_views_of_about_one_elevation() -> None:
    elevations = [30.4, 0.0, 29.8, 90.0, 0.0]
    views = tuple(replace(score("a", 1 + index), elevation_degrees=elevation) for index, elevation in enumerate(elevations))
    rings = replace(REPORT, views=views).rings
    assert [(ring.elevation_degrees, ring.views) for ring in rings] == [(0.0, 2), (pytest.approx(30.1), 2), (90.0, 1)]
    assert [ring.measures.over_white.psnr for ring in rings] == [70.0, 40.0, 80.0]


def test_ratio_is_table_1s() -> None:
    """Acer, four single-sided billboards: 16 vertices are 0.0141 % of the original (thesis, table 1)."""
    assert REPORT.vertices.ratio is not None
    assert f"{100 * REPORT.vertices.ratio:.4f}" == "0.0141"
    assert Cost(16).ratio is None and Cost(None, 5).ratio is None and Cost(16, 0).ratio is None


def test_schema() -> None:
    content = REPORT.to_json()
    assert list(content) == [
        *MEASURES,
        "sharpness",
        "brightness",
        "vertices",
        "bytes",
        "overdraw",
        "shaded",
        "alpha",
        "seconds",
        "sizes",
        "rings",
        "views",
    ]
    assert list(content["views"][0]) == ["name", "azimuth_degrees", "elevation_degrees", *MEASURES, "sharpness", "brightness"]
    assert list(content["rings"][0]) == ["elevation_degrees", "views", *MEASURES, "sharpness", "brightness"]
    for part in (content, *content["views"], *content["rings"]):
        assert {group: set(part[group]) for group in MEASURES} == MEASURES
    for cost in ("vertices", "bytes"):
        assert set(content[cost]) == {"model", "original", "ratio"}
    assert content["views"][1]["sharpness"] is None
    assert content["sizes"][0] == {"width": 64, "height": 48, "psnr": 20.5, "coverage": 1.01, "alpha": 0.1}
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    REPORT.save(path)
    assert Report.load(path) == REPORT
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("content", ['{"views": []}', "[1, 2]", '{"views": [{"name": "a"}]}', "{"])
def test_damaged_file(tmp_path: Path, content: str) -> None:
    path = tmp_path / "metrics.json"
    path.write_text(content)
    with pytest.raises(InputError, match="metrics"):
        Report.load(path)
    with pytest.raises(MissingFileError, match="does not exist"):
        Report.load(tmp_path / "other.json")
