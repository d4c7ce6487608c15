"""A run without a tree grows one first."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig, run
from bbfit.stages.recorded import grown_species
from bbfit.trees.config import GrowConfig
from bbfit.trees.growth import grow
from bbfit.trees.tree_writer import write_tree

CONFIG = RunConfig(
    species="acer",
    grow=GrowConfig(seed=3, detail=0.1, leaves=0.02),
    views=ViewsConfig(count=8, size=48, samples=1, denoise=False),
    fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=2),
)


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(None, tmp_path_factory.mktemp("grown") / "run", CONFIG).folder


def test_the_tree_is_the_one_that_was_asked_for(grown: Path, tmp_path: Path) -> None:
    scene = grow("acer", seed=3, detail=0.1, leaves=0.02)
    write_tree(scene, tmp_path / "tree.glb")
    assert (grown / "tree.glb").read_bytes() == (tmp_path / "tree.glb").read_bytes()
    record = json.loads((grown / "run.json").read_text())
    assert record["source"] == "acer" and record["config"]["species"]["curve_res"] == [6, 5, 3, 0]
    assert record["seeds"] == {"grow": 3, "views": 0, "fit": 0}
    assert set(record["stages"]) == {"grow", "views", "fit", "export", "evaluate", "report"}
    metrics = json.loads((grown / "metrics.json").read_text())
    assert metrics["vertices"]["original"] == sum(len(mesh.vertices) for mesh in scene.geometry.values())
    assert metrics["seconds"]["grow"] > 0
    assert grown_species(grown / "cloud.safetensors") == "acer"  # bbfit evaluate keeps the name


def test_a_standing_run_is_left_alone_and_a_lost_tree_grown_again(grown: Path) -> None:
    assert run(None, grown, CONFIG).skipped == ("grow", "views", "fit", "evaluate", "export", "report")
    before = (grown / "tree.glb").read_bytes()
    (grown / "tree.glb").unlink()
    assert run(None, grown, CONFIG).skipped == ("views", "fit", "evaluate", "export", "report")
    assert (grown / "tree.glb").read_bytes() == before


def test_another_tree_wants_another_folder(grown: Path) -> None:
    before = (grown / "tree.glb").read_bytes()
    with pytest.raises(InputError, match="another tree"):
        run(None, grown, replace(CONFIG, grow=replace(CONFIG.grow, seed=4)))
    assert (grown / "tree.glb").read_bytes() == before
