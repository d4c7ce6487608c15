"""Charts for pages: every view has its point, marks are where they say, and no color is the chart's own."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest
import torch

from bbfit.checks import InputError
from bbfit.evaluation.measures import Over, OverBackground
from bbfit.evaluation.report import SizeMeasures, SizeScore, ViewScore
from bbfit.evaluation.scoring import measure
from bbfit.geometry.cloud import BillboardCloud
from bbfit.reporting.charts import FEW, Chart, azimuth_chart, billboard_color, loss_chart, plan_chart, sizes_chart, times_chart, worst_views

HUES = {billboard_color(index) for index in range(10)}


def scores(*values: tuple[float, float, float], azimuths: tuple[float, ...] | None = None, elevation: float = 0.0) -> list[ViewScore]:
    """Views with the given PSNR, SSIM and FLIP, evenly around the tree if not said otherwise."""
    flat = torch.zeros(16, 16, 4)
    measures = measure(flat, flat)
    angles = azimuths or tuple(360 * index / len(values) for index in range(len(values)))
    return [
        ViewScore(f"{index:04d}", angle, elevation, replace(measures, over=Over(*[OverBackground(*each)] * 4)))
        for index, (each, angle) in enumerate(zip(values, angles, strict=True))
    ]


def ids(chart: Chart) -> set[str]:
    root = ElementTree.fromstring(chart.svg)
    found = [element.get("id") for element in root.iter() if element.get("id")]
    assert len(found) == len(set(found))
    return set(found)


def test_the_worst_views_are_found_by_each_measure() -> None:
    views = scores((20, 0.9, 0.2), (18, 0.95, 0.1), (25, 0.8, 0.15))
    assert worst_views(views) == {"psnr": 1, "ssim": 2, "flip": 0}


def test_every_view_has_a_point_in_every_panel() -> None:
    chart = azimuth_chart(scores(*[(20 + i, 0.9 - i / 100, 0.1 + i / 100) for i in range(7)]))
    found = ids(chart)
    assert {f"azimuth-{name}-{index}" for name in ("psnr", "ssim", "flip") for index in range(7)} <= found
    assert {f"azimuth-cursor-{name}" for name in ("psnr", "ssim", "flip")} <= found
    assert chart.svg.count("worst: ") == 3 and "worst: 20.00" in chart.svg and "worst: 0.840" in chart.svg and "worst: 0.160" in chart.svg


def test_one_degree_is_as_far_as_the_chart_says() -> None:
    chart = azimuth_chart(scores((20, 0.9, 0.1), (21, 0.9, 0.1), azimuths=(0.0, 200.0)))

    def x(index: int) -> float:
        group = re.search(rf'id="azimuth-psnr-{index}".*?<use [^>]*?x="([\d.]+)"', chart.svg, re.DOTALL)
        assert group
        return float(group[1])

    assert x(1) - x(0) == pytest.approx(200 * chart.marks["degree"], abs=1e-3)


@pytest.mark.parametrize("count", [1, 2, 60])
def test_any_number_of_views_is_drawn(count: int) -> None:
    views = scores(*[(20.0, 0.9, 0.1)] * count)
    tilted = [replace(view, elevation_degrees=float(index % 50)) for index, view in enumerate(views)]  # no rings to speak of
    for some in (views, tilted):
        assert f"azimuth-flip-{count - 1}" in ids(azimuth_chart(some))
    with pytest.raises(InputError, match="none to draw"):
        azimuth_chart([])


def test_the_plan_turns_about_its_middle(known_cloud: BillboardCloud) -> None:
    chart = plan_chart(known_cloud)
    assert "plan-eye" in ids(chart)
    eye = re.search(r'id="plan-eye".*?d="M ([\d.]+) ([\d.]+)', chart.svg, re.DOTALL)
    assert eye
    # At azimuth 0 the camera is straight below the middle.
    assert float(eye[1]) == pytest.approx(chart.marks["x"], abs=1e-3) and float(eye[2]) > chart.marks["y"] + 100
    plan_chart(known_cloud.take([]))


def test_the_plan_numbers_a_few_billboards_and_shows_many(known_cloud: BillboardCloud) -> None:
    for count, numbered in ((FEW, True), (FEW + 1, False)):
        many = known_cloud.take([0] * count)
        svg = plan_chart(many).svg
        assert (f">{count}</text>" in svg) == numbered
        assert svg.count("stroke-linecap: round") == count


def test_colors_are_the_pages(known_cloud: BillboardCloud) -> None:
    sizes = [SizeScore(64 >> n, 64 >> n, SizeMeasures(20.0 + n, None if n else 1.1, 0.1)) for n in range(3)]
    charts = [azimuth_chart(scores((20, 0.9, 0.1))), plan_chart(known_cloud), sizes_chart(sizes), loss_chart([3.0, 2.0, float("nan"), 1.0])]
    charts.append(times_chart({"views": 3.0, "fit": 1.0}))
    for chart in charts:
        assert set(re.findall(r"#[0-9a-fA-F]{6}\b", chart.svg)) <= HUES
        assert "<text" in chart.svg and "<metadata" not in chart.svg
        ids(chart)
    names = [name for chart in charts for name in ids(chart)]
    assert len(names) == len(set(names))
    again = [azimuth_chart(scores((20, 0.9, 0.1))), plan_chart(known_cloud)]
    assert [chart.svg for chart in again] == [chart.svg for chart in charts[:2]]


def test_each_stage_begins_where_the_one_before_ends() -> None:
    """With its seconds beside it, and with bars as long as they are."""
    svg = times_chart({"views": 60.0, "fit": 30.0, "evaluate": 10.0}).svg
    bars = re.findall(r'<path d="M ([\d.]+) [\d.]+ \nL ([\d.]+) [\d.]+ \n[^"]*z\n"[^>]*style="fill: var\(--accent\)', svg)
    starts, ends = ([float(value) for value in side] for side in zip(*bars, strict=True))
    assert ends[:-1] == pytest.approx(starts[1:], abs=1e-3)
    shares = [(end - start) / (ends[-1] - starts[0]) for start, end in zip(starts, ends, strict=True)]
    assert shares == pytest.approx([0.6, 0.3, 0.1], abs=1e-3)
    places = [svg.index(f">{said}</text>") for said in ("60.0", "30.0", "10.0")]
    assert places == sorted(places)


def test_elevations_where_lines_end_together_do_not_overlap() -> None:
    ends = [20.0, 20.01, 20.02, 23.0]
    rings = [scores(*[(end, 0.9, 0.1)] * 6, elevation=20.0 * ring) for ring, end in enumerate(ends)]
    svg = azimuth_chart([view for ring in rings for view in ring]).svg
    labels = re.findall(r'<text style="font-size: 8px[^>]*? y="([\d.]+)"[^>]*>(\d+)°</text>', svg)[: len(ends)]  # those of PSNR
    assert [int(elevation) for _, elevation in labels] == [0, 20, 40, 60]
    places = [float(place) for place, _ in labels]
    assert all(low - high > 8.9 for low, high in itertools.pairwise(places))  # a higher value is higher up
