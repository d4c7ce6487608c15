"""The record of a folder skips a stage exactly while its inputs and its outputs are the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from bbfit.checks import InputError
from bbfit.provenance import VERSIONS
from bbfit.stages.stage import RECORD_FILE, OnProgress, Record, Stage, record_head


@pytest.fixture
def runs() -> list[str]:
    """The names of the stages that have run."""
    return []


@pytest.fixture
def stage(tmp_path: Path, runs: list[str]) -> Stage:
    """Writes ``cloud.txt`` and reports two steps."""

    def work(on_progress: OnProgress) -> None:
        runs.append("fit")
        on_progress("fit", 1, 2, "half")
        (tmp_path / "cloud.txt").write_text("cloud")
        on_progress("fit", 2, 2)

    return Stage("fit", ("views", 1), ("cloud.txt",), work)


def test_a_stage_runs_once_and_is_then_skipped(tmp_path: Path, stage: Stage, runs: list[str]) -> None:
    reported: list[tuple[object, ...]] = []
    record = Record(tmp_path)
    assert not record.is_current(stage)
    assert record.run(stage, lambda *event: reported.append(event)) and record.skipped == []
    assert reported == [("fit", 1, 2, "half"), ("fit", 2, 2)]
    assert not record.run(stage) and record.skipped == ["fit"]
    again = Record(tmp_path)
    assert again.is_current(stage) and not again.run(stage) and again.skipped == ["fit"]
    assert runs == ["fit"]


@pytest.mark.parametrize("inputs", [("views", 2), ("other views", 1), ("views",)])
def test_other_inputs_repeat_a_stage(tmp_path: Path, stage: Stage, runs: list[str], inputs: tuple[object, ...]) -> None:
    Record(tmp_path).run(stage)
    other = replace(stage, inputs=inputs)
    assert Record(tmp_path).run(other) and runs == ["fit", "fit"]
    assert Record(tmp_path).is_current(other) and not Record(tmp_path).is_current(stage)


def test_another_algorithm_repeats_a_stage(tmp_path: Path, stage: Stage) -> None:
    Record(tmp_path).run(stage)
    assert Record(tmp_path).is_current(replace(stage, algorithm="fit"))
    assert not Record(tmp_path).is_current(replace(stage, algorithm="compare"))
    entry = json.loads((tmp_path / RECORD_FILE).read_text())["stages"]["fit"]
    assert set(entry) == {"inputs", "outputs", "seconds"} and "fit" in VERSIONS


@pytest.mark.parametrize("change", [lambda file: file.write_text("edited"), Path.unlink, lambda file: (file.unlink(), file.mkdir())])
def test_a_changed_output_repeats_a_stage(tmp_path: Path, stage: Stage, runs: list[str], change: Callable[[Path], object]) -> None:
    Record(tmp_path).run(stage)
    change(tmp_path / "cloud.txt")
    assert not Record(tmp_path).is_current(stage)
    if (tmp_path / "cloud.txt").is_dir():
        (tmp_path / "cloud.txt").rmdir()
    assert Record(tmp_path).run(stage)
    assert Record(tmp_path).is_current(stage) and (tmp_path / "cloud.txt").read_text() == "cloud" and runs == ["fit", "fit"]


def test_outputs_with_a_wildcard_are_recorded_one_by_one(tmp_path: Path) -> None:
    def work(on_progress: OnProgress) -> None:
        (tmp_path / "images").mkdir(exist_ok=True)
        for index in range(3):
            (tmp_path / "images" / f"{index}.png").write_text(str(index))

    stage = Stage("views", (), ("images/*.png", "mip*.png"), work)
    Record(tmp_path).run(stage)
    outputs = json.loads((tmp_path / RECORD_FILE).read_text())["stages"]["views"]["outputs"]
    assert list(outputs) == ["images/0.png", "images/1.png", "images/2.png"]
    (tmp_path / "images" / "note.txt").write_text("not an output")
    assert Record(tmp_path).is_current(stage)
    (tmp_path / "images" / "1.png").unlink()
    assert Record(tmp_path).run(stage) and Record(tmp_path).is_current(stage)


def test_an_output_can_lie_outside_the_folder(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()

    def write(on_progress: OnProgress) -> None:
        (tmp_path / "tree.glb").write_text("tree")

    stage = Stage("join", (), ("../tree.glb",), write, algorithm="lod")
    assert Record(tmp_path / "work").run(stage) and not Record(tmp_path / "work").run(stage)
    (tmp_path / "tree.glb").unlink()
    assert not Record(tmp_path / "work").is_current(stage)


@pytest.mark.parametrize(
    "damage", ["", "{", "[]", '{"stages": 3}', '{"stages": {"fit": 3}}', '{"stages": {"fit": {"inputs": 3, "outputs": {}, "seconds": 1}}}']
)
def test_a_damaged_record_only_repeats_the_stages(tmp_path: Path, stage: Stage, runs: list[str], damage: str) -> None:
    Record(tmp_path).run(stage)
    (tmp_path / RECORD_FILE).write_text(damage)
    assert Record(tmp_path).run(stage) and runs == ["fit", "fit"]
    assert Record(tmp_path).is_current(stage)


def test_a_stage_that_fails_is_not_recorded(tmp_path: Path, stage: Stage) -> None:
    def fail(on_progress: OnProgress) -> None:
        (tmp_path / "cloud.txt").write_text("half a cloud")
        raise InputError("views: are bad")

    Record(tmp_path).run(stage)
    before = (tmp_path / RECORD_FILE).read_bytes()
    with pytest.raises(InputError, match="are bad"):
        Record(tmp_path).run(replace(stage, inputs=("bad views",), work=fail))
    assert (tmp_path / RECORD_FILE).read_bytes() == before
    assert not Record(tmp_path).is_current(stage), "its output is that of the failed attempt"


def test_an_output_that_is_not_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Record(tmp_path).run(Stage("fit", (), ("cloud.txt",), lambda on_progress: None))
    assert not (tmp_path / RECORD_FILE).exists()


def test_an_input_that_changes_during_the_work_repeats_the_stage(tmp_path: Path) -> None:
    """The record keeps the key from before the work, which may have read the old contents."""
    panorama = tmp_path / "sky.hdr"
    panorama.write_text("blue")

    def work(on_progress: OnProgress) -> None:
        (tmp_path / "view.png").write_text(panorama.read_text())
        panorama.write_text("gray")

    stage = Stage("views", (panorama,), ("view.png",), work)
    Record(tmp_path).run(stage)
    assert not Record(tmp_path).is_current(stage)


def test_seconds_are_measured_unless_the_work_returns_them(tmp_path: Path, stage: Stage) -> None:
    record = Record(tmp_path)
    record.run(stage)
    record.run(Stage("views", (), (), lambda on_progress: 12.3456))
    assert 0 <= record.seconds["fit"] < 60 and record.seconds["views"] == 12.346
    assert Record(tmp_path).seconds == record.seconds


def test_the_head_is_recorded_beside_the_stages(tmp_path: Path, stage: Stage) -> None:
    head = record_head("tree.glb", {"fit": {"steps": 3}}, {"fit": 0})
    Record(tmp_path, head).run(stage)
    content = json.loads((tmp_path / RECORD_FILE).read_text())
    assert content.keys() == {"source", "config", "seeds", "versions", "machine", "stages"}
    assert content["source"] == "tree.glb" and content["config"] == {"fit": {"steps": 3}} and content["seeds"] == {"fit": 0}
    assert content["versions"]["python"] and content["versions"]["numpy"]


def test_the_head_stays_as_it_is_and_changes_without_a_stage(tmp_path: Path, stage: Stage, runs: list[str]) -> None:
    """Work of another kind in the folder of a run keeps the run's head, and a run whose stages are all current writes its own."""

    def head() -> dict[str, object]:
        return {name: value for name, value in json.loads((tmp_path / RECORD_FILE).read_text()).items() if name != "stages"}

    Record(tmp_path, {"source": "tree.glb"}).run(stage)
    Record(tmp_path).run(replace(stage, inputs=("views", 2)))
    assert head() == {"source": "tree.glb"} and runs == ["fit", "fit"]
    moved = Record(tmp_path, {"source": "moved.glb"})
    assert not moved.run(replace(stage, inputs=("views", 2)))
    moved.finish()
    assert head() == {"source": "moved.glb"}
    time = (tmp_path / RECORD_FILE).stat().st_mtime_ns
    Record(tmp_path, {"source": "moved.glb"}).finish()
    assert (tmp_path / RECORD_FILE).stat().st_mtime_ns == time


def test_outputs_with_other_names_repeat_a_stage(tmp_path: Path, stage: Stage) -> None:
    """The files of the earlier names are still there."""
    Record(tmp_path).run(stage)
    (tmp_path / "other").mkdir()

    def work(on_progress: OnProgress) -> None:
        (tmp_path / "other" / "cloud.txt").write_text("cloud")

    assert Record(tmp_path).run(replace(stage, outputs=("other/cloud.txt",), work=work))
    assert (tmp_path / "other" / "cloud.txt").is_file()


def test_stages_share_a_record(tmp_path: Path, stage: Stage, runs: list[str]) -> None:
    """A stage can run another one, as a comparison does for the size of bbfit's model."""
    record = Record(tmp_path)

    def work(on_progress: OnProgress) -> None:
        record.run(stage)
        (tmp_path / "row.json").write_text("{}")

    row = Stage("row", (), ("row.json",), work, algorithm="compare")
    record.run(row)
    assert runs == ["fit"] and Record(tmp_path).is_current(stage) and Record(tmp_path).is_current(row)
