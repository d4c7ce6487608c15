"""The command that shows results in the browser, and the option that shows a run there."""

from __future__ import annotations

import contextlib
import signal
import time
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bbfit.checks import Range, check_fields, fail
from bbfit.cli.console import err_console, out_console, progress
from bbfit.fitting.config import FitConfig

if TYPE_CHECKING:
    from bbfit.fitting.loop import Step
    from bbfit.stages.stage import OnProgress
    from bbfit.viewing.watching import Watch

Flag = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class WatchConfig:
    """Options for watching a run in the browser."""

    watch: Flag = False
    """Show the fit in the browser while it runs. In a terminal the viewer stays until Ctrl-C, elsewhere it ends with the run."""
    host: str = "127.0.0.1"
    """Address that the viewer listens on: only this machine can reach 127.0.0.1, everybody on the network can reach 0.0.0.0."""
    port: Annotated[int, Range(0, 65535)] = 8080
    """Port of the viewer; the next free one if it is taken."""
    open: Flag = False
    """Open the viewer in this machine's browser."""

    def __post_init__(self) -> None:
        check_fields(self)


def view_command(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    open: Flag = False,
    original_bytes: int = 64 << 20,
) -> None:
    """Show results in the browser: the original and the billboards side by side, levels of detail, and fields of trees.

    The viewer runs until Ctrl-C. It needs no network.

    For example: bbfit view runs/tree

    Args:
        run: Folder of bbfit run, bbfit fit or bbfit lod.
        host: Address to listen on: only this machine can reach 127.0.0.1, everybody on the network can reach 0.0.0.0.
        port: Port to listen on; the next free one if it is taken.
        open: Open the viewer in this machine's browser.
        original_bytes: The largest size of the original's file that is sent to the browser.
    """
    from bbfit.viewing.server import view

    if original_bytes < 0:
        fail("original_bytes", f"expected at least 0, got {original_bytes}")
    with view(run, host=host, port=port, original_bytes=original_bytes) as viewer:
        with _until_ctrl_c() as wait:
            _announce(viewer.url, port, " (Ctrl-C ends it)", open=open)
            if viewer.notes:
                out_console.print("\n".join(viewer.notes), style="yellow", soft_wrap=True)
            wait()


class RunDisplay:
    """Shows a run in the terminal and, with ``--watch``, in the viewer."""

    def __init__(self, watch: Watch | None = None, url: str = "") -> None:
        self._watch, self._url = watch, url

    @property
    def on_step(self) -> Callable[[Step], None] | None:
        """A function to call after each step of the fit, if there is one."""
        return None if self._watch is None else self._watch.on_step

    @contextlib.contextmanager
    def progress(self) -> Iterator[OnProgress]:
        """The progress bars of :func:`bbfit.cli.console.progress`, and a line in the viewer."""
        with progress() as show:

            def show_both(stage: str, done: int, total: int, note: str = "") -> None:
                show(stage, done, total, note)
                if self._watch is not None:
                    self._watch.on_progress(stage, done, total, note)

            yield show_both

    def finish(self) -> None:
        """Show the finished run; in a terminal, until Ctrl-C."""
        if self._watch is None:
            return
        self._watch.finish()
        if err_console.is_terminal:
            with _until_ctrl_c() as wait:
                out_console.print(f"the viewer runs at {self._url} until Ctrl-C", soft_wrap=True)
                wait()


@contextlib.contextmanager
def watched(config: WatchConfig, out: Path, source: Path | None, tree: Path | None, fit: FitConfig) -> Iterator[RunDisplay]:
    """The display of a run of ``source`` in the folder ``out``; with ``--watch`` a viewer runs meanwhile."""
    if not config.watch:
        yield RunDisplay()
        return
    from bbfit.viewing.server import Viewer
    from bbfit.viewing.watching import Watch, WatchedRun

    alpha = fit.resolve().alpha
    with Viewer(host=config.host, port=config.port) as viewer:
        with contextlib.closing(Watch(viewer, WatchedRun(out, source, tree, alpha))) as watch:
            _announce(viewer.url, config.port, open=config.open)
            yield RunDisplay(watch, viewer.url)


def _announce(url: str, port: int, ending: str = "", *, open: bool) -> None:
    taken = f"port {port} is taken; " if port and not url.endswith(f":{port}") else ""
    out_console.print(f"{taken}viewer at {url}{ending}", soft_wrap=True)
    if open and not webbrowser.open(url):
        err_console.print("no browser could be opened", style="yellow")


@contextlib.contextmanager
def _until_ctrl_c() -> Iterator[Callable[[], None]]:
    """A function that waits for Ctrl-C, which ends the command without an error. Ctrl-C counts even before the function is called.

    A signal handler records it, because an exception would be lost where none may leave, such as in the finalizer of an object.
    """
    pressed = list[int]()
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))

    def wait() -> None:
        while not pressed:
            time.sleep(0.1)

    try:
        yield wait
    finally:
        signal.signal(signal.SIGINT, before)
