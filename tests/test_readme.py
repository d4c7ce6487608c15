"""Every command and every program in README.md and in docs/ is run, in the order of its page, in a folder where the files that it names
exist as small stand-ins.

``bbfit`` commands are run as they stand, with options added at their end that make pictures, fits and trees small; of an option given
twice the last one counts. Python programs and scripts are run as they stand, with the functions of bbfit made to work small.
``scripts/demo`` is run with its installation left out, which is that of ``scripts/test``, the script that runs these tests. ``pip``
resolves what it is asked for and installs nothing. A command of a kind that is not known here is a failure.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import markdown
import pytest
from documented import DOCS, PAGES, ROOT, SITE, blocks, prose
from interrupting import heed_ctrl_c
from one_at_a_time import one_at_a_time

import bbfit
from bbfit.cli import main
from bbfit.cli.program import COMMANDS

TREES = ("tree.glb", "acer.glb", "library/one.glb")
VIEWS = ("tree", "acer", "quaking_aspen", "weeping_willow")
SMALL_TREE = {"detail": 0.1, "leaves": 0.02}
SMALL_VIEWS = {"size": 32, "count": 8, "samples": 1}
SMALL_FIT = {"steps": 4, "restarts": 1, "candidates": 1, "refinement_rounds": 0}
BUDGETS = {"--vertices", "--texels", "--bytes", "--target-psnr", "--auto"}
"""Options that decide how many billboards there are."""
# Blocks that are no commands: output and formulas, and what belongs into a page of an engine.
NOT_RUN = {"text": PAGES, "js": [DOCS / "engines.md"]}
# Ray leaves sockets to the garbage collector, and warns of its own coming changes.
pytestmark = [pytest.mark.filterwarnings("ignore::ResourceWarning"), pytest.mark.filterwarnings("ignore::FutureWarning")]


def each(pages: list[Path]) -> pytest.MarkDecorator:
    """A test for each page."""
    return pytest.mark.parametrize("page", pages, ids=lambda page: page.relative_to(ROOT).as_posix())


def with_code(language: str) -> pytest.MarkDecorator:
    """A test for each page that has code in a language."""
    return each([page for page in PAGES if any(block.language == language for block in blocks(page))])


@dataclass(frozen=True)
class Place:
    """Where a page's commands are run."""

    folder: Path
    """The working directory, with the stand-ins."""
    scratch: Path
    """For what no command should see."""


