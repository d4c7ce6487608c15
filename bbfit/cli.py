"""The command line: parse, call, print, exit code; nothing else.

Exit codes: 0 done, 2 bad input, 1 a failure of ours, 130 stopped from the keyboard.
"""

from __future__ import annotations

import contextlib
import functools
import io
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from bbfit.blender.config import ViewsConfig
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError, fail
from bbfit.exporting.config import ExportConfig, LodConfig
from bbfit.fitting.config import FitConfig
from bbfit.sweep.config import SweepConfig
from bbfit.trees.config import GrowConfig

if TYPE_CHECKING:
    from bbfit.pipeline import Progress, RunResult

_out, _err = Console(), Console(stderr=True)


def _run(
    tree: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TREE]")] = None,
    /,
    out: Path = Path("runs/tree"),
    species: str | None = None,
    grow: Annotated[GrowConfig, tyro.conf.arg(name="")] = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    budget: BudgetConfig = BudgetConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Do everything: grow a tree or take yours, render it, fit billboards to the views, write the models, score them on held-out views.

    Killed and started again, it goes on where it stopped. What stands and has unchanged inputs is not done again.

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend) or a folder of views; left out, one is grown.
        out: Folder for the results.
        species: What to grow, a quaking aspen if left out; `bbfit grow --list` names them.
        grow: How a tree is grown.
        views: How the tree is rendered.
        fit: How the billboards are fitted.
        budget: What the result may cost; chooses what the fit leaves open, with short fits first.
        export: How the models are written.
    """
    from bbfit.pipeline import RunConfig, run

    config = RunConfig(species=species, grow=grow, views=views, fit=fit, budget=budget, export=export)
    with _progress() as tell:
        result = run(tree, out, config, on_progress=tell)
    _show(result)
    _show_missed(export)


def _grow(
    species: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SPECIES]")] = None,
    /,
    out: Path | None = None,
    list: tyro.conf.FlagCreatePairsOff[bool] = False,
    config: Annotated[GrowConfig, tyro.conf.arg(name="")] = GrowConfig(),  # noqa: B008
) -> None:
    """Grow a tree of a species, after Weber and Penn 1995. The same seed gives the same file.

    Args:
        species: What to grow; may be left out where --species-file holds one species only.
        out: The tree's file, ending in .glb, or in .obj (its .mtl comes beside it).
        list: Name the species and where their figures are, and grow nothing.
        config: How it is grown.
    """
    from bbfit.model_files import check_model_path
    from bbfit.trees.growth import grow
    from bbfit.trees.species import figures_file, known_species, load_species

    if list:
        from bbfit.reporting.tables import species_table

        _out.print(species_table([load_species(name, config.species_file) for name in known_species(config.species_file)]))
        _out.print(f"figures in {config.species_file or figures_file()}", soft_wrap=True, highlight=False)
        return
    from bbfit.trees.tree_file import write_tree

    figures = load_species(species, config.species_file)
    if out is None:
        fail("out", "no file is named to write the tree to", f"say for example --out {figures.name}.glb")
    check_model_path("tree", out)
    scene = grow(figures, seed=config.seed, detail=config.detail, leaves=config.leaves, max_vertices=config.max_vertices)
    paths = write_tree(scene, out)
    _out.print(f"{figures.name}: {sum(len(mesh.vertices) for mesh in scene.geometry.values()):,} vertices")
    for path in paths:
        _out.print(f"{path}  {path.stat().st_size:,} bytes", soft_wrap=True)


def _views(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path,
    config: Annotated[ViewsConfig, tyro.conf.arg(name="")] = ViewsConfig(),  # noqa: B008
) -> None:
    """Render views of a tree with Blender, in the NeRF-synthetic layout.

    Args:
        tree: The tree's file (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: Folder for the views; one that holds a part of them is completed.
        config: How the tree is rendered.
    """
    from bbfit.blender.views_folder import render_views

    with _progress() as tell:
        render_views(tree, out, config, on_progress=lambda done, total: tell("views", done, total))
    _out.print(f"{config.count} views in {out}")


def _fit(
    views: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIEWS")],
    /,
    out: Path,
    tree: Path | None = None,
    config: Annotated[FitConfig, tyro.conf.arg(name="")] = FitConfig(),  # noqa: B008
    budget: Annotated[BudgetConfig, tyro.conf.arg(name="")] = BudgetConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Fit billboards to a folder of views, write the models and the score on held-out views.

    Args:
        views: Folder of views, bbfit's own or any in the NeRF-synthetic layout.
        out: Folder for the results.
        tree: The mesh that the views show (.glb .gltf .obj .ply .stl), to place billboards by; without it the views tell where the tree is.
        config: How the billboards are fitted.
        budget: What the result may cost; chooses what is left open, with short fits first.
        export: How the models are written.
    """
    from bbfit.checks import check_folder
    from bbfit.pipeline import RunConfig, run

    check_folder("views", views)
    with _progress() as tell:
        result = run(views, out, RunConfig(tree=tree, fit=config, budget=budget, export=export), on_progress=tell)
    _show(result)
    _show_missed(export)


