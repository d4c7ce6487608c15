"""Scores from afar, of models whose pictures and costs are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from bbfit.checks import InputError
from bbfit.evaluation.afar import FarScore, drawing_cost, score_afar, seen_afar, shown_height
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit
from bbfit.views.view_set import ViewSet

COLOR = (0.2, 0.6, 0.4)
SHARE = 72 * 30 / 96**2  # of the picture that the tree covers


def views(rows: tuple[tuple[int, int], ...] = ((12, 84), (9, 81))) -> ViewSet:
    """Views of 96 x 96 pixels, each with an opaque even rectangle of 30 columns between two rows."""
    pictures = np.zeros((len(rows), 96, 96, 4), np.uint8)
    for picture, (top, bottom) in zip(pictures, rows, strict=True):
        picture[top:bottom, 33:63] = [*(round(255 * value) for value in COLOR), 255]
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return ViewSet.from_arrays(pictures, Orbit(len(rows)).frame(box, target=torch.zeros(3), width=96, height=96))


def nothing(camera: Camera) -> Tensor:
    return torch.zeros(camera.height, camera.width, 4)


def test_views_shrink_by_the_mean_of_areas_and_keep_their_field_of_view() -> None:
    shown = views(((12, 84), (50, 50)))
    assert [shown_height(shown, index) for index in (0, 1)] == [72, 0]
    view = seen_afar(shown, 0, 1 / 3)
    assert (view.camera.width, view.camera.height, view.tree_pixels) == (32, 32, 24)
    wanted = torch.zeros(32, 32, 4, dtype=torch.float64)
    wanted[4:28, 11:21] = torch.tensor([*COLOR, 1.0], dtype=torch.float64)
    torch.testing.assert_close(view.target, wanted, atol=1e-12, rtol=0)
    corner = torch.tensor([[0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close((view.camera.project(corner) + 0.5) * 3, shown.cameras[0].project(corner) + 0.5)
    assert [seen_afar(shown, 0, scale).camera.height for scale in (0.01, 2.0)] == [11, 96]


def test_scores_are_means_over_views_and_backgrounds() -> None:
    """Of an empty picture the error is that of the backgrounds where the tree should be. FLIP sees no difference in equal pictures."""
    shown, asked = views(), list[int]()

    def fragments(camera: Camera) -> float:
        asked.append(camera.height)
        return 100.0 * len(asked)

    score = score_afar(nothing, shown, 24, fragments)
    errors = [SHARE * np.mean(np.subtract(COLOR, background) ** 2) for background in BACKGROUNDS.values()]
    assert score is not None and score.psnr == pytest.approx(np.mean([-10 * math.log10(error) for error in errors]))
    assert asked == [32, 32] and (score.tree_pixels, score.fragments) == (24, 150) and 0.1 < score.flip < 0.5
    assert drawing_cost(score, 20, 2.5) == 200
    equal = score_afar(shown.draw, shown, 24)
    assert equal == FarScore(24, 120, 0, None)
    assert drawing_cost(equal, 20, 2.5) is drawing_cost(score, None, 2.5) is drawing_cost(None, 20, 2.5) is None


def test_all_views_have_the_size_at_which_the_highest_is_that_high() -> None:
    """A narrow tree from above is low. It is as far away as from the side."""
    sizes = list[tuple[int, int]]()

    def draw(camera: Camera) -> Tensor:
        sizes.append((camera.width, camera.height))
        return nothing(camera)

    both = score_afar(draw, views(((12, 84), (40, 52))), 24)
    assert both and sizes == [(32, 32)] * 2 and both.tree_pixels == 24
    lower = score_afar(draw, views(((40, 52),)), 24)
    assert lower and sizes[2:] == [(96, 96)] and lower.tree_pixels == 12  # never enlarged


def test_empty_views_have_no_score_and_numbers_must_be_finite() -> None:
    assert score_afar(nothing, views(((5, 5), (9, 9))), 24) is None
    with pytest.raises(InputError, match="mesh: its render of view 0000 has values that are not finite"):
        score_afar(lambda camera: torch.full((camera.height, camera.width, 4), math.nan), views(), 24, drawn="mesh")
