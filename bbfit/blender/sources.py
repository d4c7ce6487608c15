"""Tree files before Blender sees them: which formats there are, which files belong to a tree, and what is refused."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import MissingFileError, check_file, fail

# The axis that points up in files of each format. An FBX or USD may say otherwise than this default, and its importer follows.
UP_AXIS = {
    ".glb": "y",
    ".gltf": "y",
    ".obj": "y",
    ".fbx": "y",
    ".usd": "y",
    ".usda": "y",
    ".usdc": "y",
    ".usdz": "y",
    ".ply": "z",
    ".stl": "z",
    ".blend": "z",
}
_GLTF_FLOAT, _GLTF_JSON_CHUNK, _GLTF_BINARY_CHUNK = 5126, 0x4E4F534A, 0x004E4942
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def check_tree(tree: str | Path) -> list[Path]:
    """Refuse what is known to be bad without loading it, and list the files that make up the tree, the named one first.

    Raises
    ------
    MissingFileError, InputError
        if the file, or one that a glTF refers to, is missing; if the file is empty, of an unknown format, or a damaged glTF; if
        a glTF refers to a file outside its folder; if a glTF or PLY holds vertices that are NaN or infinite, which Blender's
        importers of these two silently replace by 0.
    """
    path = check_file("tree", tree)
    ending = path.suffix.lower()
    if ending not in UP_AXIS:
        fail("tree", f"{path} has an unknown format", f"expected one of {' '.join(UP_AXIS)}")
    if ending in (".glb", ".gltf"):
        return [path, *_check_gltf(path)]
    if ending == ".ply":
        _check_finite(path, _ply_positions(path.read_bytes()))
    if ending == ".obj":
        names = re.findall(rb"^mtllib\s+(.+?)\s*$", path.read_bytes(), re.MULTILINE)
        libraries = [path.parent / name.decode(errors="replace") for name in names]
        return [path, *(library for library in dict.fromkeys(libraries) if library.is_file())]
    return [path]


def fingerprint(files: list[Path]) -> str:
    """SHA-256 over the contents of files, as hexadecimal digits; of a single file that file's own."""
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _check_gltf(path: Path) -> list[Path]:
    content, binary = _gltf_parts(path)
    buffers: list[bytes] = []
    files: list[Path] = []
    for kind in ("buffers", "images"):
        for entry in _entries(content, kind):
            uri = entry.get("uri")
            if uri is None:
                data = binary
            elif not isinstance(uri, str):
                fail("tree", f"{path} has a damaged list of {kind}", "export the tree anew")
            elif uri.startswith("data:"):
                data = _decode_data_uri(path, uri) if kind == "buffers" else b""
            else:
                files.append(_inside_folder(path, uri))
                data = files[-1].read_bytes() if kind == "buffers" else b""
            if kind == "buffers":
                buffers.append(data)
    for mesh in _entries(content, "meshes"):
        for primitive in _entries(mesh, "primitives"):
            positions = _gltf_positions(content, primitive, buffers)
            if positions is not None:
                _check_finite(path, positions)
    return list(dict.fromkeys(files))


def _gltf_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a glTF (glTF 2.0 specification, section 4.4 for the binary container)."""
    data, binary = path.read_bytes(), b""
    text = data
    if data[:4] == b"glTF":
        length = struct.unpack_from("<I", data, 8)[0] if len(data) >= 20 else 0
        if length < 20 or length > len(data):
            fail("tree", f"{path} is cut short", "get or export the file anew")
        start, text = 12, b""
        while start + 8 <= length:
            size, kind = struct.unpack_from("<II", data, start)
            if kind == _GLTF_JSON_CHUNK and not text:
                text = data[start + 8 : start + 8 + size]
            elif kind == _GLTF_BINARY_CHUNK and not binary:
                binary = data[start + 8 : start + 8 + size]
            start += 8 + size
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        fail("tree", f"{path} is no glTF ({error})", "get or export the file anew")
    if not isinstance(content, dict):
        fail("tree", f"{path} is no glTF", "get or export the file anew")
    return content, binary


def _entries(content: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    found = content.get(kind, [])
    return [entry for entry in found if isinstance(entry, dict)] if isinstance(found, list) else []


def _inside_folder(path: Path, uri: str) -> Path:
    """The file that a glTF's reference means, which must lie beside or below the glTF."""
    name = unquote(uri).replace("\\", "/")
    folder = path.parent.resolve()
    scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name)
    if scheme or name.startswith("/") or not (folder / name).resolve().is_relative_to(folder):
        fail("tree", f"{path} refers to {uri}, outside its own folder", "export the tree as one .glb file")
    target = path.parent / name
    if not target.is_file():
        raise MissingFileError(f"tree: {path} refers to {uri}, which does not exist; export the tree as one .glb file")
    return target


def _decode_data_uri(path: Path, uri: str) -> bytes:
    try:
        return base64.b64decode(uri.partition(",")[2])
    except (binascii.Error, ValueError) as error:
        fail("tree", f"{path} holds a damaged data URI ({error})", "export the tree anew")


def _gltf_positions(content: dict[str, Any], primitive: dict[str, Any], buffers: list[bytes]) -> NDArray[np.float32] | None:
    """POSITION of a primitive, [P, 3]; None where it is packed, sparse or damaged, which is left to Blender to judge."""
    try:
        accessor = content["accessors"][primitive["attributes"]["POSITION"]]
        view = content["bufferViews"][accessor["bufferView"]]
        data = buffers[view["buffer"]]
        if accessor["componentType"] != _GLTF_FLOAT:
            return None
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = (view.get("byteStride", 12), 4)
        return np.ndarray((accessor["count"], 3), "<f4", data, start, strides)
    except (KeyError, IndexError, TypeError, ValueError):
        return None


def _ply_positions(data: bytes) -> NDArray[np.floating] | None:
    """x, y, z of a PLY's vertices, [P, 3] (Turk 1994); None where the header is unusual, which is left to Blender to judge."""
    header, found, body = data.partition(b"end_header")
    lines = [line.split() for line in header.decode("latin-1").splitlines() if line.strip()]
    elements = [i for i, line in enumerate(lines) if line[0] == "element"]
    if not found or not elements or lines[elements[0]][1:2] != ["vertex"] or len(lines[elements[0]]) != 3:
        return None
    count = lines[elements[0]][2]
    last = elements[1] if len(elements) > 1 else len(lines)
    properties = [line[1:] for line in lines[elements[0] + 1 : last] if line[0] == "property"]
    encoding = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
    if not count.isdigit() or any(len(p) != 2 or p[0] not in _PLY_TYPES for p in properties):
        return None
    names = [name for _, name in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        return None
    body = body.lstrip(b"\r").removeprefix(b"\n")
    try:
        if encoding == "ascii":
            words = [line.split() for line in body.splitlines()[: int(count)]]
            return np.array([[float(row[names.index(axis)]) for axis in "xyz"] for row in words]).reshape(-1, 3)
        order = ">" if encoding == "binary_big_endian" else "<"
        layout = np.dtype([(name, order + _PLY_TYPES[kind]) for kind, name in properties])
        rows = np.frombuffer(body, layout, int(count))
    except (ValueError, IndexError):
        return None
    return np.stack([np.asarray(rows[axis], np.float64) for axis in "xyz"], -1)


def _check_finite(path: Path, positions: NDArray[np.floating] | None) -> None:
    if positions is not None and not np.isfinite(positions).all():
        fail("tree", f"{path} has vertices that are NaN or infinite", "export the tree anew")
