"""Write the depth of each picture beside it. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit.

Cycles takes depth from the first light path of a pixel, without a filter: where an edge crosses the pixel, it is the depth of one side.
"""

from __future__ import annotations

from pathlib import Path


def aim(path: Path, clip: tuple[float, float]) -> dict[str, str]:
    """Connect the pass of depth to a file that becomes ``path``. Return the final path by that of the file.

    Depth is 0 at the nearest clip distance and 1 at the farthest, and where nothing is seen, in linear values of 8 bits.
    """
    import bpy

    scene = bpy.context.scene
    bpy.context.view_layer.use_pass_z = scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    layers, composite = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeComposite")
    links.new(layers.outputs["Image"], composite.inputs["Image"])
    share = nodes.new("CompositorNodeMapRange")
    share.use_clamp = True
    share.inputs["From Min"].default_value, share.inputs["From Max"].default_value = clip
    links.new(layers.outputs["Depth"], share.inputs["Value"])
    output = nodes.new("CompositorNodeOutputFile")
    output.base_path = str(path.parent).replace("{", "{{").replace("}", "}}")
    form = output.format
    form.file_format, form.color_mode, form.color_depth = "PNG", "RGBA", "8"
    form.color_management = "OVERRIDE"
    form.view_settings.view_transform = "Raw"
    name = f".bbfit-{path.stem}-"
    output.file_slots.clear()
    links.new(share.outputs["Value"], output.file_slots.new(name))
    return {str(path.with_name(f"{name}{scene.frame_current:04}")): str(path)}
