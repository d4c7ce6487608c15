"""The commands' pages: one that shows results, and one that shows a fit while it goes on."""

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

from bbfit.checks import fail
from bbfit.cli.console import err_console, out_console, progress
from bbfit.fitting.config import FitConfig

if TYPE_CHECKING:
    from bbfit.fitting.loop import Step
    from bbfit.stages.stage import OnProgress
    from bbfit.viewing.watching import Watch

Flag = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class WatchConfig:
    """Looking on in a browser."""

    watch: Flag = False
    """Show the fit on a page while it goes on. In a terminal the page stays until Ctrl-C, elsewhere it ends with the run."""
    host: str = "127.0.0.1"
    """Address that the page listens on: 127.0.0.1 is seen by this machine alone, 0.0.0.0 by everybody on the network."""
    port: int = 8080
    """Port of the page; the next free one if it is taken."""
    open: Flag = False
    """Open the page in this machine's browser."""


def view_command(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    open: Flag = False,
    original_bytes: int = 64 << 20,
) -> None:
    """Look at results in the browser: the original and the billboards side by side, levels of detail, and fields of trees.

    The page is there until Ctrl-C. It needs no network.

    For example: bbfit view runs/tree

    Args:
        run: Folder of bbfit run, bbfit fit or bbfit lod.
        host: Address to listen on: 127.0.0.1 is seen by this machine alone, 0.0.0.0 by everybody on the network.
        port: Port to listen on; the next free one if it is taken.
        open: Open the page in this machine's browser.
        original_bytes: Size of the original up to which it is sent to the browser.
    """
    from bbfit.viewing.opening import view

    if original_bytes < 0:
        fail("original_bytes", f"expected at least 0, got {original_bytes}")
    with view(run, host=host, port=port, original_bytes=original_bytes) as page:
        with _until_ctrl_c() as stay:
            _announce(page.url, port, " (Ctrl-C ends it)", open=open)
            if page.notes:
                out_console.print("\n".join(page.notes), style="yellow", soft_wrap=True, highlight=False)
            stay()


class Onlooker:
    """Shows a run in the terminal and, if there is one, on a page."""

    def __init__(self, watch: Watch | None = None, url: str = "") -> None:
        self._watch, self._url = watch, url

    @property
    def on_step(self) -> Callable[[Step], None] | None:
        """To be called after each step of the fit."""
        return None if self._watch is None else self._watch.on_step

    @contextlib.contextmanager
    def progress(self) -> Iterator[OnProgress]:
        """As :func:`bbfit.cli.console.progress`, on the page too."""
        with progress() as tell:

            def both(stage: str, done: int, total: int, note: str = "") -> None:
                tell(stage, done, total, note)
                if self._watch is not None:
                    self._watch.on_progress(stage, done, total, note)

            yield both

    def finish(self) -> None:
        """Show the finished run; in a terminal, until Ctrl-C."""
        if self._watch is None:
            return
        self._watch.finish()
        if err_console.is_terminal:
            with _until_ctrl_c() as stay:
                out_console.print(f"the page stays at {self._url} until Ctrl-C", soft_wrap=True)
                stay()


@contextlib.contextmanager
def watched(config: WatchConfig, out: Path, source: Path | None, tree: Path | None, fit: FitConfig) -> Iterator[Onlooker]:
    """What shows a run of ``source`` in the folder ``out``; with ``--watch`` there is a page meanwhile."""
    if not config.watch:
        yield Onlooker()
        return
    from bbfit.viewing.page import Page
    from bbfit.viewing.watching import Watch

    alpha = fit.resolve().alpha
    with Page(host=config.host, port=config.port) as page, contextlib.closing(Watch(page, out, source, tree, alpha)) as watch:
        _announce(page.url, config.port, open=config.open)
        yield Onlooker(watch, page.url)


def _announce(url: str, port: int, ending: str = "", *, open: bool) -> None:
    taken = f"port {port} is taken; " if port and not url.endswith(f":{port}") else ""
    out_console.print(f"{taken}look at {url}{ending}", soft_wrap=True)
    if open and not webbrowser.open(url):
        err_console.print("no browser could be opened", style="yellow")


@contextlib.contextmanager
def _until_ctrl_c() -> Iterator[Callable[[], None]]:
    """A function that waits for Ctrl-C, which here is no failure; one pressed before it is called counts.

    A handler notes it, since an exception can be lost where none may leave, such as in what a collected object does last.
    """
    pressed = list[int]()
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))

    def stay() -> None:
        while not pressed:
            time.sleep(0.1)

    try:
        yield stay
    finally:
        signal.signal(signal.SIGINT, before)
