"""Vertices and indices of a GLB as integers, which say nearly as much as floats in half of the bytes.

The extension KHR_mesh_quantization allows integer positions, normals and tangents. glTF 2.0 itself allows texture coordinates of 16 bits
(section 3.7.2.1), but not every program reads them right (trimesh 5.2 does not), so they come with the extension.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.geometry.cards import Card, Cards, texture_slopes
from bbfit.glb import joined_glb, split_glb

EXTENSION = "KHR_mesh_quantization"
# Component types of glTF, and the largest index of 16 bits (65,535 would restart a primitive; glTF 2.0, section 3.7.2.1).
_BYTE, _SHORT, _UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT, _LARGEST_INDEX = 5120, 5122, 5123, 5125, 5126, 65_534
# The type in numpy, and the largest integer of each.
_INTEGERS = {_BYTE: ("i1", 127), _SHORT: ("<i2", 32_767), _UNSIGNED_SHORT: ("<u2", 65_535)}
# Vertices begin at multiples of so many bytes (glTF 2.0, section 3.6.2.4).
_ALIGNMENT = 4
# Half of the longest side of a mesh of a single point, in meters.
_SMALLEST = 1e-9
# Texture coordinates have 16 bits unless a side of the atlas has more texels: then a corner would move by more than 1/32 of a texel.
_LARGEST_SIDE = 4096


def on_grid(cards: Cards) -> Cards:
    """The cards with corners at texture coordinates of 16 bits. Their textures stay where they are, to a texel's fraction.

    A corner moves in its card's plane, by at most 1/32 of a texel. An atlas with more than 4096 texels a side keeps its coordinates.
    """
    return cards.with_cards([_on_grid(card) for card in cards.cards]) if _is_short(cards) else cards


def _is_short(cards: Cards) -> bool:
    return max(cards.atlas.image.shape[:2]) <= _LARGEST_SIDE


def _on_grid(card: Card) -> Card:
    _, largest = _INTEGERS[_UNSIGNED_SHORT]
    uvs = np.rint(card.uvs * largest) / largest
    return replace(card, uvs=uvs, corners=card.corners + (uvs - card.uvs) @ texture_slopes(card))


def with_short_indices(tree: dict[str, Any], views: list[bytes]) -> list[bytes]:
    """The contents of the buffer views of a GLB with indices of 16 bits wherever these suffice; the JSON changes in place."""
    views = list(views)
    for accessor in tree["accessors"]:
        if accessor["componentType"] == _UNSIGNED_INT:
            indices = np.frombuffer(views[accessor["bufferView"]], "<u4")
            if indices.max() <= _LARGEST_INDEX:
                views[accessor["bufferView"]] = indices.astype("<u2").tobytes()
                accessor["componentType"] = _UNSIGNED_SHORT
    return views


def quantized(tree: dict[str, Any], views: list[bytes], cards: Cards) -> list[bytes]:
    """The contents of the buffer views of a GLB of cards :func:`on_grid` with integers in place of floats; the JSON changes in place.

    Positions and texture coordinates have 16 bits, normals and tangents 8. A unit of all positions is 1/32,767 of the largest distance
    along an axis from the origin of a vertex's node. Nodes that have no origin get the center of their common bounds.
    """
    geometry = _Geometry(tree, list(views))
    kinds = {"NORMAL": _BYTE, "TANGENT": _BYTE} | ({"TEXCOORD_0": _UNSIGNED_SHORT} if _is_short(cards) else {})
    attributes = [primitive["attributes"] for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    # Meshes with equal values share an accessor.
    chosen = {each[name]: kind for each in attributes for name, kind in kinds.items() if name in each}
    for number, kind in chosen.items():
        geometry.put(number, kind)
    geometry.quantize_positions()
    geometry.require()
    return geometry.views


def quantized_tree(glb: bytes) -> bytes:
    """The GLB of a tree that :func:`~bbfit.blender.conversion.tree_as_glb` wrote, with integers in place of floats.

    It has the same place and size in half of the bytes or less. Positions have 16 bits: a unit is 1/32,767 of half of a mesh's longest
    side. Normals have 8 bits, and texture coordinates 16 if all of a primitive's are in [0, 1]. Others, and colors, stay as they are.
    What changes nothing is left out: texture coordinates that no texture uses, and indices where each names a vertex of its own.
    """
    tree, views = split_glb(glb)
    geometry = _Geometry(tree, _without_unused(tree, with_short_indices(tree, views)))
    for number, mesh in enumerate(tree["meshes"]):
        attributes = [primitive["attributes"] for primitive in mesh["primitives"]]
        for each in attributes:
            if "NORMAL" in each:
                geometry.put(each["NORMAL"], _BYTE)
            for texture in [key for key in each if key.startswith("TEXCOORD_")]:
                geometry.put_fractions(each[texture])
        bounds = [tree["accessors"][each["POSITION"]] for each in attributes]
        low, high = np.min([each["min"] for each in bounds], 0), np.max([each["max"] for each in bounds], 0)
        origin, unit = (low + high) / 2, max(float((high - low).max()) / 2, _SMALLEST) / _INTEGERS[_SHORT][1]
        for each in attributes:
            geometry.put(each["POSITION"], _SHORT, unit, origin)
        for node in tree["nodes"]:
            if node.get("mesh") == number:
                _rescale(node, unit, origin)
    geometry.require()
    return joined_glb(tree, geometry.views)


def _without_unused(tree: dict[str, Any], views: list[bytes]) -> list[bytes]:
    """The contents of the buffer views of a tree without what changes nothing, see :func:`quantized_tree`; the JSON changes in place.

    Each primitive has accessors of its own.
    """
    accessors, views = tree["accessors"], list(views)
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    for primitive in primitives:
        attributes = primitive["attributes"]
        sets = _texture_sets(tree["materials"][primitive["material"]]) if "material" in primitive else 0
        for name in [key for key in attributes if key.startswith("TEXCOORD_") and int(key.removeprefix("TEXCOORD_")) >= sets]:
            del attributes[name]
        points = accessors[attributes["POSITION"]]["count"]
        if "indices" in primitive and (corners := accessors[primitive["indices"]])["count"] == points:
            order = np.frombuffer(views[corners["bufferView"]], {_UNSIGNED_SHORT: "<u2", _UNSIGNED_INT: "<u4"}[corners["componentType"]])
            if len(np.unique(order)) == points:
                for view in (accessors[number]["bufferView"] for number in attributes.values()):
                    views[view] = np.frombuffer(views[view], np.uint8).reshape(points, -1)[order].tobytes()
                del primitive["indices"]
    places = [(primitive["attributes"], name) for primitive in primitives for name in primitive["attributes"]]
    places += [(primitive, "indices") for primitive in primitives if "indices" in primitive]
    tree["accessors"] = _kept(accessors, places)
    pictures = [(image, "bufferView") for image in tree.get("images", ()) if "bufferView" in image]
    numbered = _kept(list(enumerate(tree["bufferViews"])), [*((accessor, "bufferView") for accessor in tree["accessors"]), *pictures])
    tree["bufferViews"] = [view for _, view in numbered]
    return [views[number] for number, _ in numbered]


def _kept(items: list[Any], places: list[tuple[dict[str, Any], str]]) -> list[Any]:
    """Those of the items whose numbers are at these places, which get the new numbers."""
    numbers = {old: new for new, old in enumerate(sorted({own[key] for own, key in places}))}
    for own, key in places:
        own[key] = numbers[own[key]]
    return [items[number] for number in numbers]


def _texture_sets(part: Any) -> int:
    """How many sets of texture coordinates a material, or a part of it, needs: up to the last one that a texture uses."""
    parts = list(part.values()) if isinstance(part, dict) else part if isinstance(part, list) else []
    own = 0
    if isinstance(part, dict) and isinstance(part.get("index"), int):  # a textureInfo of glTF, whose transform may name another set
        own = 1 + part.get("extensions", {}).get("KHR_texture_transform", {}).get("texCoord", part.get("texCoord", 0))
    return max([own, *map(_texture_sets, parts)])


def _rescale(node: dict[str, Any], unit: float, origin: NDArray[np.float64]) -> None:
    """Let a node without children scale the positions of its mesh by ``unit``, and move them by ``origin``, before its own transform."""
    from trimesh.transformations import quaternion_matrix

    assert "children" not in node and "matrix" not in node
    scale = np.array(node.get("scale", [1.0] * 3))
    turned = quaternion_matrix(np.roll(node.get("rotation", [0.0, 0.0, 0.0, 1.0]), 1))[:3, :3] @ (scale * origin)
    node |= {"translation": (turned + node.get("translation", [0.0] * 3)).tolist(), "scale": (unit * scale).tolist()}


class _Geometry:
    """The accessors of a glTF with a buffer view for each, and the contents of these views."""

    def __init__(self, tree: dict[str, Any], views: list[bytes]) -> None:
        assert len({accessor["bufferView"] for accessor in tree["accessors"]}) == len(tree["accessors"])
        self._tree, self.views = tree, views

    def _floats(self, number: int) -> NDArray[np.float64]:
        """The values of an accessor of floats, [n, d]."""
        accessor = self._tree["accessors"][number]
        return np.frombuffer(self.views[accessor["bufferView"]], "<f4").reshape(accessor["count"], -1).astype(np.float64)

    def put(self, number: int, component: int, unit: float | None = None, origin: NDArray[np.float64] | float = 0.0) -> None:
        """Store an accessor of floats as integers: multiples of a ``unit`` from an ``origin``, or else fractions of the largest integer."""
        accessor, (kind, largest) = self._tree["accessors"][number], _INTEGERS[component]
        assert accessor["componentType"] == _FLOAT, "it is stored already"
        stored = np.rint((self._floats(number) - origin) / (unit or 1 / largest)).astype(kind)
        accessor |= {"componentType": component, "min": stored.min(0).tolist(), "max": stored.max(0).tolist()}
        accessor |= {} if unit else {"normalized": True}
        size = stored.shape[1] * stored.itemsize
        if free := -size % _ALIGNMENT:
            stored = np.pad(stored, ((0, 0), (0, free // stored.itemsize)))
            self._tree["bufferViews"][accessor["bufferView"]]["byteStride"] = size + free
        self.views[accessor["bufferView"]] = stored.tobytes()

    def put_fractions(self, number: int) -> None:
        """Store texture coordinates with 16 bits if all are in [0, 1]."""
        values = self._floats(number)
        if values.min(initial=0) >= 0 and values.max(initial=0) <= 1:
            self.put(number, _UNSIGNED_SHORT)

    def require(self) -> None:
        """Name the extension that these integers need."""
        for key in ("extensionsUsed", "extensionsRequired"):
            self._tree[key] = sorted({*self._tree.get(key, ()), EXTENSION})

    def quantize_positions(self) -> None:
        """Store positions as integers, and let their nodes scale and move them. Each mesh has one node and one primitive."""
        nodes = [node for node in self._tree["nodes"] if "mesh" in node]
        numbers = [self._tree["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"] for node in nodes]
        points = [self._floats(number) for number in numbers]
        moved = [node.pop("matrix", None) for node in nodes]
        free = np.concatenate([own for own, matrix in zip(points, moved, strict=True) if matrix is None] or [np.zeros((1, 3))])
        center = (free.min(0) + free.max(0)) / 2
        origins = [center if matrix is None else np.zeros(3) for matrix in moved]
        farthest = max(float(np.abs(own - origin).max()) for own, origin in zip(points, origins, strict=True))
        unit = float(f"{farthest / _INTEGERS[_SHORT][1]:.6g}")  # split models have a node for each card, which all name it
        for number, origin in dict(zip(numbers, origins, strict=True)).items():  # nodes with equal positions share an accessor
            self.put(number, _SHORT, unit, origin)
        for node, origin, matrix in zip(nodes, origins, moved, strict=True):
            node |= {"translation": origin.tolist() if matrix is None else matrix[12:15], "scale": [unit] * 3}
