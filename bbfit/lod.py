"""Levels of detail: the tree and smaller and smaller billboard clouds of it in one file, each for distances that hide its error."""

from __future__ import annotations

import glob
import logging
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from bbfit.blender.requirements import check_blender
from bbfit.checks import check_folder, check_output_file, fail
from bbfit.evaluation.scoring import views_psnr
from bbfit.evaluation.switching import Candidate, DrawingCost, Switch, cloud_candidate, mesh_cost, switches
from bbfit.exporting.config import ExportConfig, LodConfig, Outline, Profile, check_no_mip_files
from bbfit.exporting.lod import LodLevel, glb_counts, is_self_contained, lod_glb
from bbfit.exporting.lod_files import LOD_FILE, level_file, lod_document, program_file_names, program_files, read_levels
from bbfit.exporting.model import shipped_model
from bbfit.files import write_bytes, write_json
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Camera, focal_pixels
from bbfit.inputs import InputLimits
from bbfit.outputs import claimed_folder, output_folder, used_folder
from bbfit.pipeline import RunConfig, RunResult, needs_blender, run
from bbfit.provenance import digest_file
from bbfit.reporting.frame_tables import FRAMES_FILE, read_costs
from bbfit.reporting.plots import lod_picture
from bbfit.rivals.baking import tree_triangles
from bbfit.stages.results import export_config
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage, pictures_stage, views_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

Levels = TypeVar("Levels", bound=LodConfig)

ORIGINAL = "original.glb"
"""The file of the converted tree."""
LEVELS = "levels"
"""The folder of the levels' files and their description."""
# Profiles whose program loads no model with KTX2 textures, although there is a PNG beside them, unless it is given a decoder.
_WITHOUT_KTX2: frozenset[str | None] = frozenset({"playcanvas"})
# How the names of the programs that bbfit frames measures begin.
_MEASURED: dict[str | None, str] = {"three": "three.js", "babylon": "Babylon.js"}
_log = logging.getLogger(__name__)


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
    larger than the views of its fit. With ``config.fragments_per_triangle`` it must also draw faster there
    (:mod:`bbfit.evaluation.switching`). The textures of a level have the resolution of the screen at its distance. The default format of
    textures is ``auto``: KTX2 with mip levels if its encoder is installed, and PNG; for PlayCanvas it is PNG.

    A killed build continues where it stopped. Stages with current results are skipped.

    Parameters
    ----------
    tree
        A tree in any format of :func:`~bbfit.blender.views_folder.render_views`.
    out
        The .glb file to write.
    config
        The levels, and the error, the screen and the times that determine their distances.
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
    stages, on_progress = stages or RunConfig(), on_progress or silent
    config, out = with_measured_speed(config or LodConfig(), stages.export.profile), Path(out)
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


def with_measured_speed(config: Levels, profile: Profile | None) -> Levels:
    """The options with the number that ``config.frames`` measured for a profile. Raises ``InputError`` if there is none."""
    if config.frames is None:
        return config
    path = check_folder("frames", config.frames) / FRAMES_FILE
    known = {cost.program: cost.fragments_per_triangle for cost in read_costs(path) if cost.fragments_per_triangle is not None}
    if not known:
        fail("frames", f"{path} has no program's time of a triangle and of a fragment", "measure more fields, or give the number")
    own = [program for program in known if program.startswith(_MEASURED.get(profile, " "))]
    program = (own or list(known))[0]
    _log.info("a triangle takes as long as %.2g fragments in %s", known[program], program)
    return replace(config, frames=None, fragments_per_triangle=known[program])


def check_unset(config: LodConfig, stages: RunConfig) -> None:
    """Require that options which the levels decide are left out. Raises ``InputError``."""
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "planes sets the number of billboards of each level", "omit billboards and budgets")
    check_no_mip_files(stages.export)
    if config.triangles is not None and not config.original:
        fail("triangles", f"{config.triangles} are requested of a tree that is no level", "leave out one of triangles and no-original")


def check_levels(config: LodConfig, stages: RunConfig, *, mesh: bool) -> None:
    """Require options that each level's run can use (:meth:`~bbfit.pipeline.RunConfig.check`); ``mesh`` says if the tree is a mesh."""
    for planes in config.planes:
        fit = replace(stages.fit, billboards=planes)
        replace(stages, fit=fit).check(mesh=mesh, rendered=True, blender=False)


