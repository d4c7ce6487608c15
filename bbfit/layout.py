"""The NeRF-synthetic layout of a views folder: ``transforms_train.json`` and ``transforms_test.json`` beside the pictures.

Files and their meaning follow Mildenhall et al. 2020 (``camera_angle_x``, ``frames[].file_path`` without its ending,
``frames[].transform_matrix``) and nerfstudio's extension of it (``w``, ``h``, ``fl_x``, ``fl_y``, ``cx``, ``cy``, for the file or for a
frame).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import MissingFileError, check_range, fail
from bbfit.files import read_json, write_json
from bbfit.geometry.camera import Camera, camera_from_nerf, camera_to_nerf, pinhole_intrinsics
from bbfit.geometry.light import Light, from_z_up, to_z_up
from bbfit.inputs import LARGEST, InputLimits, reading

_LIMITS = InputLimits()
TRAIN_FILE, TEST_FILE, SINGLE_FILE = "transforms_train.json", "transforms_test.json", "transforms.json"
TURNED_FILE = "transforms_turned.json"
"""File beside the transforms with the cameras of second pictures of some held-out views, each turned by one degree around the tree. An
entry ``turned_from`` names the ``file_path`` of its view in the file of test views."""
LIT_TRAIN_FILE, LIT_TEST_FILE = "transforms_lights_train.json", "transforms_lights_test.json"
"""Files beside the transforms with pictures of the same cameras under one light at a time, in the same split. Each frame has a ``light``:
``sun_direction`` (towards the sun, in the axes of the file), ``sun_strength``, ``sun_color`` and ``ambient``, as in
:class:`~bbfit.geometry.light.Light`, of which either ``sun_strength`` or ``ambient`` is 0. A frame of the sky may have an ``albedo_path``
and a ``normal_path``. In the other files ``light`` is the light of the picture."""
REQUEST_FILE = "views.json"
"""File beside the transforms in which ``bbfit views`` records its options and facts about the tree."""
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "ORTHOGRAPHIC")
"""Values of ``camera_model`` that are read; with OPENCV the distortion coefficients must be zero."""
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
TEST_SHARE = 0.25
_EXPECTED = "expected the NeRF-synthetic layout"
_PICTURES = (".png", ".webp", ".jpg", ".jpeg", ".tif", ".tiff", ".exr")
# The entries that are read, of a file or of a frame.
_HEADER = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_model", *_DISTORTION)
# Least and greatest focal length in sizes of the picture: views of 0.3 millimeters to 3000 kilometers, or of 179.9 to 0.00002 degrees.
_FOCAL_LENGTHS = (1e-6, 1e7)
# Greatest ratio of the sides of a pixel.
_LONGEST_PIXEL = 100.0
# How far the principal point may lie outside the picture, in sizes of the picture.
_FARTHEST_CENTER = 10.0
# Accepted deviation of a camera's axes from orthonormal; many files have four decimals.
RIGID_TOLERANCE = 1e-3


def split_views(count: int, seed: int) -> tuple[list[int], list[int]]:
    """A seeded random quarter of ``count`` views as test views (thesis, section 5): sorted training and test indices.

    At least one view stays on either side when there are two or more.
    """
    test = sorted(np.random.default_rng(seed).permutation(count)[: _test_count(count)].tolist())
    return sorted(set(range(count)) - set(test)), test


def _test_count(count: int) -> int:
    """Number of test views among ``count`` >= 1 views."""
    return min(max(round(count * TEST_SHARE), 1), count - 1)


def split_rings(counts: Sequence[int], seed: int) -> tuple[list[int], list[int]]:
    """A seeded random quarter of each ring of views as test views: sorted training and test indices. A ring of one view is for training.

    The test views of a ring are spread around the tree: one at random out of every four neighbors. A tree is harder to show from some sides
    than from others, so rings would not be comparable if their test views came from different sides. ``counts`` are the numbers of views on
    rings that follow each other. There are at least two views.
    """
    test, begin = list[int](), 0
    for ring, count in enumerate(counts):
        parts, random = _test_count(count), np.random.default_rng(seed + ring)
        edges = [begin + count * part // max(parts, 1) for part in range(parts + 1)]
        test += [int(random.integers(first, last)) for first, last in pairwise(edges)]
        begin += count
    return (sorted(set(range(begin)) - set(test)), test) if test else split_views(begin, seed)


def write_transforms(
    folder: Path, camera: Camera, image_paths: list[str], train: list[int], test: list[int], light: Light | None = None
) -> None:
    """Write both transforms files for a batch of cameras and ``image_paths``, which are relative to ``folder`` and end in ``.png``.

    ``light`` is that of all pictures, a batch of one, if it is known. The layout does not know orthographic cameras. Theirs have
    ``camera_model = "ORTHOGRAPHIC"`` and ``orthographic_extent_x`` in meters, as well as intrinsics in pixels per meter.
    """
    header = _camera_header(camera)
    frames = _entries(camera, image_paths)
    if light is not None:
        frames = [entry | {"light": _light_entry(light)} for entry in frames]
    for name, indices in ((TRAIN_FILE, train), (TEST_FILE, test)):
        write_json(folder / name, header | {"frames": [frames[index] for index in indices]})


@dataclass(frozen=True)
class LitPaths:
    """The pictures of one view under one light at a time, as paths relative to the folder of the views."""

    ambient: str
    """The picture under an even sky of strength 1."""
    suns: list[str]
    """The pictures under single suns of strength pi: a matte white surface that faces the sun is white."""
    directions: Tensor
    """Unit vectors towards those suns, Y up, one a row."""
    albedo: str
    """The diffuse color of the surfaces."""
    normal: str
    """The normals of the surfaces, as (normal + 1) / 2, in the axes of the file."""


def write_lit(folder: Path, camera: Camera, lit: Mapping[int, LitPaths], train: Sequence[int], test: Sequence[int]) -> None:
    """Write :data:`LIT_TRAIN_FILE` and :data:`LIT_TEST_FILE` for some views of a batch of cameras: the keys of ``lit``, which are split."""
    header, sky = _camera_header(camera), Light.of(torch.tensor([[0.0, 1.0, 0.0]]), 0.0, 1.0)
    for name, indices in ((LIT_TRAIN_FILE, train), (LIT_TEST_FILE, test)):
        frames = list[dict[str, Any]]()
        for index in indices:
            paths, each = lit[index], Light.of(lit[index].directions, math.pi, 0.0)
            entries = _entries(camera[[index] * (1 + len(paths.suns))], [paths.ambient, *paths.suns])
            entries[0] |= {"albedo_path": _reference(paths.albedo), "normal_path": _reference(paths.normal)}
            lights = [sky, *(each[[number]] for number in range(len(each)))]
            frames += [entry | {"light": _light_entry(light)} for entry, light in zip(entries, lights, strict=True)]
        write_json(folder / name, header | {"frames": frames})


def _light_entry(light: Light) -> dict[str, Any]:
    """The entry of a light, a batch of one, in the file's axes."""
    strength, towards = light.sun_strengths.item(), to_z_up(light.sun_directions[0].tolist())
    sun = {"sun_direction": towards, "sun_strength": strength, "sun_color": light.sun_colors[0].tolist()}
    return (sun if strength else {"sun_strength": 0.0}) | {"ambient": light.ambients.item()}


