"""Trees as scenes and files: nothing is lost or changed on the way, and other programs read both kinds of file alike."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from full_disk import FULL, full_disk
from khronos import reports
from numpy.typing import NDArray

from bbfit.checks import InputError, MissingFileError
from bbfit.trees.parts import Material, Part
from bbfit.trees.tree_writer import scene_of, write_tree

BARK = Material("bark", (0.0221, 1 / 3, 0.1), 0.85, double_sided=False)
LEAVES = (
    Material("leaf_0", (0.0225, 0.3, 0.05), 0.6, double_sided=True),
    Material("leaf_1", (0.5, 0.25, 0.0), 0.6, double_sided=True, transmission=0.4, transmission_color=(2 / 3, 0.25, 0.0)),
)
TRANSMISSION = "KHR_materials_diffuse_transmission"


def sample() -> list[Part]:
    """A bent stem with smooth normals, and leaves of two tones that differ in place and normals alone, as copies of one leaf do."""
    random = np.random.default_rng(0)
    along, around = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 2 * np.pi, 9), indexing="ij")
    circle = np.stack([np.cos(around), np.zeros(around.shape), -np.sin(around)], -1)
    stem = 0.1 * circle + np.stack([along**2, 2 * along, -along], -1)
    corners = (np.arange(5)[:, None] * 9 + np.arange(8)).reshape(-1, 1, 1)
    faces = (corners + np.array([[0, 1, 10], [0, 10, 9]])).reshape(-1, 3)
    parts = [part(BARK, stem.reshape(-1, 3), circle.reshape(-1, 3), np.stack([around / 6, 7 * along], -1).reshape(-1, 2), faces)]
    for material in LEAVES:
        leaf = np.concatenate([point + 0.1 * random.normal(size=(1, 3)) for point in random.normal(size=(20, 3, 3))])
        uvs = np.tile([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], (20, 1))
        parts.append(part(material, leaf, random.normal(size=leaf.shape), uvs, np.arange(60).reshape(-1, 3)))
    return parts


def part(material: Material, *arrays: NDArray[Any]) -> Part:
    vertices, normals, uvs, faces = arrays
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Part(material, *(array.astype(np.float32) for array in (vertices, unit, uvs)), faces.astype(np.int32))


def read_glb(path: Path) -> tuple[dict[str, Any], list[dict[str, NDArray[Any]]]]:
    """JSON and, for each mesh, its arrays as the file has them."""
    data = path.read_bytes()
    magic, version, length, json_length = struct.unpack_from("<4sIII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    tree = json.loads(data[20 : 20 + json_length])
    meshes = []
    for mesh in tree["meshes"]:
        (primitive,) = mesh["primitives"]
        arrays = {}
        for name, index in {**primitive["attributes"], "indices": primitive["indices"]}.items():
            accessor = tree["accessors"][index]
            view = tree["bufferViews"][accessor["bufferView"]]
            assert view["target"] == (34963 if name == "indices" else 34962)
            width = {"SCALAR": 3, "VEC2": 2, "VEC3": 3}[accessor["type"]]
            kind = {5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
            start = 20 + json_length + 8 + view["byteOffset"]
            arrays[name] = np.frombuffer(data[start : start + view["byteLength"]], kind).reshape(-1, width)
        meshes.append(arrays)
    return tree, meshes


def test_a_scene_has_the_parts_as_they_are() -> None:
    parts = sample()
    nothing = replace(parts[1], material=replace(LEAVES[0], name="none"), faces=np.zeros((0, 3), np.int32))
    scene = scene_of([parts[0], nothing, *parts[1:]], name="Quaking Aspen")
    assert list(scene.geometry) == list(scene.graph.nodes_geometry) == ["bark", "leaf_0", "leaf_1"]
    for made, mesh in zip(parts, scene.geometry.values(), strict=True):
        for expected, got in (
            (made.vertices, mesh.vertices),
            (made.normals, mesh.vertex_normals),
            (made.uvs, mesh.visual.uv),
            (made.faces, mesh.faces),
        ):
            np.testing.assert_array_equal(got, expected)
        surface = mesh.visual.material
        assert (surface.name, surface.roughnessFactor) == (made.material.name, made.material.roughness)
        assert (surface.metallicFactor, surface.doubleSided) == (0.0, made.material.double_sided)


def test_a_glb_holds_the_parts_bit_for_bit(tmp_path: Path) -> None:
    parts = sample()
    path = tmp_path / "tree.glb"
    assert write_tree(scene_of(parts, name="Aspen äöü"), path) == [path]
    tree, meshes = read_glb(path)
    for made, arrays in zip(parts, meshes, strict=True):
        np.testing.assert_array_equal(arrays["POSITION"], made.vertices)
        np.testing.assert_array_equal(arrays["NORMAL"], made.normals)
        np.testing.assert_array_equal(arrays["indices"], made.faces)
        turned = np.stack([made.uvs[:, 0], 1 - made.uvs[:, 1].astype(np.float64)], -1)
        np.testing.assert_array_equal(arrays["TEXCOORD_0"], turned.astype(np.float32))
    assert [node["name"] for node in tree["nodes"]] == ["bark", "leaf_0", "leaf_1"]
    assert tree["scenes"] == [{"nodes": [0, 1, 2], "name": "Aspen äöü"}]
    assert tree["asset"]["generator"].startswith("bbfit") and "extras" not in path.read_bytes().decode("latin-1")
    transmitted = {"diffuseTransmissionFactor": 0.4, "diffuseTransmissionColorFactor": [2 / 3, 0.25, 0.0]}
    for made, surface in zip(parts, tree["materials"], strict=True):
        assert surface == {
            "name": made.material.name,
            "doubleSided": made.material.double_sided,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*made.material.color, 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": made.material.roughness,
            },
        } | ({"extensions": {TRANSMISSION: transmitted}} if made.material is LEAVES[1] else {})
    assert tree["extensionsUsed"] == [TRANSMISSION] and "extensionsRequired" not in tree


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_trimesh_reads_back_what_was_written(ending: str, tmp_path: Path) -> None:
    parts = sample()
    write_tree(scene_of(parts, name="tree"), tmp_path / f"tree{ending}")
    loaded = trimesh.load_scene(tmp_path / f"tree{ending}", process=False)
    meshes = {mesh.visual.material.name: mesh for mesh in loaded.geometry.values()}
    assert sorted(meshes) == [made.material.name for made in parts]
    for made in parts:
        mesh = meshes[made.material.name]
        if ending == ".glb":
            np.testing.assert_array_equal(mesh.faces, made.faces)
            assert mesh.visual.material.doubleSided == made.material.double_sided
        corners, expected = mesh.faces.ravel(), made.faces.ravel()
        np.testing.assert_array_equal(mesh.vertices[corners].astype(np.float32), made.vertices[expected])
        np.testing.assert_array_equal(mesh.vertex_normals[corners].astype(np.float32), made.normals[expected])
        # v runs to 7 here, and 1 - v, which a GLB holds, is rounded there by at most 2.4e-7.
        np.testing.assert_allclose(mesh.visual.uv[corners], made.uvs[expected], rtol=0, atol=2.4e-7)
        shown = mesh.visual.material.main_color[:3]
        assert abs(shown - np.array(made.material.color) * 255).max() <= 1  # 8 bits, once or twice


def test_an_obj_holds_the_parts_to_the_last_bit(tmp_path: Path) -> None:
    parts = sample()
    files = write_tree(scene_of(parts, name="tree"), tmp_path / "a tree.obj")
    assert [file.name for file in files] == ["a tree.obj", "a tree.mtl"]
    lines = [line.split() for line in files[0].read_text().splitlines()]
    rows = {word: [line[1:] for line in lines if line[0] == word] for word in ("o", "v", "vt", "vn", "usemtl", "f", "mtllib")}
    for word, name in (("v", "vertices"), ("vt", "uvs"), ("vn", "normals")):
        np.testing.assert_array_equal(np.array(rows[word], float).astype(np.float32), np.concatenate([getattr(p, name) for p in parts]))
    starts = np.cumsum([1, *(len(made.vertices) for made in parts[:-1])])
    faces = np.concatenate([made.faces + start for made, start in zip(parts, starts, strict=True)])
    assert rows["f"] == [[f"{corner}/{corner}/{corner}" for corner in face] for face in faces]
    assert rows["o"] == rows["usemtl"] == [["bark"], ["leaf_0"], ["leaf_1"]] and rows["mtllib"] == [["a", "tree.mtl"]]
    assert {"newmtl bark", "Kd 0.0221 0.333333333 0.1", "Pr 0.85", "d 1"} <= set(files[1].read_text().splitlines())


@pytest.mark.blender
def test_blender_makes_the_same_surfaces_of_both_kinds_of_file(tmp_path: Path) -> None:
    parts = sample()
    for ending in (".glb", ".obj"):
        write_tree(scene_of(parts, name="tree"), tmp_path / f"tree{ending}")
    script = """
