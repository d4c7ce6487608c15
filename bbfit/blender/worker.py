"""Runs in a process of its own, with Blender in it: loads one tree, measures it, renders the frames that it is told to.

It is started by path and knows nothing of bbfit, so that it starts fast. It speaks JSON lines: on standard input one job, then one
line a frame; on standard output ``ready`` (followed by the vertices as raw float32, if the job asks for them), ``done`` a frame, or
``refused`` with the reason. A job that holds ``convert`` has the tree written as a GLB file, by worker_glb.py beside this file, and is
answered by ``converted`` or ``refused``. What Blender itself prints goes to standard error. When standard input ends, because the
parent closed it or died, so does this process, in the middle of a render if need be.

One process renders one frame at a time and never two scenes: two renders at once crash Blender.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import queue
import sys
import threading
import traceback
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

# Everything with a surface; lights, cameras, volumes and hair that a file brings along are not rendered.
SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
UNRENDERED = {"LIGHT", "LIGHT_PROBE", "VOLUME", "CURVES", "POINTCLOUD", "GREASEPENCIL", "GPENCIL"}
# Foliage made of pictures with alpha: a ray may have to cross this many leaves.
TRANSPARENT_LAYERS = 64
AGAIN = "free the disk or make the folder writable, then start again; finished views are kept"
AGAIN_GLB = "free the disk of temporary files, then start again, or look at the file in Blender itself"


class Refused(Exception):
    """The input cannot be rendered: what is meant, what is wrong with it, what to do."""

    def __init__(self, subject: str, problem: str, hint: str) -> None:
        super().__init__(subject, problem, hint)


def main() -> NoReturn:
    """Serve one parent until it hangs up."""
    sys.excepthook = _die
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what C code prints
    requests: queue.Queue[dict[str, Any]] = queue.Queue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()

    def answer(event: str, **fields: Any) -> None:
        payload = fields.pop("payload", b"")
        answers.write(json.dumps({"event": event, **fields, "payload": len(payload)}).encode() + b"\n" + payload)
        answers.flush()

    job = requests.get()
    try:
        if "convert" in job:
            convert(job, answer)
            os._exit(0)
        prepare(job, answer)
        while True:
            frame = requests.get()
            render(frame)
            answer("done", frame=frame["frame"])
    except Refused as refusal:
        answer("refused", reason=refusal.args)
    os._exit(0)  # an ordinary exit would wait for the listening thread


def _die(*error: Any) -> None:
    """Say what went wrong and end at once; an ordinary end would trip over the listening thread and bury the message."""
    traceback.print_exception(*error)
    sys.stderr.flush()
    os._exit(1)


def _listen(requests: queue.Queue[dict[str, Any]]) -> None:
    for line in sys.stdin.buffer:
        requests.put(json.loads(line))
    os._exit(1)


def open_tree(path: str) -> tuple[np.ndarray, dict[str, Any]]:
    """Load the tree as it renders, materials included; its vertices and what is reported of it."""
    try:
        import bpy
    except ImportError as error:
        raise Refused("Blender", f"its module bpy cannot be loaded ({error})", "install what it misses") from error
    load(path)
    show_what_renders()
    points, faces = measure(path)
    add_plain_material()
    return points, {"vertices": len(points), "faces": faces, "blender": bpy.app.version_string}


def convert(job: dict[str, Any], answer: Any) -> None:
    """Load the tree and write it as a GLB file."""
    _, report = open_tree(job["tree"])
    spec = importlib.util.spec_from_file_location("worker_glb", Path(__file__).with_name("worker_glb.py"))
    assert spec and spec.loader
    writer = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = writer  # where dataclasses look for their module
    spec.loader.exec_module(writer)
    wanted = job["convert"]
    try:
        left = writer.write(wanted["path"], wanted["triangles"])
    except RuntimeError as error:  # the exporter's, whatever went wrong in it
        raise Refused("tree", f"{job['tree']} cannot be written as .glb ({' '.join(str(error).split())[-200:]})", AGAIN_GLB) from error
    if not left:
        raise Refused("triangles", f"nothing is left of {job['tree']} with {wanted['triangles']}", "allow more triangles")
    answer("converted", **report, triangles=left)


def prepare(job: dict[str, Any], answer: Any) -> None:
    """Load the tree, set up light, camera and renderer, and report what was found."""
    import bpy

    points, report = open_tree(job["tree"])
    add_light(job)
    set_up_cycles(job)
    camera = bpy.data.objects.new("bbfit camera", bpy.data.cameras.new("bbfit camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    answer("ready", **report, payload=points.tobytes() if job["measure"] else b"")


def load(path: str) -> None:
    """Read the tree into an empty scene, Z up, in meters; the importers turn Y-up formats (glTF, OBJ) by their own defaults."""
    import bpy

    ending = Path(path).suffix.lower()
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
        importers[ending]()
    except RuntimeError as error:  # every failing operator, those written in Python included
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = (lines[-1] if lines else "no reason given").removeprefix("Error: ")
        raise Refused("tree", f"{path} cannot be read as {ending} ({reason})", "get or export the file anew") from error
    for mesh in bpy.data.meshes:
        if not np.isfinite(coordinates(mesh)).all():
            raise Refused("tree", f"{path} has vertices that are NaN or infinite", "export the tree anew")
        mesh.validate()  # would have turned NaN into 0, had it run first


def append_scene(path: str) -> None:
    """Bring a .blend's active scene in, but none of its scripts, drivers, world or render settings."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=path, use_scripts=False, load_ui=False)
    name, frame = bpy.context.scene.name, bpy.context.scene.frame_current
    excluded = {layer.name for layer in _layers(bpy.context.view_layer.layer_collection) if layer.exclude}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(path, link=False) as (_, wanted):
        wanted.scenes = [name]
    source, scene = wanted.scenes[0], bpy.context.scene
    for child in source.collection.children:
        scene.collection.children.link(child)
    for found in source.collection.objects:
        scene.collection.objects.link(found)
    for layer in _layers(bpy.context.view_layer.layer_collection):
        layer.exclude = layer.name in excluded
    scene.frame_set(frame)


