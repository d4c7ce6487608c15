"""What a command line does: parse, call, print, exit code."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version

import tyro

from bbfit.checks import InputError, in_words
from bbfit.cli import commands, forests, studies, viewing
from bbfit.cli.console import OutputError, err_console, out_console, printing, take_any_text
from bbfit.cli.options import deferred, described, refuse_old
from bbfit.scratch import remove_abandoned

COMMANDS: dict[str, Callable[..., None]] = {
    "run": commands.run_command,
    "grow": commands.grow_command,
    "views": commands.views_command,
    "fit": commands.fit_command,
    "evaluate": commands.evaluate_command,
    "export": commands.export_command,
    "thin": commands.thin_command,
    "lod": commands.lod_command,
    "view": viewing.view_command,
    "sweep": studies.sweep_command,
    "compare": studies.compare_command,
    "frames": studies.frames_command,
    "library": studies.library_command,
    "forest": forests.forest_command,
}
"""The commands by their names."""


def execute(args: Sequence[str], *, program: bool) -> int:
    """Run the command line and return the exit code. In a ``program``, which owns its process, libraries write nothing to the terminal."""
    take_any_text()
    _show_notes()
    if program:
        _silence_libraries()
    try:
        try:
            _run(args)
        finally:  # also when the help or a complaint about an option ends it
            _flush()
    except BrokenPipeError:  # the reader of the output, such as head, has ended
        sys.stdout = None
        return 0
    except (InputError, OSError) as error:
        if isinstance(error, OutputError):
            _drop_output()
        with contextlib.suppress(OSError):  # standard error may be full too
            err_console.print(f"bbfit: {in_words(error)}", style="red", soft_wrap=True)
        return 2
    return 0


def _run(args: Sequence[str]) -> None:
    if list(args) == ["--version"]:
        out_console.print(f"bbfit {version('bbfit')}")
        return
    refuse_old(args)
    command = _parse(args)
    remove_abandoned()
    command()


def _parse(args: Sequence[str]) -> Callable[[], None]:
    """Parse the arguments into a call; bad values raise :class:`InputError`, unknown options end the process with exit code 2."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), printing():
            return tyro.extras.subcommand_cli_from_dict(
                {name: deferred(command) if name in args else described(command) for name, command in COMMANDS.items()},
                prog="bbfit",
                description="Compress a 3D tree into textured planes that look like it from every side.",
                args=args,
                config=(tyro.conf.DisallowNone,),  # an option that is left out is None
            )
    except SystemExit as ending:
        error: BaseException | None = ending
        while error is not None and not isinstance(error, InputError):
            error = error.__cause__ or error.__context__
        if error is not None:
            raise error from None
        sys.stderr.write(complaint.getvalue())
        raise


class _Notes(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        err_console.print(f"bbfit: {record.getMessage()}", style="yellow", soft_wrap=True)


def _show_notes() -> None:
    """Show what bbfit itself remarks."""
    log = logging.getLogger("bbfit")
    if not any(isinstance(handler, _Notes) for handler in log.handlers):
        log.addHandler(_Notes())


def _silence_libraries() -> None:
    """Show no warnings of libraries, also in processes that this one starts, unless the user asks for them."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    logging.getLogger().addHandler(logging.NullHandler())
    if not sys.warnoptions:
        os.environ["PYTHONWARNINGS"] = "ignore"
        warnings.simplefilter("ignore")


def _flush() -> None:
    if sys.stdout is not None:
        with printing():
            sys.stdout.flush()


def _drop_output() -> None:
    """Write what is left of the output to nowhere, so that Python does not fail to write it at the end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
