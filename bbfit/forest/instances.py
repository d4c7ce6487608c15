"""glTF files with instances of trees: EXT_mesh_gpu_instancing.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Vendor/EXT_mesh_gpu_instancing
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.forest.placements import quaternions
from bbfit.forest.prototypes import Part, Prototype, quaternion_product, rotated
from bbfit.glb import glb_pieces
from bbfit.model_files import generator

INSTANCING = "EXT_mesh_gpu_instancing"
_FLOAT = 5126
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MIME = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".ktx2": "image/ktx2", ".webp": "image/webp"}


@dataclass(frozen=True)
class Instances:
    """P instances of one tree in a file."""

    positions: NDArray[np.float64]
    """Meters in the file's frame, Y up, [P, 3]."""
    turns: NDArray[np.float32]
    """Degrees counterclockwise seen from above, [P]."""
    scales: NDArray[np.float64]
    """Factors of its width, height and depth, [P, 3]; width and depth are equal."""
    features: NDArray[np.float32] | None = None
    """Numbers of its instances in the file's table of properties, [P], or ``None``."""


class InstancedGltf:
    """A glTF with instances that is being made."""

    def __init__(self, matrix: NDArray[np.float64] | None = None) -> None:
        """Begin a file whose frame has a place in the scene by a matrix [4, 4], or none."""
        root: dict[str, Any] = {"name": "forest", "children": []}
        if matrix is not None and not np.array_equal(matrix, np.eye(4)):
            root["matrix"] = matrix.T.ravel().tolist()
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": generator()},
            "extensionsUsed": [INSTANCING],
            "extensionsRequired": [INSTANCING],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [root],
        }
        self._contents, self._size = list[bytes](), 0
        self._external = list[dict[str, Any]]()
        self._known = dict[tuple[str, str], int]()

    def add(self, prototype: Prototype, instances: Instances, uris: Mapping[Path | str, str] | None = None) -> None:
        """Add instances of a tree.

        ``uris`` has the addresses of its images by their files, and that of its buffer by its name. Without, all is in the file.
        """
        meshes = self._meshes(prototype, uris)
        attributes = dict[bytes, dict[str, int]]()
        features = {} if instances.features is None else {"_FEATURE_ID_0": self.accessor(instances.features[:, None])}
        for part in prototype.parts:
            key = b"".join(values.tobytes() for values in (part.translation, part.rotation, part.scale))
            if key not in attributes:
                placed = placed_part(part, instances)
                attributes[key] = {name: self.accessor(values.astype(np.float32)) for name, values in placed.items()} | features
            extensions: dict[str, Any] = {INSTANCING: {"attributes": attributes[key]}}
            if features:
                identifiers = {"featureIds": [{"featureCount": len(instances.positions), "attribute": 0, "propertyTable": 0}]}
                extensions["EXT_instance_features"] = identifiers
                self.use("EXT_instance_features")
            self.tree["nodes"][0]["children"].append(len(self.tree["nodes"]))
            node = {"name": f"tree_{prototype.name}_{len(self.tree['nodes'])}", "mesh": meshes[part.mesh], "extensions": extensions}
            self.tree["nodes"].append(node)

    def accessor(self, values: NDArray[np.float32]) -> int:
        """Add numbers, [P, C], and return the index of their accessor."""
        view = self.view(np.ascontiguousarray(values, "<f4").tobytes())
        kind = _TYPES[values.shape[1]]
        return self._append("accessors", {"bufferView": view, "componentType": _FLOAT, "count": len(values), "type": kind})

    def view(self, data: bytes) -> int:
        """Add bytes to the file's buffer, and return the index of their buffer view."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        padded = data + bytes(-len(data) % 8)  # numbers of 8 bytes in tables of properties are aligned too
        self._contents.append(padded)
        self._size += len(padded)
        return self._append("bufferViews", view)

    def use(self, extension: str) -> None:
        """Name an extension that the file uses."""
        if extension not in self.tree["extensionsUsed"]:
            self.tree["extensionsUsed"].append(extension)

    def pieces(self) -> list[bytes]:
        """The pieces of the GLB. Raises InputError if it would be larger than 4 GiB."""
        if self._size >= 1 << 32:
            fail("glb", f"the forest needs a GLB of {self._size:,} bytes, more than 4 GiB", "choose the format tiles, or fewer trees")
        buffers = [{"byteLength": self._size}] if self._size else []
        assert buffers or not self._external
        tree = self.tree | {"buffers": [*buffers, *self._external]}
        return glb_pieces(tree, self._contents)

    def _meshes(self, prototype: Prototype, uris: Mapping[Path | str, str] | None) -> dict[int, int]:
        """Add the meshes of a tree, unless they were, and return their indices."""
        document, wanted = prototype.document, sorted({part.mesh for part in prototype.parts})
        key = ("prototype", prototype.name)
        if key in self._known:
            first = self._known[key]
            return {mesh: first + number for number, mesh in enumerate(wanted)}
        views = self._views(prototype, uris)
        images = [self._image(prototype, number, views, uris) for number in range(len(document.get("images", [])))]
        samplers = [self._shared("samplers", sampler) for sampler in document.get("samplers", [])]
        moved = [_moved(texture, {"sampler": samplers, "source": images}) for texture in document.get("textures", [])]
        textures = [self._shared("textures", texture) for texture in moved]
        materials = [self._shared("materials", _with_textures(material, textures)) for material in document.get("materials", [])]
        accessors = dict[int, int]()

        def accessor(index: int) -> int:
            if index not in accessors:
                item = document["accessors"][index]
                accessors[index] = self._append("accessors", item | {"bufferView": views[item["bufferView"]]})
            return accessors[index]

        first = len(self.tree.get("meshes", []))
        for index in wanted:
            mesh = document["meshes"][index]
            primitives = list[dict[str, Any]]()
            for primitive in mesh["primitives"]:
                changed = primitive | {"attributes": {name: accessor(number) for name, number in primitive["attributes"].items()}}
                changed |= {"indices": accessor(primitive["indices"])} if "indices" in primitive else {}
                primitives.append(changed | ({"material": materials[primitive["material"]]} if "material" in primitive else {}))
            self._append("meshes", {"name": f"tree_{prototype.name}_{index}", "primitives": primitives})
        for kind in ("extensionsUsed", "extensionsRequired"):
            self.tree[kind] = sorted({*self.tree[kind], *document.get(kind, ())})
        self._known[key] = first
        return {mesh: first + number for number, mesh in enumerate(wanted)}

    def _views(self, prototype: Prototype, uris: Mapping[Path | str, str] | None) -> Sequence[int]:
        views = prototype.document["bufferViews"]
        if uris is None:
            sliced = [prototype.binary[(start := view.get("byteOffset", 0)) : start + view["byteLength"]] for view in views]
            numbers = [self.view(data) for data in sliced]
            for view, number in zip(views, numbers, strict=True):
                self.tree["bufferViews"][number] |= {key: view[key] for key in ("byteStride", "target") if key in view}
            return numbers
        self._external.append({"uri": uris[prototype.name], "byteLength": prototype.size})
        return [self._append("bufferViews", view | {"buffer": len(self._external)}) for view in views]

    def _image(self, prototype: Prototype, number: int, views: Sequence[int], uris: Mapping[Path | str, str] | None) -> int:
        image, file = prototype.document["images"][number], prototype.images[number]
        if file is None:
            return self._append("images", image | {"bufferView": views[image["bufferView"]]})
        if uris is not None:
            return self._shared("images", image | {"uri": uris[file]})
        key = ("image", str(file.resolve()))
        if key not in self._known:
            inside = {name: value for name, value in image.items() if name != "uri"} | {"mimeType": _MIME[file.suffix.lower()]}
            self._known[key] = self._append("images", inside | {"bufferView": self.view(file.read_bytes())})
        return self._known[key]

    def _shared(self, kind: str, item: dict[str, Any]) -> int:
        """Add an item unless there is an equal one, and return its index."""
        key = (kind, json.dumps(item, sort_keys=True))
        if key not in self._known:
            self._known[key] = self._append(kind, item)
        return self._known[key]

    def _append(self, kind: str, item: dict[str, Any]) -> int:
        items: list[dict[str, Any]] = self.tree.setdefault(kind, [])
        items.append(item)
        return len(items) - 1


def placed_part(part: Part, instances: Instances) -> dict[str, NDArray[np.float64]]:
    """The attributes of the extension for a mesh of a tree: TRANSLATION [P, 3], ROTATION [P, 4] and SCALE [P, 3].

    A mesh that is turned within its tree is widened by its tree's height, because widening would shear it.
    """
    turns = quaternions(instances.turns)
    turned = not np.allclose(np.abs(part.rotation), [0, 0, 0, 1])
    sizes = np.broadcast_to(instances.scales[:, 1:2], instances.scales.shape) if turned else instances.scales
    return {
        "TRANSLATION": instances.positions + rotated(turns, sizes * part.translation),
        "ROTATION": quaternion_product(turns, np.broadcast_to(part.rotation, turns.shape)),
        "SCALE": sizes * part.scale,
    }


def _moved(item: dict[str, Any], indices: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """A texture with new indices of its sampler and its images, also those in its extensions."""
    moved = {key: indices[key][value] if key in indices else value for key, value in item.items()}
    if "extensions" in item:
        moved["extensions"] = {name: _moved(entry, indices) for name, entry in item["extensions"].items()}
    return moved


def _with_textures(item: dict[str, Any], textures: Sequence[int]) -> dict[str, Any]:
    """A material with new indices of its textures, which are in all entries with the key ``index``."""
    inner = {key: _with_textures(value, textures) for key, value in item.items() if isinstance(value, dict)}
    return item | inner | ({"index": textures[item["index"]]} if "index" in item else {})
