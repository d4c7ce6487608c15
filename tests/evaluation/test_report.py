"""The report: its means, its schema, and the way to disk and back."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import pytest

from bbfit.checks import InputError, MissingFileError
from bbfit.evaluation.distances import Distances
from bbfit.evaluation.measures import Colour, Measures, Over, OverBackground, Rgba, ThesisScale
from bbfit.evaluation.report import Cost, Report, ShimmerScore, SizeMeasures, SizeScore, Subject, ViewScore, stage_seconds
from bbfit.evaluation.trunk import TrunkScore, TrunkView


def score(name: str, scale: float, sharpness: float | None = 1.0) -> ViewScore:
    over = Over(*(OverBackground((20 + step) * scale, 0.8, 0.1 + step / 10) for step in range(4)))
    colour = Colour((4.0 * scale, 5.0, 2.0, 10.0), (2.0, 3.0, 1.0, 8.0), (4.0, 4.0, 2.0, 9.0), (2.0, 2.0, 1.0, 6.0))
    measures = Measures(over, Rgba(0.1, 22 * scale, 0.7), ThesisScale(2e-5, 0.99999, 92 * scale, 17), colour, sharpness, 0.5)
    return ViewScore(name, 12.0, 0.0, measures, replace(measures, rgba=Rgba(0.05, 28 * scale, 0.8)))


SIZES = (
    SizeScore(64, 48, SizeMeasures(20.5, 1.01, 0.1), SizeMeasures(21.5, 0.99, 0.08)),
    SizeScore(32, 24, SizeMeasures(21.5, None, 0.09)),
)
SHIMMER = (ShimmerScore(64, 48, 0.02, 1.25, 0.9), ShimmerScore(32, 24, 0.0, None, None))
TRUNK = TrunkScore((TrunkView("a", 0.9, 2.0), TrunkView("b", 0.5, None)))
REPORT = Report(
    (score("a", 1.0), score("b", 1.5, None)),
    Cost(16, 113_152),
    Cost(None, 5_000),
    {"fit": 2.0},
    sizes=SIZES,
    shimmer=SHIMMER,
    trunk=TRUNK,
    distances=Distances(1.5, 30.0, None),
    subject=Subject("acer", ((0.0, 0.0, -1.0), (1.0, 2.0, 3.0)), (0.0, 1.0, 0.0), 2.5, 1.0, "0" * 64),
)
MEASURES = {
    "over_white": {"psnr", "ssim", "flip"},
    "over": {"white", "black", "grass", "sky", "mean"},
    "rgba": {"rmse", "psnr", "iou"},
    "thesis_scale": {"rmse", "ssim", "psnr", "sre"},
    "colour": {"delta_e", "chroma", "brightness", "target", "render", "target_inside", "render_inside"},
}


def test_means_are_plain_and_leave_out_what_is_undefined() -> None:
    mean = REPORT.mean
    assert mean.over_white.psnr == 25 and mean.rgba.psnr == pytest.approx(27.5) and mean.thesis_scale.psnr == 115  # dB averaged as dB
    assert mean.over.mean.psnr == pytest.approx(26.875) and mean.over.mean.flip == pytest.approx(0.25)  # of 20, 21, 22, 23 and 30 ... 34.5
    assert mean.over.mean.psnr == pytest.approx(sum(view.measures.over.mean.psnr for view in REPORT.views) / 2)
    assert mean.sharpness == 1 and mean.brightness == 0.5
    assert REPORT.antialiased and REPORT.antialiased.rgba.psnr == pytest.approx(35)
    assert replace(REPORT, views=(score("b", 1, None),)).mean.sharpness is None


def test_rings_are_views_of_about_one_elevation() -> None:
    elevations = [30.4, 0.0, 29.8, 90.0, 0.0]
    views = tuple(replace(score("a", 1 + index), elevation_degrees=elevation) for index, elevation in enumerate(elevations))
    rings = replace(REPORT, views=views).rings
    assert [(ring.elevation_degrees, ring.views) for ring in rings] == [(0.0, 2), (pytest.approx(30.1), 2), (90.0, 1)]
    assert [ring.measures.over_white.psnr for ring in rings] == [70.0, 40.0, 80.0]
    assert [ring.antialiased and ring.antialiased.rgba.psnr for ring in rings] == pytest.approx([98.0, 56.0, 112.0])
    hard = replace(REPORT, views=tuple(replace(view, antialiased=None) for view in views))
    assert hard.antialiased is None and {ring.antialiased for ring in hard.rings} == {None}


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
        "antialiased",
        "vertices",
        "bytes",
        "overdraw",
        "shaded",
        "trunk",
        "light",
        "alpha",
        "seconds",
        "distances",
        "subject",
        "sizes",
        "shimmer",
        "rings",
        "views",
    ]
    groups = [*MEASURES, "sharpness", "brightness", "antialiased"]
    assert list(content["views"][0]) == ["name", "azimuth_degrees", "elevation_degrees", *groups]
    assert list(content["rings"][0]) == ["elevation_degrees", "views", *groups]
    for part in (content, *content["views"], *content["rings"]):
        assert {group: set(part[group]) for group in MEASURES} == MEASURES
        assert part["over_white"] == part["over"]["white"] and all(set(each) == {"psnr", "ssim", "flip"} for each in part["over"].values())
    for cost in ("vertices", "bytes"):
        assert set(content[cost]) == {"model", "original", "ratio"}
    assert content["views"][1]["sharpness"] is None
    hard, smooth = ({"psnr": 20.5, "coverage": 1.01, "alpha": 0.1}, {"psnr": 21.5, "coverage": 0.99, "alpha": 0.08})
    assert content["sizes"][0] == {"width": 64, "height": 48} | hard | {"antialiased": smooth}
    assert content["sizes"][1]["antialiased"] is None
    assert content["shimmer"][0] == {"width": 64, "height": 48, "tree": 0.02, "ratio": 1.25, "antialiased": 0.9}
    assert content["trunk"]["worst_iou"] == 0.5 and content["trunk"]["worst_view"] == "b" and content["trunk"]["iou"] == 0.7
    assert replace(REPORT, trunk=None).to_json()["trunk"] is None
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    REPORT.save(path)
    assert Report.load(path) == REPORT
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


def test_a_file_of_an_earlier_version_is_refused_but_its_seconds_are_read(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    content = REPORT.to_json()
    for part in (content, *content["views"], *content["rings"]):
        del part["over"], part["colour"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"earlier version of bbfit wrote it, with scores over white only.*; write it again"):
        Report.load(path)
    assert stage_seconds(path) == {"fit": 2.0}
    path.write_text('{"seconds": {"fit": "long"}}')
    with pytest.raises(InputError, match="metrics"):
        stage_seconds(path)


def test_sums_of_colors_have_four_numbers(tmp_path: Path) -> None:
    content = REPORT.to_json()
    content["views"][0]["colour"]["render"] = [1.0, 2.0, 3.0]
    (tmp_path / "metrics.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="a sum of colors"):
        Report.load(tmp_path / "metrics.json")


@pytest.mark.parametrize("content", ['{"views": []}', "[1, 2]", '{"views": [{"name": "a"}]}', "{"])
def test_damaged_file(tmp_path: Path, content: str) -> None:
    path = tmp_path / "metrics.json"
    path.write_text(content)
    with pytest.raises(InputError, match="metrics"):
        Report.load(path)
    with pytest.raises(MissingFileError, match="does not exist"):
        Report.load(tmp_path / "other.json")


def test_figures_of_any_sums_of_colors_are_finite() -> None:
    """Also of those in a file that someone edited."""
    values = (0.0, -1.0, 5e-324, 1e-9, 0.5, 1e300)
    for first, second, alpha in itertools.product(values, repeat=3):
        colour = Colour(*[(first, second, first, alpha), (second, first, second, 1.0)] * 2)
        swapped = Colour(colour.render, colour.target, colour.render_inside, colour.target_inside)
        json.dumps([colour.to_json(), swapped.to_json()], allow_nan=False)
