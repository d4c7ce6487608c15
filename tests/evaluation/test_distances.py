"""The verdict on distances, by hand: a screen of 1080 lines that spans 50 degrees has a focal length of 540 / tan(25 degrees) pixels."""

from __future__ import annotations

import math

import pytest

from bbfit.evaluation.distances import viewing_distances

FOCAL = 540 / math.tan(math.radians(25))


def test_distances_are_those_at_which_the_screen_shows_the_tree_as_large_as_the_views() -> None:
    fine = viewing_distances(1.0, 16.0, [(256, 1.0), (128, 0.9), (64, 1.1)])
    assert fine.near_meters == pytest.approx(FOCAL / 16) and fine.far_meters is None and fine.good
    assert fine.near_meters == viewing_distances(0.0, 16.0, [(256, 1.0)]).near_meters  # nearer was not seen
    assert viewing_distances(3.0, 16.0, [(256, 1.0)]).near_meters == pytest.approx(3 * FOCAL / 16)
    thin = viewing_distances(1.0, 16.0, [(256, 1.0), (128, 0.81), (64, 0.79), (32, 1.0)])
    assert thin.far_meters == pytest.approx(2 * FOCAL / 16) and thin.good
    bad = viewing_distances(5.0, 16.0, [(256, 1.0), (128, 1.19), (64, 1.21)])
    assert bad.far_meters == pytest.approx(2 * FOCAL / 16) and not bad.good
    for coverage in (0.5, None):
        none = viewing_distances(1.0, 16.0, [(256, coverage), (128, 1.0)])
        assert none.far_meters == 0 and not none.good


def test_the_verdict_says_what_to_do_next() -> None:
    verdicts = [
        viewing_distances(silhouette, 16.0, sizes).verdict
        for silhouette, sizes in ((1.0, [(256, 1.0)]), (2.0, [(256, 1.0), (128, 0.9), (64, 0.7)]), (1.0, [(256, 0.5)]))
    ]
    assert (
        verdicts[0].startswith("Outlines, to a pixel, and density are right from 72.4 m on a screen of 1080 lines.")
        and "--size" in verdicts[0]
    )
    assert "right from 145 m to 145 m on a screen" in verdicts[1]
    assert "--billboards" in verdicts[1] and "ktx2" in verdicts[1] and verdicts[2].startswith("Not right")
