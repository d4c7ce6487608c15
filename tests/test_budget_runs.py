"""Runs within a budget: what is written, what is not done twice, and that limits hold in the files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import pytest
import torch

from bbfit.budget.config import BudgetConfig
from bbfit.budget.sizes import model_bytes
from bbfit.budget.trials import Trial
from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.files import write_json
from bbfit.fitting.config import FitConfig
from bbfit.geometry.cloud import BillboardCloud
from bbfit.outputs import WRITTEN_FILE
from bbfit.pipeline import RunConfig, RunResult, run
from bbfit.stages.billboards import budget_stage, fit_stage
from bbfit.views.dataset import ViewDataset

VIEWS = Path(__file__).resolve().parents[1] / "data" / "views"
FIT = FitConfig(placement="even", steps=6, views_per_step=1)
CONFIG = RunConfig(fit=FIT, budget=BudgetConfig(vertices=8))
STAGES = ("budget", "fit", "evaluate", "export", "report")


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """One, two, and a two-sided billboard were tried. Do not change its files."""
    return run(VIEWS, tmp_path_factory.mktemp("budget") / "run", CONFIG)


def written(folder: Path) -> dict:
    return json.loads((folder / "pareto.json").read_text())


def trials_of(folder: Path) -> list[Trial]:
    return [Trial(**{name: value for name, value in trial.items() if name != "pareto"}) for trial in written(folder)["trials"]]


KEPT = 12345.0
"""Seconds that no trial takes: trials with them were not done again."""


def tag(folder: Path) -> None:
    """Give all trials on record the time of :data:`KEPT`."""
    content = written(folder)
    for trial in content["trials"]:
        trial["seconds"] = KEPT
    write_json(folder / "pareto.json", content)


def kept(folder: Path) -> list[bool]:
    """Which trials were not done again after :func:`tag`."""
    return [trial.seconds == KEPT for trial in trials_of(folder)]


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def untimed(trials: list[Trial]) -> list[Trial]:
    return [dataclasses.replace(trial, seconds=0.0) for trial in trials]


def test_trials_and_their_picture_are_written(done: RunResult) -> None:
    assert done.skipped == () and done.missed is None
    content, trials = written(done.folder), trials_of(done.folder)
    assert set(content) == {"inputs", "budget", "config", "trials", "chosen", "met", "validation"}
    assert content["budget"] == {"vertices": 8} and content["met"] is True
    assert [(trial.billboards, trial.sides, trial.placement) for trial in trials] == [
        (1, "one", "even"),
        (2, "one", "even"),
        (1, "two", "even"),
    ]
    assert [trial.vertices for trial in trials] == [4, 8, 8] and all(trial.seconds > 0 for trial in trials)
    train = json.loads((VIEWS / "transforms_train.json").read_text())["frames"]
    assert content["validation"] == [Path(train[index]["file_path"]).stem for index in (2, 7, 12, 17)]
    assert (done.folder / "pareto.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert cv2.imread(str(done.folder / "pareto.png")).shape == (600, 1080, 3)


def test_the_record_holds_the_fit_that_was_chosen(done: RunResult) -> None:
    record, chosen = json.loads((done.folder / "run.json").read_text()), trials_of(done.folder)[written(done.folder)["chosen"]]
    fitted = record["config"]["fit"]
    assert {name: fitted[name] for name in ("billboards", "sides", "placement", "max_texels")} == {
        name: getattr(chosen, name) for name in ("billboards", "sides", "placement", "max_texels")
    }
    assert fitted == dataclasses.asdict(FitConfig(**fitted).resolve()) and fitted["steps"] == 6 and fitted["restarts"] == 1
    assert record["config"]["budget"] == dataclasses.asdict(CONFIG.budget)
    assert tuple(record["stages"]) == STAGES
    assert done.cloud.vertex_count == chosen.vertices <= 8
    metrics = json.loads((done.folder / "metrics.json").read_text())
    assert set(metrics["seconds"]) == set(STAGES) - {"report"} and metrics["seconds"]["budget"] > 0
    assert metrics["vertices"]["model"] == chosen.vertices


def test_no_stage_is_done_twice(done: RunResult) -> None:
    before, told = snapshot(done.folder), []
    again = run(VIEWS, done.folder, CONFIG, on_progress=lambda *event: told.append(event))
    assert again.skipped == STAGES and told == []
    assert again.report == done.report and snapshot(done.folder) == before and torch.equal(again.cloud.texels, done.cloud.texels)


def killed_after_a_trial(folder: Path) -> None:
    def kill(stage: str, index: int, total: int, note: str = "") -> None:
        if (stage, index) == ("budget", 1):
            raise Killed

    with pytest.raises(Killed):
        run(VIEWS, folder, CONFIG, on_progress=kill)


def test_a_killed_run_goes_on_with_the_trials_done(done: RunResult, tmp_path: Path) -> None:
    killed_after_a_trial(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"pareto.json", WRITTEN_FILE}
    tag(tmp_path)
    (first,), told = trials_of(tmp_path), []
    result = run(VIEWS, tmp_path, CONFIG, on_progress=lambda *event: told.append(event))
    assert kept(tmp_path) == [True, False, False] and result.skipped == ()
    assert trials_of(tmp_path)[0] == first and untimed(trials_of(tmp_path)) == untimed(trials_of(done.folder))
    assert [event[:2] for event in told if event[0] == "budget"] == [("budget", index) for index in range(4)]
    assert all(event[1] <= event[2] for event in told)
    for name in ("cloud.safetensors", "loss.csv", "model.glb", "model.obj"):
        assert (tmp_path / name).read_bytes() == (done.folder / name).read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        {"budget": BudgetConfig(vertices=4)},
        {"fit": dataclasses.replace(FIT, seed=1)},
        {"export": ExportConfig(padding=4)},
    ],
    ids=str,
)
def test_what_else_is_asked_for_is_chosen_anew(tmp_path: Path, change: dict[str, object]) -> None:
    """Trials of another budget, or of other fits, do not count, though they would answer the question."""
    killed_after_a_trial(tmp_path)
    tag(tmp_path)
    other = dataclasses.replace(CONFIG, **change)  # type: ignore[arg-type]
    result = run(VIEWS, tmp_path, other)
    assert kept(tmp_path) == [False] * (3 if other.budget == CONFIG.budget else 1) and result.skipped == ()
    assert written(tmp_path)["budget"] == {"vertices": other.budget.vertices} and result.cloud.vertex_count <= (other.budget.vertices or 0)


def test_how_often_a_state_is_kept_is_no_matter(tmp_path: Path) -> None:
    killed_after_a_trial(tmp_path)
    tag(tmp_path)
    run(VIEWS, tmp_path, dataclasses.replace(CONFIG, fit=dataclasses.replace(FIT, checkpoint_every=7)))
    assert kept(tmp_path) == [True, False, False]


def test_only_what_is_lost_is_made_again(tmp_path: Path) -> None:
    killed_after_a_trial(tmp_path)
    tag(tmp_path)
    run(VIEWS, tmp_path, CONFIG)
    before = snapshot(tmp_path)
    assert kept(tmp_path)[0]
    (tmp_path / "pareto.png").unlink()
    assert run(VIEWS, tmp_path, CONFIG).skipped == STAGES[1:]
    assert snapshot(tmp_path)["pareto.png"] == before["pareto.png"] and snapshot(tmp_path)["pareto.json"] == before["pareto.json"]
    (tmp_path / "pareto.json").unlink()
    assert run(VIEWS, tmp_path, CONFIG).skipped == STAGES[1:] and kept(tmp_path) == [False] * 3


def test_an_encoder_that_is_installed_later_repeats_what_counts_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views, export = ViewDataset.load(VIEWS), ExportConfig(textures="auto")
    keys = []
    for missing in ("install it", None):
        monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda missing=missing: missing)
        choice = budget_stage(tmp_path, views, None, FIT, BudgetConfig(bytes="12k"), export)
        keys.append((choice.key, fit_stage(tmp_path, views, None, FIT, (12_000, export)).key, fit_stage(tmp_path, views, None, FIT).key))
    assert keys[0][0] != keys[1][0] and keys[0][1] != keys[1][1] and keys[0][2] == keys[1][2]


def test_a_split_model_is_no_larger_than_its_budget_of_vertices(tmp_path: Path) -> None:
    """The profile would cut billboards that cross, and a run without a budget then has no seconds of its choice."""
    export = ExportConfig(alpha="blend", profile="three")
    fit = dataclasses.replace(FIT, alpha="blend")
    done = run(VIEWS, tmp_path, dataclasses.replace(CONFIG, fit=fit, export=export))
    assert done.report.vertices.model <= 8 and "budget" in done.report.seconds
    assert "budget" not in run(VIEWS, tmp_path, RunConfig(fit=dataclasses.replace(fit, billboards=2))).report.seconds


def test_a_run_without_a_budget_chooses_nothing(tmp_path: Path) -> None:
    result = run(VIEWS, tmp_path, RunConfig(fit=dataclasses.replace(FIT, billboards=1)))
    assert result.missed is None
    assert not list(tmp_path.glob("pareto*")) and "budget" not in json.loads((tmp_path / "run.json").read_text())["stages"]


@pytest.mark.parametrize(("target", "missed"), [(90.0, 90.0), (3.0, None)])
def test_a_target_that_is_missed_is_told(tmp_path: Path, target: float, missed: float | None) -> None:
    """Also by a run that finds everything done."""
    config = RunConfig(fit=FIT, budget=BudgetConfig(vertices=4, target_psnr=target))
    for skipped in ((), STAGES):
        result = run(VIEWS, tmp_path, config)
        assert result.missed == missed and result.skipped == skipped
    assert written(tmp_path)["met"] is (missed is None) and written(tmp_path)["budget"] == {"vertices": 4, "target_psnr": target}


@pytest.mark.parametrize(
    ("budget", "most", "bound"),
    [
        (BudgetConfig(bytes="1M"), 2, 2),
        (BudgetConfig(bytes="1M", vertices=4), 2, None),
        (BudgetConfig(bytes="20k"), 2, None),
        (BudgetConfig(texels="1k"), 2, None),
    ],
)
def test_bytes_that_more_billboards_would_use_are_told(tmp_path: Path, budget: BudgetConfig, most: int, bound: int | None) -> None:
    """Also by a run that finds everything done."""
    config = RunConfig(fit=dataclasses.replace(FIT, least_billboards=1, most_billboards=most), budget=budget)
    for skipped in ((), STAGES):
        result = run(VIEWS, tmp_path, config)
        assert result.bound == bound and result.skipped == skipped


def test_the_model_has_no_more_bytes_than_asked_for(tmp_path: Path) -> None:
    """A second run finds it done."""
    config = RunConfig(fit=FIT, budget=BudgetConfig(bytes="20k", vertices=8), export=ExportConfig(padding=48))
    result = run(VIEWS, tmp_path, config)
    size = (tmp_path / "model.glb").stat().st_size
    assert 10_000 < size <= 20_000
    assert result.report.bytes.model == size and written(tmp_path)["budget"] == {"bytes": "20k", "vertices": 8}
    assert all(trial.bytes <= 20_000 for trial in trials_of(tmp_path) if trial == trials_of(tmp_path)[written(tmp_path)["chosen"]])
    assert run(VIEWS, tmp_path, config).skipped == STAGES


def test_a_budget_of_vertices_or_bytes_draws_compact_outlines() -> None:
    """Unless another outline is requested. Four corners are as many as a rectangle has."""
    size = BudgetConfig(bytes="20k")
    assert RunConfig().exports == (ExportConfig(),)
    assert RunConfig(budget=size).exports == ExportConfig().outlines()
    quads = RunConfig(budget=size, export=ExportConfig(corners=4)).exports
    assert quads == (ExportConfig(outline="pieces", corners=4), ExportConfig(outline="hull", corners=4))
    assert RunConfig(budget=size, export=ExportConfig(outline="pieces")).exports == (ExportConfig(outline="pieces"),)
    assert RunConfig(budget=dataclasses.replace(size, vertices=8)).exports == (ExportConfig(outline="hull", corners=4, split=False),)
    assert [export.outline for export in RunConfig(fit=FitConfig(preset="thesis")).exports] == ["rectangle"]


@pytest.mark.parametrize(("limit", "outline"), [("10M", "pieces"), ("5k", "hull")])
def test_bytes_that_are_left_are_spent_on_the_outline(tmp_path: Path, limit: str, outline: str) -> None:
    """The record names it, and a second run finds it done."""
    config = RunConfig(fit=dataclasses.replace(FIT, least_billboards=1, most_billboards=1), budget=BudgetConfig(bytes=limit))
    run(VIEWS, tmp_path, config)
    assert json.loads((tmp_path / "run.json").read_text())["config"]["export"]["outline"] == outline
    assert run(VIEWS, tmp_path, config).skipped == STAGES


def test_a_fit_much_larger_than_its_limit_is_cut_to_it(tmp_path: Path) -> None:
    """The same fit within fewer bytes is another result, and so is one that is exported otherwise."""
    views, config = ViewDataset.load(VIEWS), dataclasses.replace(FIT, billboards=2)
    keys, texels = set(), []
    for limit in (None, (13_000, ExportConfig()), (9_000, ExportConfig()), (9_000, ExportConfig(padding=48))):
        stage = fit_stage(tmp_path, views, None, config, limit)
        stage.work(lambda *event: None)
        cloud = BillboardCloud.load(tmp_path / "cloud.safetensors")
        if limit is None:
            assert model_bytes(cloud, ExportConfig()) > 13_000
        else:
            assert 0.5 * limit[0] < model_bytes(cloud, limit[1]) <= limit[0]
        keys.add(stage.key)
        texels.append(len(cloud.texels))
    assert len(keys) == 4 and texels[0] > texels[1] > texels[2] > texels[3]


def test_a_limit_of_texels_holds_in_the_result(tmp_path: Path) -> None:
    result = run(VIEWS, tmp_path, RunConfig(fit=FIT, budget=BudgetConfig(vertices=8, texels="3k")))
    assert 1500 < len(result.cloud.texels) <= 3000
    assert json.loads((tmp_path / "run.json").read_text())["config"]["fit"]["max_texels"] == 3000


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (dataclasses.replace(CONFIG, fit=dataclasses.replace(FIT, billboards=2)), "billboards: 2 are requested in addition to a budget"),
        (RunConfig(fit=FitConfig(preset="thesis"), budget=BudgetConfig(vertices=8)), "preset: 'thesis'"),
        (RunConfig(fit=FitConfig(sides="two"), budget=BudgetConfig(vertices=4)), "vertices: 4 are too few"),
    ],
)
def test_what_does_not_go_together_is_found_before_any_work(tmp_path: Path, config: RunConfig, says: str) -> None:
    fitted: list[str] = []
    with pytest.raises(InputError, match=says):
        run(VIEWS, tmp_path, config, on_progress=lambda stage, done, total, note="": fitted.extend([stage] * (done > 0)))
    assert not list(tmp_path.iterdir()) and fitted == []
