"""Scoring a cloud on views of itself, where every answer is known."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards, framed_billboards, write_views
from skimage.color import rgb2lab

from bbfit.checks import InputError
from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.evaluation.measures import Over, OverBackground, mean_measures
from bbfit.evaluation.scoring import OriginalTree, evaluate, evaluate_model, held_out, measure, view_angles
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cloud import TENSORS, BillboardCloud
from bbfit.geometry.orbit import Orbit
from bbfit.images import over_color
from bbfit.views.dataset import ViewDataset


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    return write_views(tmp_path_factory.mktemp("views"), crossing_billboards())


def test_a_cloud_scores_full_marks_on_its_own_views(tmp_path: Path) -> None:
    """What is left is the rounding of pictures and textures to bytes, 58.9 dB (1/255/sqrt(12)) where all pixels are opaque."""
    cloud = framed_billboards()
    views = write_views(tmp_path, cloud)
    report = evaluate(cloud, views.test, export=ExportConfig(mipmaps=False))
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
    assert report.overdraw == 1 and {size.measures.coverage for size in report.sizes} == {0}
    assert report.mean.rgba.iou == report.mean.sharpness == report.mean.brightness == 0
    target = over_color(views.test.targets([2], torch.float64)[0]).numpy()
    assert report.views[2].measures.over_white.psnr == pytest.approx(metrics.psnr(target, np.ones_like(target)), abs=1e-9)
    json.dumps(report.to_json(), allow_nan=False)


def test_a_mask_is_scored_with_hard_edges_and_with_alpha_to_coverage(views: ViewDataset) -> None:
    cloud = crossing_billboards()
    for kind in ("mask", "blend"):
        model = shipped_model(replace(cloud, alpha=AlphaMode(kind)), None)
        report = evaluate_model(model, views.test)
        for index, view in enumerate(report.views):
            assert view.measures == measure(*held_out(model.draw, views.test, index))
            smooth = measure(*held_out(model.antialiased().draw, views.test, index)) if kind == "mask" else None
            assert view.antialiased == smooth != view.measures


def test_both_empty() -> None:
    empty = torch.zeros(16, 16, 4)
    measures = measure(empty, empty)
    assert measures.over_white.psnr == measures.rgba.psnr == 120
    assert measures.over_white.ssim == measures.rgba.iou == 1
    assert measures.over_white.flip == measures.rgba.rmse == 0
    assert measures.sharpness is None and measures.brightness is None
    assert measures.over.mean == measures.over.sky == OverBackground(120, 1, 0)
    assert measures.colour.delta_e is measures.colour.chroma is measures.colour.brightness is None


def constant(color: tuple[float, float, float], alpha: float = 1.0, side: int = 16) -> torch.Tensor:
    """One premultiplied color of straight RGB and an alpha everywhere, [side, side, 4]."""
    return torch.tensor([*(alpha * value for value in color), alpha], dtype=torch.float64).expand(side, side, 4)


def test_scores_are_over_each_background_and_their_mean(views: ViewDataset) -> None:
    target = views.test.targets([1], torch.float64)[0]
    image = target * torch.tensor([0.6, 0.7, 0.8, 0.9], dtype=torch.float64)
    over = measure(target, image).over
    assert list(BACKGROUNDS) == ["white", "black", "grass", "sky"] == [entry.name for entry in fields(Over)]
    for name, color in BACKGROUNDS.items():
        alphas = target[..., 3:].numpy(), image[..., 3:].numpy()
        pair = [picture[..., :3].numpy() + (1 - alpha) * np.array(color) for picture, alpha in zip((target, image), alphas, strict=True)]
        found = getattr(over, name)
        assert found == OverBackground(metrics.psnr(*pair), metrics.ssim(*pair), metrics.flip(*pair))
    for each in ("psnr", "ssim", "flip"):
        assert getattr(over.mean, each) == pytest.approx(np.mean([getattr(getattr(over, name), each) for name in BACKGROUNDS]), rel=1e-12)
    assert len({getattr(over, name).psnr for name in BACKGROUNDS}) == 4


def test_a_haze_in_the_color_of_a_background_is_seen_over_the_others() -> None:
    """Half-opaque white over nothing: invisible over white, a difference of a half over black."""
    over = measure(constant((0, 0, 0), 0), constant((1, 1, 1), 0.5)).over
    assert over.white.psnr == 120 and over.white.flip == 0
    assert over.black.psnr == pytest.approx(-20 * math.log10(0.5))
    assert over.grass.psnr == pytest.approx(-10 * math.log10(np.mean([(0.5 * (1 - value)) ** 2 for value in (0.25, 0.35, 0.12)])))
    assert over.mean.psnr < 40 and over.mean.flip > 0.2


def test_half_transparent_leaves_keep_their_color_and_gray_ones_do_not() -> None:
    """The target's leaves are half transparent. The same color at any alpha is perfect; gray of the same alpha has no chroma."""
    green = (0.2, 0.5, 0.1)
    target = constant(green, 0.5)
    solid = measure(target, constant(green, 1.0)).colour
    assert (solid.delta_e, solid.chroma, solid.brightness) == pytest.approx((0, 1, 1), abs=1e-12)
    gray = measure(target, constant((0.4, 0.4, 0.4), 0.5)).colour
    wanted = rgb2lab(np.array([green, (0.4, 0.4, 0.4)]))
    assert gray.delta_e == pytest.approx(float(np.linalg.norm(wanted[1] - wanted[0])), rel=1e-9) and gray.delta_e > 40
    assert gray.chroma == pytest.approx(0, abs=1e-3) and gray.brightness == pytest.approx(1.2 / 0.8)
    assert measure(constant((0.4, 0.4, 0.4)), target).colour.chroma is None, "a gray target has no chroma to compare with"


