"""Trees and settings that cannot be used: one clear line each, and nothing is written."""

from __future__ import annotations

import base64
import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bbfit.blender import views_folder, worker_scene
from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.checks import InputError, MissingFileError
from bbfit.inputs import LARGEST, SMALLEST
from bbfit.tree_files.tree_file import UP_AXES, TreeFile

from .conftest import FORMATS, SMALL, run_in_blender

CONFIG = ViewsConfig(**SMALL)


def refused(tree: Path, said: str, config: ViewsConfig = CONFIG) -> None:
    """The tree is refused in one line that names it, and no folder is made."""
    out = tree.parent / "never made"
    with pytest.raises(InputError, match=said) as caught:
        render_views(tree, out, config)
    message = str(caught.value)
    assert "\n" not in message and "; " in message and (tree.name in message or "hdri" in said or "device" in said), message
    assert not out.exists()


def glb(content: dict[str, Any], binary: bytes) -> bytes:
    """A binary glTF (glTF 2.0 specification, section 4.4)."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle(positions: np.ndarray, **buffer: Any) -> dict[str, Any]:
    """The JSON of a glTF with one triangle."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, **buffer}],
    }


RIGHT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.glb", b"", "is empty; get the file anew"),
        ("tree.max", b"3DS Max", r"unknown format; expected one of \.glb \.gltf \.obj"),
        ("tree", b"no ending", "unknown format"),
        ("short.glb", glb(triangle(RIGHT), RIGHT.tobytes())[:-10], "is cut short"),
        ("stub.glb", b"glTF", "is cut short"),
        ("text.gltf", b"no glTF at all", "is not a glTF"),
        ("list.gltf", b"[1, 2]", "is not a glTF"),
        ("latin.gltf", b'{"asset": "\xff"}', "is not a glTF"),
    ],
)
def test_files_refused_at_a_glance(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, said)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="does not exist; check the spelling"):
        render_views(tmp_path / "none.glb", tmp_path / "out")
    with pytest.raises(InputError, match="is not a file"):
        render_views(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("ending", [".ply", ".stl", ".obj", ".fbx", ".usda", ".usdc", ".blend", ".glb"])
def test_garbage_is_told(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"garbage{ending}"
    path.write_bytes(b"this is no tree\n" * 20)
    refused(path, "cannot be read|has no faces|is not a glTF")


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".ply", ".stl", ".fbx", ".usdc", ".usdz", ".blend"])
def test_a_file_cut_in_half_is_told(things: Path, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"half{ending}"
    data = (things / f"thing{ending}").read_bytes()
    path.write_bytes(data[: len(data) // 2])
    refused(path, "cannot be read|has no faces|is cut short|is not a glTF|crashed while reading")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_no_numbers(tmp_path: Path, value: float) -> None:
    """Blender's importers put such vertices to the origin in silence; each format is refused all the same."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, value, 3]], float)
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 1, 3], [0, 2, 3]], process=False)
    for ending in ("obj", "stl"):
        with np.errstate(invalid="ignore"):
            mesh.export(str(tmp_path / f"bad.{ending}"))
        refused(tmp_path / f"bad.{ending}", "NaN or infinite")
    for encoding in ("ascii", "binary_little_endian"):
        (tmp_path / f"{encoding}.ply").write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding=encoding))
        refused(tmp_path / f"{encoding}.ply", "NaN or infinite")
    positions = RIGHT.copy()
    positions[2, 1] = value
    (tmp_path / "bad.glb").write_bytes(glb(triangle(positions), positions.tobytes()))
    refused(tmp_path / "bad.glb", "NaN or infinite")


def test_vertices_that_are_no_numbers_in_scene_formats(tmp_path: Path) -> None:
    run_in_blender(
        """
import bpy, os, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
mesh = bpy.data.meshes.new("bad")
mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, float("nan"), 3)], [], [(0, 1, 2), (0, 1, 3)])
bpy.context.scene.collection.objects.link(bpy.data.objects.new("bad", mesh))
bpy.ops.export_scene.fbx(filepath=sys.argv[1] + "/bad.fbx")
bpy.ops.wm.usd_export(filepath=sys.argv[1] + "/bad.usdc")
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1] + "/bad.blend")
sys.stdout.flush()
os._exit(0)
""",
        str(tmp_path),
    )
    for ending in ("fbx", "usdc", "blend"):
        refused(tmp_path / f"bad.{ending}", "NaN or infinite")


def test_nothing_to_see(tmp_path: Path) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused(tmp_path / "points.obj", "has no faces to render; export the tree as a mesh")
    (tmp_path / "speck.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    refused(tmp_path / "speck.obj", "has zero size")
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n")
    refused(tmp_path / "line.obj", "has zero size")


def test_trees_of_an_impossible_size_or_place(tmp_path: Path) -> None:
    """Also in formats whose numbers only Blender reads."""
    assert (worker_scene.SMALLEST, worker_scene.LARGEST) == (SMALLEST, LARGEST)
    for name, length, said in (
        ("large", "1e20", r"reaches 1e\+20 meters from the origin"),
        ("small", "1e-5", "is smaller"),
    ):
        (tmp_path / f"{name}.obj").write_text(f"v 0 0 0\nv {length} 0 0\nv 0 {length} 0\nf 1 2 3\n")
        refused(tmp_path / f"{name}.obj", said)


@pytest.mark.parametrize("kind", ["buffers", "images"])
@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "sub/../../secret.bin",
        "%2e%2e/secret.bin",
        "..%2Fsecret.bin",
        "..\\secret.bin",
        "/etc/hostname",
        "%2Fetc/hostname",
        "file:///etc/hostname",
        "http://example.org/secret.bin",
        "https://example.org/secret.bin",
        "C:\\secret.bin",
        "link.bin",
    ],
)
def test_gltf_references_that_leave_the_folder(tmp_path: Path, kind: str, uri: str) -> None:
    (tmp_path / "secret.bin").write_bytes(RIGHT.tobytes())
    folder = tmp_path / "tree"
    (folder / "sub").mkdir(parents=True)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    content = triangle(RIGHT, uri=uri) if kind == "buffers" else triangle(RIGHT) | {"images": [{"uri": uri}]}
    for name, data in (("tree.gltf", json.dumps(content).encode()), ("tree.glb", glb(content, RIGHT.tobytes()))):
        (folder / name).write_bytes(data)
        refused(folder / name, r"refers to .*, outside its own folder; (export the tree as one \.glb file|put all files into one folder)")


def test_gltf_references_inside_the_folder(tmp_path: Path) -> None:
    """Percent-encoding and folders below are fine; what is referred to counts as part of the tree."""
    (tmp_path / "my parts").mkdir()
    binary = tmp_path / "my parts/tree.bin"
    tree = tmp_path / "tree.gltf"
    tree.write_text(json.dumps(triangle(RIGHT, uri="my%20parts/tree.bin")))
    with pytest.raises(MissingFileError, match=r"refers to my%20parts/tree\.bin, which does not exist"):
        TreeFile.open(tree)
    binary.write_bytes(RIGHT.tobytes())
    before = TreeFile.open(tree)
    assert before.files == (tree, binary) and before.bytes == tree.stat().st_size + binary.stat().st_size
    binary.write_bytes((2 * RIGHT).tobytes())
    assert TreeFile.open(tree).digest != before.digest
    tree.write_text(json.dumps(triangle(RIGHT, uri="data:application/octet-stream;base64," + base64.b64encode(RIGHT.tobytes()).decode())))
    assert TreeFile.open(tree).files == (tree,)
    bad = RIGHT.copy()
    bad[0, 0] = np.nan
    binary.write_bytes(bad.tobytes())
    tree.write_text(json.dumps(triangle(RIGHT, uri="my%20parts/tree.bin")))
    with pytest.raises(InputError, match="NaN or infinite"):
        TreeFile.open(tree)


def test_materials_of_an_obj_are_part_of_the_tree(things: Path) -> None:
    assert [path.suffix for path in TreeFile.open(things / "thing.obj").files] == [".obj", ".mtl"]


def test_textures_of_an_obj_are_part_of_the_tree(things: Path, tmp_path: Path) -> None:
    """However a material names them: with options before the name, with spaces in it, below the folder."""
    tree = tmp_path / "thing.obj"
    tree.write_text("mtllib my materials.mtl\n" + (things / "thing.obj").read_text())
    (tmp_path / "my materials.mtl").write_text(
        "newmtl bark\nmap_Kd -s 1 1 1 bark.png\nnewmtl leaf\nmap_d textures/my leaf.png\nbump none.png\n"
    )
    (tmp_path / "textures").mkdir()
    for name in ("bark.png", "textures/my leaf.png"):
        (tmp_path / name).write_bytes(b"picture")
    before = TreeFile.open(tree)
    assert [path.name for path in before.files] == ["thing.obj", "my materials.mtl", "bark.png", "my leaf.png"]
    (tmp_path / "textures/my leaf.png").write_bytes(b"another")
    assert TreeFile.open(tree).digest != before.digest


def test_every_material_library_of_a_line_is_part_of_the_tree(tmp_path: Path) -> None:
    """The format allows several names after ``mtllib``, and some programs read them all."""
    (tmp_path / "tree.obj").write_text("mtllib bark.mtl leaf.mtl\n")
    for name in ("bark.mtl", "leaf.mtl"):
        (tmp_path / name).write_text("newmtl m\n")
    assert {path.name for path in TreeFile.open(tmp_path / "tree.obj").files} == {"tree.obj", "bark.mtl", "leaf.mtl"}


def test_formats_are_the_tested_ones() -> None:
    assert set(UP_AXES) == set(FORMATS)


def test_unusable_panorama_and_device(thing_glb: Path, tmp_path: Path) -> None:
    (tmp_path / "sky.hdr").write_bytes(b"no sky" * 20)
    tree = tmp_path / "thing.glb"
    tree.write_bytes(thing_glb.read_bytes())
    refused(tree, r"hdri: .*sky\.hdr cannot be read; give an \.hdr or \.exr file", ViewsConfig(**SMALL, hdri=tmp_path / "sky.hdr"))
    refused(tree, "hdri: .*none.hdr does not exist", ViewsConfig(**SMALL, hdri=tmp_path / "none.hdr"))
    refused(tree, "device: this Blender does not support metal; choose another device, or cpu", ViewsConfig(**SMALL, render_device="metal"))


def test_without_blender(thing_glb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bpy", None)  # by which Python says that a module cannot be imported
    with pytest.raises(
        InputError, match=r'bpy is not installed; install bbfit with its extra, pip install "bbfit\[blender\]".*Python 3\.11'
    ):
        render_views(thing_glb, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_importing_loads_no_blender() -> None:
    assert views_folder.__name__ in __import__("sys").modules and "bpy" not in __import__("sys").modules


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"count": 1}, "count: expected at least 2"),
        ({"count": 2, "elevations": (0.0, 10.0, 20.0)}, "count: expected at least one view for each of 3 rings"),
        ({"elevations": ()}, "elevations: expected one or more angles"),
        ({"elevations": (91.0,)}, "elevations: expected a value in"),
        ({"size": 0}, "size: expected at least 11"),
        ({"size": 64.0}, "size: expected a whole number"),
        ({"fov_degrees": 180.0}, "fov_degrees: expected"),
        ({"samples": 0}, "samples: expected at least 1"),
        ({"sun_strength": -1.0}, "sun_strength: expected"),
        ({"ambient_strength": float("nan")}, "ambient_strength: expected"),
        ({"render_device": "gpu"}, "render_device: expected one of cpu, cuda"),
        ({"render_workers": 0}, "render_workers: expected at least 1"),
        ({"seed": -1}, "seed: expected at least 0"),
        ({"axis": "trunk"}, "axis: expected one of auto, origin, center"),
    ],
)
def test_settings_are_checked(setting: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        ViewsConfig(**setting)
