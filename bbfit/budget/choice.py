"""Choosing how to spend a budget: short fits of several configurations, compared on views that they have not seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from bbfit.budget.config import BudgetConfig
from bbfit.checks import fail
from bbfit.evaluation import metrics
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig, Placement, ResolvedFit, Sides
from bbfit.fitting.levels import resize_textures
from bbfit.fitting.loop import fit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import over_color
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewDataset, ViewSet

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Numbers of billboards that are tried, and the most that a budget of vertices allows, up to the last of them."""
WORTH_DB = 0.75
"""What ``auto`` asks of twice as many billboards, in dB."""
# One in so many training views is for validation.
_SHARE = 5
# Short fits: what they change, and how many billboards more in vain end the trials of a budget of texels or bytes.
_SHORT: dict[str, Any] = {"steps": 160, "views_per_step": 2, "restarts": 1}
_IN_VAIN = 2
# What two short fits may differ by for no reason, in dB.
_LUCK = 0.15
# Shares of a limit in texels or bytes that are tried as well, for the curve.
_LESS = (0.5, 0.25)
# Bytes a texel before any are known; a longer fit is crisper and packs better; how near to its limit in bytes a trial is to be.
_BYTES_A_TEXEL, _CRISPER, _NEAR = 2.0, 1.05, 0.6


@dataclass(frozen=True)
class Trial:
    """A configuration, what a short fit of it cost, and how good it was."""

    billboards: int
    """Their number."""
    sides: Sides
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    placement: Placement
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    max_texels: int | None
    """Limit that the fit was given."""
    vertices: int
    """Of the model."""
    texels: int
    """Of all textures."""
    bytes: int
    """Of the model as GLB."""
    psnr: float
    """Over white, mean of the validation views, in dB."""
    seconds: float
    """That the trial took."""


@dataclass(frozen=True)
class Choice:
    """What was tried, and what is to be fitted."""

    config: ResolvedFit
    """The configuration to fit with."""
    trials: tuple[Trial, ...]
    """In order."""
    chosen: int
    """Which of them the configuration is of."""
    met: bool
    """Whether it reached the target PSNR, if there is one."""
    validation: tuple[str, ...]
    """Names of the validation views."""

    def to_json(self) -> dict[str, Any]:
        """Everything but the configuration."""
        front = pareto_front([(trial.vertices, trial.psnr) for trial in self.trials])
        trials = [asdict(trial) | {"pareto": index in front} for index, trial in enumerate(self.trials)]
        return {"trials": trials, "chosen": self.chosen, "met": self.met, "validation": list(self.validation)}


