"""Clouds with maps as models: pairs of culled cards, tangents, three textures, and what they show."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from gltf_arrays import array, matrix
from khronos import messages
from PIL import Image

from bbfit.checks import InputError
from bbfit.evaluation.metrics import psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.mips import surface_chain
from bbfit.exporting.model import export, shipped_model
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light, sky
from bbfit.glb import split_glb
from bbfit.rendering.cards import draw_cards
from bbfit.rendering.dispatch import render

# What the validator says of formats and extensions that it does not know.
_UNKNOWN = ("UNSUPPORTED_EXTENSION", "UNUSED_OBJECT", "IMAGE_UNRECOGNIZED_FORMAT", "VALUE_NOT_IN_LIST")
PLAIN = ExportConfig(outline="rectangle", mipmaps=False)


def with_maps(cloud: BillboardCloud, seed: int = 0) -> BillboardCloud:
    """Smooth maps for a cloud: they change by little from texel to texel, so that filtering before and after shading are alike."""
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for texture in cloud.textures():
        sides, height, width, _ = texture.shape
        coarse = torch.rand(sides, 7, 2, 2, generator=generator, dtype=torch.float64)
        fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=True)
        parts.append(fine.permute(0, 2, 3, 1).reshape(-1, 7))
    values = torch.cat(parts).to(cloud.texels)
    texels = torch.cat([0.2 + 0.6 * values[:, :3], cloud.texels[:, 3:]], 1)
    surface = torch.cat([0.2 + 0.6 * values[:, 3:5], 0.3 + 0.7 * values[:, 5:6], torch.zeros_like(values[:, :1])], 1)
    return replace(cloud, texels=texels, surface=surface, light=Light.of(torch.tensor([[0.3, 0.9, 0.3]]), 2.5, 1.0))


def translucent(cloud: BillboardCloud) -> BillboardCloud:
    """The cloud of :func:`with_maps` with light that passes through, by more to the right."""
    cloud = with_maps(cloud)
    columns = [torch.linspace(0.1, 0.7, texture.shape[2]).expand(texture.shape[:3]).reshape(-1) for texture in cloud.textures()]
    assert cloud.surface is not None
    return replace(cloud, surface=torch.cat([cloud.surface[:, :3], torch.cat(columns).to(cloud.surface)[:, None]], 1))


@pytest.mark.parametrize("kind", ["one", "two", "mixed"])
def test_cards_show_what_the_cloud_shows_in_every_light(clouds: dict[str, BillboardCloud], orbit: Camera, kind: str) -> None:
    """Shading after filtering instead of before, and 8 bits, with one sample a pixel as the cloud has.

    Measured: at least 74.2 dB; with the sun on the other side at most 29.1.
    """
    cloud = with_maps(clouds[kind])
    lights = Light.of(sky(6, 20.0), 4.0, 0.4)
    model = shipped_model(cloud, PLAIN)
    shown, expected = draw_cards(model.cards, orbit, lights, multisampled=False).double(), render(cloud, orbit, light=lights)
    assert psnr(shown.numpy(), expected.numpy()) > 60
    turned = Light(lights.sun_directions * torch.tensor([-1.0, 1.0, -1.0]), *list(vars(lights).values())[1:])
    assert psnr(model.draw(orbit, turned).double().numpy(), expected.numpy()) < 35
    torch.testing.assert_close(model.draw(orbit[0]), model.draw(orbit[0], cloud.light))
    assert all(card.culled for card in model.cards.cards) and len(model.cards.cards) == 2 * len(cloud)


def test_a_model_for_blender_has_one_card_for_both_sides(clouds: dict[str, BillboardCloud], orbit: Camera, tmp_path: Path) -> None:
    """From the front it shows what a pair shows but for a sun behind the plane. From behind, its normals turn as a whole."""
    cloud = with_maps(clouds["one"])
    cloud = replace(cloud.take([0]), surface=torch.tensor([0.5, 0.9, 1.0, 0.0]).double().repeat(len(cloud.take([0]).texels), 1))
    single, pair = (shipped_model(cloud, replace(PLAIN, profile=profile)) for profile in ("blender", None))
    assert [card.culled for card in single.cards.cards] == [False] and len(pair.cards.cards) == 2
    (path,) = single.save(tmp_path / "model.glb")
    (material,) = split_glb(path.read_bytes())[0]["materials"]
    assert material["doubleSided"] and messages(path) == []

    normal, up, right = (axis[0] for axis in (cloud.normals, cloud.ups, cloud.rights))
    leaning = 0.8 * up + 0.6 * normal  # of every texel, seen from the front

    def sun(direction: torch.Tensor) -> Light:
        return Light.of(direction[None], 1.0, 0.0)

    front = [index for index in range(len(orbit)) if (orbit[index].position - cloud.centers[0]) @ normal > 0]
    back = [index for index in range(len(orbit)) if index not in front]
    assert front and back
    for index in front:
        torch.testing.assert_close(single.draw(orbit[index], sun(leaning)), pair.draw(orbit[index], sun(leaning)))
        below = up - 0.1 * normal
        assert pair.draw(orbit[index], sun(below))[..., :3].sum() > 0 == single.draw(orbit[index], sun(below))[..., :3].sum()
    for index in back:
        mirrored = 0.8 * up - 0.6 * normal
        assert pair.draw(orbit[index], sun(mirrored))[..., :3].sum() > single.draw(orbit[index], sun(mirrored))[..., :3].sum()
        shown = single.draw(orbit[index], sun(-leaning))
        torch.testing.assert_close(shown, pair.draw(orbit[index], sun(mirrored)))
        sky_only = Light.of(right[None], 0.0, 0.8), Light.of(right[None], 0.0, 1.0)
        torch.testing.assert_close(pair.draw(orbit[index], sky_only[0]), single.draw(orbit[index], sky_only[1]), atol=5e-3, rtol=0)


def test_glb_has_three_textures_and_tangents_and_is_valid(
    clouds: dict[str, BillboardCloud], crossed: BillboardCloud, tmp_path: Path
) -> None:
    """With every format of textures, in mask and blend; the validator does not know KTX2 and WebP, which it says."""
    files = []
    for alpha in ("mask", "blend"):
        for textures in ("png", "webp", "ktx2"):
            config = ExportConfig(alpha=alpha, textures=textures, profile="three")
            files += export(with_maps(crossed), tmp_path / f"{alpha}_{textures}.glb", config)
    assert [found for found in messages(*files) if found["code"] not in _UNKNOWN] == []
    tree, views = split_glb(files[0].read_bytes())
    assert [image["name"] for image in tree["images"]] == ["atlas", "normals", "occlusion"]
    (material,) = tree["materials"]
    assert material["normalTexture"] == {"index": 1} and material["occlusionTexture"] == {"index": 2} and not material.get("doubleSided")
    assert (
        material["extensions"]
        == {"KHR_materials_specular": {"specularFactor": 0.0}}
        == {tree["extensionsUsed"][0]: {"specularFactor": 0.0}}
    )

    def rows(name: str, width: int) -> np.ndarray:
        rows = array(tree, views, tree["meshes"][0]["primitives"][0]["attributes"][name])
        assert rows.shape[1] == width
        return rows

    placed = matrix(tree["nodes"][tree["scenes"][0]["nodes"][0]])
    points = rows("POSITION", 3) @ placed[:3, :3] + placed[:3, 3]
    normals, tangents, uvs = rows("NORMAL", 3), rows("TANGENT", 4), rows("TEXCOORD_0", 2)
    bitangents = np.cross(normals, tangents[:, :3]) * tangents[:, 3:]
    assert set(tangents[:, 3]) == {-1.0, 1.0}
    for sign in (-1.0, 1.0):  # up along the texture, to which v falls, and right, to which u grows, on both sides
        side = tangents[:, 3] == sign
        start = points[side][0]
        along = (points[side] - start) @ bitangents[side][0], (points[side] - start) @ tangents[side][0, :3]
        same = np.abs((points[side] - start) @ normals[side][0]) < 1e-6
        assert (
            np.corrcoef(along[0][same], uvs[side][same, 1])[0, 1] < -0.99 and np.corrcoef(along[1][same], uvs[side][same, 0])[0, 1] > 0.99
        )


@pytest.mark.parametrize("kind", ["one", "two"])
def test_babylon_shows_light_that_passes_through(clouds: dict[str, BillboardCloud], orbit: Camera, kind: str) -> None:
    """As the cloud's renderer does, after filtering and 8 bits, one sample a pixel. Measured: at least 74.3 dB; opaque at most 36.0."""
    cloud, lights = translucent(clouds[kind]), Light.of(sky(6, 20.0), 4.0, 0.4)
    expected = render(cloud, orbit, light=lights).numpy()
    models = [shipped_model(cloud, replace(PLAIN, profile=name)) for name in ("babylon", "three")]
    shown, opaque = (draw_cards(model.cards, orbit, lights, multisampled=False) for model in models)
    assert psnr(shown.double().numpy(), expected) > 60 > 45 > psnr(opaque.double().numpy(), expected)
    assert psnr(opaque.double().numpy(), render(cloud.opaque(), orbit, light=lights).numpy()) > 60


