"""Materials of simplified trees: what trimesh and Blender leave out, colors of vertices, pictures, and their sizes."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from khronos import messages
from PIL import Image
from trimesh.visual.material import PBRMaterial

from bbfit.blender.conversion import tree_as_glb
from bbfit.checks import InputError
from bbfit.glb import joined_glb, split_glb
from bbfit.images import srgb_to_linear
from bbfit.rivals.decimation import TooSmallError, decimate
from bbfit.rivals.draco import draco_size
from bbfit.rivals.height_fields import height_fields
from bbfit.tree_files.gltf_materials import TRANSMISSION, pictures_size, transmits
from bbfit.tree_files.tree_file import TreeFile

COLOR = [0.0437, 0.1521, 0.0519, 1.0]
SHARED = {"diffuseTransmissionFactor": 0.58, "diffuseTransmissionColorFactor": [0.06, 0.15, 0.05]}


def picture(kind: str = "PNG", size: int = 128) -> Image.Image:
    """A noisy picture whose left half is transparent, unless it is a JPEG."""
    texels = np.random.default_rng(0).integers(0, 256, (size, size, 4)).astype(np.uint8)
    texels[..., 3] = 255
    texels[:, : size // 2, 3] = 0
    data = io.BytesIO()
    Image.fromarray(texels).convert("RGBA" if kind == "PNG" else "RGB").save(data, kind)
    return Image.open(data)


def ball(material: PBRMaterial | None = None, colors: list[int] | None = None) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(3)
    if colors is not None:
        mesh.visual = trimesh.visual.ColorVisuals(vertex_colors=np.tile(np.array(colors, np.uint8), (len(mesh.vertices), 1)))
    else:
        mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2] / 2 + 0.5, material=material)
    return mesh


def leaf(path: Path, *, textured: bool) -> Path:
    """A ball whose material transmits light, with a share from a texture on request."""
    material = PBRMaterial(name="leaf", baseColorTexture=picture() if textured else None, metallicFactor=0.0)
    tree, contents = split_glb(ball(material).export(file_type="glb"))
    values: dict[str, Any] = dict(SHARED)
    if textured:
        values["diffuseTransmissionTexture"] = {"index": 0}
    tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = COLOR
    tree["materials"][0]["extensions"] = {TRANSMISSION: values}
    tree["extensionsUsed"] = [TRANSMISSION]
    path.write_bytes(joined_glb(tree, contents))
    return path


def converted(tree: Path) -> bytes:
    return tree_as_glb(tree, tree.with_name("converted.glb"), triangles=400).read_bytes()


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("simplify", [lambda tree: decimate(tree, vertices=100).glb, lambda tree: height_fields(tree, 0.1).glb, converted])
def test_simplified_leaves_transmit_light_as_before(simplify: Callable[[Path], bytes], textured: bool, tmp_path: Path) -> None:
    tree = leaf(tmp_path / "leaf.glb", textured=textured)
    assert transmits(TreeFile.open(tree))
    made = tmp_path / "made.glb"
    made.write_bytes(simplify(tree))
    content, views = split_glb(made.read_bytes())
    (material,) = content["materials"]
    values = material["extensions"][TRANSMISSION]
    assert {name: values[name] for name in SHARED} == SHARED and TRANSMISSION in content["extensionsUsed"]
    assert not [found for found in messages(made) if found["severity"] == 0]
    if not textured:
        np.testing.assert_allclose(material["pbrMetallicRoughness"]["baseColorFactor"], COLOR, atol=1e-6)
    elif "diffuseTransmissionTexture" in values:  # height fields have no coordinates
        stored = content["images"][content["textures"][values["diffuseTransmissionTexture"]["index"]]["source"]]
        assert np.array_equal(np.array(Image.open(io.BytesIO(views[stored["bufferView"]]))), np.array(picture()))


def test_vertices_keep_their_colors(tmp_path: Path) -> None:
    ball(colors=[200, 30, 30, 255]).export(tmp_path / "red.glb")
    for made in (decimate(tmp_path / "red.glb", vertices=100).glb, height_fields(tmp_path / "red.glb", 0.1).glb):
        (mesh,) = trimesh.load_scene(io.BytesIO(made), file_type="glb", process=False).geometry.values()
        colors = mesh.visual.vertex_colors if hasattr(mesh.visual, "vertex_colors") else mesh.visual.material.baseColorFactor
        assert np.unique(np.atleast_2d(colors), axis=0).tolist() == [[200, 30, 30, 255]]


@pytest.mark.parametrize("mode", ["OPAQUE", "MASK"])
def test_a_height_field_has_the_mean_color_of_its_texture_in_linear_light(mode: str, tmp_path: Path) -> None:
    tint = [128, 255, 64, 255]
    ball(PBRMaterial(name="leaf", baseColorTexture=picture(), baseColorFactor=tint, alphaMode=mode)).export(tmp_path / "leaf.glb")
    (mesh,) = trimesh.load_scene(io.BytesIO(height_fields(tmp_path / "leaf.glb", 0.1).glb), file_type="glb").geometry.values()
    texels = np.array(picture()).reshape(-1, 4)
    shown = texels[:, :3] if mode == "OPAQUE" else texels[texels[:, 3] > 0, :3]
    expected = srgb_to_linear(shown / 255.0).mean(0) * tint[:3]
    np.testing.assert_allclose(mesh.visual.material.baseColorFactor[:3], expected, atol=1)
    assert mesh.visual.material.baseColorTexture is None


def test_an_obj_is_no_metal(tmp_path: Path) -> None:
    """Its colors count once: Blender does not multiply a picture by Kd."""
    picture().save(tmp_path / "leaf.png")
    (tmp_path / "tree.mtl").write_text("newmtl leaf\nKd 0.5 0.5 0.5\nmap_Kd leaf.png\nnewmtl bark\nKd 0.2 0.4 0.6\n")
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "tree.obj").write_text(f"mtllib tree.mtl\n{square}usemtl leaf\nf 1/1 2/2 3/3\nusemtl bark\nf 1/1 3/3 4/4\n")
    content, _ = split_glb(decimate(tmp_path / "tree.obj", vertices=100).glb)
    leaf, bark = sorted(content["materials"], key=lambda material: "baseColorTexture" not in material["pbrMetallicRoughness"])
    assert [material["pbrMetallicRoughness"]["metallicFactor"] for material in (leaf, bark)] == [0, 0]
    assert leaf["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1, 1]) == [1, 1, 1, 1]
    np.testing.assert_allclose(bark["pbrMetallicRoughness"]["baseColorFactor"], [0.2, 0.4, 0.6, 1.0], atol=1 / 255)
    assert pictures_size(TreeFile.open(tmp_path / "tree.obj")) == (tmp_path / "leaf.png").stat().st_size


def test_pictures_count_as_they_are_stored(tmp_path: Path) -> None:
    """A JPEG stays one, and a picture that materials share counts once; Draco compresses neither."""
    for name in ("png", "jpeg"):
        shown = picture(name.upper())
        scene = trimesh.Scene([ball(PBRMaterial(name=f"leaf {number}", baseColorTexture=shown)) for number in range(2)])
        (tmp_path / f"{name}.glb").write_bytes(scene.export(file_type="glb"))
    for name in ("png", "jpeg"):
        tree = TreeFile.open(tmp_path / f"{name}.glb")
        content, views = split_glb((tmp_path / f"{name}.glb").read_bytes())
        assert {entry["mimeType"] for entry in content["images"]} == {f"image/{name}"}
        (size,) = {len(views[entry["bufferView"]]) for entry in content["images"]}
        assert pictures_size(tree) == size
        assert size < draco_size(tree).bytes < size + 10_000
        made, _ = split_glb(decimate(tree, vertices=200).glb)
        assert {entry["mimeType"] for entry in made["images"]} == {f"image/{name}"}
        assert len({entry["bufferView"] for entry in made["images"]}) == 1


def test_textures_beyond_the_limit_are_said(tmp_path: Path) -> None:
    ball(PBRMaterial(name="leaf", baseColorTexture=picture())).export(tmp_path / "leaf.glb")
    with pytest.raises(TooSmallError, match=r"within the limit: of 10,000 bytes, materials and textures take [\d,]+$"):
        decimate(tmp_path / "leaf.glb", size=10_000)
    assert issubclass(TooSmallError, InputError)
