"""What programs that load a glTF trust, and what is checked here: references, counts, the tree of nodes, and numbers.

Names and rules are those of the glTF 2.0 specification. Whatever is wrong raises ``ValueError`` with the reason, to be caught by
:func:`bbfit.inputs.reading`, or ``InputError``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.inputs import InputLimits
from bbfit.tree_files.extent import check_box, check_finite

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_UNSIGNED = (5121, 5123, 5125)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DEEPEST = 200
"""Most nodes on the way from a root to a leaf: Blender's importer calls itself for every one."""
# Indices of a mesh for each of its vertices.
_INDICES = 12


def check_gltf(path: Path, content: dict[str, Any], buffers: Sequence[bytes], limits: InputLimits) -> None:
    """Check the JSON of a glTF against its buffers and the limits."""
    limits.at_most("max_input_nodes", "tree", path, len(entries_of(content, "nodes")), "nodes")
    accessors = [_accessor(entry, content, buffers) for entry in entries_of(content, "accessors")]
    for accessor in accessors:
        if accessor.values is None:  # zeros, for which nothing is stored
            limits.at_most("max_input_vertices", "tree", path, accessor.count, "vertices in an accessor without data")
    positions = dict[int, NDArray[np.float64]]()
    greatest = dict[int, int]()
    meshes, indices = list[_Mesh](), 0
    for entry in entries_of(content, "meshes"):
        mesh = _Mesh(0, np.array([[np.inf] * 3, [-np.inf] * 3]))
        for primitive in entries_of(entry, "primitives"):
            attributes = _attributes(primitive, accessors)
            counts = {accessors[number].count for number in attributes.values()}
            for target in entries_of(primitive, "targets"):
                counts |= {accessors[number].count for number in _attributes({"attributes": target}, accessors).values()}
            if len(counts) > 1:
                raise ValueError("the attributes of a mesh differ in their counts")
            count = counts.pop() if counts else 0
            mesh.vertices += count * (1 + len(entries_of(primitive, "targets")))
            if "indices" in primitive:
                number = _index(primitive["indices"], accessors, "indices")
                indices += accessors[number].count
                if number not in greatest:
                    greatest[number] = _greatest_index(accessors[number])
                if greatest[number] >= count:
                    raise ValueError(f"a face refers to vertex {greatest[number]} of {count}")
            if "POSITION" in attributes:
                number = attributes["POSITION"]
                if number not in positions:
                    positions[number] = _box(path, accessors[number])
                mesh.box = _united([mesh.box, positions[number]])
            if "material" in primitive:
                _index(primitive["material"], entries_of(content, "materials"), "material")
        meshes.append(mesh)
    limits.at_most("max_input_vertices", "tree", path, indices // _INDICES, f"vertices for {_INDICES} indices each")
    _check_transmission(content)
    _check_nodes(path, content, meshes, accessors, limits)


def entries_of(content: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    """The entries of a list of objects, which may be absent."""
    entries = content.get(kind, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"it has a damaged list of {kind}")
    return entries


def slice_of(views: list[dict[str, Any]], number: Any, buffers: Sequence[bytes]) -> memoryview:
    """The bytes of a buffer view, which must be within its buffer."""
    view = views[_index(number, views, "buffer view")]
    data = buffers[_index(view.get("buffer"), buffers, "buffer")]
    start, length = _count(view.get("byteOffset", 0)), _count(view.get("byteLength"), 1)
    if start + length > len(data):
        raise ValueError("a buffer view exceeds its buffer")
    return memoryview(data)[start : start + length]


@dataclass
class _Mesh:
    vertices: int
    box: NDArray[np.float64]
    """Lowest and highest corner, [2, 3]; the lowest is above the highest if there are no vertices."""


@dataclass(frozen=True)
class _Accessor:
    count: int
    kind: str
    component: int
    values: NDArray[Any] | None
    """[count, width]. ``None`` for zeros that are not stored, or packed data."""
    changed: NDArray[Any] | None
    """The values of a sparse accessor in place of some of ``values``."""
    normalized: bool


def _accessor(entry: dict[str, Any], content: dict[str, Any], buffers: Sequence[bytes]) -> _Accessor:
    count, component, kind = _count(entry.get("count"), 1), entry.get("componentType"), entry.get("type")
    if component not in _COMPONENTS or kind not in _WIDTHS:
        raise ValueError("an accessor has an unknown type")
    width = _WIDTHS[kind]
    values = changed = None
    if "bufferView" in entry:
        values = _values(entry["bufferView"], entry.get("byteOffset", 0), count, width, component, content, buffers)
    sparse = entry.get("sparse")
    if sparse is not None:
        some, places, replaced = _count(sparse["count"], 1), sparse["indices"], sparse["values"]
        if places["componentType"] not in _UNSIGNED or some > count:
            raise ValueError("a sparse accessor is damaged")
        where = _values(places["bufferView"], places.get("byteOffset", 0), some, 1, places["componentType"], content, buffers)
        changed = _values(replaced["bufferView"], replaced.get("byteOffset", 0), some, width, component, content, buffers)
        if where is not None and where.max() >= count:
            raise ValueError("a sparse accessor refers to values that it does not have")
    return _Accessor(count, kind, component, values, changed, entry.get("normalized") is True)


def _values(
    view_number: Any, offset: Any, count: int, width: int, component: int, content: dict[str, Any], buffers: Sequence[bytes]
) -> NDArray[Any] | None:
    """The values of an accessor, [count, width], which must be within its buffer view. ``None`` if the view is packed."""
    views = entries_of(content, "bufferViews")
    view = views[_index(view_number, views, "buffer view")]
    if "EXT_meshopt_compression" in view.get("extensions", {}):
        return None
    data, offset = slice_of(views, view_number, buffers), _count(offset)
    dtype = np.dtype(_COMPONENTS[component])
    stride = view.get("byteStride")
    stride = width * dtype.itemsize if stride is None else _count(stride, width * dtype.itemsize)
    if offset + stride * (count - 1) + width * dtype.itemsize > len(data):
        raise ValueError("an accessor exceeds its buffer view")
    return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))


