"""A tiny library: trees of two crossed planes, each with three levels of detail, whose GLBs share one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.lod import LodLevel
from bbfit.exporting.vertex_formats import quantized_tree
from bbfit.files import write_bytes, write_json
from bbfit.glb import glb_pieces
from bbfit.images import encode_png
from bbfit.library.manifest import LIBRARY_FILE, Library, LibraryTree, Screen

SCREEN = Screen(1080, 60.0)
COLORS = {"oak": (200, 60, 40), "birch": (40, 170, 60), "fir": (50, 80, 210)}
HEIGHTS = {"oak": 12.0, "birch": 8.0, "fir": 20.0}
SPECIES = {"oak": "black_oak", "birch": "silver_birch", "fir": "douglas_fir"}
DISTANCES = (0.0, 120.0, 400.0)


def small_library(
    folder: Path,
    names: Sequence[str] = ("oak", "birch", "fir"),
    planes: Sequence[int] = (4, 3, 2),
    brightness: Sequence[float] = (1, 1, 1),
    integers: Sequence[str] = (),
) -> Library:
    """Write a library. Each tree is an upright ellipse of one color, 0.4 times as wide as high, on planes that cross in its axis.

    The materials of its levels have a ``brightness``. Vertices of the trees ``integers`` are integers, as web viewers read them.
    """
    (folder / "trees").mkdir(parents=True)
    write_bytes(folder / "atlas.png", encode_png(_atlas(names)))
    trees = []
    for number, name in enumerate(names):
        height = HEIGHTS[name]
        levels = []
        for level, count in enumerate(planes):
            file = f"trees/{name}_LOD{level}.glb"
            data = _glb(height, count, (number / len(names), 1 / len(names)), brightness[level])
            data = quantized_tree(data) if name in integers else data
            write_bytes(folder / file, data)
            distance = DISTANCES[level] * height / 10
            levels.append(_level(f"LOD{level}", count, len(data), distance, file))
        half = 0.2 * height
        trees.append(LibraryTree(name, SPECIES[name], number, (-half, 0.0, -half), (half, height, half), tuple(levels)))
    library = Library(folder, SCREEN, ("atlas.png",), tuple(trees))
    write_json(folder / LIBRARY_FILE, library.document())
    return library


def _level(name: str, planes: int, size: int, distance: float, file: str) -> LodLevel:
    far = distance > 0
    return LodLevel(
        name=name,
        planes=planes,
        vertices=4 * planes,
        triangles=2 * planes,
        bytes=size,
        error_meters=distance / 900,
        error_pixels=1.0 if far else 0.0,
        held_out_error_pixels=1.0 if far else 0.0,
        psnr=30.0,
        tree_pixels=900 / distance if far else None,
        distance_meters=distance,
        screen_coverage=0.0,
        file=file,
        silhouette_distance_meters=distance,
        color_distance_meters=distance,
        color_error=0.01,
        held_out_color_error=0.01,
    )


def _atlas(names: Sequence[str]) -> NDArray[np.uint8]:
    """A filled ellipse for each tree, side by side."""
    y, x = (np.mgrid[:64, :64] + 0.5) / 32 - 1
    inside = x * x + y * y < 1
    pictures = [np.concatenate([np.full((64, 64, 3), COLORS[name]), 255 * inside[..., None]], -1) for name in names]
    return np.concatenate(pictures, 1).astype(np.uint8)


def _glb(height: float, planes: int, part: tuple[float, float], brightness: float) -> bytes:
    """Planes that cross in the vertical axis, unlit, with a part of the atlas: its left edge and its width."""
    half, (left, width) = 0.2 * height, part
    points, uvs, triangles = [], [], []
    for number in range(planes):
        angle = np.pi * number / planes
        right = half * np.array([np.cos(angle), 0, np.sin(angle)])
        up = np.array([0, height, 0])
        points += [-right, right, right + up, up - right]
        uvs += [[left, 1], [left + width, 1], [left + width, 0], [left, 0]]
        triangles += [[4 * number + corner for corner in corners] for corners in ([0, 1, 2], [0, 2, 3])]
    positions, coordinates = np.array(points, "<f4"), np.array(uvs, "<f4")
    contents = [positions.tobytes(), coordinates.tobytes(), np.array(triangles, "<u2").tobytes()]
    views, start = [], 0
    for data, target in zip(contents, (34962, 34962, 34963), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data), "target": target})
        start += len(data)
    accessors: list[dict[str, Any]] = [
        {"min": positions.min(0).tolist(), "max": positions.max(0).tolist(), "componentType": 5126, "type": "VEC3", "count": len(points)},
        {"componentType": 5126, "type": "VEC2", "count": len(points)},
        {"componentType": 5123, "type": "SCALAR", "count": 3 * len(triangles)},
    ]
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [*3 * [brightness], 1], "metallicFactor": 0.0},
        "alphaMode": "MASK",
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [material],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"uri": "../atlas.png"}],
        "bufferViews": views,
        "accessors": [{**accessor, "bufferView": number} for number, accessor in enumerate(accessors)],
        "buffers": [{"byteLength": start}],
    }
    return b"".join(glb_pieces(tree, contents))
