"""Render a tree with arbitrary cameras and clip distances, and the parts that this shares with rendering views."""

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
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, camera_to_nerf
from bbfit.geometry.light import direction, to_z_up
from bbfit.geometry.orbit import hull_vertices
from bbfit.images import read_rgba
from bbfit.inputs import InputLimits
from bbfit.outputs import claimed_folder
from bbfit.tree_files.tree_file import TreeFile

PICTURES_FILE = "pictures.json"
"""The file in which :func:`render_pictures` records its request: the tree, the light, the cameras and the clip distances."""
FILTER_REACH = 2.0
"""How far, in pixels, the filter of Cycles spreads a surface beyond its outline. The Blackman-Harris filter reaches 1.5 pixels."""
# Formats of trees whose vertices bound what is seen. Others may have hair of particles or displaced surfaces.
_BOUNDED = (".glb", ".gltf", ".obj", ".ply", ".stl", ".fbx")
# The options of views that explicit cameras replace.
_UNUSED = ("count", "size", "training_samples", "elevations", "fov_degrees", "orthographic", "axis", "turned", "suns")
# The largest difference in pixels between a camera's intrinsics and those that Blender can represent.
_INTRINSICS_TOLERANCE = 1e-6


def render_pictures(
    tree: str | Path | TreeFile,
    cameras: Camera,
    out: str | Path,
    config: ViewsConfig,
    *,
    clips: Sequence[tuple[float, float]] | None = None,
    depth: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Render a tree with given cameras with Blender's Cycles, in the light of its views.

    Writes ``0000.png`` and so on (straight-alpha RGBA, fully transparent where a camera sees nothing), and ``pictures.json`` with the
    request. A second call with the same request renders only missing and damaged pictures. Workers and device may differ. Clip distances
    affect only what the camera sees: clipped parts still cast shadows and reflect light.

    Parameters
    ----------
    tree
        A tree, as for :func:`~bbfit.blender.views_folder.render_views`.
    cameras
        V pinhole or orthographic cameras with square pictures of at most 16384 pixels, square pixels and a centered principal point.
    out
        The folder for the pictures. It is created if it does not exist.
    config
        Light, samples, denoising, device, workers and seed. Its other options are ignored.
    clips
        The nearest and the farthest visible distance from each camera along its axis, in meters: V pairs with 0 < nearest < farthest. By
        default everything is visible.
    depth
        Also write ``0000_depth.png`` and so on (:func:`depth_path`), which needs ``clips``. Its red channel is 0 at the nearest and 255 at
        the farthest distance, and where a camera sees nothing.
    on_progress
        Called with the number of finished pictures and the total number, at the start and after each picture.

    Returns
    -------
    list of Path
        The paths of the V pictures.

    Raises
    ------
    MissingFileError, InputError
        If the tree or the cameras cannot be used. If ``out`` contains other pictures or cannot be written to. If Blender is not installed.
    BlenderError
        If Blender crashes repeatedly. Finished pictures are kept.
    """
    cameras, out = cameras.batch().to(torch.float64), Path(out)
    _check(cameras, clips)
    if depth and clips is None:
        fail("depth", "its range is that of the clip distances", "give clips")
    tree = TreeFile.open(tree)
    request = ViewsRequest.of(tree, config)
    request = replace(
        request,
        config={name: value for name, value in request.config.items() if name not in _UNUSED},
        cameras=_cameras_as_json(cameras),
        clips=None if clips is None else [[float(end) for end in clip] for clip in clips],
    )
    if request.check_same(out, PICTURES_FILE) is None and out.is_dir() and any(out.glob("[0-9][0-9][0-9][0-9]*.png")):
        fail("out", f"{out} contains pictures from elsewhere", f"choose another output folder, or remove {out} to render again")
    count, size = len(cameras), cameras.width
    paths = [out / f"{index:04}.png" for index in range(count)]
    wanted = [[path, depth_path(path)] if depth else [path] for path in paths]
    missing = [index for index, files in enumerate(wanted) if not all(is_intact(file, size) for file in files)]
    on_progress = on_progress or (lambda done, total: None)
    on_progress(count - len(missing), count)
    if not missing:
        return paths
    require_bpy()
    with claimed_folder("out", out), BlenderPool(worker_settings(tree, config, size, len(missing))) as pool:
        points = hull_vertices(to_y_up(pool.load()["payload"]))
        request.save(out / PICTURES_FILE)
        visible = clips or [clip_distances(points, position) for position in cameras.position]
        report, finished = on_progress, count - len(missing)
        requests = frames(cameras, paths, missing, visible, config, None if depth else visible_hull(tree, points))
        if depth:  # which is 0, as at the nearest distance, outside the part that is rendered
            requests = [request | {"depth": str(depth_path(paths[request["frame"]]).resolve())} for request in requests]
        pool.render(requests, config.render_workers, finished, lambda done: report(done, count))
    return paths


def depth_path(picture: Path) -> Path:
    """The file of the depth of a picture."""
    return picture.with_stem(f"{picture.stem}_depth")


def is_intact(path: Path, size: int) -> bool:
    """Whether a picture exists, can be decoded, and has the right size."""
    try:
        return read_rgba(path, InputLimits(max_input_pixels=size**2)).shape == (size, size, 4)
    except InputError:
        return False


def to_y_up(payload: bytes) -> NDArray[np.float64]:
    """Convert the vertices that Blender sends (raw float32, Z up) to the Y-up world, [P, 3]."""
    points = np.frombuffer(payload, np.float32).reshape(-1, 3)
    return points.astype(np.float64) @ np.array(Z_UP_TO_Y_UP)[:3, :3].T


def vertical_axis(low: NDArray[np.floating], high: NDArray[np.floating], axis: str) -> Tensor:
    """The point at half the tree's height on the vertical line that the cameras circle (``ViewsConfig.axis``), [3] float64.

    ``low`` and ``high`` are the corners of the tree's bounding box in meters, [3] each.
    """
    target = torch.from_numpy((np.asarray(low, np.float64) + high) / 2)
    through_origin = all(low[i] <= 0 <= high[i] for i in (0, 2))
    if axis == "origin" or (axis == "auto" and through_origin):
        target[[0, 2]] = 0.0
    return target


def tree_settings(tree: TreeFile) -> dict[str, Any]:
    """The worker's settings for a tree: its main file, and all files that Blender may read for it."""
    return {"tree": str(tree.path.resolve()), "files": [str(file.resolve()) for file in tree.files]}


def worker_settings(tree: TreeFile, config: ViewsConfig, size: int, count: int, *, suns: int = 0) -> dict[str, Any]:
    """The worker's settings for ``count`` pictures of ``size`` x ``size`` pixels. With pictures under single lights, ``suns`` is the
    largest number of a view's suns."""
    return {
        **tree_settings(tree),
        "size": size,
        "denoise": config.denoise,
        "sun_direction": to_z_up(direction(config.sun_azimuth, config.sun_elevation).tolist()),
        "sun_strength": config.sun_strength,
        "ambient_strength": config.ambient_strength,
        "hdri": None if config.hdri is None else str(Path(config.hdri).resolve()),
        "device": config.render_device,
        "suns": suns,
        "threads": max(1, (os.cpu_count() or 1) // max(1, min(config.render_workers, count))),
    }


def clip_distances(points: NDArray[np.float64], position: Tensor) -> tuple[float, float]:
    """Clip distances in meters of a camera at ``position``, [3], that contain every point, [P, 3], in front of the camera."""
    reach = float(np.linalg.norm(points - position.numpy(), axis=-1).max() + 2 * np.ptp(points, axis=0).sum())
    return reach * 1e-5, reach


def visible_hull(tree: TreeFile, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The vertices of a convex hull around all that is seen of a tree, given those of its vertices' hull; ``None`` if more may be seen."""
    return points if tree.path.suffix.lower() in _BOUNDED else None


def frames(
    camera: Camera,
    paths: Sequence[Path],
    indices: Sequence[int],
    clips: Sequence[tuple[float, float]],
    config: ViewsConfig,
    hull: NDArray[np.float64] | None = None,
) -> list[dict[str, Any]]:
    """The worker's requests for the pictures ``indices``. Blender has the camera axes and the Z-up world of the NeRF-synthetic layout.

    Only the part of a picture is rendered that the vertices of the tree's convex hull, [P, 3], bound; without them all of it.
    """
    matrices = camera_to_nerf(camera.world_to_camera)
    requests = []
    for index in indices:
        extent = camera.width / float(camera.intrinsics[index, 0, 0])  # at distance 1, or in meters when orthographic
        requests.append(
            {
                "frame": index,
                "path": str(paths[index].resolve()),
                "camera_to_world": matrices[index].tolist(),
                "fov_degrees": None if camera.orthographic else math.degrees(2 * math.atan(extent / 2)),
                "extent": extent if camera.orthographic else None,
                "clip": [float(end) for end in clips[index]],
                "border": None if hull is None else _border(camera[index], hull),
                "seed": (config.seed + index) % 2**31,
                "samples": config.samples,
            }
        )
    return requests


def _border(camera: Camera, hull: NDArray[np.float64]) -> list[float] | None:
    """Left, bottom, right and top edge of the pixels that show the tree, in [0, 1] from the lower left.

    ``None`` for all pixels: if the tree is not all in front of the camera, or is outside the picture.
    """
    pixels = camera.project(torch.from_numpy(hull))
    if pixels.isnan().any():
        return None
    size = torch.tensor([camera.width, camera.height])
    low, high = (pixels.amin(0) - FILTER_REACH).floor(), (pixels.amax(0) + FILTER_REACH).ceil() + 1  # pixel centers are whole numbers
    (left, top), (right, bottom) = (torch.minimum(edge.clamp_min(0), size) / size for edge in (low, high))
    return [float(left), 1 - float(bottom), float(right), 1 - float(top)] if left < right and top < bottom else None


def _check(cameras: Camera, clips: Sequence[tuple[float, float]] | None) -> None:
    size, k = cameras.width, cameras.intrinsics
    if cameras.height != size:
        fail("cameras", f"expected square pictures, got {size}x{cameras.height}")
    check_range("size", size, 1, 16384)
    expected = torch.zeros_like(k)
    expected[:, 0, 0] = expected[:, 1, 1] = k[:, 0, 0]
    expected[:, :2, 2], expected[:, 2, 2] = (size - 1) / 2, 1
    if not torch.allclose(k, expected, rtol=1e-9, atol=_INTRINSICS_TOLERANCE):
        fail("cameras", "expected square pixels and the principal point at the center of the picture")
    if clips is not None:
        if len(clips) != len(cameras):
            fail("clips", f"expected one pair for each of {len(cameras)} cameras, got {len(clips)}")
        for near, far in clips:
            if not 0 < near < far < math.inf:
                fail("clips", f"expected 0 < nearest < farthest, got {near} and {far}")


def _cameras_as_json(cameras: Camera) -> dict[str, Any]:
    return {
        "size": cameras.width,
        "orthographic": cameras.orthographic,
        "world_to_camera": cameras.world_to_camera.tolist(),
        "focal": cameras.intrinsics[:, 0, 0].tolist(),
    }
