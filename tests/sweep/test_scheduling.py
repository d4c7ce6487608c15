"""Sweeps on one machine: every run once, whatever was killed, edited or failed before."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from billboard_scene import crossing_billboards, write_views

from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig, run
from bbfit.reporting.sweep_tables import SweepRow
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.scheduling import SweepResult, run_sweep, sources
from bbfit.trees.config import GrowConfig
from bbfit.trees.species import figures_file

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
QUICK = SweepConfig(workers=2, loss=("l1", "l2"), billboards=(2,), variants=("base", "double"))
"""Four runs a tree."""
SHORT = RunConfig(fit=FitConfig(steps=12))


@pytest.fixture(scope="module")
def two_trees(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folders = [tmp_path_factory.mktemp("trees") / name for name in ("oak", "elm")]
    for number, folder in enumerate(folders):
        folder.mkdir()
        write_views(folder, crossing_billboards(2 + number), count=6)
    return folders


@pytest.fixture(scope="module")
def done(two_trees: list[Path], tmp_path_factory: pytest.TempPathFactory) -> SweepResult:
    return run_sweep(tmp_path_factory.mktemp("sweep") / "out", QUICK, SHORT, views=two_trees)


def copied(done: SweepResult, folder: Path) -> Path:
    return Path(shutil.copytree(done.folder, folder / "sweep"))


def times(folder: Path) -> dict[str, int]:
    """When each result was written."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "results").iterdir()}


def psnr(row: SweepRow) -> float:
    assert row.facts
    return float(row.facts["report"]["over"]["mean"]["psnr"])


def test_options_of_the_export_are_checked_on_a_cluster_too(two_trees: list[Path], tmp_path: Path) -> None:
    config = SweepConfig(grid="default", ray="auto")
    lit = RunConfig(fit=FitConfig(light="maps"), export=ExportConfig(material="unlit", textures="ktx2"))
    with pytest.raises(InputError, match=r"^material: the cloud has maps"):
        run_sweep(tmp_path / "out", config, lit, views=two_trees)


def test_every_configuration_of_every_tree_is_run(done: SweepResult) -> None:
    assert [row.tree for row in done.rows] == ["oak"] * 4 + ["elm"] * 4 and done.kept == 0
    labels = [tuple(row.labels.values()) for row in done.rows[:4]]
    assert labels == [(variant, loss, "2") for variant in ("base", "double") for loss in ("l1", "l2")]
    for row in done.rows:
        assert row.reason is None and row.facts and row.steps == 12
        assert row.facts["report"]["vertices"]["model"] == int(row.labels["billboards"]) * (8 if row.labels["variant"] == "double" else 4)
        assert row.facts["billboards"] == int(row.labels["billboards"]) * (2 if row.labels["variant"] == "double" else 1)
        assert (done.folder / row.folder / "model.glb").is_file()
    assert len({row.folder for row in done.rows}) == 8
    assert {path.name for path in done.folder.iterdir()} == {"results", "runs", "table.csv", "table.md", "table.png", ".bbfit.json"}


def test_a_run_of_a_sweep_is_that_run(done: SweepResult, two_trees: list[Path], tmp_path: Path) -> None:
    fit = FitConfig(preset="thesis", sides="one", bounds="viewport", loss="l2", billboards=2, steps=12)
    alone = run(two_trees[1], tmp_path / "run", RunConfig(fit=fit))
    row = next(row for row in done.rows if row.tree == "elm" and tuple(row.labels.values()) == ("base", "l2", "2"))
    assert psnr(row) == alone.report.mean.over.mean.psnr
    assert (done.folder / row.folder / "model.glb").read_bytes() == (alone.folder / "model.glb").read_bytes()


