"""Progress of long work in a terminal."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@contextlib.contextmanager
def progress_bars(console: Console, *, every: float = 60.0) -> Iterator[Callable[..., None]]:
    """A bar for each stage, with rate and time left; yields what the work has to tell (:class:`bbfit.stages.stage.OnProgress`).

    What is no terminal, as a log, gets a line when a stage is finished and every ``every`` seconds on the way.
    """
    if not console.is_terminal:
        yield _lines(console, every)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with Progress(
        TextColumn("{task.description:9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:>10}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
    ) as bars:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, rate="", note="", completed=done - 1)
            speed = bars.tasks[list(tasks).index(stage)].speed
            bars.update(tasks[stage], completed=done, total=total, note=note, rate="" if speed is None else f"{speed:.1f}/s")

        yield tell


def _lines(console: Console, every: float) -> Callable[..., None]:
    told: dict[str, float] = {}

    def tell(stage: str, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if done == total or now - told.setdefault(stage, now) >= every:
            told[stage] = now
            console.print(f"{stage} {done}/{total} {note}".rstrip(), highlight=False, soft_wrap=True)

    return tell
