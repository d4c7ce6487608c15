"""Render views of a tree into a folder. Views that exist already are kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.lit_pictures import LitPictures, light_request, lit_pictures, own_suns, spread
from bbfit.blender.pictures import FILTER_REACH, clip_distances, frames, is_intact, to_y_up, vertical_axis, visible_hull, worker_settings
from bbfit.blender.processes import BlenderError, BlenderPool, require_bpy
from bbfit.blender.request import ViewsRequest
from bbfit.checks import fail
from bbfit.files import remove_parts
from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light, direction
from bbfit.geometry.orbit import hull_vertices
from bbfit.layout import (
    LIT_TEST_FILE,
    LIT_TRAIN_FILE,
    REQUEST_FILE,
    SINGLE_FILE,
    TEST_FILE,
    TRAIN_FILE,
    TURNED_FILE,
    LitPaths,
    split_rings,
    write_lit,
    write_transforms,
    write_turned,
)
from bbfit.outputs import Written, claimed_folder, output_folder
from bbfit.tree_files.tree_file import TreeFile

__all__ = ["BlenderError", "render_views"]

# A tree is invisible from the side from which it is less wide than this.
_LEAST_PIXELS = 1e-4
# Angle between a view and its second picture, in degrees.
_TURN = 1.0


def render_views(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: ViewsConfig | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render views of a tree with Blender's Cycles.

    Writes ``images/0000.png`` and so on (straight-alpha RGBA), ``transforms_train.json``, ``transforms_test.json`` and ``views.json``
    (the request and the measurements of the tree, with ``"complete": true`` once all views are rendered). The transforms are written
    last, so an unfinished folder has none. Every picture contains every vertex. Of ``config.turned`` held-out views there is a second
    picture, ``images/turned_0003.png`` for view 3, from a camera turned by one degree around the tree, with the same seed;
    ``transforms_turned.json`` lists them. A second call with the same tree and options renders only
    missing and damaged views. Workers and device may differ.

    Parameters
    ----------
    tree
        A .glb, .gltf, .obj, .fbx, .usd, .usda, .usdc or .usdz file (Y up unless the file says otherwise), or a .ply, .stl or .blend file
        (Z up).
    out
        The folder for the views. It is created if it does not exist.
    on_progress
        Called with the number of finished pictures and the total number, at the start and after each picture.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    MissingFileError, InputError
        If the tree cannot be used. If ``out`` contains other views or cannot be written to. If Blender is not installed. Existing views
        stay as they were.
    BlenderError
        If Blender crashes repeatedly. Finished views are kept.
    """
    config, out, tree = config or ViewsConfig(), Path(out), TreeFile.open(tree)
    request = ViewsRequest.of(tree, config)
    _earlier(out, request)
    with claimed_folder("out", out):
        _render(tree, out, config, request, on_progress or (lambda done, total: None))
    return out


def _render(tree: TreeFile, out: Path, config: ViewsConfig, request: ViewsRequest, report: Callable[[int, int], None]) -> None:
    """Render the missing views into a claimed folder."""
    earlier = _earlier(out, request)  # again, because another process may just have written it
    images = out / "images"
    paths = [images / f"{index:04}.png" for index in range(config.count)]
    train, test = split_rings(config.orbit.ring_counts, config.seed)
    turned = spread(test, config.turned)
    turned_paths = [path.with_stem(f"turned_{path.stem}") for path in paths]
    lit = lit_pictures(config, paths, train, test)
    of_view = [[path, *(lit[index].paths if index in lit else ())] for index, path in enumerate(paths)]
    missing = [index for index, files in enumerate(of_view) if not all(is_intact(path, config.size) for path in files)]
    missing_turned = [index for index in turned if not is_intact(turned_paths[index], config.size)]
    transforms = [TRAIN_FILE, TEST_FILE, *([TURNED_FILE] if turned else []), *([LIT_TRAIN_FILE, LIT_TEST_FILE] if lit else [])]
    total, left = config.count + len(turned), len(missing) + len(missing_turned)
    if earlier and earlier.complete and not left and all((out / name).is_file() for name in transforms):
        report(total, total)
        return

    started, spent = time.monotonic(), earlier.seconds if earlier else 0.0
    require_bpy()
    suns = max((len(each.suns) for each in lit.values()), default=0)
    with BlenderPool(worker_settings(tree, config, config.size, left, suns=suns)) as pool:
        measured = pool.load()
        points = hull_vertices(to_y_up(measured["payload"]))
        camera, target, distance = _cameras(points, config)
        bounds = (points.min(0).tolist(), points.max(0).tolist())
        request = replace(
            request,
            tree=replace(request.tree, vertices=measured["vertices"], faces=measured["faces"], bounds=bounds),
            camera={"target": target.tolist(), "distance": distance},
            blender=measured["blender"],
        )
        output_folder("out", images)
        remove_parts(images)
        pictures = [*(path for index in missing for path in of_view[index]), *(turned_paths[index] for index in missing_turned)]
        written, files = Written(out), [REQUEST_FILE, *transforms, *(f"images/{path.name}" for path in pictures)]
        if earlier:
            written.adopt("views", written.digests([name for name in files if (out / name).is_file()]))
        written.begin("views", files, [*tree.files, *([config.hdri] if config.hdri else [])])

        def save(*, complete: bool = False) -> None:
            seconds = round(spent + time.monotonic() - started, 3)
            replace(request, seconds=seconds, complete=complete).save(out / REQUEST_FILE)

        def on_done(done: int) -> None:
            save()
            report(done, total)

        finished = total - left
        on_done(finished)
        clips = [clip_distances(points, camera.position[0])] * config.count
        neighbors = camera.turned(_TURN, target)
        hull = visible_hull(tree, points)
        own = frames(camera, paths, missing, clips, config, hull)
        second = frames(neighbors, turned_paths, missing_turned, clips, config, hull)
        training = set(train)
        own = [frame | {"samples": config.samples_of_training} if frame["frame"] in training else frame for frame in own]
        if lit:
            own = [frame | {"lights": _light(frame, lit, config, alone=False)} for frame in own]
            second = [frame | {"lights": _light(frame, lit, config, alone=True)} for frame in second]
        pool.render(own + second, config.render_workers, finished, on_done)
    names, turned_names = ([f"images/{path.name}" for path in each] for each in (paths, turned_paths))
    if turned:
        write_turned(out, neighbors[turned], [turned_names[index] for index in turned], [names[index] for index in turned])
    if lit:
        paths_of = {index: _relative(each, out) for index, each in lit.items()}
        write_lit(out, camera, paths_of, train, [index for index in test if index in lit])
    write_transforms(out, camera, names, train, test, _baked_light(config))
    save(complete=True)
    written.finish("views", written.digests([REQUEST_FILE, *transforms, "images/*.png"]))


