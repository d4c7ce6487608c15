"""The commands that compare: many configurations on many trees, and many systems on one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bbfit.blender.config import ViewsConfig
from bbfit.cli.console import out_console, progress
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.inputs import InputLimits
from bbfit.rivals.config import CompareConfig
from bbfit.sweep.config import SweepConfig
from bbfit.trees.config import GrowConfig


def sweep_command(
    out: Path,
    species: tuple[str, ...] = (),
    trees: tuple[Path, ...] = (),
    folders: Annotated[tuple[Path, ...], tyro.conf.arg(name="views")] = (),
    seed: int = 0,
    sweep: SweepConfig = SweepConfig(),  # noqa: B008
    grow: GrowConfig = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Fit many configurations to many trees, on this machine or on a Ray cluster, and compare them in tables.

    Without options it runs the 72 experiments of the thesis that the method comes from. Interrupted and started again, it resumes where it
    stopped; every run is done once.

    For example: bbfit sweep --out runs/sweep --species acer apple --grid default

    Args:
        out: Folder for trees, runs and the tables table.csv, table.md and table.png.
        species: Species to grow; `bbfit grow --list` lists them.
        trees: Tree files to render.
        folders: Folders of views.
        seed: Seed of all stages; --grow.seed, --views.seed and --fit.seed override it for one of them.
        sweep: What is varied, and where it runs.
        grow: How trees are grown.
        views: How trees are rendered.
        fit: Options of all fits; the grid overrides them.
        export: How the models are written.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import sweep_table
    from bbfit.sweep.scheduling import run_sweep

    stages = RunConfig(grow=grow, views=views, fit=fit, export=export, limits=limits)
    with progress() as on_progress:
        result = run_sweep(out, sweep, stages, species=species, trees=trees, views=folders, on_progress=on_progress)
    out_console.print(sweep_table(result.rows))
    failed = sum(row.reason is not None for row in result.rows)
    if result.kept:
        out_console.print(f"{result.kept} results kept from an earlier start", style="dim")
    if failed:
        out_console.print(f"{failed} runs failed; table.md gives the reasons, and --retry-failed runs them again", style="yellow")
    out_console.print(f"tables in {result.folder}: table.csv, table.md, table.png", soft_wrap=True)


def compare_command(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path = Path("runs/compare"),
    seed: int = 0,
    compare: CompareConfig = CompareConfig(),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Compare bbfit with other methods on one tree: scores on the same held-out views, bytes, vertices and seconds.

    Interrupted and started again, it resumes where it stopped.

    For example: bbfit compare tree.glb --out runs/compare

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: Folder for the results.
        seed: Seed of all stages; --views.seed and --fit.seed override it for one of them.
        compare: Which systems are compared, and how large each is.
        views: How the tree is rendered.
        fit: How bbfit's billboards are fitted.
        export: How they are written.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit import comparison
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import compare_table

    stages = RunConfig(views=views, fit=fit, export=export, limits=limits)
    with progress() as on_progress:
        result = comparison.compare(tree, out, compare, stages, on_progress=on_progress)
    out_console.print(compare_table(result.rows))
    out_console.print(
        f"tables in {result.folder}: compare.md, compare.csv, compare.json; pictures: systems.png, quality.png", soft_wrap=True
    )
