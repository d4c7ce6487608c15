"""Stopping a process from the keyboard, and by other signals."""

from __future__ import annotations

import signal


def heed_ctrl_c() -> None:
    """For ``subprocess``'s ``preexec_fn``: a process that a shell starts in the background, as these tests may be, ignores Ctrl-C, and so
    would its children."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def heed_signals() -> None:
    """The same for Ctrl-C, SIGTERM and SIGHUP."""
    heed_ctrl_c()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
