"""Run Blender in a process of its own: load one tree, measure it, and render pictures of it or convert it.

The parent starts this file by path. It imports only the files beside it, not bbfit, so that it starts fast. Parent and worker exchange
lines of JSON. On standard input, the first line contains the settings. Each further line requests a picture. On standard output, the worker
answers ``ready`` (followed by the vertices as raw float32 if the settings request them), then ``done`` for each picture. It answers
``refused`` with a reason if an input cannot be used. If the settings contain ``convert``, ``worker_glb.py`` writes the tree as a GLB file,
and the worker answers ``converted`` or ``refused``. If they contain ``field``, ``worker_field.py`` plants copies of the tree, and the
worker answers ``rendered`` with the costs of a picture. If they contain ``check``, it checks the device and the panorama without a tree,
and answers ``usable`` or ``refused``. The output of Blender itself goes to standard error. Standard input ends when the
parent closes it or dies. The worker then ends too, if need be in the middle of a render.

One process renders one picture at a time, because two simultaneous renders crash Blender.
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
from types import ModuleType
from typing import Any, NoReturn

# Leaves are often pictures with alpha. A ray may have to cross this many of them.
TRANSPARENT_LAYERS = 64
# Rays to lights that would add less than this are left out at random, without bias: 5% faster at the same error.
LEAST_LIGHT = 0.1
RESUME_HINT = "free the disk or make the folder writable, then start again; finished views are kept"
CONVERT_HINT = "free the disk of temporary files, then start again, or check the file in Blender"


def import_beside(name: str) -> ModuleType:
    """Import a module from the folder of this file. ``sys.path`` does not contain that folder."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module here
    spec.loader.exec_module(module)
    return module


SCENE, LIGHTS, THIN, DEPTH = (import_beside(f"worker_{name}") for name in ("scene", "lights", "thin", "depth"))


def main() -> NoReturn:
    """Answer the requests of the parent until it closes standard input."""
    sys.excepthook = _die
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # the output of C code goes to standard error
    requests: queue.Queue[dict[str, Any]] = queue.Queue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()

    def answer(event: str, **fields: Any) -> None:
        payload = fields.pop("payload", b"")
        answers.write(json.dumps({"event": event, **fields, "payload": len(payload)}).encode() + b"\n" + payload)
        answers.flush()

    settings = requests.get()
    try:
        if "check" in settings:
            check(settings)
            answer("usable")
            os._exit(0)
        if "convert" in settings:
            convert(settings, answer)
            os._exit(0)
        if "field" in settings:
            render_field(settings, answer)
            os._exit(0)
        prepare(settings, answer)
        while True:
            frame = requests.get()
            render(frame, settings)
            answer("done", frame=frame["frame"])
    except SCENE.InputRefused as error:
        answer("refused", reason=error.args)
    os._exit(0)  # an ordinary exit would wait for the listening thread


def _die(*error: Any) -> None:
    """Print an uncaught error and exit at once. An ordinary exit fails because of the listening thread, which would bury the message."""
    traceback.print_exception(*error)
    sys.stderr.flush()
    os._exit(1)


def _listen(requests: queue.Queue[dict[str, Any]]) -> None:
    for line in sys.stdin.buffer:
        requests.put(json.loads(line))
    os._exit(1)


def check(settings: dict[str, Any]) -> None:
    """Refuse a device that Blender does not find, and a panorama that it cannot read."""
    import bpy

    bpy.context.scene.render.engine = "CYCLES"
    use_device(settings["device"])
    if settings["hdri"]:
        load_panorama(settings["hdri"])


def convert(settings: dict[str, Any], answer: Any) -> None:
    """Load the tree and write it as a GLB file."""
    tree, path, triangles = settings["tree"], settings["convert"]["path"], settings["convert"]["triangles"]
    _, facts = SCENE.open_tree(tree, settings["files"])
    try:
        count = import_beside("worker_glb").write(path, triangles, import_beside("worker_thinning").thinned)
    except RuntimeError as error:  # any failure of the exporter
        reason = " ".join(str(error).split())[-200:]
        raise SCENE.InputRefused("tree", f"{tree} cannot be written as .glb ({reason})", CONVERT_HINT) from error
    if not count:
        raise SCENE.InputRefused("triangles", f"nothing is left of {tree} with {triangles}", "allow more triangles")
    answer("converted", **facts, triangles=count)


def render_field(settings: dict[str, Any], answer: Any) -> None:
    """Load the tree and render a field of copies of it."""
    field, frame = import_beside("worker_field"), settings["field"]["frame"]
    THIN.read_transmission()
    SCENE.open_tree(settings["tree"], settings["files"])
    field.plant(settings["field"]["matrices"])
    set_up(settings)
    answer("rendered", **field.timed(lambda: render(frame, settings)))


def prepare(settings: dict[str, Any], answer: Any) -> None:
    """Load the tree, set up light, camera and renderer, and report the measurements of the tree."""
    THIN.read_transmission()
    points, facts = SCENE.open_tree(settings["tree"], settings["files"])
    set_up(settings)
    answer("ready", **facts, payload=points.tobytes() if settings["measure"] else b"")