def options(values: dict[str, Any]) -> list[str]:
    """Options of the command line."""
    return [word for name, value in values.items() for word in (f"--{name}", str(value))]


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with small trees, views and a run of the names that the pages use. Do not change it."""
    folder = tmp_path_factory.mktemp("stand-ins")
    for name in TREES:
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / "data/tree.glb", folder / name)
    with contextlib.chdir(folder):
        assert main(["views", "tree.glb", "--out", "views/tree", *options(SMALL_VIEWS)]) == 0
        for name in VIEWS[1:]:
            shutil.copytree("views/tree", f"views/{name}")
        assert main(["fit", "views/tree", "--tree", "tree.glb", "--out", "runs/tree", *options(SMALL_FIT), "--billboards", "2"]) == 0
        shutil.copytree("views/tree", "runs/tree/views")
    return folder


@pytest.fixture
def place(stand_ins: Path, tmp_path: Path) -> Iterator[Place]:
    """A copy of the stand-ins, in which the test works."""
    folder = Path(shutil.copytree(stand_ins, tmp_path / "place"))
    (tmp_path / "scratch").mkdir()
    with contextlib.chdir(folder):
        yield Place(folder, tmp_path / "scratch")


def small(words: list[str]) -> list[str]:
    """The options that make a ``bbfit`` command small."""
    command, given = words[0], set(words)
    with_tree = len(words) > 1 and not words[1].startswith("-")
    stages, several = options(SMALL_VIEWS | SMALL_FIT), bool(given & {"--trees", "--species"})
    grown = [] if "--trees" in given else options(SMALL_TREE)
    machine = ["--ray", "local"] if "--ray" in given else ["--workers", "1"]
    if command == "grow":
        return [] if "--list" in given else options(SMALL_TREE)
    if command == "views":
        return options(SMALL_VIEWS)
    page = ["--port", "0"] if "--watch" in given else []
    few = {"vertices": 4} if given & BUDGETS else {} if "--billboards" in given else {"billboards": 2}
    if command == "fit":
        return [*options(SMALL_FIT | few), *page]
    if command == "run":
        return [*stages, *options(few), *([] if with_tree else options(SMALL_TREE)), *page]
    if command == "lod":
        return [*stages, "--planes", "2", "1"]
    if command == "sweep":
        one = ["--billboards", "2"] + ([] if "--grid" in given else ["--species", "acer", "--loss", "l2", "--variants", "base"])
        return [*stages, *one, *grown, *machine]
    if command == "compare":  # tests/test_comparison.py has the others
        some = [] if "--systems" in given else ["--systems", "bbfit", "crossed", "draco"]
        grown = [*grown, "--species", "acer", "--seeds", "0"] if "--species" in given else []
        return [*stages, *some, *grown, *(machine if several else []), "--billboards", "2", "--many", "3", "--mesh-steps", "2"]
    if command == "library":
        grown = [*grown, "--species", "acer", "--seeds", "0"] if "--species" in given else []
        return [*stages, *grown, *machine, "--planes", "2", "1"]
    assert command in ("evaluate", "export", "thin"), f"how is bbfit {command} made small?"
    return []


def expanded(words: list[str]) -> list[str]:
    """The words with patterns of file names replaced by the files, as a shell does."""
    return [name for word in words for name in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]


def make_room(words: list[str]) -> None:
    """Remove the stand-in for a tree that a command is about to grow: bbfit replaces no file that it did not write."""
    if words[0] == "grow" and "--out" in words:
        Path(words[words.index("--out") + 1]).unlink(missing_ok=True)


def run_bbfit(words: list[str], place: Place) -> None:
    """In this process; ``view``, which ends only when it is stopped, and what starts Ray in their own."""
    if words[0] == "view":
        return look(words)
    make_room(words)
    arguments = expanded([*words, *small(words)])
    if "--ray" in words:
        with one_at_a_time("ray"):
            subprocess.run([sys.executable, "-m", "bbfit.cli", *arguments], check=True, timeout=600)  # Ray may hang
    else:
        assert main(arguments) == 0
    if "--out" in words:
        assert (out := Path(words[words.index("--out") + 1])).exists()
        assert words[0] not in ("run", "fit") or (out / "model.glb").is_file()


def look(words: list[str]) -> None:
    """Start ``bbfit view``, load its page, stop it from the keyboard."""
    command = [sys.executable, "-m", "bbfit.cli", *words, "--port", "0"]
    at_once = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=at_once, preexec_fn=heed_ctrl_c
    ) as process:
        try:
            assert process.stdout is not None
            said = ""
            while not (address := re.search(r"http://127\.0\.0\.1:\d+", said)):
                line = process.stdout.readline()
                assert line, f"bbfit view ended: {said}"
                said += line
            with urllib.request.urlopen(address[0]) as answer:
                assert b"<html" in answer.read().lower()
            process.send_signal(signal.SIGINT)
            rest = process.communicate()[0]
            assert process.returncode == 0, rest
        finally:
            process.kill()


def run_pip(words: list[str], place: Place) -> None:
    """Resolve what is asked for from what is installed here, by the pins, and install nothing: that the package can be built, has the
    extras, and that pins and requirements agree."""
    assert words[0] == "install"
    folder = place.scratch / str(len(list(place.scratch.iterdir())))
    folder.mkdir()
    for name in ("setup.cfg", "pyproject.toml", "constraints.txt", "README.md", "LICENSE", "bbfit", "data"):
        source = ROOT / name
        shutil.copytree(source, folder / name) if source.is_dir() else shutil.copy(source, folder)
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", "--no-build-isolation", *words[1:]]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "does not provide the extra" not in result.stderr and "Would install bbfit" in result.stdout


def run_demo(words: list[str], place: Place) -> None:
    """The script itself, with a ``.venv`` whose Python installs nothing and whose ``bbfit`` works small."""
    assert not words
    shutil.copytree(ROOT / "scripts", place.folder / "scripts")
    programs = place.folder / ".venv/bin"
    programs.mkdir(parents=True)
    python = f'#!/bin/sh\nif [ "$2" = pip ]; then echo "$@" > "{place.scratch}/pip"; exit; fi\nexec "{sys.executable}" "$@"\n'
    bbfit_program = f'#!/bin/sh\nexec "{sys.executable}" -m bbfit.cli "$@" {" ".join(small(["run"]))}\n'
    for name, text in {"python": python, "bbfit": bbfit_program}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    said = subprocess.run(["scripts/demo"], cwd=place.folder, check=True, capture_output=True, text=True).stdout
    assert "Results are in" in said and (place.folder / "runs/demo/comparison.png").is_file()
    # The installation is the line of scripts/environment.sh by which scripts/test makes the environment of these tests.
    assert (place.scratch / "pip").read_text().split()[-3:] == ["constraints.txt", "--editable", ".[blender]"]


def run_tests(words: list[str], place: Place) -> None:
    """These tests are what the script runs: continuous integration calls nothing else."""
    assert words in ([], ["--fast"]) and re.search(r"^exec bash .*/scripts/test\b", (ROOT / ".ci/run").read_text(), re.MULTILINE)
    assert re.search(r"^.venv/bin/python -m pytest\b", (ROOT / "scripts/test").read_text(), re.MULTILINE)


def run_python(words: list[str], place: Place) -> None:
    """A script of the repository."""
    path, arguments = ROOT / words[0], words[1:]
    specification = importlib.util.spec_from_file_location(f"script_{path.stem}", path)
    assert specification and specification.loader
    script = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(script)
    if path.name == "benchmark.py" and "placement" not in arguments:
        arguments = [*arguments, "--quick", "--only", "grow"]
    with pytest.MonkeyPatch.context() as patch:
        work_small(patch)
        patch.setattr(sys, "argv", [str(path), *arguments])
        script.main()


def run_mkdocs(words: list[str], place: Place) -> None:
    """The command by which tests/test_docs.py builds the site."""
    assert words == SITE


DONE: dict[tuple[str, ...], Path] = {}
"""Commands that were run before without the values of ``--out``, and what they wrote: with the same stand-ins they would do the same."""
RUNNERS: dict[str, Callable[[list[str], Place], None]] = {
    "bbfit": run_bbfit,
    "pip": run_pip,
    "scripts/demo": run_demo,
    "scripts/test": run_tests,
    "python": run_python,
    "mkdocs": run_mkdocs,
}


def work_small(patch: pytest.MonkeyPatch) -> None:
    """Make the functions that ``bbfit`` offers grow, render and fit little, whatever they are asked for."""
    views = lambda config: replace(config or bbfit.ViewsConfig(), **SMALL_VIEWS)  # noqa: E731
    fit = lambda config: replace(config or bbfit.FitConfig(), **SMALL_FIT)  # noqa: E731
    stages = lambda config: replace(  # noqa: E731
        config or bbfit.RunConfig(), views=views(config and config.views), fit=fit(config and config.fit)
    )
    grown = replace(stages(None), grow=bbfit.GrowConfig(**SMALL_TREE))
    real = {name: getattr(bbfit, name) for name in ("grow", "render_views", "fit", "choose", "run", "run_sweep", "compare", "build_lod")}
    few = bbfit.CompareConfig(systems=("bbfit", "draco"), billboards=2)
    works: dict[str, Callable[..., Any]] = {
        "grow": lambda species, **given: real["grow"](species, **given | SMALL_TREE),
        "render_views": lambda tree, out, config=None: real["render_views"](tree, out, views(config)),
        "fit": lambda data, config=None, **given: real["fit"](data, fit(config), **given),
        "choose": lambda data, config, budget: real["choose"](data, fit(config), replace(budget, vertices=8)),
        "run": lambda source, out, config=None: real["run"](source, out, stages(config)),
        "run_sweep": lambda out, config, stages, **given: real["run_sweep"](
            out, replace(config, billboards=(2,), loss=("l2",), variants=("base",), workers=1), grown, **given
        ),
        "compare": lambda tree, out: real["compare"](tree, out, few, stages(None)),
        "build_lod": lambda tree, out, config: real["build_lod"](tree, out, replace(config, planes=(2, 1)), stages(None)),
    }
    for name, work in works.items():
        patch.setattr(bbfit, name, work)


@with_code("sh")
def test_commands_run(page: Path, place: Place) -> None:
    for block in blocks(page):
        for words in block.commands if block.language == "sh" else []:
            assert words[0] in RUNNERS, f"{block}: nobody knows how to run {' '.join(words)}"
            number = words.index("--out") + 1 if "--out" in words else None
            same = tuple(word for index, word in enumerate(words) if index != number)
            earlier = DONE.get(same)
            if earlier is None:
                RUNNERS[words[0]](words[1:], place)
                DONE[same] = place.folder / words[number] if number else place.folder
            elif number and not Path(words[number]).exists():  # for the commands that follow
                Path(words[number]).parent.mkdir(parents=True, exist_ok=True)
                (shutil.copytree if earlier.is_dir() else shutil.copy)(earlier, words[number])


@with_code("python")
def test_programs_run(page: Path, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a page's programs, one after another in one namespace."""
    shutil.rmtree("views/acer")  # which programs render themselves
    work_small(monkeypatch)
    names: dict[str, Any] = {}
    for block in blocks(page):
        if block.language == "python":
            exec(compile(block.text, str(block), "exec"), names)


