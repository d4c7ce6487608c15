"""The main job on a folder of views: everything is written, nothing is done twice, a kill costs little."""

from __future__ import annotations

import base64
import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import fit_inputs
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.glb import split_glb
from bbfit.images import read_rgba
from bbfit.layout import TEST_FILE
from bbfit.outputs import WRITTEN_FILE
from bbfit.pipeline import RunConfig, RunResult, run
from bbfit.stages.billboards import read_choice
from bbfit.stages.recorded import as_in_run
from bbfit.views.dataset import ViewDataset

TREE = Path(__file__).resolve().parents[1] / "data" / "tree.glb"
CONFIG = RunConfig(fit=FitConfig(billboards=2, candidates=2, refinement_rounds=0, steps=20, checkpoint_every=5))
FILES = ("cloud.safetensors", "comparison.png", "loss.csv", "loss.png", "metrics.json", "report.html", "run.json")
MODELS = ("model.glb", "model.mtl", "model.obj", "model.png")


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def done(views_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return run(views_folder, tmp_path_factory.mktemp("runs") / "new" / "run", CONFIG)


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_everything_is_written(done: RunResult) -> None:
    assert sorted(path.name for path in done.folder.iterdir()) == sorted([*FILES, *MODELS, WRITTEN_FILE])
    assert done.skipped == ()
    metrics = json.loads((done.folder / "metrics.json").read_text())
    assert set(metrics) >= {"over_white", "over", "colour", "rgba", "thesis_scale", "vertices", "bytes", "seconds", "views"}
    assert metrics["vertices"]["model"] == shipped_model(done.cloud).cards.vertex_count >= done.cloud.vertex_count == 8
    assert metrics["bytes"]["model"] == (done.folder / "model.glb").stat().st_size
    assert set(metrics["seconds"]) == {"fit", "export", "evaluate"}
    assert len(metrics["views"]) == 4
    assert torch.equal(BillboardCloud.load(done.folder / "cloud.safetensors").texels, done.cloud.texels)
    assert len((done.folder / "loss.csv").read_text().splitlines()) == 21
    assert read_rgba(done.folder / "model.png").shape[2] == 4


def test_record_holds_the_resolved_configuration(done: RunResult) -> None:
    record = json.loads((done.folder / "run.json").read_text())
    assert record["config"]["fit"]["learning_rate"] == 0.3 and record["config"]["fit"]["bounds"] == "silhouette"
    assert record["seeds"] == {"views": 0, "fit": 0}
    assert {"bbfit", "torch", "kornia", "python"} <= set(record["versions"])
    assert set(record["stages"]) == {"fit", "export", "evaluate", "report"}


def test_nothing_is_done_twice(views_folder: Path, done: RunResult) -> None:
    before, told = snapshot(done.folder), []
    again = run(views_folder, done.folder, CONFIG, on_progress=lambda *event: told.append(event))
    assert again.skipped == ("fit", "evaluate", "export", "report") and told == []
    assert again.report == done.report
    assert snapshot(done.folder) == before


def test_only_what_depends_on_a_change_is_done_again(views_folder: Path, tmp_path: Path, done: RunResult) -> None:
    run(views_folder, tmp_path, CONFIG)
    blended = dataclasses.replace(CONFIG, export=ExportConfig(alpha="blend"))
    assert run(views_folder, tmp_path, blended).skipped == ("fit",)
    (tmp_path / "comparison.png").unlink()
    assert run(views_folder, tmp_path, blended).skipped == ("fit", "export")
    (tmp_path / "model.obj").write_text("spoilt")
    assert "fit" in run(views_folder, tmp_path, blended).skipped
    assert (tmp_path / "model.obj").read_text() != "spoilt"
    other = dataclasses.replace(blended, fit=dataclasses.replace(CONFIG.fit, seed=1))
    assert run(views_folder, tmp_path, other).skipped == ()
    for damage in ("{", '{"stages": {"fit": {"inputs": 3}, "evaluate": 5, "old": {"x": 1}}}'):
        (tmp_path / "run.json").write_text(damage)
        assert run(views_folder, tmp_path, other).skipped == ()


def test_runs_and_scores_share_the_split_of_views_without_one(views_folder: Path, tmp_path: Path) -> None:
    """Whatever the seed of the fit: otherwise bbfit evaluate would score it on views that it was fitted to."""
    views = Path(shutil.copytree(views_folder, tmp_path / "views"))
    (views / TEST_FILE).unlink()
    run(views, tmp_path / "out", dataclasses.replace(CONFIG, fit=dataclasses.replace(CONFIG.fit, seed=5)))
    scored = [view["name"] for view in json.loads((tmp_path / "out" / "metrics.json").read_text())["views"]]
    assert sorted(scored) == sorted(ViewDataset.load(views).test.names)


def test_a_choice_is_fitted_on_the_device_of_the_command(tmp_path: Path) -> None:
    chosen = FitConfig(billboards=3, device="cuda:7", checkpoint_every=9).resolve()
    (tmp_path / "pareto.json").write_text(json.dumps({"config": dataclasses.asdict(chosen), "met": True}))
    assert read_choice(tmp_path, FitConfig(device="cpu:0")) == (dataclasses.replace(chosen, device="cpu:0", checkpoint_every=250), True)


def test_maps_depend_on_the_light_of_the_views() -> None:
    def inputs(strength: float) -> object:
        light = Light.of(torch.tensor([[0.0, 1.0, 0.0]]), strength, 1.0)
        views = SimpleNamespace(train=SimpleNamespace(light=light, fingerprint="a"), lit_train=SimpleNamespace(fingerprint="b"))
        return fit_inputs(views, FitConfig(light="maps"), None)  # type: ignore[arg-type]

    assert inputs(1.0) == inputs(1.0) != inputs(2.0)


def test_a_report_shows_an_atlas_that_webp_cannot_hold(views_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    largest = 32
    monkeypatch.setattr("bbfit.stages.results.WEBP_SIDE", largest)
    page = (run(views_folder, tmp_path, CONFIG).folder / "report.html").read_text()
    shown = json.loads(page.split('<script type="application/json" id="data">')[1].split("</script>")[0])
    assert max(read_rgba(tmp_path / "model.png").shape) > largest
    assert [image["mimeType"] for image in split_glb(base64.b64decode(shown["glb"]))[0]["images"]] == ["image/png"]


def test_a_killed_run_goes_on_to_the_same_result(views_folder: Path, tmp_path: Path, done: RunResult) -> None:
    def kill(stage: str, index: int, total: int, note: str = "") -> None:
        if stage == "fit" and index == 13:
            raise Killed

    with pytest.raises(Killed):
        run(views_folder, tmp_path, CONFIG, on_progress=kill)
    assert {path.name for path in tmp_path.iterdir()} == {"fit.checkpoint", WRITTEN_FILE}
    steps = []
    result = run(views_folder, tmp_path, CONFIG, on_progress=lambda stage, index, *rest: steps.append((stage, index)))
    assert steps[0] == ("fit", 11)
    assert torch.equal(result.cloud.texels, done.cloud.texels)
    for name in ("cloud.safetensors", "loss.csv", *MODELS):
        assert (tmp_path / name).read_bytes() == (done.folder / name).read_bytes()


def test_a_fit_whose_result_cannot_be_saved_is_not_lost(views_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "cloud.safetensors").mkdir()
    with pytest.raises(InputError, match=r"cloud\.safetensors cannot be written"):
        run(views_folder, tmp_path, CONFIG)
    (tmp_path / "cloud.safetensors").rmdir()
    told = []
    run(views_folder, tmp_path, CONFIG, on_progress=lambda stage, *rest: told.append(stage))
    assert "fit" not in told
    assert not (tmp_path / "fit.checkpoint").exists()


def test_a_fit_by_a_mesh_in_several_files_is_done_again_when_any_of_them_changes(views_folder: Path, tmp_path: Path) -> None:
    """The triangles of a .gltf are in its .bin, which the digest of the .gltf alone would miss."""
    corners = [[x, y, z] for x in (-0.6, 1.2) for y in (0.1, 2.3) for z in (-1.1, 0.7)]
    mesh = trimesh.convex.convex_hull(np.array(corners) * 0.5 + [0.15, 0.6, -0.1])
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), merge_buffers=True)
    files = {name.replace("model.gltf", "tree.gltf"): content for name, content in files.items()}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    config = dataclasses.replace(CONFIG, tree=tmp_path / "tree.gltf")
    run(views_folder, tmp_path / "out", config)
    assert "fit" in run(views_folder, tmp_path / "out", config).skipped
    (buffer,) = [tmp_path / name for name in files if name.endswith(".bin")]
    data = bytearray(buffer.read_bytes())
    start = json.loads(files["tree.gltf"])["bufferViews"][-1].get("byteOffset", 0)
    data[start : start + 4] = np.float32(np.frombuffer(data[start : start + 4], np.float32) * 0.99).tobytes()
    buffer.write_bytes(data)
    assert run(views_folder, tmp_path / "out", config).skipped == ()