def test_babylon_s_file_has_translucency_in_the_alpha_of_occlusion(crossed: BillboardCloud, tmp_path: Path) -> None:
    """With every format of textures and with mip levels; nothing of it in other files, or without translucency."""
    cloud = translucent(crossed)
    files = [
        *(export(cloud, tmp_path / f"{kind}.glb", ExportConfig(profile="babylon", textures=kind))[0] for kind in ("png", "webp", "ktx2")),
        *(export(cloud, tmp_path / f"{name}.glb", ExportConfig(profile=name))[0] for name in ("three", "blender")),
        export(cloud, tmp_path / "any.glb")[0],
        export(with_maps(crossed), tmp_path / "opaque.glb", ExportConfig(profile="babylon"))[0],
    ]
    assert [found for found in messages(*files) if found["code"] not in _UNKNOWN] == []
    for file in files:
        tree, views = split_glb(file.read_bytes())
        (material,) = tree["materials"]
        written = material["extensions"].get("KHR_materials_diffuse_transmission")
        assert (written is not None) == (file in files[:3]) == ("KHR_materials_diffuse_transmission" in tree["extensionsUsed"])
        if written is not None:
            assert written == {
                "diffuseTransmissionFactor": 1.0,
                "diffuseTransmissionTexture": material["occlusionTexture"],
                "diffuseTransmissionColorTexture": material["pbrMetallicRoughness"]["baseColorTexture"],
            }
            for image in tree["images"]:
                if image["name"] == "occlusion" and image["mimeType"] != "image/ktx2":
                    picture = np.array(Image.open(io.BytesIO(views[image["bufferView"]])).convert("RGBA"))
                    surface = shipped_model(cloud, ExportConfig(profile="babylon")).cards.atlas.surface
                    assert surface is not None and np.array_equal(picture[..., [0, 3]], surface[..., 3:])


