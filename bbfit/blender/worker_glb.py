"""The worker's other trade: writes the tree that it loaded as one GLB file, thinned out if asked.

Runs in the worker's process, which imports it by path when a job asks for it, and like the worker it knows nothing of bbfit. What is
written is what the worker shows and measures: every instance of every surface of the evaluated scene, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

# A material is foliage if none of its islands is longer than this part of the tree's diagonal: leaves and cards are, stems are not.
FOLIAGE_LENGTH = 0.25
# Leaves grow at most so much to make up for lost ones.
LARGEST_GROWTH = 4.0
JOINED_AT_ONCE = 64


@dataclass(frozen=True)
class Placed:
    """One object of the tree to write."""

    name: str
    """The object's name in the file that was loaded."""
    mesh: Any
    """Its mesh with all modifiers applied; objects may share one."""
    matrix: Any
    """From the mesh's frame to the world's, 4 x 4."""


@dataclass(frozen=True)
class Islands:
    """The connected parts of a mesh of P vertices and T triangles."""

    labels: np.ndarray
    """Part of each vertex, [P]."""
    triangles: np.ndarray
    """Vertices of each triangle, [T, 3]."""
    materials: np.ndarray
    """Material slot of each triangle, [T]."""
    areas: np.ndarray
    """Area of each triangle, [T]."""
    lengths: np.ndarray
    """Diagonal of the bounding box of the part that each triangle belongs to, [T]."""


def write(path: str, triangles: int | None) -> int:
    """Write the scene to ``path`` with at most about ``triangles`` triangles, all if None; return how many were left."""
    import bpy

    placed = realized()
    kept = {item.mesh for item in placed}
    bpy.data.batch_remove(list(bpy.data.objects))
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in kept])
    for mesh in kept:
        share_normals(mesh)
    total = count(placed)
    if triangles is not None and total > triangles:
        placed = thinned(placed, triangles / total)
    for item in placed:
        link(item)
    # Every setting that decides what is written; the rest is by default.
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
    return count(placed)


def count(placed: list[Placed]) -> int:
    """Triangles of all objects; a mesh that several share counts for each."""
    return sum(len(item.mesh.loop_triangles) for item in placed)


def realized() -> list[Placed]:
    """Everything in the evaluated scene that has faces, as meshes without modifiers; what shares its evaluated mesh still does."""
    import bpy

    depsgraph = bpy.context.evaluated_depsgraph_get()
    known: dict[tuple[int, ...], Any] = {}
    found = list[Placed]()
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type != "MESH" or not instance.show_self:  # curves, texts and so on come a second time as the mesh that they make
            continue
        own = {index: slot.material for index, slot in enumerate(evaluated.material_slots) if slot.link == "OBJECT"}
        key = (evaluated.data.as_pointer(), *(material.as_pointer() if material else 0 for material in own.values()))
        if key not in known:
            mesh = bpy.data.meshes.new_from_object(evaluated, preserve_all_data_layers=True, depsgraph=depsgraph)
            mesh.name = evaluated.original.data.name if evaluated.original and evaluated.original.data else evaluated.name
            for index, material in own.items():
                if index < len(mesh.materials) and material:
                    mesh.materials[index] = material.original
            mesh.calc_loop_triangles()
            known[key] = mesh
        if len(known[key].polygons):
            found.append(Placed(evaluated.name, known[key], instance.matrix_world.copy()))
    return [unsheared(item) for item in found]


def unsheared(item: Placed) -> Placed:
    """The same object, its matrix applied to a mesh of its own where glTF's and Blender's objects cannot have it: where it shears."""
    from mathutils import Matrix

    error = np.abs(np.array(Matrix.LocRotScale(*item.matrix.decompose())) - np.array(item.matrix))
    return in_world(item) if error[:3, :3].max() > 1e-6 * np.abs(np.array(item.matrix)[:3, :3]).max() else item


def in_world(item: Placed) -> Placed:
    """The same object with a mesh of its own in the world's frame."""
    from mathutils import Matrix

    mesh = item.mesh.copy()
    mesh.transform(item.matrix)
    if item.matrix.determinant() < 0:
        mesh.flip_normals()
    mesh.calc_loop_triangles()
    return Placed(item.name, mesh, Matrix())


def share_normals(mesh: Any) -> None:
    """Make one normal of those that a vertex's corners have, if they are the same but for rounding.

    Blender keeps a given normal to 16 bits, in a frame that differs from face to face where the faces are flat, and its exporter
    would write a vertex for each of the results: 22,000 for the 13,000 of a crown of leaves.
    """
    if not mesh.has_custom_normals:
        return
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    normals = np.empty((len(corners), 3), np.float32)
    mesh.corner_normals.foreach_get("vector", normals.ravel())
    shared = np.zeros((len(mesh.vertices), 3), np.float32)
    shared[corners] = normals  # of each vertex some corner's
    if np.abs(normals - shared[corners]).max(initial=0) < 2e-3:
        mesh.shade_smooth()
        mesh.normals_split_custom_set_from_vertices(shared)


