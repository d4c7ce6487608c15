"""Write the loaded tree as one GLB file, thinned out on request. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit. The file contains what the worker renders and measures: every instance of
every surface of the evaluated scene, and nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

# A material is foliage if none of its islands is longer than this share of the tree's diagonal. Leaves and cards are shorter, stems longer.
FOLIAGE_LENGTH = 0.25
# Leaves are enlarged by at most this factor to compensate for removed leaves.
MAX_GROWTH = 4.0
# What is seen of the area of a stem, whose far side is hidden, relative to that of a leaf. Less or more is no better.
BARK_SEEN = 0.5
# Triangles that each leaf or each part of the bark keeps in the mean; parts that cannot have them go. Fewer leaves of more triangles are
# worse: what counts is how evenly they fill the crown.
LEAF_TRIANGLES, BARK_TRIANGLES = 1, 16
# Leaves with pictures keep the triangles of a rectangle.
RECTANGLE = 2
# Bark and foliage may exceed their numbers of triangles by this factor. If more remain, further parts go, at least a tenth of them at a
# time, in at most so many attempts.
OVERSHOOT, ATTEMPTS, FEWER = 1.01, 8, 0.9
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


@dataclass(frozen=True)
class Islands:
    """The connected components ("islands") of a mesh of P vertices and T triangles."""

    labels: np.ndarray
    """Island of each vertex, [P]."""
    triangles: np.ndarray
    """Vertices of each triangle, [T, 3]."""
    materials: np.ndarray
    """Material slot of each triangle, [T]."""
    areas: np.ndarray
    """Area of each triangle, [T]."""
    lengths: np.ndarray
    """Diagonal of the bounding box of each triangle's island, [T]."""
    centers: np.ndarray
    """The mean of each island's vertices, [I, 3]."""


def write(path: str, triangles: int | None) -> int:
    """Write the scene to ``path`` with at most about ``triangles`` triangles (all if None). Return the number of triangles written."""
    import bpy

    placed = realized()
    meshes = {item.mesh for item in placed}
    bpy.data.batch_remove(list(bpy.data.objects))
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in meshes])
    for mesh in meshes:
        share_normals(mesh)
    total = count_triangles(placed)
    if triangles is not None and total > triangles:
        placed = thinned(placed, triangles)
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
    meshes: dict[tuple[int, ...], Any] = {}
    placed = list[PlacedMesh]()
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type != "MESH" or not instance.show_self:  # curves, texts and so on occur again as the meshes made of them
            continue
        own = {index: slot.material for index, slot in enumerate(evaluated.material_slots) if slot.link == "OBJECT"}
        key = (evaluated.data.as_pointer(), *(material.as_pointer() if material else 0 for material in own.values()))
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


def thinned(placed: list[PlacedMesh], triangles: int) -> list[PlacedMesh]:
    """Thin a tree out to about ``triangles``: take whole leaves and twigs away, collapse edges of what remains, and enlarge the leaves.

    All meshes are joined first. Bark and foliage share the triangles by the areas that one sees of them. Both keep as many parts as can
    have a few triangles each (``BARK_TRIANGLES``, ``LEAF_TRIANGLES``): leaves evenly, and large parts of the bark more likely than small
    ones, so that the trunk stays. The edges of each kind collapse where this changes its shape least. Then leaves are enlarged about
    their centers until each material of foliage has its former area (Cook et al., "Stochastic Simplification of Aggregate Detail",
    SIGGRAPH 2007).
    """
    import bpy

    joined = [join(members) for members in joinable_groups(placed)]
    bpy.context.view_layer.update()
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in [item.data for item in joined]])
    corners = np.concatenate([np.array(item.bound_box) for item in joined])
    length = FOLIAGE_LENGTH * float(np.linalg.norm(np.ptp(corners, axis=0)))
    originals = [islands(item.data) for item in joined]
    leaves = [foliage(original, length) for original in originals]
    bark = [~each for each in leaves]
    leaf_area, bark_area = (
        sum(float(original.areas[each].sum(dtype=np.float64)) for original, each in zip(originals, kind, strict=True))
        for kind in (leaves, bark)
    )
    share = leaf_area / max(leaf_area + BARK_SEEN * bark_area, 1e-30)
    of_leaves = min(sum(int(each.sum()) for each in leaves), round(share * triangles))
    textured = any(
        shows_picture(item.data, original.materials[each]) for item, original, each in zip(joined, originals, leaves, strict=True)
    )
    stems = reduced(joined, originals, bark, triangles - of_leaves, BARK_TRIANGLES, by_area=True)
    rest = triangles - sum(len(mesh.loop_triangles) for mesh in stems if mesh)
    crowns = reduced(joined, originals, leaves, rest, RECTANGLE if textured else LEAF_TRIANGLES, by_area=False)
    remaining = list[PlacedMesh]()
    for item, original, stem, crown in zip(joined, originals, stems, crowns, strict=True):
        if crown:
            restore_area(crown, original)
        if meshes := [mesh for mesh in (stem, crown) if mesh]:
            whole = merge([link(PlacedMesh(item.name, mesh, item.matrix_world.copy())) for mesh in meshes])
            whole.data.calc_loop_triangles()
            remaining.append(PlacedMesh(item.name, whole.data, whole.matrix_world.copy()))
            bpy.data.objects.remove(whole)
    bpy.data.batch_remove(joined)
    return remaining


