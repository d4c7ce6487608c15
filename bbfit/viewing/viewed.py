"""The tree that the viewer shows, read from the folder of a run or of levels of detail."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.request import ViewsRequest
from bbfit.checks import InputError, check_folder, fail
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod_files import LOD_FILE, read_levels
from bbfit.files import read_json
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import shown_bounds
from bbfit.geometry.light import Light, angles_degrees, direction
from bbfit.inputs import reading
from bbfit.layout import REQUEST_FILE
from bbfit.stages.recorded import recorded_export
from bbfit.stages.stage import RECORD_FILE
from bbfit.viewing.levels import ViewerLevel
from bbfit.viewing.originals import MAX_BYTES, Original, find_original
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import evenly

LEVELS, CLOUD_FILE = "levels", "cloud.safetensors"
"""The folder of levels of detail in a folder of bbfit lod, and the cloud in a run's folder."""
# The most views whose colors are given, and how far their cameras may be from eye level, in sines of the elevation.
_SEEN, _LEVEL = 8, 0.1


@dataclass(frozen=True)
class SeenColor:
    """The mean color of a tree in a view, in which its leaves shade each other."""

    azimuth: float
    """Of the camera as seen from the tree, in degrees."""
    elevation: float
    """The same above the horizon."""
    color: tuple[float, float, float]
    """Straight sRGB in [0, 1]."""


@dataclass(frozen=True)
class ViewedTree:
    """A tree and its billboards."""

    name: str
    """The folder's name."""
    levels: tuple[ViewerLevel, ...]
    """The original, if it is a level, and the billboards, finest first; at least one level has billboards."""
    original: Original
    """The original tree."""
    export: ExportConfig
    """How the run's models are exported; the textures are PNG, which browsers read."""
    bounds: NDArray[np.float64]
    """Lowest and highest corner of what the billboards show in meters, [2, 3]."""
    light: Light
    """The light of the views, as far as it is known, a batch of one."""
    seen: tuple[SeenColor, ...] = ()
    """The colors of the original in some views at eye level; empty without views."""
    views: Path | None = None
    """The folder of views that the billboards were fitted to."""
    notes: tuple[str, ...] = ()
    """Remarks that the page shows."""
    live: bool = False
    """Whether the fit is still running."""

    @property
    def clouds(self) -> tuple[BillboardCloud, ...]:
        """The clouds of the levels that have billboards."""
        return tuple(level.cloud for level in self.levels if level.cloud is not None)

    @property
    def has_maps(self) -> bool:
        """Whether the billboards take the light of a program: all clouds have maps."""
        return all(cloud.surface is not None for cloud in self.clouds)

    @property
    def is_measured(self) -> bool:
        """Whether the scale of every level is known."""
        return all(level.scale is not None for level in self.levels)

    def with_scale(self, scale: float) -> ViewedTree:
        """The same tree with the scale of its one cloud, in pixels per meter."""
        return replace(self, levels=tuple(level if level.scale is not None else replace(level, scale=scale) for level in self.levels))

    def without_views(self, reason: str) -> ViewedTree:
        """The same tree without views, and a note on why they cannot be used."""
        return replace(self, views=None, notes=(*self.notes, reason))


def open_results(folder: str | Path, *, original_bytes: int = MAX_BYTES) -> ViewedTree:
    """Read the folder of ``bbfit run``, ``bbfit fit`` or ``bbfit lod``. An original that is gone or cannot be read becomes a note.

    ``original_bytes`` is the largest size of the original's file that is sent to browsers. Raises MissingFileError or InputError if it is
    no such folder, or is damaged.
    """
    folder = check_folder("run", folder)
    is_lod = (folder / LEVELS / LOD_FILE).is_file()
    with reading("run", folder, "start bbfit again for this folder"):
        return _open_lod(folder, original_bytes) if is_lod else _open_run(folder, original_bytes)


def _open_run(folder: Path, original_bytes: int) -> ViewedTree:
    if not (folder / CLOUD_FILE).is_file():
        done = " yet" if (folder / RECORD_FILE).is_file() or (folder / "fit.checkpoint").is_file() else ""
        fail("run", f"{folder} holds no {CLOUD_FILE}{done}", "give the folder that bbfit run, bbfit fit or bbfit lod wrote")
    record = _record(folder)
    views, cloud = _views(folder, record), BillboardCloud.load(folder / CLOUD_FILE)
    original = find_original(sources(folder, record), original_bytes)
    tree = live_tree(cloud, folder.resolve().name, original, light_of(views))
    notes = () if record else (f"there is no {RECORD_FILE}, so the tree that it was made from is not known",)
    return replace(tree, export=_export(record), seen=seen_colors(views), views=views, notes=notes, live=False)


