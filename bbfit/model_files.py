"""What model files of every kind share: the endings they may have, and the GLB container as trimesh writes it."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bbfit.checks import check_folder, fail

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".obj")

# Numbers that glTF 2.0 borrows from OpenGL (specification, section 5.11).
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def check_model_path(name: str, path: str | Path) -> Path:
    """Require one of the endings :data:`SUFFIXES` and an existing folder; return the path as a ``Path``.

    Raises
    ------
    InputError, MissingFileError
        that call the file ``name``.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        fail(name, f"{path} ends in {path.suffix or 'nothing'}", f"choose an ending of {' or '.join(SUFFIXES)}")
    check_folder(f"{name}'s folder", path.parent)
    return path


def glb_of_scene(scene: trimesh.Scene, complete: Callable[[dict[str, Any]], None]) -> bytes:
    """A scene as binary glTF 2.0, with its unit normals as they are and with what trimesh leaves out of the JSON.

    ``complete`` is given the glTF's JSON last, to change it in place. The same scene gives the same bytes.
    """
    import trimesh

    def finish(tree: dict[str, Any]) -> None:
        tree["asset"]["generator"] = generator()
        for mesh in tree["meshes"]:
            mesh.pop("extras", None)
            for primitive in mesh["primitives"]:
                for accessor in primitive["attributes"].values():
                    tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"] = _ARRAY_BUFFER
                tree["bufferViews"][tree["accessors"][primitive["indices"]]["bufferView"]]["target"] = _ELEMENT_ARRAY_BUFFER
        complete(tree)

    return trimesh.exchange.gltf.export_glb(scene, include_normals=True, unitize_normals=False, tree_postprocessor=finish)


def split_glb(glb: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON of a GLB file and the contents of its buffer views."""
    length = int.from_bytes(glb[12:16], "little")
    tree, binary = json.loads(glb[20 : 20 + length]), glb[28 + length :]
    views = tree["bufferViews"]
    return tree, [binary[(start := view.get("byteOffset", 0)) : start + view["byteLength"]] for view in views]


def joined_glb(tree: dict[str, Any], contents: Sequence[bytes]) -> bytes:
    """The GLB file of a JSON and the contents of its buffer views, whose places and lengths are worked out anew."""
    views, binary = list[dict[str, Any]](), bytearray()
    for view, content in zip(tree["bufferViews"], contents, strict=True):
        views.append(view | {"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)})
        binary += content + bytes(-len(content) % 4)
    text = json.dumps(tree | {"bufferViews": views, "buffers": [{"byteLength": len(binary)}]}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(struct.pack("<I", len(chunk)) + kind + chunk for kind, chunk in ((b"JSON", text), (b"BIN\0", bytes(binary))))
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def generator() -> str:
    """The name and version of this program, as files name what made them."""
    try:
        return f"bbfit {version('bbfit')}"
    except PackageNotFoundError:  # used from a folder that was never installed
        return "bbfit"
