"""The files of an octahedral impostor: a GLB of one quad with the atlas, and the program for three.js that draws it."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np
import torch

from bbfit.glb import joined_glb
from bbfit.images import encode_png
from bbfit.model_files import generator
from bbfit.rivals.octahedral import CUTOFF, OctahedralImpostor

THREE_PROGRAM = "impostor_three.js"
"""The name of the program for three.js."""
# Numbers that glTF 2.0 borrows from OpenGL (specification, sections 5.11 and 5.26).
_FLOAT, _UNSIGNED_SHORT, _ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 5126, 5123, 34962, 34963
_TRILINEAR, _LINEAR, _CLAMPED = 9987, 9729, 33071


def three_program() -> bytes:
    """The program for three.js, a module that exports ``loadImpostor``."""
    return (files("bbfit.rivals") / "programs" / THREE_PROGRAM).read_bytes()


def impostor_glb(impostor: OctahedralImpostor) -> bytes:
    """An impostor as binary glTF 2.0: one quad of 4 vertices, the atlas of colors, and, with parallax, that of heights, both as PNG.

    The mesh's ``extras`` describe the grid for a shader: ``frames``, ``hemisphere``, ``center`` and ``radius`` in meters, ``parallax``,
    ``per_pixel`` and ``levels`` as in :class:`~bbfit.rivals.octahedral.OctahedralImpostor`, and ``heights``, the index of that texture or
    null. A program without the shader shows the frame that is nearest to the front, which is +Z, on the quad, unlit.
    """
    side, frames, heights = impostor.radius, impostor.grid.frames, impostor.parallax > 0
    square = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    points = (impostor.center.numpy() + side * np.pad(square, ((0, 0), (0, 1)))).astype("<f4")
    nearest, weights = impostor.grid.nearest(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    row, column = divmod(int(nearest[weights.argmax()]), frames)
    uvs = (([column, row] + (square * [1, -1] + 1) / 2) / frames).astype("<f4")
    pictures = {"colors": impostor.colors.numpy()} | ({"heights": impostor.heights[..., None].expand(-1, -1, 3).numpy()} if heights else {})
    contents = [points.tobytes(), uvs.tobytes(), np.array([0, 3, 1, 1, 3, 2], "<u2").tobytes(), *map(encode_png, pictures.values())]
    extras = {
        "frames": frames,
        "hemisphere": impostor.grid.hemisphere,
        "center": impostor.center.tolist(),
        "radius": side,
        "parallax": impostor.parallax,
        "per_pixel": impostor.per_pixel,
        "levels": impostor.levels,
        "heights": 1 if heights else None,
    }
    material: dict[str, Any] = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0},
        "extensions": {"KHR_materials_unlit": {}},
        **({"alphaMode": "MASK", "alphaCutoff": CUTOFF} if impostor.alpha == "mask" else {"alphaMode": "BLEND"}),
    }
    tree = {
        "asset": {"version": "2.0", "generator": generator()},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "impostor", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}], "extras": extras}],
        "materials": [material],
        "textures": [{"name": name, "sampler": 0, "source": number} for number, name in enumerate(pictures)],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _TRILINEAR, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
        "images": [{"name": name, "bufferView": 3 + number, "mimeType": "image/png"} for number, name in enumerate(pictures)],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": 4, "type": "VEC3"}
            | {"min": points.min(0).tolist(), "max": points.max(0).tolist()},
            {"bufferView": 1, "componentType": _FLOAT, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": _UNSIGNED_SHORT, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [*({"target": _ARRAY_BUFFER} for _ in range(2)), {"target": _ELEMENT_ARRAY_BUFFER}, *({} for _ in pictures)],
    }
    return joined_glb(tree, contents)