def test_obj_has_a_map_of_normals(crossed: BillboardCloud, tmp_path: Path) -> None:
    files = export(with_maps(crossed), tmp_path / "tree.obj")
    assert [file.name for file in files] == ["tree.obj", "tree.mtl", "tree.png", "tree_normals.png"]
    lines = files[1].read_text().splitlines()
    assert {"map_Kd tree.png", "map_d tree.png", "norm tree_normals.png", "illum 1"} <= set(lines)
    assert len(trimesh.load(files[0], process=False).faces) > 0


def test_maps_have_a_material_of_their_own(crossed: BillboardCloud) -> None:
    with pytest.raises(InputError, match="material: the cloud has maps"):
        shipped_model(with_maps(crossed), ExportConfig(material="unlit"))
    model = shipped_model(crossed)
    with pytest.raises(InputError, match="light: the light of these cards is in their textures"):
        draw_cards(model.cards, Camera(torch.eye(4).double(), torch.eye(3).double(), 4, 4), Light.of(sky(1), 1.0, 1.0))


def test_levels_of_normals_are_unit_vectors_weighted_by_alpha() -> None:
    """Two visible normals left and right, and a hidden third that does not count; programs compute plain means, which are shorter."""
    normals = np.zeros((4, 4, 4), np.uint8)
    normals[:, :2], normals[:, 2:] = (218, 128, 218, 255), (37, 128, 218, 55)
    alpha = np.full((4, 4), 255, np.uint8)
    normals[0], alpha[0] = (128, 255, 128, 0), 0
    weighted, plain = surface_chain(normals, alpha)[-1][0, 0], surface_chain(normals, None)[-1][0, 0]
    assert weighted.tolist() == pytest.approx([128, 128, 255, 155], abs=1)
    assert plain.tolist() == pytest.approx([128, 160, 195, 116], abs=1)
    assert [level.shape for level in surface_chain(normals, alpha)] == [(4, 4, 4), (2, 2, 4), (1, 1, 4)]


def test_clouds_with_maps_survive_the_disk(crossed: BillboardCloud, tmp_path: Path) -> None:
    cloud = with_maps(crossed)
    cloud.save(tmp_path / "cloud.safetensors")
    read = BillboardCloud.load(tmp_path / "cloud.safetensors")
    assert read.surface is not None and cloud.surface is not None and read.light is not None and cloud.light is not None
    assert torch.equal(read.surface, cloud.surface) and torch.equal(read.texels, cloud.texels)
    assert all(torch.equal(mine, other) for mine, other in zip(vars(read.light).values(), vars(cloud.light).values(), strict=True))
    crossed.save(tmp_path / "baked.safetensors")
    assert BillboardCloud.load(tmp_path / "baked.safetensors").surface is None
    part = cloud.take([1])
    assert part.surface is not None and torch.equal(part.surface, cloud.surface[len(cloud.surface) // 2 :])
    both = BillboardCloud.joined([part, part])
    assert both.surface is not None and len(both.surface) == 2 * len(part.surface)
    with pytest.raises(InputError, match="surface: expected values"):
        replace(cloud, surface=cloud.surface + 1).save(tmp_path / "cloud.safetensors")
    with pytest.raises(InputError, match="light: expected one exactly if"):
        replace(cloud, light=None)
