"""Show the progress of a long computation in a terminal or a log."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@contextlib.contextmanager
def progress_bars(console: Console, *, log_interval: float = 60.0) -> Iterator[Callable[..., None]]:
    """Show a progress bar for each stage with its rate and remaining time; yield the callback, a :class:`bbfit.stages.stage.OnProgress`.

    A log gets lines instead: one when a stage is finished and otherwise at least ``log_interval`` seconds apart.
    """
    if not console.is_terminal:
        yield _lines(console, log_interval)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with Progress(
        TextColumn("{task.description:9}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:>10}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
    ) as bars:
        tasks: dict[str, TaskID] = {}

        def on_progress(stage: str, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, rate="", note="", completed=done - 1)
            speed = bars.tasks[list(tasks).index(stage)].speed
            bars.update(tasks[stage], completed=done, total=total, note=note, rate="" if speed is None else f"{speed:.1f}/s")

        yield on_progress


def _lines(console: Console, interval: float) -> Callable[..., None]:
    printed: dict[str, float] = {}

    def on_progress(stage: str, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if done == total or now - printed.setdefault(stage, now) >= interval:
            printed[stage] = now
            console.print(f"{stage} {done}/{total} {note}".rstrip(), highlight=False, markup=False, emoji=False, soft_wrap=True)

    return on_progress
