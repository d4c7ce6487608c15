"""What the materials of a glTF say that trimesh and Blender's exporter leave out, for models that are made from it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from typing import Any
from urllib.parse import unquote

from bbfit.glb import gltf_parts, joined_glb, split_glb
from bbfit.inputs import reading
from bbfit.tree_files.gltf import decoded_uri
from bbfit.tree_files.gltf_checks import entries_of, slice_of
from bbfit.tree_files.tree_file import GLTF_SUFFIXES, TreeFile

TRANSMISSION = "KHR_materials_diffuse_transmission"
_TEXTURES = {"diffuseTransmissionTexture", "diffuseTransmissionColorTexture"}
_TRANSFORM = "KHR_texture_transform"
_PNG = b"\x89PNG"


def with_transmission(glb: bytes, tree: TreeFile, *, colors: Collection[str] = (), textures: bool = True) -> bytes:
    """The GLB of a model of a tree with the diffuse transmission of the tree's materials, which go by their names.

    Materials named in ``colors`` also get the tree's exact factors of base color, which trimesh rounds to 8 bits. Without ``textures``, for
    a model without texture coordinates, the transmission has its factors alone, as where a texture has neither PNG nor JPEG. A tree that is
    no .glb or .gltf has no such material.
    """
    if tree.suffix not in GLTF_SUFFIXES:
        return glb
    content, picture = _read(tree)
    known = {material["name"]: material for material in entries_of(content, "materials") if "name" in material}
    target, contents = split_glb(glb)
    extensions = set(target.get("extensionsUsed", ()))
    for material in target.get("materials", ()):
        source = known.get(material.get("name"), {})
        factor = (source.get("pbrMetallicRoughness") or {}).get("baseColorFactor")
        if factor is not None and material["name"] in colors:
            material.setdefault("pbrMetallicRoughness", {})["baseColorFactor"] = factor
        values = copy.deepcopy((source.get("extensions") or {}).get(TRANSMISSION))
        if values is None:
            continue
        for name in sorted(_TEXTURES & values.keys()):
            with reading("tree", tree.path, "export the tree again"):
                texture = content["textures"][values[name]["index"]]
            if not textures or "source" not in texture:
                del values[name]
                continue
            values[name]["index"] = _added(target, contents, content, texture, picture)
            extensions |= {_TRANSFORM} & (values[name].get("extensions") or {}).keys()
        material["extensions"] = (material.get("extensions") or {}) | {TRANSMISSION: values}
        extensions.add(TRANSMISSION)
    if extensions:
        target["extensionsUsed"] = sorted(extensions)
    return joined_glb(target, contents)


def transmits(tree: TreeFile) -> bool:
    """Whether a material of a tree transmits light diffusely (``KHR_materials_diffuse_transmission``)."""
    if tree.suffix not in GLTF_SUFFIXES:
        return False
    return any(TRANSMISSION in (material.get("extensions") or {}) for material in entries_of(_read(tree)[0], "materials"))


def pictures_size(tree: TreeFile) -> int:
    """Bytes of the pictures of a tree, in a file and beside it, as they are stored; each counts once."""
    if tree.suffix not in GLTF_SUFFIXES:
        return sum(file.stat().st_size for file in tree.files[1:] if file.suffix.lower() != ".mtl")
    content, picture = _read(tree)
    return sum(map(len, {picture(number) for number in range(len(entries_of(content, "images")))}))


def _read(tree: TreeFile) -> tuple[dict[str, Any], Callable[[int], bytes]]:
    """The JSON of a glTF, and the function that returns the contents of one of its pictures."""
    content, binary = gltf_parts(tree.path.read_bytes(), "tree", tree.path)
    files = {file.resolve(): file for file in tree.files}

    def stored(uri: str) -> bytes:
        if uri.startswith("data:"):
            return decoded_uri(uri)
        return files[(tree.path.parent / unquote(uri).replace("\\", "/")).resolve()].read_bytes()

    def picture(number: int) -> bytes:
        with reading("tree", tree.path, "export the tree again"):
            entry = entries_of(content, "images")[number]
            if "uri" in entry:
                return stored(entry["uri"])
            buffers = [stored(buffer["uri"]) if "uri" in buffer else binary for buffer in entries_of(content, "buffers")]
            return bytes(slice_of(entries_of(content, "bufferViews"), entry["bufferView"], buffers))

    return content, picture


def _added(
    target: dict[str, Any], contents: list[bytes], source: dict[str, Any], texture: dict[str, Any], picture: Callable[[int], bytes]
) -> int:
    """Add a texture of another glTF with its picture and its sampler, and return its number."""
    data = picture(texture["source"])
    added: dict[str, Any] = {"source": len(target.setdefault("images", []))}
    target["images"].append({"bufferView": len(contents), "mimeType": "image/png" if data.startswith(_PNG) else "image/jpeg"})
    target["bufferViews"].append({})
    contents.append(data)
    if "sampler" in texture:
        added["sampler"] = len(target.setdefault("samplers", []))
        target["samplers"].append(source["samplers"][texture["sampler"]])
    target.setdefault("textures", []).append(added)
    return len(target["textures"]) - 1
