"""The files of levels of detail: one for each level, ``lod.json`` that describes them, and what programs need to switch between them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from bbfit.checks import check_record
from bbfit.exporting.config import LodConfig
from bbfit.exporting.lod import LodLevel
from bbfit.files import read_json
from bbfit.geometry.camera import focal_pixels
from bbfit.inputs import reading
from bbfit.model_files import generator, relative_uri

LOD_FILE = "lod.json"
"""The name of the description."""
LOD_VERSION = 1
"""The version of its schema. It rises when a field changes its meaning or goes; new fields may come without."""
# Cesium refines a tile once its error covers more pixels than this (Cesium3DTileset.maximumScreenSpaceError).
_CESIUM_PIXELS = 16
# How far before and after a distance Godot fades, as a share of it.
_GODOT_MARGIN = 0.05
_GODOT_SCRIPT = """@tool
extends Node3D

# Visibility ranges belong to geometry: each level holds its range as metadata, for all of the geometry in it. Godot takes distances from
# the center of bounds, which are those of the whole tree here, so that all parts of a level switch together.
func _ready():
	for level in get_children():
		for part in level.find_children("*", "GeometryInstance3D", true, false):
			part.custom_aabb = part.global_transform.affine_inverse() * global_transform * get_meta("extent")
			for property in ["begin", "begin_margin", "end", "end_margin", "fade_mode"]:
				part.set("visibility_range_" + property, level.get_meta("visibility_range_" + property))
"""


def lod_document(
    name: str, levels: Sequence[LodLevel], config: LodConfig, bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
) -> dict[str, Any]:
    """What ``lod.json`` contains: the levels of the tree ``name``, finest first, with its lowest and highest corner in meters, Y up."""
    low, high = bounds
    return {
        "version": LOD_VERSION,
        "generator": generator(),
        "name": name,
        "extent": {"low": low, "high": high, "radius": math.dist(low, high) / 2},
        "config": asdict(config),
        "levels": [asdict(level) for level in levels],
    }


@dataclass(frozen=True)
class StoredLevels:
    """What a ``lod.json`` contains."""

    levels: tuple[LodLevel, ...]
    """The levels, finest first."""
    focal: float
    """Focal length in pixels of the screen that their distances are for. Distances over it hold for any screen."""
    triangles: int | None
    """Triangles to which the tree itself was thinned out; ``None`` if all of them stayed."""


def read_levels(folder: Path) -> StoredLevels:
    """Read the ``lod.json`` of a folder of levels. Raises MissingFileError or InputError if it is missing or damaged."""
    path = folder / LOD_FILE
    with reading("levels of detail", path, "start bbfit lod again"):
        stored = read_json("levels of detail", path)
        levels, config = tuple(LodLevel(**level) for level in stored["levels"]), stored["config"]
        check_record("levels", levels, tuple[LodLevel, ...])
        focal = focal_pixels(float(config["screen_height"]), float(config["screen_fov_degrees"]))
        return StoredLevels(levels, focal, config.get("triangles"))


def level_file(name: str, number: int | str) -> str:
    """The name of a level's own file; Unity's importers know levels by such names. ``number`` may be ``*``, for all of them."""
    return f"{name}_LOD{number}.glb"


def program_file_names(profile: str | None, name: str) -> tuple[str, ...]:
    """Names of the files that a program needs beside the levels of the tree ``name``; none for a profile without any."""
    return tuple(file.format(name=name) for file in _PROGRAMS.get(profile, {}))


def program_files(profile: str | None, document: Mapping[str, Any]) -> dict[str, bytes]:
    """These files by their names, for a :func:`lod_document`."""
    scripts = files("bbfit.exporting") / "lod_programs"
    made = _PROGRAMS.get(profile, {})
    contents = {file: (scripts / file).read_bytes() if make is None else _text_bytes(make(document)) for file, make in made.items()}
    return {file.format(name=document["name"]): content for file, content in contents.items()}


def _text_bytes(text: str) -> bytes:
    """Text as UTF-8, with the bytes of file names that are no text as they are."""
    return text.encode(errors="surrogateescape")


def _godot_scene(document: Mapping[str, Any]) -> str:
    """A scene for Godot 4 with a node for each level.

    https://docs.godotengine.org/en/stable/engine_details/file_formats/tscn.html and class_geometryinstance3d.html
    """
    levels = document["levels"]
    parts = [f"[gd_scene load_steps={len(levels) + 2} format=3]"]
    parts += [f'[ext_resource type="PackedScene" path={_text(level["file"])} id="{number}"]' for number, level in enumerate(levels)]
    parts.append(f'[sub_resource type="GDScript" id="ranges"]\nscript/source = {_text(_GODOT_SCRIPT)}')
    low, high = document["extent"]["low"], document["extent"]["high"]
    extent = ", ".join(map(str, [*low, *(above - below for below, above in zip(low, high, strict=True))]))
    parts.append(f'[node name={_text(document["name"])} type="Node3D"]\nscript = SubResource("ranges")\nmetadata/extent = AABB({extent})')
    distances = [*(level["distance_meters"] for level in levels), 0.0]
    for number, (level, begin, end) in enumerate(zip(levels, distances, distances[1:], strict=False)):
        ranges = {"begin": begin, "begin_margin": _GODOT_MARGIN * begin, "end": end, "end_margin": _GODOT_MARGIN * end, "fade_mode": 1}
        lines = [f"metadata/visibility_range_{key} = {value}" for key, value in ranges.items()]
        head = f'[node name={_text(level["name"])} parent="." instance=ExtResource("{number}")]'
        parts.append("\n".join([head, *lines]))
    return "\n\n".join(parts) + "\n"


def _text(value: str) -> str:
    """A string of Godot's text files, which may contain line ends."""
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _tileset(document: Mapping[str, Any]) -> str:
    """A tileset of 3D Tiles 1.1 whose tiles replace each other at the levels' distances in Cesium, the coarsest at the root.

    Cesium refines a tile where its geometric error, seen from the distance of its bounding sphere, covers more than 16 pixels. Tiles have
    Z up; Cesium turns their GLBs, which have Y up. The tree goes where its height would be a pixel.
    """
    config, extent = document["config"], document["extent"]
    focal = focal_pixels(config["screen_height"], config["screen_fov_degrees"])
    x, y, z = ((low + high) / 2 for low, high in zip(extent["low"], extent["high"], strict=True))
    sphere = {"sphere": [x, -z, y, extent["radius"]]}
    tile: dict[str, Any] = {}
    for level in document["levels"]:
        error = _CESIUM_PIXELS * max(0.0, level["distance_meters"] - extent["radius"]) / focal
        children = {"children": [tile]} if tile else {}
        content = {"uri": relative_uri(level["file"])}
        tile = {"boundingVolume": sphere, "geometricError": error, "refine": "REPLACE", "content": content} | children
    height = extent["high"][1] - extent["low"][1]
    least = max(_CESIUM_PIXELS * height, tile["geometricError"])
    return json.dumps({"asset": {"version": "1.1", "generator": generator()}, "geometricError": least, "root": tile}, indent=1) + "\n"


# For each profile the names of its files, and what makes each; None for a script of the package.
_PROGRAMS: Mapping[str | None, Mapping[str, Callable[[Mapping[str, Any]], str] | None]] = {
    "three": {"lod_three.js": None, "lod_field_three.js": None},
    "babylon": {"lod_babylon.js": None},
    "playcanvas": {"lod_playcanvas.js": None},
    "godot": {"{name}.tscn": _godot_scene},
    "unity": {"BbfitLod.cs": None},
    "cesium": {"tileset.json": _tileset},
}
