"""The command line: exit codes, one clear line for bad input, options plain and nested."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import bbfit
from bbfit.cli import main
from bbfit.cli.console import out_console
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import split_glb
from bbfit.images import write_png
from bbfit.outputs import single_files
from bbfit.provenance import digest_file
from bbfit.reporting.tables import report_table
from bbfit.stages.results import original_tree
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.species import figures_file, known_species

DATA = Path(__file__).resolve().parents[1] / "data"
QUICK = ["--billboards", "2", "--candidates", "2", "--refinement-rounds", "0", "--steps", "3"]


@pytest.fixture(scope="module")
def fitted(views_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cli") / "fit"
    assert main(["fit", str(views_folder), "--out", str(out), *QUICK]) == 0
    return out


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must fail for bad input, and return the one line that it says."""
    capsys.readouterr()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("bbfit: ") and not captured.out
    return lines[0]


@pytest.mark.parametrize(
    "command",
    [[]]
    + [[name] for name in ("run", "grow", "views", "fit", "evaluate", "export", "thin", "lod", "sweep", "compare", "library", "forest")],
)
def test_help_shows_defaults_and_needs_no_torch(command: list[str]) -> None:
    script = (
        "import sys; from bbfit.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "finally: print('torch' in sys.modules, 'cv2' in sys.modules, file=sys.stderr)"
    )
    result = subprocess.run([sys.executable, "-c", script, *command, "--help"], capture_output=True, text=True)
    assert result.returncode == 0 and result.stderr.split() == ["False", "False"]
    assert "usage" in result.stdout
    assert not command or command == ["evaluate"] or "default:" in result.stdout


def test_fit_writes_what_run_writes_for_the_same_views(views_folder: Path, fitted: Path, tmp_path: Path) -> None:
    assert main(["run", str(views_folder), "--out", str(tmp_path), *QUICK]) == 0
    for name in ("cloud.safetensors", "model.glb", "model.obj"):
        assert (tmp_path / name).read_bytes() == (fitted / name).read_bytes()


EXPORTS = {
    "default": ([], bbfit.ExportConfig()),
    "blended": (
        ["--alpha", "blend", "--split", "--outline", "hull", "--corners", "6", "--mip-files"],
        bbfit.ExportConfig(alpha="blend", split=True, outline="hull", corners=6, mip_files=True),
    ),
}


@pytest.mark.parametrize("kind", EXPORTS)
def test_there_is_one_evaluation(kind: str, views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A fit's metrics.json, the command's JSON and printout, and the library's report are equal but for the seconds."""
    options, export = EXPORTS[kind]
    run, again = tmp_path / "run", tmp_path / "again.json"
    tree = ["--tree", str(DATA / "tree.glb")]
    assert main(["fit", str(views_folder), "--out", str(run), "--placement", "even", *tree, *QUICK, *options]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(run / "cloud.safetensors"), str(views_folder), "--out", str(again), *tree, *options]) == 0
    printed = capsys.readouterr().out
    views = bbfit.ViewDataset.load(views_folder)
    cloud, original = BillboardCloud.load(run / "cloud.safetensors"), original_tree(views, TreeFile.open(DATA / "tree.glb"))
    report = dataclasses.replace(bbfit.evaluate(cloud, views.test, export=export, original=original), seconds={})
    assert report.overdraw and report.sizes and report.vertices.ratio
    for path in (run / "metrics.json", again):
        found = bbfit.Report.load(path)
        assert found.subject.cloud == digest_file(run / "cloud.safetensors") and found.bytes.model == (run / "model.glb").stat().st_size
        assert dataclasses.replace(found, seconds={}, subject=report.subject, bytes=report.bytes) == report and set(found.seconds) == {
            "fit",
            "export",
            "evaluate",
        }
    out_console.print(report_table(found, thesis=False))
    expected = [line.rstrip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert [line.rstrip() for line in printed.splitlines() if line.strip()][: len(expected)] == expected


@pytest.mark.parametrize("name", ["tree.glb", "tree.obj"])
def test_export(fitted: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(fitted / "cloud.safetensors"), "--out", str(tmp_path / name), "--alpha", "mask"]) == 0
    assert name in capsys.readouterr().out.replace("\n", "")
    assert (tmp_path / name).stat().st_size > 0


