"""The original tree as a GLB file for the viewer, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bbfit.checks import InputError
from bbfit.exporting.lod import is_self_contained
from bbfit.glb import gltf_parts
from bbfit.tree_files.tree_file import MESH_SUFFIXES, TreeFile

MAX_BYTES = 64 << 20
"""The default for the largest original that is sent to browsers."""
# Compressions for which the loader of three.js needs a decoder that the page does not have.
_COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"}


@dataclass(frozen=True)
class Original:
    """The tree that the billboards replace."""

    glb: bytes | None
    """A GLB file, Y up, in meters; ``None`` if the tree cannot be shown."""
    note: str
    """Why the tree cannot be shown, or how it was converted; empty if the file is sent unchanged."""


def find_original(candidates: Sequence[Path | None], max_bytes: int = MAX_BYTES) -> Original:
    """The first of some files that exists, as a GLB file.

    A self-contained GLB is used unchanged; trimesh converts other formats. Nothing is raised: the note says if the file cannot be read,
    is too large or needs Blender.
    """
    known = [path for path in candidates if path is not None]
    path = next((path for path in known if path.is_file()), None)
    if path is None:
        gone = f"the original no longer exists: {known[0]}" if known else "made from views alone: there is no mesh of the original"
        return Original(None, gone)
    ending = path.suffix.lower()
    if ending not in MESH_SUFFIXES:
        return Original(None, f"only Blender reads {path.name}; convert it to .glb to see it here")
    try:
        tree = TreeFile.open(path)
        if tree.bytes > max_bytes:
            return Original(None, _too_large(path.name, tree.bytes, max_bytes))
        if ending == ".glb" and is_self_contained(path):
            return _unchanged(path.read_bytes(), path.name)
        glb = _converted(tree)
    except (InputError, OSError) as error:
        return Original(None, f"the original cannot be shown: {error}")
    if len(glb) > max_bytes:
        return Original(None, _too_large(f"{path.name} as GLB", len(glb), max_bytes))
    return Original(glb, f"converted from {path.name}")


def _unchanged(glb: bytes, name: str) -> Original:
    packed = sorted(_COMPRESSIONS & set(gltf_parts(glb)[0].get("extensionsRequired", ())))
    if packed:
        return Original(None, f"{name} is compressed with {' and '.join(packed)}, which the viewer cannot read")
    return Original(glb, "")


def _converted(tree: TreeFile) -> bytes:
    scene = tree.scene()
    if tree.up_axis == "z":
        import trimesh

        scene.apply_transform(trimesh.transformations.rotation_matrix(-3.141592653589793 / 2, [1, 0, 0]))
    glb: bytes = scene.export(file_type="glb")
    return glb


def _too_large(name: str, size: int, limit: int) -> str:
    return f"{name} has {size / 2**20:,.0f} MiB, more than the limit of {limit / 2**20:,.0f} MiB; --original-bytes raises it"