def live_tree(cloud: BillboardCloud, name: str, original: Original, light: Light, seen: tuple[SeenColor, ...] = ()) -> ViewedTree:
    """A tree whose billboards are being fitted."""
    levels = (ViewerLevel(None, math.inf), ViewerLevel(cloud, None)) if original.glb is not None else (ViewerLevel(cloud, math.inf),)
    return ViewedTree(name, levels, original, ExportConfig(), shown_bounds(cloud).numpy(), light, seen, live=True)


def sources(folder: Path, record: dict[str, Any]) -> list[Path | None]:
    """Files that may hold the original tree of a run: the grown tree, the source, or the mesh that was given beside views."""
    if not record:
        return [folder / "tree.glb"] if (folder / "tree.glb").is_file() else []
    if record["config"].get("grow") is not None:
        return [folder / "tree.glb"]
    source = Path(record["source"])
    if not source.is_dir() and source.suffix:
        return [source]
    given = record["config"].get("tree")
    return [Path(given)] if isinstance(given, str) else []


def light_of(views: Path | None) -> Light:
    """The light of a folder of views by its ``views.json``, a batch of one; the default light if that file has none."""
    path = None if views is None else views / REQUEST_FILE
    names = ("sun_strength", "sun_azimuth", "sun_elevation", "ambient_strength")
    try:
        request = ViewsRequest.load(path) if path is not None and path.is_file() else None
        stored = request.config if request else {}
        config = ViewsConfig(**{name: stored[name] for name in names if isinstance(stored.get(name), int | float)})
    except InputError:
        config = ViewsConfig()
    return Light.of(direction(config.sun_azimuth, config.sun_elevation)[None], config.sun_strength, config.ambient_strength)


def seen_colors(folder: Path | None) -> tuple[SeenColor, ...]:
    """The colors of the tree in up to eight training views around it, those nearest to eye level; none if there are no readable views."""
    if folder is None or not folder.is_dir():
        return ()
    try:
        views = ViewDataset.load(folder).train
        away = -views.cameras.batch().forward
        found = (away[:, 1].abs() <= away[:, 1].abs().min() + _LEVEL).nonzero()[:, 0].tolist()
        found = evenly(found, _SEEN)
        sums = [views.targets([index], torch.float64).sum((0, 1, 2)) for index in found]
    except InputError:
        return ()
    pairs = [(angles_degrees(away[index]), total.tolist()) for index, total in zip(found, sums, strict=True) if total[3] > 0]
    return tuple(SeenColor(*angles, (red / alpha, green / alpha, blue / alpha)) for angles, (red, green, blue, alpha) in pairs)


def _record(folder: Path) -> dict[str, Any]:
    """``run.json``, empty if there is none."""
    path = folder / RECORD_FILE
    if not path.is_file():
        return {}
    record = read_json("run", path)
    if not isinstance(record, dict) or not isinstance(record.get("source"), str) or not isinstance(record.get("config"), dict):
        fail("run", f"{path} was not written by bbfit or is damaged", "remove it, or start the run again")
    return record


def _export(record: dict[str, Any]) -> ExportConfig:
    """The run's export, with textures that browsers read."""
    return replace(recorded_export(record), textures="png", mip_files=False)


def _views(folder: Path, record: dict[str, Any]) -> Path | None:
    near = [folder / "views", *([Path(record["source"])] if record else []), folder.parent / "views"]
    return next((path for path in near if path.is_dir()), None)


def _open_lod(folder: Path, original_bytes: int) -> ViewedTree:
    stored = read_levels(folder / LEVELS)
    billboards = [level for level in stored.levels if level.planes is not None]
    if not billboards:
        fail("run", f"{folder / LEVELS / LOD_FILE} names no billboards", "start bbfit lod again")
    runs = [folder / str(level.requested) for level in billboards]
    records = [_record(run) for run in runs]
    scales = [stored.focal / level.distance_meters if level.distance_meters else math.inf for level in billboards]
    coarser = [
        ViewerLevel(BillboardCloud.load(run / CLOUD_FILE), scale, level.halvings)
        for run, scale, level in zip(runs, scales, billboards, strict=True)
    ]
    kinds = {level.content for level in stored.levels if level.planes is None}
    with_tree, thinned = "tree" in kinds, sorted(kinds - {"tree"})
    converted = folder / "original.glb"
    original = find_original([converted] if converted.is_file() else sources(folder, records[0]), original_bytes)
    if with_tree and original.glb is not None:
        levels = (ViewerLevel(None, math.inf), *coarser)
    else:  # the finest that is shown is seen from near by
        levels = (replace(coarser[0], scale=math.inf, halvings=0), *coarser[1:])
    boxes = np.stack([shown_bounds(level.cloud).numpy() for level in coarser if level.cloud is not None])
    return ViewedTree(
        name=folder.resolve().name,
        levels=levels,
        original=original,
        export=_export(records[0]),
        bounds=np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]),
        light=light_of(folder / "views"),
        seen=seen_colors(folder / "views"),
        views=folder / "views",
        notes=(f"not shown here: the tree thinned out to {' and '.join(thinned)}",) if thinned else (),
    )
