"""Runs in a process of its own, started by blender_viewer.py: imports one model as a user does and renders it with Cycles or EEVEE.

Standard input holds the job as JSON. Pictures are 16-bit PNGs, 0000.png, 0001.png, ... in the job's folder.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

# A ray may have to cross this many billboards.
TRANSPARENT_LAYERS = 128


def main() -> None:
    """Do one job."""
    import bpy
    from mathutils import Matrix

    job = json.load(sys.stdin)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if job["model"].endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=job["model"])
    else:
        bpy.ops.wm.obj_import(filepath=job["model"])
        unlight()
    set_up(job)
    scene, lens = bpy.context.scene, bpy.data.cameras.new("camera")
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)
    lens.sensor_fit = "HORIZONTAL"
    sky = add_light(job) if job["lights"] is not None or job["panorama"] is not None else None
    for index, view in enumerate(job["views"]):
        if job["lights"] is not None:
            aim(job["lights"][index], sky)
        scene.camera.matrix_world = Matrix(view["camera_to_world"])
        if job["orthographic"]:
            lens.type, lens.ortho_scale = "ORTHO", view["extent"]
        else:
            lens.type, lens.angle = "PERSP", view["angle"]
        lens.shift_x, lens.shift_y = view["shift"]
        lens.clip_start, lens.clip_end = view["clip"]
        scene.render.filepath = os.path.join(job["folder"], f"{index:04d}.png")  # noqa: PTH118
        bpy.ops.render.render(write_still=True)


def add_light(job: dict[str, Any]) -> Any:
    """Add a sun and a sky, or a sky with a panorama, and return the sky's node; docs/engines.md says what a user sets."""
    import bpy

    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    sky = tree.nodes["Background"]
    sky.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    if job["panorama"] is not None:
        picture = tree.nodes.new("ShaderNodeTexEnvironment")
        picture.image = bpy.data.images.load(job["panorama"])
        tree.links.new(picture.outputs["Color"], sky.inputs["Color"])
    else:
        lamp = bpy.data.lights.new("sun", "SUN")
        lamp.angle = 0.0
        scene.collection.objects.link(bpy.data.objects.new("sun", lamp))
    if not job["as_it_comes"]:
        for item in bpy.data.objects:
            if item.type == "MESH":
                item.visible_diffuse = item.visible_shadow = False
        for material in bpy.data.materials:
            material.cycles.use_bump_map_correction = False
    return sky


def aim(light: dict[str, Any], sky: Any) -> None:
    """Give the sun and the sky the values of one light."""
    import bpy
    from mathutils import Vector

    sun = bpy.data.objects["sun"]
    sun.rotation_euler = Vector(light["towards"]).to_track_quat("Z", "Y").to_euler()
    sun.data.energy, sun.data.color = light["strength"], light["color"]
    sky.inputs["Strength"].default_value = light["ambient"]


def unlight() -> None:
    """Let materials emit their color in place of reflecting light: what an MTL's ``illum 0`` asks for and Blender's importer ignores."""
    import bpy

    for material in bpy.data.materials:
        tree = material.node_tree
        for surface in [node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"]:
            (link,) = surface.inputs["Base Color"].links
            tree.links.new(link.from_socket, surface.inputs["Emission Color"])
            tree.links.remove(link)
            surface.inputs["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)
            surface.inputs["Emission Strength"].default_value = 1.0


def set_up(job: dict[str, Any]) -> None:
    """The renderer: one sample at the center of each pixel, nothing but what the model itself emits."""
    import bpy

    scene = bpy.context.scene
    render, cycles, image = scene.render, scene.cycles, scene.render.image_settings
    render.engine, cycles.device = "CYCLES", "CPU"
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = job["samples"], False, False
    cycles.transparent_max_bounces = TRANSPARENT_LAYERS
    # As narrow as Blender allows; of filters of this width a Gaussian keeps nearest to the center.
    cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", 0.01
    render.resolution_x, render.resolution_y, render.resolution_percentage = job["width"], job["height"], 100
    render.threads_mode, render.threads = "FIXED", 1
    render.film_transparent, render.dither_intensity = True, 0.0
    render.use_persistent_data = True
    image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "16"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    if job["eevee"]:
        render.engine, scene.eevee.taa_render_samples, render.filter_size = "BLENDER_EEVEE_NEXT", job["samples"], 0.0
        bpy.context.preferences.system.anisotropic_filter = "FILTER_0"


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # an ordinary exit crashes in Blender's own clean-up now and then
