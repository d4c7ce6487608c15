"""Frame times of fields of trees in programs of a browser."""

from __future__ import annotations

import logging
import math
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from bbfit.blender.config import ViewsConfig
from bbfit.blender.fields import render_field
from bbfit.blender.processes import require_bpy
from bbfit.checks import check_record, fail
from bbfit.exporting.lod import glb_counts
from bbfit.files import read_json, write_bytes, write_json
from bbfit.frames.browser import FieldPage, open_pages
from bbfit.frames.config import FramesConfig, Program
from bbfit.frames.costs import frame_costs
from bbfit.frames.errors import SizeError, size_error
from bbfit.frames.fields import Bounds, planted
from bbfit.frames.models import DrawnModel, drawn_models
from bbfit.inputs import InputLimits, reading
from bbfit.outputs import claimed_folder, output_folder
from bbfit.provenance import digest_file, installed_version
from bbfit.reporting.frame_tables import FRAMES_FILE, FrameCosts, FrameRow, Machine, frames_csv, frames_json, frames_markdown, frames_plot
from bbfit.scratch import ScratchFolder
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

ORIGINAL = "original"
"""The name of the tree itself among the models."""
_TABLES = ("frames.csv", FRAMES_FILE, "frames.md", "frames.png")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FramesResult:
    """The results of a measurement."""

    folder: Path
    """The folder with the tables and the picture."""
    rows: tuple[FrameRow, ...]
    """One row for each field that was drawn."""
    costs: tuple[FrameCosts, ...]
    """What the frames of each program take time for (:func:`~bbfit.frames.costs.frame_costs`)."""
    machine: Machine


def measure_frames(
    sources: Sequence[str | Path],
    out: str | Path,
    config: FramesConfig | None = None,
    *,
    tree: str | Path | TreeFile | None = None,
    limits: InputLimits | None = None,
    on_progress: OnProgress | None = None,
) -> FramesResult:
    """Draw fields of trees in a browser, and measure the time of a frame, what it draws, and how far it is from the tree.

    In a field all trees are in the picture, at one size, and are turned at random. Each frame sorts them from front to back, or blended
    ones from back to front. It ends when a pixel of it was read back. Writes ``frames.csv``, ``frames.json``, ``frames.md`` and
    ``frames.png``. A killed measurement continues where it stopped.

    Parameters
    ----------
    sources
        Folders of ``bbfit run``, ``compare`` and ``lod``, and GLB files, all of one tree.
    out
        The folder for the results.
    config
        The fields and the programs. Babylon.js draws neither levels of detail nor impostors.
    tree
        The tree itself, which is drawn too, in any format.
    limits
        What the inputs may be.
    on_progress
        Called with the number of finished fields.

    Raises
    ------
    MissingFileError, InputError, OSError
        If a source cannot be read, the browser, playwright or a program is not installed, or the folder cannot be written to.
    """
    config, limits, on_progress = config or FramesConfig(), limits or InputLimits(), on_progress or silent
    models, views = drawn_models(sources, limits)
    tree = None if tree is None else TreeFile.open(tree, limits)
    if "cycles" in config.programs:
        require_bpy()
    if ORIGINAL in [model.name for model in models]:
        fail("sources", f"{ORIGINAL} is the name of the tree itself", "rename the file")
    with claimed_folder("out", out) as folder, open_pages(config) as pages:
        record = Record(folder, inputs=[*(file for model in models for file in model.files), *(tree.files if tree else ())])
        record.check({"tables": _TABLES} | ({"convert": (f"{ORIGINAL}.glb",)} if tree else {}))
        if tree is not None:
            models = [_original(record, tree, on_progress), *models]
        output_folder("out", folder / "fields")
        machine = _machine(pages, config)
        bounds = _bounds(models, views)
        rows = list[FrameRow]()
        for number, model in enumerate(models):
            on_progress("models", number, len(models), model.name)
            rows += _Fields(record, pages, model, views, bounds, config, machine).rows(on_progress)
        on_progress("models", len(models), len(models))
        programs = list(dict.fromkeys(row.program for row in rows))
        rows.sort(key=lambda row: (programs.index(row.program), config.tree_heights.index(row.tree_pixels)))

        costs = frame_costs(rows)

        def write_tables(on_progress: OnProgress) -> None:
            write_bytes(folder / "frames.csv", frames_csv(rows))
            write_json(folder / FRAMES_FILE, frames_json(rows, costs, machine))
            write_bytes(folder / "frames.md", frames_markdown(rows, costs, machine).encode(errors="backslashreplace"))
            frames_plot(rows, folder / "frames.png")

        record.run(Stage("tables", ([asdict(row) for row in rows], asdict(machine)), _TABLES, write_tables, algorithm="frames"))
    return FramesResult(folder, tuple(rows), costs, machine)


