"""Exported models: what a file shows is what was fitted, and other programs accept it."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from glb_viewer import read_glb, view_glb
from khronos import reports
from PIL import Image
from reload import rebuild

from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import texel_to_world
from bbfit.operators.drawing.reference import render_reference

KINDS = ("one", "two", "mixed")

# Rounding to 8 bits moves straight color and alpha by at most 0.5 / 255 each. A layer's share of a pixel is
# color * alpha + (1 - alpha) * behind, so a pixel moves by at most 1 / 255 a layer, alpha by half of that; three layers here. Vertices
# are float32, which moves a picture by far less.
ALLOWED_COLOR, ALLOWED_ALPHA = 3 / 255, 1.5 / 255


def load_glb(path: Path) -> BillboardCloud:
    """As trimesh reads it."""
    scene = trimesh.load_scene(path, process=False)
    corners, uvs, culled = [], [], []
    for mesh in scene.geometry.values():
        corners.append(np.asarray(mesh.vertices).reshape(-1, 4, 3))
        uvs.append(np.stack([mesh.visual.uv[:, 0], 1 - mesh.visual.uv[:, 1]], -1).reshape(-1, 4, 2))
        culled.append(np.full(len(corners[-1]), not mesh.visual.material.doubleSided))
        image = np.array(mesh.visual.material.baseColorTexture)
    return rebuild(np.concatenate(corners), np.concatenate(uvs), np.concatenate(culled), image)


def load_obj(path: Path, two_sided: bool) -> BillboardCloud:
    mesh = trimesh.load_mesh(path, process=False)
    assert len(mesh.vertices) == 4 * len(mesh.faces) // 2
    uvs = np.stack([mesh.visual.uv[:, 0], 1 - mesh.visual.uv[:, 1]], -1).reshape(-1, 4, 2)
    corners = np.asarray(mesh.vertices).reshape(-1, 4, 3)
    image = np.array(mesh.visual.material.image)
    return rebuild(corners, uvs, np.full(len(corners), two_sided), image)


def in_file_order(cloud: BillboardCloud) -> BillboardCloud:
    """One-sided billboards come first in a GLB."""
    order = torch.argsort(cloud.two_sided.long(), stable=True)
    textures = cloud.textures()
    return BillboardCloud(
        *(getattr(cloud, name)[order] for name in ("centers", "rights", "ups", "half_extents", "texture_sizes", "two_sided")),
        torch.cat([textures[n].reshape(-1, 4) for n in order.tolist()]),
    )


def assert_same(original: BillboardCloud, reloaded: BillboardCloud, camera: Camera) -> None:
    for name in ("centers", "rights", "ups", "half_extents"):
        torch.testing.assert_close(getattr(reloaded, name), getattr(original, name), rtol=0, atol=2e-6)  # float32
    assert torch.equal(reloaded.texture_sizes, original.texture_sizes)
    assert torch.equal(reloaded.two_sided, original.two_sided)
    assert (reloaded.texels - original.texels).abs().max() <= 0.5 / 255 + 1e-9
    difference = (render_reference(reloaded, camera) - render_reference(original, camera)).abs()
    assert difference[..., :3].max() <= ALLOWED_COLOR  # measured 0.6 / 255
    assert difference[..., 3].max() <= ALLOWED_ALPHA  # measured 0.5 / 255


@pytest.mark.parametrize("kind", KINDS)
def test_reloaded_glb_is_the_cloud(kind: str, clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    (path,) = export(clouds[kind], tmp_path / "model.glb")
    assert_same(in_file_order(clouds[kind]), load_glb(path), orbit)


@pytest.mark.parametrize("kind", ["one", "two"])
def test_reloaded_obj_is_the_cloud(kind: str, clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    files = export(clouds[kind], tmp_path / "model.obj")
    assert [file.name for file in files] == ["model.obj", "model.mtl", "model.png"]
    assert_same(clouds[kind], load_obj(files[0], kind == "two"), orbit)


@pytest.mark.parametrize("kind", KINDS)
def test_a_viewer_shows_the_render(kind: str, clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    """By the glTF specification alone: culling, texture coordinates, filtering, the fade at the rim."""
    (path,) = export(clouds[kind], tmp_path / "model.glb")
    expected = render_reference(clouds[kind], orbit).numpy()
    assert expected[..., 3].max(axis=(1, 2)).min() > 0.5, "an empty view shows nothing"
    for index in range(len(orbit)):
        difference = abs(view_glb(path, orbit[index]) - expected[index])
        assert difference[..., :3].max() <= ALLOWED_COLOR  # measured 0.6 / 255
        assert difference[..., 3].max() <= ALLOWED_ALPHA  # measured 0.5 / 255


def test_transparent_texels_change_color_only_at_the_silhouette(crossed: BillboardCloud, orbit: Camera, tmp_path: Path) -> None:
    """Hidden colors are replaced: alpha stays, color moves by at most u (1 - u) <= 1/4 a layer, u being the hidden texels' weight."""
    hidden = crossed.texels[:, 3] * 255 < 0.5
    assert 0.2 < hidden.float().mean() < 0.8
    (path,) = export(crossed, tmp_path / "model.glb", ExportConfig(outline="rectangle"))
    reloaded = load_glb(path).to(torch.float32)
    difference = (render_reference(reloaded, orbit) - render_reference(crossed, orbit)).abs()
    assert difference[..., 3].max() <= 2 * 0.5 / 255 + 1e-5
    assert difference[..., :3].max() <= 2 * (0.25 + 1 / 255)
    # Exporting what was exported changes nothing more.
    (again,) = export(reloaded, tmp_path / "again.glb")
    np.testing.assert_array_equal(read_glb(again)[2], read_glb(path)[2])


