"""The options of the command line: one name in every command, switches, one seed."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest

import bbfit
from bbfit.cli import main

COMMANDS = ("run", "grow", "views", "fit", "evaluate", "export", "thin", "lod", "view", "sweep", "compare", "frames", "library", "forest")
STAGES = {"views": bbfit.ViewsConfig, "fit": bbfit.FitConfig, "export": bbfit.ExportConfig, "grow": bbfit.GrowConfig}
QUICK = ["--billboards", "1", "--placement", "even", "--steps", "2"]


@pytest.fixture
def offered(capsys: pytest.CaptureFixture[str]) -> dict[str, set[str]]:
    """The options of every command."""
    found = {}
    for command in COMMANDS:
        with pytest.raises(SystemExit):
            main([command, "--help"])
        found[command] = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", capsys.readouterr().out))
    return found


def test_an_option_has_one_name_in_every_command(offered: dict[str, set[str]]) -> None:
    """Only the seeds of single stages have a prefix, where a command has several stages and a seed for all of them."""
    several = {"run", "lod", "sweep", "compare", "library"}
    for command, options in offered.items():
        dotted = {option for option in options if "." in option}
        assert all(option.endswith(".seed") for option in dotted)
        assert bool(dotted) == (command in several)
        assert command not in several or "--seed" in options
    for stage, commands in {"views": several, "fit": several | {"fit"}, "export": several | {"fit", "evaluate"}}.items():
        own = {f"--{field.name.replace('_', '-')}" for field in fields(STAGES[stage])}
        assert all(own <= offered[command] for command in commands), stage


def test_the_model_has_the_alpha_that_the_textures_were_fitted_for(views_folder: Path, tmp_path: Path) -> None:
    """One option for both stages."""
    assert main(["run", str(views_folder), "--out", str(tmp_path), *QUICK, "--alpha", "mask", "--alpha-cutoff", "0.4"]) == 0
    config = json.loads((tmp_path / "run.json").read_text())["config"]
    assert (config["fit"]["alpha"], config["fit"]["alpha_cutoff"]) == ("mask", 0.4)
    assert config["export"]["alpha"] is config["export"]["alpha_cutoff"] is None
    assert b'"alphaCutoff":0.4' in (tmp_path / "model.glb").read_bytes()


@pytest.mark.parametrize(
    ("options", "seeds"),
    [([], (0, 0)), (["--seed", "7"], (7, 7)), (["--seed", "7", "--fit.seed", "0"], (7, 0)), (["--views.seed", "3"], (3, 0))],
    ids=str,
)
def test_one_seed_is_that_of_all_stages(options: list[str], seeds: tuple[int, int], views_folder: Path, tmp_path: Path) -> None:
    assert main(["run", str(views_folder), "--out", str(tmp_path), *QUICK, *options]) == 0
    assert json.loads((tmp_path / "run.json").read_text())["seeds"] == dict(zip(("views", "fit"), seeds, strict=True))


@pytest.mark.parametrize(("options", "split"), [([], True), (["--split"], True), (["--no-split"], False)], ids=str)
def test_flags_are_switches(options: list[str], split: bool, views_folder: Path, tmp_path: Path) -> None:
    """With a profile that splits if it is not told otherwise."""
    out = ["--out", str(tmp_path), *QUICK, "--billboards", "2", "--alpha", "blend", "--profile", "three", "--outline", "rectangle"]
    assert main(["fit", str(views_folder), *out, *options]) == 0
    vertices = json.loads((tmp_path / "metrics.json").read_text())["vertices"]["model"]
    assert (vertices > 8) == split


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("--fit.billboards", "--billboards"),
        ("--export.no-fallback", "--no-fallback"),
        ("--budget.bytes=200k", "--bytes"),
        ("--views.device", "--render-device"),
    ],
)
def test_options_with_a_prefix_are_refused_with_their_new_name(option: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "tree.glb", option, "1"]) == 2
    said = capsys.readouterr().err
    assert said.splitlines() == [f"bbfit: {option.partition('=')[0]}: options have no prefix any more; use {name}"]


@pytest.mark.parametrize("option", [["--hull", "6"], ["--hull=6"]], ids=str)
def test_the_old_option_of_hulls_names_the_new_ones(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "cloud.safetensors", "--out", "model.glb", *option]) == 2
    said = capsys.readouterr().err
    assert said.splitlines() == ["bbfit: --hull: is no option any more; use --outline hull, with --corners for fewer than 8 corners"]
