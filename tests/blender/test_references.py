"""Files that a tree refers to: all of them count, those elsewhere are refused, and devices are never opened."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from bbfit.blender.config import ViewsConfig
from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.views_folder import render_views
from bbfit.checks import InputError
from bbfit.inputs import InputLimits
from bbfit.tree_files.tree_file import TreeFile

from .conftest import SMALL, run_in_blender

# A cube with a texture in every format that keeps it in a file of its own, a .blend that links another, and a USD with a sublayer.
MAKE = """
import bpy, os, sys
folder = sys.argv[1]
os.makedirs(folder + "/textures")
bpy.ops.wm.read_factory_settings(use_empty=True)
picture = bpy.data.images.new("leaf", 4, 4, alpha=True)
picture.pixels[:] = [0, 1, 0, 1] * 16
picture.filepath_raw, picture.file_format = folder + "/textures/leaf.png", "PNG"
picture.save()
bpy.ops.mesh.primitive_cube_add()
material = bpy.data.materials.new("leaf")
material.use_nodes = True
node = material.node_tree.nodes.new("ShaderNodeTexImage")
node.image = bpy.data.images.load(folder + "/textures/leaf.png")
material.node_tree.links.new(node.outputs[0], material.node_tree.nodes["Principled BSDF"].inputs[0])
bpy.context.object.data.materials.append(material)
bpy.ops.wm.save_as_mainfile(filepath=folder + "/library.blend", compress=False)
bpy.ops.export_scene.fbx(filepath=folder + "/tree.fbx", path_mode="RELATIVE")
bpy.ops.wm.obj_export(filepath=folder + "/tree.obj", path_mode="RELATIVE")
for ending in ("usda", "usdc"):
    bpy.ops.wm.usd_export(filepath=folder + "/tree." + ending, export_textures_mode="KEEP", relative_paths=True)
bpy.ops.wm.usd_export(filepath=folder + "/tree.usdz")
with open(folder + "/layers.usda", "w") as file:
    file.write('#usda 1.0\\n(\\n defaultPrim = "root"\\n subLayers = [@./tree.usdc@]\\n upAxis = "Z"\\n)\\n')
bpy.ops.wm.read_factory_settings(use_empty=True)
with bpy.data.libraries.load(folder + "/library.blend", link=True, relative=True) as (source, linked):
    linked.objects = list(source.objects)
for item in linked.objects:
    bpy.context.scene.collection.objects.link(item)
