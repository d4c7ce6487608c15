"""Levels of detail: the tree, and ever smaller billboard clouds of it, in one file, each shown from where its error does not show."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bbfit.blender.conversion import converted_once
from bbfit.blender.meshes import MESH_SUFFIXES
from bbfit.blender.sources import check_tree
from bbfit.blender.views_folder import render_views
from bbfit.checks import fail
from bbfit.evaluation.silhouettes import scale_within, worst_silhouette
from bbfit.exporting.config import LodConfig
from bbfit.exporting.lod import LodLevel, glb_counts, lod_glb, stands_alone
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.files import output_folder, write_bytes, write_json
from bbfit.fitting.initialize import pixels_a_meter
from bbfit.pipeline import Progress, RunConfig, RunResult, export_config, run
from bbfit.reporting.plots import lod_picture
from bbfit.views import ViewDataset


@dataclass(frozen=True)
class LodResult:
    """What :func:`build_lod` made."""

    path: Path
    """The GLB file."""
    folder: Path
    """Where views and runs lie, and what was measured as ``lod.json`` and ``lod.png``."""
    levels: tuple[LodLevel, ...]
    """The finest first."""


def build_lod(
    tree: str | Path,
    out: str | Path,
    config: LodConfig | None = None,
    stages: RunConfig | None = None,
    *,
    work: str | Path | None = None,
    on_progress: Progress | None = None,
) -> LodResult:
    """Render a tree, fit billboard clouds of several sizes, and write them and the tree as levels of detail in one GLB.

    Each level takes over at the distance from which on its error stays below ``config.error_pixels``. The error is that of its silhouette,
    in meters at the tree's axis, by the training view in which it is largest, and a margin for views between those; it shrinks with
    distance as everything does. No level is shown larger than the views that it was fitted to. Its textures are as fine as the screen can
    show from there. Where the exports' format of textures is left open it is auto: KTX2 with mip levels if its encoder is there, and PNG.

    Started again, it goes on where it stopped; what stands and has unchanged inputs is not done again.

    Parameters
    ----------
    tree : the tree's file, of any kind that :func:`~bbfit.blender.views_folder.render_views` takes.
    out : the GLB to write.
    stages : how views are rendered, and billboards fitted and exported; the number of billboards is the levels' to say.
    work : folder for views, one run a level (named by its planes), ``lod.json`` and ``lod.png``; left out, it is called as ``out`` is
        without its ending.
    on_progress : told how far each stage is; the stages of a level are called by its number of planes first.

    Raises
    ------
    InputError, OSError
        if an input cannot be used or something cannot be written; earlier results stay as they were.
    """
    config, stages = config or LodConfig(), stages or RunConfig()
    out = Path(out)
    if out.suffix.lower() != ".glb":
        fail("out", f"{out} ends in {out.suffix or 'nothing'}", "levels of detail stand in one .glb file")
    output_folder("out's folder", out.parent)
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "the levels have their own numbers of them", "leave out billboards and budgets, and say planes")
    files = check_tree(tree)
    folder = output_folder("work", work or out.with_suffix(""))
    tell = on_progress or (lambda stage, done, total, note="": None)
    views = ViewDataset.load(render_views(tree, folder / "views", stages.views, on_progress=lambda done, total: tell("views", done, total)))
    original = _original(files, folder, config, tell) if config.original else None
    mesh = files[0] if files[0].suffix.lower() in MESH_SUFFIXES else None
    runs = [_fitted(folder, replace(stages, tree=mesh), planes, tell) for planes in config.planes]

    export = export_config(views, stages.export)
    if export.textures is None:
        export = replace(export, textures="auto")  # from afar is where mip levels matter
    places = _places(views, runs, config)
    tell("join", 0, len(runs) + 1)
    models, shipped = [original.read_bytes()] if original else [], list[ShippedModel]()
    for number, (fitted, place) in enumerate(zip(runs, places, strict=True), 1):
        shipped.append(shipped_model(fitted.cloud, export, place.halvings))
        models.append(shipped[-1].glb)
        tell("join", number, len(runs) + 1)
    if original:
        places.insert(0, _Place(math.inf, 0.0, 0.0, 0))
    fits = [None] * (len(models) - len(runs)) + runs
    levels = _levels(views, models, fits, places, config, out.stem)
    write_bytes(out, lod_glb(models, levels))
    write_json(folder / "lod.json", {"config": asdict(config), "levels": [asdict(level) for level in levels]})
    lod_picture(list(zip(levels[-len(shipped) :], shipped, strict=True)), views.test, folder / "lod.png")
    tell("join", len(runs) + 1, len(runs) + 1)
    return LodResult(out, folder, levels)


@dataclass(frozen=True)
class _Place:
    """Where a level takes over."""

    scale: float
    """Pixels a meter on the screen below which it is shown; infinity for the finest level."""
    error: float
    """Meters by which its silhouette is off in the worst training view."""
    unseen: float
    """The same in the worst held-out view."""
    halvings: int
    """How often the sides of its textures can be halved and still have a texel for each pixel."""


def _fitted(folder: Path, stages: RunConfig, planes: int, tell: Progress) -> RunResult:
    def told(stage: str, done: int, total: int, note: str = "") -> None:
        tell(f"{planes} {stage}", done, total, note)

    stages = replace(stages, fit=replace(stages.fit, billboards=planes))
    return run(folder / "views", folder / str(planes), stages, on_progress=told)


def _original(files: list[Path], folder: Path, config: LodConfig, tell: Progress) -> Path:
    """The tree as a GLB that others can be joined to."""
    if config.triangles is None and stands_alone(files[0]):
        return files[0]
    begun = list[bool]()

    def on_begin() -> None:
        begun.append(True)
        tell("original", 0, 1)

    path = converted_once(files[0], folder / "original.glb", triangles=config.triangles, on_begin=on_begin)
    if begun:
        tell("original", 1, 1)
    return path


def _places(views: ViewDataset, runs: list[RunResult], config: LodConfig) -> list[_Place]:
    """Where billboard clouds take over; the first from the start if it is the finest level."""
    view_scale = float(pixels_a_meter(views.train.cameras))
    places = list[_Place]()
    for fitted in runs:
        error, unseen = (worst_silhouette(fitted.cloud, split) / view_scale for split in (views.train, views.test))
        scale = min([view_scale, scale_within(error, config.error_pixels), *(place.scale for place in places)])
        places.append(_Place(scale, error, unseen, max(0, math.floor(math.log2(fitted.cloud.texel_density / scale)))))
    if not config.original:
        places[0] = replace(places[0], scale=math.inf, halvings=0)
    return places


def _levels(
    views: ViewDataset, models: list[bytes], fits: list[RunResult | None], places: list[_Place], config: LodConfig, name: str
) -> tuple[LodLevel, ...]:
    """What is known of the levels."""
    view_scale = float(pixels_a_meter(views.train.cameras))
    low, high = views.request["tree"]["bounds"]
    height, radius = high[1] - low[1], math.dist(low, high) / 2
    focal = config.screen_height / 2 / math.tan(math.radians(config.screen_fov_degrees) / 2)
    until = [*(place.scale for place in places[1:]), 0.0]
    levels = list[LodLevel]()
    for model, fitted, place, least in zip(models, fits, places, until, strict=True):
        vertices, triangles = glb_counts(model)
        shown = min(place.scale, view_scale)
        levels.append(
            LodLevel(
                name=f"{name}_LOD{len(levels)}",
                planes=None if fitted is None else len(fitted.cloud),
                vertices=vertices,
                triangles=triangles,
                bytes=len(model),
                error_meters=place.error,
                error_pixels=place.error * shown,
                held_out_error_pixels=place.unseen * shown,
                psnr=None if fitted is None else fitted.report.mean.over_white.psnr,
                tree_pixels=None if math.isinf(place.scale) else height * place.scale,
                distance_meters=focal / place.scale,
                screen_coverage=min(1.0, math.pi * (radius * least) ** 2 / (config.screen_width * config.screen_height)),
            )
        )
    return tuple(levels)
