"""The command line: parse, call, print, exit code; nothing else.

Exit codes: 0 done, 2 bad input, 1 a bug in bbfit, 130 interrupted from the keyboard.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import tyro

from bbfit.checks import InputError
from bbfit.cli import commands, studies, viewing
from bbfit.cli.console import err_console, out_console
from bbfit.cli.options import deferred, refuse_dotted

_COMMANDS: dict[str, Callable[..., Any]] = {
    "run": deferred(commands.run_command),
    "grow": deferred(commands.grow_command),
    "views": deferred(commands.views_command),
    "fit": deferred(commands.fit_command),
    "evaluate": deferred(commands.evaluate_command),
    "export": deferred(commands.export_command),
    "lod": deferred(commands.lod_command),
    "view": deferred(viewing.view_command),
    "sweep": deferred(studies.sweep_command),
    "compare": deferred(studies.compare_command),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = sys.argv[1:] if args is None else args
    if list(args) == ["--version"]:
        out_console.print(f"bbfit {version('bbfit')}", highlight=False)
        return 0
    try:
        refuse_dotted(args)
        _parse(args)()
    except BrokenPipeError:  # the reader of the output, such as head, has ended
        sys.stdout = None
        return 0
    except (InputError, OSError) as error:
        err_console.print(f"bbfit: {error}", style="red", highlight=False, soft_wrap=True, markup=False)
        return 2
    except KeyboardInterrupt:
        err_console.print("bbfit: stopped; the same command resumes from here")
        return 130
    return 0


def _parse(args: Sequence[str]) -> Callable[[], None]:
    """Parse the arguments into a call; bad values raise :class:`InputError`, unknown options end the process with exit code 2."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                prog="bbfit",
                description="Compress a 3D tree into a handful of textured planes that look like it from every side.",
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
