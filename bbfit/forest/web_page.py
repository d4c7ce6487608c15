"""A web page that shows a forest with three.js. It needs neither a server nor a network."""

from __future__ import annotations

import base64
import html
import json
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np

from bbfit.checks import Range, check_fields, fail
from bbfit.files import write_bytes, write_pieces
from bbfit.forest.ground_map import CELLS, GroundMap
from bbfit.forest.placements import Placements
from bbfit.forest.tiles import ForestTile, leaves
from bbfit.glb import gltf_parts
from bbfit.inputs import InputLimits, reading
from bbfit.library.manifest import Library, LibraryTree
from bbfit.model_files import generator
from bbfit.outputs import output_folder
from bbfit.reporting.threejs import drawing_script, library_page

PAGE = "page"
"""The folder of the page in the folder of a forest; ``index.html`` is the page."""
PAGE_FILES = tuple(f"{PAGE}/{place}" for place in ("*", "data/*.js", "data/models/*.js", "data/pictures/*.js", "data/tiles/*.js"))
"""Patterns of all files that :func:`write_page` writes, relative to the folder of the forest."""
_SCRIPTS = ("packs.js", "models.js", "tiles.js", "ground.js", "walker.js", "forest.js")
# The page draws at most about so many trees around the camera, unless its user moves the slider.
_NEAR_TREES = 60_000
_DISTANCES = (200, 300, 400, 500, 700, 1000, 1500, 2000, 3000, 4000, 6000, 8000)
_HINT = "build the library again"
# The modules that lod_field_three.js imports, with the names that it takes from the global of the frame's page.
_MODULES = {
    "three": "Box3, BufferAttribute, DynamicDrawUsage, Frustum, Group, InstancedBufferAttribute, InstancedMesh, MathUtils, Matrix4, "
    "Sphere, Vector3",
    "three/addons/loaders/GLTFLoader.js": "GLTFLoader",
}

Read = Callable[[str], Placements]
"""Reads the placements of a leaf by its name."""


@dataclass(frozen=True)
class PageConfig:
    """Options of the web page."""

    title: str = "Forest"
    """Its title."""
    draw_distance: Annotated[float, Range(0, open_low=True)] | None = None
    """How far trees are drawn at first, in meters along the ground.

    By default so far that about 60,000 trees at most are drawn."""
    level_bytes: Annotated[int, Range(1)] = 32 << 20
    """The largest file of a level of detail that the page loads. Finer levels are left out."""


def write_page(
    folder: Path,
    library: Library,
    root: ForestTile,
    read: Read,
    config: PageConfig | None = None,
    limits: InputLimits | None = None,
) -> Path:
    """Write the page of a forest to ``folder/page``, and return its ``index.html``, which opens by a double click.

    The page loads a tile's placements when the camera comes near, and a tree's levels of detail when a copy needs them. ``root`` is the
    quadtree of the placements, and ``read`` gives the placements of a leaf; one leaf at a time is in memory.

    Raises InputError if a file of the library cannot be used, or if the disk is full.
    """
    config = config or PageConfig()
    check_fields(config)
    page = output_folder("out", folder / PAGE)
    for part in ("models", "pictures", "tiles"):
        for earlier in output_folder("out", page / "data" / part).glob("*.js"):
            earlier.unlink()
    margin = max(50.0, 0.05 * max(root.high[0] - root.low[0], root.high[2] - root.low[2]))
    low, high = (root.low[0] - margin, root.low[2] - margin), (root.high[0] + margin, root.high[2] + margin)
    ground = GroundMap(low, high, np.array([_crown_area(tree) for tree in library.trees]))
    tiles = list(leaves(root))
    for tile in tiles:
        placements = read(tile.name)
        ground.add(placements)
        _write_pack(page, f"tiles/{tile.name.replace('/', '-')}", tile_bytes(placements, tile.low))
    heights = ground.heights()
    _write_pack(page, "ground", ground.cover().tobytes() + (b"" if heights is None else heights.astype("<f4").tobytes()))
    packed = dict[Path, str]()
    distance = config.draw_distance or near_distance(tiles)
    data = {
        "screen": {"height": library.screen.height, "fov": library.screen.fov_degrees},
        "trees": [_tree(index, library, page, packed, config, limits or InputLimits()) for index in range(len(library.trees))],
        "tiles": [{"name": tile.name, "low": tile.low, "high": tile.high, "count": tile.count} for tile in tiles],
        "ground": {"low": low, "high": high, "cells": CELLS},
        "drawDistance": distance,
        "pose": _first_pose(tiles, max(tree.height for tree in library.trees), distance, heights is not None),
    }
    write_bytes(page / "data" / "forest.js", f"window.forestData = {json.dumps(data, allow_nan=False)};\n".encode())
    own = files("bbfit.forest") / "page"
    for name in ("forest.css", *_SCRIPTS):
        write_bytes(page / name, (own / name).read_bytes())
    write_bytes(page / "drawing.js", drawing_script().encode())
    counts = f"{_number(root.count, 'tree')} of {_number(len(library.trees), 'kind')}"
    texts = {"generator": generator(), "title": config.title, "counts": counts, "library": _library_frame()}
    filled = Template((own / "index.html").read_text(encoding="utf-8"))
    write_bytes(page / "index.html", filled.substitute({name: html.escape(text) for name, text in texts.items()}).encode())
    return page / "index.html"


