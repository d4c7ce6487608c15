"""The commands that turn one tree into billboards, and one command for each stage of it: parse, call, print."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from bbfit.blender.config import ViewsConfig
from bbfit.budget.config import BudgetConfig
from bbfit.checks import fail
from bbfit.cli.console import out_console, progress, show, show_missing_encoder
from bbfit.cli.viewing import WatchConfig, watched
from bbfit.exporting.config import ExportConfig, LodConfig, ThinConfig, check_effect
from bbfit.fitting.config import FitConfig
from bbfit.inputs import InputLimits
from bbfit.trees.config import GrowConfig


def run_command(
    tree: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TREE]")] = None,
    /,
    out: Path = Path("runs/tree"),
    species: str | None = None,
    seed: int = 0,
    grow: GrowConfig = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    budget: BudgetConfig = BudgetConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
    page: WatchConfig = WatchConfig(),  # noqa: B008
) -> None:
    """Do everything: take a tree or grow one, render views of it, fit billboards to them, write the models and a report with the scores.

    Interrupted and started again, it resumes where it stopped.

    For example: bbfit run tree.glb --out runs/tree

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend) or a folder of views. Default: grow one.
        out: Folder for the results.
        species: Species to grow if there is no tree; `bbfit grow --list` lists them. Default: a quaking aspen.
        seed: Seed of all stages; --grow.seed, --views.seed and --fit.seed override it for one of them.
        grow: How a tree is grown.
        views: How the tree is rendered.
        fit: How the billboards are fitted. The preset decides options that are not given.
        budget: What the result may cost. With any limit, short fits choose the number of billboards.
        export: How the models are written.
        limits: What the tree and the views may refer to, and how large they may be.
        page: Watching the fit in a browser.
    """
    from bbfit.pipeline import RunConfig, run

    config = RunConfig(species=species, grow=grow, views=views, fit=fit, budget=budget, export=export, limits=limits)
    with watched(page, out, tree, None, fit) as display:
        with display.progress() as on_progress:
            result = run(tree, out, config, on_progress=on_progress, on_step=display.on_step)
        show(result, thesis=fit.preset == "thesis")
        show_missing_encoder(export)
        display.finish()


def grow_command(
    species: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SPECIES]")] = None,
    /,
    out: Path | None = None,
    list: tyro.conf.FlagCreatePairsOff[bool] = False,
    grow: GrowConfig = GrowConfig(),  # noqa: B008
) -> None:
    """Grow a tree of a species, after Weber and Penn 1995. The same seed gives the same file.

    For example: bbfit grow acer --seed 7 --out acer.glb

    Args:
        species: Species to grow; optional if --species-file has only one species.
        out: The tree's file, ending in .glb, or in .obj (its .mtl comes beside it).
        list: List the species and the file of their parameters, and grow nothing.
        grow: How it is grown.
    """
    from bbfit.model_files import check_model_path, names_beside
    from bbfit.trees import growth
    from bbfit.trees.species import figures_file, known_species, load_species

    if list:
        from bbfit.reporting.tables import species_table

        out_console.print(species_table([load_species(name, grow.species_file) for name in known_species(grow.species_file)]))
        out_console.print(f"figures in {grow.species_file or figures_file()}", soft_wrap=True)
        return
    from bbfit.outputs import single_files
    from bbfit.trees.tree_writer import write_tree

    figures = load_species(species, grow.species_file)
    if out is None:
        fail("out", "a file to write the tree to is missing", f"for example --out {figures.name}.glb")
    check_model_path("tree", out)
    with single_files("bbfit grow", out.parent, names_beside(out), [grow.species_file] if grow.species_file else []):
        scene = growth.grow(figures, seed=grow.seed, detail=grow.detail, leaves=grow.leaves, max_vertices=grow.max_vertices)
        paths = write_tree(scene, out)
    out_console.print(f"{figures.name}: {sum(len(mesh.vertices) for mesh in scene.geometry.values()):,} vertices")
    for path in paths:
        out_console.print(f"{path}  {path.stat().st_size:,} bytes", soft_wrap=True)


def views_command(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path,
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Render views of a tree from all around with Blender, into a folder in the NeRF-synthetic layout.

    Interrupted and started again, it renders the missing views.

    For example: bbfit views tree.glb --out views/tree

    Args:
        tree: The tree's file (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: Folder for the views; one with a part of them is completed.
        views: How the tree is rendered.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.blender.views_folder import render_views
    from bbfit.tree_files.tree_file import TreeFile

    with progress() as on_progress:
        render_views(TreeFile.open(tree, limits), out, views, on_progress=lambda done, total: on_progress("views", done, total))
    out_console.print(f"{views.count} views in {out}", soft_wrap=True)


def fit_command(
    views: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIEWS")],
    /,
    out: Path,
    tree: Path | None = None,
    fit: FitConfig = FitConfig(),  # noqa: B008
    budget: BudgetConfig = BudgetConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
    page: WatchConfig = WatchConfig(),  # noqa: B008
) -> None:
    """Fit billboards to a folder of views, write the models and a report with the scores. Needs no Blender.

    Interrupted and started again, it resumes where it stopped.

    For example: bbfit fit views/tree --tree tree.glb --out runs/tree

    Args:
        views: Folder of views, bbfit's own or any in the NeRF-synthetic layout.
        out: Folder for the results.
        tree: The mesh that the views show (.glb .gltf .obj .ply .stl), to place billboards by. Default: the visual hull of the views.
        fit: How the billboards are fitted. The preset decides options that are not given.
        budget: What the result may cost. With any limit, short fits choose the number of billboards.
        export: How the models are written.
        limits: What the tree and the views may refer to, and how large they may be.
        page: Watching the fit in a browser.
    """
    from bbfit.checks import check_folder
    from bbfit.pipeline import RunConfig, run

    if views.is_file():
        fail("views", f"{views} is a file", "give a folder of views; bbfit run takes a tree")
    check_folder("views", views)
    stages = RunConfig(tree=tree, fit=fit, budget=budget, export=export, limits=limits)
    with watched(page, out, views, tree, fit) as display:
        with display.progress() as on_progress:
            result = run(views, out, stages, on_progress=on_progress, on_step=display.on_step)
        show(result, thesis=fit.preset == "thesis")
        show_missing_encoder(export)
        display.finish()


def evaluate_command(
    cloud: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLOUD")],
    views: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIEWS")],
    /,
    out: Path | None = None,
    tree: Path | None = None,
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Score fitted billboards on the held-out views of a folder, which they were not fitted to.

    For example: bbfit evaluate runs/tree/cloud.safetensors runs/tree/views --out scores.json

    Args:
        cloud: The cloud.safetensors of a run's folder.
        views: Folder of views.
        out: File for the measures as JSON. Default: metrics.json beside the cloud, which replaces the one of its run.
        tree: The mesh that the views show, for its vertices and bytes, if the views were not rendered by bbfit.
        export: How the model is exported. The scores are those of the exported model. Default: the outline is that of the cloud's run.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.checks import check_output_file
    from bbfit.evaluation.report import stage_seconds
    from bbfit.evaluation.scoring import evaluate_model
    from bbfit.exporting.model import shipped_model
    from bbfit.geometry.cloud import BillboardCloud
    from bbfit.outputs import claimed_folder, single_files, used_folder
    from bbfit.reporting.tables import report_table
    from bbfit.stages.describing import subject_of
    from bbfit.stages.recorded import as_in_run, grown_species
    from bbfit.stages.results import completed, original_tree
    from bbfit.tree_files.tree_file import TreeFile
    from bbfit.views.dataset import ViewDataset

    export.check()
    out = check_output_file("out", out or cloud.with_name("metrics.json"))
    billboards, dataset, export = BillboardCloud.load(cloud), ViewDataset.load(views, limits=limits), as_in_run(export, cloud)
    mesh = None if tree is None else TreeFile.open(tree, limits)
    original = original_tree(dataset, mesh)
    dataset.test.check(may_be_empty=True)
    earlier = cloud.with_name("metrics.json")
    seconds = stage_seconds(earlier) if earlier.is_file() else {}
    inputs = [cloud, *dataset.train.paths, *dataset.test.paths, *(mesh.files if mesh else ())]
    use = claimed_folder if out == earlier else used_folder  # no other process may be at work in the run's folder
    with use("out", out.parent) as folder, single_files("evaluate", folder, [out.name], inputs):
        with progress() as on_progress:
            model = shipped_model(billboards, export, on_progress=on_progress)
            report = evaluate_model(
                model,
                dataset.test,
                original=original,
                turned=dataset.turned,
                lit=dataset.lit_test,
                on_progress=partial(on_progress, "evaluate"),
            )
        report = completed(replace(report, seconds={**seconds, **report.seconds}), model, subject_of(dataset, cloud, grown_species(cloud)))
        report.save(out)
    out_console.print(report_table(report, thesis=False))
    out_console.print(f"measures in {out}", soft_wrap=True)


def export_command(
    cloud: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLOUD")],
    /,
    out: Path,
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Write fitted billboards as a model for an engine or another program.

    For example: bbfit export runs/tree/cloud.safetensors --out planes.glb --profile godot

    Args:
        cloud: The cloud.safetensors of a run's folder.
        out: The model's file, ending in .glb, or in .obj (its .mtl and .png come beside it).
        export: How the model is written. Default: the outline is that of the cloud's run.
    """
    from bbfit.exporting.model import shipped_model
    from bbfit.geometry.cloud import BillboardCloud
    from bbfit.model_files import check_model_path, names_beside
    from bbfit.outputs import check_room, remove_results, single_files
    from bbfit.stages.describing import described_by_run
    from bbfit.stages.recorded import as_in_run

    out = check_model_path("model file", out)
    export.check()
    billboards, given, export = BillboardCloud.load(cloud), export, as_in_run(export, cloud)
    check_effect(replace(given, outline=export.outline), out)
    names = names_beside(out, texture=True, normals=billboards.surface is not None, mip_files=export.resolve().mip_files)
    stale = [name for name in names_beside(out, normals=True, mip_files=True) if name not in names]
    check_room(out.parent, 16 * len(billboards.texels))  # four bytes a texel for up to three pictures and all levels
    with single_files("bbfit export", out.parent, names, [cloud], stale), progress() as on_progress:
        shipped = described_by_run(shipped_model(billboards, export, on_progress=on_progress), cloud)
        paths = shipped.save(out)
        remove_results(out.parent, *(name for name in names if "*" in name), but=paths)  # mip levels of an earlier, larger atlas
    for path in paths:
        out_console.print(f"{path}  {path.stat().st_size:,} bytes", soft_wrap=True)
    if out.suffix.lower() == ".glb":
        nodes, vertices = shipped.cards.node_count, shipped.cards.vertex_count
        out_console.print(f"nodes {nodes:,}, draw calls {nodes:,}, vertices {vertices:,}", soft_wrap=True)
    show_missing_encoder(export)