bpy.ops.wm.save_as_mainfile(filepath=folder + "/tree.blend", compress=True)
os._exit(0)
"""
TEXTURE = "textures/leaf.png"
FILES = {
    "tree.obj": ["tree.mtl", TEXTURE],
    "tree.fbx": [TEXTURE],
    "tree.usda": [TEXTURE],
    "tree.usdc": [TEXTURE],
    "tree.usdz": [],
    "layers.usda": ["tree.usdc", TEXTURE],
    "library.blend": [TEXTURE],
    "tree.blend": ["library.blend", TEXTURE],
}


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("references") / "trees"
    folder.mkdir()
    run_in_blender(MAKE, str(folder))
    return folder


@pytest.fixture
def trees(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "trees"))


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_a_tree_refers_to_counts(trees: Path, name: str) -> None:
    tree = TreeFile.open(trees / name)
    assert [file.relative_to(trees).as_posix() for file in tree.files] == [name, *FILES[name]]
    for file in FILES[name]:
        with (trees / file).open("ab") as changed:
            changed.write(b"\n")
        again = TreeFile.open(trees / name)
        assert again.digest != tree.digest and again.files == tree.files
        tree = again


@pytest.mark.parametrize("name", FILES)
def test_blender_reads_no_other_file(trees: Path, name: str, tmp_path: Path) -> None:
    assert tree_as_glb(trees / name, tmp_path / "tree.glb").stat().st_size > 1000


def test_a_replaced_texture_refuses_earlier_views(trees: Path, tmp_path: Path) -> None:
    config = ViewsConfig(**SMALL | {"count": 2})
    render_views(trees / "tree.blend", tmp_path / "views", config)
    (trees / TEXTURE).unlink()
    shutil.copy(trees.parent / "views" / "images" / "0000.png", trees / TEXTURE)
    with pytest.raises(InputError, match=r"contains pictures of an earlier version of tree\.blend"):
        render_views(trees / "tree.blend", tmp_path / "views", config)


def check_refused_unless_allowed(tree: Path, allowed: Path) -> None:
    with pytest.raises(InputError, match=r"^tree: .* refers to .*leaf\.png, outside its own folder; .*--allow-folders"):
        TreeFile.open(tree)
    opened = TreeFile.open(tree, InputLimits(allow_folders=(allowed,)))
    assert [file.name for file in opened.files][-1] == "leaf.png"


@pytest.mark.parametrize("name", [name for name, files in FILES.items() if files])
def test_a_symbolic_link_to_a_file_elsewhere_is_refused_unless_its_folder_is_allowed(trees: Path, name: str) -> None:
    elsewhere = trees.parent / "elsewhere"
    elsewhere.mkdir()
    (trees / TEXTURE).rename(elsewhere / "leaf.png")
    (trees / TEXTURE).symlink_to(elsewhere / "leaf.png")
    check_refused_unless_allowed(trees / name, elsewhere)


@pytest.mark.parametrize("name", ["tree.obj", "tree.usda"])
def test_a_path_out_of_the_folder_is_refused_unless_its_folder_is_allowed(trees: Path, name: str) -> None:
    (trees / "inner").mkdir()
    for file in (trees / name, trees / "tree.mtl"):
        text = file.read_text().replace("./textures/leaf.png", "textures/leaf.png").replace("textures/leaf.png", "../textures/leaf.png")
        (trees / "inner" / file.name).write_text(text)
    check_refused_unless_allowed(trees / "inner" / name, trees / "textures")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("a.mtl", "newmtl a\nmap_Kd {}\n"),
        ("a.mtl", "newmtl a\nmap_Kd -s 1 1 1 {}\n"),
        ("a.usda", "#usda 1.0\n(\n subLayers = [@{}@]\n)\n"),
        ("a.usda", '#usda 1.0\ndef Xform "a" (references = @{}@) {{}}\n'),
        ("a.fbx", '; FBX 7.4.0 project file\nVideo: {{ RelativeFilename: "{}" }}\n'),
        ("a.gltf", '{{"asset": {{"version": "2.0"}}, "buffers": [{{"uri": "{}", "byteLength": 4}}]}}'),
    ],
)
@pytest.mark.parametrize("target", ["/dev/zero", "pipe", "../secret", "/etc/hostname"])
def test_devices_pipes_and_secrets_are_not_opened(tmp_path: Path, name: str, text: str, target: str) -> None:
    folder = tmp_path / "trees"
    folder.mkdir()
    (tmp_path / "secret").write_text("secret")
    os.mkfifo(folder / "pipe")
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / name).write_text(text.format(target))
    tree = folder / ("a.obj" if name == "a.mtl" else name)
    said = "is a device or a pipe" if target == "pipe" else "outside its own folder"
    with pytest.raises(InputError, match=rf"^tree: .* refers to .*{target}, .*{said}"):
        TreeFile.open(tree)


def test_a_device_within_an_allowed_folder_is_not_opened(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib /dev/zero\nv 0 0 0\n")
    with pytest.raises(InputError, match="is a device or a pipe"):
        TreeFile.open(tmp_path / "a.obj", InputLimits(allow_folders=(Path("/dev"),)))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("tree.obj", None),
        ("tree.blend", None),
        ("tree.obj", b"garbage"),
        ("tree.fbx", b"garbage"),
        ("tree.usda", b"garbage"),
        ("tree.blend", b"garbage"),
    ],
)
def test_a_picture_that_is_missing_or_damaged_is_named(trees: Path, tmp_path: Path, name: str, content: bytes | None) -> None:
    """Blender would show the material in magenta."""
    (trees / TEXTURE).unlink()
    if content is not None:
        (trees / TEXTURE).write_bytes(content)
    with pytest.raises(InputError, match=r"leaf.* is missing or cannot be read; put the picture where"):
        render_views(trees / name, tmp_path / "views", ViewsConfig(**SMALL))


def test_a_damaged_usd_or_blend_is_refused_in_one_line(trees: Path) -> None:
    for name in ("tree.usdc", "tree.usdz", "tree.usda", "tree.blend", "library.blend"):
        data = (trees / name).read_bytes()
        for damaged in (data[: len(data) // 3], data[:7] + b"\xff" * 200 + data[207:]):
            (trees / name).write_bytes(damaged)
            with pytest.raises(InputError) as caught:
                TreeFile.open(trees / name)
            assert "\n" not in str(caught.value) and name in str(caught.value)
        (trees / name).write_bytes(data)


def test_udim_tiles_count(tmp_path: Path) -> None:
    for tile in (1001, 1002):
        (tmp_path / f"leaf.{tile}.png").write_bytes(b"x")
    (tmp_path / "leaf.final.png").write_bytes(b"x")
    (tmp_path / "a.mtl").write_text("map_Kd leaf.<UDIM>.png\n")
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    assert [file.name for file in TreeFile.open(tmp_path / "a.obj").files] == ["a.obj", "a.mtl", "leaf.1001.png", "leaf.1002.png"]
