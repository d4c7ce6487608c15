"""What limits leave for texels, and what a configuration reaches with them, with trials that are made up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bbfit.budget.config import BudgetConfig
from bbfit.budget.spending import has_all_texels, spent, texel_gain, texels_within
from bbfit.budget.trials import Trial, Trials
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.views.dataset import ViewDataset


def trial(count: int, texels: int, pictures: int, bare: int = 0, psnr: float = 20.0, most: int | None = None, two: bool = False) -> Trial:
    vertices = count * (8 if two else 4)
    return Trial(count, "two" if two else "one", "clusters", most or texels, vertices, texels, bare + pictures, pictures, psnr, 0.0)


@pytest.fixture(scope="module")
def views(views_folder: Path) -> ViewDataset:
    return ViewDataset.load(views_folder)


@pytest.fixture
def trials_of(views: ViewDataset) -> Callable[[Callable[[int, int], tuple[int, float]]], Trials]:
    """Trials with bytes and PSNR that are a function of the number of billboards and the limit of texels."""

    def made(world: Callable[[int, int], tuple[int, float]]) -> Trials:
        def known(config: FitConfig) -> Trial:
            assert config.billboards and config.max_texels
            pictures, psnr = world(config.billboards, config.max_texels)
            return trial(config.billboards, config.max_texels, pictures, psnr=psnr)

        return Trials(views, FitConfig(), None, ExportConfig(), known)

    return made


def test_bytes_that_are_left_go_to_texels() -> None:
    """What is no picture grows with the textures, of which a two-sided billboard has two, for more of them as their power of 0.6 at least;
    nothing may be left."""
    assert texels_within([], 4, 1000.0) == 500
    one = trial(4, 1000, pictures=3000, bare=800)
    assert texels_within([one], 4, 6800) == pytest.approx(2000)
    bare = 800 * 2**0.6
    assert texels_within([one], 8, 6000 + bare) == pytest.approx(2000)
    assert texels_within([trial(2, 1000, 3000, 800, two=True)], 8, 6000 + bare) == pytest.approx(2000)
    assert texels_within([one], 2, 6400) == pytest.approx(2000)  # at best in proportion
    assert texels_within([one], 8, bare) == 0 and texels_within([one], 40, 1600) < 0


def test_the_nearest_trial_counts() -> None:
    """In number of textures first; of two with as many, the one whose bytes are nearest."""
    few, many, more = trial(4, 1000, 1000), trial(16, 1000, 2000), trial(16, 4000, 4000)
    assert texels_within([few, many, more], 6, 8000) == pytest.approx(8000)
    assert texels_within([few, many, more], 24, 2000) == pytest.approx(1000)
    assert texels_within([few, many, more], 24, 4000) == pytest.approx(4000)


def test_what_a_fit_may_have_is_more_than_it_has() -> None:
    """A fit leaves some of its limit, in any case as large a part of it; one that leaves much of it is as dense as it is to be."""
    some, much = trial(4, 900, 1800, most=1000), trial(4, 500, 1000, most=1000)
    assert not has_all_texels(some) and texels_within([some], 4, 3600) == pytest.approx(2000)
    assert has_all_texels(much) and texels_within([much], 4, 2000) == pytest.approx(1000)
    assert not has_all_texels(trial(128, 500, 1000, most=1000))  # a few texels each are rounded away


def test_trials_of_equal_billboards_show_what_texels_gain() -> None:
    """Otherwise a usual gain is taken; texels never make it worse."""
    assert texel_gain([]) == texel_gain([trial(4, 1000, 1), trial(6, 4000, 1), trial(2, 4000, 1, two=True), trial(4, 1100, 1)]) == 0.4
    assert texel_gain([trial(4, 1000, 1, psnr=20), trial(6, 1000, 1), trial(4, 4000, 1, psnr=21)]) == pytest.approx(0.5)
    assert texel_gain([trial(4, 4000, 1, psnr=20), trial(4, 1000, 1, psnr=21)]) == 0


def test_what_a_trial_leaves_of_the_limit_counts_as_used(trials_of: Callable[..., Trials]) -> None:
    """Except for a target, which a trial has to reach as it is."""
    for budget, gain in ((BudgetConfig(bytes=100_000), 0.4 * 0.5), (BudgetConfig(bytes=100_000, target_psnr=30), 0.0)):
        trials = trials_of(lambda count, texels: (round(texels * 100_000 / 2**0.5 / 46_000), 20.0))
        found = spent(trials, budget, 4, "one", "clusters")
        assert found is not None and len(trials.done) == 1
        assert found.psnr == pytest.approx(20 + gain, abs=1e-4) and found.max_texels == pytest.approx(2**0.5 * 46_000, abs=3)


def test_what_exceeds_the_limit_is_nothing(trials_of: Callable[..., Trials]) -> None:
    """Three trials are enough to see that."""
    trials = trials_of(lambda count, texels: (200_000 + texels, 20.0))
    assert spent(trials, BudgetConfig(bytes=100_000), 4, "one", "clusters") is None and len(trials.done) == 3
    assert spent(trials, BudgetConfig(texels=7), 4, "one", "clusters").psnr == 20  # type: ignore[union-attr]
    assert trials.done[-1].max_texels == 7