def write_turned(folder: Path, camera: Camera, image_paths: list[str], views: list[str]) -> None:
    """Write :data:`TURNED_FILE` for a batch of cameras, their pictures and the pictures of the views that they are turned from.

    Paths are as in :func:`write_transforms`.
    """
    frames = [entry | {"turned_from": _reference(view)} for entry, view in zip(_entries(camera, image_paths), views, strict=True)]
    write_json(folder / TURNED_FILE, _camera_header(camera) | {"frames": frames})


def _reference(image_path: str) -> str:
    return "./" + image_path.removesuffix(".png")


def _entries(camera: Camera, image_paths: list[str]) -> list[dict[str, Any]]:
    """The entry of each camera of a batch in a transforms file."""
    matrices = camera_to_nerf(camera.world_to_camera.double()).tolist()
    return [{"file_path": _reference(path), "transform_matrix": matrix} for path, matrix in zip(image_paths, matrices, strict=True)]


def _camera_header(camera: Camera) -> dict[str, Any]:
    """The entries of a transforms file that hold for all cameras of a batch."""
    k = camera.intrinsics[0].double()
    header: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": k[0, 0].item(),
        "fl_y": k[1, 1].item(),
        "cx": k[0, 2].item() + 0.5,  # the layout counts from the pixel's corner
        "cy": k[1, 2].item() + 0.5,
    }
    if camera.orthographic:
        header |= {"camera_model": "ORTHOGRAPHIC", "orthographic_extent_x": camera.width / header["fl_x"]}
    else:
        header |= {"camera_model": "OPENCV", "camera_angle_x": 2 * math.atan(0.5 * camera.width / header["fl_x"])}
    return header


