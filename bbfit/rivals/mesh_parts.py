"""The triangles of a tree by material, as rivals simplify them, and the GLB file of simplified ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.tree_files.tree_file import TreeFile


@dataclass(frozen=True)
class Part:
    """Triangles of one material."""

    points: NDArray[np.float64]
    """Vertices in meters, in the file's axes, [P, 3]."""
    faces: NDArray[np.int64]
    """Vertices of each triangle, [F, 3]."""
    uv: NDArray[np.float64] | None
    """Texture coordinates, [P, 2]; ``None`` if the file has none."""
    material: Any
    """The material as trimesh reads it; ``None`` if the file has none."""


def tree_parts(tree: TreeFile) -> list[Part]:
    """The triangles of a .glb, .gltf or .obj by material, placed, with equal vertices welded. Raises the errors of ``TreeFile.scene``."""
    import trimesh

    parts = []
    for mesh in tree.scene().dump():
        assert isinstance(mesh, trimesh.Trimesh)
        mesh.merge_vertices(merge_norm=True)
        uv = getattr(mesh.visual, "uv", None)
        material = getattr(mesh.visual, "material", None)
        part = Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), None if uv is None else np.asarray(uv), material)
        parts.append(used_vertices(part))
    return parts


def used_vertices(part: Part) -> Part:
    """A part without vertices that no triangle uses."""
    used, faces = np.unique(part.faces, return_inverse=True)
    uv = None if part.uv is None else part.uv[used]
    return replace(part, points=part.points[used], faces=faces.reshape(-1, 3), uv=uv)


def parts_glb(parts: list[Part]) -> bytes:
    """A GLB file of parts, without normals."""
    import trimesh

    meshes = []
    for part in parts:
        visual = trimesh.visual.TextureVisuals(uv=part.uv, material=part.material) if part.material is not None else None
        meshes.append(trimesh.Trimesh(part.points, part.faces, visual=visual, process=False, validate=False))
    data = trimesh.Scene(meshes).export(file_type="glb")
    assert isinstance(data, bytes)
    return data
