"""Render a picture and, in the same pass, pictures under each of its lights alone. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit.

Cycles separates the light of groups of lamps ("light groups"), but its denoiser then covers only their sum. So the compositor denoises each
group, with the guides of all of them, in the part of the picture that is rendered. The view's own picture is the sum of the denoised
groups.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

_AMBIENT = "ambient"
# Strength of a sun under which a matte white surface that faces it is white.
_UNIT_SUN = math.pi


def set_up(settings: dict[str, Any]) -> None:
    """Give the sky unit strength, add ``settings["suns"]`` suns of unit strength, and make each a group of its own."""
    import bpy

    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 1.0
    scene.world.lightgroup = layer.lightgroups.add(name=_AMBIENT).name
    for number in range(settings["suns"]):
        lamp = bpy.data.lights.new(f"bbfit sun {number}", "SUN")
        lamp.energy = _UNIT_SUN
        sun = bpy.data.objects.new(lamp.name, lamp)
        sun.lightgroup = layer.lightgroups.add(name=f"sun{number}").name
        scene.collection.objects.link(sun)
    scene.cycles.use_denoising = False
    layer.cycles.denoising_store_passes = settings["denoise"]
    layer.use_pass_diffuse_color = layer.use_pass_normal = True
    scene.use_nodes = True


def aim(frame: dict[str, Any], settings: dict[str, Any]) -> dict[str, str]:
    """Aim the suns, and connect the passes to files beside the picture. Return the final path of each of those files."""
    import bpy
    from mathutils import Vector

    lights = frame["lights"]
    for number in range(settings["suns"]):
        sun = bpy.data.objects[f"bbfit sun {number}"]
        sun.hide_render = number >= len(lights["suns"])
        if not sun.hide_render:
            sun.rotation_euler = Vector(lights["suns"][number]).to_track_quat("Z", "Y").to_euler()
    graph = _Graph(frame, settings)
    ambient = graph.light(_AMBIENT)
    has_sun = settings["sun_strength"] > 0
    suns = [graph.light(f"sun{number}") for number in range(max(int(has_sun), len(lights["of_suns"])))]
    own = graph.scaled(ambient, settings["ambient_strength"])
    if has_sun:
        own = graph.sum(own, graph.scaled(suns[0], settings["sun_strength"] / _UNIT_SUN))
    graph.picture(own)
    graph.file(ambient, lights["ambient"])
    for sun, name in zip(suns, lights["of_suns"], strict=False):
        graph.file(sun, name)
    graph.file(graph.render.outputs["DiffCol"], lights["albedo"])
    if lights["normal"]:
        graph.file(graph.as_color(graph.render.outputs["Normal"]), lights["normal"], data=True)
    return graph.files


def _pixels(low: float, high: float, size: int) -> tuple[int, int]:
    """The first pixel and the number of pixels between two edges, in [0, 1], of a picture.

    The compositor centers what it crops. So that a whole number of pixels leads back, a side is odd if that of the picture is odd.
    """
    first, end = round(low * size), round(high * size)
    if (end - first - size) % 2:
        first, end = (first, end + 1) if end < size else (first - 1, end)
    return first, end - first


class _Graph:
    """The nodes of the compositor for one picture."""

    def __init__(self, frame: dict[str, Any], settings: dict[str, Any]) -> None:
        import bpy

        self.nodes, self.links, self.files = bpy.context.scene.node_tree.nodes, bpy.context.scene.node_tree.links, dict[str, str]()
        self._denoise, self._size = settings["denoise"], settings["size"]
        left, bottom, right, top = frame["border"] or (0.0, 0.0, 1.0, 1.0)
        self._rendered = [("X", "Width", *_pixels(left, right, self._size)), ("Y", "Height", *_pixels(bottom, top, self._size))]
        self.nodes.clear()
        self.render = self.nodes.new("CompositorNodeRLayers")
        self._composite = self.nodes.new("CompositorNodeComposite")
        self._output = self.nodes.new("CompositorNodeOutputFile")
        self._output.base_path = str(Path(frame["path"]).parent).replace("{", "{{").replace("}", "}}")
        form = self._output.format
        form.file_format, form.color_mode, form.color_depth = "PNG", "RGBA", "8"
        self._output.file_slots.clear()

    def light(self, group: str) -> Any:
        """The light of a group, denoised."""
        noisy = self.render.outputs[f"Combined_{group}"]
        if not self._denoise:
            return noisy
        node = self.nodes.new("CompositorNodeDenoise")
        node.prefilter, node.use_hdr = "FAST", True
        for name, source in (("Image", noisy), ("Normal", self._guide("Normal")), ("Albedo", self._guide("Albedo"))):
            self.links.new(self._cropped(source), node.inputs[name])
        return self._mixed("MIX", noisy, self._moved(node.outputs[0]))

    def _cropped(self, color: Any) -> Any:
        """The part of a picture that is rendered, around the center of the frame."""
        node = self.nodes.new("CompositorNodeCrop")
        self.links.new(color, node.inputs["Image"])
        for axis, side, first, count in self._rendered:
            node.inputs[axis].default_value, node.inputs[side].default_value = first, count
        node.inputs["Alpha Crop"].default_value = False
        return node.outputs[0]

    def _moved(self, color: Any) -> Any:
        """A cropped picture at its place in the frame."""
        node = self.nodes.new("CompositorNodeTranslate")
        self.links.new(color, node.inputs["Image"])
        for axis, _, first, count in self._rendered:
            node.inputs[axis].default_value = first + (count - self._size) / 2
        return node.outputs[0]

    def _guide(self, name: str) -> Any:
        return self.render.outputs[f"Denoising {name}"]

    def scaled(self, color: Any, factor: float) -> Any:
        """A color times a factor."""
        return self._mixed("MULTIPLY", color, (factor, factor, factor, 1.0))

    def sum(self, first: Any, second: Any) -> Any:
        """The sum of two colors."""
        return self._mixed("ADD", first, second)

    def as_color(self, normal: Any) -> Any:
        """(normal + 1) / 2, weighted like the normal by how much of a pixel surfaces cover."""
        half = (0.5, 0.5, 0.5, 1.0)
        return self.sum(self._mixed("MULTIPLY", normal, half), self._mixed("MULTIPLY", self.render.outputs["Alpha"], half))

    def _mixed(self, kind: str, first: Any, second: Any) -> Any:
        node = self.nodes.new("CompositorNodeMixRGB")
        node.blend_type = kind
        node.inputs[0].default_value = 1.0
        for value, socket in ((first, node.inputs[1]), (second, node.inputs[2])):
            if isinstance(value, tuple):
                socket.default_value = value
            else:
                self.links.new(value, socket)
        return node.outputs[0]

    def _with_alpha(self, color: Any) -> Any:
        node = self.nodes.new("CompositorNodeSetAlpha")
        node.mode = "REPLACE_ALPHA"  # passes are premultiplied
        self.links.new(color, node.inputs["Image"])
        self.links.new(self.render.outputs["Alpha"], node.inputs["Alpha"])
        return node.outputs[0]

    def picture(self, color: Any) -> None:
        """Make a color the picture of the render."""
        self.links.new(self._with_alpha(color), self._composite.inputs["Image"])

    def file(self, color: Any, path: str | None, *, data: bool = False) -> None:
        """Write a color to a file, if there is one; ``data`` are written as they are, colors as sRGB."""
        import bpy

        if path is None:
            return
        name = f".bbfit-{Path(path).stem}-"
        slot = self._output.file_slots.new(name)
        if data:
            form = self._output.file_slots[-1]
            form.use_node_format = False
            form.format.file_format, form.format.color_mode, form.format.color_depth = "PNG", "RGBA", "8"
            form.format.color_management = "OVERRIDE"
            form.format.view_settings.view_transform = "Raw"
        self.links.new(self._with_alpha(color), slot)
        self.files[str(Path(path).with_name(f"{name}{bpy.context.scene.frame_current:04}"))] = path