@dataclass(frozen=True)
class Frame:
    """One entry of a transforms file."""

    image: Path
    """The picture's file."""
    camera_to_world: list[list[float]]
    """Z-up world, OpenGL camera axes, 4 x 4."""
    header: dict[str, Any]
    """The file's entries with the frame's own ones over them."""
    light: Light | None = None
    """The light, a batch of one, if the file has it."""
    passes: Mapping[str, Path] = field(default_factory=dict)
    """The pictures ``albedo`` and ``normal`` of the frame, if the file has them."""


def read_frames(folder: Path, limits: InputLimits = _LIMITS) -> tuple[list[Frame], list[Frame] | None]:
    """Training and test frames of a views folder; ``None`` for the test frames where the folder names none.

    ``transforms.json`` alone (nerfstudio) is split by the ``test_filenames`` in it; without those, it and a training file alone are
    read as one list. Raises ``InputError`` if the files are damaged, or name pictures outside of the folder and the allowed folders.
    """
    for name in (TRAIN_FILE, SINGLE_FILE):
        if (folder / name).is_file():
            train, held_out = _read_file(folder / name, limits)
            if (folder / TEST_FILE).is_file():
                return train, _read_file(folder / TEST_FILE, limits)[0]
            if not held_out:
                return train, None
            test = [frame for frame in train if frame.header["file_path"] in held_out]
            return [frame for frame in train if frame.header["file_path"] not in held_out], test
    raise MissingFileError(f"views: {folder} has no {TRAIN_FILE} or {SINGLE_FILE}; give a folder that bbfit views wrote")


def read_lit(folder: Path, limits: InputLimits = _LIMITS) -> tuple[list[Frame], list[Frame]] | None:
    """The frames of :data:`LIT_TRAIN_FILE` and :data:`LIT_TEST_FILE`, all with a light. ``None`` if neither file exists.

    Raises ``InputError`` if a file is damaged or missing, a frame has no light or two, and the errors of :func:`read_frames`.
    """
    paths = [folder / name for name in (LIT_TRAIN_FILE, LIT_TEST_FILE)]
    if not any(path.is_file() for path in paths):
        return None
    for path in paths:
        if not path.is_file():
            raise MissingFileError(f"views: {path} does not exist; render the views anew, or remove the other transforms_lights file")
    train, test = (_read_file(path, limits)[0] for path in paths)
    for path, frames in zip(paths, (train, test), strict=True):
        for number, frame in enumerate(frames):
            if frame.light is None or bool(frame.light.sun_strengths > 0) == bool(frame.light.ambients > 0):
                fail(
                    "views", f"frame {number} of {path} has not exactly one light", "give each either a sun_strength or an ambient above 0"
                )
    return train, test


def read_turned(folder: Path, test: Sequence[Frame], limits: InputLimits = _LIMITS) -> list[tuple[int, Frame]]:
    """The frames of :data:`TURNED_FILE`, each with the index of its view among the test frames. None if there is no such file.

    Raises ``InputError`` if the file is damaged or a frame is turned from no test view, and the errors of :func:`read_frames`.
    """
    path = folder / TURNED_FILE
    if not path.is_file():
        return []
    indices = {frame.header["file_path"]: index for index, frame in enumerate(test)}
    pairs = []
    for number, frame in enumerate(_read_file(path, limits)[0]):
        view = frame.header.get("turned_from")
        if not isinstance(view, str) or view not in indices:
            fail("views", f"frame {number} of {path} is turned from no held-out view", f"render the views anew, or remove {path.name}")
        pairs.append((indices[view], frame))
    return pairs


def _read_file(path: Path, limits: InputLimits) -> tuple[list[Frame], set[str]]:
    """The frames of a transforms file, and the pictures that it holds out."""
    content = read_json("views", path)
    with reading("views", path, _EXPECTED), np.errstate(all="ignore"):
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
            fail("views", f"{path} has no list of frames", _EXPECTED)
        limits.at_most("max_input_frames", "views", path, len(content["frames"]), "views")
        header, frames, known = {key: content[key] for key in _HEADER if key in content}, [], dict[str, Path]()
        for index, entry in enumerate(content["frames"]):
            if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
                fail("views", f"frame {index} of {path} has no file_path", _EXPECTED)
            matrix = _matrix(entry.get("transform_matrix"))
            if matrix is None:
                fail("views", f"frame {index} of {path} has no rigid 4x4 transform_matrix in meters", _EXPECTED)
            reference = entry["file_path"]
            if reference not in known:
                ending = "" if Path(reference).suffix.lower() in _PICTURES else ".png"
                known[reference] = limits.referenced("views", path, reference + ending, path.parent)
            own = {key: entry[key] for key in ("file_path", "turned_from", *_HEADER) if key in entry}
            passes = {
                name: limits.referenced("views", path, f"{entry[key]}.png", path.parent)
                for name in ("albedo", "normal")
                if isinstance(entry.get(key := f"{name}_path"), str)
            }
            light = _light(entry["light"]) if "light" in entry else None
            if "light" in entry and light is None:
                fail("views", f"frame {index} of {path} has no usable light", "give a direction, strengths and a color")
            frames.append(Frame(known[reference], matrix, header | own, light, passes))
        held_out = content.get("test_filenames")
        return frames, {name for name in held_out if isinstance(name, str)} if isinstance(held_out, list) else set()


