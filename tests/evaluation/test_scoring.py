"""Scoring a cloud on views of itself, where every answer is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards, write_views

from bbfit.checks import InputError
from bbfit.evaluation import metrics
from bbfit.evaluation.scoring import OriginalTree, evaluate, held_out, measure, view_angles
from bbfit.exporting.model import shipped_model
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cloud import TENSORS, BillboardCloud
from bbfit.geometry.orbit import Orbit
from bbfit.images import over_color
from bbfit.views import ViewDataset


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    return write_views(tmp_path_factory.mktemp("views"), crossing_billboards())


def test_a_cloud_scores_full_marks_on_its_own_views(views: ViewDataset) -> None:
    """What is left is the rounding of the pictures to bytes, 58.9 dB (1/255/sqrt(12)) where all pixels are opaque."""
    report = evaluate(crossing_billboards(), views.test)
    assert [view.name for view in report.views] == views.test.names == ["0000", "0002", "0004", "0006"]
    assert [view.azimuth_degrees for view in report.views] == [0, 90, 180, 270]
    for view in report.views:
        measures = view.measures
        assert measures.over_white.psnr > 58.9 and measures.rgba.psnr > 58.9  # measured 65.8 and 65.3 at least
        assert measures.over_white.ssim > 0.9999 and measures.over_white.flip < 0.005  # measured 0.99998 and 0.0024
        assert measures.rgba.iou > 0.99
        assert measures.sharpness == pytest.approx(1, abs=2e-3)
        assert measures.brightness == pytest.approx(1, abs=2e-3)
        assert measures.thesis_scale.psnr - measures.rgba.psnr == pytest.approx(72.2451, abs=1e-4)


def test_another_split_and_another_cloud_score_less(views: ViewDataset) -> None:
    """The measures see the difference between a cloud and a worse one, and which views they are given."""
    cloud = crossing_billboards()
    dark = cloud.with_texels(cloud.texels * torch.tensor([0.5, 0.5, 0.5, 1]))
    measures = evaluate(dark, views.test).mean
    assert measures.brightness == pytest.approx(0.5, abs=2e-3)
    assert measures.rgba.iou > 0.99
    assert measures.over_white.psnr < 25
    assert [view.name for view in evaluate(dark, views.train).views] == ["0001", "0003", "0005", "0007"]


def test_nothing_drawn(views: ViewDataset) -> None:
    """Transparent billboards are white over white: every measure is finite, and as bad as it should be."""
    cloud = crossing_billboards()
    report = evaluate(cloud.with_texels(torch.zeros_like(cloud.texels)), views.test)
    assert report.overdraw == 1 and {size.coverage for size in report.sizes} == {0}
    assert report.mean.rgba.iou == report.mean.sharpness == report.mean.brightness == 0
    target = over_color(views.test.targets([2], torch.float64)[0]).numpy()
    assert report.views[2].measures.over_white.psnr == pytest.approx(metrics.psnr(target, np.ones_like(target)), abs=1e-9)
    json.dumps(report.to_json(), allow_nan=False)


def test_both_empty() -> None:
    empty = torch.zeros(16, 16, 4)
    measures = measure(empty, empty)
    assert measures.over_white.psnr == measures.rgba.psnr == 120
    assert measures.over_white.ssim == measures.rgba.iou == 1
    assert measures.over_white.flip == measures.rgba.rmse == 0
    assert measures.sharpness is None and measures.brightness is None


def test_measures_are_taken_from_the_right_pictures() -> None:
    """A transparent white layer is invisible over white but not in RGBA: only the second group may see it."""
    target, image = torch.zeros(16, 16, 4), torch.full((16, 16, 4), 0.25)
    measures = measure(target, image)
    assert measures.over_white.psnr == 120 and measures.over_white.flip == 0
    assert measures.rgba.rmse == pytest.approx(0.25, rel=1e-12)
    assert measures.thesis_scale.rmse == pytest.approx(0.25 / 4095, rel=1e-12)
    assert measures.thesis_scale.sre == -120  # the signal is the target's, and it has none


def test_costs_and_stages(views: ViewDataset) -> None:
    cloud = crossing_billboards()
    calls: list[tuple[int, int]] = []
    report = evaluate(
        cloud,
        views.test,
        original=OriginalTree(vertices=64_000, bytes=8_000),
        on_progress=lambda done, total: calls.append((done, total)),
    )
    assert calls == [(done, 9) for done in range(1, 10)], "four views, and five sizes of pictures"
    size = len(shipped_model(cloud).glb)
    content = report.to_json()
    assert content["vertices"] == {"model": 8, "original": 64_000, "ratio": 8 / 64_000}
    assert content["bytes"] == {"model": size, "original": 8_000, "ratio": size / 8_000}
    assert list(content["seconds"]) == ["evaluate"] and content["seconds"]["evaluate"] > 0
    alone = evaluate(cloud, views.test).to_json()
    assert alone["vertices"] == {"model": 8, "original": None, "ratio": None}
    assert alone["bytes"] == {"model": size, "original": None, "ratio": None}


def test_two_sided_billboards_count_twice(views: ViewDataset) -> None:
    cloud = crossing_billboards()
    two = replace(cloud, two_sided=torch.tensor([True, True]), texels=cloud.texels.repeat(2, 1))
    assert evaluate(two, views.test).vertices.model == 16


def test_render_is_clamped_and_not_rounded(views: ViewDataset) -> None:
    cloud = crossing_billboards()
    _, image = held_out(shipped_model(cloud.with_texels(cloud.texels * 1.5)).draw, views.test, 1)
    assert image.dtype == torch.float64 and image.min() == 0 and image.max() == 1
    assert ((image * 255).round() / 255 - image).abs().max() > 1e-3


def test_bad_input(views: ViewDataset, tmp_path: Path) -> None:
    cloud = crossing_billboards()
    with pytest.raises(InputError, match="cloud: its render of view 0000 has values that are not finite"):
        evaluate(cloud.with_texels(torch.full_like(cloud.texels, torch.nan)), views.test)
    with pytest.raises(InputError, match="no billboards"):
        evaluate(BillboardCloud(**{name: getattr(cloud, name)[:0] for name in TENSORS}), views.test)
    with pytest.raises(InputError, match="no held-out view"):
        evaluate(cloud, replace(views.test, paths=()))
    with pytest.raises(InputError, match=r"12x10 pixels; give at least 11x11"):
        evaluate(cloud, write_views(tmp_path, cloud, count=4, width=12, height=10).test)
    with pytest.raises(InputError, match="original vertices: expected at least 0"):
        OriginalTree(vertices=-1)
    with pytest.raises(InputError, match="image: expected shape"):
        measure(torch.zeros(16, 16, 4), torch.zeros(16, 15, 4))


def test_angles_are_the_orbits() -> None:
    """Azimuth and elevation come back from the cameras, wherever the tree stands."""
    orbit = Orbit(10, (-20.0, 0.0, 45.0))
    target = torch.tensor([3.0, -2.0, 7.0], dtype=torch.float64)
    camera = Camera(look_at(target + 5 * orbit.directions, target), pinhole_intrinsics(40, 8, 8).repeat(10, 1, 1), 8, 8)
    np.testing.assert_allclose(view_angles(camera).numpy(), orbit.angles_degrees, atol=1e-6)
    assert view_angles(camera[0]).shape == (1, 2)


def test_angles_of_the_axes_and_the_zenith() -> None:
    position = torch.tensor([[0, 0, 4], [4, 0, 0], [0, 0, -4], [-4, 0, 0], [0, 4, 0], [0, -4, 0]], dtype=torch.float64)
    camera = Camera(look_at(position, torch.zeros(3).double()), pinhole_intrinsics(40, 8, 8).repeat(6, 1, 1), 8, 8)
    assert view_angles(camera).tolist() == [[0, 0], [90, 0], [180, 0], [270, 0], [0, 90], [0, -90]]
