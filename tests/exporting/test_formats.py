"""What a GLB may hold beside the plain export: other alpha modes, other textures, split nodes, outlines; and bad wishes."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from khronos import messages
from PIL import Image
from scipy import ndimage

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export, shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import joined_glb, split_glb


def tree_of(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    return split_glb(path.read_bytes())


@pytest.mark.parametrize(
    ("fitted", "config", "expected"),
    [
        (AlphaMode("mask", 0.3), ExportConfig(), ("MASK", 0.3)),
        (AlphaMode("blend"), ExportConfig(), ("BLEND", None)),
        (AlphaMode("hash"), ExportConfig(), ("BLEND", None)),
        (AlphaMode("coverage", 0.4), ExportConfig(), ("MASK", 0.4)),
        (AlphaMode("coverage", 0.4), ExportConfig(profile="vtk"), ("BLEND", None)),
        (AlphaMode("blend", 0.4), ExportConfig(alpha="coverage"), ("MASK", 0.4)),
        (AlphaMode("mask", 0.3), ExportConfig(alpha="blend"), ("BLEND", None)),
        (AlphaMode("blend"), ExportConfig(alpha="mask", alpha_cutoff=0.7), ("MASK", 0.7)),
        (AlphaMode("mask", 0.3), ExportConfig(alpha_cutoff=0.6), ("MASK", 0.6)),
    ],
)
def test_a_file_has_the_mode_that_its_cloud_was_fitted_for_unless_another_is_asked(
    crossed: BillboardCloud, tmp_path: Path, fitted: AlphaMode, config: ExportConfig, expected: tuple[str, float | None]
) -> None:
    cloud = replace(crossed, alpha=fitted)
    (path,) = export(cloud, tmp_path / "model.glb", config)
    (material,) = tree_of(path)[0]["materials"]
    assert (material["alphaMode"], material.get("alphaCutoff")) == expected
    shipped = shipped_model(cloud, config).cloud.alpha
    assert ("MASK" if shipped.tested else "BLEND") == expected[0]
    assert not shipped.tested or shipped.cutoff == expected[1]
    assert material.get("extras") == {"hash": {"alphaMode": "HASH"}, "coverage": {"alphaMode": "COVERAGE"}}.get(shipped.kind)


@pytest.mark.parametrize("fallback", [True, False])
@pytest.mark.parametrize(("textures", "extension"), [("webp", "EXT_texture_webp"), ("ktx2", "KHR_texture_basisu")])
def test_other_textures_stand_beside_png_or_in_its_place(
    crossed: BillboardCloud, tmp_path: Path, textures: str, extension: str, fallback: bool
) -> None:
    config = ExportConfig(textures=textures, fallback=fallback)  # type: ignore[arg-type]
    (path,) = export(crossed, tmp_path / "model.glb", config)
    tree, views = tree_of(path)
    (texture,) = tree["textures"]
    assert (texture.get("source") == 0) == fallback and extension in tree["extensionsUsed"]
    assert tree.get("extensionsRequired", []) == ([] if fallback else [extension])
    image = tree["images"][texture["extensions"][extension]["source"]]
    data = views[image["bufferView"]]
    assert image["mimeType"] == f"image/{textures}" and len(tree["images"]) == 1 + fallback
    atlas = shipped_model(crossed, config).cards.atlas.image
    if textures == "webp":
        np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(data))), atlas)  # colors of transparent texels as well
    else:
        assert data.startswith(b"\xabKTX 20\xbb\r\n\x1a\n")
    assert tree["samplers"][0]["minFilter"] == 9987
    if fallback:
        np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(views[tree["images"][0]["bufferView"]]))), atlas)
    # The validator does not know what KTX2 pictures are.
    codes = {message["code"] for message in messages(path) if message["severity"] < 2}
    assert codes <= ({"VALUE_NOT_IN_LIST", "IMAGE_UNRECOGNIZED_FORMAT"} if textures == "ktx2" else set())


@pytest.mark.parametrize(
    ("alpha", "config", "expected"),
    [
        (AlphaMode("mask", 0.25), ExportConfig(), 9987),
        (AlphaMode("mask", 0.26), ExportConfig(), 9729),
        (AlphaMode("mask", 0.26), ExportConfig(textures="ktx2"), 9987),
        (AlphaMode("mask", 0.26), ExportConfig(textures="ktx2", mipmaps=False), 9729),
        (AlphaMode("mask", 0.26), ExportConfig(alpha="blend"), 9987),
        (AlphaMode("mask"), ExportConfig(mipmaps=True), 9987),
        (AlphaMode("blend"), ExportConfig(mipmaps=False), 9729),
        (AlphaMode("hash"), ExportConfig(), 9987),
        (AlphaMode("coverage"), ExportConfig(), 9987),
    ],
)
def test_the_sampler_reads_mip_levels_where_leaves_survive_them(
    crossed: BillboardCloud, tmp_path: Path, alpha: AlphaMode, config: ExportConfig, expected: int
) -> None:
    (path,) = export(replace(crossed, alpha=alpha), tmp_path / "model.glb", config)
    assert tree_of(path)[0]["samplers"][0]["minFilter"] == expected


def test_split_nodes_stand_at_their_origins_and_their_bounds_are_centerd_there(crossed: BillboardCloud, tmp_path: Path) -> None:
    config = ExportConfig(alpha="blend", split=True)
    (path,) = export(crossed, tmp_path / "model.glb", config)
    tree, _ = tree_of(path)
    cards = shipped_model(crossed, config).cards
    placed = [node for node in tree["nodes"] if "mesh" in node]
    assert len(placed) == len(cards.nodes) > 1 and len(cards.cards) > len(crossed)
    vertices = 0
    for node, (card, *_) in zip(placed, cards.nodes, strict=True):
        assert card.origin is not None
        place = node.get("translation") or np.array(node["matrix"])[12:15]
        np.testing.assert_allclose(place, card.origin, atol=1e-6)
        accessor = tree["accessors"][tree["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"]]
        np.testing.assert_allclose(np.add(accessor["min"], accessor["max"]), 0, atol=1e-5)
        vertices += accessor["count"]
    assert vertices == cards.vertex_count
    assert not messages(path)


def test_nodes_have_equal_spheres_and_both_sides_where_programs_need_them(crossed: BillboardCloud, tmp_path: Path) -> None:
    """CesiumJS culls nothing that is blended, and sorts by the nearest points of spheres."""
    (path,) = export(crossed, tmp_path / "tree.glb", ExportConfig(profile="cesium", alpha="blend"))
    tree, _ = tree_of(path)
    positions = [tree["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]] for mesh in tree["meshes"]]
    radii = [np.linalg.norm(np.subtract(each["max"], each["min"])) / 2 for each in positions]
    np.testing.assert_allclose(radii, radii[0], rtol=1e-6)
    assert len(radii) > 1 and all(material["doubleSided"] for material in tree["materials"])


def test_only_blend_is_split_and_only_where_nodes_are_sorted(crossed: BillboardCloud) -> None:
    def pieces(alpha: str, **options: Any) -> int:
        return len(shipped_model(crossed, ExportConfig(alpha=alpha, outline="hull", **options)).cards.cards)  # type: ignore[arg-type]

    assert pieces("mask", split=True) == pieces("hash", split=True) == pieces("blend") == pieces("blend", profile="blender") == 2
    assert pieces("blend", profile="blender", split=True) == pieces("blend", profile="three") > 2
    assert pieces("blend", profile="three", split=False) == 2


def test_a_hull_saves_area_and_keeps_to_its_corners(crossed: BillboardCloud, tmp_path: Path) -> None:
    for corners in (4, 6, 8):
        cards = shipped_model(crossed, ExportConfig(alpha="mask", outline="hull", corners=corners)).cards.cards
        assert all(len(card.corners) <= corners for card in cards)
    (path,) = export(crossed, tmp_path / "model.glb", ExportConfig(alpha="mask", outline="hull"))
    assert not messages(path)
    obj, *_ = export(crossed, tmp_path / "model.obj", ExportConfig(alpha="mask", outline="hull"))
    faces = [line for line in obj.read_text().splitlines() if line.startswith("f ")]
    assert len(faces) == 2 and all(len(face.split()) - 1 == len(card.corners) for face, card in zip(faces, cards, strict=True))


def test_mip_files_are_written_on_request(crossed: BillboardCloud, tmp_path: Path) -> None:
    files = export(crossed, tmp_path / "model.obj", ExportConfig(mip_files=True))
    pictures = [np.array(Image.open(file).convert("RGBA")) for file in files if "_mip" in file.name]
    assert len(pictures) > 4 and pictures[-1].shape == (1, 1, 4)
    np.testing.assert_array_equal(pictures[0], np.array(Image.open(tmp_path / "model.png").convert("RGBA")))
    for coarse, fine in zip(pictures[1:], pictures, strict=False):
        assert coarse.shape[:2] == tuple(max(1, side // 2) for side in fine.shape[:2])


def test_the_materials_light_is_as_asked(crossed: BillboardCloud, tmp_path: Path) -> None:
    for material, extensions in (("unlit", ["KHR_materials_unlit"]), ("pbr", None), ("emissive", None)):
        (path,) = export(crossed, tmp_path / f"{material}.glb", ExportConfig(material=material))  # type: ignore[arg-type]
        assert tree_of(path)[0].get("extensionsUsed") == extensions
        assert not messages(path)


def test_an_emissive_material_reflects_nothing_and_emits_the_colors(crossed: BillboardCloud, tmp_path: Path) -> None:
    for profile, emits in (("vtk", True), ("three", False)):
        (path,) = export(crossed, tmp_path / "model.glb", ExportConfig(profile=profile))  # type: ignore[arg-type]
        (material,) = tree_of(path)[0]["materials"]
        assert ("emissiveTexture" in material) == emits
    (path,) = export(crossed, tmp_path / "model.glb", ExportConfig(material="emissive"))
    (material,) = tree_of(path)[0]["materials"]
    surface = material["pbrMetallicRoughness"]
    assert (surface["baseColorFactor"], surface["metallicFactor"]) == ([0, 0, 0, 1], 1)
    assert material["emissiveTexture"] == surface["baseColorTexture"] and material["emissiveFactor"] == [1, 1, 1]


def test_masks_become_blended_where_programs_blend_them(crossed: BillboardCloud) -> None:
    """With opaque insides, clear outsides, and edges one texel wide."""
    masked = replace(crossed, alpha=AlphaMode("mask", 0.3))
    model = shipped_model(masked, ExportConfig(profile="vtk"))
    assert model.cloud.alpha.kind == model.cards.alpha.kind == "blend"
    for before, after in zip(masked.textures(), model.cloud.textures(), strict=True):
        old, new = before[0, ..., 3], after[0, ..., 3]
        assert ((new >= 0.5) == (old >= 0.3)).all() and torch.equal(before[..., :3], after[..., :3])
        inside = torch.from_numpy(ndimage.binary_erosion(old >= 0.3, np.ones((5, 5))))
        outside = torch.from_numpy(ndimage.binary_erosion(old < 0.3, np.ones((5, 5))))
        assert (new[inside] > 0.5).all() and (new[outside] < 0.5).all()
    blended = replace(crossed, alpha=AlphaMode())
    assert torch.equal(shipped_model(blended, ExportConfig(profile="vtk")).cloud.texels, blended.texels)


def test_a_missing_encoder_is_named(crossed: BillboardCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "alktx2", None)
    with pytest.raises(InputError, match=r"bbfit\[ktx2\]"):
        export(crossed, tmp_path / "model.glb", ExportConfig(textures="ktx2"))
    assert not list(tmp_path.iterdir())


def test_ktx2_is_shipped_where_it_can_be(crossed: BillboardCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its encoder the file is what it would be in PNG, and the configuration tells what to install."""
    config = ExportConfig(textures="auto")
    (path,) = export(crossed, tmp_path / "model.glb", config)
    assert "KHR_texture_basisu" in tree_of(path)[0]["extensionsUsed"] and config.missing_encoder is None
    (png,) = export(crossed, tmp_path / "png.glb", replace(config, textures="png"))
    monkeypatch.setitem(sys.modules, "alktx2", None)
    (without,) = export(crossed, tmp_path / "without.glb", config)
    assert without.read_bytes() == png.read_bytes()
    assert config.missing_encoder is not None and "bbfit[ktx2]" in config.missing_encoder
    assert ExportConfig().missing_encoder is None


def test_a_glb_taken_apart_and_joined_is_the_same(crossed: BillboardCloud, tmp_path: Path) -> None:
    (path,) = export(crossed, tmp_path / "model.glb")
    tree, views = tree_of(path)
    assert split_glb(joined_glb(tree, views)) == (tree, views)
    assert joined_glb(tree, views) == path.read_bytes()


@pytest.mark.parametrize(
    "bad",
    [
        {"profile": "maya"},
        {"alpha": "opaque"},
        {"alpha_cutoff": 0.0},
        {"alpha_cutoff": 1},
        {"alpha_cutoff": "half"},
        {"corners": 3},
        {"corners": 9},
        {"pieces": 0},
        {"outline": "round"},
        {"textures": "jpeg"},
        {"material": "toon"},
        {"split": 2},
    ],
)
def test_bad_wishes_are_refused_by_name(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        ExportConfig(**bad)