def thin_command(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path,
    thin: ThinConfig = ThinConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Thin a tree out to a number of bytes or triangles: fewer and larger leaves on simpler branches, as one GLB.

    It keeps the materials of the tree, which need lights. No billboards are made.

    For example: bbfit thin tree.glb --out small.glb --bytes 2M --profile three

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: The file, ending in .glb.
        thin: How far it is thinned out.
        limits: What the tree may refer to, and how large it may be.
    """
    from bbfit.exporting.lod import glb_counts
    from bbfit.exporting.trees import check_thin, thin_tree
    from bbfit.outputs import single_files
    from bbfit.tree_files.tree_file import TreeFile

    source = TreeFile.open(tree, limits)
    check_thin(source, out, thin)
    with single_files("bbfit thin", out.parent, [out.name], source.files), progress() as on_progress:
        thin_tree(source, out, thin, on_progress=partial(on_progress, "thin"))
    vertices, triangles = glb_counts(out.read_bytes())
    out_console.print(f"{out}  {out.stat().st_size:,} bytes, {vertices:,} vertices, {triangles:,} triangles", soft_wrap=True)


def lod_command(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path,
    work: Path | None = None,
    seed: int = 0,
    lod: LodConfig = LodConfig(),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Make levels of detail: the tree and fewer and fewer billboards, with the distance from which each looks the same.

    They come in one GLB, and as a file each with lod.json, which describes them, and with --profile what that program needs to switch.
    Interrupted and started again, it resumes where it stopped.

    For example: bbfit lod tree.glb --out lod.glb

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: The file, ending in .glb.
        work: Folder for views, a run for each level, the levels' files and lod.png. Default: the file without its ending.
        seed: Seed of all stages; --views.seed and --fit.seed override it for one of them.
        lod: The levels.
        views: How the tree is rendered.
        fit: How the billboards are fitted. The preset decides options that are not given.
        export: How they are written.
        limits: What the tree and the views may refer to, and how large they may be.
    """
    from bbfit.lod import LEVELS, build_lod
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import lod_table

    stages = RunConfig(views=views, fit=fit, export=export, limits=limits)
    with progress() as on_progress:
        result = build_lod(tree, out, lod, stages, work=work, on_progress=on_progress)
    out_console.print(lod_table(result.levels))
    show_missing_encoder(export)
    out_console.print(
        f"levels of detail in {result.path}, {result.path.stat().st_size:,} bytes; one by one with lod.json in {result.folder / LEVELS}",
        soft_wrap=True,
    )
