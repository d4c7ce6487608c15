"""What programs get beside the levels of detail, read back; tests/viewers shows it in those that can be had."""

from __future__ import annotations

import itertools
import json
import math
import re
from typing import Any, get_args
from urllib.parse import unquote

import pytest

from bbfit.exporting.config import LodConfig, Profile
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.lod_files import LOD_VERSION, level_file, lod_document, program_file_names, program_files

DISTANCES = (0.0, 40.0, 90.5)
BOUNDS = ((-3.0, 0.0, -2.0), (3.0, 8.0, 2.5))
NAME = 'an "old" oak #1, 50 % \udcff'


@pytest.fixture
def document() -> dict[str, Any]:
    levels = [
        LodLevel(f"{NAME}_LOD{n}", None, 0, 0, 0, 0.0, 0.0, 0.0, None, None, distance, 0.0, level_file(NAME, n), distance, 0.0, 0.0, 0.0)
        for n, distance in enumerate(DISTANCES)
    ]
    return lod_document(NAME, levels, LodConfig(), BOUNDS)


def test_the_description_is_json_with_all_that_a_program_needs(document: dict[str, Any]) -> None:
    read = json.loads(json.dumps(document, allow_nan=False))
    assert read["version"] == LOD_VERSION == 1
    assert [level["file"] for level in read["levels"]] == [f"{NAME}_LOD{n}.glb" for n in range(3)]
    assert [level["distance_meters"] for level in read["levels"]] == list(DISTANCES)
    assert read["extent"] == {"low": list(BOUNDS[0]), "high": list(BOUNDS[1]), "radius": pytest.approx(math.hypot(6, 8, 4.5) / 2)}
    assert {"screen_width", "screen_height", "screen_fov_degrees", "error_pixels", "color_error"} <= read["config"].keys()


def test_files_have_the_names_that_are_told_before(document: dict[str, Any]) -> None:
    for profile in (None, *get_args(Profile), "playcanvas", "cesium"):
        made = program_files(profile, document)
        assert tuple(made) == program_file_names(profile, NAME) and all(made.values())
    assert not program_files(None, document) and not program_files("blender", document)


def parsed(scene: str) -> list[tuple[str, dict[str, str], dict[str, str]]]:
    """The sections of a text file of Godot: kind, attributes and properties, with strings in quotes."""
    string = r'"(?:[^"\\]|\\.)*"'
    sections = []
    for head in re.finditer(rf"^\[(\w+)((?: \w+=(?:{string}|[^\]\s\"(]+|\w+\({string}\)))*)\]$", scene, re.MULTILINE):
        after = scene[head.end() :]
        values = {}
        while found := re.match(rf"\s*([\w/]+) = ({string}|[^\n]+)", after):
            values[found[1]] = found[2]
            after = after[found.end() :]
        assert not after.strip() or after.lstrip().startswith("["), after[:40]
        attributes = dict(re.findall(rf"(\w+)=({string}|\w+\({string}\)|[^\s\]]+)", head[2]))
        sections.append((head[1], attributes, values))
    return sections


def test_godot_shows_each_level_in_its_range(document: dict[str, Any]) -> None:
    (scene,) = program_files("godot", document).values()
    head, *sections = parsed(scene.decode(errors="surrogateescape"))
    assert head == ("gd_scene", {"load_steps": "5", "format": "3"}, {})
    files = {section[1]["id"]: json.loads(section[1]["path"]) for section in sections if section[0] == "ext_resource"}
    assert list(files.values()) == [level["file"] for level in document["levels"]]
    (script,) = [section[2]["script/source"] for section in sections if section[0] == "sub_resource"]
    root, *levels = [section for section in sections if section[0] == "node"]
    assert root[2]["script"] == 'SubResource("ranges")' and "parent" not in root[1]
    assert root[2]["metadata/extent"] == "AABB(-3.0, 0.0, -2.0, 6.0, 8.0, 4.5)"
    ranges = []
    for number, (_, attributes, values) in enumerate(levels):
        assert json.loads(attributes["name"]) == f"{NAME}_LOD{number}" and attributes["parent"] == '"."'
        assert files[attributes["instance"].removeprefix("ExtResource(").removesuffix(")")] == document["levels"][number]["file"]
        assert values.pop("metadata/visibility_range_fade_mode") == "1"
        assert all(name.removeprefix("metadata/visibility_range_") in script for name in values)
        ranges.append({name.removeprefix("metadata/visibility_range_"): float(value) for name, value in values.items()})
    assert [(each["begin"], each["end"]) for each in ranges] == [(0, 40), (40, 90.5), (90.5, 0)]  # 0 is no end
    for near, far in itertools.pairwise(ranges):  # both fade over the same distances
        assert near["end_margin"] == far["begin_margin"] > 0


def test_a_tileset_refines_where_the_finer_level_is_needed(document: dict[str, Any]) -> None:
    """By the formula of Cesium3DTile.getScreenSpaceError, and its bound of 16 pixels."""
    tileset = json.loads(program_files("cesium", document)["tileset.json"])
    assert tileset["asset"]["version"] == "1.1"
    chain, tile = [], tileset["root"]
    while tile:
        chain.append(tile)
        (tile,) = tile.get("children", [None])
    assert [unquote(tile["content"]["uri"], errors="surrogateescape") for tile in chain] == [level["file"] for level in document["levels"]][
        ::-1
    ]
    errors = [tileset["geometricError"], *(tile["geometricError"] for tile in chain)]
    assert errors == sorted(errors, reverse=True) and errors[-1] == 0
    for tile, distance in zip(chain, DISTANCES[::-1], strict=True):
        x, y, z, radius = tile["boundingVolume"]["sphere"]
        assert (x, y, z) == (0, -0.25, 4) and tile["refine"] == "REPLACE"  # Z up
        seen = tile["geometricError"] * 1080 / ((distance - radius) * 2 * math.tan(math.radians(25)))
        assert seen == pytest.approx(16 if distance else 0)


def test_unity_reads_fields_that_are_there(document: dict[str, Any]) -> None:
    script = program_files("unity", document)["BbfitLod.cs"].decode()
    assert script.count("{") == script.count("}") and script.count("(") == script.count(")")
    classes = dict(re.findall(r"\[Serializable\] class (\w+) \{ (.*?) \}", script))
    for name, place in (("Level", document["levels"][0]), ("Config", document["config"]), ("Document", document)):
        assert set(re.findall(r"(\w+);", classes[name])) <= place.keys()