def link(item: Placed) -> Any:
    """Put an object into the scene."""
    import bpy

    made = bpy.data.objects.new(item.name, item.mesh)
    made.matrix_world = item.matrix
    bpy.context.scene.collection.objects.link(made)
    return made


def thinned(placed: list[Placed], ratio: float) -> list[Placed]:
    """The tree with that part of its triangles, by collapsing edges, and with leaves enlarged until they cover what they did before.

    All meshes are joined first, so that edges collapse where that changes the tree's shape least, wherever they are: by the same
    ratio for each mesh leaves of a few triangles would lose as many as bark that has far too many. Foliage still loses area, since
    a card of two triangles turns into one and then goes; so what is left of each foliage material is enlarged, every island about
    its middle, until the material has its area again (Cook, Halstead, Planck, Ryu, "Stochastic Simplification of Aggregate Detail",
    SIGGRAPH 2007).
    """
    import bpy

    joined = [join(members) for members in groups(placed)]
    bpy.context.view_layer.update()
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh not in [made.data for made in joined]])
    corners = np.concatenate([np.array(made.bound_box) for made in joined])
    length = FOLIAGE_LENGTH * float(np.linalg.norm(np.ptp(corners, axis=0)))
    before = [islands(made.data) for made in joined]
    for made in joined:
        modifier = made.modifiers.new("bbfit", "DECIMATE")
        modifier.ratio, modifier.use_collapse_triangulate = ratio, True
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found = [bpy.data.meshes.new_from_object(made.evaluated_get(depsgraph), depsgraph=depsgraph) for made in joined]
    left = list[Placed]()
    for made, mesh, whole in zip(joined, found, before, strict=True):
        restore(mesh, whole, length)
        mesh.calc_loop_triangles()
        if len(mesh.polygons):
            left.append(Placed(made.name, mesh, made.matrix_world.copy()))
    bpy.data.batch_remove(joined)
    return left


def groups(placed: list[Placed]) -> list[list[Placed]]:
    """Objects that can be joined without their materials changing: of the same colors and texture coordinates, or without the latter."""
    found: dict[tuple[Any, ...], dict[tuple[str, ...], list[Placed]]] = {}
    for item in sorted(placed, key=lambda item: not item.mesh.uv_layers):
        colors = item.mesh.color_attributes
        shades = (*((layer.name, layer.domain, layer.data_type) for layer in colors), colors.render_color_index)
        sheets = (*(layer.name for layer in item.mesh.uv_layers), *(layer.name for layer in item.mesh.uv_layers if layer.active_render))
        alike = found.setdefault(shades, {})
        alike.setdefault(sheets or next(iter(alike), ()), []).append(item)
    return [members for alike in found.values() for members in alike.values()]


def join(members: list[Placed]) -> Any:
    """One object of many, in the world's frame, in the scene."""
    # Blender's time grows with the square of what is joined at once, and of what else there is.
    if len(members) > JOINED_AT_ONCE:
        objects = [join(members[start : start + JOINED_AT_ONCE]) for start in range(0, len(members), JOINED_AT_ONCE)]
    else:
        objects = [link(in_world(item)) for item in members]
    return merge(objects)


def merge(objects: list[Any]) -> Any:
    """Blender's own join of objects, into the first."""
    import bpy

    if len(objects) > 1:
        emptied = [made.data for made in objects[1:]]
        bpy.context.view_layer.update()
        chosen = {"active_object": objects[0], "object": objects[0], "selected_objects": objects, "selected_editable_objects": objects}
        with bpy.context.temp_override(**chosen):
            bpy.ops.object.join()
        bpy.data.batch_remove(emptied)
    return objects[0]


def islands(mesh: Any) -> Islands:
    """The connected parts of a mesh."""
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
    return Islands(labels, triangles, materials[polygons], areas, np.linalg.norm(high - low, axis=-1)[labels[triangles[:, 0]]])


def coordinates(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh, [P, 3] float32."""
    values = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", values.ravel())
    return values


def restore(mesh: Any, whole: Islands, length: float) -> None:
    """Enlarge the foliage of a thinned mesh, the materials whose parts were all shorter than ``length``, to its area in ``whole``."""
    left = islands(mesh)
    points = coordinates(mesh)
    growth = np.ones(int(left.labels.max(initial=0)) + 1)
    for material in np.unique(left.materials):
        earlier, now = whole.materials == material, left.materials == material
        area = left.areas[now].sum(dtype=np.float64)
        if whole.lengths[earlier].max() < length and area > 0:
            lost = np.sqrt(whole.areas[earlier].sum(dtype=np.float64) / area)
            growth[left.labels[left.triangles[now]].ravel()] = np.clip(lost, 1.0, LARGEST_GROWTH)
    counts = np.bincount(left.labels)
    middles = np.stack([np.bincount(left.labels, points[:, axis]) / counts for axis in range(3)], -1)[left.labels]
    mesh.vertices.foreach_set("co", (middles + growth[left.labels, None] * (points - middles)).astype(np.float32).ravel())
    mesh.update()
