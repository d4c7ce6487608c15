"""A small glTF viewer for tests: it knows the glTF 2.0 specification and nothing of bbfit but its cameras.

Pixels' rays meet triangles in float64; front faces wind counter-clockwise, texture coordinates start at the picture's top-left corner,
sampling is bilinear on straight alpha and clamped to the edge, materials are unlit.
"""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gltf_arrays import array, matrix
from numpy.typing import NDArray
from PIL import Image

from bbfit.geometry.camera import Camera


@dataclass
class Primitive:
    """One drawn list of triangles."""

    positions: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    uvs: NDArray[np.float64]
    triangles: NDArray[np.int64]
    material: dict[str, Any]


def read_glb(path: Path) -> tuple[dict[str, Any], list[Primitive], NDArray[np.uint8]]:
    """The JSON tree, the primitives of all meshes and the only texture, uint8 [H, W, 4]."""
    data = path.read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    tree = json.loads(data[20 : 20 + json_length])
    binary = data[20 + json_length + 8 :]

    def blob(view: dict[str, Any]) -> bytes:
        start = view.get("byteOffset", 0)
        return binary[start : start + view["byteLength"]]

    contents, primitives = [blob(view) for view in tree["bufferViews"]], []
    for node in tree["nodes"]:
        placed = matrix(node)
        for primitive in tree["meshes"][node["mesh"]]["primitives"]:
            attributes = {name: array(tree, contents, index) for name, index in primitive["attributes"].items()}
            points = attributes["POSITION"] @ placed[:3, :3].T + placed[:3, 3]
            triangles = array(tree, contents, primitive["indices"]).astype(np.int64).reshape(-1, 3)
            material = tree["materials"][primitive["material"]]
            primitives.append(Primitive(points, attributes.get("NORMAL"), attributes["TEXCOORD_0"], triangles, material))
    (image,) = tree["images"]
    return tree, primitives, np.array(Image.open(io.BytesIO(blob(tree["bufferViews"][image["bufferView"]]))).convert("RGBA"))


def view_glb(path: Path, camera: Camera) -> NDArray[np.float64]:
    """Premultiplied RGBA of a single pinhole camera, [H, W, 4]; each pixel blends its faces from back to front."""
    _, primitives, texture = read_glb(path)
    pose, k = camera.world_to_camera.double().numpy(), camera.intrinsics.double().numpy()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones(x.shape)], -1) @ pose[:3, :3]
    layers, depths = [], []
    for primitive in primitives:
        taken, before = np.zeros(x.shape, bool), np.zeros(4)
        for triangle in primitive.triangles:
            a, b, c = primitive.positions[triangle]
            normal = np.cross(b - a, c - a)
            plane = np.append(normal, normal @ a) / np.linalg.norm(normal)
            if not np.allclose(plane, before, atol=1e-4):
                taken[:] = False
            before = plane
            if not primitive.material.get("doubleSided", False) and normal @ (eye - a) <= 0:
                continue
            depth = (a - eye) @ normal / (rays @ normal)
            hit = eye + rays * depth[..., None]
            weights = np.stack([np.cross(c - b, hit - b) @ normal, np.cross(a - c, hit - c) @ normal], -1) / (normal @ normal)
            weights = np.concatenate([weights, 1 - weights.sum(-1, keepdims=True)], -1)
            inside = (weights >= -1e-12).all(-1) & (depth > 0) & ~taken  # an edge inside a plane belongs to one triangle only
            taken |= inside
            layers.append(_shade(texture, weights @ primitive.uvs[triangle], primitive.material) * inside[..., None])
            depths.append(np.where(inside, depth, np.inf))
    image = np.zeros((*x.shape, 4))
    order = np.argsort(np.stack(depths), 0, kind="stable")
    for layer in np.take_along_axis(np.stack(layers), order[..., None], 0)[::-1]:
        image = layer + image * (1 - layer[..., 3:])
    return image


def _shade(texture: NDArray[np.uint8], uvs: NDArray[np.float64], material: dict[str, Any]) -> NDArray[np.float64]:
    height, width = texture.shape[:2]
    x, y = uvs[..., 0] * width - 0.5, uvs[..., 1] * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    straight = np.zeros((*x.shape, 4))
    for column, row in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        weight = (1 - abs(x - column)) * (1 - abs(y - row))
        straight += weight[..., None] * texture[row.clip(0, height - 1), column.clip(0, width - 1)] / 255.0
    alpha = straight[..., 3:]
    if material["alphaMode"] == "MASK":
        alpha = (alpha >= material["alphaCutoff"]).astype(np.float64)
    return np.concatenate([straight[..., :3] * alpha, alpha], -1)
