"""The commands that compare: many configurations on many trees, many systems, and frame times."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bbfit.blender.config import ViewsConfig
from bbfit.checks import fail
from bbfit.cli.console import out_console, progress
from bbfit.comparison.config import CompareConfig
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.frames.config import FramesConfig
from bbfit.inputs import InputLimits
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
    tree: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TREE]")] = None,
    /,
    out: Path = Path("runs/compare"),
    species: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    trees: tuple[Path, ...] = (),
    seed: int = 0,
    compare: CompareConfig = CompareConfig(),  # noqa: B008
    grow: GrowConfig = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Compare bbfit with other methods: scores on the same held-out views, bytes, vertices, shaded pixels and seconds.

    With one TREE it compares their pictures. With --trees or --species it compares means over trees, on this machine or on a Ray cluster.
    Interrupted and started again, it resumes where it stopped.

    For example: bbfit compare tree.glb --out runs/compare

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: Folder for the results.
        species: Species to grow and compare on; `bbfit grow --list` lists them.
        seeds: Seeds of the trees of each species.
        trees: Tree files to compare on.
        seed: Seed of all other stages; --views.seed and --fit.seed override it for one of them.
        compare: Which systems are compared, how large each is, and where trees are compared.
        grow: How trees are grown.
        views: How trees are rendered.
        fit: How bbfit's billboards are fitted.
        export: How they are written.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.comparison.many_trees import compare_trees
    from bbfit.comparison.one_tree import compare as compare_one
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import compare_table, summary_table

    many = bool(species or trees)
    if (tree is not None) == many:
        fail("compare", "expected a tree, or trees and species", "for example bbfit compare tree.glb, or bbfit compare --trees a.glb b.glb")
    stages = RunConfig(grow=grow, views=views, fit=fit, export=export, limits=limits)
    if tree is not None:
        with progress() as on_progress:
            result = compare_one(tree, out, compare, stages, on_progress=on_progress)
        out_console.print(compare_table(result.rows))
        tables = "tables in {}: compare.md, compare.csv, compare.json; pictures: systems.png, quality.png"
        out_console.print(tables.format(result.folder), soft_wrap=True)
        return
    with progress() as on_progress:
        compared = compare_trees(out, compare, stages, species=species, seeds=seeds, trees=trees, on_progress=on_progress)
    out_console.print(summary_table(compared.rows))
    for name, reason in compared.failures.items():
        out_console.print(f"{name} failed: {reason}", style="yellow", soft_wrap=True)
    out_console.print(f"in {compared.folder}: summary.md, summary.csv, pareto.png, and a comparison for each tree in trees", soft_wrap=True)


def frames_command(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDERS AND GLB FILES]")] = (),
    /,
    out: Path = Path("runs/frames"),
    tree: Path | None = None,
    frames: FramesConfig = FramesConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Measure frame times: draw fields of hundreds to a hundred thousand trees in a browser, by three.js and Babylon.js.

    Interrupted and started again, it resumes where it stopped.

    For example: bbfit frames runs/compare lod --tree tree.glb --out runs/frames

    Args:
        sources: Folders of bbfit run, compare and lod, and GLB files, all of one tree.
        out: Folder for the results.
        tree: The tree itself, which is drawn too (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        frames: Which fields of trees are drawn, and in what.
        limits: What the inputs may refer to, and how large they may be.
    """
    from bbfit.frames.measurement import measure_frames
    from bbfit.reporting.tables import frames_table

    with progress() as on_progress:
        result = measure_frames(sources, out, frames, tree=tree, limits=limits, on_progress=on_progress)
    for table in frames_table(result.rows):
        out_console.print(table)
    for cost in result.costs:
        if cost.fragments_per_triangle is not None:
            out_console.print(f"{cost.program}: a triangle takes as long as {cost.fragments_per_triangle:.2g} fragments", soft_wrap=True)
    out_console.print(f"in {result.folder}: frames.md, frames.csv, frames.json, frames.png", soft_wrap=True)