def test_bad_views_leave_earlier_results_as_they_were(views_folder: Path, tmp_path: Path, done: RunResult) -> None:
    views = shutil.copytree(views_folder, tmp_path / "views")
    before = snapshot(done.folder)
    picture = sorted((views / "images").iterdir())[-1]
    picture.write_bytes(picture.read_bytes()[:200])
    with pytest.raises(InputError, match=picture.name):
        run(views, done.folder, CONFIG)
    assert snapshot(done.folder) == before


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_bad_picture_of_either_split_is_found_before_the_fit(views_folder: Path, tmp_path: Path, split: str) -> None:
    views = Path(shutil.copytree(views_folder, tmp_path / "views"))
    name = json.loads((views / f"transforms_{split}.json").read_text())["frames"][-1]["file_path"] + ".png"
    (views / name).write_bytes((views / name).read_bytes()[:-5])
    with pytest.raises(InputError, match="cut short"):
        run(views, tmp_path / "out", CONFIG, on_progress=lambda *event: pytest.fail("work was begun"))


def test_out_must_be_a_folder_that_can_be_written(views_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="is a file"):
        run(views_folder, tmp_path / "file", CONFIG)
    with pytest.raises(InputError, match="is a file"):
        run(views_folder, tmp_path / "file" / "deeper", CONFIG)
    assert (tmp_path / "file").read_text() == "mine"


