"""The choice of a configuration for a budget, by short fits that are compared on training views held out for validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bbfit.budget.config import BudgetConfig
from bbfit.budget.spending import Spent, allowed, spent
from bbfit.budget.trials import Known, OnTrial, Trial, Trials
from bbfit.checks import fail
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig, Placement, ResolvedFit
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 256)
"""Numbers of billboards to try, in addition to the largest that the limit of vertices and ``FitConfig.most_billboards`` allow."""
START = 32
"""Least number of billboards that a limit of texels or bytes is first spent on, if it is among those to try."""
EACH_TEXELS, BYTES, BYTES_POWER = 100, 6_500, 2.5
"""Roughly how many billboards limits are first spent on, in views of 256 pixels: the largest number to try of which each may have
``EACH_TEXELS`` texels, and which is not above (bytes / ``BYTES``) ** ``BYTES_POWER``: 32 for 26 kB, 128 for 45 kB, 384 for 70 kB. More
billboards need hardly more texels together, and each takes about 120 bytes besides."""
MIN_GAIN_DB = 0.35
"""Least gain of short fits, in dB, for which ``auto`` doubles the bytes of the model. Fits in full gain about 0.4 dB more: 0.79 in place of
0.48 for an aspen of 48 to 384 billboards, and 0.67 in place of 0.11 for a poplar of 192 to 290 (hard edges, held-out views)."""
LEAST_VIEWS = 5
"""Least number of training views. Every fifth of them is for validation."""
# Most billboards for which evenly placed and two-sided ones are tried too: the more there are, the less it matters.
_FEW = 8
# Random difference between two short fits, in dB, and what limits may cost a number of billboards before fewer are tried.
_NOISE_DB, _LITTLE_DB = 0.15, 0.2
# What twice as many billboards usually gain, in dB, where no two trials show it.
_USUAL_GAIN_DB = 0.5


@dataclass(frozen=True)
class Choice:
    """The result of :func:`choose`: the trials and the configuration to fit."""

    config: ResolvedFit
    """The configuration to fit with."""
    trials: tuple[Trial, ...]
    """All trials, in order."""
    chosen: int
    """Index of the trial whose configuration was chosen."""
    met: bool
    """Whether the trial reached the target PSNR. True without a target."""
    validation: tuple[str, ...]
    """Names of the validation views."""

    def to_json(self) -> dict[str, Any]:
        """Return everything except the configuration as plain JSON, and mark the trials on the Pareto front."""
        front = pareto_front([(trial.vertices, trial.psnr) for trial in self.trials])
        trials = [asdict(trial) | {"pareto": index in front} for index, trial in enumerate(self.trials)]
        return {"trials": trials, "chosen": self.chosen, "met": self.met, "validation": list(self.validation)}


def choose(
    views: ViewDataset,
    config: FitConfig,
    budget: BudgetConfig,
    *,
    tree: str | Path | TreeFile | None = None,
    export: ExportConfig | None = None,
    known: Known | None = None,
    on_trial: OnTrial | None = None,
) -> Choice:
    """Choose the number, sides, placement and texel density of billboards for a budget. The test views are not used.

    Every fifth training view is held out for validation. Short fits to the other views are compared there. A limit of vertices alone is
    spent in full, and by halves and quarters for the curve. A limit of texels or bytes is first spent on as many billboards as have enough
    of them, at least 32, and then on more for as long as they are not clearly worse. If none is better, and the limits cost more than
    0.2 dB, fewer are tried for as long as both are so. If a single number is tried, a last trial spends half of the limit, for the curve.
    Few billboards are also tried two-sided, half as many, and evenly placed, unless there is a target.

    A target and ``auto`` begin with the best number within the limits, or with ``FitConfig.most_billboards``. If that reaches the target,
    fewer are tried where the target is expected, by interpolation. ``auto`` halves the number for as long as PSNR - ``MIN_GAIN_DB``
    log2(bytes) grows.

    All short fits of a number of billboards start from one placement, which a quick search finds. What a limit in bytes leaves for texels
    is estimated from the bytes of earlier trials, and the PSNR at the limit from the trial nearest to it.

    Parameters
    ----------
    views
        Views of the tree.
    config
        Options of the fit, with ``billboards`` left open.
    budget
        At least one limit.
    tree
        The mesh that places billboards, as in :func:`bbfit.fitting.loop.fit`.
    export
        Options of the export. They determine the size in bytes.
    known
        Called with the configuration of each short fit. Returns its trial from an earlier call, or ``None``; see
        :func:`bbfit.budget.trials.lookup`.
    on_trial
        Called after each trial with all trials so far and the expected total number.

    Raises
    ------
    InputError
        If ``config`` sets the number of billboards or of texels or a preset other than ``default``, there are fewer than five training
        views, or no trial is within the budget.
    """
    check_budget(config, budget)
    train, validation = validation_split(len(views.train))
    split = replace(views, train=views.train.take(train), test=views.train.take(validation))
    mesh = None if tree is None else TreeFile.open(tree)
    return _Chooser(Trials(split, config, mesh, export or ExportConfig(), known, on_trial), config, budget).choice(tuple(split.test.names))


def check_budget(config: FitConfig, budget: BudgetConfig) -> None:
    """Require that a fit and a budget do not contradict each other. Raises the errors of :func:`choose` that do not depend on the views."""
    if config.billboards is not None:
        fail("billboards", f"{config.billboards} are requested in addition to a budget", "leave out one of them")
    if config.max_texels is not None:
        fail(
            "max_texels", f"{config.max_texels} are requested in addition to a budget", "leave them out, or limit --texels in place of them"
        )
    if config.preset != "default":
        fail("preset", f"{config.preset!r} cannot be combined with a budget", "leave out one of them")
    least = _least(config)
    named = "one billboard" if least == 1 else f"{least} billboards"
    if budget.vertices is not None and budget.vertices < least * _vertices(config):
        fail("vertices", f"{budget.vertices} are too few for {named} of sides {config.sides!r}", "allow more, or sides one")
    if config.most_billboards < least:
        fail("most_billboards", f"{config.most_billboards} are too few for {named}, one of them for the crown", "allow more")
    textures = least * _vertices(config) // 4
    if budget.most_texels is not None and budget.most_texels < textures:
        fail("texels", f"{budget.most_texels} are too few for {textures} textures", "allow more")
    config.resolve()


def validation_split(count: int, hint: str = "") -> tuple[list[int], list[int]]:
    """The indices of the training views that a budget fits to, and of those that it compares on, out of ``count``.

    Raises ``InputError`` with the ``hint`` if there are too few.
    """
    if count < LEAST_VIEWS:
        fail("views", f"{count} training views are too few for a validation split", hint or f"give at least {LEAST_VIEWS}")
    validation = [index for index in range(count) if index % LEAST_VIEWS == LEAST_VIEWS // 2]
    return [index for index in range(count) if index not in validation], validation


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (cost, quality) that no cheaper or equally cheap point matches in quality, by increasing cost."""
    front, best = list[int](), -math.inf
    for index in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if points[index][1] > best:
            front.append(index)
            best = points[index][1]
    return front


