"""Load a tree into Blender and measure it. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

# The limits of a tree's size and place in meters, as in bbfit.inputs.
SMALLEST, LARGEST = 1e-4, 1e6
# Objects with a surface. Lights, cameras, volumes and hair of the file are not rendered.
SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
UNRENDERED = {"LIGHT", "LIGHT_PROBE", "VOLUME", "CURVES", "POINTCLOUD", "GREASEPENCIL", "GPENCIL"}


class InputRefused(Exception):
    """The input cannot be used. The arguments are the input's name, the problem, and a hint."""

    def __init__(self, subject: str, problem: str, hint: str) -> None:
        super().__init__(subject, problem, hint)


def open_tree(path: str, files: list[str]) -> tuple[np.ndarray, dict[str, Any]]:
    """Load the tree with its materials, as it renders. Return its vertices, [P, 3], and the facts that are reported to the parent.

    ``files`` are all files that the tree may refer to, with symbolic links resolved.
    """
    try:
        import bpy
    except ImportError as error:
        raise InputRefused("Blender", f"its module bpy cannot be loaded ({error})", "install the missing library") from error
    load(path)
    check_files(path, files)
    check_pictures(path)
    show_what_renders()
    points, faces = measure(path)
    add_plain_material()
    return points, {"vertices": len(points), "faces": faces, "blender": bpy.app.version_string}


