"""Rendering views of a tree into a folder: what is asked, what stands already, what is still to do."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.pictures import FILTER_REACH, FREE, asked_for, frames, job, stands, to_y_up, vertical_axis, whole
from bbfit.blender.processes import BlenderError, BlenderPool, require_bpy
from bbfit.blender.sources import check_tree
from bbfit.checks import fail
from bbfit.files import output_folder, read_json, write_json
from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit
from bbfit.layout import REQUEST_FILE, SINGLE_FILE, TEST_FILE, TRAIN_FILE, split_views, write_transforms

__all__ = ["BlenderError", "render_views"]


def render_views(
    tree: str | Path,
    out: str | Path,
    config: ViewsConfig | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render views of a tree with Blender's Cycles.

    Writes ``images/0000.png`` and so on (straight-alpha RGBA), ``transforms_train.json``, ``transforms_test.json`` and
    ``views.json`` (what was asked and what was found of the tree; ``"complete": true`` when all is there). The transforms are
    written last, so a half-finished folder has none. Every vertex is in every picture. Started again with the same tree and the
    same settings, other than workers and device, it renders the views that are still missing or damaged, and no others.

    Parameters
    ----------
    tree : .glb .gltf .obj .fbx .usd .usda .usdc .usdz (Y up, or as the file says), .ply .stl .blend (Z up).
    out : folder to write to; made if need be.
    on_progress : called with the number of finished views and of all views, at the start and after each view.

    Returns
    -------
    ``out`` as a path.

    Raises
    ------
    MissingFileError, InputError
        if the tree cannot be used, if ``out`` holds other views or cannot be written to, or if there is no Blender. Earlier views
        are left as they were.
    BlenderError
        if Blender crashes again and again; finished views are kept.
    """
    config, out = config or ViewsConfig(), Path(out)
    files = check_tree(tree)
    request = asked_for(files, config)
    earlier = _earlier(out, request)
    images = out / "images"
    paths = [images / f"{index:04}.png" for index in range(config.count)]
    missing = [index for index, path in enumerate(paths) if not stands(path, config.size)]
    tell = on_progress or (lambda done, total: None)
    if earlier.get("complete") and not missing and (out / TRAIN_FILE).is_file() and (out / TEST_FILE).is_file():
        tell(config.count, config.count)
        return out

    started, spent = time.monotonic(), float(earlier.get("seconds", 0))
    require_bpy()
    with BlenderPool(job(files[0], config, config.size, len(missing))) as pool:
        found = pool.load()
        points = to_y_up(found["payload"])
        camera, target, distance = _cameras(points, config)
        request["tree"] |= {
            "vertices": found["vertices"],
            "faces": found["faces"],
            "bounds": [points.min(0).tolist(), points.max(0).tolist()],
        }
        request |= {"camera": {"target": target.tolist(), "distance": distance}, "blender": found["blender"]}
        output_folder("out", out)
        output_folder("out", images)
        for leftover in images.glob(".*.part"):
            leftover.unlink()

        def record(done: int) -> None:
            write_json(out / REQUEST_FILE, request | {"seconds": round(spent + time.monotonic() - started, 3), "complete": False})
            tell(done, config.count)

        kept = config.count - len(missing)
        record(kept)
        clips = [whole(points, camera.position[0])] * config.count
        pool.render(frames(camera, paths, missing, clips, config.seed), config.render_workers, kept, record)
    train, test = split_views(config.count, config.seed)
    write_transforms(out, camera, [f"images/{path.name}" for path in paths], train, test)
    write_json(out / REQUEST_FILE, request | {"seconds": round(spent + time.monotonic() - started, 3), "complete": True})
    return out


def _earlier(out: Path, request: dict[str, Any]) -> dict[str, Any]:
    """What an earlier start left in ``views.json``, which must have asked for the same; empty where there was none."""
    if out.exists() and not out.is_dir():
        fail("out", f"{out} is a file, not a folder", "choose another output folder")
    path = out / REQUEST_FILE
    if not path.is_file():
        strange = [out / name for name in (TRAIN_FILE, TEST_FILE, SINGLE_FILE) if (out / name).exists()]
        strange += sorted((out / "images").glob("[!.]*"))[:1]
        if strange:
            fail("out", f"{out} holds views from elsewhere ({strange[0].name})", "choose another output folder")
        return {}
    earlier = read_json("out", path)
    if not isinstance(earlier, dict) or not isinstance(earlier.get("config"), dict) or not isinstance(earlier.get("tree"), dict):
        fail("out", f"{path} was not written by bbfit", "choose another output folder")
    hint = f"choose another output folder, or remove {out} to render anew"
    for name, value in request["config"].items():
        before = earlier["config"].get(name)
        if name not in FREE and before != value:
            fail("out", f"{out} holds views with {name} {_show(before)}, not {_show(value)}", hint)
    if earlier["tree"].get("sha256") != request["tree"]["sha256"]:
        name, now = earlier["tree"].get("name"), request["tree"]["name"]
        fail("out", f"{out} holds views of {'another tree, ' if name != now else 'an earlier version of '}{name}", hint)
    return earlier


def _show(value: Any) -> str:
    if isinstance(value, dict):
        return str(value.get("name"))
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _cameras(points: NDArray[np.float64], config: ViewsConfig) -> tuple[Camera, torch.Tensor, float]:
    """Cameras that see every point, the point that they look at and their distance from it in meters."""
    target = vertical_axis(points.min(0), points.max(0), config.axis)
    orbit = Orbit(config.count, tuple(config.elevations))
    camera = orbit.frame(
        points,
        target=target,
        width=config.size,
        height=config.size,
        fov_x_degrees=None if config.orthographic else config.fov_degrees,
        margin=max(0.02, FILTER_REACH / config.size),  # so that the outermost pixels stay empty
    )
    return camera, target, float((camera.position[0] - target).norm())
