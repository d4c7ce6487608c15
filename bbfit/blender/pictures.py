"""Rendering a tree by any cameras into a folder, slab by slab if asked, and what that shares with rendering views of it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.blender.config import ViewsConfig
from bbfit.blender.processes import BlenderPool, require_bpy
from bbfit.blender.request import ViewsRequest
from bbfit.checks import InputError, check_range, fail
from bbfit.files import output_folder
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, camera_to_nerf
from bbfit.images import read_rgba
from bbfit.tree_files.tree_file import TreeFile

RECORD_FILE = "pictures.json"
"""What :func:`render_pictures` notes beside its pictures: the tree, the light, the cameras and the clip distances."""
FILTER_REACH = 2.0
"""Pixels that a surface's picture reaches beyond it, rounded up: Cycles' filter (Blackman-Harris) spreads it 1.5 pixels about a pixel's
center."""
# Settings of views that cameras given one by one replace.
_UNUSED = ("count", "size", "elevations", "fov_degrees", "orthographic", "axis")
# How far a camera's intrinsics may be from what Blender is told, in pixels.
_CENTERD = 1e-6


def render_pictures(
    tree: str | Path | TreeFile,
    cameras: Camera,
    out: str | Path,
    config: ViewsConfig,
    *,
    clips: Sequence[tuple[float, float]] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Render a tree by given cameras with Blender's Cycles, in the light of its views.

    Writes ``0000.png`` and so on (straight-alpha RGBA, fully transparent where a camera sees nothing) and ``pictures.json`` with what
    was asked. Started again with the same request, it renders what is missing or damaged, and nothing else; workers and device may
    differ. Clip distances cut what the camera sees, and nothing else: what is cut away still casts shadows and reflects light.

    Parameters
    ----------
    tree : as for :func:`~bbfit.blender.views_folder.render_views`.
    cameras : V pinhole or parallel cameras with square pictures of at most 16384 pixels, square pixels and a centerd principal point.
    out : folder to write to; made if need be.
    config : light, samples, denoising, device, workers and seed; the rest of it is not used.
    clips : nearest and farthest distance from each camera along its axis that is seen, in meters, V pairs with 0 < nearest < farthest;
        everything when left out.
    on_progress : called with the number of finished pictures and of all pictures, at the start and after each picture.

    Returns
    -------
    The V pictures' paths.

    Raises
    ------
    MissingFileError, InputError
        if the tree or the cameras cannot be used, if ``out`` holds other pictures or cannot be written to, or if there is no Blender.
    BlenderError
        if Blender crashes again and again; finished pictures are kept.
    """
    cameras, out = cameras.batch().to(torch.float64), Path(out)
    _check(cameras, clips)
    tree = TreeFile.open(tree)
    request = ViewsRequest.of(tree, config)
    request = replace(
        request,
        config={name: value for name, value in request.config.items() if name not in _UNUSED},
        cameras=_described(cameras),
        clips=None if clips is None else [[float(end) for end in clip] for clip in clips],
    )
    if request.check_same(out, RECORD_FILE) is None and out.is_dir() and any(out.glob("[0-9][0-9][0-9][0-9]*.png")):
        fail("out", f"{out} holds pictures from elsewhere", f"choose another output folder, or remove {out} to render again")
    count, size = len(cameras), cameras.width
    paths = [out / f"{index:04}.png" for index in range(count)]
    missing = [index for index, path in enumerate(paths) if not is_whole(path, size)]
    on_progress = on_progress or (lambda done, total: None)
    on_progress(count - len(missing), count)
    if not missing:
        return paths
    require_bpy()
    with BlenderPool(job(tree, config, size, len(missing))) as pool:
        points = to_y_up(pool.load()["payload"])
        output_folder("out", out)
        request.save(out / RECORD_FILE)
        seen = clips or [whole(points, position) for position in cameras.position]
        report, kept = on_progress, count - len(missing)
        pool.render(frames(cameras, paths, missing, seen, config.seed), config.render_workers, kept, lambda done: report(done, count))
    return paths


def is_whole(path: Path, size: int) -> bool:
    """Whether a picture exists, can be decoded, and has the right size."""
    try:
        return read_rgba(path).shape == (size, size, 4)
    except InputError:
        return False


