"""The commands for many trees, configurations or systems: sweeps, comparisons, frame times, and libraries."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from bbfit.blender.config import ViewsConfig
from bbfit.checks import fail
from bbfit.cli.console import out_console, progress, show_missing_encoder
from bbfit.comparison.config import CompareConfig
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.frames.config import FramesConfig
from bbfit.inputs import InputLimits
from bbfit.library.config import LibraryConfig
from bbfit.sweep.config import SweepConfig
from bbfit.trees.config import GrowConfig
from bbfit.workers.config import WorkersConfig


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
    """Compare bbfit with other methods: scores on the same held-out views, near and from afar, and what each costs.

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
        given = replace(compare, **vars(WorkersConfig())) != compare
        if given or seeds != (0,) or replace(grow, seed=0) != GrowConfig(detail=0.5):
            fail("compare", "seeds, options of grown trees, and where tasks run are for --trees and --species", "leave them out")
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


def library_command(
    trees: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[TREES]")] = (),
    /,
    out: Path = Path("runs/library"),
    species: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    seed: int = 0,
    library: LibraryConfig = LibraryConfig(),  # noqa: B008
    grow: GrowConfig = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Make levels of detail of many trees that share one atlas, with a list of all of them and a picture of each.

    It works on this machine or on a Ray cluster. Interrupted and started again, it resumes where it stopped.

    For example: bbfit library --species acer apple --seeds 0 1 2 --out library

    Args:
        trees: Trees (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: Folder for the library.
        species: Species to grow; `bbfit grow --list` lists them.
        seeds: Seeds of the trees of each species.
        seed: Seed of all other stages; --views.seed and --fit.seed override it for one of them.
        library: The levels of each tree, their atlas, and where trees are made.
        grow: How trees are grown.
        views: How trees are rendered.
        fit: How the billboards are fitted. The levels set --billboards.
        export: How the models are written.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.library.building import build_library
    from bbfit.lod import with_textures
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.library_tables import library_table, times_table

    stages, started = RunConfig(grow=grow, views=views, fit=fit, export=export, limits=limits), time.perf_counter()
    with progress() as on_progress:
        built = build_library(trees, out, library, stages, species=species, seeds=seeds, on_progress=on_progress)
    elapsed = time.perf_counter() - started
    out_console.print(library_table({tree.name: (tree.height, tree.levels) for tree in built.trees}))
    out_console.print(times_table({tree.name: tree.seconds for tree in built.trees}, built.seconds))
    out_console.print(f"this start took {elapsed:,.0f} s", style="dim")
    for page in built.pages:
        files = ", ".join(page.files)
        out_console.print(f"{page.width:,} x {page.height:,} texels, {page.used:.0%} used, {page.bytes:,} bytes: {files}", soft_wrap=True)
    for name, reason in built.failures.items():
        out_console.print(f"{name} failed and is not in the library: {reason}", style="yellow", soft_wrap=True)
    show_missing_encoder(with_textures(export))
    out_console.print(f"in {built.folder}: library.json, contact.png, times.md, and the models in trees", soft_wrap=True)
