"""The files of a glTF, and its check before a program loads it."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from bbfit.checks import MissingFileError, fail
from bbfit.glb import gltf_parts
from bbfit.inputs import InputLimits, reading
from bbfit.tree_files.gltf_checks import check_gltf, entries_of, slice_of
from bbfit.tree_files.pictures import check_pictures

_AGAIN = "export the tree again"


def read_gltf(path: Path, limits: InputLimits) -> list[Path]:
    """The files that a .gltf or .glb refers to, after a check of everything that programs trust when they load it.

    Raises ``MissingFileError`` or ``InputError`` if the file is damaged or exceeds the limits, or refers to a file that is missing or
    outside of its folder and the allowed folders.
    """
    with reading("tree", path, _AGAIN), np.errstate(all="ignore"):
        content, binary = gltf_parts(path.read_bytes(), "tree", path)
        files, buffers, pictures = dict[Path, bytes](), list[bytes](), list[Path | bytes]()
        for entry in entries_of(content, "buffers"):
            uri = entry.get("uri")
            if isinstance(uri, str) and not uri.startswith("data:"):
                file = _referenced(path, uri, limits)
                if file not in files:
                    total = path.stat().st_size + sum(map(len, files.values())) + file.stat().st_size
                    limits.at_most("max_input_bytes", "tree", path, total, "bytes")
                    files[file] = file.read_bytes()
                buffers.append(files[file])
            else:
                buffers.append(binary if uri is None else decoded_uri(uri))
        views = entries_of(content, "bufferViews")
        for entry in entries_of(content, "images"):
            uri = entry.get("uri")
            if uri is None and "bufferView" in entry:
                pictures.append(bytes(slice_of(views, entry["bufferView"], buffers)))
            elif isinstance(uri, str) and not uri.startswith("data:"):
                pictures.append(_referenced(path, uri, limits))
            elif uri is not None:
                pictures.append(decoded_uri(uri))
        check_gltf(path, content, buffers, limits)
        check_pictures(path, pictures, limits)
        return list(dict.fromkeys((*files, *(picture for picture in pictures if isinstance(picture, Path)))))


def _referenced(path: Path, uri: str, limits: InputLimits) -> Path:
    """The file that a URI of a glTF refers to."""
    name = unquote(uri).replace("\\", "/")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name):
        fail("tree", f"{path} refers to {uri}, outside its own folder", "export the tree as one .glb file")
    target = limits.referenced("tree", path, name, path.parent)
    if not target.is_file():
        raise MissingFileError(f"tree: {path} refers to {uri}, which does not exist; export the tree as one .glb file")
    return target


def decoded_uri(uri: Any) -> bytes:
    """The bytes in a data URI."""
    if not isinstance(uri, str):
        raise ValueError("a URI is no text")
    return base64.b64decode(uri.partition(",")[2])
