"""The two kinds of work that a sweep consists of, as functions that any process on any machine can carry out.

A task reads files, writes into one folder, and returns a few facts that JSON can hold. Whoever carries it out sees to it that the files are
there and what becomes of the folder.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from bbfit.checks import InputError
from bbfit.pipeline import RunConfig

Facts = dict[str, Any]
"""What a task returns, as JSON holds it."""


class Work(Protocol):
    """What a task does."""

    def __call__(self, inputs: Mapping[str, Path], folder: Path, *arguments: Any) -> Facts:
        """Read ``inputs``, files or folders, which may lie elsewhere than the task says, and write into ``folder``."""


@dataclass(frozen=True)
class Task:
    """A piece of work with all that it needs."""

    name: str
    """Tells it from all others."""
    work: Work
    """A function of a module, so that other processes find it."""
    inputs: Mapping[str, tuple[Path, ...]]
    """What it reads: a folder, or files of which the first is named to it and the others lie in the same folder or below."""
    folder: Path
    """Where it writes; what is there from an earlier start may be gone on with."""
    arguments: tuple[Any, ...] = ()
    """What else the function takes."""
    alone: bool = False
    """Whether it uses all cores of a machine by itself."""


@dataclass(frozen=True)
class Outcome:
    """How a task ended."""

    facts: Facts | None
    """What it returned, ``None`` if it failed."""
    reason: str | None
    """Why it failed."""
    where: str
    """Machine, or Ray's node, that it ran on."""
    seconds: float = 0.0
    """That it took."""
    trace: str | None = None
    """Where in the program, if the failure is a fault of it."""


class Workers(Protocol):
    """Processes, here or elsewhere, that carry out tasks. A context manager: leaving it ends them."""

    def __enter__(self) -> Workers:
        """Start."""

    def __exit__(self, *_: object) -> None:
        """End all processes."""

    def submit(self, task: Task) -> None:
        """Carry a task out as soon as there is room."""

    def next(self) -> tuple[Task, Outcome]:
        """Wait for a task to end; there must be one."""


def prepare_tree(inputs: Mapping[str, Path], folder: Path, stages: RunConfig, species: str | None) -> Facts:
    """Grow a tree, or take the file ``tree``, and render its views into ``folder``.

    ``species_file`` and ``hdri`` are inputs too if the stages name any.

    Raises
    ------
    InputError, OSError
        if that cannot be done.
    """
    from bbfit.pipeline import prepare

    grow = RunConfig().grow if species is None else replace(stages.grow, species_file=inputs.get("species_file"))
    stages = replace(stages, species=species, grow=grow, views=replace(stages.views, hdri=inputs.get("hdri")))
    prepared = prepare(inputs.get("tree"), folder, stages)
    tree, views = prepared.tree, prepared.views
    return {"mesh": None if tree is None else tree.path.name, "views": len(views.train) + len(views.test)}


def fit_tree(inputs: Mapping[str, Path], folder: Path, stages: RunConfig) -> Facts:
    """Everything from the fit on: billboards for the folder ``views``, placed by the mesh ``tree`` if there is one.

    Raises
    ------
    InputError, OSError
        if that cannot be done.
    """
    from bbfit.pipeline import run

    result = run(inputs["views"], folder, replace(stages, tree=inputs.get("tree")))
    report = result.report.to_json()
    del report["views"], report["rings"]
    return {"report": report, "billboards": len(result.cloud), "texels": len(result.cloud.texels)}


def attempt(work: Callable[[], Facts], where: str) -> Outcome:
    """What came of some work. Whatever goes wrong in it is this task's failure: it is recorded, and the other tasks go on."""
    begun = time.perf_counter()
    facts, reason, trace = None, None, None
    try:
        facts = work()
    except (InputError, OSError) as error:
        reason = " ".join(str(error).split())
    except Exception as error:  # a fault of ours, or too little memory
        reason, trace = " ".join(f"{type(error).__name__}: {error}".split()), traceback.format_exc()
    return Outcome(facts, reason, where, round(time.perf_counter() - begun, 3), trace)
