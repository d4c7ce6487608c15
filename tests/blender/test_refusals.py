"""Options that cannot work are refused before anything is grown or rendered, and no folder stays behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bbfit.blender import processes
from bbfit.blender.config import ViewsConfig
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.one_tree import compare
from bbfit.exporting.config import ExportConfig, LodConfig
from bbfit.fitting.config import FitConfig
from bbfit.lod import build_lod
from bbfit.pipeline import RunConfig, run
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.scheduling import run_sweep
from bbfit.trees.config import GrowConfig

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
VIEWS = {"count": 8, "size": 16, "samples": 1, "denoise": False}

BAD: dict[str, tuple[RunConfig, str]] = {
    "a missing device": (RunConfig(fit=FitConfig(device="cuda:99")), r"device: 'cuda:99' is not available; use cpu"),
    "a device without values": (RunConfig(fit=FitConfig(device="meta")), "device: 'meta' is not available"),
    "an unknown device": (RunConfig(fit=FitConfig(device="gpu")), "device: 'gpu' is not available"),
    "an odd device": (RunConfig(fit=FitConfig(device="hpu")), "device: 'hpu' is not available"),
    "a device of another Blender": (RunConfig(views=ViewsConfig(render_device="metal")), "render_device: this Blender does not support"),
    "a missing panorama": (RunConfig(views=ViewsConfig(hdri=Path("none.hdr"))), r"hdri: none\.hdr does not exist"),
    "an unreadable panorama": (RunConfig(views=ViewsConfig(hdri=Path(__file__))), r"hdri: .*test_refusals\.py cannot be read"),
    "two views": (RunConfig(views=ViewsConfig(count=2)), "views: there is a single training view.*; give a larger --count than 2"),
    "a ring above": (RunConfig(views=ViewsConfig(elevations=(90.0,))), "training cameras look along one line.*--elevations 0 90"),
    "above and below": (RunConfig(views=ViewsConfig(elevations=(90.0, -90.0))), "training cameras look along one line"),
    "a parallel ring above": (
        RunConfig(views=ViewsConfig(elevations=(90.0,), orthographic=True), fit=FitConfig(placement="even")),
        "training cameras look along one line",
    ),
    "too few views for a budget": (
        RunConfig(views=ViewsConfig(count=6), budget=BudgetConfig(auto=True)),
        "views: 4 training views are too few for a validation split; give a --count of at least 7",
    ),
    "two numbers of billboards": (RunConfig(fit=FitConfig(billboards=3), budget=BudgetConfig(vertices=40)), "billboards: 3 are requested"),
    "two numbers of texels": (RunConfig(fit=FitConfig(max_texels=900), budget=BudgetConfig(vertices=40)), "max_texels: 900 are requested"),
    "the thesis in a budget": (RunConfig(fit=FitConfig(preset="thesis"), budget=BudgetConfig(auto=True)), "preset: 'thesis' cannot"),
    "a budget below a billboard": (RunConfig(fit=FitConfig(sides="two"), budget=BudgetConfig(vertices=4)), "vertices: 4 are too few"),
    "pairs of clusters": (RunConfig(fit=FitConfig(sides="pair")), "sides: pairs need an even placement"),
    "pairs of clusters in a budget": (RunConfig(fit=FitConfig(sides="pair"), budget=BudgetConfig(auto=True)), "sides: pairs need"),
    "too few texels": (RunConfig(fit=FitConfig(max_texels=1)), "max_texels: 1 are too few for 384 textures"),
}


@pytest.fixture(autouse=True)
def _no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """No tree is loaded in Blender, and so none is rendered."""
    monkeypatch.setattr(processes.BlenderPool, "load", lambda pool: pytest.fail("Blender was asked to load the tree"))


def refused(command: Callable[[Path], Any], said: str, folder: Path) -> None:
    """The command refuses in one line. Its folder, two levels deep, and the folder's parent are not made."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match=said) as caught:
        command(folder / "new" / "out")
    assert "\n" not in str(caught.value)
    assert sorted(folder.rglob("*")) == before


def idle(*event: object) -> None:
    pytest.fail(f"work was begun: {event}")


@pytest.mark.parametrize("source", [TREE, None], ids=["tree", "grown"])
@pytest.mark.parametrize("kind", BAD)
def test_a_run_that_cannot_end_does_not_begin(kind: str, source: Path | None, tmp_path: Path) -> None:
    config, said = BAD[kind]
    refused(lambda out: run(source, out, config, on_progress=idle), said, tmp_path)


ALONE = sorted(kind for kind in BAD if "budget" not in kind and "two numbers" not in kind and kind not in ("too few texels",))


