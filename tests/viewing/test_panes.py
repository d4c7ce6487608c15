"""Sizes on the screen, and the slider of distances."""

from __future__ import annotations

import math

import pytest

from bbfit.viewing.panes import STEPS, Picture, Reach, meters


def test_a_metre_is_as_large_as_a_pinhole_shows_it() -> None:
    """Half of the pane's height is seen under half of the field of view."""
    picture = Picture(800, 600, math.radians(90), split=False)
    assert picture.pixels_a_meter(10.0) * 10.0 == pytest.approx(300)  # at 45 degrees, 10 m up are as far away as the tree


@pytest.mark.parametrize(
    ("width", "height", "split", "pane"),
    [(800, 600, False, (800, 600)), (800, 600, True, (400, 600)), (600, 800, True, (600, 400)), (500, 500, True, (250, 500))],
)
def test_panes_stand_side_by_side_where_the_picture_is_wide(width: int, height: int, split: bool, pane: tuple[float, float]) -> None:
    assert Picture(width, height, 0.7, split).pane == pane


@pytest.mark.parametrize(("width", "height"), [(2.0, 10.0), (10.0, 2.0)])
def test_what_is_to_fit_fills_four_fifths_of_the_pane(width: int, height: int) -> None:
    picture = Picture(900, 500, 0.7, split=True)
    scale = picture.pixels_a_meter(picture.distance_to_fit(width, height))
    assert max(width * scale / picture.pane[0], height * scale / picture.pane[1]) == pytest.approx(0.8)


def test_steps_of_the_slider_are_equal_factors() -> None:
    reach = Reach(2.0, 800.0)
    assert (reach.distance(0), reach.distance(STEPS)) == (2.0, pytest.approx(800.0))
    assert reach.distance(STEPS / 2) == pytest.approx(40.0)
    assert [reach.step(reach.distance(step)) for step in range(STEPS + 1)] == list(range(STEPS + 1))
    assert (reach.step(0.0), reach.step(1e9)) == (0, STEPS)


def test_meters_are_told_with_three_digits() -> None:
    assert [meters(value) for value in (3.14159, 42.4242, 512.3, 2052.2)] == ["3.14 m", "42.4 m", "512 m", "2,052 m"]