def _index(value: Any, entries: Sequence[Any], what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < len(entries):
        raise ValueError(f"it refers to a {what} that it does not have")
    return value


def _count(value: Any, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 1 << 40:
        raise ValueError("an offset, a stride or a count is damaged")
    return value


def _attributes(entry: dict[str, Any], accessors: list[_Accessor]) -> dict[str, int]:
    attributes = entry.get("attributes", {})
    return {name: _index(number, accessors, "accessor") for name, number in attributes.items()}


def _greatest_index(accessor: _Accessor) -> int:
    """The largest vertex index of a primitive, [0] if it is not stored."""
    if accessor.kind != "SCALAR" or accessor.component not in _UNSIGNED:
        raise ValueError("indices of faces are no whole numbers")
    stored = [int(values.max()) for values in (accessor.values, accessor.changed) if values is not None]
    return max(stored, default=0)


def _box(path: Path, accessor: _Accessor) -> NDArray[np.float64]:
    """The corners of the box around positions, [2, 3]. Those of packed positions are not known; then it is empty."""
    if accessor.kind != "VEC3":
        raise ValueError("positions are no vectors")
    boxes = []
    for values in (accessor.values, accessor.changed):
        if values is not None:
            box = np.stack([values.min(0), values.max(0)]).astype(np.float64)
            check_finite(path, box)
            if accessor.normalized and accessor.component != 5126:
                box = box / np.iinfo(_COMPONENTS[accessor.component]).max
            boxes.append(box)
    return _united(boxes)


def _united(boxes: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    stacked = np.stack([np.array([[np.inf] * 3, [-np.inf] * 3]), *boxes])
    return np.stack([stacked[:, 0].min(0), stacked[:, 1].max(0)])


def _check_transmission(content: dict[str, Any]) -> None:
    """Require that what materials transmit has the types and ranges of KHR_materials_diffuse_transmission; Blender's importer skips it."""
    for material in entries_of(content, "materials"):
        values = (material.get("extensions") or {}).get("KHR_materials_diffuse_transmission", {})
        color = values.get("diffuseTransmissionColorFactor", [1.0, 1.0, 1.0])
        if not isinstance(color, list) or len(color) != 3 or not all(map(_is_share, (*color, values.get("diffuseTransmissionFactor", 0)))):
            raise ValueError("the transmitted light of a material is no share in [0, 1]")
        for name in ("diffuseTransmissionTexture", "diffuseTransmissionColorTexture"):
            if name in values:
                _index(values[name]["index"], entries_of(content, "textures"), "texture")


def _is_share(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1


def _check_nodes(path: Path, content: dict[str, Any], meshes: list[_Mesh], accessors: list[_Accessor], limits: InputLimits) -> None:
    """Require that the nodes are trees of limited depth, and that what they place is near the origin."""
    nodes = entries_of(content, "nodes")
    parents = np.full(len(nodes), -1)
    vertices = 0
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents[_index(child, nodes, "node")] >= 0:
                raise ValueError(f"node {child} has two parents")
            parents[child] = number
        if "mesh" in node:
            copies = 1
            instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
            if instancing is not None:
                copies = max([accessors[index].count for index in _attributes(instancing, accessors).values()], default=1)
            vertices += copies * meshes[_index(node["mesh"], meshes, "mesh")].vertices
        if "skin" in node:
            _index(node["skin"], entries_of(content, "skins"), "skin")
    limits.at_most("max_input_vertices", "tree", path, max(vertices, sum(mesh.vertices for mesh in meshes)), "vertices")
    for skin in entries_of(content, "skins"):
        for joint in skin.get("joints", []):
            _index(joint, nodes, "node")
    scenes = entries_of(content, "scenes")
    for scene in scenes:
        for root in scene.get("nodes", []):
            _index(root, nodes, "node")
    if "scene" in content:
        _index(content["scene"], scenes, "scene")
    world = _world(parents, _transforms(nodes))
    if not np.isfinite(world).all():
        raise ValueError("the transform of a node is NaN or infinite")
    boxes = [np.zeros((0, 2, 3))]
    for number, node in enumerate(nodes):
        if "mesh" in node and "skin" not in node and np.isfinite(box := meshes[node["mesh"]].box).all():
            matrix, middle, half = world[number], box.mean(0), np.diff(box, axis=0)[0] / 2
            middle, half = matrix[:3, :3] @ middle + matrix[:3, 3], np.abs(matrix[:3, :3]) @ half
            boxes.append(np.stack([middle - half, middle + half])[None])
    placed = np.concatenate(boxes)
    if len(placed):
        check_box(path, placed[:, 0].min(0), placed[:, 1].max(0))


def _transforms(nodes: list[dict[str, Any]]) -> NDArray[np.float64]:
    """The matrices of nodes relative to their parents, [N, 4, 4]."""
    result = np.tile(np.eye(4), (len(nodes), 1, 1))
    for number, node in enumerate(nodes):
        if "matrix" in node:
            result[number] = _numbers(node["matrix"], 16).reshape(4, 4).T
        elif node.keys() & {"translation", "rotation", "scale"}:
            x, y, z, w = _numbers(node.get("rotation", (0, 0, 0, 1)), 4)
            norm = x * x + y * y + z * z + w * w
            twice = 2 / norm if norm else 0.0
            rotation = np.eye(3) + twice * np.array(
                [[-y * y - z * z, x * y - z * w, x * z + y * w], [x * y + z * w, -x * x - z * z, y * z - x * w],
                 [x * z - y * w, y * z + x * w, -x * x - y * y]]
            )  # fmt: skip
            result[number, :3, :3] = rotation * _numbers(node.get("scale", (1, 1, 1)), 3)
            result[number, :3, 3] = _numbers(node.get("translation", (0, 0, 0)), 3)
    return result


def _numbers(values: Any, count: int) -> NDArray[np.float64]:
    if not isinstance(values, list | tuple) or len(values) != count or not all(isinstance(value, int | float) for value in values):
        raise ValueError("the transform of a node is no list of numbers")
    return np.array(values, np.float64)


def _world(parents: NDArray[np.int64], local: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrices of nodes relative to the world, [N, 4, 4]."""
    world, done = local.copy(), parents < 0
    for _ in range(_DEEPEST):
        following = ~done & done[parents]
        if not following.any():
            break
        world[following] = world[parents[following]] @ local[following]
        done |= following
    if not done.all():
        raise ValueError(f"its nodes are nested more than {_DEEPEST} deep, or in a circle")
    return world
