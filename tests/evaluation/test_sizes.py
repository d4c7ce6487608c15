"""Scores at ever smaller sizes: what is drawn is asked for at that size and compared with means over areas of the views."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from billboard_scene import crossing_billboards, write_views
from torch import Tensor

from bbfit.checks import InputError
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.evaluation.report import SizeScore
from bbfit.evaluation.sizes import Draw, score_sizes
from bbfit.geometry.camera import Camera
from bbfit.images import over_color, shrunk
from bbfit.rendering.dispatch import render
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> ViewSet:
    """Four views of 98 x 70 pixels."""
    return write_views(tmp_path_factory.mktemp("views"), crossing_billboards(), width=98, height=70).test


def plain(camera: Camera, value: float) -> Tensor:
    """The same in all channels of all pixels."""
    return torch.full((len(camera), camera.height, camera.width, 4), value)


def averaged(views: ViewSet, index: int, width: int, height: int) -> Tensor:
    """A view's mean over areas: every pixel is cut into width x height parts, of which each new one takes as many as it covers."""
    target = views.targets([index], torch.float64)[0]
    parts = target.repeat_interleave(height, 0).reshape(height, len(target), -1, 4).mean(1)
    return parts.repeat_interleave(width, 1).reshape(height, width, target.shape[1], 4).mean(2)


def test_a_cloud_scores_full_marks_at_the_size_of_its_own_views(views: ViewSet) -> None:
    """Left is the rounding of the pictures to bytes (measured 65.8 dB); smaller pictures differ by what one sample a pixel misses."""
    cloud = crossing_billboards()
    scores = score_sizes(lambda camera: render(cloud, camera), views)
    assert [(score.width, score.height) for score in scores] == [(98, 70), (49, 35), (24, 17)]
    assert scores[0].measures.psnr > 60 and scores[0].measures.alpha < 2e-3 and scores[0].measures.coverage == pytest.approx(1, abs=1e-3)
    for score in scores[1:]:
        assert 20 < score.measures.psnr < 60 and score.measures.coverage == pytest.approx(1, abs=0.02)  # measured 33.0 and 28.0 dB, 0.2 %


def test_targets_are_means_by_area_of_premultiplied_display_values(views: ViewSet) -> None:
    """Drawing just those, by way of the cameras, is perfect at every size, also where sides are no multiples."""
    numbers = {tuple(pose.flatten().tolist()): index for index, pose in enumerate(views.cameras.world_to_camera)}
    asked = []

    def draw(camera: Camera) -> Tensor:
        asked.append(camera)
        (index,) = {numbers[tuple(pose.flatten().tolist())] for pose in camera.world_to_camera}
        return averaged(views, index, camera.width, camera.height).expand(len(camera), -1, -1, -1)

    for score in score_sizes(draw, views):
        assert score.measures.psnr == 120 and score.measures.alpha < 1e-9 and score.measures.coverage == pytest.approx(1, abs=1e-12)
    for size, moved in (((98, 70), [0]), ((49, 35), [0, 4]), ((24, 17), [0, 16])):
        shifts = torch.stack([camera.intrinsics for camera in asked if (camera.width, camera.height) == size])
        assert shifts.shape == (4, sum(moved) + 1, 3, 3)
        shifts = shifts - views.cameras.resized(*size).intrinsics[:, None]
        assert not shifts[:, 0].any() and not shifts[:, :, [0, 1, 2, 2, 2], [0, 1, 0, 1, 2]].any()
        if moved[1:]:
            x, y = shifts[:, 1:, :2, 2].unbind(-1)
            assert len(set(zip(x[0].tolist(), y[0].tolist(), strict=True))) == moved[1]
            torch.testing.assert_close(x.mean(1), torch.zeros(4).double())
            assert float(x.abs().max()) == float(y.abs().max()) == {4: 0.25, 16: 0.375}[moved[1]]


def test_small_pictures_are_drawn_at_several_places_for_their_coverage(views: ViewSet) -> None:
    """A plate that hides what is left of the optical axis."""

    def draw(camera: Camera) -> Tensor:
        covered = torch.arange(camera.width) < camera.intrinsics[:, 0, 2, None]
        return covered[:, None, :, None].expand(-1, camera.height, camera.width, 4).float()

    for score, parts in zip(score_sizes(draw, views), (1, 2, 4), strict=True):
        middle = float(views.cameras.resized(score.width, score.height).intrinsics[0, 0, 2])
        columns = sum(math.ceil(middle + (part + 0.5) / parts - 0.5) for part in range(parts)) / parts
        wanted = sum(float(shrunk(views.targets([index], torch.float64)[0], score.width, score.height)[..., 3].sum()) for index in range(4))
        assert score.measures.coverage == pytest.approx(4 * columns * score.height / wanted)