class _Fields:
    """The fields of one model."""

    def __init__(
        self,
        record: Record,
        pages: Mapping[Program, FieldPage],
        model: DrawnModel,
        views: ViewDataset | None,
        bounds: Bounds,
        config: FramesConfig,
        machine: Machine,
    ) -> None:
        self._record, self._pages, self._model, self._views = record, pages, model, views
        self._bounds, self._config, self._machine = bounds, config, machine
        self._loaded: FieldPage | None = None

    def rows(self, on_progress: OnProgress) -> list[FrameRow]:
        """The rows of all programs and heights."""
        model, config, rows = self._model, self._config, list[FrameRow]()
        files = [digest_file(file) for file in model.files]
        renderer = (self._machine.processor, self._machine.renderer, self._machine.browser)
        for program in config.programs:
            if program != "three" and model.kind != "mesh":
                continue
            for pixels in config.tree_heights:
                error = self._error(pixels, files)
                name = f"fields/{program}_{model.name}_{pixels}"
                inputs = (files, model.distances, self._bounds, _fields_of(config, program), pixels, renderer, self._version(program))
                measure = self._render if program == "cycles" else partial(self._measure, program)
                work = partial(self._store, name, partial(measure, pixels, on_progress))
                outputs = (f"{name}.json", f"{name}.png")
                self._record.run(Stage(f"{program} {model.name} {pixels}", inputs, outputs, work, algorithm="frames"))
                rows += [FrameRow(**(row | error)) for row in self._stored(f"{name}.json")]
        return rows

    def _error(self, pixels: int, files: list[str]) -> dict[str, float | None]:
        """The fields of a row that tell how far the model is from the tree."""
        if self._model.name == ORIGINAL:
            return {"flip": 0.0, "psnr": None, "error_pixels": None}
        page = self._pages.get("three")
        if self._views is None or page is None:
            return {"flip": None, "psnr": None, "error_pixels": None}
        views, model, name = self._views.test, self._model, f"fields/error_{self._model.name}_{pixels}.json"

        def work(on_progress: OnProgress) -> None:
            self._load(page)
            found = size_error(model, page, views, pixels, self._config.error_views)
            write_json(self._record.folder / name, None if found is None else asdict(found))

        pictures = [[digest_file(path) for path in each if path.is_file()] for each in model.pictures]
        drawn = (self._views.fingerprint, pixels, self._config.error_views, self._machine.browser, self._version("three"))
        inputs = (files, model.distances, pictures, *drawn)
        self._record.run(Stage(f"error {model.name} {pixels}", inputs, (name,), work, algorithm="frames"))
        stored = read_json("frames", self._record.folder / name)
        if stored is None:
            return {"flip": None, "psnr": None, "error_pixels": None}
        with reading("frames", self._record.folder / name, "remove it, then start bbfit frames again"):
            error = SizeError(**stored)
            check_record("error", error, SizeError)
        return {"flip": error.flip, "psnr": error.psnr, "error_pixels": error.tree_pixels}

    def _version(self, program: Program) -> str | None:
        """The version of a program."""
        return installed_version("bpy") if program == "cycles" else self._pages[program].call("machine")["version"]

    def _store(self, name: str, measure: Callable[[], tuple[list[dict[str, Any]], bytes]], _: OnProgress = silent) -> None:
        """Store the rows of a program and height, and a picture of the field with the fewest trees."""
        rows, picture = measure()
        write_bytes(self._record.folder / f"{name}.png", picture)
        write_json(self._record.folder / f"{name}.json", rows)

    def _measure(self, program: Program, pixels: int, report: OnProgress) -> tuple[list[dict[str, Any]], bytes]:
        """Draw more and more trees of a height until a frame takes too long."""
        page, model, config = self._pages[program], self._model, self._config
        self._load(page)
        version, rows, picture = self._version(program) or program, list[dict[str, Any]](), b""
        for number, count in enumerate(config.counts):
            report(f"{model.name}, {pixels} px, {program}", number, len(config.counts), f"{count:,} trees")
            field = planted(self._bounds, pixels, count, config)
            page.answers["matrices.bin"] = field.matrices.tobytes()
            camera = {"metersHigh": field.meters_high, "elevation": math.radians(config.elevation_degrees), "reach": field.reach}
            size = {"width": config.width, "height": config.height}
            page.call("plant", {"matrices": f"/matrices.bin?{count}-{pixels}", **camera, **size})
            found = page.call("measure", {"frames": config.frames, "seconds": config.seconds, "longest_ms": config.longest_ms})
            picture = picture or page.picture()
            figures = {"ms": median(found["times"]), "update_ms": median(found["updates"]), "frames": len(found["times"])}
            drawn = {"calls": found["calls"], "triangles": int(found["triangles"]), "card_bytes": found["bytes"]}
            fragments = page.call("fragments") if found["times"][0] < config.longest_ms else None
            rows.append(self._row(version, pixels, count, figures | drawn | {"fragments": fragments}))
            if figures["ms"] > config.longest_ms:
                break
        report(f"{model.name}, {pixels} px, {program}", len(config.counts), len(config.counts))
        return rows, picture

    def _render(self, pixels: int, report: OnProgress) -> tuple[list[dict[str, Any]], bytes]:
        """Render fields with Cycles. Its pictures are square, and as high as those of the others."""
        (model,), config, rows = self._model.files, self._config, list[dict[str, Any]]()
        triangles, picture = glb_counts(model.read_bytes())[1], b""
        with ScratchFolder() as scratch:
            for number, count in enumerate(config.cycles_counts):
                report(f"{self._model.name}, {pixels} px, Cycles", number, len(config.cycles_counts), f"{count:,} trees")
                field = planted(self._bounds, pixels, count, config)
                camera = field.camera(config.height, config.elevation_degrees)
                views = ViewsConfig(samples=config.samples)
                cost = render_field(model, field.matrices, camera, 2 * field.reach, scratch / "field.png", views)
                picture = picture or (scratch / "field.png").read_bytes()
                figures = {"ms": 1000 * cost.seconds, "update_ms": 0.0, "frames": 1, "calls": 0, "triangles": triangles * count}
                rows.append(self._row("Cycles", pixels, count, figures | {"card_bytes": cost.bytes, "fragments": None}))
        report(f"{self._model.name}, {pixels} px, Cycles", len(config.cycles_counts), len(config.cycles_counts))
        return rows, picture

    def _row(self, program: str, pixels: int, count: int, figures: dict[str, Any]) -> dict[str, Any]:
        model = self._model
        known = {"model": model.name, "title": model.title, "kind": model.kind, "file_bytes": model.bytes}
        return {"program": program, "tree_pixels": pixels, "count": count} | known | figures

    def _stored(self, name: str) -> list[dict[str, Any]]:
        path = self._record.folder / name
        stored = read_json("frames", path)
        with reading("frames", path, "remove it, then start bbfit frames again"):
            for row in stored:
                check_record("row", FrameRow(**row, flip=None, psnr=None, error_pixels=None), FrameRow)
        return list(stored)

    def _load(self, page: FieldPage) -> None:
        """Load the model into a page that does not show it yet."""
        if self._loaded is page:
            return
        model, low_high = self._model, self._bounds
        addresses = [f"models/{number}.glb" for number in range(len(model.files))]
        page.answers.update(zip(addresses, model.files, strict=True))
        files = [{"url": f"/{url}?{model.name}", "distance": at} for url, at in zip(addresses, model.distances, strict=True)]
        page.call("load", {"kind": model.kind, "files": files, "extent": {"low": low_high[0], "high": low_high[1]}})
        self._loaded = page