@pytest.mark.parametrize("kind", KINDS)
def test_mask_cuts_where_alpha_reaches_the_cutoff(kind: str, clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    (path,) = export(clouds[kind], tmp_path / "model.glb", ExportConfig(alpha="mask", alpha_cutoff=0.25))
    for primitive in read_glb(path)[1]:
        assert primitive.material["alphaMode"] == "MASK" and primitive.material["alphaCutoff"] == 0.25
    assert set(np.unique(view_glb(path, orbit[0])[..., 3])) == {0.0, 1.0}


@pytest.mark.parametrize("kind", KINDS)
def test_quads_are_the_rectangles(kind: str, clouds: dict[str, BillboardCloud], tmp_path: Path) -> None:
    """Corners half a texel outside the rectangles, in the cloud's own meters; winding and normals agree; nothing merged or split.

    Without light, a model has no normals.
    """
    cloud = in_file_order(clouds[kind])
    (path,) = export(clouds[kind], tmp_path / "model.glb")
    tree, primitives, _ = read_glb(path)
    _, lit, _ = read_glb(export(clouds[kind], tmp_path / "lit.glb", ExportConfig(material="pbr"))[0])
    positions = np.concatenate([primitive.positions for primitive in primitives])
    assert len(positions) == cloud.vertex_count
    quad = 0
    for n, (height, width) in enumerate(cloud.texture_sizes.tolist()):
        texels = torch.tensor([[-1.0, height, 1], [width, height, 1], [width, -1, 1], [-1, -1, 1]], dtype=torch.float64)
        corners = (texels @ texel_to_world(cloud)[n].mT)[:, :3].numpy()
        for _ in range(1 + int(cloud.two_sided[n])):
            found = positions[4 * quad : 4 * quad + 4]
            nearest = np.linalg.norm(found[:, None] - corners, axis=-1).argmin(-1)
            assert sorted(nearest) == [0, 1, 2, 3]
            np.testing.assert_allclose(found, corners[nearest], rtol=0, atol=1e-6)
            quad += 1
    culled = []
    for primitive, with_normals in zip(primitives, lit, strict=True):
        assert primitive.normals is None and with_normals.normals is not None
        np.testing.assert_array_equal(primitive.positions, with_normals.positions)
        np.testing.assert_array_equal(primitive.triangles, with_normals.triangles)
        a, b, c = (primitive.positions[primitive.triangles[:, i]] for i in range(3))
        winding = np.cross(b - a, c - a)
        winding /= np.linalg.norm(winding, axis=-1, keepdims=True)
        for i in range(3):
            np.testing.assert_allclose(with_normals.normals[primitive.triangles[:, i]], winding, rtol=0, atol=1e-5)
        sides = -1 if not primitive.material["doubleSided"] else 1
        chosen = cloud.two_sided if sides == -1 else ~cloud.two_sided
        expected = cloud.normals[chosen].repeat_interleave(2 if sides == -1 else 1, 0).numpy().copy()
        if sides == -1:
            expected[1::2] *= -1
        np.testing.assert_allclose(with_normals.normals[::4], expected, rtol=0, atol=1e-6)
        culled.append(sides == -1)
    assert culled == sorted({bool(two) for two in cloud.two_sided})
    assert tree["asset"]["generator"].startswith("bbfit")
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert {node["name"] for node in tree["nodes"]} <= {"billboards", "billboards_two_sided"}


def test_khronos_validator_finds_nothing(clouds: dict[str, BillboardCloud], crossed: BillboardCloud, tmp_path: Path) -> None:
    files = []
    for (kind, cloud), alpha in itertools.product({**clouds, "crossed": crossed}.items(), ("blend", "mask")):
        files += export(cloud, tmp_path / f"{kind}_{alpha}.glb", ExportConfig(alpha=alpha))  # type: ignore[arg-type]
    assert len(files) == 8
    for file, report in zip(files, reports(*files), strict=True):
        issues = report["issues"]
        assert (issues["numErrors"], issues["numWarnings"], issues["numHints"]) == (0, 0, 0), (file.name, issues["messages"])
        # An atlas is no larger than it must be, so its sides are seldom powers of two; the validator notes that as information.
        assert {message["code"] for message in issues["messages"]} <= {"IMAGE_NPOT_DIMENSIONS"}


def test_obj_says_what_it_can(clouds: dict[str, BillboardCloud], tmp_path: Path) -> None:
    model, material, texture = export(clouds["mixed"], tmp_path / "a tree.obj", ExportConfig(up="z"))
    assert "mtllib a tree.mtl\n" in model.read_text() and "culling" in model.read_text()
    assert {"map_Kd a tree.png", "map_d a tree.png", "illum 0"} <= set(material.read_text().splitlines())
    (glb,) = export(clouds["mixed"], tmp_path / "model.glb")
    np.testing.assert_array_equal(np.array(Image.open(texture).convert("RGBA")), read_glb(glb)[2])
    z_up, y_up = (
        np.array([line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v ")], float)
        for path in (model, export(clouds["mixed"], tmp_path / "y.obj")[0])
    )
    np.testing.assert_array_equal(z_up, np.stack([y_up[:, 0], -y_up[:, 2], y_up[:, 1]], -1))
    normals = np.array([line.split()[1:] for line in model.read_text().splitlines() if line.startswith("vn ")], float)
    winding = np.cross(z_up[1::4] - z_up[::4], z_up[2::4] - z_up[::4])
    np.testing.assert_allclose(winding / np.linalg.norm(winding, axis=-1, keepdims=True), normals, rtol=0, atol=1e-7)
    assert len(z_up) == clouds["mixed"].vertex_count


def test_float32_coordinates_survive_obj(crossed: BillboardCloud, tmp_path: Path) -> None:
    far = BillboardCloud(**{**vars(crossed), "centers": crossed.centers + torch.tensor([1234.567, 0.0123, -7.7])})
    (glb,), (obj, *_) = export(far, tmp_path / "m.glb"), export(far, tmp_path / "m.obj")
    lines = [line.split()[1:] for line in obj.read_text().splitlines() if line.startswith("v ")]
    np.testing.assert_array_equal(np.array(lines, float).astype(np.float32), read_glb(glb)[1][0].positions.astype(np.float32))


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_same_cloud_same_bytes(suffix: str, clouds: dict[str, BillboardCloud], tmp_path: Path) -> None:
    first, second = (tmp_path / "1", tmp_path / "2")
    for folder in (first, second):
        folder.mkdir()
        export(clouds["mixed"], folder / f"model.{suffix}")
    for file in first.iterdir():
        assert file.read_bytes() == (second / file.name).read_bytes()


def test_bad_input_leaves_files_alone(clouds: dict[str, BillboardCloud], tmp_path: Path) -> None:
    (path,) = export(clouds["one"], tmp_path / "model.glb")
    before = path.read_bytes()
    cloud = clouds["one"]
    with pytest.raises(InputError, match=r"\.glb or \.obj"):
        export(cloud, tmp_path / "model.fbx")
    with pytest.raises(MissingFileError, match="does not exist"):
        export(cloud, tmp_path / "nowhere" / "model.glb")
    with pytest.raises(InputError, match="nothing to export"):
        empty = torch.zeros(0, 3)
        none = BillboardCloud(empty, empty, empty, torch.zeros(0, 2), torch.zeros(0, 2).long(), torch.zeros(0).bool(), torch.zeros(0, 4))
        export(none, path)
    for name in ("texels", "centers"):
        broken = BillboardCloud(**{**vars(cloud), name: getattr(cloud, name).clone().fill_(float("nan"))})
        with pytest.raises(InputError, match=f"{name} are not all finite"):
            export(broken, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["model.glb"]


@pytest.mark.parametrize("bad", [{"padding": 0}, {"up": "x"}])
def test_config_is_checked(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        ExportConfig(**bad)  # type: ignore[arg-type]
