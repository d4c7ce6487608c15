"""How a budget is spent: what is tried, what is kept, and that nobody peeps at the held-out views."""

from __future__ import annotations

import dataclasses
import json
import math
import random
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from billboard_scene import crossing_billboards

from bbfit.budget import trials as trials_module
from bbfit.budget.choice import COUNTS, MIN_GAIN_DB, START, Choice, choose, pareto_front
from bbfit.budget.config import BudgetConfig
from bbfit.budget.sizes import model_bytes, within_bytes
from bbfit.budget.spending import _FULL, _GAPS
from bbfit.budget.trials import Trial, lookup, short_config
from bbfit.checks import InputError
from bbfit.evaluation.scoring import evaluate, views_psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.bark import Bark
from bbfit.fitting.config import FitConfig, Placement, Sides
from bbfit.fitting.loop import fit
from bbfit.fitting.points import placement_points
from bbfit.fitting.search import QUICK as QUICK_SEARCH
from bbfit.fitting.search import find_placement
from bbfit.geometry.cloud import BillboardCloud
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

LUCK = 0.15
"""What two short fits may differ by for no reason, in dB."""
BYTES_A_TEXEL, BYTES_EACH, AIM = 2.5, 125, 0.92
"""The first guess, for a texel and for a billboard besides; the part of a limit in bytes that a trial aims at."""


def near(wanted: float, granted: float, dense: float) -> bool:
    """Whether a trial with ``granted`` of ``dense`` texels shows what ``wanted`` ones gain."""
    return 4 * wanted >= granted and abs(0.1 * (dense / granted - dense / min(dense, wanted))) <= 0.4


MOST = FitConfig().most_billboards
HALVED = [MOST >> halving for halving in range(MOST.bit_length())]
"""Numbers of billboards that are tried for as long as fewer are worthwhile."""
DATA = Path(__file__).resolve().parents[2] / "data"
Quality = Callable[[int, Sides, Placement], float]


@pytest.fixture(scope="module")
def views(views_folder: Path) -> ViewDataset:
    """Twelve training views."""
    return ViewDataset.load(views_folder)


# The front.


def front_by_comparison(points: Sequence[tuple[float, float]]) -> set[int]:
    """Those that no other point beats: none is as cheap and as good, and better in one of the two or equal and earlier."""
    return {
        i
        for i, (cost, quality) in enumerate(points)
        if not any(c <= cost and q >= quality and ((c, q) != (cost, quality) or j < i) for j, (c, q) in enumerate(points) if j != i)
    }


@pytest.mark.parametrize("seed", range(40))
def test_the_front_is_what_nothing_beats(seed: int) -> None:
    """In order of cost, quality rises from each to the next; few different numbers, so that many are equal."""
    drawn = random.Random(seed)
    points = [(float(drawn.randint(1, 9)), drawn.choice([drawn.random(), float(drawn.randint(0, 5))])) for _ in range(1 + seed)]
    front = pareto_front(points)
    assert set(front) == front_by_comparison(points) and len(set(front)) == len(front) > 0
    assert all(points[a][0] < points[b][0] and points[a][1] < points[b][1] for a, b in pairwise(front))
    best, cheapest = max(quality for _, quality in points), min(cost for cost, _ in points)
    assert points[front[-1]][1] == best and points[front[0]][0] == cheapest


def test_the_front_of_nothing_and_of_equals() -> None:
    assert pareto_front([]) == []
    assert pareto_front([(2, 3), (2, 3), (2, 3)]) == [0]
    assert pareto_front([(4, 1), (2, 3), (1, 2)]) == [2, 1]


# Bytes and decibels.


@pytest.fixture(scope="module")
def noise() -> BillboardCloud:
    """Three billboards, one of them two-sided, with textures that do not pack."""
    sizes, two_sided = torch.tensor([[40, 30], [64, 20], [9, 50]]), torch.tensor([False, True, False])
    texels = torch.rand(40 * 30 + 2 * 64 * 20 + 9 * 50, 4, generator=torch.Generator().manual_seed(2))
    return dataclasses.replace(crossing_billboards(3), texture_sizes=sizes, two_sided=two_sided, texels=texels)


@pytest.mark.parametrize("share", [0.999, 0.8, 0.5, 0.35])
@pytest.mark.parametrize("export", [ExportConfig(), ExportConfig(alpha="mask", padding=2)])
def test_textures_shrink_until_the_model_is_small_enough(noise: BillboardCloud, share: float, export: ExportConfig) -> None:
    """The limit is kept, and made use of; rectangles stay, and textures are as wide for their height as before."""
    limit = int(share * model_bytes(noise, export))
    cut = within_bytes(noise, limit, export)
    assert 0.8 * limit < model_bytes(cut, export) <= limit  # measured 0.88
    for name in ("centers", "rights", "ups", "half_extents", "two_sided"):
        assert torch.equal(getattr(cut, name), getattr(noise, name))
    factors = (cut.texture_sizes + 0.5) / noise.texture_sizes
    assert (cut.texture_sizes < noise.texture_sizes).all() and factors.amax() - factors.amin() < 0.16
    assert len(cut.texels) == int((cut.texture_sizes.prod(-1) * (1 + cut.two_sided.long())).sum())
    assert cut.texels[:, 3].mean() == pytest.approx(float(noise.texels[:, 3].mean()), abs=0.03)


def test_what_is_small_enough_is_left_alone(noise: BillboardCloud) -> None:
    size = model_bytes(noise, ExportConfig())
    assert within_bytes(noise, None, ExportConfig()) is noise
    assert within_bytes(noise, size, ExportConfig()) is noise
    assert within_bytes(noise, size - 1, ExportConfig()) is not noise


def test_textures_shrink_to_a_texel_where_they_must(noise: BillboardCloud) -> None:
    """Thin ones are a texel wide long before they are all that small."""
    bare = dataclasses.replace(noise, texture_sizes=torch.ones(3, 2, dtype=torch.int64), texels=noise.texels[:4])
    cut = within_bytes(noise, model_bytes(bare, ExportConfig()) + 60, ExportConfig())
    assert int(cut.texture_sizes.amin()) == 1 < int(cut.texture_sizes.amax())