def _light(frame: dict[str, Any], lit: dict[int, LitPictures], config: ViewsConfig, *, alone: bool) -> dict[str, Any]:
    """The lights of a frame. A view and its second picture have the same, and so the same noise."""
    each = lit.get(frame["frame"])
    return light_request(own_suns(config)) if each is None else each.request(alone=alone)


def _relative(lit: LitPictures, out: Path) -> LitPaths:
    ambient, *suns, albedo, normal = (path.relative_to(out).as_posix() for path in lit.paths)
    return LitPaths(ambient, suns, torch.tensor(lit.suns, dtype=torch.float64), albedo, normal)


def _baked_light(config: ViewsConfig) -> Light | None:
    """The light of the views' own pictures; a panorama is none."""
    sun = direction(config.sun_azimuth, config.sun_elevation)
    return None if config.hdri is not None else Light.of(sun[None], config.sun_strength, config.ambient_strength)


def _earlier(out: Path, request: ViewsRequest) -> ViewsRequest | None:
    """The request that an earlier call recorded in ``out``. It must be for the same views."""
    if out.exists() and not out.is_dir():
        fail("out", f"{out} is a file, not a folder", "choose another output folder")
    earlier = request.check_same(out, REQUEST_FILE)
    if earlier is None:
        foreign = [out / name for name in (TRAIN_FILE, TEST_FILE, SINGLE_FILE) if (out / name).exists()]
        foreign += sorted((out / "images").glob("[!.]*"))[:1]
        if foreign:
            fail("out", f"{out} contains views from elsewhere ({foreign[0].name})", "choose another output folder")
    return earlier


def _cameras(points: NDArray[np.float64], config: ViewsConfig) -> tuple[Camera, torch.Tensor, float]:
    """Cameras that see every point, the point that they look at, and their distance from it in meters."""
    target = vertical_axis(points.min(0), points.max(0), config.axis)
    camera = config.orbit.frame(
        points,
        target=target,
        width=config.size,
        height=config.size,
        fov_x_degrees=None if config.orthographic else config.fov_degrees,
        margin=max(0.02, FILTER_REACH / config.size),  # so that the outermost pixels stay empty
    )
    if max(_least_width(points, camera[index]) for index in range(config.count)) < _LEAST_PIXELS:
        fail(
            "elevations",
            f"the tree is flat, and all {config.count} cameras see it edge-on, so that no picture would show it",
            "add a ring of another elevation, as in --elevations 0 30",
        )
    return camera, target, float((camera.position[0] - target).norm())


def _least_width(points: NDArray[np.float64], camera: Camera) -> float:
    """The standard deviation of the points, [P, 3], in the picture of a camera, across the direction in which it is least, in pixels."""
    pixels = camera.project(torch.from_numpy(points))
    return float(torch.linalg.svdvals((pixels - pixels.mean(0)) / len(pixels) ** 0.5)[1])
