"""What a GLB says about itself, and that nothing else of it changes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.description import Description, described_glb
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import split_glb
from tests.khronos import messages

KNOWN = Description(
    name="acer",
    billboards=3,
    alpha=AlphaMode("mask", 0.2),
    light="baked",
    sun_direction=(0.0, 1.0, 0.0),
    sun_strength=2.5,
    ambient=1.0,
    tree_bounds=((-1.0, 0.0, -1.0), (1.0, 2.123456789, 1.0)),
    score={"psnr": 24.509468, "flip": 0.0426497, "views": 23.0},
    distances={"near_meters": 24.0, "far_meters": None, "screen_height": 1080.0, "screen_fov_degrees": 50.0},
)


@pytest.mark.parametrize("config", [ExportConfig(alpha="mask"), ExportConfig(alpha="blend", split=True), ExportConfig(textures="webp")])
def test_names_and_facts_are_there_and_nothing_else_changes(crossed: BillboardCloud, tmp_path: Path, config: ExportConfig) -> None:
    plain = shipped_model(crossed, config)
    glb = plain.described(KNOWN).glb
    (before, contents), (after, same) = split_glb(plain.glb), split_glb(glb)
    assert same == contents
    for kind in ("nodes", "meshes", "materials"):
        names = [item["name"] for item in after[kind]]
        assert all(name == "acer" or name.startswith("acer_") for name in names) and len(set(names)) == len(names), names
    assert [image["name"] for image in after["images"]] == [f"acer_{image['name']}" for image in before["images"]]
    facts = after["asset"]["extras"]["bbfit"]
    assert (facts["tree"], facts["billboards"], facts["alpha"]) == ("acer", 3, {"mode": "mask", "cutoff": 0.2})
    assert facts["light"] == {"kind": "baked", "sun_direction": [0, 1, 0], "sun_strength": 2.5, "ambient": 1}
    assert facts["score"] == {"psnr": 24.509, "flip": 0.04265, "views": 23} and facts["tree_bounds"][1] == [1, 2.1235, 1]
    scene = trimesh.load(io.BytesIO(glb), file_type="glb", process=False)
    placed = [scene.graph.get(node) for node in scene.graph.nodes_geometry]
    meshes = [(scene.geometry[name], matrix) for matrix, name in placed]
    points = np.concatenate([trimesh.transform_points(mesh.vertices[np.unique(mesh.faces)], matrix) for mesh, matrix in meshes])
    np.testing.assert_allclose(facts["bounds"], [points.min(0), points.max(0)], rtol=1e-4, atol=1e-6)
    root = after["nodes"][after["scenes"][0]["nodes"][0]]["extras"]["bbfit"]
    assert root == {"tree_bounds": facts["tree_bounds"], "distances": facts["distances"]}
    (tmp_path / "model.glb").write_bytes(glb)
    assert not messages(tmp_path / "model.glb")


def test_what_is_not_known_is_left_out(crossed: BillboardCloud) -> None:
    bare = Description("x", 2, AlphaMode("blend", 0.5), "maps")
    model = shipped_model(crossed)
    tree, _ = split_glb(described_glb(model.glb, bare, model.cards))
    facts = tree["asset"]["extras"]["bbfit"]
    assert set(facts) == {"tree", "billboards", "alpha", "light", "bounds"}
    assert facts["light"] == {"kind": "maps"} and facts["alpha"] == {"mode": "blend"}
