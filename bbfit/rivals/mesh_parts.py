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
    """The material, a ``PBRMaterial`` of trimesh; ``None`` if the file has none."""
    colors: NDArray[np.uint8] | None = None
    """Linear colors of the vertices, RGBA, [P, 4]; ``None`` if the file has none, or a material."""

    def taken(self, points: NDArray[np.float64], faces: NDArray[np.int64], source: NDArray[np.int64]) -> Part:
        """A part of other points and triangles whose vertices have the values of those with the indices ``source``."""
        uv, colors = None if self.uv is None else self.uv[source], None if self.colors is None else self.colors[source]
        return replace(self, points=points, faces=faces, uv=uv, colors=colors)


def tree_parts(tree: TreeFile) -> list[Part]:
    """The triangles of a .glb, .gltf or .obj by material, placed, with equal vertices welded. Raises the errors of ``TreeFile.scene``."""
    import trimesh

    parts, scene, materials = [], tree.scene(), dict[int, Any]()
    for node in sorted(scene.graph.nodes_geometry):
        matrix, name = scene.graph[node]
        # A copy of a picture forgets that it was a JPEG, and is no longer one that several materials share.
        material = getattr(scene.geometry[name].visual, "material", None)
        mesh = scene.geometry[name].copy().apply_transform(matrix)
        mesh.merge_vertices(merge_norm=True)
        uv, colors = getattr(mesh.visual, "uv", None), None
        if isinstance(mesh.visual, trimesh.visual.ColorVisuals) and mesh.visual.defined:
            colors = np.asarray(mesh.visual.vertex_colors)
        if material is not None:
            material = materials.setdefault(id(material), _physical(material))
        part = Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), None if uv is None else np.asarray(uv), material, colors)
        parts.append(used_vertices(part))
    return parts


def _physical(material: Any) -> Any:
    """A material as glTF has it. That of an OBJ is matte, of its color or its picture, and shows both sides."""
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    if not isinstance(material, SimpleMaterial):
        return material
    color = None if material.image is not None else material.diffuse
    return PBRMaterial(material.name, baseColorTexture=material.image, baseColorFactor=color, metallicFactor=0.0, doubleSided=True)


def used_vertices(part: Part) -> Part:
    """A part without vertices that no triangle uses."""
    used, faces = np.unique(part.faces, return_inverse=True)
    return part.taken(part.points[used], faces.reshape(-1, 3), used)


def parts_glb(parts: list[Part]) -> bytes:
    """A GLB file of parts, without normals and without what :func:`~bbfit.tree_files.gltf_materials.with_transmission` adds."""
    import trimesh

    meshes = []
    for part in parts:
        visual: Any = trimesh.visual.TextureVisuals(uv=part.uv, material=part.material) if part.material is not None else None
        if part.colors is not None:
            visual = trimesh.visual.ColorVisuals(vertex_colors=part.colors)
        meshes.append(trimesh.Trimesh(part.points, part.faces, visual=visual, process=False, validate=False))
    data = trimesh.Scene(meshes).export(file_type="glb")
    assert isinstance(data, bytes)
    return data
