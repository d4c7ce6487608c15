"""What limits leave for texels, and what a configuration reaches with them, with trials that are made up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from bbfit.budget.config import BudgetConfig
from bbfit.budget.spending import _FULL, _GAPS, has_all_texels, spent, texels_within
from bbfit.budget.trials import Trial, Trials
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.views.dataset import ViewDataset


def trial(
    count: int, texels: int, pictures: int, bare: int = 0, psnr: float = 20.0, most: int | None = None, density: float = 0.5
) -> Trial:
    return Trial(count, "one", "clusters", most or texels, 4 * count, texels, density, bare + pictures, pictures, psnr, 0.0)


def two_sided(one: Trial) -> Trial:
    return replace(one, sides="two", vertices=2 * one.vertices)


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
    """And to the gaps around textures, of which a two-sided billboard has two. What is no picture grows with the textures, for more of them
    as their power of 0.9 at least; nothing may be left."""
    assert texels_within([], 4, 8000.0) == 3000 and texels_within([], 4000, 9000.0) == pytest.approx(1200)
    one = trial(4, 1000, pictures=3000, bare=800)
    assert texels_within([one], 4, 6800) == pytest.approx(2 * (1000 + 4 * _GAPS) - 4 * _GAPS)
    bare = 800 * 2**0.9
    assert texels_within([one], 8, 6000 + bare) == pytest.approx(2 * (1000 + 4 * _GAPS) - 8 * _GAPS)
    assert texels_within([two_sided(trial(2, 1000, 3000, 800))], 8, 6000 + bare) == texels_within([one], 8, 6000 + bare)
    assert texels_within([one], 2, 6400) == pytest.approx(2 * (1000 + 4 * _GAPS) - 2 * _GAPS)  # at best in proportion
    assert texels_within([one], 8, bare) == -8 * _GAPS and texels_within([one], 40, 1600) < 0


def test_the_nearest_trial_counts() -> None:
    """In number of textures first; of two with as many, the one whose bytes are nearest."""
    few, many, more = trial(4, 1000, 1000), trial(16, 1000, 2000), trial(16, 4000, 4000)
    assert texels_within([few, many, more], 6, 8000) == pytest.approx(8 * (1000 + 4 * _GAPS) - 6 * _GAPS)
    assert texels_within([few, many, more], 24, 2000) == pytest.approx(1000 - 8 * _GAPS)
    assert texels_within([few, many, more], 24, 4000) == pytest.approx(4000 - 8 * _GAPS)


def test_what_a_fit_may_have_is_more_than_it_has() -> None:
    """A fit leaves some of its limit, in any case as large a part of it; one that is dense needs no more."""
    some, all_of_them = trial(4, 900, 1800, most=1000, density=0.97), trial(4, 900, 1800, most=1000, density=0.99)
    assert not has_all_texels(some) and texels_within([some], 4, 3600) == pytest.approx(2000 + 4 * _GAPS)
    assert has_all_texels(all_of_them) and texels_within([all_of_them], 4, 3600) == pytest.approx(1800 + 4 * _GAPS)


@pytest.mark.parametrize(("share", "target"), [(1.5, None), (4, None), (0.7, None), (1.5, 30), (0.7, 30)])
def test_what_a_trial_leaves_of_the_limit_counts_as_used_and_what_it_exceeds_as_lost(
    trials_of: Callable[..., Trials], share: float, target: float | None
) -> None:
    """Until it is dense. A target counts no gain: a trial has to reach it as it is."""
    first, gaps = int((92_000 - 4 * 125) / 2.5), 4 * _GAPS
    trials = trials_of(lambda count, texels: (round((texels + gaps) * 100_000 / share / (first + gaps)), 20.0))
    found = spent(trials, BudgetConfig(bytes=100_000, target_psnr=target), 4, "one", "clusters")
    assert found is not None and len(trials.done) == 1
    left = share * (first + gaps) - gaps
    gain = 0.1 * (2 - 2 / min(left / first, 2))
    assert found.missing == pytest.approx(0.1 * (2 / min(left / first, 2) - 1), abs=1e-5)
    assert found.psnr == pytest.approx(20 + (gain if target is None else min(gain, 0)), abs=1e-4)
    assert found.max_texels == pytest.approx(_FULL * (left + gaps) - gaps, abs=3)


def test_no_more_is_tried_of_what_exceeds_the_limit_and_is_bad_enough(trials_of: Callable[..., Trials]) -> None:
    """Fewer texels would not make it better."""
    for least, tried in ((20.1, 1), (19.9, 2)):
        trials = trials_of(lambda count, texels: (10 * texels, 20.0))
        assert (spent(trials, BudgetConfig(bytes=100_000), 4, "one", "clusters", least=least) is None) is (tried == 1)
        assert len(trials.done) == tried


def test_a_trial_with_the_texels_that_it_asks_for_misses_nothing(views: ViewDataset) -> None:
    """Unless it exceeds the limit in bytes; a limit of texels costs what the density is short of."""
    for limit, missing in ((100_000, 0.0), (3000, 0.1 * (1 / (0.75 - 0.25 * 4 * _GAPS / 1000) - 1))):
        trials = Trials(
            views, FitConfig(), None, ExportConfig(), lambda config: trial(4, 1000, 2000, 1500, most=config.max_texels, density=1)
        )
        found = spent(trials, BudgetConfig(bytes=limit), 4, "one", "clusters")
        assert found is not None and len(trials.done) == 1 and found.missing == pytest.approx(missing)
    trials = Trials(views, FitConfig(), None, ExportConfig(), lambda config: trial(4, 900, 2000, most=config.max_texels, density=0.25))
    assert spent(trials, BudgetConfig(texels=1000), 4, "one", "clusters").missing == pytest.approx(0.3)  # type: ignore[union-attr]


def test_what_exceeds_the_limit_is_nothing(trials_of: Callable[..., Trials]) -> None:
    """Two trials are enough to see that."""
    trials = trials_of(lambda count, texels: (2_000_000 + texels, 20.0))
    assert spent(trials, BudgetConfig(bytes=100_000), 4, "one", "clusters") is None and len(trials.done) == 2
    assert spent(trials, BudgetConfig(texels=7), 4, "one", "clusters").psnr == 20  # type: ignore[union-attr]
    assert trials.done[-1].max_texels == 7
