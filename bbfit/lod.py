"""Levels of detail: the tree and smaller and smaller billboard clouds of it in one file, each for distances that hide its error."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from bbfit.blender.requirements import check_blender
from bbfit.checks import check_output_file, check_record, fail
from bbfit.evaluation.color_error import mean_color_error, share_within
from bbfit.evaluation.silhouettes import scale_within, worst_silhouette
from bbfit.exporting.config import ExportConfig, LodConfig
from bbfit.exporting.lod import LodLevel, glb_counts, is_self_contained, lod_glb
from bbfit.exporting.lod_files import LOD_FILE, level_file, lod_document, program_file_names, program_files
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.files import read_json, write_bytes, write_json
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.inputs import reading
from bbfit.outputs import claimed_folder, output_folder, used_folder
from bbfit.pipeline import RunConfig, RunResult, needs_blender, run
from bbfit.provenance import digest_file
from bbfit.reporting.plots import lod_picture
from bbfit.stages.results import export_config
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage, views_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

ORIGINAL = "original.glb"
"""The file of the converted tree."""
LEVELS = "levels"
"""The folder of the levels' files and their description."""
# Profiles whose program loads no model with KTX2 textures, although there is a PNG beside them, unless it is given a decoder.
_WITHOUT_KTX2: frozenset[str | None] = frozenset({"playcanvas"})


@dataclass(frozen=True)
class LodResult:
    """The result of :func:`build_lod`."""

    path: Path
    """The GLB file."""
    folder: Path
    """The folder of the views, the runs, the picture ``lod.png``, and ``levels``: a file for each level, ``lod.json`` that describes them,
    and what the program of the profile needs to switch between them."""
    levels: tuple[LodLevel, ...]
    """The levels, finest first."""


def build_lod(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: LodConfig | None = None,
    stages: RunConfig | None = None,
    *,
    work: str | Path | None = None,
    on_progress: OnProgress | None = None,
) -> LodResult:
    """Render a tree, fit billboard clouds of several sizes, and write the tree and the clouds as levels of detail.

    They are written to one GLB, and to the folder ``levels`` with a file for each, for programs that do not read MSFT_lod.

    Each level replaces the next finer one at the distance from which its error stays below ``config.error_pixels``. The error is that of
    its silhouette in the worst training view, in meters at the tree's axis, with a margin for the views in between. In pixels, it is
    inversely proportional to the distance. The colors must look the same too: their mean error at the size on the screen
    (:func:`~bbfit.evaluation.color_error.mean_color_error`) is at most ``config.color_error`` in the training views. No level is shown
    larger than the views of its fit. The textures of a level have the resolution of the screen at its distance. The default format of
    textures is ``auto``: KTX2 with mip levels if its encoder is installed, and PNG; for PlayCanvas it is PNG.

    A killed build continues where it stopped. Stages with current results are skipped.

    Parameters
    ----------
    tree
        A tree in any format of :func:`~bbfit.blender.views_folder.render_views`.
    out
        The .glb file to write.
    config
        The levels, and the error and the screen that determine their distances.
    stages
        The options for rendering views and for fitting and exporting billboards. ``config.planes`` sets the numbers of billboards.
    work
        The folder for views, one run for each level (named by its number of planes), ``levels`` and ``lod.png``. The default is ``out``
        without its suffix.
    on_progress
        Called with the progress of each stage. The names of a level's stages start with its number of planes.

    Raises
    ------
    InputError, OSError
        If an input cannot be used or a file cannot be written. Earlier results stay as they were.
    """
    config, stages, on_progress = config or LodConfig(), stages or RunConfig(), on_progress or silent
    out = Path(out)
    if out.suffix.lower() != ".glb":
        fail("out", f"{out} ends in {out.suffix or 'nothing'}", "give a name that ends in .glb")
    check_output_file("out", out)
    check_unset(config, stages)
    tree, work = TreeFile.open(tree, stages.limits), Path(work or out.with_suffix(""))
    check_levels(config, stages, mesh=tree.is_mesh)
    if needs_blender(work):
        check_blender(stages.views)
    with used_folder("out's folder", out.parent), claimed_folder("work", work) as folder:
        return _built(tree, out, folder, config, stages, on_progress)


def check_unset(config: LodConfig, stages: RunConfig) -> None:
    """Require that options which the levels decide are left out. Raises ``InputError``."""
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "planes sets the number of billboards of each level", "omit billboards and budgets")
    if config.triangles is not None and not config.original:
        fail("triangles", f"{config.triangles} are requested of a tree that is no level", "leave out one of triangles and no-original")


