"""Thin surfaces that transmit light, such as leaves: glTF's KHR_materials_diffuse_transmission, which Blender's importer leaves out.

``worker.py`` imports this module by path, so it does not import bbfit. The parent has checked the values of the extension.
"""

from __future__ import annotations

from typing import Any

NAME = "KHR_materials_diffuse_transmission"


def read_transmission() -> None:
    """Make Blender's glTF importer call :class:`Transmission` for each material: it asks the modules of add-ons for this name."""
    import bpy  # noqa: F401 - makes Blender's add-ons importable
    import io_scene_gltf2

    io_scene_gltf2.glTF2ImportUserExtension = Transmission


class Transmission:
    """An extension of Blender's glTF importer."""

    def gather_import_material_after_hook(self, source: Any, vertex_color: Any, material: Any, gltf: Any) -> None:
        """Add the transmitted light to a material that has been imported; ``source`` is the material of the glTF.

        The surface reflects ``(1 - f)`` of its base color and transmits ``f`` of the transmission color, both diffusely and below the
        specular reflection, which keeps its strength. Metal and glass (KHR_materials_transmission) transmit nothing diffusely.
        """
        surface = next((node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"), None)
        if surface is not None and NAME in (source.extensions or {}):
            _transmit(surface, source, vertex_color, material, gltf)


def _transmit(surface: Any, source: Any, vertex_color: Any, material: Any, gltf: Any) -> None:
    from io_scene_gltf2.blender.imp.material_utils import MaterialHelper, color_factor_and_texture, scalar_factor_and_texture

    values, graph = source.extensions[NAME], _Graph(material.node_tree)
    imported = MaterialHelper(gltf, source, material, vertex_color)
    share, color = graph.new("ShaderNodeMath"), graph.new("ShaderNodeMix")
    share.operation, share.inputs[1].default_value = "MULTIPLY", 1.0
    color.data_type, color.blend_type = "RGBA", "MULTIPLY"
    color.inputs["Factor"].default_value, color.inputs[7].default_value = 1.0, (1.0, 1.0, 1.0, 1.0)
    texture, factor = values.get("diffuseTransmissionTexture"), values.get("diffuseTransmissionFactor", 0.0)
    scalar_factor_and_texture(imported, (0, 0), "Transmission", share.inputs[0], factor, texture, channel=4)
    texture, factor = values.get("diffuseTransmissionColorTexture"), values.get("diffuseTransmissionColorFactor", [1.0] * 3)
    color_factor_and_texture(imported, (0, 0), "Transmission Color", color.inputs[6], factor, texture)

    of_surface = {name: graph.source(surface.inputs[name]) for name in ("Metallic", "Transmission Weight", "IOR", "Alpha", "Base Color")}
    transmitted = share.outputs[0]
    for name in ("Metallic", "Transmission Weight"):
        transmitted = graph.math("MULTIPLY", transmitted, graph.math("SUBTRACT", 1.0, of_surface[name]))
    graph.into(graph.scaled(of_surface["Base Color"], graph.math("SUBTRACT", 1.0, transmitted)), surface.inputs["Base Color"])
    # Blender inverts the index of refraction where it sees a back.
    facing = graph.math("MULTIPLY_ADD", graph.new("ShaderNodeNewGeometry").outputs["Backfacing"], -2.0, 1.0)
    fresnel = graph.new("ShaderNodeFresnel")
    graph.into(graph.math("POWER", of_surface["IOR"], facing), fresnel.inputs["IOR"])
    specular = graph.math("MULTIPLY", graph.math("MULTIPLY", 2.0, graph.source(surface.inputs["Specular IOR Level"])), fresnel.outputs[0])
    below = graph.math("MULTIPLY", graph.math("SUBTRACT", 1.0, specular, clamp=True), of_surface["Alpha"])
    leaf = graph.new("ShaderNodeBsdfTranslucent")
    graph.into(graph.scaled(color.outputs[2], graph.math("MULTIPLY", transmitted, below)), leaf.inputs["Color"])
    graph.add(surface.outputs[0], leaf.outputs[0])


class _Graph:
    """The nodes of a material."""

    def __init__(self, tree: Any) -> None:
        self._tree = tree

    def new(self, kind: str) -> Any:
        return self._tree.nodes.new(kind)

    def source(self, socket: Any) -> Any:
        """What feeds an input of a node: another socket, or its own value."""
        if socket.is_linked:
            return socket.links[0].from_socket
        value = socket.default_value
        return value if isinstance(value, float) else tuple(value)

    def into(self, value: Any, socket: Any) -> None:
        """Feed an input of a node."""
        if isinstance(value, float | tuple):
            socket.default_value = value
        else:
            self._tree.links.new(value, socket)

    def math(self, operation: str, *values: Any, clamp: bool = False) -> Any:
        """The result of an operation on numbers."""
        node = self.new("ShaderNodeMath")
        node.operation, node.use_clamp = operation, clamp
        for value, socket in zip(values, node.inputs, strict=False):
            self.into(value, socket)
        return node.outputs[0]

    def scaled(self, color: Any, factor: Any) -> Any:
        """A color times a number."""
        node = self.new("ShaderNodeVectorMath")
        node.operation = "SCALE"
        self.into(color[:3] if isinstance(color, tuple) else color, node.inputs[0])
        self.into(factor, node.inputs["Scale"])
        return node.outputs[0]

    def add(self, shader: Any, other: Any) -> None:
        """Add a shader to another wherever that is used."""
        both, used = self.new("ShaderNodeAddShader"), [link.to_socket for link in shader.links]
        for value, socket in zip((shader, other), both.inputs, strict=True):
            self.into(value, socket)
        for socket in used:
            self.into(both.outputs[0], socket)