def test_an_export_knows_the_score_of_its_cloud_alone(fitted: Path, tmp_path: Path) -> None:
    """A cloud beside the metrics of another cloud, or in another alpha mode, has no score."""

    def facts(cloud: Path, *options: str) -> dict[str, Any]:
        out = tmp_path / "out.glb"
        assert main(["export", str(cloud), "--out", str(out), *options]) == 0
        return split_glb(out.read_bytes())[0]["asset"]["extras"]["bbfit"]

    cloud, report = fitted / "cloud.safetensors", bbfit.Report.load(fitted / "metrics.json")
    known = facts(cloud)
    assert known == split_glb((fitted / "model.glb").read_bytes())[0]["asset"]["extras"]["bbfit"]
    assert known["score"]["psnr"] == pytest.approx(report.mean.over.mean.psnr, rel=1e-4) and known["score"]["views"] == len(report.views)
    other = facts(cloud, "--alpha", "blend")
    assert other["alpha"] == {"mode": "blend"} and "score" not in other and "distances" not in other and other["tree"] == known["tree"]
    alone = tmp_path / "birch.safetensors"
    shutil.copy(cloud, alone)
    assert facts(alone)["tree"] == "birch" and "score" not in facts(alone)
    shutil.copy(fitted / "metrics.json", tmp_path)
    assert "score" in facts(alone)
    changed = dataclasses.replace(report, subject=dataclasses.replace(report.subject, cloud="0" * 64))
    changed.save(tmp_path / "metrics.json")
    assert "score" not in facts(alone)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fit", "{tmp}/none", "--out", "{tmp}/o"], "does not exist"),
        (["fit", "{tmp}", "--out", "{tmp}/o"], "no transforms_train.json"),
        (["fit", "{views}", "--out", "{tmp}/o", "--billboards", "0"], "at least 1"),
        (["fit", "{views}", "--out", "{views}/transforms_train.json"], "is a file"),
        (["fit", "{views}", "--out", "{tmp}/o", "--sides", "pair"], "--placement even"),
        (["fit", "{views}", "--out", "{tmp}/o", "--tree", "{tmp}/none.glb"], "none.glb"),
        (["fit", "{views}", "--out", "{tmp}/o", "--tree", "{data}/tree.glb"], "not where the views show a tree"),
        (["run", "{tmp}/none.glb", "--out", "{tmp}/o"], "none.glb"),
        (["run", "{tmp}/empty.glb", "--out", "{tmp}/o"], "is empty"),
        (["run", "{tmp}/tree.docx", "--out", "{tmp}/o"], ".glb"),
        (["views", "{tmp}/none.glb", "--out", "{tmp}/o"], "none.glb"),
        (["evaluate", "{tmp}/none.safetensors", "{views}"], "none.safetensors"),
        (["evaluate", "{cloud}", "{views}", "--out", "{cloud}/metrics.json"], "{cloud}"),
        (["evaluate", "{tmp}/tree.docx", "{views}"], "tree.docx"),
        (["export", "{cloud}", "--out", "{tmp}/model.stl"], ".glb or .obj"),
        (["export", "{cloud}", "--out", "{tmp}/nowhere/model.glb"], "nowhere"),
        (["export", "{cloud}", "--out", "{tmp}/model.obj", "--textures", "ktx2"], "textures: an OBJ file has a PNG, not ktx2"),
        (["export", "{cloud}", "--out", "{tmp}/model.obj", "--quantized"], "quantized: an OBJ file has decimal numbers"),
        (["export", "{cloud}", "--out", "{tmp}/model.glb", "--up", "z"], "up: a GLB is Y up"),
        (["export", "{cloud}", "--out", "{tmp}/model.glb", "--no-fallback"], "fallback: PNG is the only texture"),
        (["export", "{cloud}", "--out", "{tmp}/model.glb", "--outline", "hull", "--pieces", "4"], "pieces: a hull is one polygon"),
        (["export", "{cloud}", "--out", "{tmp}/model.glb", "--outline", "rectangle", "--corners", "5"], "corners: a rectangle has four"),
        (["export", "{cloud}", "--out", "{tmp}/model.glb", "--padding", "100000"], "padding: expected a value in [1, 64], got 100000"),
        (["export", "{tmp}/empty.glb", "--out", "{tmp}/model.glb"], "empty.glb"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], says: str, views_folder: Path, fitted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.glb").touch()
    (tmp_path / "tree.docx").write_text("not a tree")
    places = {"data": DATA, "tmp": tmp_path, "views": views_folder, "cloud": fitted / "cloud.safetensors"}
    assert says.format(**places) in refused([part.format(**places) for part in arguments], capsys)
    assert not (tmp_path / "o" / "cloud.safetensors").exists()