def check_levels(config: LodConfig, stages: RunConfig, *, mesh: bool) -> None:
    """Require options that each level's run can use (:meth:`~bbfit.pipeline.RunConfig.check`); ``mesh`` says if the tree is a mesh."""
    for planes in config.planes:
        fit = replace(stages.fit, billboards=planes)
        replace(stages, fit=fit).check(mesh=mesh, rendered=True, blender=False)


def _built(tree: TreeFile, out: Path, folder: Path, config: LodConfig, stages: RunConfig, on_progress: OnProgress) -> LodResult:
    """The stages of :func:`build_lod` in a claimed folder. The options were checked."""
    record = Record(folder, inputs=[*tree.files, *([stages.views.hdri] if stages.views.hdri else [])])
    record.check({"join": _outputs(out, folder, config, stages.export)} | ({"convert": (ORIGINAL,)} if _converts(tree, config) else {}))
    output_folder("work", folder / LEVELS)
    record.run(views_stage(folder, tree, stages.views), on_progress)
    views = ViewDataset.load(folder / "views", limits=stages.limits)
    original = _original(record, tree, config, on_progress) if config.original else None
    stages = replace(stages, tree=tree.path if tree.is_mesh else None)
    runs = [_fitted(folder, stages, planes, on_progress) for planes in config.planes]
    export = export_config(views, stages.export)
    export = with_textures(export)
    record.run(_join_stage(folder, out, original, runs, views, config, export), on_progress)
    description = folder / LEVELS / LOD_FILE
    stored = read_json("levels of detail", description)
    with reading("levels of detail", description, "remove it, then start bbfit lod again"):
        levels = tuple(LodLevel(**level) for level in stored["levels"])
        check_record("levels", levels, tuple[LodLevel, ...])
    return LodResult(out, folder, levels)


def with_textures(export: ExportConfig) -> ExportConfig:
    """The options with the textures of levels of detail, unless they say otherwise: with mip levels, because distant levels need them."""
    if export.textures is not None:
        return export
    return replace(export, textures="png" if export.profile in _WITHOUT_KTX2 else "auto")


def _join_stage(
    folder: Path, out: Path, original: Path | None, runs: list[RunResult], views: ViewDataset, config: LodConfig, export: ExportConfig
) -> Stage:
    """Join the original (if it is a level) and the models of all runs to one file."""

    def work(on_progress: OnProgress) -> None:
        steps = 2 * len(runs) + 1
        on_progress("join", 0, steps)
        switches = _switches(views, runs, config, lambda done: on_progress("join", done, steps))
        models, shipped = [original.read_bytes()] if original else [], list[ShippedModel]()
        for number, (fitted, switch) in enumerate(zip(runs, switches, strict=True), 1 + len(runs)):
            shipped.append(shipped_model(fitted.cloud, export, switch.halvings))
            models.append(shipped[-1].glb)
            on_progress("join", number, steps)
        if original:
            switches.insert(0, _Switch())
        fits = [None] * (len(models) - len(runs)) + runs
        levels = _levels(views, models, fits, switches, config, out.stem)
        document = lod_document(out.stem, levels, config, _bounds(views))
        for level, model in zip(levels, models, strict=True):
            write_bytes(folder / LEVELS / level.file, model)
        for name, data in program_files(export.profile, document).items():
            write_bytes(folder / LEVELS / name, data)
        write_json(folder / LEVELS / LOD_FILE, document)
        write_bytes(out, lod_glb(models, levels, export.profile))
        lod_picture(list(zip(levels[-len(shipped) :], shipped, strict=True)), views.test, folder / "lod.png")
        on_progress("join", steps, steps)

    clouds = [digest_file(fitted.folder / name) for fitted in runs for name in ("cloud.safetensors", "metrics.json")]
    inputs = (original and digest_file(original), clouds, views.fingerprint, config, export.resolve(), out.stem)
    return Stage("join", inputs, _outputs(out, folder, config, export), work, algorithm="lod")


def _outputs(out: Path, folder: Path, config: LodConfig, export: ExportConfig) -> tuple[str, ...]:
    levels = [level_file(out.stem, number) for number in range(config.original + len(config.planes))]
    shipped = (LOD_FILE, *levels, *program_file_names(export.profile, out.stem))
    return ("lod.png", *(f"{LEVELS}/{name}" for name in shipped), os.path.relpath(out, folder))


