"""Rendering views of a tree into a folder: what is asked, what stands already, what is still to do."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.processes import BlenderError, BlenderPool, require_bpy
from bbfit.blender.sources import UP_AXIS, check_tree, fingerprint
from bbfit.checks import InputError, check_file, fail
from bbfit.files import output_folder, read_json, write_json
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, camera_to_nerf
from bbfit.geometry.orbit import Orbit
from bbfit.images import read_rgba
from bbfit.layout import REQUEST_FILE, SINGLE_FILE, TEST_FILE, TRAIN_FILE, split_views, write_transforms

__all__ = ["BlenderError", "render_views"]

# What may differ between two starts on one folder: it changes how long the pictures take, not what they show.
_FREE = ("workers", "device")
# Cycles' pixel filter (Blackman-Harris, width 1.5, of which Cycles makes 3) spreads a surface 1.5 pixels about a pixel's centre: what keeps
# this many pixels from the picture's edge leaves its outermost pixels empty.
_FILTER_REACH = 2.0


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
    request = _request(files, config)
    earlier = _earlier(out, request)
    images = out / "images"
    paths = [images / f"{index:04}.png" for index in range(config.count)]
    missing = [index for index, path in enumerate(paths) if not _stands(path, config.size)]
    tell = on_progress or (lambda done, total: None)
    if earlier.get("complete") and not missing and (out / TRAIN_FILE).is_file() and (out / TEST_FILE).is_file():
        tell(config.count, config.count)
        return out

    started, spent = time.monotonic(), float(earlier.get("seconds", 0))
    require_bpy()
    with BlenderPool(_job(files[0], config, len(missing))) as pool:
        found = pool.load()
        points = _to_y_up(np.frombuffer(found["payload"], np.float32).reshape(-1, 3))
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
        pool.render(_frames(camera, points, config, paths, missing), config.workers, kept, record)
    train, test = split_views(config.count, config.seed)
    write_transforms(out, camera, [f"images/{path.name}" for path in paths], train, test)
    write_json(out / REQUEST_FILE, request | {"seconds": round(spent + time.monotonic() - started, 3), "complete": True})
    return out


def _request(files: list[Path], config: ViewsConfig) -> dict[str, Any]:
    """What is asked, as it stands in ``views.json``."""
    asked: dict[str, Any] = asdict(config) | {"elevations": [float(angle) for angle in config.elevations], "hdri": None}
    if config.hdri is not None:
        panorama = check_file("hdri", config.hdri)
        asked["hdri"] = {"name": panorama.name, "sha256": fingerprint([panorama])}
    return {
        "bbfit": _version(),
        "config": asked,
        "tree": {
            "name": files[0].name,
            "sha256": fingerprint(files),
            "bytes": sum(file.stat().st_size for file in files),
            "up_axis": UP_AXIS[files[0].suffix.lower()],
        },
    }


def _version() -> str:
    try:
        return version("bbfit")
    except PackageNotFoundError:  # run from a source folder that is not installed
        return "unknown"


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
        if name not in _FREE and before != value:
            fail("out", f"{out} holds views with {name} {_show(before)}, not {_show(value)}", hint)
    if earlier["tree"].get("sha256") != request["tree"]["sha256"]:
        name, now = earlier["tree"].get("name"), request["tree"]["name"]
        fail("out", f"{out} holds views of {'another tree, ' if name != now else 'an earlier version of '}{name}", hint)
    return earlier


def _show(value: Any) -> str:
    if isinstance(value, dict):
        return str(value.get("name"))
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _stands(path: Path, size: int) -> bool:
    """Whether a picture is there, whole and of the right size."""
    try:
        return read_rgba(path).shape == (size, size, 4)
    except InputError:
        return False


def _to_y_up(points: NDArray[np.float32]) -> NDArray[np.float64]:
    return points.astype(np.float64) @ np.array(Z_UP_TO_Y_UP)[:3, :3].T


def _cameras(points: NDArray[np.float64], config: ViewsConfig) -> tuple[Camera, torch.Tensor, float]:
    """Cameras that see every point, the point that they look at and their distance from it in metres."""
    low, high = points.min(0), points.max(0)
    target = torch.from_numpy((low + high) / 2)
    through_origin = (low[[0, 2]] <= 0).all() and (high[[0, 2]] >= 0).all()
    if config.axis == "origin" or (config.axis == "auto" and through_origin):
        target[[0, 2]] = 0.0
    orbit = Orbit(config.count, tuple(config.elevations))
    camera = orbit.frame(
        points,
        target=target,
        width=config.size,
        height=config.size,
        fov_x_degrees=None if config.orthographic else config.fov_degrees,
        margin=max(0.02, _FILTER_REACH / config.size),
    )
    return camera, target, float((camera.position[0] - target).norm())


def _job(tree: Path, config: ViewsConfig, frames: int) -> dict[str, Any]:
    azimuth, elevation = math.radians(config.sun_azimuth), math.radians(config.sun_elevation)
    across = math.cos(elevation)
    return {
        "tree": str(tree.resolve()),
        "size": config.size,
        "samples": config.samples,
        "denoise": config.denoise,
        # Azimuth as in Orbit, whose +Z is Blender's -Y.
        "sun_direction": [across * math.sin(azimuth), -across * math.cos(azimuth), math.sin(elevation)],
        "sun_strength": config.sun_strength,
        "ambient_strength": config.ambient_strength,
        "hdri": None if config.hdri is None else str(Path(config.hdri).resolve()),
        "device": config.device,
        "threads": max(1, (os.cpu_count() or 1) // max(1, min(config.workers, frames))),
    }


def _frames(
    camera: Camera, points: NDArray[np.float64], config: ViewsConfig, paths: list[Path], indices: list[int]
) -> list[dict[str, Any]]:
    """What the worker needs for each picture; Blender's camera axes and its Z-up world are those of the NeRF-synthetic layout."""
    matrices = camera_to_nerf(camera.world_to_camera)
    reach = np.linalg.norm(points[:, None] - camera.position[0].numpy(), axis=-1).max() + 2 * np.ptp(points, axis=0).sum()
    return [
        {
            "frame": index,
            "path": str(paths[index].resolve()),
            "camera_to_world": matrices[index].tolist(),
            "fov_degrees": config.fov_degrees,
            "extent": camera.width / float(camera.intrinsics[index, 0, 0]) if camera.orthographic else None,
            "clip": [float(reach) * 1e-5, float(reach)],
            "seed": (config.seed + index) % 2**31,
        }
        for index in indices
    ]
