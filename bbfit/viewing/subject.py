"""What a page shows, read from the folder of a run or of levels of detail."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError, check_folder, fail
from bbfit.exporting.config import ExportConfig
from bbfit.files import read_json
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import corners, shown_bounds
from bbfit.layout import REQUEST_FILE
from bbfit.stages.stage import RECORD_FILE
from bbfit.viewing.levels import Level
from bbfit.viewing.originals import MOST_BYTES, Original, find_original

LOD_FILE, CLOUD_FILE = "lod.json", "cloud.safetensors"
"""What tells a folder of levels of detail, and the billboards of a run."""


@dataclass(frozen=True)
class Subject:
    """A tree and its billboards."""

    name: str
    """What the page is called."""
    levels: tuple[Level, ...]
    """The tree itself, if it can be shown, and its billboards, finest first; at least one has billboards."""
    original: Original
    """The tree."""
    export: ExportConfig
    """How the run's models are written; the textures are PNG, which the page reads."""
    bounds: NDArray[np.float64]
    """Lowest and highest corner of what the billboards show in meters, [2, 3]."""
    light: ViewsConfig
    """How the tree was lit in the views, as far as that is known."""
    views: Path | None = None
    """The views that it was fitted to."""
    notes: tuple[str, ...] = ()
    """What the page is to say."""
    live: bool = False
    """Whether it is still being fitted."""

    @property
    def clouds(self) -> tuple[Level, ...]:
        """The levels that are billboards."""
        return tuple(level for level in self.levels if level.cloud is not None)

    @property
    def size(self) -> tuple[float, float]:
        """Width, the larger one of that along x and that along z, and height in meters."""
        low, high = self.bounds
        return float(max(high[0] - low[0], high[2] - low[2])), float(high[1] - low[1])

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle of the bounds in meters, [3]."""
        middle: NDArray[np.float64] = self.bounds.mean(0)
        return middle

    def measured(self, scale: float) -> Subject:
        """The same, with a size from which on its one cloud stands for the tree."""
        return replace(self, levels=tuple(level if level.scale is not None else replace(level, scale=scale) for level in self.levels))

    def unmeasured(self, why: str) -> Subject:
        """The same without views, and why they are of no use."""
        return replace(self, views=None, notes=(*self.notes, why))


def open_run(folder: str | Path, *, original_bytes: int = MOST_BYTES) -> Subject:
    """Read the folder of ``bbfit run``, ``bbfit fit`` or ``bbfit lod``.

    Parameters
    ----------
    original_bytes : size of the original up to which it is sent to browsers.

    Raises
    ------
    MissingFileError, InputError
        if it is no such folder, or is damaged. An original that is gone or cannot be read is a note.
    """
    folder = check_folder("run", folder)
    if (folder / LOD_FILE).is_file():
        return _open_lod(folder, original_bytes)
    if not (folder / CLOUD_FILE).is_file():
        done = " yet" if (folder / RECORD_FILE).is_file() or (folder / "fit.checkpoint").is_file() else ""
        fail("run", f"{folder} holds no {CLOUD_FILE}{done}", "give the folder that bbfit run, bbfit fit or bbfit lod wrote")
    record = _record(folder)
    cloud = BillboardCloud.load(folder / CLOUD_FILE)
    original = find_original(sources(folder, record), original_bytes)
    views = _views(folder, record)
    levels = (Level(None, math.inf), Level(cloud, None)) if original.glb is not None else (Level(cloud, math.inf),)
    return Subject(
        name=folder.resolve().name,
        levels=levels,
        original=original,
        export=_export(record),
        bounds=shown_bounds(cloud).numpy(),
        light=light_of(views),
        views=views,
        notes=() if record else (f"there is no {RECORD_FILE}, so what it was made from is not known",),
    )


def live_subject(cloud: BillboardCloud, name: str, original: Original, light: ViewsConfig) -> Subject:
    """A cloud that is being fitted."""
    levels = (Level(None, math.inf), Level(cloud, None)) if original.glb is not None else (Level(cloud, math.inf),)
    return Subject(name, levels, original, ExportConfig(), shown_bounds(cloud).numpy(), light, live=True)


def outlines(cloud: BillboardCloud) -> NDArray[np.float32]:
    """The edges of a cloud's rectangles as line segments, [4 N, 2, 3] in meters."""
    around = corners(cloud).numpy()
    return np.stack([around, np.roll(around, -1, 1)], 2).reshape(-1, 2, 3).astype(np.float32)