def _light(entry: Any) -> Light | None:
    """The light of a frame, or ``None`` for what is none. A sun may have no color, which is white, and a sky no sun."""
    if not isinstance(entry, dict):
        return None
    try:
        strength, ambient = float(entry.get("sun_strength", 0)), float(entry.get("ambient", 0))
        x, y, z = map(float, entry.get("sun_direction", () if strength else (0, 0, 1)))
        red, green, blue = map(float, entry.get("sun_color", (1, 1, 1)))
        if not max(abs(x), abs(y), abs(z), strength, ambient, red, green, blue) <= LARGEST:
            return None
        return Light.of(torch.tensor([from_z_up([x, y, z])], dtype=torch.float64), strength, ambient, (red, green, blue))
    except (TypeError, ValueError, OverflowError):
        return None


def _matrix(value: Any) -> list[list[float]] | None:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if array.shape != (4, 4) or not np.isfinite(array).all():
        return None
    rotation = array[:3, :3]
    rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=RIGID_TOLERANCE) and np.linalg.det(rotation) > 0
    near = (np.abs(array[:3, 3]) <= LARGEST).all()
    return array.tolist() if rigid and near and np.allclose(array[3], (0, 0, 0, 1)) else None


def cameras_of(frames: list[Frame], width: int, height: int) -> Camera:
    """The frames' cameras for pictures of ``width`` x ``height`` pixels, float64.

    Intrinsics given for another picture size (``w``, ``h``) are scaled, so pictures may have been reduced since.
    """
    matrices = torch.tensor([frame.camera_to_world for frame in frames], dtype=torch.float64)
    intrinsics = torch.stack([_intrinsics(frame, width, height) for frame in frames])
    parallel = frames[0].header.get("camera_model") == "ORTHOGRAPHIC"
    return Camera(camera_from_nerf(matrices), intrinsics, width, height, parallel)


def _intrinsics(frame: Frame, width: int, height: int) -> torch.Tensor:
    header = frame.header
    if header.get("camera_model", "OPENCV") not in CAMERA_MODELS or any(header.get(name) for name in _DISTORTION):
        fail("views", f"{frame.image.parent.parent}: the pictures are distorted by their lens", "undistort them and their transforms first")
    try:
        if "fl_x" in header:
            scale_x, scale_y = width / float(header.get("w", width)), height / float(header.get("h", height))
            focal_x = float(header["fl_x"])
            focal_y = float(header.get("fl_y", focal_x))
            center_x = float(header.get("cx", float(header.get("w", width)) / 2))
            center_y = float(header.get("cy", float(header.get("h", height)) / 2))
            intrinsics = torch.tensor(
                [[focal_x * scale_x, 0, center_x * scale_x - 0.5], [0, focal_y * scale_y, center_y * scale_y - 0.5], [0, 0, 1]],
                dtype=torch.float64,
            )
        else:
            angle = float(header["camera_angle_x"])
            check_range("camera_angle_x", angle, 0, math.pi, open_low=True, open_high=True)
            intrinsics = pinhole_intrinsics(math.degrees(angle), width, height)
        sizes = torch.tensor([width, height], dtype=torch.float64)
        focal, center = intrinsics.diagonal()[:2] / sizes, intrinsics[:2, 2] / sizes
        low, high = _FOCAL_LENGTHS
        is_sane = ((focal >= low) & (focal <= high) & (center.abs() <= _FARTHEST_CENTER)).all()  # NaN is not
        if is_sane and focal.max() <= _LONGEST_PIXEL * focal.min():
            return intrinsics
    except (KeyError, TypeError, ValueError, ArithmeticError):
        pass
    fail("views", f"{frame.image.parent.parent}: the camera has neither a usable fl_x nor camera_angle_x", "add one of them")
