"""The trees of a library as parts of other glTF files: their meshes, what these refer to, and where they are in the tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.glb import gltf_parts
from bbfit.inputs import InputLimits, reading
from bbfit.library.manifest import Library

_HINT = "build the library again"
_SHEARED = 1e-4
_DEEPEST = 64


@dataclass(frozen=True)
class Part:
    """A mesh of a tree, and where it is: scaled first, then turned, then moved."""

    mesh: int
    """Index into the meshes of the tree's glTF."""
    translation: NDArray[np.float64]
    """Meters, [3]."""
    rotation: NDArray[np.float64]
    """Unit quaternion (x, y, z, w), [4]."""
    scale: NDArray[np.float64]
    """Factors along the axes, [3]."""


@dataclass(frozen=True)
class Prototype:
    """A level of detail of a tree."""

    name: str
    """A name for its files and nodes, unique in the library."""
    document: dict[str, Any]
    """Its glTF's JSON."""
    binary: bytes
    """Its buffer; empty where it is in a file of its own."""
    size: int
    """Number of bytes of its buffer."""
    images: tuple[Path | None, ...]
    """The file of each image, ``None`` for those in the buffer."""
    parts: tuple[Part, ...]
    """Its meshes."""
    triangles: int
    """Number of its triangles."""


def read_prototype(library: Library, tree: int, level: int, limits: InputLimits) -> Prototype:
    """A level of a tree of a library. Raises InputError or MissingFileError if its file is damaged, or refers to files elsewhere."""
    described = library.trees[tree]
    path = library.folder / described.levels[level].file
    limits.at_most("max_input_bytes", "library", path, path.stat().st_size, "bytes")
    document, binary = gltf_parts(path.read_bytes(), "library", path)
    with reading("library", path, _HINT):
        _check(document, binary)
        scene = document["scenes"][document.get("scene", 0)]
        parts = tuple(part for node in scene["nodes"] for part in _parts(document, node, np.eye(4), 0))
        if not parts:
            fail("library", f"{path} shows no mesh", _HINT)
        images = tuple(_image_file(image, path, library, limits) for image in document.get("images", []))
        for image in filter(None, images):
            if not image.is_file() or not image.stat().st_size:
                fail("library", f"{image}, to which {path} refers, is missing or empty", _HINT)
    return Prototype(f"{tree}_{level}", document, binary, len(binary), images, parts, described.levels[level].triangles)


def quaternion_product(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation ``second`` and then ``first``, of quaternions (x, y, z, w), [..., 4]."""
    a, u, b, v = first[..., 3:], first[..., :3], second[..., 3:], second[..., :3]
    return np.concatenate([a * v + b * u + np.cross(u, v), a * b - np.sum(u * v, -1, keepdims=True)], -1)


def rotated(rotation: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points turned by unit quaternions (x, y, z, w), [..., 3]."""
    u, w = rotation[..., :3], rotation[..., 3:]
    twice = 2 * np.cross(u, points)
    return points + w * twice + np.cross(u, twice)


def _check(document: dict[str, Any], binary: bytes) -> None:
    """Require that everything in a glTF that is needed lies within its binary chunk. Raises errors of any kind otherwise."""
    buffers = document["buffers"]
    if len(buffers) != 1 or "uri" in buffers[0] or not 0 < buffers[0]["byteLength"] <= len(binary):
        raise ValueError("its data is not all in its binary chunk")
    if document.keys() & {"skins", "animations"}:
        raise ValueError("it is animated")
    for view in document["bufferViews"]:
        start, size = view.get("byteOffset", 0), view["byteLength"]
        if view["buffer"] != 0 or start < 0 or size <= 0 or start + size > len(binary):
            raise ValueError("it is cut short")
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            for index in [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]:
                accessor = document["accessors"][index]
                if not 0 <= accessor["bufferView"] < len(document["bufferViews"]) or accessor["count"] < 1 or "sparse" in accessor:
                    raise ValueError("a mesh has no vertices")
            if not {"min", "max"} <= document["accessors"][primitive["attributes"]["POSITION"]].keys():
                raise ValueError("a mesh has no bounds")


def _parts(document: dict[str, Any], index: int, outer: NDArray[np.float64], depth: int) -> Iterator[Part]:
    """The meshes of a node and of those below it."""
    if depth > _DEEPEST:
        raise ValueError("its nodes are nested too deeply")
    node = document["nodes"][index]
    matrix = outer @ _matrix(node)
    if "mesh" in node:
        yield _part(node["mesh"], matrix)
    for child in node.get("children", []):
        yield from _parts(document, child, matrix, depth + 1)


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = np.array(node.get("rotation", (0, 0, 0, 1)), float)
    matrix[:3, :3] = rotated(rotation / np.linalg.norm(rotation), np.eye(3)).T * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _part(mesh: int, matrix: NDArray[np.float64]) -> Part:
    """A mesh with a matrix that scales, turns and moves it."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    if not np.isfinite(matrix).all() or (scale == 0).any():
        raise ValueError("a node has no usable matrix")
    turn = matrix[:3, :3] / scale
    if np.linalg.det(turn) < 0:
        scale, turn = -scale, -turn
    if np.abs(turn.T @ turn - np.eye(3)).max() > _SHEARED:
        raise ValueError("a node is sheared")
    return Part(mesh, matrix[:3, 3], _quaternion(turn), scale)


def _quaternion(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation matrix as a unit quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(turn).as_quat(), float)


def _image_file(image: dict[str, Any], path: Path, library: Library, limits: InputLimits) -> Path | None:
    if "uri" not in image:
        return None
    if image["uri"].startswith("data:"):
        raise ValueError("a picture is a data URI")
    return limits.referenced("library", path, image["uri"], library.folder)