def _fields_of(config: FramesConfig, program: Program) -> tuple[Any, ...]:
    """The options that a frame time depends on."""
    if program == "cycles":
        return (config.cycles_counts, config.samples, config.height, config.elevation_degrees, config.seed)
    size = (config.width, config.height, config.elevation_degrees, config.seed)
    return (config.counts, config.longest_ms, config.frames, config.seconds, *size, config.graphics_card)


def _original(record: Record, tree: TreeFile, on_progress: OnProgress) -> DrawnModel:
    record.run(convert_stage(record.folder, tree, f"{ORIGINAL}.glb"), on_progress)
    return DrawnModel(ORIGINAL, f"the tree itself, {tree.path.name}", "mesh", (record.folder / f"{ORIGINAL}.glb",))


def _bounds(models: Sequence[DrawnModel], views: ViewDataset | None) -> Bounds:
    """The tree's bounds: as recorded with its views, or else those of the first model."""
    known = views.request.tree.bounds if views and views.request else None
    if known:
        return known
    import trimesh

    with reading("model", models[0].files[0], "export it again"):
        low, high = trimesh.load_scene(models[0].files[0]).bounds.tolist()
    return tuple(low), tuple(high)


def _machine(pages: Mapping[Program, FieldPage], config: FramesConfig) -> Machine:
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load > 0.5:
        _log.warning(
            "other processes use the processor (a load of %.1f); frame times are those of an idle machine only if it is idle", load
        )
    picture = f"{config.width} x {config.height} pixels, up to 4 samples a pixel"
    page = next(iter(pages.values()), None)
    renderer, browser = ("", "") if page is None else (page.call("machine")["renderer"], page.browser)
    return Machine(f"{_processor()}, {cores} cores", renderer, browser, picture, load)


def _processor() -> str:
    try:
        names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()