def test_measures_are_those_of_known_differences(views: ViewSet) -> None:
    """Nothing at all, and white of alpha 1/4 everywhere, at half the size."""
    targets = torch.stack([averaged(views, index, 49, 35) for index in range(4)])
    nothing = score_sizes(lambda camera: plain(camera, 0.0), views, 1)[1]
    colors = [torch.tensor(color).double() for color in BACKGROUNDS.values()]
    errors = torch.stack([(over_color(targets, color) - color).square().mean((1, 2, 3)) for color in colors])
    assert nothing.measures.coverage == 0 and nothing.measures.alpha == pytest.approx(float(targets[..., 3].square().mean().sqrt()))
    assert nothing.measures.psnr == pytest.approx(float((-10 * errors.log10()).mean()))
    haze = score_sizes(lambda camera: plain(camera, 0.25), views, 1)[1]
    hazes = torch.stack([(over_color(targets, color) - 0.25 - 0.75 * color).square().mean((1, 2, 3)) for color in colors])
    assert haze.measures.psnr == pytest.approx(float((-10 * hazes.log10()).mean()))
    assert haze.measures.coverage == pytest.approx(float(0.25 / targets[..., 3].mean()))
    assert haze.measures.alpha == pytest.approx(float((targets[..., 3] - 0.25).square().mean().sqrt()))
    assert score_sizes(lambda camera: plain(camera, 7.0), views, 0)[0].measures.coverage == pytest.approx(4 * haze.measures.coverage)


def test_coverage_is_of_all_views_together(views: ViewSet) -> None:
    """Drawing one view alone has its share of the alpha of all."""
    sums = torch.stack([averaged(views, index, 49, 35)[..., 3].sum() for index in range(4)])
    pose, target = views.cameras.world_to_camera[2], averaged(views, 2, 49, 35)

    def draw(camera: Camera) -> Tensor:
        shown = torch.equal(camera.world_to_camera[0], pose) and camera.width == 49
        return target.expand(len(camera), -1, -1, -1) if shown else plain(camera, 0.0)

    assert score_sizes(draw, views, 1)[1].measures.coverage == pytest.approx(float(sums[2] / sums.sum()))


def test_scores_can_be_written_as_json(views: ViewSet) -> None:
    """With and without alpha to coverage."""
    smooths: tuple[Draw | None, ...] = (None, lambda camera: plain(camera, 0.25))
    for smooth in smooths:
        score = score_sizes(lambda camera: plain(camera, 0.0), views, 0, antialiased=smooth)[0]
        assert SizeScore.from_json(json.loads(json.dumps(score.to_json(), allow_nan=False))) == score
        assert (score.width, score.height) == (98, 70) and (score.antialiased is None) == (smooth is None)


def test_masks_have_measures_for_both_ways_of_drawing(views: ViewSet) -> None:
    """Each is what the other way of drawing has on its own."""

    def hard(camera: Camera) -> Tensor:
        return plain(camera, 0.0)

    def smooth(camera: Camera) -> Tensor:
        return plain(camera, 0.25)

    both = score_sizes(hard, views, 1, antialiased=smooth)
    alone = [score_sizes(draw, views, 1) for draw in (hard, smooth)]
    assert [score.measures for score in both] == [score.measures for score in alone[0]]
    assert [score.antialiased for score in both] == [score.measures for score in alone[1]]
    assert all(score.antialiased is None for score in alone[0])


@pytest.mark.parametrize("size", [(98, 70), (97, 1), (24, 17), (1, 1)])
def test_shrinking_takes_means_by_area(size: tuple[int, int], views: ViewSet) -> None:
    picture = views.targets([1], torch.float64)[0]
    small = shrunk(picture, *size)
    torch.testing.assert_close(small, averaged(views, 1, *size), rtol=0, atol=1e-12)
    assert shrunk(picture.float(), *size).dtype == torch.float32


def test_bad_input(views: ViewSet, tmp_path: Path) -> None:
    cloud = crossing_billboards()
    with pytest.raises(InputError, match="no held-out view"):
        score_sizes(lambda camera: render(cloud, camera), replace(views, paths=()))
    with pytest.raises(InputError, match="halvings: expected at least 0"):
        score_sizes(lambda camera: render(cloud, camera), views, -1)
    with pytest.raises(InputError, match=r"the render of view 0000: expected shape \[1, 70, 98, 4\], got \[70, 98, 4\]"):
        score_sizes(lambda camera: render(cloud, camera[0]), views)
    with pytest.raises(InputError, match="values that are not finite for view 0000 at 98 x 70"):
        score_sizes(lambda camera: plain(camera, math.nan), views)
    with pytest.raises(InputError, match="width: expected at most the picture's 98, got 99"):
        shrunk(views.targets([0])[0], 99, 5)
    write_views(tmp_path, cloud, count=4, width=12, height=11)
    (score,) = score_sizes(lambda camera: render(cloud, camera), ViewDataset.load(tmp_path).test)
    assert (score.width, score.height) == (12, 11)