def _built(tree: TreeFile, out: Path, folder: Path, config: LodConfig, stages: RunConfig, on_progress: OnProgress) -> LodResult:
    """The stages of :func:`build_lod` in a claimed folder. The options were checked."""
    record = Record(folder, inputs=[*tree.files, stages.views.hdri])
    converted = {"convert": (ORIGINAL,)} if _converts(tree, config) else {}
    thinned = {f"thin {count}": (thinned_file(count),) for count in config.thinned}
    record.check({"join": _outputs(out, folder, stages.export)} | converted | thinned)
    output_folder("work", folder / LEVELS)
    record.run(views_stage(folder, tree, stages.views), on_progress)
    views = ViewDataset.load(folder / "views", limits=stages.limits)
    export = with_textures(export_config(views, stages.outlined))
    original = _original(record, tree, config, export, on_progress) if config.original else None
    meshes = [_thinned(record, tree, count, views, stages, export, on_progress) for count in _smaller(config, views)]
    stages = replace(stages, tree=tree.path if tree.is_mesh else None)
    runs = [_fitted(folder, stages, planes, on_progress) for planes in config.planes]
    record.run(_join_stage(folder, out, original, [*meshes, *runs], views, config, export, stages.limits), on_progress)
    return LodResult(out, folder, read_levels(folder / LEVELS).levels)


def with_textures(export: ExportConfig) -> ExportConfig:
    """The options with the textures of levels of detail, unless they say otherwise: with mip levels, because distant levels need them."""
    if export.textures is not None:
        return export
    return replace(export, textures="png" if export.profile in _WITHOUT_KTX2 else "auto")


def _join_stage(
    folder: Path,
    out: Path,
    original: Path | None,
    made: list[_Thinned | RunResult],
    views: ViewDataset,
    config: LodConfig,
    export: ExportConfig,
    limits: InputLimits,
) -> Stage:
    """Join the original (if it is a level) and the other models, finest first, to one file."""

    def work(on_progress: OnProgress) -> None:
        steps = 2 * len(made) + 1
        on_progress("join", 0, steps)
        candidates = [
            Candidate(each.draw, partial(_mesh_costs, TreeFile.open(each.file, limits), views.train))
            if isinstance(each, _Thinned)
            else cloud_candidate(each.cloud, views.train, export)
            for each in made
        ]
        tree = (
            mesh_cost(tree_triangles(TreeFile.open(original, limits)), views.train)
            if original and config.fragments_per_triangle is not None
            else None
        )
        found = switches(candidates, views, config, tree=tree, on_level=lambda done: on_progress("join", done, steps))
        models = [_Model(original.read_bytes(), None, Switch(cost=tree))] if original else []
        for number, (each, switch) in enumerate(zip(made, found, strict=True), 1 + len(made)):
            if switch:
                models.append(_model(each, switch, export, views))
            on_progress("join", number, steps)
        levels = _levels(views, models, config, out.stem)
        document = lod_document(out.stem, levels, config, _bounds(views))
        for file in (folder / LEVELS).glob(level_file(glob.escape(out.stem), "*")):  # of an earlier build with more levels
            file.unlink()
        for level, model in zip(levels, models, strict=True):
            write_bytes(folder / LEVELS / level.file, model.glb)
        for name, data in program_files(export.profile, document).items():
            write_bytes(folder / LEVELS / name, data)
        write_json(folder / LEVELS / LOD_FILE, document)
        write_bytes(out, lod_glb([model.glb for model in models], levels, export.profile))
        drawn = [(level, model.draw) for level, model in zip(levels, models, strict=True) if model.draw]
        lod_picture(drawn, views.test, folder / "lod.png")
        on_progress("join", steps, steps)

    files = [each.file if isinstance(each, _Thinned) else each.folder / "cloud.safetensors" for each in made]
    scores = [each.folder / "metrics.json" for each in made if not isinstance(each, _Thinned)]
    digests = [digest_file(file) for file in (*files, *scores)]
    inputs = (original and digest_file(original), digests, views.fingerprint, config, export.key, out.stem)
    return Stage("join", inputs, _outputs(out, folder, export), work, algorithm="lod")


@dataclass(frozen=True)
class _Thinned:
    """A tree that was thinned out, with the pictures that Blender made of it."""

    file: Path
    train: ViewSet
    test: ViewSet

    def draw(self, camera: Camera) -> Tensor:
        return ViewSet.joined([self.train, self.test]).draw(camera)


@dataclass(frozen=True)
class _Model:
    """The model of a level."""

    glb: bytes
    planes: int | None
    switch: Switch
    psnr: float | None = None
    draw: Callable[[Camera], Tensor] | None = None
    requested: int | None = None


def _model(made: _Thinned | RunResult, switch: Switch, export: ExportConfig, views: ViewDataset) -> _Model:
    if isinstance(made, _Thinned):
        return _Model(made.file.read_bytes(), None, switch, views_psnr(made.draw, views.test), made.draw)
    own = export if switch.outline is None else replace(export, outline=switch.outline)
    shipped = shipped_model(made.cloud, own, switch.halvings)
    return _Model(shipped.glb, len(made.cloud), switch, made.report.mean.over.mean.psnr, shipped.draw, int(made.folder.name))