def _vertices(config: FitConfig) -> int:
    """Vertices of a billboard."""
    return 4 if config.sides == "one" else 8


def _least(config: FitConfig) -> int:
    """The fewest billboards of a choice: one shows the crown. Evenly placed billboards know no trunk."""
    return 1 + (0 if config.placement == "even" else config.trunk_billboards or 0)


class _Chooser:
    """The course of a choice: which trials are run, and which of them is chosen."""

    def __init__(self, trials: Trials, config: FitConfig, budget: BudgetConfig) -> None:
        self._trials, self._config, self._budget = trials, config, budget
        self._placement: Placement = config.placement or "clusters"
        most = config.most_billboards
        if budget.vertices is not None:
            most = min(most, budget.vertices // _vertices(config))
        least = min(most, _least(config))
        self._counts = sorted({count for count in COUNTS if least <= count < most} | {most})
        self._spends = budget.texels is not None or budget.bytes is not None
        self._lowers = budget.auto or budget.target_psnr is not None
        if budget.auto or not (self._spends or self._lowers):
            halvings = range(most.bit_length() if budget.auto else 3)
            self._counts = sorted({max(least, most >> halving) for halving in halvings})
        trials.expected = 4 if self._spends or self._lowers else len(self._counts) + 2

    def choice(self, validation: tuple[str, ...]) -> Choice:
        """See :func:`choose`. ``validation`` are the names of the validation views."""
        config, budget, done = self._config, self._budget, self._trials.done
        best = self._best(self._series())
        if budget.target_psnr is None:
            best = max([best, *self._others(best.trial.billboards)], key=lambda other: other.psnr)
            if self._spends:
                self._try_half(best)
        trial = best.trial
        met = budget.target_psnr is None or best.psnr >= budget.target_psnr
        chosen = replace(config, billboards=trial.billboards, sides=trial.sides, placement=trial.placement, max_texels=best.max_texels)
        return Choice(chosen.resolve(), tuple(done), done.index(trial), met, validation)

    def _spent(self, count: int, least: float = -math.inf) -> Spent | None:
        anyway = count == self._counts[0]  # what the fewest billboards take is told if it is too much
        return spent(self._trials, self._budget, count, self._config.sides, self._placement, anyway=anyway, least=least)

    def _others(self, count: int) -> list[Spent]:
        """Other ways to spend the vertices of a few billboards."""
        others = list[Spent | None]()
        if 1 < count <= _FEW and self._config.sides == "one" and count // 2 > (self._config.trunk_billboards or 0):
            others.append(spent(self._trials, self._budget, count // 2, "two", self._placement))
        if count <= _FEW and self._config.placement is None:
            others.append(spent(self._trials, self._budget, count, self._config.sides, "even"))
        return [other for other in others if other is not None]

    def _series(self) -> list[Spent]:
        """Run the trials that determine the number of billboards."""
        if self._spends:
            series = self._climbed()
        else:  # the more vertices the better; fewer are for the curve, or are tried below
            wanted = self._counts[-1:] if self._lowers else self._counts
            series = [point for point in map(self._spent, wanted) if point is not None]
        if series and self._budget.target_psnr is not None:
            return self._lowered_to(self._budget.target_psnr, series)
        return self._halved(series) if series and self._budget.auto else series

    def _lowered_to(self, target: float, series: list[Spent]) -> list[Spent]:
        """Try fewer billboards, where the target is expected, until the next fewer miss it. None are tried if the best one misses it."""
        tried = {point.trial.billboards: point.psnr for point in series}
        counts = list(self._counts)
        while enough := [count for count, psnr in tried.items() if psnr >= target]:
            most = min(enough)
            least = max((count for count in tried if count < most), default=0)
            between = [count for count in counts if least < count < most]
            if not between:
                break
            gain = (tried[most] - tried[least]) / math.log2(most / least) if least else _USUAL_GAIN_DB
            wanted = math.log2(most) - (tried[most] - target) / gain
            count = min(between, key=lambda count: abs(math.log2(count) - wanted))
            point = self._spent(count)
            if point is None:  # it exceeds another limit
                counts.remove(count)
            else:
                series = [*series, point]
                tried[count] = point.psnr
        return series

    def _halved(self, series: list[Spent]) -> list[Spent]:
        """Try half as many billboards as the most worthwhile of ``series``, and so on until that is not worthwhile."""
        best = max(series, key=_worth)
        for count in reversed([count for count in self._counts if count < best.trial.billboards]):
            point = self._spent(count)
            if point is None or _worth(point) <= _worth(best):
                break
            series, best = [*series, point], point
        return series

    def _climbed(self) -> list[Spent]:
        """Spend the limits on as many billboards as have enough of them, then on more until that is clearly worse, or else on fewer."""
        start = self._start(self._budget)
        series, begin = list[Spent](), self._spent(self._counts[start])
        if begin is not None:
            series = self._followed([begin], self._counts[start + 1 :], _NOISE_DB)
            if begin.missing <= _LITTLE_DB or max(series, key=lambda point: point.psnr) is not begin:
                return series
        return self._followed(series, self._counts[:start][::-1], fewer=True)

    def _start(self, budget: BudgetConfig) -> int:
        """Index of the number of billboards to spend limits on first."""
        texels, size = budget.most_texels or math.inf, budget.most_bytes or math.inf
        able = max(START, min(texels / EACH_TEXELS, (size / BYTES) ** BYTES_POWER))
        return max((index for index, count in enumerate(self._counts) if count <= able), default=0)

    def _try_half(self, best: Spent) -> None:
        """Run a trial with half of the limits, for the curve, unless they leave as much as the whole, or there is a curve already."""
        trial, budget = best.trial, self._budget.half
        if len({(other.billboards, other.sides, other.placement) for other in self._trials.done}) > 1:
            return
        if not best.missing and trial.bytes <= (budget.most_bytes or math.inf) and trial.texels <= (budget.most_texels or math.inf):
            return
        count = min(self._counts[self._start(budget)], trial.billboards)
        texels = allowed(self._trials.done, budget, count * trial.textures // trial.billboards)
        if texels >= 2 * count:
            self._trials.run(count, trial.sides, trial.placement, int(texels))

    def _followed(self, series: list[Spent], counts: Sequence[int], patience: float = 0.0, *, fewer: bool = False) -> list[Spent]:
        """Continue a series until a number exceeds the limits, reaches the target, or is worse than another by over ``patience``, in dB.

        ``fewer`` billboards gain at most what more of them miss, so they are not tried after some that miss little.
        """
        for count in counts:
            least = max((point.psnr for point in series), default=-math.inf) - patience
            if least + patience >= (self._budget.target_psnr or math.inf):
                break
            point = self._spent(count, least)
            if point is not None:
                series = [*series, point]
            if series and (point is None or point.psnr < least or (fewer and point.missing <= _LITTLE_DB)):
                break
        return series

    def _best(self, series: list[Spent]) -> Spent:
        """Return what determines the number of vertices."""
        budget = self._budget
        if not series:
            least = min(self._trials.done, key=lambda trial: trial.bytes)
            named = "billboard" if least.billboards == 1 else "billboards"
            fail("budget", f"{least.billboards} {named} with {least.bytes:,} bytes exceeds it", "allow more")
        if budget.auto:
            return max(series, key=_worth)
        best = max(series, key=lambda point: point.psnr)
        equivalent = [point for point in series if point.psnr >= best.psnr - _NOISE_DB]
        if budget.vertices is not None or budget.target_psnr is not None:  # use all vertices that are allowed, or draw as few as possible
            sign = 1 if budget.vertices is not None else -1
            best = max(equivalent, key=lambda point: (sign * point.trial.vertices, point.psnr))
        if budget.target_psnr is not None:
            sufficient = [point for point in series if point.psnr >= budget.target_psnr]
            return min(sufficient, key=lambda point: (point.trial.vertices, -point.psnr), default=best)
        return best


def _worth(point: Spent) -> float:
    """What ``auto`` maximizes: PSNR in dB, less what each doubling of the bytes has to gain."""
    return point.psnr - MIN_GAIN_DB * math.log2(point.trial.bytes)