def test_from_a_tree_to_a_model(tmp_path: Path) -> None:
    """The whole job with Blender, on the tree that comes with bbfit; a second run does nothing."""
    config = RunConfig(
        views=ViewsConfig(count=8, size=48, samples=2, denoise=False),
        fit=FitConfig(billboards=2, placement="even", placement_learning_rate=0, steps=10),
    )
    told = []
    run(TREE, tmp_path, config, on_progress=lambda stage, done, total, note="": told.append((stage, done, total)))
    assert [event for event in told if event[0] == "views"] == [("views", done, 10) for done in range(11)]  # of eight, two are turned too
    assert {"views/views.json", "views/images/0007.png"} <= {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["vertices"]["original"] > 10_000 and 0 < metrics["vertices"]["ratio"] < 1e-2
    assert metrics["bytes"]["original"] > 100_000
    assert set(metrics["seconds"]) == {"views", "fit", "export", "evaluate"} and metrics["seconds"]["views"] > 0
    # The model stands where the tree stands: on the ground, around the trunk at the origin.
    corners = [[float(word) for word in line.split()[1:]] for line in (tmp_path / "model.obj").read_text().splitlines() if line[:2] == "v "]
    low, high = (np.array(corners).min(0), np.array(corners).max(0))
    bounds = np.array(json.loads((tmp_path / "views" / "views.json").read_text())["tree"]["bounds"])
    assert abs(low[1] - bounds[0, 1]) < 0.5 and abs(high[1] - bounds[1, 1]) < 2  # branches nearer to a camera reach higher on the plane
    assert low[0] < 0 < high[0] and low[2] < 0 < high[2]

    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*") if path.name not in ("run.json",)}
    assert run(TREE, tmp_path, config).skipped == ("views", "fit", "evaluate", "export", "report")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with pytest.raises(InputError, match="size 48"):
        run(TREE, tmp_path, dataclasses.replace(config, views=dataclasses.replace(config.views, size=64)))


def test_an_obj_of_a_z_up_tree_is_z_up(views_folder: Path, tmp_path: Path) -> None:
    views = Path(shutil.copytree(views_folder, tmp_path / "views"))
    (views / "views.json").write_text(json.dumps({"tree": {"up_axis": "z", "vertices": 5000, "bytes": 90_000}}))
    result = run(views, tmp_path / "out", CONFIG)
    assert "Z up" in (tmp_path / "out" / "model.obj").read_text().splitlines()[0]
    assert as_in_run(ExportConfig(), tmp_path / "out" / "cloud.safetensors").up == "z"
    assert as_in_run(ExportConfig(up="y"), tmp_path / "out" / "cloud.safetensors").up == "y"
    vertices = json.loads((tmp_path / "out" / "metrics.json").read_text())["vertices"]
    model = shipped_model(result.cloud).cards.vertex_count
    assert vertices == {"model": model, "original": 5000, "ratio": model / 5000}