import json, os, sys
out = os.dup(1)
os.dup2(2, 1)  # importers talk
import bpy
report = []
for path in sys.argv[1:]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    (bpy.ops.wm.obj_import if path.endswith(".obj") else bpy.ops.import_scene.gltf)(filepath=path)
    for shape in sorted(bpy.data.objects, key=lambda found: found.name):
        mesh, (slot,) = shape.data, shape.material_slots
        inputs = slot.material.node_tree.nodes["Principled BSDF"].inputs
        values = [getattr(i, "default_value", None) for i in inputs]
        corners = [(shape.matrix_world @ mesh.vertices[c.vertex_index].co)[:] for c in mesh.loops]
        normals = [(shape.matrix_world.to_3x3() @ n.vector)[:] for n in mesh.corner_normals]
        uvs = [c.uv[:] for c in mesh.uv_layers[0].data]
        material = [slot.material.name, *(v[:] if hasattr(v, "__len__") else v for v in values)]
        report.append([material, inputs["Base Color"].default_value[:], corners, normals, uvs])
os.write(out, json.dumps(report).encode())
os._exit(0)
"""
    command = [sys.executable, "-c", script, str(tmp_path / "tree.glb"), str(tmp_path / "tree.obj")]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    glb, obj = report[: len(parts)], report[len(parts) :]
    for made, *both in zip(parts, glb, obj, strict=True):
        assert both[0][0] == both[1][0] and both[0][0][0] == made.material.name
        corners = made.faces.ravel()
        for _, color, positions, normals, uvs in both:
            np.testing.assert_allclose(color[:3], made.material.color, rtol=1e-6, atol=1e-9)
            for got, array in ((positions, made.vertices), (normals, made.normals)):
                z_up = np.stack([array[corners, 0], -array[corners, 2], array[corners, 1]], -1)
                # Blender keeps normals as two angles of 16 bits.
                np.testing.assert_allclose(got, z_up, rtol=0, atol=1e-6 if array is made.vertices else 0.01)  # measured 4e-7, 0.004
            np.testing.assert_allclose(uvs, made.uvs[corners], rtol=0, atol=1e-6)


@pytest.mark.node
def test_khronos_validator_finds_nothing(tmp_path: Path) -> None:
    write_tree(scene_of(sample(), name="tree"), tmp_path / "tree.glb")
    (report,) = reports(tmp_path / "tree.glb")
    # Texture coordinates without a texture are noted as information; they are for those who add one. So is an extension that is unknown.
    found = report["issues"]["messages"]
    assert {message["code"] for message in found} <= {"UNUSED_OBJECT", "UNSUPPORTED_EXTENSION"}, report["issues"]
    assert {message["message"].split("'")[1] for message in found if message["code"] == "UNSUPPORTED_EXTENSION"} == {TRANSMISSION}
    assert report["info"]["totalVertexCount"] == sum(len(made.vertices) for made in sample())


def written(folder: Path) -> dict[str, str]:
    """Hashes of the sample's files."""
    files = [file for ending in (".glb", ".obj") for file in write_tree(scene_of(sample(), name="tree"), folder / f"tree{ending}")]
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def test_the_same_scene_gives_the_same_bytes_in_every_process(tmp_path: Path) -> None:
    first = written(tmp_path)
    assert written(tmp_path) == first and len(first) == 3
    script = "import json, pathlib, sys, test_tree_writer as t; print(json.dumps(t.written(pathlib.Path(sys.argv[1]))))"
    command = [sys.executable, "-c", script, str(tmp_path)]
    environment = {**os.environ, "PYTHONHASHSEED": "1234", "PYTHONPATH": str(Path(__file__).parents[1])}
    result = subprocess.run(command, check=True, stdout=subprocess.PIPE, cwd=Path(__file__).parent, env=environment)
    assert json.loads(result.stdout) == first