@pytest.mark.parametrize("option", ["--billboards", "--count", "--padding"])
def test_a_bad_value_in_a_stage_of_a_run_is_one_line(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["run", str(tmp_path / "tree.glb"), "--out", str(tmp_path / "out"), option, "0"], capsys)
    assert option[2:] in line and "at least" in line


TRIALS = ["--placement", "even", "--steps", "3", "--views-per-step", "1"]


@pytest.mark.parametrize(
    ("options", "limits", "tried"),
    [
        (["--vertices", "8"], {"vertices": 8}, [(1, "one"), (2, "one"), (1, "two")]),
        (["--vertices", "8", "--sides", "two"], {"vertices": 8}, [(1, "two")]),
        (["--texels", "1.5k"], {"texels": "1.5k"}, None),
        (["--bytes", "9k"], {"bytes": "9k"}, None),
        (["--bytes", "9000", "--vertices", "4"], {"vertices": 4, "bytes": 9000}, None),
        (
            ["--target-psnr", "3", "--least-billboards", "1", "--most-billboards", "4"],
            {"target_psnr": 3.0},
            [(4, "one"), (1, "one")],
        ),
        (["--auto", "--vertices", "4"], {"vertices": 4, "auto": True}, [(1, "one")]),
    ],
)
def test_fit_within_a_budget(
    views_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    limits: dict[str, object],
    tried: list[tuple[int, str]] | None,
) -> None:
    assert main(["fit", str(views_folder), "--out", str(tmp_path), *TRIALS, *options]) == 0
    written = json.loads((tmp_path / "pareto.json").read_text())
    assert written["budget"] == limits and (tmp_path / "pareto.png").stat().st_size > 0
    assert tried in (None, [(trial["billboards"], trial["sides"]) for trial in written["trials"]])
    cloud = BillboardCloud.load(tmp_path / "cloud.safetensors")
    assert "vertices" not in limits or cloud.vertex_count <= limits["vertices"]  # type: ignore[operator]
    assert "texels" not in limits or len(cloud.texels) <= 1500
    assert "bytes" not in limits or (tmp_path / "model.glb").stat().st_size <= 9000
    assert "no short fit" not in capsys.readouterr().out


def test_an_export_has_the_outline_of_its_run(views_folder: Path, tmp_path: Path) -> None:
    """So does a score, unless another outline is requested or the cloud is not that of the run."""
    run, model = tmp_path / "run", tmp_path / "model.glb"
    cloud = run / "cloud.safetensors"

    def exported(file: Path, *options: str) -> bytes:
        assert main(["export", str(file), "--out", str(model), *options]) == 0
        return model.read_bytes()

    assert main(["fit", str(views_folder), "--out", str(run), *TRIALS, "--vertices", "4"]) == 0
    original = (run / "model.glb").read_bytes()
    default = exported(cloud, "--outline", "pieces")
    assert exported(cloud) == original != default
    assert exported(cloud, "--corners", "8") != original  # the run has hulls of 4 corners
    assert main(["evaluate", str(cloud), str(views_folder), "--out", str(tmp_path / "again.json")]) == 0
    assert bbfit.Report.load(tmp_path / "again.json").vertices.model == bbfit.Report.load(run / "metrics.json").vertices.model <= 4
    record = (run / "run.json").read_text()
    recorded = record.replace('"up": "auto"', '"up": "z"').replace('"pieces": null', '"pieces": 4')
    assert recorded.count('"z"') == recorded.count('"pieces": 4') == 1
    (run / "run.json").write_text(recorded)
    assert exported(cloud) == original  # what the run asked for is no request of the export, although it has no effect
    (run / "run.json").unlink()
    assert exported(cloud) == default  # no record
    (run / "run.json").write_text(record.replace(digest_file(cloud), "0" * 64))
    assert exported(cloud) == default  # the record of another cloud
    (run / "run.json").write_text(record.replace('"hull"', '"circle"'))
    assert exported(cloud) == default  # of another version