def _mesh_costs(file: TreeFile, views: ViewSet) -> dict[Outline | None, DrawingCost]:
    return {None: mesh_cost(tree_triangles(file), views)}


def _outputs(out: Path, folder: Path, export: ExportConfig) -> tuple[str, ...]:
    levels = level_file(glob.escape(out.stem), "*")
    shipped = (LOD_FILE, levels, *program_file_names(export.profile, out.stem))
    return ("lod.png", *(f"{LEVELS}/{name}" for name in shipped), os.path.relpath(out, folder))


def _fitted(folder: Path, stages: RunConfig, planes: int, on_progress: OnProgress) -> RunResult:
    def report(stage: str, done: int, total: int, note: str = "") -> None:
        on_progress(f"{planes} {stage}", done, total, note)

    stages = replace(stages, fit=replace(stages.fit, billboards=planes))
    return run(folder / "views", folder / str(planes), stages, on_progress=report)


def _original(record: Record, tree: TreeFile, config: LodConfig, export: ExportConfig, on_progress: OnProgress) -> Path:
    """The tree as a GLB that others can be joined to."""
    if not _converts(tree, config):
        return tree.path
    quantized = export.resolve().quantized
    record.run(convert_stage(record.folder, tree, ORIGINAL, triangles=config.triangles, quantized=quantized), on_progress)
    return record.folder / ORIGINAL


def _thinned(
    record: Record, tree: TreeFile, count: int, views: ViewDataset, stages: RunConfig, export: ExportConfig, on_progress: OnProgress
) -> _Thinned:
    """The tree with at most ``count`` triangles, and its pictures."""
    file, quantized = record.folder / thinned_file(count), export.resolve().quantized
    record.run(convert_stage(record.folder, tree, file.name, triangles=count, quantized=quantized, stage=f"thin {count}"), on_progress)
    stage, train, test = pictures_stage(record.folder, file, views, stages.views, stage=f"render {count}")
    record.run(stage, on_progress)
    return _Thinned(file, train, test)


def _smaller(config: LodConfig, views: ViewDataset) -> list[int]:
    """The numbers of triangles of thinned-out levels. One that the tree does not exceed stands for the tree, unless that is a level too."""
    faces = (views.request and views.request.tree.faces) or math.inf
    larger = sum(count >= faces for count in config.thinned)
    same = larger if config.original else max(0, larger - 1)
    if same:
        _log.warning("the tree has %s triangles; no level has %s", f"{faces:,}", " or ".join(map(str, config.thinned[:same])))
    return [*config.thinned[same:]]


def thinned_file(count: int | str) -> str:
    """The file of a tree that was thinned out to a number of triangles."""
    return f"thinned_{count}.glb"


def _converts(tree: TreeFile, config: LodConfig) -> bool:
    """Whether the finest level is a converted tree."""
    return config.original and not (config.triangles is None and is_self_contained(tree.path))


def _bounds(views: ViewDataset) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The tree's lowest and highest corner in meters."""
    assert views.request and views.request.tree.bounds
    return views.request.tree.bounds


def _levels(views: ViewDataset, models: list[_Model], config: LodConfig, name: str) -> tuple[LodLevel, ...]:
    """The measurements of the levels."""
    view_scale = float(pixels_per_meter(views.train.cameras))
    low, high = _bounds(views)
    height, radius = high[1] - low[1], math.dist(low, high) / 2
    focal = focal_pixels(config.screen_height, config.screen_fov_degrees)
    next_scales = [*(model.switch.scale for model in models[1:]), 0.0]
    levels = list[LodLevel]()
    for model, next_scale in zip(models, next_scales, strict=True):
        (vertices, triangles), switch = glb_counts(model.glb), model.switch
        largest_scale = min(switch.scale, view_scale)
        levels.append(
            LodLevel(
                name=f"{name}_LOD{len(levels)}",
                planes=model.planes,
                vertices=vertices,
                triangles=triangles,
                bytes=len(model.glb),
                error_meters=switch.errors[0],
                error_pixels=switch.errors[0] * largest_scale,
                held_out_error_pixels=switch.errors[1] * largest_scale,
                psnr=model.psnr,
                tree_pixels=None if math.isinf(switch.scale) else height * switch.scale,
                distance_meters=focal / switch.scale,
                screen_coverage=min(1.0, math.pi * (radius * next_scale) ** 2 / (config.screen_width * config.screen_height)),
                file=level_file(name, len(levels)),
                silhouette_distance_meters=focal / switch.silhouette_scale,
                color_distance_meters=focal / switch.color_scale,
                color_error=switch.color_errors[0],
                held_out_color_error=switch.color_errors[1],
                requested=model.requested,
                halvings=switch.halvings,
                outline=switch.outline,
                speed_distance_meters=focal / switch.faster_scale,
                fragments=None if switch.cost is None else switch.cost.fragments * largest_scale**2,
            )
        )
    return tuple(levels)
