"""Write the loaded tree as one GLB file, thinned out on request. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit. The file contains what the worker renders and measures: every instance of
every surface of the evaluated scene, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

JOIN_BATCH = 64


@dataclass(frozen=True)
class PlacedMesh:
    """One object of the tree to write."""

    name: str
    """The object's name in the loaded file."""
    mesh: Any
    """Its mesh with all modifiers applied. Objects may share a mesh."""
    matrix: Any
    """The transform from the mesh's frame to the world, 4 x 4."""


def write(path: str, triangles: int | None, thin: Callable[[list[Any], int], list[list[Any]]]) -> int:
    """Write the scene to ``path`` with at most about ``triangles`` triangles (all if None). Return the number of triangles written.

    ``thin`` is :func:`worker_thinning.thinned`.
    """
    import bpy

    placed = realized()
    meshes = {item.mesh for item in placed}
    bpy.data.batch_remove(list(bpy.data.objects))
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in meshes])
    for mesh in meshes:
        share_normals(mesh)
    total = count_triangles(placed)
    if triangles is not None and total > triangles:
        placed = decimated(placed, triangles, thin)
    for item in placed:
        link(item)
    # Every setting that decides what is written. All other settings keep their defaults.
    bpy.ops.export_scene.gltf(
        filepath=path,
        export_format="GLB",
        use_active_scene=True,
        export_yup=True,
        export_apply=False,
        export_texcoords=True,
        export_normals=True,
        export_materials="EXPORT",
        export_image_format="AUTO",
        export_vertex_color="MATERIAL",
        export_all_vertex_colors=False,
        export_cameras=False,
        export_lights=False,
        export_animations=False,
        export_skins=False,
        export_morph=False,
        export_extras=False,
        will_save_settings=False,
    )
    return count_triangles(placed)


def count_triangles(placed: list[PlacedMesh]) -> int:
    """Triangles of all objects. A shared mesh counts once for each of its objects."""
    return sum(len(item.mesh.loop_triangles) for item in placed)


def realized() -> list[PlacedMesh]:
    """All objects of the evaluated scene that have faces, as meshes without modifiers. Objects that share an evaluated mesh still do."""
    import bpy

    depsgraph = bpy.context.evaluated_depsgraph_get()
    meshes: dict[tuple[Any, ...], Any] = {}
    placed = list[PlacedMesh]()
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type != "MESH" or not instance.show_self:  # curves, texts and so on occur again as the meshes made of them
            continue
        own = {index: slot.material for index, slot in enumerate(evaluated.material_slots) if slot.link == "OBJECT"}
        key = (evaluated.data.as_pointer(), *((index, material.as_pointer() if material else 0) for index, material in own.items()))
        if key not in meshes:
            mesh = bpy.data.meshes.new_from_object(evaluated, preserve_all_data_layers=True, depsgraph=depsgraph)
            mesh.name = evaluated.original.data.name if evaluated.original and evaluated.original.data else evaluated.name
            for index, material in own.items():
                if index < len(mesh.materials) and material:
                    mesh.materials[index] = material.original
            mesh.calc_loop_triangles()
            meshes[key] = mesh
        if len(meshes[key].polygons):
            placed.append(PlacedMesh(evaluated.name, meshes[key], instance.matrix_world.copy()))
    return [unsheared(item) for item in placed]


def unsheared(item: PlacedMesh) -> PlacedMesh:
    """The object without a shear, which objects of glTF and Blender cannot have: a matrix that shears is applied to a copy of the mesh."""
    from mathutils import Matrix

    error = np.abs(np.array(Matrix.LocRotScale(*item.matrix.decompose())) - np.array(item.matrix))
    return in_world(item) if error[:3, :3].max() > 1e-6 * np.abs(np.array(item.matrix)[:3, :3]).max() else item


