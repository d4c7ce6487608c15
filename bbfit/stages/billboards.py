"""The stages from views to fitted billboards: the choice of a configuration for a budget, and the fit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path

from bbfit.budget.choice import choose
from bbfit.budget.config import BudgetConfig
from bbfit.budget.sizes import fitted_within_bytes
from bbfit.budget.trials import Trial, lookup
from bbfit.checks import InputError, check_record
from bbfit.exporting.config import ExportConfig, ResolvedExport
from bbfit.files import read_json, write_bytes, write_json
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.fitting.loop import Step, fit, fit_inputs
from bbfit.inputs import reading
from bbfit.provenance import EXECUTION, VERSIONS
from bbfit.reporting.plots import Cost, loss_plot, pareto_plot
from bbfit.reporting.text import csv_bytes
from bbfit.stages.stage import OnProgress, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

BUDGET_OUTPUTS = ("pareto.json", "pareto.png")
FIT_OUTPUTS = ("cloud.safetensors", "loss.csv", "loss.png")


def budget_stage(
    folder: Path, views: ViewDataset, tree: TreeFile | None, fit_config: FitConfig, budget: BudgetConfig, export: ExportConfig
) -> Stage:
    """Choose a configuration for a budget, and write ``pareto.json`` and ``pareto.png``.

    ``pareto.json`` is written after every trial, so that an interrupted choice repeats none.
    """
    path = folder / "pareto.json"
    inputs = (*fit_inputs(views, fit_config, tree), budget, *_sized(export), VERSIONS["fit"])

    def work(on_progress: OnProgress) -> None:
        def on_trial(trials: list[Trial], total: int) -> None:
            write_json(path, {"inputs": stage.key, "trials": [asdict(trial) for trial in trials]})
            last = trials[-1]
            on_progress("budget", len(trials), max(total, len(trials)), f"{last.vertices} vertices {last.psnr:.2f} dB")

        on_progress("budget", 0, 1)
        known = _known_trials(path, stage.key)
        choice = choose(views, fit_config, budget, tree=tree, export=export, known=lookup(known), on_trial=on_trial)
        limits = {name: value for name, value in asdict(budget).items() if value}
        write_json(path, {"inputs": stage.key, "budget": limits, "config": asdict(choice.config), **choice.to_json()})
        cost: Cost = "bytes" if budget.bytes else "texels" if budget.texels else "vertices"
        pareto_plot(choice, path.with_suffix(".png"), cost=cost)

    stage = Stage("budget", inputs, BUDGET_OUTPUTS, work)
    return stage


def read_choice(folder: Path, given: FitConfig) -> tuple[ResolvedFit, bool]:
    """The configuration that a finished budget stage chose, and whether it reached the target PSNR (true without a target).

    Options that do not change results, such as the device, are those of ``given``: the stage may have run with others.
    """
    path = folder / "pareto.json"
    content = read_json("budget", path)
    with reading("budget", path, "remove it to choose anew"):
        execution = {entry.name: getattr(given, entry.name) for entry in fields(FitConfig) if entry.metadata == EXECUTION}
        config = ResolvedFit(**(content["config"] | execution))
        check_record("met", content["met"], bool)
        return config, content["met"]


def fit_stage(
    folder: Path,
    views: ViewDataset,
    tree: TreeFile | None,
    config: FitConfig,
    limit: tuple[int, ExportConfig] | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Stage:
    """Fit billboards and write ``cloud.safetensors``, ``loss.csv`` and ``loss.png``. An interrupted fit continues from its checkpoint.

    The fit uses the training views. Without ``tree``, the views alone place the billboards. ``limit`` is the maximum size of the model in
    bytes with its export options; a fit that exceeds it is repeated for a few steps with fewer texels. ``on_step`` is called after every
    step of the fit.
    """
    config = config.resolve()
    checkpoint = folder / "fit.checkpoint"

    def work(on_progress: OnProgress) -> float:
        def after(step: Step) -> None:
            on_progress("fit", step.index, step.total, f"loss {step.loss:.5f}")
            if on_step is not None:
                on_step(step)

        def on_place(done: int, total: int) -> None:
            on_progress("place", done, total)

        result = fit(views, config, tree=tree, checkpoint=checkpoint, on_step=after, on_place=on_place)
        started = time.perf_counter()
        cloud = result.cloud if limit is None else fitted_within_bytes(views, result, *limit, on_step=after)
        seconds = result.seconds + time.perf_counter() - started
        cloud.save(folder / "cloud.safetensors")
        write_bytes(folder / "loss.csv", csv_bytes([("step", "loss"), *enumerate(result.losses, 1)]))
        loss_plot(result.losses, folder / "loss.png")
        return seconds

    within = None if limit is None else (limit[0], *_sized(limit[1]), VERSIONS["budget"])
    return Stage("fit", (*fit_inputs(views, config, tree), within), FIT_OUTPUTS, work, temporary=(checkpoint.name,))


def _sized(export: ExportConfig) -> tuple[ResolvedExport, int]:
    """What the size of a model depends on besides its cloud: also the encoders that are installed."""
    return export.resolve(), VERSIONS["export"]


def _known_trials(path: Path, key: str) -> list[Trial]:
    """The trials of an interrupted choice with the same key, or none if the file is missing or damaged."""
    try:
        content = read_json("budget", path) if path.is_file() else {}
        names = [entry.name for entry in fields(Trial)]
        same = isinstance(content, dict) and content.get("inputs") == key
        with reading("budget", path, "remove it to choose anew"):
            trials = [Trial(**{name: trial[name] for name in names}) for trial in content["trials"]] if same else []
            for trial in trials:
                check_record("trial", trial, Trial)
            return trials
    except InputError:
        return []