@each(PAGES)
def test_all_code_is_in_blocks_of_a_kind_that_is_run(page: Path) -> None:
    """No command hides in an indented block, or in one of another language."""
    for block in blocks(page):
        assert block.language in ("sh", "python") or page in NOT_RUN.get(block.language, []), f"{block}: {block.language!r}"
    html = markdown.markdown(page.read_text(encoding="utf-8"), extensions=["fenced_code", "tables"])
    assert html.count("<pre>") == len(blocks(page))


def said_by(*words: str) -> str:
    """What a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as said, pytest.raises(SystemExit) as ending:
        main(words)
    assert ending.value.code in (0, None)
    return said.getvalue()


@pytest.fixture(scope="module")
def offered() -> set[str]:
    """Every option of every command."""
    return {option for command in COMMANDS for option in re.findall(r"--[a-z][\w.-]*", said_by(command, "--help"))}


@each(PAGES)
def test_options_and_commands_that_are_mentioned_exist(page: Path, offered: set[str]) -> None:
    text = prose(page)
    other = {"--help", "--fast", "--out", "--quick", "--strict", "--every", "--panorama"}  # the last two are of scripts/viewers.py
    mentioned = {option.rstrip(".") for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*", text)}
    assert mentioned - other <= offered
    assert {name for name in re.findall(r"`bbfit ([a-z]+)", text)} <= set(COMMANDS)


def test_the_last_of_an_option_given_twice_counts(stand_ins: Path, tmp_path: Path) -> None:
    """What makes small appendages count."""
    command = ["fit", str(stand_ins / "views/tree"), "--out", str(tmp_path), "--billboards", "5", "--steps", "3"]
    assert main([*command, *options(SMALL_FIT), "--billboards", "1", "--placement", "even"]) == 0
    assert len(bbfit.BillboardCloud.load(tmp_path / "cloud.safetensors")) == 1
    assert len((tmp_path / "loss.csv").read_text().splitlines()) == 1 + SMALL_FIT["steps"]


def test_the_table_of_a_run_s_files_is_complete(place: Place) -> None:
    """Of a run that grows its tree within a budget; README.md and docs/commands.md have the same files."""
    assert main(["run", "--out", "all", *small(["run", "--vertices"]), "--vertices", "4"]) == 0
    made = {f"{path.name}/" if path.is_dir() else path.name for path in Path("all").glob("[!.]*")}
    for page in (ROOT / "README.md", DOCS / "commands.md"):
        table = page.read_text(encoding="utf-8").split("| file | what |")[1].split("\n\n")[0]
        told = {name for row in table.splitlines()[2:] for name in re.findall(r"`([^`]+)`", row.split("|")[1])}
        told |= {f"model{name}" for name in told - {".bbfit.json"} if name.startswith(".")}
        assert {name for name in told if not name.startswith(".")} == made