def test_changes_to_a_scene_are_written(tmp_path: Path) -> None:
    """Another color, and another place."""
    scene = scene_of(sample(), name="tree")
    scene.geometry["bark"].visual.material.baseColorFactor = [51, 102, 0, 255]
    scene.apply_transform(trimesh.transformations.compose_matrix(angles=(0, np.pi / 2, 0), translate=(10, 0, 0), scale=(2, 2, 2)))
    write_tree(scene, tmp_path / "tree.glb")
    colors = [surface["pbrMetallicRoughness"]["baseColorFactor"] for surface in read_glb(tmp_path / "tree.glb")[0]["materials"]]
    assert colors == [[0.2, 0.4, 0.0, 1.0], [*LEAVES[0].color, 1.0], [*LEAVES[1].color, 1.0]]
    write_tree(scene, tmp_path / "tree.obj")
    assert "Kd 0.2 0.4 0\n" in (tmp_path / "tree.mtl").read_text()
    lines = [line.split() for line in (tmp_path / "tree.obj").read_text().splitlines()]
    for word, arrays, scale, move in (("v", "vertices", 2, [10, 0, 0]), ("vn", "normals", 1, [0, 0, 0])):
        array = np.concatenate([getattr(made, arrays) for made in sample()])
        expected = scale * np.stack([array[:, 2], array[:, 1], -array[:, 0]], -1) + move
        np.testing.assert_allclose([[float(x) for x in line[1:]] for line in lines if line[0] == word], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["tree.ply", "tree", "tree.glb.part"])