def _layers(layer: Any) -> list[Any]:
    return [child for direct in layer.children for child in (direct, *_layers(direct))]


def show_what_renders() -> None:
    """Make the evaluated scene, which is the viewport's, that of the render; switch off everything that is no surface."""
    import bpy

    for found in bpy.data.objects:
        found.hide_render = found.hide_render or found.type in UNRENDERED
        found.hide_viewport = found.hide_render
        found.show_instancer_for_viewport = found.show_instancer_for_render
        for modifier in found.modifiers:
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


def measure(path: str) -> tuple[np.ndarray, int]:
    """World positions of all vertices that belong to a face, [P, 3] float32 with Z up, and the number of triangles."""
    import bpy

    known: dict[int, tuple[np.ndarray, int, float]] = {}
    placed: list[np.ndarray] = []
    faces, area = 0, 0.0
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type not in SURFACES or not instance.show_self:
            continue
        key = instance.object.data.as_pointer()
        if key not in known:
            known[key] = measure_mesh(instance.object)
        local, count, size = known[key]
        matrix = np.array(instance.matrix_world)
        placed.append(local @ matrix[:3, :3].T + matrix[:3, 3])
        faces, area = faces + count, area + size
    if not faces:
        raise Refused("tree", f"{path} has no faces to render", "export the tree as a mesh")
    points = np.concatenate(placed)
    if not np.isfinite(points).all():
        raise Refused("tree", f"{path} has vertices that are NaN or infinite", "export the tree anew")
    if area == 0 or not np.ptp(points, axis=0).any():
        raise Refused("tree", f"{path} has zero size", "export the tree anew, at its real size")
    return points.astype(np.float32), faces


def measure_mesh(evaluated: Any) -> tuple[np.ndarray, int, float]:
    """Positions of the vertices in faces in float64, number and summed area of the triangles, in the object's own frame."""
    mesh = evaluated.to_mesh()
    mesh.calc_loop_triangles()
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    areas = np.empty(len(mesh.loop_triangles), np.float32)
    mesh.loop_triangles.foreach_get("area", areas)
    result = coordinates(mesh)[np.unique(corners)].astype(np.float64), len(areas), float(areas.sum())
    evaluated.to_mesh_clear()
    return result


def add_plain_material() -> None:
    """Give surfaces without a material a matt gray, or their vertex colors."""
    import bpy

    for found in bpy.data.objects:
        if found.type not in SURFACES or found.data is None:
            continue
        if not found.material_slots:
            found.data.materials.append(None)  # a slot
        for slot in found.material_slots:
            if slot.material is None:
                colors = getattr(found.data, "color_attributes", [])
                slot.material = plain_material(colors[0].name if len(colors) else "")
    bpy.context.view_layer.update()


