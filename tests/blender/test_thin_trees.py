"""Flat and thin trees, small pictures and wide angles, rendered by Blender and fitted: an empty picture of bbfit's own is no error."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError
from bbfit.exporting.config import LodConfig
from bbfit.fitting.config import FitConfig
from bbfit.lod import build_lod
from bbfit.pipeline import RunConfig, run
from bbfit.trees.growth import grow
from bbfit.trees.tree_writer import write_tree
from bbfit.views.dataset import ViewDataset

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
FAST = {"count": 8, "size": 32, "samples": 4, "denoise": False, "turned": 0}
FIT = FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=4)


def card(degrees: float) -> trimesh.Trimesh:
    """An upright rectangle of 1 m x 2 m on the ground, turned about the vertical."""
    corners = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 2, 0], [-0.5, 2, 0]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 1, 0]))


def floor() -> trimesh.Trimesh:
    """A square of 2 m on the ground."""
    return trimesh.Trimesh([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], [[0, 1, 2], [0, 2, 3]], process=False)


THIN: dict[str, Callable[[], trimesh.Trimesh]] = {
    "a card that faces a camera": lambda: card(0),
    "a card across": lambda: card(90),
    "a card between cameras": lambda: card(17),
    "a pole": lambda: trimesh.creation.box(bounds=[[-0.01, 0, -0.01], [0.01, 20, 0.01]]),
    "a beam": lambda: trimesh.creation.box(bounds=[[-10, 0, -0.01], [10, 0.02, 0.01]]),
    "a disc": lambda: trimesh.creation.box(bounds=[[-10, 0, -10], [10, 0.02, 10]]),
}


@pytest.mark.parametrize("kind", THIN)
def test_a_thin_tree_is_fitted_by_its_mesh_and_by_its_views(kind: str, tmp_path: Path) -> None:
    THIN[kind]().export(tmp_path / "thin.glb")
    config = RunConfig(views=ViewsConfig(**FAST), fit=FIT)
    result = run(tmp_path / "thin.glb", tmp_path / "out", config)
    assert len(result.cloud) and np.isfinite(result.report.mean.over_white.psnr)
    for name, fit in (("hull", FIT), ("even", FitConfig(billboards=2, placement="even", steps=4))):
        again = run(tmp_path / "out" / "views", tmp_path / name, RunConfig(fit=fit))
        assert len(again.cloud) and np.isfinite(again.report.mean.over_white.psnr)


def test_a_card_is_invisible_from_its_edge_and_whole_from_its_front(tmp_path: Path) -> None:
    card(0).export(tmp_path / "card.glb")
    views = ViewDataset.load(render_views(tmp_path / "card.glb", tmp_path / "views", ViewsConfig(**FAST)))
    shown = {name: split.shows(index) for split in (views.train, views.test) for index, name in enumerate(split.names)}
    assert [name for name, seen in sorted(shown.items()) if not seen] == ["0002", "0006"]


def test_levels_and_budgets_of_a_card(tmp_path: Path) -> None:
    """With an empty picture among the held-out views."""
    card(0).export(tmp_path / "card.glb")
    views = ViewsConfig(**FAST | {"count": 8, "seed": 0})
    lod = build_lod(
        tmp_path / "card.glb",
        tmp_path / "lod.glb",
        LodConfig(planes=(2,)),
        RunConfig(views=views, fit=FitConfig(steps=4, candidates=1, refinement_rounds=0)),
    )
    dataset = ViewDataset.load(lod.folder / "views")
    assert not all(map(dataset.test.shows, range(len(dataset.test))))
    budget = RunConfig(fit=FitConfig(placement="even", steps=2), budget=BudgetConfig(vertices=4))
    assert len(run(lod.folder / "views", tmp_path / "budget", budget).cloud)


def test_a_tree_that_no_camera_can_see_is_refused_before_it_is_rendered(tmp_path: Path) -> None:
    floor().export(tmp_path / "floor.glb")
    config = RunConfig(views=ViewsConfig(**FAST), fit=FIT)
    said = "elevations: the tree is flat, and all 8 cameras see it edge-on, .*; add a ring of another elevation, as in --elevations 0 30"
    for orthographic in (False, True):
        with pytest.raises(InputError, match=said):
            run(tmp_path / "floor.glb", tmp_path / "out", RunConfig(views=ViewsConfig(**FAST, orthographic=orthographic), fit=FIT))
        assert not (tmp_path / "out").exists()
    followed = RunConfig(views=ViewsConfig(**FAST, elevations=(0.0, 30.0)), fit=config.fit)
    assert len(run(tmp_path / "floor.glb", tmp_path / "out", followed).cloud)


def test_a_tree_of_invisible_material_is_refused_with_the_reason(tmp_path: Path) -> None:
    mesh = card(20)
    clear = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 255, 255, 0], alphaMode="BLEND")
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=clear)
    mesh.export(tmp_path / "clear.glb")
    with pytest.raises(InputError, match=r"none of 6 training pictures shows anything of the tree; it is thinner .* or its materials are"):
        run(tmp_path / "clear.glb", tmp_path / "out", RunConfig(views=ViewsConfig(**FAST), fit=FIT))


def test_an_empty_picture_from_elsewhere_is_still_refused(tmp_path: Path) -> None:
    """The same folder without the record that bbfit rendered it, or with one of an unfinished render."""
    card(0).export(tmp_path / "card.glb")
    views = render_views(tmp_path / "card.glb", tmp_path / "views", ViewsConfig(**FAST))
    record = json.loads((views / "views.json").read_text())
    for changed in ({**record, "complete": False}, {"tree": {"up_axis": "y"}}, None):
        (views / "views.json").unlink()
        if changed is not None:
            (views / "views.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=r"000[26]\.png is fully transparent; render it anew or take it out"):
            run(views, tmp_path / "out", RunConfig(fit=FIT))
        assert not (tmp_path / "out").exists()
        (views / "views.json").write_text(json.dumps(record))
    assert len(run(views, tmp_path / "out", RunConfig(fit=FIT)).cloud)


@pytest.mark.parametrize("size", [11, 16, 48])
@pytest.mark.parametrize("fov", [40.0, 170.0])
def test_small_pictures_and_wide_angles_show_the_tree_where_it_is(fov: float, size: int, tmp_path: Path) -> None:
    """Of a tree with bare twigs, which single samples miss, so that its pictures are empty where its mesh is."""
    write_tree(grow("acer", seed=3, detail=0.1, leaves=0.02), tmp_path / "acer.glb")
    views = ViewsConfig(count=6, size=size, fov_degrees=fov, samples=1, denoise=False)
    for tree in (tmp_path / "acer.glb", TREE):
        assert len(run(tree, tmp_path / f"out of {tree.name}", RunConfig(views=views, fit=FIT)).cloud)


def test_a_sparse_tree_in_few_pixels_is_where_its_views_show_it(tmp_path: Path) -> None:
    """Single samples miss the top of this fir in all views."""
    write_tree(grow("douglas_fir", seed=0, detail=0.15, leaves=0.1), tmp_path / "fir.glb")
    views = ViewsConfig(count=4, size=16, samples=1, denoise=False)
    result = run(tmp_path / "fir.glb", tmp_path / "out", RunConfig(views=views, fit=FIT))
    trimesh.load(tmp_path / "fir.glb", force="mesh").export(tmp_path / "fir.obj")
    for tree in ("fir.glb", "fir.obj"):
        assert len(run(result.folder / "views", tmp_path / tree[-3:], RunConfig(tree=tmp_path / tree, fit=FIT)).cloud)


def test_a_mesh_that_was_converted_is_recognized_in_small_pictures(tmp_path: Path) -> None:
    """Its digest is not that of the rendered tree, so that the pictures themselves must show it; elsewhere they do not."""
    write_tree(grow("acer", seed=3, detail=0.1, leaves=0.02), tmp_path / "acer.glb")
    views = render_views(tmp_path / "acer.glb", tmp_path / "views", ViewsConfig(count=6, size=48, samples=2, denoise=False))
    mesh = trimesh.load(tmp_path / "acer.glb", force="mesh")
    mesh.export(tmp_path / "same.ply")
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])).export(tmp_path / "acer.ply")
    assert len(run(views, tmp_path / "out", RunConfig(tree=tmp_path / "acer.ply", fit=FIT)).cloud)
    with pytest.raises(InputError, match=r"same\.ply is not where the views show a tree"):
        run(views, tmp_path / "lying", RunConfig(tree=tmp_path / "same.ply", fit=FIT))
    assert not (tmp_path / "lying").exists()
    shutil.rmtree(views)