def shows_picture(mesh: Any, slots: np.ndarray) -> bool:
    """Whether a material in any of these slots of a mesh has a picture."""
    materials = [mesh.materials[slot] for slot in np.unique(slots) if slot < len(mesh.materials)]
    return any(node.type == "TEX_IMAGE" for material in materials if material and material.node_tree for node in material.node_tree.nodes)


def foliage(original: Islands, length: float) -> np.ndarray:
    """Which triangles are foliage, [T]: those of materials all of whose islands are shorter than ``length``."""
    return ~np.isin(original.materials, original.materials[original.lengths >= length])


def reduced(
    items: list[Any], originals: list[Islands], chosen: list[np.ndarray], triangles: int, least: float, *, by_area: bool
) -> list[Any]:
    """The ``chosen`` triangles of each object, reduced to about ``triangles`` of all objects, as meshes; ``None`` where nothing remains.

    As many islands remain as can have ``least`` triangles in the mean. Islands stay whole if they have fewer in the mean, or no more than a
    rectangle, which would vanish as a whole. ``by_area``: the larger an island, the likelier it remains.
    """
    import bpy

    total = sum(int(each.sum()) for each in chosen)
    count = sum(len(np.unique(original.labels[original.triangles[each, 0]])) for original, each in zip(originals, chosen, strict=True))
    if triangles < 1 or not count:
        return [None for _ in items]
    mean = total / count
    share = triangles / count / (mean if mean <= RECTANGLE else min(least, mean))
    meshes = list[Any]()
    for _ in range(ATTEMPTS):
        bpy.data.batch_remove([mesh for mesh in meshes if mesh])
        meshes = collapsed(items, originals, sampled(originals, chosen, share, by_area=by_area), triangles)
        got = sum(len(mesh.loop_triangles) for mesh in meshes if mesh)
        if got <= OVERSHOOT * triangles or share * count <= 1:
            break
        # The edges of small closed surfaces and of some leaves cannot collapse so far.
        share = min(share, 1.0) * min(triangles / got, FEWER)
    return meshes


def sampled(originals: list[Islands], chosen: list[np.ndarray], share: float, *, by_area: bool) -> list[np.ndarray]:
    """Which of the ``chosen`` triangles of each object remain, if a ``share`` of their islands does, at least one of each object."""
    kept = list[np.ndarray]()
    for original, each in zip(originals, chosen, strict=True):
        labels = original.labels[original.triangles[:, 0]]
        numbers = np.unique(labels[each])
        areas = np.bincount(labels[each], original.areas[each], len(original.centers))[numbers] if by_area else 1.0
        # Weighted sampling without replacement (Efraimidis and Spirakis 2006), with evenly spread numbers in place of random ones.
        order = np.argsort(-np.log1p(-spread(original.centers[numbers])) / np.maximum(areas, 1e-30), kind="stable")
        kept.append(each & np.isin(labels, numbers[order[: math.ceil(share * len(numbers))]]))
    return kept


