"""Light that passes through thin surfaces (glTF, KHR_materials_diffuse_transmission), as Blender renders it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.geometry.camera import Camera
from bbfit.glb import joined_glb, split_glb
from bbfit.images import encode_png, srgb_to_linear
from bbfit.views.dataset import ViewDataset
from tests.blender.conftest import SMALL

BASE = np.array([200, 100, 50]) / 255


def leaf(path: Path, transmission: dict[str, Any], picture: NDArray[np.uint8] | None = None, *, gloss: float = 0.0) -> Path:
    """An upright square that faces +Z, white with gloss, otherwise of the color BASE, or of the picture."""
    shape = trimesh.Trimesh([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    texture = None if picture is None else Image.fromarray(picture)
    factor = [255] * 4 if gloss or texture else [200, 100, 50, 255]
    material = PBRMaterial("leaf", baseColorFactor=factor, baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=1.0)
    material.doubleSided, material.alphaMode = True, None if texture is None else "MASK"
    shape.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    tree, views = split_glb(trimesh.Scene(shape).export(file_type="glb"))
    if picture is not None:
        views[tree["images"][0]["bufferView"]] = encode_png(picture)
    tree["materials"][0]["extensions"] = {
        "KHR_materials_diffuse_transmission": transmission,
        "KHR_materials_specular": {"specularFactor": gloss},
    }
    path.write_bytes(joined_glb(tree | {"extensionsUsed": list(tree["materials"][0]["extensions"])}, views))
    return path


def seen(path: Path, *, rows: slice = slice(4, 12)) -> dict[str, NDArray[np.float64]]:
    """The linear color in the middle of the square from its front, under a sun that it faces, and from its back; and its diffuse color."""
    light = {"sun_azimuth": 0.0, "sun_elevation": 0.0, "suns": 1, "elevations": (0.0,), "orthographic": True}
    config = ViewsConfig(**SMALL | {"count": 4, "size": 16, "samples": 64, "denoise": False, "turned": 0} | light)
    views, found = ViewDataset.load(render_views(path, path.parent / "views", config)), dict[str, NDArray[np.float64]]()

    def color(picture: torch.Tensor) -> NDArray[np.float64]:
        middle = picture[rows, 4:12].double().numpy() / 255
        return (srgb_to_linear(middle[..., :3]) * middle[..., 3:]).mean((0, 1))

    for lit in (views.lit_train, views.lit_test):
        assert lit is not None and lit.albedo is not None
        cameras: Camera = lit.skies.cameras
        for index in range(len(lit.skies)):
            towards = float(-cameras.forward[index, 2])
            if abs(towards) > 0.9:
                own = next(place for place, camera in enumerate(lit.cameras) if camera == index)
                found["front" if towards > 0 else "back"] = color(lit.suns.image(own))
                found |= {"sky": color(lit.skies.image(index)), "albedo": color(lit.albedo.image(index))}
    return found


def test_a_leaf_reflects_and_transmits_its_shares(tmp_path: Path) -> None:
    """(1 - f) of the base color, f of the other color; both under an even sky, and in the pass of the diffuse color."""
    color = np.array([0.5, 0.2, 0.9])
    found = seen(leaf(tmp_path / "leaf.glb", {"diffuseTransmissionFactor": 0.6, "diffuseTransmissionColorFactor": color.tolist()}))
    reflected, transmitted = 0.4 * BASE, 0.6 * color
    both = reflected + transmitted
    for name, expected in {"front": reflected, "back": transmitted, "sky": both, "albedo": both}.items():
        assert found[name] == pytest.approx(expected, abs=0.015), name


def test_transmission_has_textures(tmp_path: Path) -> None:
    """The share is the alpha of a texture, here that of the base color: 0 below, which is cut out, and 0.6 above."""
    picture = np.full((4, 4, 4), (255, 0, 188, 153), np.uint8)
    picture[2:, :, 3] = 0
    names = ("diffuseTransmissionTexture", "diffuseTransmissionColorTexture")
    path = leaf(tmp_path / "leaf.glb", {"diffuseTransmissionFactor": 0.5} | {name: {"index": 0} for name in names}, picture)
    found = seen(path, rows=slice(4, 6))
    color = srgb_to_linear(np.array([255, 0, 188]) / 255)
    assert found["back"] == pytest.approx(0.3 * color, abs=0.02)
    assert found["front"] == pytest.approx(0.7 * color, abs=0.02)
    assert seen(path, rows=slice(9, 12))["sky"].tolist() == [0.0] * 3


def test_a_glossy_white_leaf_makes_no_light(tmp_path: Path) -> None:
    """What is reflected and transmitted is at most what falls on it. Measured: 0.987 of it."""
    found = seen(leaf(tmp_path / "leaf.glb", {"diffuseTransmissionFactor": 0.5}, gloss=1.0))
    assert 0.95 < found["sky"].min() and found["sky"].max() <= 1.0
    assert found["back"] == pytest.approx(np.full(3, 0.48), abs=0.02) and found["albedo"].max() <= 1.0