def test_mip_files_of_a_larger_atlas_are_removed(views_folder: Path, tmp_path: Path) -> None:
    """By a run and by an export; files of the user stay."""

    def levels(folder: Path, *options: str) -> list[str]:
        assert main(["fit", str(views_folder), "--out", str(folder), *QUICK, "--mip-files", *options]) == 0
        assert main(["export", str(folder / "cloud.safetensors"), "--out", str(tmp_path / "planes.obj"), "--mip-files", *options[2:]]) == 0
        stored = json.loads((folder / "run.json").read_text())["stages"]["export"]["outputs"]
        found = sorted(path.name for path in folder.glob("model_mip*.png"))
        assert found == sorted(name for name in stored if "mip" in name)
        assert len(list(tmp_path.glob("planes_mip[0-9]*.png"))) == len(found)
        return found

    (tmp_path / "planes_map.png").write_text("mine")
    assert main(["fit", str(views_folder), "--out", str(tmp_path / "run"), *QUICK]) == 0
    assert main(["export", str(tmp_path / "run" / "cloud.safetensors"), "--out", str(tmp_path / "planes_mipmapped.obj")]) == 0
    large = levels(tmp_path / "run", "--texel-density", "1")
    small = levels(tmp_path / "run", "--texel-density", "0.1", "--padding", "1")
    assert 0 < len(small) < len(large) and (tmp_path / "planes_map.png").read_text() == "mine"
    (tmp_path / "planes_mip1.png").write_text("mine")
    assert main(["export", str(tmp_path / "run" / "cloud.safetensors"), "--out", str(tmp_path / "planes.obj")]) == 0
    assert sorted(path.name for path in tmp_path.glob("planes_m*.png")) == ["planes_map.png", "planes_mip1.png", "planes_mipmapped.png"]
    assert (tmp_path / "planes_mip1.png").read_text() == (tmp_path / "planes_map.png").read_text() == "mine"


def test_run_within_a_budget_is_fit_within_it(views_folder: Path, tmp_path: Path) -> None:
    for command in ("run", "fit"):
        options = ["--out", str(tmp_path / command), *TRIALS, "--vertices", "4", "--texels", "1k"]
        assert main([command, str(views_folder), *options]) == 0
    for name in ("cloud.safetensors", "model.glb"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "fit" / name).read_bytes()
    assert json.loads((tmp_path / "run" / "pareto.json").read_text())["budget"] == {"vertices": 4, "texels": "1k"}