def test_other_endings_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^tree: .*choose an ending of \.glb or \.obj$"):
        write_tree(scene_of(sample(), name="tree"), tmp_path / name)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_what_cannot_be_written_leaves_the_folder_as_it_was(ending: str, tmp_path: Path) -> None:
    scene = scene_of(sample(), name="tree")
    with pytest.raises(MissingFileError, match=r"^tree's folder: .*nowhere does not exist"):
        write_tree(scene, tmp_path / "nowhere" / f"tree{ending}")
    for bad, message in (
        (scene_of([], name="tree"), "no triangles"),
        (trimesh.Scene(), "no triangles"),
        (trimesh.Scene(trimesh.creation.box()), "no texture coordinates or no PBR material"),
    ):
        with pytest.raises(InputError, match=message):
            write_tree(bad, tmp_path / f"tree{ending}")
    write_tree(scene, tmp_path / f"tree{ending}")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with full_disk(), pytest.raises(InputError, match=rf"cannot be written \({FULL}\); free the disk"):
        write_tree(scene_of(sample()[:1], name="other"), tmp_path / f"tree{ending}")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_more_than_a_glb_can_hold_is_refused(tmp_path: Path) -> None:
    """Four gigabytes, of one large part that the scene holds under many names."""
    made = sample()[0]
    faces = np.tile(made.faces, (1 + 2**20 // len(made.faces), 1))
    scene = scene_of([replace(made, faces=faces)], name="tree")
    each = made.vertices.nbytes + made.normals.nbytes + made.uvs.nbytes + faces.nbytes
    ((name, mesh),) = scene.geometry.items()
    count = 2**32 // each + 1
    scene.geometry.update({f"{name} {number}": mesh for number in range(count - 1)})
    size = count * each
    with pytest.raises(InputError, match=rf"would have {size:,} bytes, more than a GLB can have; grow less detail or write an \.obj"):
        write_tree(scene, tmp_path / "tree.glb")
