"""The choice of a configuration for a budget, by short fits that are compared on held-out training views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bbfit.budget.config import BudgetConfig
from bbfit.checks import fail
from bbfit.evaluation.backgrounds import mean_psnr
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig, Placement, ResolvedFit, Sides
from bbfit.fitting.levels import resize_textures
from bbfit.fitting.loop import fit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewDataset, ViewSet

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Numbers of billboards to try, in addition to the largest number that the limit of vertices allows, up to the last number."""
MIN_GAIN_DB = 0.75
"""Least gain, in dB, for which ``auto`` doubles the number of billboards."""
LEAST_VIEWS = 5
"""Least number of training views. Every fifth of them is for validation."""
# Options of short fits that the configuration leaves open.
_SHORT: dict[str, Any] = {"steps": 160, "views_per_step": 2, "restarts": 1}
# Number of larger counts without a gain after which the trials of a budget of texels or bytes end.
_PATIENCE = 2
# Random difference between two short fits, in dB.
_NOISE_DB = 0.15
# Fractions of the texels that are also tried, for the curve.
_CURVE_FRACTIONS = (0.5, 0.25)
# Initial estimate of the bytes per texel.
_BYTES_PER_TEXEL = 2.0
# Factor on the texels of the full fit, whose textures compress better than those of a short fit.
_COMPRESSION_GAIN = 1.05
# Least fraction of a limit in bytes that a trial has to use.
_MIN_USE = 0.6


