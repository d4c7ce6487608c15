"""The triangles of tree files that can be read without Blender."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bbfit.blender.sources import check_tree
from bbfit.checks import fail

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
"""Endings of such files."""


def tree_scene(tree: str | Path) -> trimesh.Scene:
    """A tree's meshes with their materials, as the file holds them: its own axes and order, nothing merged.

    Raises
    ------
    MissingFileError, InputError
        if the file is missing, takes Blender to be read, cannot be read or has no triangles.
    """
    import trimesh

    path = check_tree(tree)[0]
    if path.suffix.lower() not in MESH_SUFFIXES:
        fail("tree", f"{path} has triangles that only Blender can read", f"give one of {' '.join(MESH_SUFFIXES)}, or no tree")
    try:
        scene = trimesh.load_scene(path, process=False)
    except (ValueError, LookupError, TypeError, AttributeError, OSError) as error:
        fail("tree", f"{path} cannot be read ({error})", "expected a mesh")
    for name in [name for name, mesh in scene.geometry.items() if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces)]:
        scene.delete_geometry(name)  # points, lines, and what is empty
    if not scene.geometry or not scene.area > 0:
        fail("tree", f"{path} has no triangles", "expected a mesh")
    return scene


def tree_mesh(tree: str | Path) -> trimesh.Trimesh:
    """All triangles of a tree in one mesh, placed as in the file; otherwise as :func:`tree_scene`."""
    return tree_scene(tree).to_mesh()
