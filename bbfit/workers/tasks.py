"""Tasks: functions that any process on any machine can run.

A task reads files, writes to one folder, and returns a few values as JSON. The workers provide the input files and keep the folder.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bbfit.checks import InputError, in_words

Facts = dict[str, Any]
"""The result of a task as JSON."""


class Work(Protocol):
    """The function of a task."""

    def __call__(self, inputs: Mapping[str, Path], folder: Path, *arguments: Any) -> Facts:
        """Read ``inputs``, which are files or folders (perhaps copies on another machine), and write to ``folder``."""


@dataclass(frozen=True)
class Task:
    """A function with its inputs, arguments and output folder."""

    name: str
    """A unique name."""
    work: Work
    """A module-level function, so that other processes can import it."""
    inputs: Mapping[str, tuple[Path, ...]]
    """Each input is a folder or a tuple of files. The function gets the path of the first file. The others lie in its folder or below."""
    folder: Path
    """The output folder. It can contain partial results of an earlier attempt, which the function may use."""
    arguments: tuple[Any, ...] = ()
    """Further arguments of the function."""
    alone: bool = False
    """Whether the task uses all cores of a machine."""


@dataclass(frozen=True)
class Outcome:
    """The result of a task, or the reason for its failure."""

    facts: Facts | None
    """The values that the function returned. ``None`` if it failed."""
    reason: str | None
    """The reason for the failure."""
    where: str
    """The machine or the Ray node that ran the task."""
    seconds: float = 0.0
    """The duration in seconds."""
    trace: str | None = None
    """The traceback, if the failure is an error in the program."""


class Workers(Protocol):
    """Processes that run tasks, on this machine or others. This is a context manager: leaving it ends the processes."""

    def __enter__(self) -> Workers:
        """Start."""

    def __exit__(self, *_: object) -> None:
        """End all processes."""

    def submit(self, task: Task) -> None:
        """Run a task as soon as a process is free."""

    def next(self) -> tuple[Task, Outcome]:
        """Wait until a task ends. At least one submitted task must be unfinished."""


def attempt(work: Callable[[], Facts], where: str) -> Outcome:
    """Run a function and record its result. Any error becomes the failure of this task, and the other tasks continue."""
    started = time.perf_counter()
    facts, reason, trace = None, None, None
    try:
        facts = work()
    except (InputError, OSError) as error:
        reason = " ".join(in_words(error).split())
    except Exception as error:  # an error in the program, or too little memory
        reason, trace = " ".join(f"{type(error).__name__}: {error}".split()), traceback.format_exc()
    return Outcome(facts, reason, where, round(time.perf_counter() - started, 3), trace)