def choose(
    views: ViewDataset,
    config: FitConfig,
    budget: BudgetConfig,
    *,
    tree: TreeFile | None = None,
    export: ExportConfig | None = None,
    known: Sequence[Trial] = (),
    on_trial: Callable[[list[Trial], int], None] | None = None,
) -> Choice:
    """Choose number, sides, placement and texel density of billboards for a budget; the test views are not looked at.

    Every fifth training view is kept for validation. Short fits of the others with more and more billboards show what each would be worth,
    until the budget is reached, the target is met, or more do not pay. Then as many vertices are tried two-sided, and evenly placed, and,
    for the curve of a budget of texels or bytes, a half and a quarter of it.

    Parameters
    ----------
    views : training views; the test views are left alone.
    config : what the fit will be asked for; ``billboards`` has to be left open.
    budget : at least one limit.
    tree, export : as for the fit and the export to come; the export decides over the bytes.
    known : trials of an earlier call with the same arguments, which are not done again.
    on_trial : told of all trials so far, and how many there may be, after each.

    Raises
    ------
    InputError
        if the number of billboards is set as well, the preset does not place billboards, there are fewer than five training views, or the
        budget cannot be kept.
    """
    if config.billboards is not None:
        fail("billboards", f"{config.billboards} are asked for and a budget as well", "leave one of them out")
    if config.preset != "default":
        fail("preset", f"{config.preset!r} is a schedule of its own", "leave it out, or the budget")
    train = range(len(views.train))
    held = [index for index in train if index % _SHARE == _SHARE // 2]
    if len(views.train) < _SHARE:
        fail("views", f"{len(views.train)} training views leave none for validation", f"give at least {_SHARE}")
    split = replace(views, train=views.train.take([index for index in train if index not in held]), test=views.train.take(held))
    return _Trials(split, config, budget, tree, export or ExportConfig(), list(known), on_trial).choice()


def within_bytes(cloud: BillboardCloud, most: int | None, export: ExportConfig) -> BillboardCloud:
    """The same billboards with textures shrunk until the model has ``most`` bytes or less; as they are if it has, or there is no limit.

    Raises
    ------
    InputError
        if the model is larger with a texel a billboard.
    """
    while most is not None and (size := model_bytes(cloud, export)) > most:
        if int(cloud.texture_sizes.amax()) == 1:
            fail("bytes", f"{most:,} are too few: {size:,} are needed without textures", "allow more, or fewer billboards")
        sizes = (cloud.texture_sizes * min(0.98, math.sqrt(most / size))).long().clamp_min(1)
        cloud = resize_textures(cloud, sizes)
    return cloud


def model_bytes(cloud: BillboardCloud, export: ExportConfig) -> int:
    """Size of the cloud as GLB."""
    return len(shipped_model(cloud, export).glb)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which of some (cost, quality) no other one beats in both, by cost."""
    front, best = list[int](), -math.inf
    for index in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if points[index][1] > best:
            front.append(index)
            best = points[index][1]
    return front


class _Trials:
    def __init__(
        self,
        views: ViewDataset,
        config: FitConfig,
        budget: BudgetConfig,
        tree: TreeFile | None,
        export: ExportConfig,
        known: list[Trial],
        on_trial: Callable[[list[Trial], int], None] | None,
    ) -> None:
        self._views, self._config, self._budget, self._tree, self._export = views, config, budget, tree, export
        self._known, self._on_trial = known, on_trial or (lambda trials, total: None)
        self._trials: list[Trial] = []
        most = COUNTS[-1] if budget.vertices is None else min(COUNTS[-1], budget.vertices // self._vertices(1, config.sides))
        if most < 1:
            fail("vertices", f"{budget.vertices} are too few for one billboard of sides {config.sides!r}", "allow more, or sides one")
        self._counts = sorted({count for count in COUNTS if count < most} | {most})
        self._total = len(self._counts) + 2 + len(_LESS) * (budget.texels is not None or budget.bytes is not None)

    def choice(self) -> Choice:
        """See :func:`choose`."""
        config, budget = self._config, self._budget
        placement: Placement = config.placement or "clusters"
        line = list[Trial]()
        for count in self._counts:
            line.append(self._try(count, config.sides, placement))
            if self._enough(line):
                break
        best = self._best()
        if budget.target_psnr is None:  # the same vertices otherwise spent
            count, done = best.billboards, len(self._trials)
            if config.sides == "one" and count > 1:
                self._try(count // 2, "two", placement)
            if config.placement is None:
                self._try(count, config.sides, "even")
            best = max([best, *filter(self._holds, self._trials[done:])], key=lambda trial: trial.psnr)
            if budget.texels is not None or budget.bytes is not None:  # what less would do
                for share in _LESS:
                    self._trial_of(best.billboards, best.sides, best.placement, max(2 * count, int(share * best.texels)))
        most = best.max_texels
        if budget.most_bytes is not None:
            most = min(int(_CRISPER * budget.most_bytes / best.bytes * best.texels), budget.most_texels or 1 << 40)
        asked = replace(config, billboards=best.billboards, sides=best.sides, placement=best.placement, max_texels=most)
        met = budget.target_psnr is None or best.psnr >= budget.target_psnr
        return Choice(asked.resolve(), tuple(self._trials), self._trials.index(best), met, tuple(self._views.test.names))

    def _enough(self, line: list[Trial]) -> bool:
        """Whether more billboards need not be tried after those of ``line``."""
        budget = self._budget
        if budget.target_psnr is not None:
            return self._holds(line[-1]) and line[-1].psnr >= budget.target_psnr
        if budget.auto and len(line) > 2:  # a trial may be unlucky, two in a row are not
            return all(_gain(line[-1 - back], line[-2 - back]) < WORTH_DB for back in (0, 1))
        if budget.texels is not None or budget.bytes is not None:
            best = max(range(len(line)), key=lambda index: line[index].psnr)
            return len(line) - 1 - best >= _IN_VAIN
        return False

    def _holds(self, trial: Trial) -> bool:
        limits = ((trial.vertices, self._budget.vertices), (trial.texels, self._budget.most_texels), (trial.bytes, self._budget.most_bytes))
        return all(limit is None or cost <= limit for cost, limit in limits)

    def _best(self) -> Trial:
        """The trial that decides over the vertices."""
        budget = self._budget
        fitting = [trial for trial in self._trials if self._holds(trial)]
        if not fitting:
            fail("budget", f"{self._trials[0].billboards} billboard with {self._trials[0].bytes:,} bytes is too much for it", "allow more")
        best = max(fitting, key=lambda trial: trial.psnr)
        as_good = [trial for trial in fitting if trial.psnr >= best.psnr - _LUCK]
        dear = 1 if budget.vertices is not None else -1  # what is allowed is made use of; otherwise the fewer, the cheaper to draw
        best = max(as_good, key=lambda trial: (dear * trial.vertices, trial.psnr))
        if budget.target_psnr is not None:
            enough = [trial for trial in fitting if trial.psnr >= budget.target_psnr]
            return min(enough, key=lambda trial: (trial.vertices, -trial.psnr), default=best)
        if budget.auto:  # up the front as long as a step pays
            front = [fitting[index] for index in pareto_front([(trial.vertices, trial.psnr) for trial in fitting])]
            best = front[0]
            for trial in front[1:]:
                if _gain(trial, best) >= WORTH_DB:
                    best = trial
        return best

    def _try(self, count: int, sides: Sides, placement: Placement) -> Trial:
        """Add a trial, or some until the limit in bytes holds and is made use of."""
        limit, tried = self._budget.most_bytes, list[Trial]()
        most = self._guess(count, self._trials[-1:])
        for _ in range(3):
            tried.append(self._trial_of(count, sides, placement, most))
            trial = tried[-1]
            if limit is None or (trial.bytes <= limit and (trial.bytes > _NEAR * limit or trial.texels < _NEAR * (most or 0))):
                break
            before, most = most, self._guess(count, tried[-2:])
            if most == before:
                break
        return tried[-1]

    def _guess(self, count: int, known: list[Trial]) -> int | None:
        """How many texels are within the limits, by one or two trials before: bytes are about linear in texels."""
        limit, allowed = self._budget.most_bytes, self._budget.most_texels
        if limit is None:
            return allowed
        wanted, texels = 0.95 * limit, 0.95 * limit / _BYTES_A_TEXEL
        if len(known) == 2 and (known[1].bytes - known[0].bytes) * (known[1].texels - known[0].texels) > 0:
            rate = (known[1].bytes - known[0].bytes) / (known[1].texels - known[0].texels)
            texels = known[1].texels + (wanted - known[1].bytes) / rate
        elif known:
            texels = wanted * known[-1].texels / known[-1].bytes
        return max(2 * count, min(int(texels), allowed or 1 << 40))

    def _trial_of(self, count: int, sides: Sides, placement: Placement, most: int | None) -> Trial:
        trial = self._trial(count, sides, placement, most)
        self._trials.append(trial)
        self._on_trial(list(self._trials), self._total)
        return trial

    def _trial(self, count: int, sides: Sides, placement: Placement, most: int | None) -> Trial:
        for trial in self._known:
            if (trial.billboards, trial.sides, trial.placement, trial.max_texels) == (count, sides, placement, most):
                return trial
        begun = time.perf_counter()
        short = {name: value for name, value in _SHORT.items() if getattr(self._config, name) is None}
        config = replace(self._config, billboards=count, sides=sides, placement=placement, max_texels=most, **short)
        cloud = fit(self._views, config, tree=self._tree).cloud
        size, seconds = model_bytes(cloud, self._export), time.perf_counter() - begun
        score = mean_psnr(cloud, self._views.test)
        return Trial(count, sides, placement, most, cloud.vertex_count, len(cloud.texels), size, round(score, 3), round(seconds, 1))

    @staticmethod
    def _vertices(count: int, sides: Sides) -> int:
        return count * (4 if sides == "one" else 8)


def mean_psnr(cloud: BillboardCloud, views: ViewSet) -> float:
    """Mean over views of the PSNR over white, in dB."""
    pairs = (held_out(shipped_model(cloud).draw, views, index) for index in range(len(views)))
    return float(np.mean([metrics.psnr(*(over_color(picture).numpy() for picture in pair)) for pair in pairs]))


def _gain(more: Trial, fewer: Trial) -> float:
    """Decibels for every doubling of the vertices."""
    return (more.psnr - fewer.psnr) / math.log2(more.vertices / fewer.vertices) if more.vertices > fewer.vertices else math.inf
