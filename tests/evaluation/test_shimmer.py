"""The change between neighboring views, against changes that are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards
from torch import Tensor

from bbfit.checks import InputError
from bbfit.evaluation.report import Report
from bbfit.evaluation.scoring import evaluate
from bbfit.evaluation.shimmer import change, score_shimmer
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.orbit import Orbit
from bbfit.images import over_color, shrunk, unpremultiply
from bbfit.rendering.dispatch import render
from bbfit.views.dataset import TurnedViews
from bbfit.views.view_set import ViewSet

AXIS = torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64)


def pairs_of(cloud: BillboardCloud, *, width: int = 140, height: int = 100, times: int = 4) -> TurnedViews:
    """Three views of a cloud and their neighbors, means over ``times`` x ``times`` samples of each pixel."""
    corners = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (0.0, 3.0) for z in (-1.0, 1.0)])
    camera = Orbit(3, (10.0,)).frame(corners.double().numpy(), target=AXIS, width=width, height=height)

    def view_set(camera: Camera) -> ViewSet:
        images = torch.stack([shrunk(image, width, height) for image in render(cloud, camera.resized(width * times, height * times))])
        return ViewSet.from_arrays(unpremultiply(images).clamp(0, 1), camera)

    return TurnedViews(view_set(camera), view_set(camera.turned(1, AXIS)))


@pytest.fixture(scope="module")
def pairs() -> TurnedViews:
    return pairs_of(crossing_billboards())


def test_change_is_the_mean_over_pixels_channels_and_backgrounds() -> None:
    """Half of the pixels turn from nothing to an opaque color; over a background of that color nothing changes."""
    color = (0.55, 0.70, 0.90)  # of the sky
    empty, opaque = torch.zeros(6, 8, 4).double(), torch.zeros(6, 8, 4).double()
    opaque[:3] = torch.tensor([*color, 1.0])
    others = [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.25, 0.35, 0.12)]
    expected = sum(abs(one - other) for background in others for one, other in zip(color, background, strict=True)) / 3 / 4 / 2
    assert change(empty, opaque) == change(opaque, empty) == pytest.approx(expected, rel=1e-7)
    assert change(opaque, opaque) == 0


def test_the_tree_drawn_like_its_views_changes_as_they_do(pairs: TurnedViews) -> None:
    """Sides from 512 pixels down that fit into the views, drawn as means over areas; left is the rounding of the pictures to bytes."""

    def averaged(camera: Camera) -> Tensor:
        full = render(crossing_billboards(), camera.resized(140 * 4, 100 * 4))
        return torch.stack([shrunk(shrunk(image, 140, 100), camera.width, camera.height) for image in full])

    scores = score_shimmer(averaged, pairs)
    assert [(score.width, score.height) for score in scores] == [(128, 91), (64, 46), (32, 23)]
    for score in scores:
        assert score.ratio == pytest.approx(1, abs=0.02) and score.antialiased is None and 0 < score.tree < 0.1


def test_ratio_is_that_of_sums_over_pairs(pairs: TurnedViews) -> None:
    """White that comes in the neighbor of the first view alone: the mean of 1 minus each background's channels."""
    first = pairs.turned.cameras[0].world_to_camera

    def draw(camera: Camera) -> Tensor:
        white = torch.stack([torch.allclose(pose, first) * torch.ones(camera.height, camera.width, 4) for pose in camera.world_to_camera])
        assert len(camera) == 2
        return white * 2  # clamped to 1

    blank = lambda camera: torch.zeros(2, camera.height, camera.width, 4)  # noqa: E731
    white = 1 - sum(sum(color) / 3 for color in ((1, 1, 1), (0, 0, 0), (0.25, 0.35, 0.12), (0.55, 0.70, 0.90))) / 4
    for score in score_shimmer(draw, pairs, blank):
        own = 0.0
        for index in range(3):
            both = [shrunk(part.targets([index], torch.float64)[0], score.width, score.height) for part in (pairs.views, pairs.turned)]
            for color in ((1, 1, 1), (0, 0, 0), (0.25, 0.35, 0.12), (0.55, 0.70, 0.90)):
                one, other = (over_color(picture, torch.tensor(color, dtype=torch.float64)) for picture in both)
                own += float((one - other).abs().mean()) / 4
        assert score.tree == pytest.approx(own / 3, rel=1e-9)
        assert score.ratio == pytest.approx(white / own, rel=1e-9) and score.antialiased == 0


