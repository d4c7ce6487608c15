"""Integer positions, texture coordinates, normals and tangents (KHR_mesh_quantization)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
import torch
from glb_viewer import view_glb
from gltf_arrays import KINDS, array, matrix
from khronos import WARNING, messages
from test_lit import with_maps
from trimesh.transformations import quaternion_matrix

from bbfit.exporting.config import ExportConfig, Profile
from bbfit.exporting.model import export, shipped_model
from bbfit.exporting.vertex_formats import EXTENSION, on_grid, quantized_tree
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import texture_slopes
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import joined_glb, split_glb

# Components of 16 bits and of 8 bits.
_SHORT, _UNSIGNED_SHORT, _BYTE = 5122, 5123, 5120


def _attributes(path: Path) -> tuple[dict[str, Any], list[bytes], list[dict[str, int]]]:
    tree, contents = split_glb(path.read_bytes())
    return tree, contents, [primitive["attributes"] for mesh in tree["meshes"] for primitive in mesh["primitives"]]


def _both(cloud: BillboardCloud, folder: Path, **options: Any) -> tuple[Path, Path]:
    """The same model with integers and with floats."""
    (integers,), (floats,) = (
        export(cloud, folder / f"{quantized}.glb", ExportConfig(quantized=quantized, **options)) for quantized in (True, False)
    )
    return integers, floats


@pytest.mark.parametrize("kind", ["one", "two", "mixed"])
def test_a_viewer_shows_the_same_in_fewer_bytes(kind: str, clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    """Eight bytes of 20 are saved for each vertex. A viewer that knows nothing but the specification shows the same picture."""
    integers, floats = _both(clouds[kind], tmp_path)
    tree, _, attributes = _attributes(integers)
    assert messages(integers) == [] and tree["extensionsRequired"] == [EXTENSION]
    accessors = [{name: tree["accessors"][number]["componentType"] for name, number in each.items()} for each in attributes]
    assert all(each == {"POSITION": _SHORT, "TEXCOORD_0": _UNSIGNED_SHORT} for each in accessors)
    vertices = sum(tree["accessors"][each["POSITION"]]["count"] for each in attributes)
    lengths = [sum(map(len, split_glb(path.read_bytes())[1])) for path in (integers, floats)]
    assert lengths[1] - lengths[0] == 8 * vertices
    for index in range(len(orbit)):
        shown, expected = view_glb(integers, orbit[index]), view_glb(floats, orbit[index])
        assert expected[..., 3].max() > 0.5
        assert abs(shown - expected).max() < 1 / 255  # measured 0.81 / 255: noise for texels, and positions that move by 0.02 mm


def test_a_corner_moves_along_its_texture(crossed: BillboardCloud) -> None:
    """A texture stays at its place: positions and coordinates change together."""
    cards = shipped_model(crossed, ExportConfig(quantized=True)).cards
    for before, after in zip(cards.cards, on_grid(cards).cards, strict=True):
        np.testing.assert_allclose(after.uvs * 65_535, np.rint(before.uvs * 65_535), atol=1e-9)
        moved = before.corners + (after.uvs - before.uvs) @ texture_slopes(before)
        np.testing.assert_allclose(after.corners, moved, atol=1e-12)
        np.testing.assert_allclose(texture_slopes(after), texture_slopes(before), atol=1e-9)
    assert any((before.uvs != after.uvs).any() for before, after in zip(cards.cards, on_grid(cards).cards, strict=True))


def test_a_large_atlas_keeps_its_coordinates(crossed: BillboardCloud, tmp_path: Path) -> None:
    """Beyond 4096 texels, 16 bits would move a corner by more than 1/32 of a texel."""
    cards = shipped_model(crossed).cards
    for side, same in ((4096, False), (4100, True)):
        wide = replace(cards, atlas=replace(cards.atlas, image=np.zeros((4, side, 4), np.uint8)))
        assert (on_grid(wide) is wide) == same


def test_normals_and_tangents_keep_their_directions(clouds: dict[str, BillboardCloud], tmp_path: Path) -> None:
    integers, floats = _both(with_maps(clouds["mixed"]), tmp_path, alpha="mask")
    assert [found["code"] for found in messages(integers) if found["code"] != "UNSUPPORTED_EXTENSION"] == []
    (tree, contents, found), (other, others, expected) = _attributes(integers), _attributes(floats)
    assert {tree["accessors"][each[name]]["componentType"] for each in found for name in ("NORMAL", "TANGENT")} == {_BYTE}
    for name in ("NORMAL", "TANGENT"):
        rows = np.concatenate([array(tree, contents, each[name]) for each in found])
        exact = np.concatenate([array(other, others, each[name]) for each in expected])
        cosines = (rows[:, :3] * exact[:, :3]).sum(-1) / np.linalg.norm(rows[:, :3], axis=-1)
        assert np.degrees(np.arccos(cosines.clip(-1, 1))).max() < 0.4  # half a step of 1/127 along each axis
        np.testing.assert_array_equal(rows[:, 3:], exact[:, 3:])  # the sign of the bitangent
    saved = len(floats.read_bytes()) - len(integers.read_bytes())
    assert saved > 27 * len(rows)  # 4 bytes each of positions and coordinates, 8 of normals, 12 of tangents, less some JSON


@pytest.mark.parametrize("profile", ["three", "cesium"])
def test_nodes_with_equal_normals_keep_them(profile: Profile, crossed: BillboardCloud, tmp_path: Path) -> None:
    """trimesh lets meshes share the accessor of equal values."""
    shifted = replace(crossed.take([0, 0, 0]), centers=crossed.centers[[0, 0, 0]] + torch.tensor([[0.0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]]))
    config = ExportConfig(alpha="blend", profile=profile, material="pbr")
    (path,) = export(shifted, tmp_path / "tree.glb", config)
    tree, contents, found = _attributes(path)
    shared = [each[name] for each in found for name in each]
    assert len(found) > 1 and len(set(shared)) < len(shared) and messages(path) == []
    for each in found:
        np.testing.assert_allclose(np.linalg.norm(array(tree, contents, each["NORMAL"]), axis=-1), 1, atol=0.02)


def test_split_nodes_stay_at_their_origins(crossed: BillboardCloud, tmp_path: Path) -> None:
    """Programs sort nodes by their places or by the centers of their bounds."""
    config = ExportConfig(alpha="blend", profile="three")
    (path,) = export(crossed, tmp_path / "tree.glb", config)
    tree, contents, _ = _attributes(path)
    nodes, placed = on_grid(shipped_model(crossed, config).cards).nodes, [node for node in tree["nodes"] if "mesh" in node]
    assert len(nodes) == len(placed) > 1 and messages(path) == []
    for cards, node in zip(nodes, placed, strict=True):
        assert cards[0].origin is not None
        np.testing.assert_allclose(node["translation"], cards[0].origin, atol=1e-6)
        number = tree["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"]
        assert np.add(tree["accessors"][number]["min"], tree["accessors"][number]["max"]).tolist() == [0, 0, 0]
        points, unit = array(tree, contents, number) @ matrix(node)[:3, :3].T + cards[0].origin, node["scale"][0]
        exact = np.concatenate([card.corners for card in cards])
        assert abs(points[: len(exact)] - exact).max() < 0.5 * unit + 1e-6


def test_programs_that_read_integers_get_them(crossed: BillboardCloud) -> None:
    readers = {"three", "babylon", "playcanvas", "model-viewer", "cesium", "filament"}
    for profile in (None, *get_args(Profile)):
        assert ExportConfig(profile=profile).resolve().quantized == (profile in readers)
        assert ExportConfig(profile=profile, quantized=False).resolve().quantized is False
        assert ExportConfig(profile=profile, quantized=True).resolve().quantized is True


def _tree_of_floats() -> bytes:
    """Two meshes as Blender writes them, at three nodes, of which one is turned and mirrored. The second mesh repeats its texture.

    The first primitive shares vertices. The second has a material without a texture.
    """
    random, contents = np.random.default_rng(3), [cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()]
    tree: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1, 2]}], "accessors": [], "bufferViews": [{}]}

    def put(values: np.ndarray, kind: int, shape: str, **more: Any) -> int:
        contents.append(values.astype(KINDS[kind]).tobytes())
        tree["bufferViews"].append({"target": 34963 if shape == "SCALAR" else 34962})
        accessor = {"bufferView": len(contents) - 1, "componentType": kind, "count": len(values), "type": shape}
        tree["accessors"].append(accessor | more)
        return len(tree["accessors"]) - 1

    def primitive(count: int, repeats: float, material: int, corners: np.ndarray) -> dict[str, Any]:
        points = random.normal(size=(count, 3)).astype("f4") * [1, 5, 2] + [3, 4, 5]
        bounds = {"min": points.min(0).astype("f4").tolist(), "max": points.max(0).astype("f4").tolist()}
        normals = random.normal(size=(count, 3))
        attributes = {
            "POSITION": put(points, 5126, "VEC3", **bounds),
            "NORMAL": put(normals / np.linalg.norm(normals, axis=1, keepdims=True), 5126, "VEC3"),
            "TEXCOORD_0": put(repeats * random.random((count, 2)), 5126, "VEC2"),
            "TEXCOORD_1": put(random.random((count, 2)), 5126, "VEC2"),
        }
        return {"attributes": attributes, "indices": put(corners, 5125, "SCALAR"), "material": material}

    shared = np.concatenate([np.arange(90), random.permutation(90)])
    tree |= {"images": [{"bufferView": 0, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, {"doubleSided": True}]
    parts = [primitive(90, 1, 0, shared), primitive(30, 1, 1, random.permutation(30)), primitive(60, 7, 0, random.permutation(60))]
    tree["meshes"] = [{"primitives": parts[:2]}, {"primitives": parts[2:]}]
    turn = np.array([0.1, -0.5, 0.3, 0.8]) / np.linalg.norm([0.1, -0.5, 0.3, 0.8])
    placed = {"rotation": turn.tolist(), "scale": [-2.0, 3.0, 0.5], "translation": [1.0, 2.0, 3.0]}
    tree["nodes"] = [{"mesh": 0}, {"mesh": 0} | placed, {"mesh": 1, "translation": [0.0, -9.0, 0.0]}]
    return joined_glb(tree, contents)


def _corners(glb: bytes, name: str) -> list[np.ndarray]:
    """An attribute at the corners of the triangles of each primitive of each node of a GLB, positions in the world."""
    tree, contents = split_glb(glb)
    found = list[np.ndarray]()
    for node in tree["nodes"]:
        turned = quaternion_matrix(np.roll(node.get("rotation", (0, 0, 0, 1)), 1))[:3, :3] * node.get("scale", (1, 1, 1))
        for primitive in tree["meshes"][node["mesh"]]["primitives"]:
            if name in primitive["attributes"]:
                own = array(tree, contents, primitive["attributes"][name])
                own = own[array(tree, contents, primitive["indices"]).astype(int).ravel()] if "indices" in primitive else own
                found.append(own @ turned.T + node.get("translation", (0, 0, 0)) if name == "POSITION" else own)
    return found


def test_a_tree_stays_where_it_is_in_half_of_the_bytes(tmp_path: Path) -> None:
    floats = _tree_of_floats()
    integers = quantized_tree(floats)
    for name, glb in (("floats", floats), ("integers", integers)):
        (tmp_path / f"{name}.glb").write_bytes(glb)
        assert [each for each in messages(tmp_path / f"{name}.glb") if each["severity"] <= WARNING] == []
    # Half of the longest side of a mesh is at most 15 m here, which one node stretches by 3.
    for name, error in (("POSITION", 0.5 * 3 * np.sqrt(3) * 15 / 32_767), ("NORMAL", 0.5 / 127)):
        for got, expected in zip(_corners(integers, name), _corners(floats, name), strict=True):
            np.testing.assert_allclose(got, expected, rtol=0, atol=1.001 * error)
    # The material of the second primitive, at the first two nodes, has no texture.
    textured = [values for number, values in enumerate(_corners(floats, "TEXCOORD_0")) if number not in (1, 3)]
    for got, expected in zip(_corners(integers, "TEXCOORD_0"), textured, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1.001 * 0.5 / 65_535)
    assert _corners(integers, "TEXCOORD_1") == []
    tree, contents = split_glb(integers)
    own = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    kinds = [tree["accessors"][each["attributes"]["TEXCOORD_0"]]["componentType"] for each in (own[0], own[2])]
    assert kinds == [_UNSIGNED_SHORT, 5126]  # the coordinates of the second mesh exceed 1
    assert ["indices" in each for each in own] == [True, False, False]
    assert tree["extensionsRequired"] == tree["extensionsUsed"] == [EXTENSION]
    # Without the picture, a vertex has 8 + 4 bytes and its texture coordinates, 4 or 8, and an index 2.
    picture = contents[tree["images"][0]["bufferView"]]
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), -1).shape == (1, 1, 3)
    assert sum(map(len, contents)) - len(picture) == 90 * 16 + 180 * 2 + 30 * 12 + 60 * 20


@pytest.mark.parametrize(
    ("texture", "sets"),
    [
        ({}, 0),
        ({"normalTexture": {"index": 3}}, 1),
        ({"occlusionTexture": {"index": 0, "texCoord": 1, "strength": 0.5}}, 2),
        ({"emissiveTexture": {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": {"texCoord": 0}}}}, 1),
        ({"extensions": {"KHR_materials_transmission": {"transmissionTexture": {"index": 0, "texCoord": 1}}}}, 2),
    ],
)
def test_texture_coordinates_that_a_texture_uses_stay(texture: dict[str, Any], sets: int) -> None:
    tree, contents = split_glb(_tree_of_floats())
    tree["materials"][1] |= texture
    after, _ = split_glb(quantized_tree(joined_glb(tree, contents)))
    assert sum(name.startswith("TEXCOORD_") for name in after["meshes"][0]["primitives"][1]["attributes"]) == sets
