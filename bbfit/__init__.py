"""bbfit: a 3D tree as a handful of textured planes that look like it from every side."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bbfit.blender.config import ViewsConfig
    from bbfit.blender.views_folder import render_views
    from bbfit.budget.choice import choose
    from bbfit.budget.config import BudgetConfig
    from bbfit.checks import InputError
    from bbfit.comparison import compare
    from bbfit.evaluation.report import Report
    from bbfit.evaluation.scoring import evaluate
    from bbfit.exporting.config import ExportConfig, LodConfig
    from bbfit.exporting.model import export
    from bbfit.fitting.config import FitConfig
    from bbfit.fitting.loop import FitResult, fit
    from bbfit.geometry.camera import Camera
    from bbfit.geometry.cloud import BillboardCloud
    from bbfit.geometry.orbit import Orbit
    from bbfit.lod import build_lod
    from bbfit.pipeline import RunConfig, run
    from bbfit.rendering.dispatch import render
    from bbfit.rivals.config import CompareConfig
    from bbfit.sweep.config import SweepConfig
    from bbfit.sweep.scheduling import run_sweep
    from bbfit.trees.config import GrowConfig
    from bbfit.trees.growth import grow
    from bbfit.trees.species import Species, load_species
    from bbfit.trees.tree_file import write_tree
    from bbfit.viewing.server import view
    from bbfit.views import ViewDataset

# Names are imported when they are first used, so that `bbfit --help` need not wait for torch.
_HOMES = {
    "BillboardCloud": "bbfit.geometry.cloud",
    "BudgetConfig": "bbfit.budget.config",
    "Camera": "bbfit.geometry.camera",
    "CompareConfig": "bbfit.rivals.config",
    "ExportConfig": "bbfit.exporting.config",
    "FitConfig": "bbfit.fitting.config",
    "FitResult": "bbfit.fitting.loop",
    "GrowConfig": "bbfit.trees.config",
    "InputError": "bbfit.checks",
    "LodConfig": "bbfit.exporting.config",
    "Orbit": "bbfit.geometry.orbit",
    "Report": "bbfit.evaluation.report",
    "RunConfig": "bbfit.pipeline",
    "Species": "bbfit.trees.species",
    "SweepConfig": "bbfit.sweep.config",
    "ViewDataset": "bbfit.views",
    "ViewsConfig": "bbfit.blender.config",
    "build_lod": "bbfit.lod",
    "choose": "bbfit.budget.choice",
    "compare": "bbfit.comparison",
    "evaluate": "bbfit.evaluation.scoring",
    "export": "bbfit.exporting.model",
    "fit": "bbfit.fitting.loop",
    "grow": "bbfit.trees.growth",
    "load_species": "bbfit.trees.species",
    "render": "bbfit.rendering.dispatch",
    "render_views": "bbfit.blender.views_folder",
    "run": "bbfit.pipeline",
    "run_sweep": "bbfit.sweep.scheduling",
    "view": "bbfit.viewing.server",
    "write_tree": "bbfit.trees.tree_file",
}

__version__ = version("bbfit")
__all__ = [
    "BillboardCloud",
    "BudgetConfig",
    "Camera",
    "CompareConfig",
    "ExportConfig",
    "FitConfig",
    "FitResult",
    "GrowConfig",
    "InputError",
    "LodConfig",
    "Orbit",
    "Report",
    "RunConfig",
    "Species",
    "SweepConfig",
    "ViewDataset",
    "ViewsConfig",
    "build_lod",
    "choose",
    "compare",
    "evaluate",
    "export",
    "fit",
    "grow",
    "load_species",
    "render",
    "render_views",
    "run",
    "run_sweep",
    "view",
    "write_tree",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'bbfit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