@dataclass(frozen=True)
class Trial:
    """The cost and the quality of a short fit of a configuration."""

    billboards: int
    """Number of billboards."""
    sides: Sides
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    placement: Placement
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    max_texels: int | None
    """Limit of texels of the fit."""
    vertices: int
    """Vertices of the model."""
    texels: int
    """Texels of all textures."""
    bytes: int
    """Size of the model as GLB, in bytes."""
    psnr: float
    """PSNR in dB, the mean over the validation views and the backgrounds (:data:`bbfit.evaluation.backgrounds.BACKGROUNDS`)."""
    seconds: float
    """Duration of the trial."""


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
    known: Callable[[FitConfig], Trial | None] | None = None,
    on_trial: Callable[[list[Trial], int], None] | None = None,
) -> Choice:
    """Choose the number, sides, placement and texel density of billboards for a budget. The test views are not used.

    Every fifth training view is held out for validation. Short fits to the other views try increasing numbers of billboards, until they
    reach the budget or the target, or gain too little. Further trials spend the same vertices on two-sided billboards and on evenly placed
    ones. For a budget of texels or bytes, two trials with a half and a quarter of the texels complete the curve.

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
        Called with the configuration of each short fit. Returns its trial from an earlier call, or ``None``; see :func:`lookup`.
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
    return _Trials(split, config, budget, mesh, export or ExportConfig(), known, on_trial).choice()


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
    if budget.vertices is not None and budget.vertices < _vertices(config):
        fail("vertices", f"{budget.vertices} are too few for one billboard of sides {config.sides!r}", "allow more, or sides one")
    config.resolve()


def validation_split(count: int, hint: str = "") -> tuple[list[int], list[int]]:
    """The indices of the training views that a budget fits to, and of those that it compares on, out of ``count``.

    Raises ``InputError`` with the ``hint`` if there are too few.
    """
    if count < LEAST_VIEWS:
        fail("views", f"{count} training views are too few for a validation split", hint or f"give at least {LEAST_VIEWS}")
    validation = [index for index in range(count) if index % LEAST_VIEWS == LEAST_VIEWS // 2]
    return [index for index in range(count) if index not in validation], validation


def lookup(trials: Sequence[Trial]) -> Callable[[FitConfig], Trial | None]:
    """Return a function that finds the trial of a configuration among those of an earlier call with the same arguments."""
    by_choice = {(trial.billboards, trial.sides, trial.placement, trial.max_texels): trial for trial in trials}
    return lambda config: by_choice.get((config.billboards, config.sides, config.placement, config.max_texels))  # type: ignore[arg-type]


def within_bytes(cloud: BillboardCloud, max_bytes: int | None, export: ExportConfig) -> BillboardCloud:
    """Shrink the textures of a cloud until the exported model has at most ``max_bytes`` bytes; ``None`` is no limit.

    Raises InputError if the model is larger even with one texel per texture.
    """
    while max_bytes is not None and (size := model_bytes(cloud, export)) > max_bytes:
        if int(cloud.texture_sizes.amax()) == 1:
            fail("bytes", f"{max_bytes:,} are too few: {size:,} are needed without textures", "allow more, or fewer billboards")
        sizes = (cloud.texture_sizes * min(0.98, math.sqrt(max_bytes / size))).long().clamp_min(1)
        cloud = resize_textures(cloud, sizes)
    return cloud


def model_bytes(cloud: BillboardCloud, export: ExportConfig) -> int:
    """Return the size of the cloud as GLB, in bytes."""
    return len(shipped_model(cloud, export).glb)


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


class _Trials:
    def __init__(
        self,
        views: ViewDataset,
        config: FitConfig,
        budget: BudgetConfig,
        tree: TreeFile | None,
        export: ExportConfig,
        known: Callable[[FitConfig], Trial | None] | None,
        on_trial: Callable[[list[Trial], int], None] | None,
    ) -> None:
        self._views, self._config, self._budget, self._tree, self._export = views, config, budget, tree, export
        self._known, self._on_trial = known or (lambda config: None), on_trial or (lambda trials, total: None)
        self._trials: list[Trial] = []
        max_count = COUNTS[-1] if budget.vertices is None else min(COUNTS[-1], budget.vertices // _vertices(config))
        self._counts = sorted({count for count in COUNTS if count < max_count} | {max_count})
        self._total = len(self._counts) + 2 + len(_CURVE_FRACTIONS) * (budget.texels is not None or budget.bytes is not None)

    def choice(self) -> Choice:
        """See :func:`choose`."""
        config, budget = self._config, self._budget
        placement: Placement = config.placement or "clusters"
        series = list[Trial]()
        for count in self._counts:
            series.append(self._try(count, config.sides, placement))
            if self._is_complete(series):
                break
        best = self._best()
        if budget.target_psnr is None:  # other ways to spend the same vertices
            count, before = best.billboards, len(self._trials)
            if config.sides == "one" and count > 1:
                self._try(count // 2, "two", placement)
            if config.placement is None:
                self._try(count, config.sides, "even")
            best = max([best, *filter(self._is_within_budget, self._trials[before:])], key=lambda trial: trial.psnr)
            if budget.texels is not None or budget.bytes is not None:  # fewer texels, for the curve
                for fraction in _CURVE_FRACTIONS:
                    self._trial(best.billboards, best.sides, best.placement, max(2 * count, int(fraction * best.texels)))
        max_texels = best.max_texels
        if budget.most_bytes is not None:
            max_texels = min(int(_COMPRESSION_GAIN * budget.most_bytes / best.bytes * best.texels), budget.most_texels or 1 << 40)
        chosen = replace(config, billboards=best.billboards, sides=best.sides, placement=best.placement, max_texels=max_texels)
        met = budget.target_psnr is None or best.psnr >= budget.target_psnr
        return Choice(chosen.resolve(), tuple(self._trials), self._trials.index(best), met, tuple(self._views.test.names))

    def _is_complete(self, series: list[Trial]) -> bool:
        """Whether trials of more billboards can be skipped after those of ``series``."""
        budget = self._budget
        if budget.target_psnr is not None:
            return self._is_within_budget(series[-1]) and series[-1].psnr >= budget.target_psnr
        if budget.auto and len(series) > 2:  # one small gain may be chance, two in a row are not
            return all(_gain(series[-1 - back], series[-2 - back]) < MIN_GAIN_DB for back in (0, 1))
        if budget.texels is not None or budget.bytes is not None:
            best = max(range(len(series)), key=lambda index: series[index].psnr)
            return len(series) - 1 - best >= _PATIENCE
        return False

    def _is_within_budget(self, trial: Trial) -> bool:
        limits = ((trial.vertices, self._budget.vertices), (trial.texels, self._budget.most_texels), (trial.bytes, self._budget.most_bytes))
        return all(limit is None or cost <= limit for cost, limit in limits)

    def _best(self) -> Trial:
        """Return the trial that determines the number of vertices."""
        budget = self._budget
        allowed = [trial for trial in self._trials if self._is_within_budget(trial)]
        if not allowed:
            first = self._trials[0]
            fail("budget", f"{first.billboards} billboard with {first.bytes:,} bytes exceeds it", "allow more")
        best = max(allowed, key=lambda trial: trial.psnr)
        equivalent = [trial for trial in allowed if trial.psnr >= best.psnr - _NOISE_DB]
        sign = 1 if budget.vertices is not None else -1  # use all vertices that the budget allows, or draw as few as possible
        best = max(equivalent, key=lambda trial: (sign * trial.vertices, trial.psnr))
        if budget.target_psnr is not None:
            sufficient = [trial for trial in allowed if trial.psnr >= budget.target_psnr]
            return min(sufficient, key=lambda trial: (trial.vertices, -trial.psnr), default=best)
        if budget.auto:  # follow the Pareto front while a step gains enough
            front = [allowed[index] for index in pareto_front([(trial.vertices, trial.psnr) for trial in allowed])]
            best = front[0]
            for trial in front[1:]:
                if _gain(trial, best) >= MIN_GAIN_DB:
                    best = trial
        return best

    def _try(self, count: int, sides: Sides, placement: Placement) -> Trial:
        """Run a trial. With a limit in bytes, run up to three, until one is within the limit and uses most of it."""
        limit, trials = self._budget.most_bytes, list[Trial]()
        max_texels = self._guess(count, self._trials[-1:])
        for _ in range(3):
            trials.append(trial := self._trial(count, sides, placement, max_texels))
            if limit is None or (trial.bytes <= limit and (trial.bytes > _MIN_USE * limit or trial.texels < _MIN_USE * (max_texels or 0))):
                break
            previous, max_texels = max_texels, self._guess(count, trials[-2:])
            if max_texels == previous:
                break
        return trials[-1]

    def _guess(self, count: int, known: list[Trial]) -> int | None:
        """Estimate the most texels within the limits from the last one or two trials. Bytes are about linear in texels."""
        limit, max_texels = self._budget.most_bytes, self._budget.most_texels
        if limit is None:
            return max_texels
        target, texels = 0.95 * limit, 0.95 * limit / _BYTES_PER_TEXEL
        if len(known) == 2 and (known[1].bytes - known[0].bytes) * (known[1].texels - known[0].texels) > 0:
            rate = (known[1].bytes - known[0].bytes) / (known[1].texels - known[0].texels)
            texels = known[1].texels + (target - known[1].bytes) / rate
        elif known:
            texels = target * known[-1].texels / known[-1].bytes
        return max(2 * count, min(int(texels), max_texels or 1 << 40))

    def _trial(self, count: int, sides: Sides, placement: Placement, max_texels: int | None) -> Trial:
        """Add the trial of a configuration. Run a short fit unless the trial is known."""
        short = {name: value for name, value in _SHORT.items() if getattr(self._config, name) is None}
        config = replace(self._config, billboards=count, sides=sides, placement=placement, max_texels=max_texels, **short)
        trial = self._known(config)
        if trial is None:
            started = time.perf_counter()
            cloud = fit(self._views, config, tree=self._tree).cloud
            size, seconds = model_bytes(cloud, self._export), round(time.perf_counter() - started, 1)
            psnr = round(validation_psnr(cloud, self._views.test), 3)
            trial = Trial(count, sides, placement, max_texels, cloud.vertex_count, len(cloud.texels), size, psnr, seconds)
        self._trials.append(trial)
        self._on_trial(list(self._trials), self._total)
        return trial


def validation_psnr(cloud: BillboardCloud, views: ViewSet) -> float:
    """Compute the PSNR of a cloud in dB, averaged over views and :data:`~bbfit.evaluation.backgrounds.BACKGROUNDS`."""
    draw = shipped_model(cloud).draw
    return float(np.mean([mean_psnr(*held_out(draw, views, index)) for index in range(len(views))]))


def _gain(more: Trial, fewer: Trial) -> float:
    """Return the gain in dB per doubling of the vertices."""
    return (more.psnr - fewer.psnr) / math.log2(more.vertices / fewer.vertices) if more.vertices > fewer.vertices else math.inf
