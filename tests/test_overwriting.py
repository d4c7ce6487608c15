"""No command writes over a file that it did not make, nor over an input, and a refusal comes before any work."""

from __future__ import annotations

import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pytest

from bbfit.cli import main
from bbfit.fitting.config import FitConfig
from bbfit.outputs import claimed_folder
from bbfit.pipeline import RunConfig, RunResult, run

DATA = Path(__file__).resolve().parents[1] / "data"
FIT = ["--placement", "even", "--steps", "2"]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A finished run. Do not change its files."""
    return run(DATA / "views", tmp_path_factory.mktemp("done") / "run", RunConfig(fit=FitConfig(placement="even", steps=2)))


@pytest.fixture
def folder(done: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: a run, views, a tree, and files that are none of bbfit's business."""
    shutil.copytree(done.folder, tmp_path / "run")
    shutil.copytree(DATA / "views", tmp_path / "views")
    shutil.copy(DATA / "tree.glb", tmp_path)
    for name in ("table.csv", "compare.md", "metrics.json", "report.html", "notes.obj", "notes.mtl", "lod.glb"):
        (tmp_path / name).write_text("mine")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def state(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("lod tree.glb --out tree.glb", "tree.glb"),
        ("lod tree.glb --out lod.glb", "lod.glb"),
        ("lod tree.glb --out new.glb --work .", "lod.json"),
        ("run run/model.glb --out run", "model.glb"),
        ("run run/model.obj --out run", "model.obj"),
        ("run --species acer --out .", "tree.glb"),
        ("run tree.glb --out .", "metrics.json"),
        ("fit views --out .", "metrics.json"),
        ("fit views --tree run/model.glb --out run", "model.glb"),
        ("evaluate run/cloud.safetensors views --out views/images/0000.png", "0000.png"),
        ("evaluate run/cloud.safetensors views --out run/cloud.safetensors", "cloud.safetensors"),
        ("evaluate run/cloud.safetensors views --out run/model.glb", "model.glb"),
        ("evaluate run/cloud.safetensors views --out metrics.json", "metrics.json"),
        ("evaluate run/cloud.safetensors views --tree tree.glb --out tree.glb", "tree.glb"),
        ("export run/cloud.safetensors --out tree.glb", "tree.glb"),
        ("export run/cloud.safetensors --out run/model.glb", "model.glb"),
        ("export run/cloud.safetensors --out new.obj --mip-files", ""),
        ("export run/cloud.safetensors --out notes.obj", "notes.obj"),
        ("grow acer --out tree.glb", "tree.glb"),
        ("grow acer --out notes.obj", "notes.obj"),
        ("sweep --views views --out . --grid default", "table.csv"),
        ("compare tree.glb --out .", "compare.md"),
    ],
)
def test_a_file_in_the_way_is_refused_at_once(folder: Path, command: str, file: str, capsys: pytest.CaptureFixture[str]) -> None:
    if command.endswith("--work ."):
        (folder / "levels").mkdir()
        (folder / "levels" / "lod.json").write_text("mine")
    if not file:
        (folder / "new_mip0.png").write_text("mine")
        file = "new_mip0.png"
    before = state(folder)
    arguments = command.split() + (FIT if command.split()[0] in ("run", "fit", "lod", "sweep", "compare") else [])
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("bbfit: ") and len(said.splitlines()) == 1 and file in said
    assert "exists, and is a file that bbfit" in said or "is an input, which the results would replace" in said
    assert state(folder) == before


@pytest.mark.parametrize(
    "command",
    [
        "evaluate run/cloud.safetensors views",
        "evaluate run/cloud.safetensors views --out scores.json",
        "export run/cloud.safetensors --out new.obj",
        "grow acer --detail 0.1 --out acer.obj",
    ],
)
def test_what_a_command_wrote_it_writes_again_until_it_is_edited(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    mine = state(folder)
    assert main(command.split()) == 0 and main(command.split()) == 0
    written = state(folder)
    assert {name for name in mine if mine[name] != written[name]} <= {"run/metrics.json", "run/.bbfit.json"}
    name = (sorted(written.keys() - mine.keys() - {".bbfit.json"}) or ["run/metrics.json"])[0]
    edited = (folder / name).read_text() + "\n"
    (folder / name).write_text(edited)
    capsys.readouterr()
    assert main(command.split()) == 2
    assert f"{Path(name).name} has changed since bbfit wrote it" in capsys.readouterr().err
    assert (folder / name).read_text() == edited


def test_an_evaluated_run_goes_on(folder: Path) -> None:
    """The file that ``evaluate`` writes by default is that of the run, which may replace it."""
    assert main("evaluate run/cloud.safetensors views --padding 4".split()) == 0
    assert main(["fit", "views", "--out", "run", *FIT]) == 0
    assert not list((folder / "run").glob("*.changed"))


def test_an_edited_result_of_a_run_is_kept_beside_the_new_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "run" / "model.obj").write_text("edited")
    assert main(["fit", "views", "--out", "run", *FIT]) == 0
    assert (folder / "run" / "model.obj.changed").read_text() == "edited"
    assert (folder / "run" / "model.obj").read_text().startswith("#")
    assert "run/model.obj has changed since bbfit wrote it; it is now model.obj.changed" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["fit views --out run", "run tree.glb --out run", "evaluate run/cloud.safetensors views"])
def test_a_folder_in_use_is_refused(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with claimed_folder("out", folder / "run"):
        before = state(folder)
        script = "import sys; from bbfit.cli import main; sys.exit(main(sys.argv[1:]))"
        done = subprocess.run([sys.executable, "-c", script, *command.split()], capture_output=True, text=True)
        assert done.returncode == 2 and "run is in use by process" in done.stderr and len(done.stderr.splitlines()) == 1
        assert state(folder) == before