def test_a_missed_target_is_said_and_no_failure(views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", str(views_folder), "--out", str(tmp_path), *TRIALS, "--target-psnr", "90.5", "--vertices", "4"]) == 0
    assert "no short fit within the budget reached 90.5 dB" in " ".join(capsys.readouterr().out.split())


def test_bytes_that_are_left_are_said(views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bounds = ["--least-billboards", "1", "--most-billboards", "2"]
    assert main(["fit", str(views_folder), "--out", str(tmp_path), *TRIALS, *bounds, "--bytes", "1M"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "less than half of the limit; more billboards look better near by: allow more than 2 with --most-billboards" in said


@pytest.mark.parametrize("command", ["fit", "run"])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--vertices", "3"], "vertices: expected at least 4, got 3"),
        (["--texels", "0"], "texels: expected at least 1, got 0"),
        (["--texels", "2.5"], "texels: '2.5' is not a whole number"),
        (["--bytes", "much"], "bytes: 'much' is no number; write for example 200000, 200k or 1.5M"),
        (["--bytes", "60kb"], "bytes: '60kb' is no number"),
        (["--target-psnr", "0"], "target_psnr: expected a value in (0, 100], got 0"),
        (["--target-psnr", "nan"], "target_psnr: expected a value in (0, 100], got nan"),
        (["--target-psnr", "30", "--auto"], "auto: auto and a target PSNR both decide when to stop"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_budget_that_cannot_be_is_one_line(
    views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, options: list[str], says: str
) -> None:
    assert says in refused([command, str(views_folder), "--out", str(tmp_path / "out"), *options], capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--vertices", "8", "--billboards", "2"], "bbfit: billboards: 2 are requested in addition to a budget; leave out one of them"),
        (["--auto", "--preset", "thesis"], "bbfit: preset: 'thesis' cannot be combined with a budget"),
        (["--vertices", "4", "--sides", "two"], "bbfit: vertices: 4 are too few for one billboard"),
        (["--bytes", "10", "--vertices", "4"], "bbfit: budget: 1 billboard with "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_budget_that_cannot_be_kept_is_exit_code_2(
    views_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    says: str,
) -> None:
    """What is wrong stands in the last line, after the progress."""
    quick = [] if "--preset" in options else TRIALS
    assert main(["fit", str(views_folder), "--out", str(tmp_path), *quick, *options]) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith(says)
    assert not (tmp_path / "cloud.safetensors").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--max-texels", "1"], "max_texels: 1 are too few for 2 textures"),
        (["--restarts", "0"], "restarts: expected at least 1, got 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_limits_of_a_fit_that_cannot_be_are_one_line(
    views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    assert says in refused(["fit", str(views_folder), "--out", str(tmp_path), *QUICK, "--placement", "even", *options], capsys)


def test_grow_writes_what_the_function_makes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--seed", "4", "--detail", "0.3", "--leaves", "0.05"]
    for name in ("acer.glb", "acer.obj"):
        assert main(["grow", "acer", "--out", str(tmp_path / name), *options]) == 0
    assert "vertices" in capsys.readouterr().out
    bbfit.write_tree(bbfit.grow("acer", seed=4, detail=0.3, leaves=0.05), tmp_path / "same.glb")
    assert (tmp_path / "same.glb").read_bytes() == (tmp_path / "acer.glb").read_bytes()
    assert (tmp_path / "acer.mtl").is_file()


def test_grow_takes_a_species_of_ones_own(tmp_path: Path) -> None:
    figures = json.loads(figures_file().read_text())["apple"]
    (tmp_path / "own.json").write_text(json.dumps({"pear": figures | {"Leaves": 0}}))
    assert main(["grow", "--species-file", str(tmp_path / "own.json"), "--out", str(tmp_path / "pear.glb"), "--detail", "0.2"]) == 0
    assert set(trimesh.load(tmp_path / "pear.glb").geometry) == {"bark"}


def test_grow_lists_the_species(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grow", "--list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in known_species()) and "13 ± 3" in said and "species.json" in said.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["grow", "willow", "--out", "{tmp}/t.glb"], "weeping_willow"),
        (["grow", "acer"], "--out acer.glb"),
        (["grow", "acer", "--out", "{tmp}/t.stl"], ".glb or .obj"),
        (["grow", "acer", "--out", "{tmp}/none/t.glb"], "does not exist"),
        (["grow", "acer", "--out", "{tmp}/t.glb", "--detail", "0"], "detail"),
        (["grow", "acer", "--out", "{tmp}/t.glb", "--leaves", "1.5"], "leaves"),
        (["grow", "acer", "--out", "{tmp}/t.glb", "--max-vertices", "1000"], "the limit is 1,000"),
        (["grow", "--species-file", "{tmp}/none.json", "--out", "{tmp}/t.glb"], "none.json"),
        (["grow", "--species-file", "{tmp}/bad.json", "--out", "{tmp}/t.glb"], "nCurveRes"),
        (["run", "--species", "willow", "--out", "{tmp}/o"], "weeping_willow"),
        (["run", "{tmp}/t.glb", "--leaves", "0.3", "--out", "{tmp}/o"], "no tree is grown"),
    ],
)
def test_a_tree_that_cannot_be_grown_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = json.loads(figures_file().read_text())["apple"]
    (tmp_path / "bad.json").write_text(json.dumps({"pear": figures | {"nCurveRes": [0, 1, 1, 1]}}))
    assert says in refused([part.format(tmp=tmp_path) for part in arguments], capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.json"]


def test_sweep_shows_its_runs_and_what_failed(views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"no tree")
    grid = tmp_path / "grid.yaml"
    grid.write_text("fit: {billboards: 2}\naxes: {seed: [0, 1]}")
    options = [
        "--grid",
        str(grid),
        "--steps",
        "3",
        "--workers",
        "1",
        "--candidates",
        "1",
        "--refinement-rounds",
        "0",
    ]
    command = ["sweep", "--out", str(tmp_path / "out"), "--views", str(views_folder), "--trees", str(bad), *options]
    for stood in (0, 2):
        assert main(command) == 0
        out = capsys.readouterr().out
        assert f"tables in {tmp_path / 'out'}" in out.replace("\n", "") and "2 runs failed" in out and "failed: tree:" in out
        assert ("results kept" in out) == bool(stood)
    assert len((tmp_path / "out" / "table.csv").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ([], "no trees"),
        (["--grid", "none", "--species", "acer"], "neither built in nor"),
        (["--species", "cactus"], "species: expected one of"),
        (["--species", "acer", "--gpus", "1"], "gpus: only Ray"),
        (["--species", "acer", "--ray", "127.0.0.1:1"], "no cluster answers at 127.0.0.1:1"),
    ],
)
def test_bad_sweeps_are_one_line(options: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = ["sweep", "--out", str(tmp_path / "out"), *([] if options else ["--grid", "default"])]
    assert complaint in refused([*start, *options], capsys)


def test_bad_comparisons_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "does not exist" in refused(["compare", str(tmp_path / "none.glb"), "--out", str(tmp_path)], capsys)
    for options in (["--seeds", "1", "2"], ["--detail", "0.3"], ["--workers", "2"], ["--ray", "local"]):
        assert "are for --trees and --species" in refused(["compare", "tree.glb", *options], capsys)
    assert "systems: expected one of" in refused(["compare", "tree.glb", "--systems", "octree"], capsys)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("bbfit ")


def test_a_view_without_content_is_named(views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    views = Path(shutil.copytree(views_folder, tmp_path / "views"))
    for picture in (views / "images").iterdir():
        write_png(picture, np.zeros((40, 48, 4), np.uint8))
    assert "fully transparent" in refused(["fit", str(views), "--out", str(tmp_path / "out"), *QUICK], capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        ["grow-wings"],
        ["fit"],
        ["fit", "x", "--out", "y", "--steps", "many"],
        ["fit", "x", "--out", "y", "--vertices", "few"],
        ["fit", "x", "--out", "y", "--target-psnr", "good"],
        ["run", "--no-such", "1"],
        ["evaluate", "x", "y", "--vertices", "8"],
        ["export", "x", "--out", "y", "--split", "True"],
    ],
)
def test_unknown_options_are_exit_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr().err


def test_a_fault_of_ours_is_exit_code_1(views_folder: Path, tmp_path: Path) -> None:
    script = "import sys, bbfit.cli as cli, bbfit.pipeline as p\np.run = lambda *a, **k: 1 / 0\nsys.exit(cli.main(sys.argv[1:]))"
    command = [sys.executable, "-c", script, "fit", str(views_folder), "--out", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 1 and "ZeroDivisionError" in result.stderr


def test_a_disk_that_fills_up_leaves_the_earlier_model(fitted: Path, tmp_path: Path) -> None:
    """A limit on file size makes a real write fail half-way, as a full disk does."""
    model = tmp_path / "model.glb"
    with single_files("bbfit export", tmp_path, [model.name]):
        model.write_bytes(b"earlier")
    script = "import sys; from bbfit.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", script, "export", str(fitted / "cloud.safetensors"), "--out", str(model)]
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))  # noqa: E731
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit, env=environment)
    assert result.returncode == 2, result.stderr
    assert (
        result.stderr.startswith("bbfit: ")
        and "model.glb cannot be written" in result.stderr
        and len(result.stderr.strip().splitlines()) == 1
    )
    assert model.read_bytes() == b"earlier" and {path.name for path in tmp_path.iterdir()} == {"model.glb", ".bbfit.json"}


def test_a_run_killed_outright_goes_on(views_folder: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of the fit; the same command ends with the result of an unbroken run."""
    script = "import sys; from bbfit.cli import main; sys.exit(main(sys.argv[1:]))"
    options = ["--billboards", "2", "--candidates", "2", "--refinement-rounds", "0", "--steps", "120", "--checkpoint-every", "10"]
    command = [sys.executable, "-c", script, "fit", str(views_folder), *options, "--out"]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # as this process, so that the results are equal to the bit
    process = subprocess.Popen([*command, str(tmp_path / "broken")], stderr=subprocess.DEVNULL, env=one_thread)
    while not (tmp_path / "broken" / "fit.checkpoint").exists():
        assert process.poll() is None, "the fit ended before it was killed"
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert not (tmp_path / "broken" / "cloud.safetensors").exists()
    for name in ("broken", "whole"):
        assert main(["fit", str(views_folder), *options, "--out", str(tmp_path / name)]) == 0
    whole, broken = (BillboardCloud.load(tmp_path / name / "cloud.safetensors") for name in ("whole", "broken"))
    assert torch.equal(whole.texels, broken.texels)