def plain_material(attribute: str) -> Any:
    """A matt material, gray or colored by a vertex attribute."""
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


def add_light(job: dict[str, Any]) -> None:
    """Even white light or a panorama all around, and a sun."""
    import bpy
    from mathutils import Vector

    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("bbfit world")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = job["ambient_strength"]
    if job["hdri"]:
        panorama = tree.nodes.new("ShaderNodeTexEnvironment")
        try:
            panorama.image = bpy.data.images.load(job["hdri"])
        except RuntimeError as error:
            raise Refused("hdri", f"{job['hdri']} cannot be read", "give an .hdr or .exr file") from error
        if not panorama.image.size[0]:
            raise Refused("hdri", f"{job['hdri']} cannot be read", "give an .hdr or .exr file")
        tree.links.new(panorama.outputs["Color"], background.inputs["Color"])
    if job["sun_strength"] > 0:
        lamp = bpy.data.lights.new("bbfit sun", "SUN")
        lamp.energy = job["sun_strength"]
        sun = bpy.data.objects.new("bbfit sun", lamp)
        sun.rotation_euler = Vector(job["sun_direction"]).to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(sun)


def set_up_cycles(job: dict[str, Any]) -> None:
    """Renderer, colors and file format; every setting that pictures depend on and factory settings leave open."""
    import bpy

    scene = bpy.context.scene
    render, cycles, image = scene.render, scene.cycles, scene.render.image_settings
    render.engine = "CYCLES"
    use_device(job["device"])
    cycles.samples, cycles.use_adaptive_sampling = job["samples"], False
    cycles.transparent_max_bounces = TRANSPARENT_LAYERS
    cycles.use_denoising, cycles.denoiser = job["denoise"], "OPENIMAGEDENOISE"
    cycles.denoising_prefilter = "FAST"  # 0.1 dB below ACCURATE against 128 samples, in 40% of the time
    render.resolution_x = render.resolution_y = job["size"]
    render.resolution_percentage = 100
    render.threads_mode, render.threads = "FIXED", job["threads"]
    render.use_persistent_data = True
    render.film_transparent = True
    render.dither_intensity = 0.0
    render.use_file_extension = False
    image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    for name in render.bl_rna.properties.keys():  # times, paths and host names have no place in the pictures
        if name.startswith("use_stamp"):
            setattr(render, name, False)


def use_device(name: str) -> None:
    """Compute on the CPU or on every device of the named kind."""
    import bpy

    scene = bpy.context.scene
    if name == "cpu":
        scene.cycles.device = "CPU"
        return
    preferences = bpy.context.preferences.addons["cycles"].preferences
    kind = name.upper()
    try:
        preferences.compute_device_type = kind
    except TypeError as error:
        raise Refused("device", f"{name} is not known to this Blender", "choose another one, or cpu") from error
    preferences.refresh_devices()
    if not any(device.type == kind for device in preferences.devices):
        raise Refused("device", f"{name} was not found on this machine", "choose another one, or cpu")
    for device in preferences.devices:
        device.use = device.type == kind
    scene.cycles.device = "GPU"


def render(frame: dict[str, Any]) -> None:
    """Render one picture to a temporary name and rename it."""
    import bpy
    from mathutils import Matrix

    scene, path = bpy.context.scene, Path(frame["path"])
    lens = scene.camera.data
    lens.sensor_fit = "HORIZONTAL"
    if frame["extent"] is None:
        lens.type, lens.angle = "PERSP", math.radians(frame["fov_degrees"])
    else:
        lens.type, lens.ortho_scale = "ORTHO", frame["extent"]
    lens.clip_start, lens.clip_end = frame["clip"]
    scene.camera.matrix_world = Matrix(frame["camera_to_world"])
    scene.cycles.seed = frame["seed"]
    part = path.with_name(f".{path.name}.part")
    scene.render.filepath = str(part).replace("{", "{{").replace("}", "}}")  # Blender fills in {names}
    try:
        bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        raise Refused("views", f"{path} could not be rendered ({' '.join(str(error).split()).removeprefix('Error: ')})", AGAIN) from error
    try:
        if not part.read_bytes().endswith(b"IEND\xaeB`\x82"):
            raise Refused("views", f"{path} could not be written completely", AGAIN)
        part.replace(path)
    except OSError as error:
        raise Refused("views", f"{path} could not be written ({error.strerror})", AGAIN) from error


if __name__ == "__main__":
    main()
