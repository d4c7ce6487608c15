"""The original tree as the page can show it: one GLB file, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bbfit.checks import InputError
from bbfit.exporting.lod import glb_counts, stands_alone
from bbfit.glb import gltf_parts
from bbfit.tree_files.tree_file import MESH_SUFFIXES, TreeFile

MOST_BYTES = 64 << 20
"""Size of an original up to which it is sent to the browser, if nothing else is said."""
# What three.js's loader in the page cannot unpack without fetching a decoder from elsewhere.
_PACKED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"}


@dataclass(frozen=True)
class Original:
    """The tree that was compressed."""

    glb: bytes | None
    """A GLB file, Y up in meters; ``None`` if it cannot be shown."""
    note: str
    """Why it cannot be shown, or what was done to it; empty if it is the file as it is."""
    vertices: int | None = None
    """Vertices of it, if they could be counted."""

    @staticmethod
    def missing(note: str) -> Original:
        """None to show, and why."""
        return Original(None, note)


def find_original(candidates: Sequence[Path | None], most_bytes: int = MOST_BYTES) -> Original:
    """The first of some files that is there, as a GLB file.

    A GLB with all its data in it is taken byte for byte; other kinds are converted by trimesh. Nothing is raised: what cannot be read,
    is too large or takes Blender to be read is told in the note.
    """
    named = [path for path in candidates if path is not None]
    path = next((path for path in named if path.is_file()), None)
    if path is None:
        told = f"the original is not there any more: {named[0]}" if named else "made from views alone: there is no mesh of the original"
        return Original.missing(told)
    ending = path.suffix.lower()
    if ending not in MESH_SUFFIXES:
        return Original.missing(f"only Blender reads {path.name}; convert it to .glb to see it here")
    try:
        tree = TreeFile.open(path)
        size = tree.bytes
        if size > most_bytes:
            return Original.missing(_too_large(path.name, size, most_bytes))
        if ending == ".glb" and stands_alone(path):
            return _as_it_is(path.read_bytes(), path.name)
        glb = _converted(tree)
    except (InputError, OSError) as error:
        return Original.missing(f"the original cannot be shown: {error}")
    if len(glb) > most_bytes:
        return Original.missing(_too_large(f"{path.name} as GLB", len(glb), most_bytes))
    return Original(glb, f"converted from {path.name}", _vertices(glb))


def _as_it_is(glb: bytes, name: str) -> Original:
    packed = sorted(_PACKED & set(gltf_parts(glb)[0].get("extensionsRequired", ())))
    if packed:
        return Original.missing(f"{name} is packed by {' and '.join(packed)}, which the page cannot read")
    return Original(glb, "", _vertices(glb))


def _converted(tree: TreeFile) -> bytes:
    scene = tree.scene()
    if tree.up_axis == "z":
        import trimesh

        scene.apply_transform(trimesh.transformations.rotation_matrix(-3.141592653589793 / 2, [1, 0, 0]))
    glb: bytes = scene.export(file_type="glb")
    return glb


def _vertices(glb: bytes) -> int | None:
    try:
        return glb_counts(glb)[0]
    except (LookupError, TypeError, ValueError):  # rare parts of glTF, which only the count does not know
        return None


def _too_large(name: str, size: int, most: int) -> str:
    return f"{name} has {size / 2**20:,.0f} MiB, more than the {most / 2**20:,.0f} MiB that are sent; --original-bytes raises the limit"
