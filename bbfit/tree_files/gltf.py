"""The files and vertex positions of a glTF, for checks before a program loads it."""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import MissingFileError, fail
from bbfit.glb import gltf_parts
from bbfit.inputs import InputLimits

_FLOAT = 5126


def read_gltf(path: Path, limits: InputLimits) -> tuple[list[Path], list[NDArray[np.float32]]]:
    """The files that a .gltf or .glb refers to, and the vertex positions of its primitives, [P, 3] each.

    Packed, sparse and damaged positions are omitted. The program that loads the file checks those. Raises ``MissingFileError`` or
    ``InputError`` if the file is damaged, or refers to a file that is missing or outside its folder.
    """
    content, binary = gltf_parts(path.read_bytes(), "tree", path)
    buffers: list[bytes] = []
    files: list[Path] = []
    for kind in ("buffers", "images"):
        for entry in _entries(content, kind):
            uri, data = entry.get("uri"), b""
            if uri is None:
                data = binary
            elif not isinstance(uri, str):
                fail("tree", f"{path} has a damaged list of {kind}", "export the tree again")
            elif not uri.startswith("data:"):
                files.append(_referenced(path, uri, limits))
                data = files[-1].read_bytes() if kind == "buffers" else b""
            elif kind == "buffers":
                data = _decode_data_uri(path, uri)
            if kind == "buffers":
                buffers.append(data)
    primitives = [primitive for mesh in _entries(content, "meshes") for primitive in _entries(mesh, "primitives")]
    read = (_positions(content, primitive, buffers) for primitive in primitives)
    return list(dict.fromkeys(files)), [positions for positions in read if positions is not None]


def _entries(content: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    entries = content.get(kind, [])
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def _referenced(path: Path, uri: str, limits: InputLimits) -> Path:
    """The file that a URI of a glTF refers to."""
    name = unquote(uri).replace("\\", "/")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name):
        fail("tree", f"{path} refers to {uri}, outside its own folder", "export the tree as one .glb file")
    target = limits.referenced("tree", path, name, path.parent)
    if not target.is_file():
        raise MissingFileError(f"tree: {path} refers to {uri}, which does not exist; export the tree as one .glb file")
    return target


def _decode_data_uri(path: Path, uri: str) -> bytes:
    try:
        return base64.b64decode(uri.partition(",")[2])
    except (binascii.Error, ValueError) as error:
        fail("tree", f"{path} contains a damaged data URI ({error})", "export the tree again")


def _positions(content: dict[str, Any], primitive: dict[str, Any], buffers: list[bytes]) -> NDArray[np.float32] | None:
    """The POSITION attribute of a primitive, [P, 3]. ``None`` if it is packed, sparse or damaged."""
    try:
        accessor = content["accessors"][primitive["attributes"]["POSITION"]]
        view = content["bufferViews"][accessor["bufferView"]]
        data = buffers[view["buffer"]]
        if accessor["componentType"] != _FLOAT:
            return None
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = (view.get("byteStride", 12), 4)
        return np.ndarray((accessor["count"], 3), "<f4", data, start, strides)
    except (KeyError, IndexError, TypeError, ValueError):
        return None
