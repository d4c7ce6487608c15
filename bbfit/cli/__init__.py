"""The command line: parse, call, print, exit code; nothing else.

Exit codes: 0 done, 2 bad input, 1 a failure of ours, 130 stopped from the keyboard.
"""

from __future__ import annotations

import contextlib
import functools
import io
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import tyro

from bbfit.checks import InputError
from bbfit.cli import commands, studies, viewing
from bbfit.cli.console import err_console, out_console


def _later(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """The same command line, but parsing it only returns what to do."""

    @functools.wraps(command)
    def bind(*args: Any, **options: Any) -> Callable[[], None]:
        return functools.partial(command, *args, **options)

    return bind


_COMMANDS: dict[str, Callable[..., Any]] = {
    "run": _later(commands.run_command),
    "grow": _later(commands.grow_command),
    "views": _later(commands.views_command),
    "fit": _later(commands.fit_command),
    "evaluate": _later(commands.evaluate_command),
    "export": _later(commands.export_command),
    "lod": _later(commands.lod_command),
    "view": _later(viewing.view_command),
    "sweep": _later(studies.sweep_command),
    "compare": _later(studies.compare_command),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    if list(sys.argv[1:] if args is None else args) == ["--version"]:
        out_console.print(f"bbfit {version('bbfit')}", highlight=False)
        return 0
    try:
        _parse(args)()
    except BrokenPipeError:  # the reader of our output, such as head, has seen enough
        sys.stdout = None
        return 0
    except (InputError, OSError) as error:
        err_console.print(f"bbfit: {error}", style="red", highlight=False, soft_wrap=True, markup=False)
        return 2
    except KeyboardInterrupt:
        err_console.print("bbfit: stopped; the same command goes on from here")
        return 130
    return 0


def _parse(args: Sequence[str] | None) -> Callable[[], None]:
    """What the arguments ask for; bad values raise :class:`InputError`, unknown options end the process with exit code 2."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                prog="bbfit",
                description="Compress a 3D tree into a handful of textured planes that look like it from every side.",
                args=args,
            )
    except SystemExit as ending:
        error: BaseException | None = ending
        while error is not None and not isinstance(error, InputError):
            error = error.__cause__ or error.__context__
        if error is not None:
            raise error from None
        sys.stderr.write(complaint.getvalue())
        raise