def _number(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def tile_bytes(placements: Placements, corner: tuple[float, float, float]) -> bytes:
    """Placements as the page reads them, with positions from the tile's low corner; ``page/tiles.js`` describes the bytes.

    The page has single precision. From the corner of a tile of a kilometer that is a tenth of a millimeter.
    """
    count = len(placements)
    trees = np.zeros(count + count % 2, "<u2")
    trees[:count] = placements.trees
    rows = [*(placements.positions - corner).T, placements.turns, placements.scales]
    return struct.pack("<I", count) + trees.tobytes() + np.stack(rows).astype("<f4").tobytes()


def near_distance(tiles: Sequence[ForestTile], trees: int = _NEAR_TREES) -> float:
    """The largest of some draw distances in meters within which about ``trees`` trees at most stand around any place in the forest."""
    middles = np.array([[(tile.low[axis] + tile.high[axis]) / 2 for axis in (0, 2)] for tile in tiles])
    counts = np.array([tile.count for tile in tiles])
    areas = np.array([max(1.0, (tile.high[0] - tile.low[0]) * (tile.high[2] - tile.low[2])) for tile in tiles])
    densest = np.argsort(-counts / areas)[:64]
    away = np.linalg.norm(middles[densest, None] - middles, axis=-1)
    # Of the leaf in the middle, only what its own density gives within the distance.
    own = counts[densest, None] * np.minimum(1.0, np.pi * np.square(_DISTANCES) / areas[densest, None])
    around = np.stack([np.where(away <= distance, counts, 0).sum(-1) - counts[densest] for distance in _DISTANCES], -1)
    fitting = [distance for distance, most in zip(_DISTANCES, (own + around).max(0), strict=True) if most <= trees]
    return float(fitting[-1] if fitting else _DISTANCES[0])


def _first_pose(tiles: Sequence[ForestTile], height: float, distance: float, relief: bool) -> tuple[float, ...]:
    """The first pose of the camera: south of the leaf nearest to the forest's middle, above its trees, looking north.

    It is x, y, z, yaw and pitch, in meters and degrees. ``height`` is that of the tallest tree.
    """
    middles = np.array([[(low + high) / 2 for low, high in zip(tile.low, tile.high, strict=True)] for tile in tiles])
    counts = np.array([tile.count for tile in tiles])
    center = np.average(middles, axis=0, weights=counts)
    tile = tiles[int(np.linalg.norm(middles - center, axis=-1).argmin())]
    back = min(8 * height, distance / 3)
    x, _, z = ((low + high) / 2 for low, high in zip(tile.low, tile.high, strict=True))
    y = (tile.high[1] if relief else height) + 0.25 * back
    return (round(x, 2), round(y, 2), round(z + back, 2), 0.0, -math.degrees(math.atan2(0.25 * back + height / 2, back)))


def _crown_area(tree: LibraryTree) -> float:
    """The area of a tree's crown seen from above, as that of an ellipse."""
    return math.pi / 4 * (tree.high[0] - tree.low[0]) * (tree.high[2] - tree.low[2])


def _tree(index: int, library: Library, page: Path, packed: dict[Path, str], config: PageConfig, limits: InputLimits) -> dict[str, Any]:
    """What the page knows of a tree; writes its levels, and the pictures that are not ``packed`` yet."""
    tree, levels = library.trees[index], []
    for number, level in enumerate(tree.levels):
        path = library.folder / level.file
        with reading("library", path, _HINT):
            glb = path.read_bytes()
        if not page_loads(tree, number, len(glb), config):
            continue
        pack = f"models/{index}-{number}"
        _write_pack(page, pack, glb)
        pictures = dict[str, str]()
        for uri, picture in _pictures(path, glb, library, limits).items():
            if picture not in packed:
                packed[picture] = f"pictures/{len(packed)}"
                with reading("library", picture, _HINT):
                    content = picture.read_bytes()
                _write_pack(page, packed[picture], content)
            pictures[uri] = packed[picture]
        levels.append({"pack": pack, "pictures": pictures, "distance": level.distance_meters})
    return {"name": tree.name, "low": tree.low, "high": tree.high, "levels": levels}


def page_loads(tree: LibraryTree, level: int, size: int, config: PageConfig | None = None) -> bool:
    """Whether the page loads a level of a tree, whose file has ``size`` bytes: it leaves out large ones, but not the coarsest."""
    return size <= (config or PageConfig()).level_bytes or level == len(tree.levels) - 1


def check_page_textures(document: Mapping[str, Any], name: str) -> None:
    """Require that the page reads the textures of the tree ``name``, whose glTF is ``document``. Raises InputError."""
    if any(_source(texture) is None for texture in document.get("textures", [])):
        fail("page", f"the tree {name} of the library has KTX2 textures alone, which the page does not read", "build it with PNG textures")


def _source(texture: Mapping[str, Any]) -> int | None:
    """The picture of a texture that the page reads: PNG, JPEG or WebP."""
    source: int | None = texture.get("source", texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source"))
    return source


def _pictures(path: Path, glb: bytes, library: Library, limits: InputLimits) -> dict[str, Path]:
    """The pictures beside a GLB that its textures show, by their addresses in the GLB."""
    content, _ = gltf_parts(glb, "library", path)
    check_page_textures(content, path.stem)
    found = dict[str, Path]()
    with reading("library", path, _HINT):
        for texture in content.get("textures", []):
            uri = content["images"][_source(texture)].get("uri")
            if uri is not None and not uri.startswith("data:"):
                found[uri] = limits.referenced("library", path, unquote(uri), library.folder).resolve()
    return found


def _write_pack(page: Path, name: str, content: bytes) -> None:
    """Write ``data/NAME.js``, a script that hands bytes to ``page/packs.js``."""

    def pieces() -> Iterator[bytes]:
        yield f'packs.arrive({json.dumps(name)}, "'.encode()
        for start in range(0, len(content), 3 << 20):
            yield base64.b64encode(content[start : start + (3 << 20)])
        yield b'");\n'

    write_pieces(page / "data" / f"{name}.js", pieces())


def _library_frame() -> str:
    """The page of three.js with :class:`TreeField` of ``lod_field_three.js`` as a global beside ``THREE``.

    Modules come from addresses that hold them, because a page that was opened by a double click may import nothing else.
    """
    program = (files("bbfit.exporting") / "lod_programs" / "lod_field_three.js").read_bytes()
    modules = {name: f"export const {{ {taken} }} = THREE;".encode() for name, taken in _MODULES.items()} | {"field": program}
    imports = {name: f"data:text/javascript;base64,{base64.b64encode(code).decode()}" for name, code in modules.items()}
    scripts = (
        f'<script type="importmap">{json.dumps({"imports": imports})}</script>'
        '<script type="module">import { TreeField } from "field"; globalThis.TreeField = TreeField;</script>'
    )
    before, end, after = library_page().rpartition("</body>")
    return before + scripts + end + after