def test_the_tables_tell_what_was_found(done: SweepResult) -> None:
    with (done.folder / "table.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(line["tree"], line["variant"], line["loss"], line["billboards"]) for line in table] == [
        (row.tree, *(row.labels[name] for name in ("variant", "loss", "billboards"))) for row in done.rows
    ]
    assert [float(line["psnr"]) for line in table] == [psnr(row) for row in done.rows]
    text = (done.folder / "table.md").read_text()
    assert "8 of 8 runs done, 12 steps each" in text and f"{psnr(done.rows[0]):.2f}" in text
    assert (done.folder / "table.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_is_done_twice(done: SweepResult, two_trees: list[Path], tmp_path: Path) -> None:
    """Nor with another grid that has runs in common, nor for the same views in another place."""
    folder = copied(done, tmp_path)
    before, told = times(folder), list[tuple[str, int, int]]()
    again = run_sweep(
        folder, QUICK, SHORT, views=two_trees, on_progress=lambda stage, now, total, note="": told.append((stage, now, total))
    )
    assert again.kept == 8 and times(folder) == before and [psnr(row) for row in again.rows] == [psnr(row) for row in done.rows]
    assert told == [("trees", 2, 2), ("runs", 8, 8)]
    moved = Path(shutil.copytree(two_trees[0], tmp_path / "ash"))
    more = run_sweep(folder, SweepConfig(workers=2, loss=("l2",), billboards=(2, 3), variants=("base",)), SHORT, views=[moved])
    assert more.kept == 1 and {name: time for name, time in times(folder).items() if name in before} == before and len(times(folder)) == 9
    assert psnr(more.rows[0]) == psnr(next(row for row in done.rows if tuple(row.labels.values()) == ("base", "l2", "2")))


def test_what_is_damaged_or_depends_on_something_else_is_made_anew(done: SweepResult, two_trees: list[Path], tmp_path: Path) -> None:
    folder = copied(done, tmp_path)
    results = sorted((folder / "results").iterdir())
    results[0].write_text("{")
    results[1].write_text('{"outcome": {"facts": 3}}')
    assert run_sweep(folder, QUICK, SHORT, views=two_trees).kept == 6
    results[2].unlink()
    assert run_sweep(folder, QUICK, SHORT, views=two_trees).kept == 7
    other = run_sweep(folder, QUICK, RunConfig(fit=FitConfig(seed=1, steps=12)), views=two_trees[:1])
    assert other.kept == 0 and psnr(other.rows[0]) != psnr(done.rows[0])


def test_a_killed_sweep_goes_on_where_it_was(done: SweepResult, two_trees: list[Path], tmp_path: Path) -> None:
    """Killed with all its processes after the second result."""
    folder = tmp_path / "killed"
    script = tmp_path / "sweep.py"
    script.write_text(f"""
import os, signal, sys
from pathlib import Path
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.scheduling import run_sweep

def kill(stage, done, total, note=""):
    if stage == "runs" and done == 2:
        os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    run_sweep(Path({str(folder)!r}), {QUICK!r}, RunConfig(fit=FitConfig(steps=12)), views=[Path(sys.argv[1])], on_progress=kill)
""")
    assert subprocess.run([sys.executable, str(script), two_trees[0]]).returncode == -signal.SIGKILL
    before = times(folder)
    result = run_sweep(folder, QUICK, SHORT, views=two_trees[:1])
    assert 2 <= result.kept == len(before) < 4 and {name: times(folder)[name] for name in before} == before
    assert [psnr(row) for row in result.rows] == [psnr(row) for row in done.rows[:4]]


def test_failures_are_recorded_and_retried_when_asked(two_trees: list[Path], tmp_path: Path) -> None:
    """A tree that cannot be read and views that are too few; the good tree's run is made."""
    bad, broken = tmp_path / "bad.glb", tmp_path / "broken"
    bad.write_bytes(b"no tree")
    shutil.copytree(two_trees[0], broken)
    (broken / "0001.png").write_bytes(b"no picture")
    config = SweepConfig(grid="default", workers=1)
    stages = RunConfig(fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=8))
    result = run_sweep(tmp_path / "out", config, stages, trees=[bad], views=[broken, two_trees[0]])
    reasons = [row.reason for row in result.rows]
    assert "bad.glb is not a glTF" in str(reasons[0])
    assert "0001.png" in str(reasons[1]) and reasons[2] is None
    text = (result.folder / "table.md").read_text()
    assert "1 of 3 runs done" in text and f"bad, its one run: {reasons[0]}" in text
    shutil.copy(two_trees[0] / "0001.png", broken / "0001.png")
    mended = run_sweep(tmp_path / "out", config, stages, trees=[bad], views=[broken, two_trees[0]])
    assert [row.reason is None for row in mended.rows] == [False, True, True], "its views are others now"