def _evaluate(
    cloud: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLOUD")],
    views: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIEWS")],
    /,
    out: Path | None = None,
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Score a billboard cloud on the held-out views of a folder.

    Args:
        cloud: A .safetensors file written by bbfit fit.
        views: Folder of views.
        out: File for the measures as JSON; left out, metrics.json beside the cloud, which replaces the one of its run.
        export: How the model was written, if not as the cloud was fitted: the score is of what the model shows.
    """
    from bbfit.evaluation.report import Report
    from bbfit.evaluation.scoring import evaluate
    from bbfit.exporting.model import as_shipped, shipped_cards
    from bbfit.files import output_folder
    from bbfit.geometry.cloud import BillboardCloud
    from bbfit.pipeline import original_tree, with_model
    from bbfit.reporting.tables import report_table
    from bbfit.views import ViewDataset

    billboards, dataset = BillboardCloud.load(cloud), ViewDataset.load(views)
    out, earlier = out or cloud.with_name("metrics.json"), cloud.with_name("metrics.json")
    output_folder("out", out.parent)
    with _progress() as tell:
        shipped = as_shipped(billboards, export)
        report = evaluate(
            shipped,
            dataset.test,
            original=original_tree(dataset),
            model_bytes=model.stat().st_size if (model := cloud.with_name("model.glb")).is_file() else None,
            seconds=Report.load(earlier).seconds if earlier.is_file() else None,
            on_view=lambda done, total: tell("evaluate", done, total),
        )
        cards = shipped_cards(billboards, export)
        report = with_model(report, shipped, cards, dataset.test, on_size=lambda done, total: tell("sizes", done, total))
    report.save(out)
    _out.print(report_table(report))
    _out.print(f"measures in {out}", soft_wrap=True)


def _export(
    cloud: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLOUD")],
    /,
    out: Path,
    config: Annotated[ExportConfig, tyro.conf.arg(name="")] = ExportConfig(),  # noqa: B008
) -> None:
    """Write a billboard cloud as a model that other programs open.

    Args:
        cloud: A .safetensors file written by bbfit fit.
        out: The model's file, ending in .glb, or in .obj (its .mtl and .png come beside it).
        config: How the model is written.
    """
    from bbfit.exporting.model import export
    from bbfit.geometry.cloud import BillboardCloud

    for path in export(BillboardCloud.load(cloud), out, config):
        _out.print(f"{path}  {path.stat().st_size:,} bytes")
    _show_missed(config)


def _lod(
    tree: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TREE")],
    /,
    out: Path,
    work: Path | None = None,
    config: Annotated[LodConfig, tyro.conf.arg(name="")] = LodConfig(),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Make levels of detail: the tree and ever fewer billboards in one GLB, each shown from where its error does not show.

    Killed and started again, it goes on where it stopped.

    Args:
        tree: A tree (.glb .gltf .obj .ply .stl .fbx .usd .usda .usdc .usdz .blend).
        out: The file, ending in .glb.
        work: Folder for views, a run for each level, lod.json and lod.png; left out, it is called as the file is without its ending.
        config: Which levels there are.
        views: How the tree is rendered.
        fit: How the billboards are fitted.
        export: How they are written.
    """
    from bbfit.lod import build_lod
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import lod_table

    with _progress() as tell:
        result = build_lod(tree, out, config, RunConfig(views=views, fit=fit, export=export), work=work, on_progress=tell)
    _out.print(lod_table(result.levels))
    _show_missed(export)
    _out.print(f"levels of detail in {result.path}, {result.path.stat().st_size:,} bytes; measures in {result.folder}", soft_wrap=True)


def _sweep(
    out: Path,
    species: tuple[str, ...] = (),
    trees: tuple[Path, ...] = (),
    folders: Annotated[tuple[Path, ...], tyro.conf.arg(name="views")] = (),
    config: Annotated[SweepConfig, tyro.conf.arg(name="")] = SweepConfig(),  # noqa: B008
    grow: Annotated[GrowConfig, tyro.conf.arg(name="")] = GrowConfig(detail=0.5),  # noqa: B008
    views: ViewsConfig = ViewsConfig(),  # noqa: B008
    fit: FitConfig = FitConfig(),  # noqa: B008
    export: ExportConfig = ExportConfig(),  # noqa: B008
) -> None:
    """Fit a grid of configurations to many trees, on this machine or on a Ray cluster, and compare them: the thesis's 72 experiments if
    nothing else is said.

    Killed and started again, it goes on where it stopped; every run is made once.

    Args:
        out: Folder for trees, runs and the tables table.csv, table.md and table.png.
        species: Species to grow; `bbfit grow --list` names them.
        trees: Tree files to render.
        folders: Folders of views.
        config: What is varied, and what it runs on.
        grow: How trees are grown.
        views: How trees are rendered.
        fit: What all runs have in common besides what the grid says.
        export: How the models are written.
    """
    from bbfit.pipeline import RunConfig
    from bbfit.reporting.tables import sweep_table
    from bbfit.sweep.scheduling import run_sweep

    stages = RunConfig(grow=grow, views=views, fit=fit, export=export)
    with _progress() as tell:
        result = run_sweep(out, config, stages, species=species, trees=trees, views=folders, on_progress=tell)
    _out.print(sweep_table(result.rows))
    failed = sum(row.reason is not None for row in result.rows)
    if result.kept:
        _out.print(f"{result.kept} results stood from an earlier start", style="dim")
    if failed:
        _out.print(f"{failed} runs failed; table.md says why, and --retry-failed tries them again", style="yellow")
    _out.print(f"tables in {result.folder}: table.csv, table.md, table.png", soft_wrap=True)


def _later(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """The same command line, but parsing it only returns what to do."""

    @functools.wraps(command)
    def bind(*args: Any, **options: Any) -> Callable[[], None]:
        return functools.partial(command, *args, **options)

    return bind


_COMMANDS: dict[str, Callable[..., Any]] = {
    "run": _later(_run),
    "grow": _later(_grow),
    "views": _later(_views),
    "fit": _later(_fit),
    "evaluate": _later(_evaluate),
    "export": _later(_export),
    "lod": _later(_lod),
    "sweep": _later(_sweep),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    if list(sys.argv[1:] if args is None else args) == ["--version"]:
        _out.print(f"bbfit {version('bbfit')}", highlight=False)
        return 0
    try:
        _parse(args)()
    except BrokenPipeError:  # the reader of our output, such as head, has seen enough
        sys.stdout = None
        return 0
    except (InputError, OSError) as error:
        _err.print(f"bbfit: {error}", style="red", highlight=False, soft_wrap=True, markup=False)
        return 2
    except KeyboardInterrupt:
        _err.print("bbfit: stopped; the same command goes on from here")
        return 130
    return 0


def _parse(args: Sequence[str] | None) -> Callable[[], None]:
    """What the arguments ask for; bad values raise :class:`InputError`, unknown options end the process with exit code 2."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                prog="bbfit",
                description="Compress a 3D tree into a handful of textured planes that look like it from every side.",
                args=args,
            )
    except SystemExit as ending:
        error: BaseException | None = ending
        while error is not None and not isinstance(error, InputError):
            error = error.__cause__ or error.__context__
        if error is not None:
            raise error from None
        sys.stderr.write(complaint.getvalue())
        raise


def _show(result: RunResult) -> None:
    from bbfit.reporting.tables import report_table

    _out.print(report_table(result.report))
    if result.skipped:
        _out.print(f"unchanged, not done again: {', '.join(result.skipped)}", style="dim")
    if result.missed is not None:
        _out.print(
            f"no short fit within the budget reached {result.missed:g} dB on validation views; this is the best one, fitted for longer",
            style="yellow",
        )
    _out.print(
        f"results in {result.folder}: comparison.png, model.glb, model.obj, metrics.json, cloud.safetensors, loss.png", soft_wrap=True
    )


def _show_missed(config: ExportConfig) -> None:
    if config.missed is not None:
        _out.print(f"textures are PNG alone, without mip levels; for KTX2 {config.missed}", style="yellow", soft_wrap=True)


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    """One bar a stage, with rate and time left, on standard error."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with Progress(
        TextColumn("{task.description:9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:>10}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=_err,
    ) as bars:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, rate="", note="", completed=done - 1)
            speed = bars.tasks[list(tasks).index(stage)].speed
            bars.update(tasks[stage], completed=done, total=total, note=note, rate="" if speed is None else f"{speed:.1f}/s")

        yield tell


if __name__ == "__main__":
    sys.exit(main())
