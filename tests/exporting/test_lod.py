"""Levels of detail in one GLB: each is what its own file was, told by the extension MSFT_lod, beside a scene that shows the first."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from khronos import WARNING, messages
from PIL import Image
from test_formats import tree_of

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import LodLevel, glb_counts, is_self_contained, lod_glb
from bbfit.exporting.model import export, shipped_model
from bbfit.geometry.cloud import BillboardCloud

BLANK = LodLevel("", 1, 0, 0, 0, 0.1, 1.0, 1.0, 20.0, 50.0, 10.0, 0.0, "", 10.0, 5.0, 0.05, 0.06)
CONFIGS = (
    ExportConfig(alpha="blend", split=True),
    ExportConfig(textures="webp", fallback=False),
    ExportConfig(alpha="hash", outline="hull", corners=6),
)


@pytest.fixture(scope="module")
def tree() -> bytes:
    """A textured box and a ball with a color of its own, under nodes that move them."""
    scene = trimesh.Scene()
    box = trimesh.creation.box((0.2, 1.0, 0.2))
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (8, 8, 4), np.uint8))
    material = trimesh.visual.material.PBRMaterial(name="bark", baseColorTexture=picture, alphaMode="MASK", alphaCutoff=0.4)
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], material=material)
    scene.add_geometry(box, node_name="trunk", transform=trimesh.transformations.translation_matrix((0, 0.5, 0)))
    scene.add_geometry(trimesh.creation.icosphere(1), node_name="crown", transform=trimesh.transformations.translation_matrix((0, 2, 0)))
    return bytes(scene.export(file_type="glb"))


def levels_of(models: list[bytes]) -> list[LodLevel]:
    coverages = [*(0.5**number for number in range(len(models) - 1)), 0.0]
    return [
        replace(BLANK, name=f"oak_LOD{number}", screen_coverage=coverage, distance_meters=9.5 * number)
        for number, coverage in enumerate(coverages)
    ]


def described(tree: dict[str, Any], views: list[bytes], node: int) -> Any:
    """A node with all that it refers to in place of numbers; names are left out."""
    skipped = ("name", "extras", "extensions")

    def item(kind: str, number: int) -> dict[str, Any]:
        return {key: value for key, value in tree[kind][number].items() if key != "name"}

    def accessor(number: int) -> Any:
        entry = item("accessors", number)
        return entry | {"bufferView": content(entry["bufferView"])}

    def content(number: int) -> Any:
        return {key: value for key, value in tree["bufferViews"][number].items() if key == "target"} | {"bytes": views[number]}

    def picture(number: int) -> Any:
        entry = item("images", number)
        return entry | {"bufferView": content(entry["bufferView"])}

    def texture(number: int) -> Any:
        entry = item("textures", number)
        sources = [entry, *entry.get("extensions", {}).values()]
        named = [picture(source["source"]) for source in sources if "source" in source]
        return named, sorted(entry.get("extensions", {})), tree["samplers"][entry["sampler"]] if "sampler" in entry else None

    def material(number: int) -> Any:
        entry = item("materials", number)
        surface = dict(entry.get("pbrMetallicRoughness", {}))
        if "baseColorTexture" in surface:
            surface["baseColorTexture"] = texture(surface["baseColorTexture"]["index"])
        return entry | {"pbrMetallicRoughness": surface}

    def primitive(entry: dict[str, Any]) -> Any:
        attributes = {name: accessor(number) for name, number in entry["attributes"].items()}
        made = entry | {"attributes": attributes, "indices": accessor(entry["indices"])}
        return made | ({"material": material(entry["material"])} if "material" in entry else {})

    entry = tree["nodes"][node]
    made = {key: value for key, value in entry.items() if key not in (*skipped, "mesh", "children")}
    made["children"] = [described(tree, views, child) for child in entry.get("children", [])]
    if "mesh" in entry:
        made["mesh"] = [primitive(one) for one in tree["meshes"][entry["mesh"]]["primitives"]]
    return made


def test_every_level_is_what_its_own_file_was(
    crossed: BillboardCloud, clouds: dict[str, BillboardCloud], tree: bytes, tmp_path: Path
) -> None:
    several = (crossed, clouds["two"], clouds["mixed"])
    models = [export(cloud, tmp_path / "m.glb", config)[0].read_bytes() for cloud, config in zip(several, CONFIGS, strict=True)]
    models.insert(0, tree)
    (path := tmp_path / "oak.glb").write_bytes(lod_glb(models, levels_of(models)))
    joined, views = tree_of(path)
    (root,) = joined["scenes"][joined["scene"]]["nodes"]
    first = joined["nodes"][root]
    roots = [root, *first["extensions"]["MSFT_lod"]["ids"]]
    assert [joined["nodes"][number]["name"] for number in roots] == [f"oak_LOD{number}" for number in range(4)]
    for model, node in zip(models, roots, strict=True):
        (own := tmp_path / "own.glb").write_bytes(model)
        alone, contents = tree_of(own)
        tops = [described(alone, contents, top) for top in alone["scenes"][alone["scene"]]["nodes"]]
        assert tops and described(joined, views, node) == {"children": tops}
    # Nothing of the first was renumbered, as what bbfit does not know of may refer to it.
    own.write_bytes(tree)
    alone, contents = tree_of(own)
    assert views[: len(contents)] == contents
    for kind in ("accessors", "images", "textures", "materials", "meshes", "nodes"):
        assert joined[kind][: len(alone[kind])] == alone[kind]
    assert first["extras"] == {"MSFT_screencoverage": [1.0, 0.5, 0.25, 0.0], "lod_distances": [0.0, 9.5, 19.0, 28.5]}
    assert {"MSFT_lod", "EXT_texture_webp", "KHR_materials_unlit"} <= set(joined["extensionsUsed"])
    assert joined["extensionsRequired"] == ["EXT_texture_webp"]
    names = [node["name"] for node in joined["nodes"]]
    assert len(set(names)) == len(names)
    # The validator knows nothing of MSFT_lod, and so takes the other levels for unused; trimesh has no targets. Nothing else is wrong.
    found = messages(path)
    assert {message["code"] for message in found} <= {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT", "BUFFER_VIEW_TARGET_MISSING"}
    assert sorted(message["pointer"] for message in found if message["code"] == "UNUSED_OBJECT") == sorted(
        f"/nodes/{number}" for number in roots[1:]
    )


def test_one_level_needs_no_extension(crossed: BillboardCloud, tmp_path: Path) -> None:
    (path,) = export(crossed, tmp_path / "model.glb")
    path.write_bytes(lod_glb([path.read_bytes()], levels_of([b""])))
    tree, _ = tree_of(path)
    assert "MSFT_lod" not in tree["extensionsUsed"] and not messages(path)


def test_vertices_and_triangles_are_counted_node_by_node(crossed: BillboardCloud, tree: bytes, tmp_path: Path) -> None:
    (path,) = export(crossed, tmp_path / "model.glb", ExportConfig(alpha="mask", outline="rectangle"))
    assert glb_counts(path.read_bytes()) == (8, 4)
    cut = shipped_model(crossed, ExportConfig(alpha="mask"))
    assert glb_counts(cut.glb) == (cut.cards.vertex_count, sum(len(card.triangles) for card in cut.cards.cards))
    vertices, triangles = glb_counts(tree)
    assert triangles == 12 + 80 and vertices == len(trimesh.load(io.BytesIO(tree), file_type="glb", force="mesh", process=False).vertices)


def changed(glb: bytes, change: dict[str, Any]) -> bytes:
    """A GLB with other entries at the top of its JSON."""
    length = int.from_bytes(glb[12:16], "little")
    text = json.dumps(json.loads(glb[20 : 20 + length]) | change).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    return b"glTF" + struct.pack("<III4s", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def test_only_whole_files_stand_alone(tree: bytes, tmp_path: Path) -> None:
    size = len(tree)
    cases = {
        tree: True,
        changed(tree, {}): True,
        changed(tree, {"buffers": [{"byteLength": 4, "uri": "data.bin"}]}): False,
        changed(tree, {"buffers": [{"byteLength": size}, {"byteLength": 4, "uri": "more.bin"}]}): False,
        changed(tree, {"images": [{"uri": "bark.png"}]}): False,
        changed(tree, {"scenes": []}): False,
        b'{"asset": {"version": "2.0"}}': False,
        b"": False,
        b"glTF" + struct.pack("<II", 1, size) + tree[12:]: False,
    }
    for number, (data, expected) in enumerate(cases.items()):
        (path := tmp_path / f"{number}.glb").write_bytes(data)
        assert is_self_contained(path) is expected, number


def test_levels_without_any_picture_have_no_empty_lists(tmp_path: Path) -> None:
    plain = trimesh.Scene(trimesh.creation.box()).export(file_type="glb")
    models = [plain, plain]
    (path := tmp_path / "oak.glb").write_bytes(lod_glb(models, levels_of(models)))
    assert [] not in tree_of(path)[0].values()
    assert not [message for message in messages(path) if message["severity"] < WARNING]