def load(path: str) -> None:
    """Read the tree into an empty scene, Z up, in meters. By default, the importers rotate Y-up formats (glTF, OBJ)."""
    import bpy

    suffix = Path(path).suffix.lower()
    importers = {
        ".glb": lambda: bpy.ops.import_scene.gltf(filepath=path, disable_bone_shape=True),
        ".obj": lambda: bpy.ops.wm.obj_import(filepath=path, validate_meshes=False),
        ".ply": lambda: bpy.ops.wm.ply_import(filepath=path),
        ".stl": lambda: bpy.ops.wm.stl_import(filepath=path, use_mesh_validate=False),
        ".fbx": lambda: bpy.ops.wm.fbx_import(filepath=path, validate_meshes=False),
        ".usd": lambda: bpy.ops.wm.usd_import(filepath=path, validate_meshes=False),
        ".blend": lambda: append_scene(path),
    }
    importers |= {".gltf": importers[".glb"]} | dict.fromkeys([".usda", ".usdc", ".usdz"], importers[".usd"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        importers[suffix]()
    except RuntimeError as error:  # any failing operator, including those written in Python
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = (lines[-1] if lines else "no reason given").removeprefix("Error: ")
        raise InputRefused("tree", f"{path} cannot be read as {suffix} ({reason})", "get or export the file again") from error
    for mesh in bpy.data.meshes:
        check_finite(path, coordinates(mesh))
        mesh.validate()  # only now, because it replaces NaN by 0


def check_files(path: str, files: list[str]) -> None:
    """Refuse a tree that refers to a file that is not one of ``files``: it may lie anywhere, and a change of it would go unnoticed."""
    import bpy

    for name in bpy.utils.blend_paths(absolute=True, packed=False, local=False):
        file = Path(os.path.realpath(name))
        if file.exists() and not file.is_dir() and str(file) not in files:
            hint = "put all files into one folder, or export the tree as one .glb file"
            raise InputRefused("tree", f"{path} refers to {name}, which bbfit did not find in its folder", hint)


def check_pictures(path: str) -> None:
    """Refuse a tree with a material whose picture is missing or damaged: Blender would show it in magenta."""
    import bpy

    for material in bpy.data.materials:
        trees, seen = [material.node_tree] if material.node_tree else [], set()
        while trees:
            tree = trees.pop()
            for node in tree.nodes if tree.name not in seen else ():
                trees += [node.node_tree] if getattr(node, "node_tree", None) else []
                image = getattr(node, "image", None)
                if image is not None and image.source == "FILE" and not image.size[0] and any(out.is_linked for out in node.outputs):
                    name = image.filepath or image.name
                    hint = "put the picture where the tree expects it, or remove it from the material"
                    raise InputRefused("tree", f"{path}: the picture {name} of {material.name} is missing or cannot be read", hint)
            seen.add(tree.name)


def append_scene(path: str) -> None:
    """Append the active scene of a .blend without its scripts, drivers, world and render settings."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=path, use_scripts=False, load_ui=False)
    name, frame = bpy.context.scene.name, bpy.context.scene.frame_current
    excluded = {layer.name for layer in _layers(bpy.context.view_layer.layer_collection) if layer.exclude}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=False) as (_, appended):
        appended.scenes = [name]
    source, scene = appended.scenes[0], bpy.context.scene
    for child in source.collection.children:
        scene.collection.children.link(child)
    for item in source.collection.objects:
        scene.collection.objects.link(item)
    for layer in _layers(bpy.context.view_layer.layer_collection):
        layer.exclude = layer.name in excluded
    scene.frame_set(frame)


def _layers(layer: Any) -> list[Any]:
    return [child for direct in layer.children for child in (direct, *_layers(direct))]


def show_what_renders() -> None:
    """Give the viewport, whose scene Blender evaluates, the settings of the render. Hide everything that has no surface."""
    import bpy

    for item in bpy.data.objects:
        item.hide_render = item.hide_render or item.type in UNRENDERED
        item.hide_viewport = item.hide_render
        item.show_instancer_for_viewport = item.show_instancer_for_render
        for modifier in item.modifiers:
            modifier.show_viewport = modifier.show_render
            if modifier.type in ("SUBSURF", "MULTIRES"):
                modifier.levels = modifier.render_levels
    for collection in bpy.data.collections:
        collection.hide_viewport = collection.hide_render
    bpy.context.view_layer.update()


def coordinates(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh, [P, 3] float32."""
    values = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", values)
    return values.reshape(-1, 3)


def check_finite(path: str, points: np.ndarray) -> None:
    """Refuse positions that are NaN or infinite."""
    if not np.isfinite(points).all():
        raise InputRefused("tree", f"{path} has vertices that are NaN or infinite", "export the tree again")


def measure(path: str) -> tuple[np.ndarray, int]:
    """World positions of all vertices that belong to a face, [P, 3] float32 with Z up, and the number of triangles."""
    import bpy

    measured: dict[int, tuple[np.ndarray, int, float]] = {}
    placed: list[np.ndarray] = []
    faces, area = 0, 0.0
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type not in SURFACES or not instance.show_self:
            continue
        key = instance.object.data.as_pointer()
        if key not in measured:
            measured[key] = measure_mesh(instance.object)
        local, mesh_faces, mesh_area = measured[key]
        matrix = np.array(instance.matrix_world)
        placed.append(local @ matrix[:3, :3].T + matrix[:3, 3])
        faces, area = faces + mesh_faces, area + mesh_area
    if not faces:
        raise InputRefused("tree", f"{path} has no faces to render", "export the tree as a mesh")
    points = np.concatenate(placed)
    check_finite(path, points)
    if area == 0 or not np.ptp(points, axis=0).any():
        raise InputRefused("tree", f"{path} has zero size", "export the tree again, at its real size")
    check_extent(path, points)
    return points.astype(np.float32), faces


def check_extent(path: str, points: np.ndarray) -> None:
    """Refuse trees that are too far from the origin, too large or too small for pictures of them to mean anything."""
    farthest, size = np.abs(points).max(), np.ptp(points, axis=0).max()
    if farthest > LARGEST:
        raise InputRefused(
            "tree", f"{path} reaches {farthest:.3g} meters from the origin, more than {LARGEST:g}", "export the tree in meters"
        )
    if size < SMALLEST:
        raise InputRefused("tree", f"{path} is smaller than {SMALLEST:g} meters", "export the tree again, at its real size")


def measure_mesh(evaluated: Any) -> tuple[np.ndarray, int, float]:
    """Positions of the vertices in faces (float64, in the object's own frame), and the number and the total area of the triangles."""
    mesh = evaluated.to_mesh()
    mesh.calc_loop_triangles()
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    areas = np.empty(len(mesh.loop_triangles), np.float32)
    mesh.loop_triangles.foreach_get("area", areas)
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[corners] = True
    result = coordinates(mesh)[used].astype(np.float64), len(areas), float(areas.sum())
    evaluated.to_mesh_clear()
    return result


def add_plain_material() -> None:
    """Give surfaces without a material a matte gray, or their vertex colors."""
    import bpy

    for item in bpy.data.objects:
        if item.type not in SURFACES or item.data is None:
            continue
        if not item.material_slots:
            item.data.materials.append(None)  # adds a slot
        for slot in item.material_slots:
            if slot.material is None:
                colors = getattr(item.data, "color_attributes", [])
                slot.material = plain_material(colors[0].name if len(colors) else "")
    bpy.context.view_layer.update()


def plain_material(attribute: str) -> Any:
    """A matte material, gray or colored by a vertex attribute."""
    import bpy

    name = f"bbfit plain {attribute}".strip()
    if name in bpy.data.materials:
        return bpy.data.materials[name]
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = 1.0
    surface.inputs["Base Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    if attribute:
        node = material.node_tree.nodes.new("ShaderNodeVertexColor")
        node.layer_name = attribute
        material.node_tree.links.new(node.outputs["Color"], surface.inputs["Base Color"])
    return material