def sources(folder: Path, record: dict[str, Any]) -> list[Path | None]:
    """Where the tree of a run may be: what it was grown or made from, or the mesh that was given beside views."""
    if not record:
        return [folder / "tree.glb"] if (folder / "tree.glb").is_file() else []
    if record["config"].get("grow") is not None:
        return [folder / "tree.glb"]
    source = Path(record["source"])
    if not source.is_dir() and source.suffix:
        return [source]
    given = record["config"].get("tree")
    return [Path(given)] if isinstance(given, str) else []


def light_of(views: Path | None) -> ViewsConfig:
    """How a folder of views was lit, as its ``views.json`` says; bbfit's usual light if it does not."""
    path = views / REQUEST_FILE if views is not None else None
    try:
        request = read_json("views", path) if path is not None and path.is_file() else {}
    except InputError:
        request = {}
    config = request.get("config") if isinstance(request, dict) else None
    names = ("sun_strength", "sun_azimuth", "sun_elevation", "ambient_strength")
    known = {name: config[name] for name in names if isinstance(config.get(name), int | float)} if isinstance(config, dict) else {}
    try:
        return ViewsConfig(**known)
    except InputError:
        return ViewsConfig()


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
    """The run's export as the page can show it."""
    told = record.get("config", {}).get("export")
    known = {f.name: told[f.name] for f in fields(ExportConfig) if f.name in told} if isinstance(told, dict) else {}
    try:
        config = ExportConfig(**known)
    except (InputError, TypeError):  # of another version
        config = ExportConfig()
    return replace(config, textures="png", mip_files=False)


def _views(folder: Path, record: dict[str, Any]) -> Path | None:
    near = [folder / "views", folder.parent / "views", *([Path(record["source"])] if record else [])]
    return next((path for path in near if path.is_dir()), None)


def _open_lod(folder: Path, original_bytes: int) -> Subject:
    told = read_json("run", folder / LOD_FILE)
    found, records, with_tree = list[Level](), list[dict[str, Any]](), False
    try:
        config = told["config"]
        focal = config["screen_height"] / 2 / math.tan(math.radians(config["screen_fov_degrees"]) / 2)
        for index, level in enumerate(told["levels"]):
            scale = focal / level["distance_meters"] if index and level["distance_meters"] else math.inf
            if level["planes"] is None:
                with_tree = True
                continue
            run = folder / str(level["planes"])
            cloud = BillboardCloud.load(run / CLOUD_FILE)
            halvings = 0 if math.isinf(scale) else max(0, math.floor(math.log2(cloud.texel_density / scale)))
            found.append(Level(cloud, scale, halvings))
            records.append(_record(run))
    except (LookupError, TypeError, AttributeError, ArithmeticError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        fail("run", f"{folder / LOD_FILE} is damaged or of another version ({error!r})", "start bbfit lod again")
    if not found:
        fail("run", f"{folder / LOD_FILE} names no billboards", "start bbfit lod again")
    converted = folder / "original.glb"
    original = find_original([converted] if converted.is_file() else sources(folder, records[0]), original_bytes)
    levels = (Level(None, math.inf), *found) if with_tree and original.glb is not None else tuple(found)
    boxes = np.stack([shown_bounds(level.cloud).numpy() for level in found if level.cloud is not None])
    return Subject(
        name=folder.resolve().name,
        levels=levels,
        original=original,
        export=_export(records[0]),
        bounds=np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]),
        light=light_of(folder / "views"),
        views=folder / "views",
    )