def test_it_is_the_model_with_its_padding_that_counts(noise: BillboardCloud) -> None:
    thin, thick = (within_bytes(noise, 12_000, ExportConfig(padding=padding)) for padding in (1, 64))
    assert len(thin.texels) > len(thick.texels)


def test_no_textures_are_small_enough_for_less_than_the_rectangles(noise: BillboardCloud) -> None:
    with pytest.raises(
        InputError, match=r"^bytes: 1,000 are too few: \d,\d+ are needed without textures; allow more, or fewer billboards$"
    ):
        within_bytes(noise, 1000, ExportConfig())


def test_a_texel_for_each_is_the_end_and_not_an_error(noise: BillboardCloud) -> None:
    bare = dataclasses.replace(noise, texture_sizes=torch.ones(3, 2, dtype=torch.int64), texels=torch.rand(4, 4))
    size = model_bytes(bare, ExportConfig())
    assert within_bytes(bare, size, ExportConfig()) is bare
    with pytest.raises(InputError, match=f"{size:,} are needed"):
        within_bytes(bare, size - 1, ExportConfig())


def test_the_mean_psnr_is_that_of_the_report(views: ViewDataset, known_cloud: BillboardCloud) -> None:
    worse = known_cloud.with_texels(known_cloud.texels**2)
    for split in (views.test, views.train.take([3, 7])):
        found = views_psnr(shipped_model(worse).draw, split)
        assert found == pytest.approx(evaluate(worse, split).mean.over.mean.psnr, abs=1e-9) and 10 < found < 40
    assert views_psnr(shipped_model(known_cloud).draw, views.test) > found + 5


# Rules, with qualities that are made up.


class World:
    """Where a fit gives what is made up, and is noted; every billboard side has so many texels if it may.

    ``size`` is the bytes of a number of billboards and texels with the gaps between them, of which ``bare`` are no textures.
    """

    def __init__(
        self,
        quality: Quality,
        texels: int = 1000,
        size: Callable[[int, int], int] = lambda count, texels: 2 * texels,
        bare: Callable[[int], int] = lambda count: 0,
    ) -> None:
        self.quality, self.texels, self.size, self.bare = quality, texels, size, bare
        self.asked: list[tuple[int, Sides, Placement, int | None]] = []
        self.less: tuple[int, Sides, Placement, int | None] | None = None

    def trial(self, config: FitConfig) -> Trial:
        """A trial for every configuration, so that nothing is fitted."""
        assert config.billboards is not None and config.placement is not None
        count, sides, placement, most = config.billboards, config.sides, config.placement, config.max_texels
        self.asked.append((count, sides, placement, most))
        textures = count * (1 if sides == "one" else 2)
        texels = min(most or 1 << 40, self.texels * textures)
        pictures = self.size(count, texels + _GAPS * textures)
        psnr = self.quality(count, sides, placement)
        density = texels / (self.texels * textures)
        return Trial(count, sides, placement, most, 4 * textures, texels, density, self.bare(count) + pictures, pictures, psnr, 0.0)

    @property
    def line(self) -> list[int]:
        """Numbers that were tried one after the other, in the manner of the first."""
        return [asked[0] for asked in self.asked if asked[1:3] == self.asked[0][1:3]]

    @property
    def others(self) -> list[tuple[int, Sides, Placement]]:
        """What was tried beside them."""
        return [asked[:3] for asked in self.asked if asked[1:3] != self.asked[0][1:3]]


Choosing = Callable[..., Choice]


@pytest.fixture(scope="module")
def choosing(views: ViewDataset) -> Choosing:
    """Chooses in a made-up world, and leaves out what is tried for the ``curve`` alone, if it is."""

    def chosen(world: World, budget: BudgetConfig, config: FitConfig | None = None, *, curve: bool = True) -> Choice:
        found = choose(views, config or FitConfig(), budget, known=world.trial)
        assert len(found.trials) == len(world.asked)
        limits = [asked[3] or math.inf for asked in world.asked]
        if curve and budget.target_psnr is None and (budget.texels or budget.bytes) and limits[-1] <= 0.7 * max(limits):
            world.less = world.asked.pop()
            found = dataclasses.replace(found, trials=found.trials[:-1])
        return found

    return chosen


def rising(count: int, sides: Sides, placement: Placement) -> float:
    """More billboards are better, two sides or even placement are worse."""
    return 20 + 4 * math.log2(count) - (sides != "one") - 2 * (placement == "even")


def curve(**psnrs: float) -> Quality:
    """Given PSNRs of n1, n2, ... billboards, and those of two2, even2, ...; otherwise very bad."""

    def quality(count: int, sides: Sides, placement: Placement) -> float:
        kind = "even" if placement == "even" else "n" if sides == "one" else sides
        return psnrs.get(f"{kind}{count}", 1.0)

    return quality


def summary(found: Choice) -> tuple[int | None, Sides, Placement | None]:
    return found.config.billboards, found.config.sides, found.config.placement