@dataclass(frozen=True)
class _Switch:
    """The scale at which a level replaces the next finer one. The defaults are those of the tree itself."""

    scale: float = math.inf
    """The level is shown below this scale, in pixels per meter on the screen. Infinity for the finest level."""
    silhouette_scale: float = math.inf
    """The scale below which the error of its silhouette is within the bound."""
    color_scale: float = math.inf
    """The scale below which the error of its colors is."""
    errors: tuple[float, float] = (0.0, 0.0)
    """The error of its silhouette in the worst training view and in the worst held-out view, in meters."""
    color_errors: tuple[float, float] = (0.0, 0.0)
    """The mean error of its colors at ``scale`` in the training views and in the held-out views."""
    halvings: int = 0
    """How many times its textures can be halved and still have a texel for each pixel at that scale."""


def _fitted(folder: Path, stages: RunConfig, planes: int, on_progress: OnProgress) -> RunResult:
    def report(stage: str, done: int, total: int, note: str = "") -> None:
        on_progress(f"{planes} {stage}", done, total, note)

    stages = replace(stages, fit=replace(stages.fit, billboards=planes))
    return run(folder / "views", folder / str(planes), stages, on_progress=report)


def _original(record: Record, tree: TreeFile, config: LodConfig, on_progress: OnProgress) -> Path:
    """The tree as a GLB that others can be joined to."""
    if not _converts(tree, config):
        return tree.path
    record.run(convert_stage(record.folder, tree, ORIGINAL, triangles=config.triangles), on_progress)
    return record.folder / ORIGINAL


def _converts(tree: TreeFile, config: LodConfig) -> bool:
    """Whether the finest level is a converted tree."""
    return config.original and not (config.triangles is None and is_self_contained(tree.path))


def _switches(views: ViewDataset, runs: list[RunResult], config: LodConfig, on_level: Callable[[int], None]) -> list[_Switch]:
    """The switch of each run. The first one has an infinite scale if it is the finest level."""
    view_scale = float(pixels_per_meter(views.train.cameras))
    switches, splits = list[_Switch](), (views.train, views.test)
    for fitted in runs:
        draw = shipped_model(fitted.cloud).draw
        error, held_out_error = (worst_silhouette(fitted.cloud, split) / view_scale for split in splits)
        silhouette = scale_within(error, config.error_pixels)
        color = view_scale * share_within(draw, views.train, config.color_error)
        scale = min([view_scale, silhouette, color, *(switch.scale for switch in switches)])
        colors, held_out_colors = (mean_color_error(draw, split, scale / view_scale) for split in splits)
        halvings = max(0, math.floor(math.log2(fitted.cloud.texel_density / scale)))
        switches.append(_Switch(scale, silhouette, color, (error, held_out_error), (colors, held_out_colors), halvings))
        on_level(len(switches))
    if not config.original:
        switches[0] = replace(switches[0], scale=math.inf, halvings=0)
    return switches


def _bounds(views: ViewDataset) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The tree's lowest and highest corner in meters."""
    assert views.request and views.request.tree.bounds
    return views.request.tree.bounds


def _levels(
    views: ViewDataset, models: list[bytes], fits: list[RunResult | None], switches: list[_Switch], config: LodConfig, name: str
) -> tuple[LodLevel, ...]:
    """The measurements of the levels."""
    view_scale = float(pixels_per_meter(views.train.cameras))
    low, high = _bounds(views)
    height, radius = high[1] - low[1], math.dist(low, high) / 2
    focal = config.screen_height / 2 / math.tan(math.radians(config.screen_fov_degrees) / 2)
    next_scales = [*(switch.scale for switch in switches[1:]), 0.0]
    levels = list[LodLevel]()
    for model, fitted, switch, next_scale in zip(models, fits, switches, next_scales, strict=True):
        vertices, triangles = glb_counts(model)
        largest_scale = min(switch.scale, view_scale)
        levels.append(
            LodLevel(
                name=f"{name}_LOD{len(levels)}",
                planes=None if fitted is None else len(fitted.cloud),
                vertices=vertices,
                triangles=triangles,
                bytes=len(model),
                error_meters=switch.errors[0],
                error_pixels=switch.errors[0] * largest_scale,
                held_out_error_pixels=switch.errors[1] * largest_scale,
                psnr=None if fitted is None else fitted.report.mean.over.mean.psnr,
                tree_pixels=None if math.isinf(switch.scale) else height * switch.scale,
                distance_meters=focal / switch.scale,
                screen_coverage=min(1.0, math.pi * (radius * next_scale) ** 2 / (config.screen_width * config.screen_height)),
                file=level_file(name, len(levels)),
                silhouette_distance_meters=focal / switch.silhouette_scale,
                color_distance_meters=focal / switch.color_scale,
                color_error=switch.color_errors[0],
                held_out_color_error=switch.color_errors[1],
                halvings=switch.halvings,
            )
        )
    return tuple(levels)
