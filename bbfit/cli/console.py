"""The terminal: results on standard output, progress and errors on standard error."""

from __future__ import annotations

import codecs
import contextlib
import io
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig

if TYPE_CHECKING:
    from bbfit.pipeline import RunResult
    from bbfit.stages.stage import OnProgress


class OutputError(InputError):
    """Standard output cannot be written to."""


@contextlib.contextmanager
def printing() -> Iterator[None]:
    """Within this block only standard output is written. If that fails, it raises :class:`OutputError`; a closed pipe is another matter."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"standard output cannot be written to ({error.strerror})") from None


class _Output(Console):
    def print(self, *objects: Any, **options: Any) -> None:
        with printing():
            super().print(*objects, **options)


out_console = _Output(markup=False, emoji=False, highlight=False)
"""Standard output. It shows text as it is, so that paths may contain anything."""
err_console = Console(stderr=True, markup=False, emoji=False, highlight=False)
"""Standard error, likewise."""
# What bbfit, its progress bars and its help write beyond ASCII, for terminals that know ASCII alone.
_PLAIN = str.maketrans("↑↓→·•²…╭╮╰╯├┤┬┴┼─━│┃╸╺", "^v>-*2.+++++++++--||--") | {ord("±"): "+-", ord("°"): " degrees"}


def show(result: RunResult, *, thesis: bool) -> None:
    """Print the scores of a run, with those on the thesis's scale if ``thesis``, and the folder of its results."""
    from bbfit.reporting.tables import report_table

    out_console.print(report_table(result.report, thesis=thesis))
    if result.report.distances is not None:
        out_console.print(result.report.distances.verdict)
    if result.skipped:
        out_console.print(f"unchanged and skipped: {', '.join(result.skipped)}", style="dim")
    if result.missed is not None:
        out_console.print(
            f"no short fit within the budget reached {result.missed:g} dB on validation views; this is the best one, fitted for longer",
            style="yellow",
        )
    if result.bound is not None:
        said = f"the model takes {result.report.bytes.model:,} bytes, less than half of the limit; more billboards look better near by"
        out_console.print(f"{said}: allow more than {result.bound} with --most-billboards", style="yellow", soft_wrap=True)
    out_console.print(
        f"results in {result.folder}: report.html shows all; model.glb, model.obj, metrics.json, cloud.safetensors", soft_wrap=True
    )


def show_missing_encoder(config: ExportConfig) -> None:
    """Print what to install, if a texture format was omitted because its encoder is missing."""
    if config.missing_encoder is not None:
        out_console.print(f"textures are PNG alone, without mip levels; for KTX2 {config.missing_encoder}", style="yellow", soft_wrap=True)


def progress() -> contextlib.AbstractContextManager[OnProgress]:
    """A progress bar for each stage, on standard error."""
    from bbfit.reporting.progress import progress_bars

    return progress_bars(err_console)


def take_any_text() -> None:
    """Let standard output and standard error take any text. What they cannot encode is replaced by something similar or by its code."""
    codecs.register_error("bbfit", _similar)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="bbfit")


def _similar(error: UnicodeError) -> tuple[str | bytes, int]:
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end].translate(_PLAIN)
    return "".join(map(_escaped, text)), error.end


def _escaped(letter: str) -> str:
    code = ord(letter)
    if 0xDC80 <= code <= 0xDCFF:  # where Python keeps the bytes of a path that are not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return letter.encode("ascii", "backslashreplace").decode()
