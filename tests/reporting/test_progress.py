"""Progress in a terminal and in a log."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from bbfit.reporting.progress import progress_bars


def report(console: Console, **options: float) -> None:
    """Report two stages of three and two units."""
    with progress_bars(console, **options) as on_progress:
        for stage, count in (("views", 3), ("fit", 2)):
            for done in range(count + 1):
                on_progress(stage, done, count, f"note {done}")


def test_a_log_gets_a_line_for_each_finished_stage() -> None:
    text = io.StringIO()
    report(Console(file=text))
    assert text.getvalue() == "views 3/3 note 3\nfit 2/2 note 2\n"
    report(Console(file=text), log_interval=0.0)
    assert len(text.getvalue().splitlines()) == 2 + 4 + 3


def test_a_terminal_gets_a_bar_for_each_stage() -> None:
    text = io.StringIO()
    report(Console(file=text, force_terminal=True, width=100))
    assert all(word in text.getvalue() for word in ("views", "3/3", "fit", "2/2", "note 2"))


@pytest.mark.parametrize("terminal", [False, True])
def test_a_note_is_shown_as_it_is(terminal: bool) -> None:
    """Reasons of failures name paths, and paths may look like markup or like the code of an emoji."""
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=120, color_system=None)
    with progress_bars(console) as on_progress:
        on_progress("runs", 1, 1, "c/[/b] [red]:evergreen_tree:.glb")
    assert "c/[/b] [red]:evergreen_tree:.glb" in out.getvalue()