@pytest.mark.parametrize("kind", ALONE)
def test_neither_does_any_other_command(kind: str, tmp_path: Path) -> None:
    config, said = BAD[kind]
    small = LodConfig(planes=(8, 2))
    refused(lambda out: build_lod(TREE, out / "lod.glb", small, config, on_progress=idle), said, tmp_path)
    refused(lambda out: build_lod(TREE, out / "lod.glb", small, config, work=out / "work", on_progress=idle), said, tmp_path)
    refused(lambda out: compare(TREE, out, CompareConfig(("crossed",)), config, on_progress=idle), said, tmp_path)
    refused(lambda out: run_sweep(out, SweepConfig("default"), config, trees=[TREE], on_progress=idle), said, tmp_path)
    refused(lambda out: run_sweep(out, SweepConfig("default"), config, species=["acer"], on_progress=idle), said, tmp_path)


def test_levels_of_detail_that_contradict_each_other(tmp_path: Path) -> None:
    few = RunConfig(fit=FitConfig(max_texels=4))
    refused(lambda out: build_lod(TREE, out / "lod.glb", LodConfig(planes=(8, 2)), few, on_progress=idle), "max_texels: 4", tmp_path)
    nothing = LodConfig(planes=(2,), triangles=500, original=False)
    refused(lambda out: build_lod(TREE, out / "lod.glb", nothing, on_progress=idle), "triangles: 500 are requested", tmp_path)
    refused(lambda out: build_lod(TREE, out / "lod.obj", LodConfig(), on_progress=idle), r"ends in \.obj", tmp_path)
    (tmp_path / "lod.glb").mkdir()
    refused(lambda out: build_lod(TREE, tmp_path / "lod.glb", LodConfig(), work=out, on_progress=idle), "is a folder", tmp_path)


def test_comparisons_that_contradict_themselves(tmp_path: Path) -> None:
    thesis = RunConfig(fit=FitConfig(preset="thesis"))
    budgeted = CompareConfig(("bbfit-bytes",))
    refused(lambda out: compare(TREE, out, budgeted, thesis, on_progress=idle), "preset: 'thesis' cannot", tmp_path)
    few = RunConfig(views=ViewsConfig(count=6))
    refused(lambda out: compare(TREE, out, budgeted, few, on_progress=idle), "too few for a validation split", tmp_path)


def test_a_missing_encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: "install it")
    config = RunConfig(export=ExportConfig(textures="ktx2"))
    said = "textures: the encoder of ktx2, the package alktx2, is not installed; install it"
    refused(lambda out: run(TREE, out, config, on_progress=idle), said, tmp_path)
    refused(lambda out: build_lod(TREE, out / "lod.glb", LodConfig(), config, on_progress=idle), said, tmp_path)
    refused(lambda out: compare(TREE, out, CompareConfig(), config, on_progress=idle), said, tmp_path)
    refused(lambda out: run_sweep(out, SweepConfig("default"), config, trees=[TREE], on_progress=idle), said, tmp_path)


def test_a_missing_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bpy", None)
    said = "Blender: its module bpy is not installed"
    for source in (TREE, None):
        refused(lambda out: run(source, out, on_progress=idle), said, tmp_path)  # noqa: B023
    refused(lambda out: build_lod(TREE, out / "lod.glb", on_progress=idle), said, tmp_path)
    refused(lambda out: compare(TREE, out, on_progress=idle), said, tmp_path)
    refused(lambda out: run_sweep(out, SweepConfig("default"), trees=[TREE], on_progress=idle), said, tmp_path)


def test_what_is_refused_later_leaves_no_folder_either(tmp_path: Path) -> None:
    """A tree that grows too large, and one without faces, which only Blender finds out."""
    large = RunConfig(species="acer", grow=GrowConfig(max_vertices=1000))
    refused(lambda out: run(None, out, large), "the limit is 1,000", tmp_path)
    assert main(["run", "--species", "acer", "--max-vertices", "1000", "--out", str(tmp_path / "new" / "out")]) == 2
    assert not list(tmp_path.iterdir())


def test_a_tree_that_blender_refuses_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    config = RunConfig(views=ViewsConfig(**VIEWS))
    said = "has no faces to render"
    refused(lambda out: run(tmp_path / "points.obj", out, config), said, tmp_path)
    refused(lambda out: build_lod(tmp_path / "points.obj", out / "lod.glb", None, config), said, tmp_path)
    refused(lambda out: compare(tmp_path / "points.obj", out, None, config), said, tmp_path)


def test_finished_views_need_no_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with all views is fitted on a machine without Blender, and whatever the device was."""
    monkeypatch.undo()
    fit = FitConfig(billboards=1, placement="even", steps=2)
    run(TREE, tmp_path, RunConfig(views=ViewsConfig(**VIEWS), fit=fit))
    monkeypatch.setitem(sys.modules, "bpy", None)
    elsewhere = RunConfig(views=ViewsConfig(**VIEWS, render_device="metal"), fit=FitConfig(billboards=1, placement="even", steps=3))
    assert run(TREE, tmp_path, elsewhere).skipped == ("views",)