def collapsed(items: list[Any], originals: list[Islands], kept: list[np.ndarray], triangles: int) -> list[Any]:
    """The ``kept`` triangles of each object as meshes, whose edges collapse until about ``triangles`` of all objects are left."""
    import bpy

    ratio = triangles / max(sum(int(each.sum()) for each in kept), 1)
    meshes = list[Any]()
    for item, original, each in zip(items, originals, kept, strict=True):
        part = link(PlacedMesh(item.name, only(item.data, original, each), item.matrix_world.copy()))
        if ratio < 1:
            modifier = part.modifiers.new("bbfit", "DECIMATE")
            modifier.ratio, modifier.use_collapse_triangulate = ratio, True
        depsgraph = bpy.context.evaluated_depsgraph_get()
        mesh = bpy.data.meshes.new_from_object(part.evaluated_get(depsgraph), depsgraph=depsgraph)
        bpy.data.batch_remove([part.data])  # and the object with it
        mesh.calc_loop_triangles()
        meshes.append(mesh if len(mesh.polygons) else None)
    return meshes


def spread(points: np.ndarray) -> np.ndarray:
    """Different numbers in [0, 1) for points, [P, 3], so that the points with numbers below any bound are spread evenly among all.

    They are those of van der Corput's sequence, along Morton's curve through the points.
    """
    scale = 1023 / max(float(np.ptp(points, axis=0).max(initial=0)), 1e-30)
    cells = ((points - points.min(0, initial=np.inf)) * scale).astype(np.int64)
    code = sum(((cells >> bit & 1) << [3 * bit, 3 * bit + 1, 3 * bit + 2]).sum(-1) for bit in range(10))
    rank, values = np.empty(len(points), np.int64), np.zeros(len(points))
    rank[np.argsort(code, kind="stable")] = np.arange(len(points))
    for bit in range(max(len(points) - 1, 1).bit_length()):
        values += (rank >> bit & 1) / 2 ** (bit + 1)
    return values


def only(mesh: Any, original: Islands, kept: np.ndarray) -> Any:
    """A copy of a mesh with the polygons of the ``kept`` triangles alone; an island is kept as a whole or not at all."""
    import bmesh

    polygons = np.empty(len(original.triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    stays = np.zeros(len(mesh.polygons), bool)
    stays[polygons[kept]] = True
    copy, edited = mesh.copy(), bmesh.new()
    edited.from_mesh(mesh)
    bmesh.ops.delete(edited, geom=[face for face in edited.faces if not stays[face.index]], context="FACES")
    edited.to_mesh(copy)
    edited.free()
    return copy


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


def islands(mesh: Any) -> Islands:
    """Compute the connected components of a mesh."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh.calc_loop_triangles()
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    areas = np.empty(len(triangles), np.float32)
    mesh.loop_triangles.foreach_get("area", areas)
    polygons = np.empty(len(triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    materials = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", materials)
    edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    points = coordinates(mesh)
    graph = coo_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (len(points), len(points)))
    number, labels = connected_components(graph, directed=False)
    low, high = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
    np.minimum.at(low, labels, points)
    np.maximum.at(high, labels, points)
    lengths = np.linalg.norm(high - low, axis=-1)[labels[triangles[:, 0]]]
    counts = np.maximum(np.bincount(labels, minlength=number), 1)
    centers = np.stack([np.bincount(labels, points[:, axis], number) / counts for axis in range(3)], -1)
    return Islands(labels, triangles, materials[polygons], areas, lengths, centers)


def coordinates(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh, [P, 3] float32."""
    values = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", values.ravel())
    return values


def restore_area(mesh: Any, original: Islands) -> None:
    """Enlarge the islands of a mesh of foliage until each material has its area in ``original``."""
    current = islands(mesh)
    points = coordinates(mesh)
    growth = np.ones(int(current.labels.max(initial=0)) + 1)
    for material in np.unique(current.materials):
        before, after = original.materials == material, current.materials == material
        area = current.areas[after].sum(dtype=np.float64)
        if area > 0:
            factor = np.sqrt(original.areas[before].sum(dtype=np.float64) / area)
            growth[current.labels[current.triangles[after]].ravel()] = np.clip(factor, 1.0, MAX_GROWTH)
    centers = current.centers[current.labels]
    mesh.vertices.foreach_set("co", (centers + growth[current.labels, None] * (points - centers)).astype(np.float32).ravel())
    mesh.update()