def to_y_up(payload: bytes) -> NDArray[np.float64]:
    """The vertices that Blender sends, in our world, [P, 3]."""
    points = np.frombuffer(payload, np.float32).reshape(-1, 3)
    return points.astype(np.float64) @ np.array(Z_UP_TO_Y_UP)[:3, :3].T


def vertical_axis(low: NDArray[np.floating], high: NDArray[np.floating], axis: str) -> Tensor:
    """The point in the middle of a tree's height on the vertical line that cameras circle (``ViewsConfig.axis``), [3] float64.

    Parameters
    ----------
    low, high : [3] corners of the tree's bounding box in meters.
    """
    target = torch.from_numpy((np.asarray(low, np.float64) + high) / 2)
    through_origin = all(low[i] <= 0 <= high[i] for i in (0, 2))
    if axis == "origin" or (axis == "auto" and through_origin):
        target[[0, 2]] = 0.0
    return target


def job(tree: TreeFile, config: ViewsConfig, size: int, count: int) -> dict[str, Any]:
    """What the worker needs to know for all of ``count`` pictures of ``size`` x ``size`` pixels."""
    azimuth, elevation = math.radians(config.sun_azimuth), math.radians(config.sun_elevation)
    across = math.cos(elevation)
    return {
        "tree": str(tree.path.resolve()),
        "size": size,
        "samples": config.samples,
        "denoise": config.denoise,
        # Azimuth as in Orbit, whose +Z is Blender's -Y.
        "sun_direction": [across * math.sin(azimuth), -across * math.cos(azimuth), math.sin(elevation)],
        "sun_strength": config.sun_strength,
        "ambient_strength": config.ambient_strength,
        "hdri": None if config.hdri is None else str(Path(config.hdri).resolve()),
        "device": config.render_device,
        "threads": max(1, (os.cpu_count() or 1) // max(1, min(config.render_workers, count))),
    }


def whole(points: NDArray[np.float64], position: Tensor) -> tuple[float, float]:
    """Clip distances of a camera at ``position``, [3], between which every point, [P, 3], lies if it lies before the camera."""
    reach = float(np.linalg.norm(points - position.numpy(), axis=-1).max() + 2 * np.ptp(points, axis=0).sum())
    return reach * 1e-5, reach


def frames(
    camera: Camera, paths: Sequence[Path], indices: Sequence[int], clips: Sequence[tuple[float, float]], seed: int
) -> list[dict[str, Any]]:
    """What the worker needs for each picture; Blender's camera axes and its Z-up world are those of the NeRF-synthetic layout."""
    matrices = camera_to_nerf(camera.world_to_camera)
    found = []
    for index in indices:
        extent = camera.width / float(camera.intrinsics[index, 0, 0])  # at distance 1, or in meters when orthographic
        found.append(
            {
                "frame": index,
                "path": str(paths[index].resolve()),
                "camera_to_world": matrices[index].tolist(),
                "fov_degrees": None if camera.orthographic else math.degrees(2 * math.atan(extent / 2)),
                "extent": extent if camera.orthographic else None,
                "clip": [float(end) for end in clips[index]],
                "seed": (seed + index) % 2**31,
            }
        )
    return found


def _check(cameras: Camera, clips: Sequence[tuple[float, float]] | None) -> None:
    size, k = cameras.width, cameras.intrinsics
    if cameras.height != size:
        fail("cameras", f"expected square pictures, got {size}x{cameras.height}")
    check_range("size", size, 1, 16384)
    expected = torch.zeros_like(k)
    expected[:, 0, 0] = expected[:, 1, 1] = k[:, 0, 0]
    expected[:, :2, 2], expected[:, 2, 2] = (size - 1) / 2, 1
    if not torch.allclose(k, expected, rtol=1e-9, atol=_CENTERD):
        fail("cameras", "expected square pixels and the principal point in the middle of the picture")
    if clips is not None:
        if len(clips) != len(cameras):
            fail("clips", f"expected one pair for each of {len(cameras)} cameras, got {len(clips)}")
        for near, far in clips:
            if not 0 < near < far < math.inf:
                fail("clips", f"expected 0 < nearest < farthest, got {near} and {far}")


def _described(cameras: Camera) -> dict[str, Any]:
    return {
        "size": cameras.width,
        "orthographic": cameras.orthographic,
        "world_to_camera": cameras.world_to_camera.tolist(),
        "focal": cameras.intrinsics[:, 0, 0].tolist(),
    }