def set_up(settings: dict[str, Any]) -> None:
    """Set up light, camera and renderer for the loaded scene."""
    import bpy

    add_light(settings)
    set_up_cycles(settings)
    if settings["suns"]:
        LIGHTS.set_up(settings)
    camera = bpy.data.objects.new("bbfit camera", bpy.data.cameras.new("bbfit camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera


def add_light(settings: dict[str, Any]) -> None:
    """Add ambient light, which is uniform white or a panorama, and a sun, unless ``worker_lights.py`` adds suns."""
    import bpy
    from mathutils import Vector

    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("bbfit world")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = settings["ambient_strength"]
    if settings["hdri"]:
        panorama = tree.nodes.new("ShaderNodeTexEnvironment")
        panorama.image = load_panorama(settings["hdri"])
        tree.links.new(panorama.outputs["Color"], background.inputs["Color"])
    if settings["sun_strength"] > 0 and not settings["suns"]:
        lamp = bpy.data.lights.new("bbfit sun", "SUN")
        lamp.energy = settings["sun_strength"]
        sun = bpy.data.objects.new("bbfit sun", lamp)
        sun.rotation_euler = Vector(settings["sun_direction"]).to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(sun)


def load_panorama(path: str) -> Any:
    """Load a panorama, and refuse a file that is none."""
    import bpy

    unreadable = SCENE.InputRefused("hdri", f"{path} cannot be read", "give an .hdr or .exr file")
    try:
        image = bpy.data.images.load(path)
    except RuntimeError as error:
        raise unreadable from error
    if not image.size[0]:
        raise unreadable
    return image


def set_up_cycles(settings: dict[str, Any]) -> None:
    """Set the renderer, the colors and the file format: every setting that affects pictures and differs from the factory settings."""
    import bpy

    scene = bpy.context.scene
    render, cycles, image = scene.render, scene.cycles, scene.render.image_settings
    render.engine = "CYCLES"
    use_device(settings["device"])
    cycles.use_adaptive_sampling = False
    cycles.transparent_max_bounces = TRANSPARENT_LAYERS
    cycles.use_light_tree = False  # a few lights need no tree to choose from
    cycles.light_sampling_threshold = LEAST_LIGHT
    cycles.use_denoising, cycles.denoiser = settings["denoise"], "OPENIMAGEDENOISE"
    cycles.denoising_prefilter = "FAST"  # 0.1 dB below ACCURATE against 128 samples, in 40% of the time
    render.resolution_x = render.resolution_y = settings["size"]
    render.resolution_percentage = 100
    render.threads_mode, render.threads = "FIXED", settings["threads"]
    render.use_persistent_data = True
    render.film_transparent, render.use_crop_to_border = True, False
    render.dither_intensity = 0.0
    render.use_file_extension = False
    image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    for name in render.bl_rna.properties.keys():  # no times, paths or host names in the metadata of pictures
        if name.startswith("use_stamp"):
            setattr(render, name, False)


def use_device(name: str) -> None:
    """Render on the CPU, or on all devices of a kind such as ``cuda``."""
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
        raise SCENE.InputRefused("render_device", f"this Blender does not support {name}", "choose another device, or cpu") from error
    preferences.refresh_devices()
    if not any(device.type == kind for device in preferences.devices):
        raise SCENE.InputRefused("render_device", f"this machine has no {name} device", "choose another device, or cpu")
    for device in preferences.devices:
        device.use = device.type == kind
    scene.cycles.device = "GPU"


def render(frame: dict[str, Any], settings: dict[str, Any]) -> None:
    """Render one picture, and those under single lights or its depth that belong to it, under temporary names, then rename them."""
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
    scene.render.use_border = frame["border"] is not None
    for edge, place in zip(("min_x", "min_y", "max_x", "max_y"), frame["border"] or (), strict=False):
        setattr(scene.render, f"border_{edge}", place)
    scene.cycles.seed, scene.cycles.samples = frame["seed"], frame["samples"]
    part = path.with_name(f".bbfit-{path.stem}.part")
    scene.render.filepath = str(part).replace("{", "{{").replace("}", "}}")  # Blender would replace {names}
    parts = LIGHTS.aim(frame, settings) if "lights" in frame else {}
    if "depth" in frame:
        parts = DEPTH.aim(Path(frame["depth"]), frame["clip"])
    try:
        bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split()).removeprefix("Error: ")
        raise SCENE.InputRefused("views", f"{path} could not be rendered ({reason})", RESUME_HINT) from error
    for written, final in {**parts, str(part): str(path)}.items():
        keep(Path(written), Path(final))


def keep(part: Path, path: Path) -> None:
    """Give a finished picture its name."""
    try:
        picture = part.read_bytes()
        if not picture.endswith(b"IEND\xaeB`\x82"):
            raise SCENE.InputRefused("views", f"{path} could not be written completely", RESUME_HINT)
        part.write_bytes(without_texts(picture))
        part.replace(path)
    except OSError as error:
        raise SCENE.InputRefused("views", f"{path} could not be written ({error.strerror})", RESUME_HINT) from error


def without_texts(png: bytes) -> bytes:
    """A PNG without texts: Cycles writes its seconds into them, so that no two renders would have the same bytes."""
    kept, start = png[:8], 8
    while start < len(png):
        end = start + 12 + int.from_bytes(png[start : start + 4], "big")
        kept += b"" if png[start + 4 : start + 8] == b"tEXt" else png[start:end]
        start = end
    return kept


if __name__ == "__main__":
    main()