def test_holes_are_dark_for_the_old_brightness_only() -> None:
    target = constant((0.2, 0.5, 0.1))
    holed = target.clone()
    holed[:, ::4] = 0
    measures = measure(target, holed)
    assert measures.brightness == pytest.approx(0.75) and measures.colour.brightness == pytest.approx(1)
    assert measures.colour.delta_e == pytest.approx(0, abs=1e-12)
    dim = measure(target, holed * torch.tensor([0.5, 0.5, 0.5, 1]))
    assert dim.brightness == pytest.approx(0.375) and dim.colour.brightness == pytest.approx(0.5)


def test_brightness_is_that_inside_the_targets_silhouette() -> None:
    """What the render draws elsewhere counts for its mean color, but not for its brightness."""
    target = torch.zeros(16, 16, 4, dtype=torch.float64)
    target[:8] = constant((0.2, 0.5, 0.1))[:8]
    image = target.clone()
    image[8:] = constant((1, 1, 1))[8:]
    colour = measure(target, image).colour
    assert colour.brightness == pytest.approx(1) and colour.delta_e is not None and colour.delta_e > 20
    assert colour.render == pytest.approx((128 * 1.2, 128 * 1.5, 128 * 1.1, 256)) and colour.render_inside == colour.target_inside


def test_colors_of_several_views_are_pooled() -> None:
    """One view is too red and another too green, by areas of 1 to 3: their sums are the target's, the means of their figures are not."""
    gray, red, green = (0.4, 0.4, 0.2), (0.7, 0.4, 0.2), (0.3, 0.4, 0.2)
    small, large = torch.zeros(16, 16, 4).double(), torch.zeros(16, 16, 4).double()
    small[:4], large[:12] = 1, 1
    pairs = [(shape * constant(gray), shape * constant(color)) for shape, color in ((small, red), (large, green))]
    each = [measure(*pair) for pair in pairs]
    pooled = mean_measures(each).colour
    assert (pooled.delta_e, pooled.chroma, pooled.brightness) == pytest.approx((0, 1, 1), abs=1e-9)
    assert min(one.colour.delta_e or 0 for one in each) > 5
    assert pooled.target == pytest.approx((256 * 0.4, 256 * 0.4, 256 * 0.2, 256))
    empty = torch.zeros(16, 16, 4)
    for pair in ((empty, pairs[0][1]), (pairs[0][0], empty)):
        nothing = measure(*pair).colour
        assert nothing.delta_e is nothing.chroma is nothing.brightness is None
    assert mean_measures([measure(*pairs[0]), measure(empty, empty)]).colour == each[0].colour, "a view without a tree changes nothing"


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
    with pytest.raises(InputError, match="cloud: texels are not all finite"):
        evaluate(cloud.with_texels(torch.full_like(cloud.texels, torch.nan)), views.test)
    with pytest.raises(InputError, match="cloud: its render of view 0000 has values that are not finite"):
        held_out(lambda camera: torch.full((camera.height, camera.width, 4), torch.nan), views.test, 0)
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
