"""The systems that are fits of bbfit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from bbfit.budget.config import BudgetConfig
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.subject import Subject, System, SystemResult, billboards
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.geometry.cloud import BillboardCloud
from bbfit.pipeline import RunConfig, fitted, prepare
from bbfit.rivals.fluffed import fluffed


def fits(config: CompareConfig, shared: FitConfig) -> dict[str, tuple[FitConfig, BudgetConfig]]:
    """The options of the systems that are fits of bbfit. Fields that a system does not set come from the shared options."""
    default, count = FitConfig(), config.billboards
    own = {
        "bbfit-default": FitConfig(),
        "bbfit-default-blend": FitConfig(alpha="blend"),
        "bbfit-default-coverage": FitConfig(alpha="coverage"),
        "bbfit-rectangles": FitConfig(),
        "bbfit-small": FitConfig(alpha="blend", texel_density=0.4),
        "bbfit-fine": FitConfig(alpha="blend", billboards=config.most, texel_density=1.6),
        "bbfit": FitConfig(billboards=count),
        "bbfit-few": FitConfig(alpha="blend", billboards=config.few),
        "bbfit-blend": FitConfig(alpha="blend", billboards=count),
        "bbfit-many": FitConfig(alpha="blend", billboards=config.many, locality=0.0),
        "bbfit-medium": FitConfig(alpha="blend", billboards=config.medium),
        "bbfit-most": FitConfig(alpha="blend", billboards=config.most),
        "bbfit-most-coverage": FitConfig(alpha="coverage", billboards=config.most),
        "thesis": FitConfig(preset="thesis", billboards=4, sides="pair"),
        "bbfit-maps": FitConfig(billboards=count, light="maps"),
        "baked-maps": FitConfig(billboards=count, light="maps", map_steps=0),
    }
    open_fields = {
        system: [entry.name for entry in fields(FitConfig) if getattr(fit, entry.name) == getattr(default, entry.name)]
        for system, fit in own.items()
    }
    made = {
        system: (replace(fit, **{name: getattr(shared, name) for name in open_fields[system]}), BudgetConfig())
        for system, fit in own.items()
    }
    return made | {"bbfit-bytes": (replace(shared, alpha="blend", max_texels=None), BudgetConfig(bytes=1))}  # the size is known later


def own_systems(config: CompareConfig, shared: FitConfig) -> dict[str, System]:
    """The fits of bbfit by their names."""
    chosen, count = fits(config, shared), config.billboards
    bounded = partial(_fitted, outlines=False)
    named: dict[str, tuple[str, Callable[[FitConfig, Subject, Path], SystemResult]]] = {
        "bbfit-default": ("bbfit, its default, mask", _fitted),
        "bbfit-default-blend": ("bbfit, its default, blend", _fitted),
        "bbfit-default-coverage": ("bbfit, its default, coverage", _fitted),
        "bbfit-rectangles": ("bbfit, its default, mask, rectangles", bounded),
        "bbfit-small": ("bbfit, its default, blend, 0.4 texels a pixel", _fitted),
        "bbfit-fine": (f"bbfit, {config.most} billboards, blend, 1.6 texels a pixel", bounded),
        "bbfit": (f"bbfit, {count} billboards, mask", bounded),
        "bbfit-few": (f"bbfit, {config.few} billboards, blend", bounded),
        "bbfit-blend": (f"bbfit, {count} billboards, blend", bounded),
        "bbfit-many": (f"bbfit, {config.many} large billboards, blend", bounded),
        "bbfit-medium": (f"bbfit, {config.medium} billboards, blend", bounded),
        "bbfit-most": (f"bbfit, {config.most} billboards, blend", bounded),
        "bbfit-most-coverage": (f"bbfit, {config.most} billboards, coverage", bounded),
        "bbfit-bytes": ("bbfit, blend, in bbfit's bytes", _budgeted),
        "thesis": ("the thesis, 4 double billboards, L2", bounded),
        "bbfit-maps": (f"bbfit, {count} billboards, mask, fitted maps", bounded),
        "baked-maps": (f"bbfit, {count} billboards, mask, baked maps", bounded),
    }
    systems = {name: System(title, partial(fitted, chosen[name][0]), chosen[name]) for name, (title, fitted) in named.items()}
    systems["bbfit-bytes"] = replace(systems["bbfit-bytes"], inputs=(*chosen["bbfit-bytes"], *chosen["bbfit"]))
    fluffy = f"bbfit, {count} billboards, mask, baked maps, spherical normals"
    return systems | {"fluffed": System(fluffy, _fluffed, chosen["baked-maps"])}


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