def in_world(item: PlacedMesh) -> PlacedMesh:
    """The object with a copy of its mesh in the world's frame."""
    from mathutils import Matrix

    mesh = item.mesh.copy()
    mesh.transform(item.matrix)
    if item.matrix.determinant() < 0:
        mesh.flip_normals()
    mesh.calc_loop_triangles()
    return PlacedMesh(item.name, mesh, Matrix())


def share_normals(mesh: Any) -> None:
    """Give all corners of a vertex one normal, if their normals differ only by rounding.

    Blender stores a custom normal in 16 bits, relative to a frame that differs between flat faces. Its exporter would write a vertex for
    each of the different results: 22,000 for a crown of leaves with 13,000 vertices.
    """
    if not mesh.has_custom_normals:
        return
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    normals = np.empty((len(corners), 3), np.float32)
    mesh.corner_normals.foreach_get("vector", normals.ravel())
    shared = np.zeros((len(mesh.vertices), 3), np.float32)
    shared[corners] = normals  # the normal of any one corner of each vertex
    if np.abs(normals - shared[corners]).max(initial=0) < 2e-3:
        mesh.shade_smooth()
        mesh.normals_split_custom_set_from_vertices(shared)


def link(item: PlacedMesh) -> Any:
    """Add an object to the scene."""
    import bpy

    linked = bpy.data.objects.new(item.name, item.mesh)
    linked.matrix_world = item.matrix
    bpy.context.scene.collection.objects.link(linked)
    return linked


def decimated(placed: list[PlacedMesh], triangles: int, thin: Callable[[list[Any], int], list[list[Any]]]) -> list[PlacedMesh]:
    """Join all meshes, and ``thin`` them out to about ``triangles``."""
    import bpy

    joined = [join(members) for members in joinable_groups(placed)]
    bpy.context.view_layer.update()
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in [item.data for item in joined]])
    remaining = list[PlacedMesh]()
    for item, meshes in zip(joined, thin([item.data for item in joined], triangles), strict=True):
        if meshes:
            whole = merge([link(PlacedMesh(item.name, mesh, item.matrix_world.copy())) for mesh in meshes])
            whole.data.calc_loop_triangles()
            remaining.append(PlacedMesh(item.name, whole.data, whole.matrix_world.copy()))
            bpy.data.objects.remove(whole)
    bpy.data.batch_remove(joined)
    return remaining


def joinable_groups(placed: list[PlacedMesh]) -> list[list[PlacedMesh]]:
    """Groups of objects whose materials survive joining: they have the same color layers, and the same UV layers or none."""
    groups: dict[tuple[Any, ...], dict[tuple[str, ...], list[PlacedMesh]]] = {}
    for item in sorted(placed, key=lambda item: not item.mesh.uv_layers):
        colors = item.mesh.color_attributes
        color_key = (*((layer.name, layer.domain, layer.data_type) for layer in colors), colors.render_color_index)
        uv_key = (*(layer.name for layer in item.mesh.uv_layers), *(layer.name for layer in item.mesh.uv_layers if layer.active_render))
        by_uv = groups.setdefault(color_key, {})
        by_uv.setdefault(uv_key or next(iter(by_uv), ()), []).append(item)
    return [members for by_uv in groups.values() for members in by_uv.values()]


def join(members: list[PlacedMesh]) -> Any:
    """Join many objects to one object of the scene, in the world's frame."""
    # Blender's time grows with the square of the number of joined objects, and of all other objects.
    if len(members) > JOIN_BATCH:
        objects = [join(members[start : start + JOIN_BATCH]) for start in range(0, len(members), JOIN_BATCH)]
    else:
        objects = [link(in_world(item)) for item in members]
    return merge(objects)


def merge(objects: list[Any]) -> Any:
    """Join objects into the first one with Blender's own operator."""
    import bpy

    if len(objects) > 1:
        unused = [item.data for item in objects[1:]]
        bpy.context.view_layer.update()
        context = {"active_object": objects[0], "object": objects[0], "selected_objects": objects, "selected_editable_objects": objects}
        with bpy.context.temp_override(**context):
            bpy.ops.object.join()
        bpy.data.batch_remove(unused)
    return objects[0]