def test_one_sample_per_pixel_flickers_and_more_the_smaller_it_is_drawn() -> None:
    """Textures of many texels to a pixel, which means over areas calm down and single samples do not."""
    cloud = crossing_billboards()
    many = torch.Generator().manual_seed(2)
    fine = replace(cloud, texture_sizes=torch.tensor([[120, 80]] * 2), texels=torch.rand(2 * 120 * 80, 4, generator=many))
    hard = replace(fine, alpha=AlphaMode("mask"))
    scores = score_shimmer(lambda camera: render(hard, camera), pairs_of(hard))
    ratios = [score.ratio for score in scores if score.ratio is not None]
    assert len(ratios) == 3 and 1.2 < ratios[0] < ratios[1] < ratios[2]


def test_report_has_the_shimmer_of_both_drawings_of_a_mask(pairs: TurnedViews, tmp_path: Path) -> None:
    mask, seen = replace(crossing_billboards(), alpha=AlphaMode("mask")), list[tuple[int, int]]()
    report = evaluate(mask, pairs.views, turned=pairs, on_progress=lambda done, total: seen.append((done, total)))
    model = shipped_model(mask)
    expected = score_shimmer(model.draw, pairs, model.antialiased().draw)
    assert report.shimmer == expected and all(score.antialiased for score in expected)
    assert seen[-1] == (9, 9) and [done for done, _ in seen] == sorted(done for done, _ in seen)
    report.save(tmp_path / "metrics.json")
    assert Report.load(tmp_path / "metrics.json").shimmer == expected
    assert evaluate(mask, pairs.views).shimmer == ()
    blended = evaluate(crossing_billboards(), pairs.views, turned=pairs).shimmer
    assert [score.antialiased for score in blended] == [None] * 3 and all(score.ratio for score in blended)


def test_a_tree_that_does_not_change_has_no_ratio() -> None:
    pairs = pairs_of(crossing_billboards().with_texels(torch.zeros(2 * 12 * 8, 4)))
    assert {(score.tree, score.ratio) for score in score_shimmer(lambda camera: render(crossing_billboards(), camera), pairs)} == {
        (0, None)
    }


def test_unusable_renders_and_pairs_are_refused(pairs: TurnedViews) -> None:
    with pytest.raises(InputError, match="the render of view 0000"):
        score_shimmer(lambda camera: torch.zeros(2, camera.height, camera.width, 3), pairs)
    with pytest.raises(InputError, match="not finite for view 0000 at 128 x 91 pixels"):
        score_shimmer(lambda camera: torch.full((2, camera.height, camera.width, 4), math.nan), pairs)
    with pytest.raises(InputError, match="got 2 and 3"):
        score_shimmer(lambda camera: render(crossing_billboards(), camera), TurnedViews(pairs.views, pairs.turned.take([0, 1])))


def test_mip_levels_are_those_of_the_file_however_the_mask_is_drawn(pairs: TurnedViews) -> None:
    model = shipped_model(replace(crossing_billboards(), alpha=AlphaMode("mask")), ExportConfig(textures="ktx2"))
    smoothed = shipped_model(replace(model.cloud, alpha=AlphaMode("mask", antialiased=True)), model.config)
    assert model.antialiased().cards is model.cards and model.cards.chain and smoothed.cards.chain
    assert all(np.array_equal(*levels) for levels in zip(model.cards.chain, smoothed.cards.chain, strict=True))
    hard, smooth = (draw(pairs.views.cameras) for draw in (model.draw, model.antialiased().draw))
    assert set(hard[..., 3].unique().tolist()) == {0.0, 1.0} and len(smooth[..., 3].unique()) > 100
