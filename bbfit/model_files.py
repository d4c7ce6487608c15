"""What model files of every kind share: their endings, trimesh's glTF export, and the name of the program that wrote them."""

from __future__ import annotations

import glob
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from bbfit.checks import check_folder, check_output_file, fail
from bbfit.provenance import installed_version

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".obj")

# Numbers that glTF 2.0 borrows from OpenGL (specification, section 5.11).
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def check_model_path(name: str, path: str | Path) -> Path:
    """Require one of the endings ``SUFFIXES`` and an existing folder; return the path as a ``Path``.

    Raises ``InputError`` or ``MissingFileError`` with a message that calls the file ``name``.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        fail(name, f"{path} ends in {path.suffix or 'nothing'}", f"choose an ending of {' or '.join(SUFFIXES)}")
    check_folder(f"{name}'s folder", path.parent)
    return check_output_file(name, path)


def names_beside(path: Path, *, texture: bool = False, normals: bool = False, mip_files: bool = False) -> list[str]:
    """The names of the files that a model at ``path`` consists of, the model first.

    A GLB is one file. An OBJ has a material library, with ``texture`` a texture, and with ``normals`` a map of normals. ``mip_files``
    adds a pattern for mip levels.
    """
    if path.suffix.lower() != ".obj":
        others = list[str]()
    else:
        maps = [normals_path(path).name] if normals else []
        others = [path.with_suffix(suffix).name for suffix in (".mtl", *([".png"] if texture else []))] + maps
    levels = [f"{glob.escape(path.stem)}_mip[0-9]*.png"] if mip_files else []
    return [path.name, *others, *levels]


def relative_uri(file: str) -> str:
    """The URI of a file beside or below the file that refers to it (RFC 3986). Bytes of its name that are no text become codes too."""
    return quote(file, errors="surrogateescape")


def normals_path(path: Path) -> Path:
    """The file of the normals of a model at ``path``."""
    return path.with_name(f"{path.stem}_normals.png")


def glb_of_scene(scene: trimesh.Scene, complete: Callable[[dict[str, Any]], None], *, normals: bool = True) -> bytes:
    """A scene as binary glTF 2.0, with its unit normals as they are, or without, and with what trimesh leaves out of the JSON.

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

    return trimesh.exchange.gltf.export_glb(scene, include_normals=normals, unitize_normals=False, tree_postprocessor=finish)


def generator() -> str:
    """The name and version of this program, as files name what made them."""
    return f"bbfit {installed_version('bbfit') or ''}".rstrip()