@pytest.mark.parametrize(
    ("vertices", "counts"),
    [
        (4, [1]),
        (7, [1]),
        (8, [1, 2]),
        (32, [2, 4, 8]),
        (40, [2, 5, 10]),
        (43, [2, 5, 10]),
        (124, [7, 15, 31]),
        (128, [8, 16, 32]),
        (1024, [64, 128, 256]),
        (10**6, [MOST // 4, MOST // 2, MOST]),
    ],
)
def test_a_limit_of_vertices_is_made_use_of(choosing: Choosing, vertices: int, counts: list[int]) -> None:
    """What the limit allows is tried, and a half and a quarter of it for the curve; a few billboards also in other manners."""
    world = World(rising)
    found = choosing(world, BudgetConfig(vertices=vertices))
    assert world.line == counts
    assert summary(found) == (counts[-1], "one", "clusters") and found.config.max_texels is None and found.met
    assert all(trial.vertices <= vertices for trial in found.trials)
    others = [(counts[-1] // 2, "two", "clusters")] * (counts[-1] > 1) + [(counts[-1], "one", "even")]
    assert world.others == (others if counts[-1] <= 8 else [])
    assert found.trials[found.chosen].billboards == counts[-1] and len(found.trials) == len(world.asked)


def test_no_more_are_tried_than_a_fit_may_have(choosing: Choosing) -> None:
    """``most_billboards`` is the largest number, also if that is more than by default."""
    for most in (48, 600):
        world = World(rising)
        found = choosing(world, BudgetConfig(bytes="100M"), FitConfig(most_billboards=most), curve=False)
        assert world.line == [most] and found.config.billboards == most


@pytest.mark.parametrize(
    ("budget", "start"),
    [
        (BudgetConfig(bytes="46k"), 128),
        (BudgetConfig(bytes="60k"), 256),
        (BudgetConfig(bytes="69k"), 256),
        (BudgetConfig(bytes="71k"), MOST),
        (BudgetConfig(texels="13k"), 128),
        (BudgetConfig(texels="13k", bytes="240k"), 128),
        (BudgetConfig(bytes="5k"), START),
    ],
)
def test_a_limit_is_first_spent_on_as_many_as_have_enough(choosing: Choosing, budget: BudgetConfig, start: int) -> None:
    world = World(lambda count, *kind: 30.0 - abs(math.log2(count / start)))
    assert choosing(world, budget).config.billboards == start
    assert world.line[0] == start and len(set(world.line)) <= 3  # one more and one fewer are worse


@pytest.mark.parametrize(("texels", "line"), [(130_000, [MOST]), (125_000, [MOST, 256])])
def test_fewer_are_tried_only_if_the_limit_costs_enough(choosing: Choosing, texels: int, line: list[int]) -> None:
    """As many as are allowed lose 0.2 dB with a third of the 384,000 texels that they ask for."""
    world = World(rising)
    assert choosing(world, BudgetConfig(texels=texels)).config.billboards == MOST
    assert world.line == line


@pytest.mark.parametrize(("texels", "most"), [(20, 16), (40, 32), (100, 64), (1, 1)])
def test_no_more_are_tried_than_there_are_texels(choosing: Choosing, texels: int, most: int) -> None:
    """Each texture has one, also for a target that none reaches."""
    for budget in (BudgetConfig(texels=texels), BudgetConfig(texels=texels, target_psnr=99.0)):
        world = World(rising, texels=1)
        assert choosing(world, budget, curve=False).config.billboards == most
        assert max(count for count, *_ in world.asked) == most


def test_half_as_many_two_sided_ones_are_tried_if_the_trunk_leaves_some(choosing: Choosing) -> None:
    for trunk, others in ((2, [(4, "two", "clusters"), (8, "one", "even")]), (4, [(8, "one", "even")])):
        world = World(curve(n8=30.0))
        choosing(world, BudgetConfig(vertices=32), FitConfig(trunk_billboards=trunk))
        assert world.others == others


def test_two_sided_billboards_have_twice_the_vertices(choosing: Choosing) -> None:
    """They are not tried again with half as many, nor are one-sided ones."""
    world = World(rising)
    found = choosing(world, BudgetConfig(vertices=43), FitConfig(sides="two"))
    assert world.line == [1, 2, 5] and summary(found) == (5, "two", "clusters")
    assert world.others == [(5, "two", "even")]
    assert choosing(World(rising), BudgetConfig(vertices=8), FitConfig(sides="two")).config.billboards == 1


def test_even_pairs_have_eight_vertices_each(choosing: Choosing) -> None:
    world = World(rising)
    found = choosing(world, BudgetConfig(vertices=24), FitConfig(sides="pair", placement="even"))
    assert world.line == [1, 3] and world.others == [] and summary(found) == (3, "pair", "even")


@pytest.mark.parametrize(
    ("quality", "expected"),
    [
        (curve(n1=20, n2=22, n3=23, two1=22.9, even3=22.9), (3, "one", "clusters")),
        (curve(n1=20, n2=22, n3=23, two1=23.1, even3=22.9), (1, "two", "clusters")),
        (curve(n1=20, n2=22, n3=23, two1=23.1, even3=23.2), (3, "one", "even")),
    ],
)
def test_the_same_vertices_may_be_spent_otherwise(choosing: Choosing, quality: Quality, expected: object) -> None:
    """Two sides of half as many, rounded down, or even placement, are taken where they are better."""
    world = World(quality)
    assert summary(choosing(world, BudgetConfig(vertices=12))) == expected
    assert world.others == [(1, "two", "clusters"), (3, "one", "even")]


def test_a_placement_that_is_asked_for_is_kept(choosing: Choosing) -> None:
    for placement in ("even", "clusters"):
        world = World(rising)
        found = choosing(world, BudgetConfig(vertices=16), FitConfig(placement=placement))  # type: ignore[arg-type]
        assert {asked[2] for asked in world.asked} == {placement} == {found.config.placement}
        assert world.line == [1, 2, 4] and world.others == [(2, "two", placement)]


@pytest.mark.parametrize(
    ("quality", "line", "best"),
    [
        (curve(n32=25, n64=26, n128=25.8), [32, 64, 128], 64),
        (curve(n32=25, n64=24, n128=30, n24=25.5, n16=25.2, n12=30), [32, 64, 24, 16], 24),
        (curve(n32=25, n64=24, n24=24, n16=30), [32, 64, 24], 32),
        (rising, [32, 64, 128, 256, MOST], MOST),
        (lambda count, sides, placement: 30.0 - count - 9 * (sides != "one"), [32, 64, 24, 16, 12, 8, 6], 6),
    ],
)
def test_texels_go_to_more_and_to_fewer_until_that_is_in_vain(choosing: Choosing, quality: Quality, line: list[int], best: int) -> None:
    """To fewer only if more are no better, and until the limit costs 0.2 dB; every trial has the limit, and so has the fit."""
    world = World(quality)
    found = choosing(world, BudgetConfig(texels="2k"), FitConfig(placement="clusters"))
    assert world.line == line and line[0] == START and summary(found) == (best, "one", "clusters")
    assert {asked[3] for asked in world.asked} == {2000} and found.config.max_texels == 2000
    assert all(trial.texels <= 2000 for trial in found.trials)


def test_other_manners_have_the_texels_too(choosing: Choosing) -> None:
    """Of eight billboards or fewer."""
    for most, others in ((8, [(4, "two", "clusters"), (8, "one", "even")]), (12, [])):
        world = World(rising)
        assert choosing(world, BudgetConfig(texels="2k", vertices=4 * most)).config.billboards == most
        assert world.others == others and {asked[3] for asked in world.asked} == {2000}


def test_a_step_in_vain_may_be_bad_luck(choosing: Choosing) -> None:
    """One that loses little is followed by the next, but not to fewer."""
    world = World(curve(n32=25, n64=25 - 0.9 * LUCK, n128=26, n256=25))
    assert choosing(world, BudgetConfig(texels=3000)).config.billboards == 128
    assert world.line == [32, 64, 128, 256]
    world = World(curve(n32=25, n64=20, n24=25 - 0.9 * LUCK, n16=26, n12=25))
    assert choosing(world, BudgetConfig(texels=3000)).config.billboards == 32
    assert world.line == [32, 64, 24]


def test_limits_of_vertices_and_texels_hold_at_once(choosing: Choosing) -> None:
    world = World(rising)
    found = choosing(world, BudgetConfig(vertices=20, texels=3000))
    assert world.line == [5] and found.config.billboards == 5 and found.config.max_texels == 3000
    assert all(trial.vertices <= 20 and trial.texels <= 3000 for trial in found.trials)


@pytest.mark.parametrize("wrong", [0.2, 0.5, 0.7, 1.0, 1.08, 1.1, 1.5, 4.0])
def test_bytes_are_kept_and_made_use_of_whatever_a_texel_takes(choosing: Choosing, wrong: float) -> None:
    """The first guess may be wrong by a factor of two; by more, it is known what a texel takes, and a second trial is enough."""
    rate = wrong * BYTES_A_TEXEL
    guess, dense = (AIM * 100_000 - 4 * BYTES_EACH) / BYTES_A_TEXEL, 2 * 10**5
    world = World(rising, texels=dense, size=lambda count, texels: int(rate * texels))
    found = choosing(world, BudgetConfig(vertices=16, bytes="100k"))
    assert world.line == ([4, 3] if near(100_000 / rate - 4 * _GAPS, guess, 4 * dense) else [4, 4, 3])
    assert summary(found) == (4, "one", "clusters") and len(set(world.asked)) == len(world.asked)
    assert 50_000 <= found.trials[found.chosen].bytes <= 200_000
    assert all(trial.bytes == pytest.approx(AIM * 100_000, abs=2 * rate) for trial in found.trials[len(world.line) - 1 :])
    assert found.config.max_texels is not None
    assert rate * (found.config.max_texels + 4 * _GAPS) == pytest.approx(_FULL * 100_000, abs=3 * rate)


def test_bytes_that_are_not_needed_are_not_asked_for_again(choosing: Choosing) -> None:
    """The billboards have fewer texels than they may."""
    world = World(rising, texels=100)
    found = choosing(world, BudgetConfig(vertices=16, bytes="100k"), curve=False)
    assert world.line == [4] and len(world.asked) == 3
    assert found.config.max_texels == pytest.approx(_FULL * 100_000 / 2 - 4 * _GAPS, abs=1)


def test_what_a_billboard_takes_besides_is_found_out(choosing: Choosing) -> None:
    """Bytes that do not depend on texels: after the first number a trial is below the limit and close to it."""
    world = World(rising, texels=2000, bare=lambda count: 400 * count)
    found = choosing(world, BudgetConfig(vertices=48, bytes=20_000))
    assert summary(found) == (12, "one", "clusters") and world.line == [12, 8]
    for trial in found.trials[1:]:
        assert trial.bytes == pytest.approx(AIM * 20_000, abs=2)
    assert found.config.max_texels == pytest.approx((_FULL * 20_000 - 4800) / 2 - 12 * _GAPS, abs=3)


def test_so_many_that_no_texel_is_left_are_not_tried(choosing: Choosing) -> None:
    """Nor are more of them; the fewest are tried in any case."""
    world = World(rising, texels=10**6, bare=lambda count: 1000 * count)
    assert choosing(world, BudgetConfig(bytes=7500), FitConfig(placement="clusters")).config.billboards == 6
    assert world.line == [32, 6, 4]
    world = World(rising, texels=10**6, bare=lambda count: 960)
    assert choosing(world, BudgetConfig(bytes=1010), FitConfig(placement="clusters")).config.billboards == 1
    assert world.line[0] == 12 and world.line[-1] == 1  # for 16 the first guess leaves less than 8 texels each


def test_a_budget_of_bytes_that_can_be_kept_is_kept(choosing: Choosing) -> None:
    """A thousand texels would do."""
    found = choosing(
        World(rising, texels=10**6, size=lambda count, texels: 4 * texels, bare=lambda count: 2000), BudgetConfig(vertices=4, bytes=6000)
    )
    assert found.trials[found.chosen].bytes <= 6000


def test_bytes_and_texels_hold_at_once(choosing: Choosing) -> None:
    world = World(rising, texels=10**6)
    found = choosing(world, BudgetConfig(vertices=16, bytes=40_000, texels="1M"))
    assert found.config.max_texels == pytest.approx(_FULL * 20_000 - 4 * _GAPS, abs=3)
    world = World(rising, texels=10**6)
    found = choosing(world, BudgetConfig(vertices=16, bytes="1M", texels=3000))
    assert {asked[3] for asked in world.asked} == {3000} and found.config.max_texels == 3000


@pytest.mark.parametrize("budget", [BudgetConfig(texels=9000, vertices=48), BudgetConfig(bytes=18_500, vertices=48)], ids=str)
def test_less_is_tried_for_the_curve_alone(views: ViewDataset, choosing: Choosing, budget: BudgetConfig) -> None:
    """Half of the limit, which does not change the choice, even if it should do better."""
    world = World(rising)
    most = choosing(world, budget)
    done, texels = len(world.asked), 4500 if budget.texels else AIM * 9250 / 2 - 12 * _GAPS

    def better(count: int, sides: Sides, placement: Placement) -> float:
        return rising(count, sides, placement) + 10 * (len(other.asked) > done)

    other = World(better)
    found = choose(views, FitConfig(), budget, known=other.trial)
    kind = (most.config.billboards, most.config.sides, most.config.placement)
    assert other.asked[done:] == [world.less] == [(*kind, int(texels))]
    assert found.config == most.config and found.chosen == most.chosen and found.trials[:done] == most.trials
    assert found.trials[-1].psnr > found.trials[found.chosen].psnr


def test_less_has_two_texels_for_each_at_the_least(views: ViewDataset, choosing: Choosing) -> None:
    world = World(rising, texels=5)
    choosing(world, BudgetConfig(texels=48, vertices=48))
    assert world.less == (12, "one", "clusters", 24)
    found = choose(views, FitConfig(), BudgetConfig(texels=47, vertices=48), known=World(rising, texels=5).trial)
    assert [trial.max_texels for trial in found.trials] == [47]


def test_two_numbers_are_a_curve(views: ViewDataset) -> None:
    """Nothing is tried for the curve alone if fewer billboards were, or other ways to use the vertices of a few."""
    for budget, tried in ((BudgetConfig(texels=125_000), [MOST, 256]), (BudgetConfig(texels=3000, vertices=32), [8, 4, 8])):
        found = choose(views, FitConfig(), budget, known=World(rising).trial)
        assert [trial.billboards for trial in found.trials] == tried
        assert {trial.max_texels for trial in found.trials} == {budget.most_texels}


def test_a_curve_of_vertices_or_of_limits_that_change_nothing_needs_nothing_else(views: ViewDataset) -> None:
    for budget, tried in (
        (BudgetConfig(vertices=16, bytes="1M"), [4, 2, 4]),
        (BudgetConfig(vertices=16, texels="1M"), [4, 2, 4]),
        (BudgetConfig(vertices=16), [1, 2, 4, 2, 4]),
        (BudgetConfig(auto=True), [MOST, MOST // 2]),
        (BudgetConfig(texels=500, target_psnr=25), [32, 1, 2, 3]),
    ):
        world = World(rising)
        choose(views, FitConfig(), budget, known=world.trial)
        assert [asked[0] for asked in world.asked] == tried


def test_no_trial_is_done_twice(choosing: Choosing) -> None:
    world = World(rising, texels=10**6)
    choosing(world, BudgetConfig(vertices=16, bytes="1M", texels=3000))
    assert len(set(world.asked)) == len(world.asked)


@pytest.mark.parametrize("seed", range(20))
def test_a_target_takes_as_few_as_will_do(choosing: Choosing, seed: int) -> None:
    """Whatever the curve looks like, as long as more are better. Nothing else is tried, since it would have as many vertices."""
    drawn, counts = random.Random(seed), [*COUNTS, MOST]
    psnrs = sorted(drawn.uniform(20, 30) for _ in counts)
    target = drawn.uniform(psnrs[0] - 1, psnrs[-1])
    world = World(curve(**{f"n{count}": psnr for count, psnr in zip(counts, psnrs, strict=True)}))
    found = choosing(world, BudgetConfig(target_psnr=target))
    fewest = next(count for count, psnr in zip(counts, psnrs, strict=True) if psnr >= target)
    assert summary(found) == (fewest, "one", "clusters") and found.met and world.others == []
    assert found.trials[found.chosen].psnr >= target and len(set(world.line)) == len(world.line)


@pytest.mark.parametrize(
    ("gain", "target", "line"), [(0.5, 22, [MOST, 16, 12]), (0.7, 23.4, [MOST, 12, 32, 24]), (4, 30.5, [MOST, 1, 6, 8])]
)
def test_a_target_is_found_by_interpolation(choosing: Choosing, gain: float, target: float, line: list[int]) -> None:
    """First with what a doubling usually gains, half a decibel, and then with what it gains here."""
    world = World(lambda count, *kind: 20 + gain * math.log2(count))
    assert choosing(world, BudgetConfig(target_psnr=target)).met and world.line == line


def test_a_target_that_is_not_reached_gives_the_best(choosing: Choosing) -> None:
    for budget, most in ((BudgetConfig(target_psnr=90), MOST), (BudgetConfig(target_psnr=90, vertices=35), 8)):
        world = World(rising)
        found = choosing(world, budget)
        assert world.line == [most] and world.others == [] and summary(found) == (most, "one", "clusters") and not found.met
    world = World(curve(n32=25, n64=26, n128=25.5))
    found = choosing(world, BudgetConfig(target_psnr=26.1, texels=3000))
    assert world.line == [32, 64, 128] and world.others == [] and summary(found) == (64, "one", "clusters") and not found.met


def test_a_target_needs_no_more_than_reach_it(choosing: Choosing) -> None:
    """Limits are first spent on 32 billboards, and on more only until one number reaches the target."""
    world = World(curve(n32=25, n64=26, n128=27, n24=24))
    assert choosing(world, BudgetConfig(target_psnr=26, texels=3000)).config.billboards == 64
    assert world.line == [32, 64]


def test_a_target_that_only_more_than_is_allowed_reaches_is_not_reached(choosing: Choosing) -> None:
    """From eight billboards on the model has too many bytes without a texel, and is not tried."""
    world = World(rising, texels=300, bare=lambda count: 3000 * count)
    found = choosing(world, BudgetConfig(target_psnr=32, bytes=22_000))
    assert world.line == [32, 6] and summary(found) == (6, "one", "clusters") and not found.met
    assert found.config.max_texels == pytest.approx((_FULL * 22_000 - 18_000) / 2 - 6 * _GAPS, abs=2)
    # A texel limit does not stand in the way: trials keep it.
    found = choosing(World(rising), BudgetConfig(target_psnr=32, texels=500))
    assert summary(found) == (8, "one", "clusters") and found.met and found.config.max_texels == 500


def test_a_target_is_not_given_up_for_a_trial_that_is_too_much(choosing: Choosing) -> None:
    """Of the numbers that reach it, 24 do not pack at all, and 32 do."""
    world = World(rising, size=lambda count, texels: 2 * texels if count != 24 else 10**6)
    found = choosing(world, BudgetConfig(target_psnr=37, bytes=20_000))
    assert summary(found) == (32, "one", "clusters") and found.met
    assert {trial.billboards for trial in found.trials if trial.psnr >= 37} == {24, 32}


def test_of_all_trials_that_reach_a_target_the_smallest_counts(choosing: Choosing) -> None:
    """Of those within the limit, the last one left less of it. One between them was too large by far."""
    world = World(rising, texels=10**6, size=lambda count, texels: 20_000 if texels <= 50_000 else 400_000)
    found = choosing(world, BudgetConfig(target_psnr=20, bytes=100_000))
    assert world.line[-3:] == [1, 1, 1] and found.config.billboards == 1 and found.chosen == len(found.trials) - 1 and found.met


def test_auto_stops_at_the_knee(choosing: Choosing) -> None:
    """More than 48 are hardly better, and fewer are clearly worse."""
    world = World(lambda count, *kind: 20 + 3 * math.log2(min(count, 48)) + 0.3 * math.log2(max(count / 48, 1)))
    found = choosing(world, BudgetConfig(auto=True))
    assert world.line == [384, 192, 96, 48, 24] and world.others == [] and summary(found) == (48, "one", "clusters") and found.met


@pytest.mark.parametrize(("gain", "last"), [(MIN_GAIN_DB + 0.01, MOST), (MIN_GAIN_DB - 0.01, 1)])
def test_auto_goes_as_far_as_it_pays(choosing: Choosing, gain: float, last: int) -> None:
    """By what a doubling of the bytes gains."""
    world = World(lambda count, sides, placement: 20 + gain * math.log2(count) - (sides != "one") - (placement == "even"))
    found = choosing(world, BudgetConfig(auto=True))
    assert summary(found) == (last, "one", "clusters") and world.line == (HALVED if last == 1 else HALVED[:2])


def test_auto_counts_bytes_and_not_billboards(choosing: Choosing) -> None:
    """A small gain is worth many billboards that take few bytes."""
    quality = lambda count, *kind: 20 + 0.1 * math.log2(count)  # noqa: E731
    for bare, best in ((10**7, MOST), (0, 1)):
        assert choosing(World(quality, bare=lambda count, bare=bare: bare), BudgetConfig(auto=True)).config.billboards == best


def test_auto_within_a_limit(choosing: Choosing) -> None:
    world = World(rising)
    found = choosing(world, BudgetConfig(auto=True, vertices=24, texels=5000))
    assert world.line == [6, 3] and summary(found) == (6, "one", "clusters") and found.config.max_texels == 5000


def test_auto_may_spend_the_vertices_of_the_knee_otherwise(choosing: Choosing) -> None:
    knee = {"n12": 24.2, "n6": 24, "n3": 20}
    budget = BudgetConfig(auto=True, vertices=48)
    assert summary(choosing(World(curve(**knee, two3=24.05)), budget)) == (3, "two", "clusters")
    assert summary(choosing(World(curve(**knee, even6=24.05)), budget)) == (6, "one", "even")


@pytest.mark.parametrize("better", [-1.1, -0.9, 0.3, 0.9, 1.1])
def test_a_little_better_may_be_luck(choosing: Choosing, better: float) -> None:
    """Of two that differ by little, the one of more vertices if there is a limit to them, or fewer for a target; otherwise the better."""
    quality = curve(n6=25, n8=26 + better * LUCK, n12=26, n16=21, n24=20.5, n32=20, n48=21)
    for budget, expected in (
        (BudgetConfig(target_psnr=30, texels="3k", vertices=48), 12 if better < 1 else 8),
        (BudgetConfig(target_psnr=30, texels="3k"), 12 if better < -1 else 8),
        (BudgetConfig(texels="3k", vertices=48), 12 if better < 1 else 8),
        (BudgetConfig(texels="3k"), 12 if better < 0 else 8),
        (BudgetConfig(bytes="6k"), 12 if better < 0 else 8),
    ):
        world = World(quality)
        assert choosing(world, budget).config.billboards == expected
        assert world.others == ([] if expected == 12 or budget.target_psnr else [(4, "two", "clusters"), (8, "one", "even")])


@pytest.mark.parametrize(("better", "expected"), [(0.9, 12), (1.1, 6)])
def test_fewer_than_the_vertices_allow_are_chosen_only_if_they_are_better(choosing: Choosing, better: float, expected: int) -> None:
    world = World(curve(n3=20, n6=26 + better * LUCK, n12=26))
    assert choosing(world, BudgetConfig(vertices=48)).config.billboards == expected
    assert world.others == ([(3, "two", "clusters"), (6, "one", "even")] if expected == 6 else [])


def test_luck_does_not_make_up_for_a_number(choosing: Choosing) -> None:
    """It is counted from the best, and not from each to the next."""
    step = 0.7 * LUCK
    quality = curve(n32=26 - 2 * step, n64=26 - step, n128=26, n256=26 - step, n384=26 - 2 * step)
    assert choosing(World(quality), BudgetConfig(target_psnr=30, texels=3000, vertices=10_000)).config.billboards == 256
    assert choosing(World(quality), BudgetConfig(target_psnr=30, texels=3000)).config.billboards == 64


def test_of_equals_the_first_is_chosen(choosing: Choosing) -> None:
    """Which trial it is, not only what it is like: two-sided ones have the same number of vertices."""
    found = choosing(World(lambda *kind: 20.0), BudgetConfig(vertices=8))
    assert [trial.vertices for trial in found.trials] == [4, 8, 8, 8] and found.chosen == 1


# What is fitted for a trial.


QUICK = FitConfig(candidates=1, refinement_rounds=0, steps=4, views_per_step=1)


@pytest.mark.slow
def test_a_trial_is_a_short_fit_measured_on_views_it_has_not_seen(views: ViewDataset) -> None:
    """Every fifth training view is for validation."""
    export, tree = ExportConfig(padding=2), TreeFile.open(DATA / "tree.glb")
    asked = dataclasses.replace(QUICK, seed=3)
    own = ViewDataset.load(DATA / "views")
    own = dataclasses.replace(own, train=own.train.take(range(7)))
    found = choose(own, asked, BudgetConfig(vertices=8), tree=tree, export=export)
    held, rest = own.train.take([2]), dataclasses.replace(own, train=own.train.take([0, 1, 3, 4, 5, 6]))
    assert found.validation == tuple(held.names)
    kinds = [(trial.billboards, trial.sides, trial.placement) for trial in found.trials]
    assert kinds == [(1, "one", "clusters"), (2, "one", "clusters"), (1, "two", "clusters"), (2, "one", "even")]
    points, bark = placement_points(rest, asked, tree)
    for trial, kind in zip(found.trials, kinds, strict=True):
        config, start = short_config(asked, *kind, None), None
        if trial.placement == "clusters":
            start = find_placement(rest.train, points, config.resolve(), effort=QUICK_SEARCH, bark=bark)
        cloud = fit(rest, config, tree=tree, placement=start).cloud
        assert trial.max_texels is None
        assert (trial.vertices, trial.texels, trial.bytes) == (cloud.vertex_count, len(cloud.texels), model_bytes(cloud, export))
        assert 0 < trial.texture_bytes < trial.bytes
        assert trial.psnr == pytest.approx(views_psnr(shipped_model(cloud, export).draw, held), abs=6e-4) and trial.seconds >= 0


@pytest.mark.slow
def test_a_number_is_searched_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever number of texels its trials may have; points are sampled once."""
    searched, sampled = list[tuple[int | None, Sides]](), list[object]()

    def search(views: object, points: object, config: FitConfig, effort: object, bark: object) -> BillboardCloud:
        searched.append((config.billboards, config.sides))
        return find_placement(views, points, config, effort=effort, bark=bark)  # type: ignore[arg-type]

    def sample(*given: object) -> tuple[torch.Tensor, Bark | None]:
        sampled.append(given)
        return placement_points(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(trials_module, "find_placement", search)
    monkeypatch.setattr(trials_module, "placement_points", sample)
    found = choose(
        ViewDataset.load(DATA / "views"), dataclasses.replace(QUICK, placement="clusters"), BudgetConfig(texels="2k", vertices=4)
    )
    assert len(searched) == len(set(searched)) and len(sampled) == 1
    tried = [(trial.billboards, trial.sides) for trial in found.trials]
    assert set(tried) == set(searched) and len(tried) > len(searched)


class Noted(World):
    """A made-up world that keeps the configurations of the short fits."""

    def __init__(self) -> None:
        super().__init__(rising)
        self.configs: list[FitConfig] = []

    def trial(self, config: FitConfig) -> Trial:
        self.configs.append(config)
        return super().trial(config)


def test_what_is_asked_for_is_kept(views: ViewDataset) -> None:
    """In the trials, steps included, and in the fit, which is not short unless it was asked to be."""
    asked = FitConfig(steps=7, views_per_step=3, candidates=2, levels=1, loss="l1", texel_density=0.7, orientation="free")
    world = Noted()
    found = choose(views, asked, BudgetConfig(vertices=4), known=world.trial)
    first = dataclasses.replace(asked, billboards=1, placement="clusters", restarts=1, refinement_rounds=0)
    assert world.configs[0] == first
    trial = found.trials[found.chosen]
    assert found.config == dataclasses.replace(asked, billboards=1, sides=trial.sides, placement=trial.placement).resolve()
    short = Noted()
    plain = choose(views, FitConfig(), BudgetConfig(vertices=4), known=short.trial).config
    assert plain == FitConfig(billboards=1, placement=plain.placement).resolve() == plain.resolve()
    most = {"steps": 200, "views_per_step": 2, "levels": 2, "restarts": 1, "candidates": 4, "refinement_rounds": 0}
    assert short.configs[0] == FitConfig(billboards=1, placement="clusters", **most)  # type: ignore[arg-type]
    assert short_config(FitConfig(steps=9000, levels=7, candidates=50), 1, "one", "clusters", None) == short.configs[0]
    even = short_config(FitConfig(), 3, "two", "even", 500)
    assert (even.billboards, even.sides, even.max_texels, even.levels, even.steps) == (3, "two", 500, None, 200)


@pytest.mark.parametrize(
    ("count", "held"), [(5, [2]), (6, [2]), (7, [2]), (8, [2, 7]), (10, [2, 7]), (12, [2, 7])], ids=lambda value: str(value)
)
def test_one_in_five_views_is_held(views: ViewDataset, count: int, held: list[int]) -> None:
    few = dataclasses.replace(views, train=views.train.take(range(count)))
    if count == 8:
        few = dataclasses.replace(views, train=views.train.take(range(4, 12)))
    found = choose(few, FitConfig(), BudgetConfig(vertices=4), known=World(rising).trial)
    assert list(found.validation) == [few.train.names[index] for index in held]


@pytest.mark.parametrize("kept", range(5))
def test_trials_that_are_known_are_not_done_again(views: ViewDataset, kept: int) -> None:
    budget, world = BudgetConfig(vertices=8), Noted()
    whole = choose(views, FitConfig(), budget, known=world.trial)
    assert len(world.configs) == len(whole.trials) == 4
    find, rest = lookup(whole.trials[:kept]), Noted()
    again = choose(views, FitConfig(), budget, known=lambda config: find(config) or rest.trial(config))
    assert rest.configs == world.configs[kept:] and again == whole


def test_only_the_same_trial_is_known(views: ViewDataset) -> None:
    """It has to agree in number, sides, placement and limit of texels."""
    world = Noted()
    first = choose(views, FitConfig(), BudgetConfig(vertices=4), known=world.trial).trials[0]
    assert lookup([first])(world.configs[0]) is first
    for other in ({"billboards": 2}, {"sides": "two"}, {"placement": "even"}, {"max_texels": 500}):
        assert lookup([dataclasses.replace(first, **other)])(world.configs[0]) is None


def test_each_trial_is_told(views: ViewDataset) -> None:
    """All so far, in a list of one's own, and how many there may be; also those that were known."""
    told: list[tuple[list[Trial], int]] = []
    budget = BudgetConfig(vertices=12)
    found = choose(views, FitConfig(), budget, known=World(rising).trial, on_trial=lambda trials, total: told.append((trials, total)))
    assert [trials for trials, _ in told] == [list(found.trials[: count + 1]) for count in range(4)]
    assert {total for _, total in told} == {4}


@pytest.mark.parametrize(
    ("config", "budget", "count", "says"),
    [
        (
            FitConfig(billboards=3),
            BudgetConfig(vertices=8),
            12,
            "^billboards: 3 are requested in addition to a budget; leave out one of them$",
        ),
        (FitConfig(preset="thesis"), BudgetConfig(auto=True), 12, "^preset: 'thesis' cannot be combined with a budget"),
        (FitConfig(), BudgetConfig(vertices=8), 4, "^views: 4 training views are too few for a validation split; give at least 5$"),
        (FitConfig(), BudgetConfig(vertices=8), 1, "^views: 1 training views are too few"),
        (FitConfig(sides="two"), BudgetConfig(vertices=7), 12, "^vertices: 7 are too few for one billboard of sides 'two'; allow more"),
        (
            FitConfig(trunk_billboards=3),
            BudgetConfig(vertices=12),
            12,
            "^vertices: 12 are too few for 4 billboards of sides 'one'; allow more",
        ),
        (
            FitConfig(trunk_billboards=3, least_billboards=1, most_billboards=3),
            BudgetConfig(texels=9000),
            12,
            "^most_billboards: 3 are too few",
        ),
        (FitConfig(sides="pair"), BudgetConfig(vertices=4), 12, "^vertices: 4 are too few for one billboard of sides 'pair'"),
        (FitConfig(), BudgetConfig(bytes=100), 12, r"^budget: 1 billboard with \d,\d+ bytes exceeds it; allow more$"),
    ],
)
def test_what_cannot_be_chosen(views: ViewDataset, config: FitConfig, budget: BudgetConfig, count: int, says: str) -> None:
    few, world = (
        dataclasses.replace(views, train=views.train.take(range(count))),
        World(rising, bare=lambda count: 1000),
    )
    with pytest.raises(InputError, match=says):
        choose(few, config, budget, known=world.trial)
    assert (len(world.asked) > 0) == (budget.bytes is not None)


def test_a_choice_survives_the_disk(choosing: Choosing) -> None:
    """Trials read back are the trials, and can be given as known; the front is by vertices."""
    found = choosing(World(curve(n1=20, n2=22, n3=21, n4=23, two2=23.5)), BudgetConfig(vertices=16, target_psnr=None))
    content = json.loads(json.dumps(found.to_json()))
    assert set(content) == {"trials", "chosen", "met", "validation"}
    flags = [trial.pop("pareto") for trial in content["trials"]]
    assert tuple(Trial(**trial) for trial in content["trials"]) == found.trials
    assert flags == [True, True, False, True, False] and found.chosen == content["chosen"] == 3
    assert content["met"] is True and content["validation"] == list(found.validation)


# The real thing.


def sealed(folder: Path) -> ViewDataset:
    """Views whose test pictures are missing."""
    views = ViewDataset.load(folder)
    missing = tuple(path.with_name("missing.png") for path in views.test.paths)
    return dataclasses.replace(views, test=dataclasses.replace(views.test, paths=missing))


@pytest.mark.slow
def test_a_choice_on_real_views() -> None:
    """Limits hold in every trial; the one that is chosen is a fit of views that leave out those for validation."""
    views, told = sealed(DATA / "views"), []
    found = choose(views, QUICK, BudgetConfig(vertices=11, texels="4k"), on_trial=lambda trials, total: told.append(len(trials)))
    kinds = [(trial.billboards, trial.sides, trial.placement) for trial in found.trials]
    assert kinds[:2] == [(2, "one", "clusters"), (1, "two", "clusters")] and told == list(range(1, len(kinds) + 1))
    assert all(trial.vertices <= 8 and 0 < trial.texels <= 4000 and 5 < trial.psnr < 40 and trial.seconds > 0 for trial in found.trials)
    best = found.trials[found.chosen]
    whole = [trial for trial in found.trials if trial.max_texels == 4000]
    assert best in whole and best.psnr >= max(trial.psnr for trial in whole if trial.vertices <= best.vertices) and len(whole) > 2
    held = [index for index in range(len(views.train)) if index % 5 == 2]
    assert found.validation == tuple(views.train.names[index] for index in held) and len(held) == 4
    rest = dataclasses.replace(views, train=views.train.take([index for index in range(len(views.train)) if index not in held]))
    config = short_config(QUICK, best.billboards, best.sides, best.placement, best.max_texels)
    start = (
        None
        if best.placement == "even"
        else find_placement(rest.train, placement_points(rest, config, None)[0], config.resolve(), effort=QUICK_SEARCH)
    )
    cloud = fit(rest, config, placement=start).cloud
    assert (best.vertices, best.texels, best.bytes) == (cloud.vertex_count, len(cloud.texels), model_bytes(cloud, ExportConfig()))
    assert best.psnr == pytest.approx(views_psnr(shipped_model(cloud).draw, views.train.take(held)), abs=6e-4)


@pytest.mark.slow
def test_bytes_on_real_views() -> None:
    found = choose(sealed(DATA / "views"), dataclasses.replace(QUICK, placement="even"), BudgetConfig(bytes="20k", vertices=8))
    best = found.trials[found.chosen]
    assert (best.billboards, best.max_texels is not None) == (2, True) and best.texels <= (best.max_texels or 0)
    share, gaps = (_FULL * 20_000 - best.bytes + best.texture_bytes) / best.texture_bytes, 2 * _GAPS
    # A trial that is not dense has all that it may.
    assert found.config.max_texels == pytest.approx(share * ((best.max_texels or 0) + gaps) - gaps, abs=1)
    within = [trial for trial in found.trials if trial.bytes <= 20_000]
    assert found.trials[found.chosen] in within and len(found.trials) - len(within) <= 1  # only the first guess was too large
