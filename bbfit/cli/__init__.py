"""The command line: parse, call, print, exit code; nothing else.

Exit codes: 0 done, 2 bad input, 1 a bug in bbfit, 130 interrupted from the keyboard, 143 and 129 ended by SIGTERM and SIGHUP.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from bbfit.cli.stopping import Stopping


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. Without ``args`` it is that of the process."""
    with Stopping(program=args is None) as stopping:
        from bbfit.cli.program import execute  # which takes a while

        stopping.begin()
        return execute(sys.argv[1:] if args is None else args, program=args is None)
    return stopping.code