def test_a_failed_run_stands_until_it_is_to_be_retried(two_trees: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    config = SweepConfig(grid="default", workers=1)
    stages = RunConfig(fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=8))
    first = run_sweep(folder, config, stages, views=two_trees[:1])
    (path,) = (folder / "results").iterdir()
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"outcome": content["outcome"] | {"facts": None, "reason": "out of memory"}}))
    stands = run_sweep(folder, config, stages, views=two_trees[:1])
    assert stands.kept == 1 and stands.rows[0].reason == "out of memory"
    retried = run_sweep(folder, SweepConfig(grid="default", workers=1, retry_failed=True), stages, views=two_trees[:1])
    assert retried.kept == 0 and retried.rows[0].reason is None and psnr(retried.rows[0]) == psnr(first.rows[0])


def test_trees_are_grown_and_rendered_once(tmp_path: Path) -> None:
    """A species and a tree's file, with views of 48 x 48 pixels by Blender; the second start finds all of them.

    Each tree has four views, and a second picture of the one that is held out.
    """
    stages = RunConfig(
        views=ViewsConfig(count=4, size=48, samples=1, denoise=False),
        fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=4),
    )
    config = SweepConfig(grid="default", workers=1)
    told = list[tuple[str, int, int]]()

    def sweep() -> SweepResult:
        told.clear()
        return run_sweep(
            tmp_path / "out",
            config,
            stages,
            species=["acer"],
            trees=[TREE],
            on_progress=lambda stage, now, total, note="": told.append((stage, now, total)),
        )

    first = sweep()
    assert [row.tree for row in first.rows] == ["acer", "tree"] and all(row.reason is None for row in first.rows)
    assert (tmp_path / "out" / "trees" / "acer" / "tree.glb").is_file()
    assert told[0] == ("trees", 0, 2) and told[-1] == ("runs", 2, 2)
    pictures = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "trees").rglob("*.png")}
    assert len(pictures) == 10 and sum(path.name.startswith("turned_") for path in pictures) == 2
    again = sweep()
    assert again.kept == 2 and told == [("trees", 2, 2), ("runs", 2, 2)]
    (tmp_path / "out" / "trees" / "tree" / "views" / "images" / "0002.png").unlink()
    (tmp_path / "out" / "trees" / "tree" / "views" / "transforms_test.json").unlink()
    assert sweep().kept == 2
    now = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "trees").rglob("*.png")}
    assert now.keys() == pictures.keys() and sum(now[path] != pictures[path] for path in now) == 1


def test_species_of_ones_own_file_are_grown(tmp_path: Path) -> None:
    """An acer by another name; its file may lie elsewhere at the next start."""
    figures = json.loads(figures_file().read_text())["acer"]
    views = ViewsConfig(count=4, size=48, samples=1, denoise=False)
    for folder, kept in (("here", 0), ("there", 1)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.json").write_text(json.dumps({"sapling": figures}))
        grown = GrowConfig(detail=0.1, leaves=0.02, species_file=tmp_path / folder / "own.json")
        stages = RunConfig(grow=grown, views=views, fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=4))
        result = run_sweep(tmp_path / "out", SweepConfig(grid="default", workers=1), stages, species=["sapling"])
        assert [(row.tree, row.reason) for row in result.rows] == [("sapling", None)] and result.kept == kept


def test_trees_have_names_of_their_own(tmp_path: Path) -> None:
    for name in ("oak", "elm"):
        (tmp_path / name / "views").mkdir(parents=True)
        (tmp_path / name / "tree.glb").write_bytes(b"x")
    trees = [tmp_path / name / "tree.glb" for name in ("oak", "elm")]
    assert [source.name for source in sources(["acer"], trees, [])] == ["acer", "oak_tree", "elm_tree"]
    assert [source.name for source in sources([], trees[:1], [tmp_path / "elm" / "views"])] == ["tree", "elm"]
    with pytest.raises(InputError, match=r"two trees are called \w+_oak; rename one, or omit one"):
        sources([], [], [tmp_path / "oak" / "views"] * 2)
    with pytest.raises(InputError, match="two trees are called acer"):
        sources(["acer", "acer"], [], [])
    with pytest.raises(InputError, match="there are no trees; give species, trees or views"):
        sources([], [], [])
    with pytest.raises(MissingFileError, match=r"none.glb does not exist"):
        sources([], [tmp_path / "none.glb"], [])


def test_budgets_are_refused(tmp_path: Path, two_trees: list[Path]) -> None:
    from bbfit.budget.config import BudgetConfig

    with pytest.raises(InputError, match="budget: a sweep runs the configurations of its grid"):
        run_sweep(tmp_path / "out", QUICK, RunConfig(budget=BudgetConfig(vertices=8)), views=two_trees)
    assert not (tmp_path / "out").exists()
