"""The systems that are fits of bbfit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bbfit.budget.config import BudgetConfig
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.subject import Subject, System, SystemResult, billboards
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.geometry.cloud import BillboardCloud
from bbfit.pipeline import RunConfig, fitted, prepare
from bbfit.rivals.fluffed import fluffed

Simplify = Callable[[FitConfig, Subject, Path], SystemResult]
"""Makes a system with the options of its fit, for a tree, in a folder."""


def fits(config: CompareConfig, shared: FitConfig) -> dict[str, tuple[FitConfig, BudgetConfig]]:
    """The options of the systems that are fits of bbfit. Fields that a system does not set come from the shared options."""
    made = {name: (replace(shared, **options), BudgetConfig()) for name, (_, options, _) in _table(config).items()}
    return made | {"bbfit-bytes": (replace(shared, alpha="blend", max_texels=None), BudgetConfig(bytes=1))}  # the size is known later


def _table(config: CompareConfig) -> dict[str, tuple[str, dict[str, Any], Simplify]]:
    """The title of each system without a budget, the options that it sets, and how it is made."""
    bounded, count = partial(_fitted, outlines=False), config.billboards
    return {
        "bbfit-default": ("bbfit, its default, mask", {}, _fitted),
        "bbfit-default-blend": ("bbfit, its default, blend", {"alpha": "blend"}, _fitted),
        "bbfit-default-coverage": ("bbfit, its default, coverage", {"alpha": "coverage"}, _fitted),
        "bbfit-rectangles": ("bbfit, its default, mask, rectangles", {}, bounded),
        "bbfit-small": ("bbfit, its default, blend, 0.4 texels a pixel", {"alpha": "blend", "texel_density": 0.4}, _fitted),
        "bbfit-fine": (
            f"bbfit, {config.most} billboards, blend, 1.6 texels a pixel",
            {"alpha": "blend", "billboards": config.most, "texel_density": 1.6},
            bounded,
        ),
        "bbfit": (f"bbfit, {count} billboards, mask", {"billboards": count}, bounded),
        "bbfit-few": (f"bbfit, {config.few} billboards, blend", {"alpha": "blend", "billboards": config.few}, bounded),
        "bbfit-blend": (f"bbfit, {count} billboards, blend", {"alpha": "blend", "billboards": count}, bounded),
        "bbfit-many": (
            f"bbfit, {config.many} large billboards, blend",
            {"alpha": "blend", "billboards": config.many, "locality": 0.0},
            bounded,
        ),
        "bbfit-medium": (f"bbfit, {config.medium} billboards, blend", {"alpha": "blend", "billboards": config.medium}, bounded),
        "bbfit-most": (f"bbfit, {config.most} billboards, blend", {"alpha": "blend", "billboards": config.most}, bounded),
        "bbfit-most-coverage": (f"bbfit, {config.most} billboards, coverage", {"alpha": "coverage", "billboards": config.most}, bounded),
        "thesis": ("the thesis, 4 double billboards, L2", {"preset": "thesis", "billboards": 4, "sides": "pair"}, bounded),
        "bbfit-maps": (f"bbfit, {count} billboards, mask, fitted maps", {"billboards": count, "light": "maps"}, bounded),
        "baked-maps": (f"bbfit, {count} billboards, mask, baked maps", {"billboards": count, "light": "maps", "map_steps": 0}, bounded),
    }


def own_systems(config: CompareConfig, shared: FitConfig) -> dict[str, System]:
    """The fits of bbfit by their names."""
    chosen = fits(config, shared)
    systems = {name: System(title, partial(made, chosen[name][0]), chosen[name]) for name, (title, _, made) in _table(config).items()}
    budgeted, inputs = partial(_budgeted, chosen["bbfit-bytes"][0]), (*chosen["bbfit-bytes"], *chosen["bbfit"])
    fluffy = f"bbfit, {config.billboards} billboards, mask, baked maps, spherical normals"
    return systems | {
        "bbfit-bytes": System("bbfit, blend, in bbfit's bytes", budgeted, inputs),
        "fluffed": System(fluffy, _fluffed, chosen["baked-maps"]),
    }


def _fitted(fit: FitConfig, subject: Subject, folder: Path, *, outlines: bool = True) -> SystemResult:
    """Run bbfit. Without ``outlines``, billboards are rectangles unless an outline is given."""
    export = subject.stages.export
    return _run(RunConfig(fit=fit, export=export if outlines else export.comparable()), subject, folder)


def _budgeted(fit: FitConfig, subject: Subject, folder: Path) -> SystemResult:
    """Run bbfit with a budget of as many bytes as the model of the ``bbfit`` system has."""
    budget = BudgetConfig(bytes=subject.most_bytes)
    return _run(RunConfig(fit=fit, budget=budget, export=subject.stages.export.comparable()), subject, folder)


def _run(stages: RunConfig, subject: Subject, folder: Path) -> SystemResult:
    def report(stage: str, done: int, total: int, note: str = "") -> None:
        subject.on_progress(f"{folder.name} {stage}", done, total, note)

    config = replace(stages, tree=subject.tree.path, limits=subject.stages.limits)
    with prepare(subject.folder / "views", folder / "run", config, on_progress=report) as prepared:
        made = fitted(prepared, config, on_progress=report)
        seconds = made.seconds + sum(prepared.record.seconds.get(stage, 0.0) for stage in ("budget", "fit"))
    return billboards(subject, made.model, seconds)


def _fluffed(subject: Subject, folder: Path) -> SystemResult:
    """Spherical normals in place of the baked ones of the system ``baked-maps``."""
    baked = subject.row("baked-maps")
    started = time.perf_counter()
    cloud = fluffed(BillboardCloud.load(folder.parent / "baked-maps" / "run" / "cloud.safetensors"))
    result = billboards(subject, shipped_model(cloud, subject.stages.export.comparable()), 0.0)
    return replace(result, seconds=(baked.costs.seconds or 0.0) + time.perf_counter() - started)
