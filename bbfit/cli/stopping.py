"""Ctrl-C, SIGTERM and SIGHUP: how the command line ends early. It imports little, because it works while the rest is imported."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that end a command. Its exit code is then 128 and the signal's number."""
LINE = "bbfit: stopped; the same command resumes from here"
"""What a command says that is ended early."""


class Stopped(KeyboardInterrupt):
    """A signal tells the command to end. Code that tidies up after Ctrl-C also tidies up after other signals."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Stopping:
    """Within this context a signal ends the command in an orderly way: it raises :class:`Stopped`, and leaving the context says so.

    A signal that comes where an exception would do harm ends the process at once: before :meth:`begin`, during an import, and again while
    the first one is answered. This still holds after the context, until the process ends. Signals that the process ignores, as under
    nohup, stay as they are. If the command is no ``program``, which owns its process, all signals do, and only Ctrl-C ends the command.
    """

    def __init__(self, *, program: bool) -> None:
        self._program, self._begun, self._said = program, False, False
        self._number: int | None = None
        self._handled = list[int]()

    @property
    def code(self) -> int:
        """The exit code of a command that was stopped."""
        return 128 + (self._number or signal.SIGINT)

    def __enter__(self) -> Stopping:
        if self._program and threading.current_thread() is threading.main_thread():
            self._hook, sys.unraisablehook = sys.unraisablehook, self._raise_again
            for number in SIGNALS:
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    self._handled.append(number)
                    signal.signal(number, self._stop)
        return self

    def begin(self) -> None:
        """From now on a signal raises :class:`Stopped`."""
        self._begun = True

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> bool:
        self._begun = False
        # Some libraries turn the exception into one of their own.
        stopped = isinstance(error, KeyboardInterrupt) or (error is not None and self._number is not None)
        if stopped:
            self._said = True
            with contextlib.suppress(OSError):  # standard error is full
                print(LINE, file=sys.stderr, flush=True)
        return stopped

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if not self._begun or self._number is not None or _imports(frame):
            self._end(number)
        self._number = number
        raise Stopped(number)

    def _end(self, number: int) -> None:
        """End the process at once."""
        for other in self._handled:
            signal.signal(other, signal.SIG_IGN)
        self._number = self._number or number
        if not self._said:
            shown = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides the cursor
            with contextlib.suppress(OSError):
                os.write(2, f"{shown}{LINE}\n".encode())  # sys.stderr may be in use
        scratch = sys.modules.get("bbfit.scratch")
        if scratch is not None:
            scratch.remove_own()
        os._exit(self.code)

    def _raise_again(self, lost: Any) -> None:
        """Where no exception may leave, such as in the finalizer of an object, Python drops it and calls this function."""
        if isinstance(lost.exc_value, Stopped):
            self._number = None
            threading.Timer(0.01, _send, (lost.exc_value.number,)).start()
        else:
            self._hook(lost)


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported. Libraries in C do not bear an exception in their import."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _send(number: int) -> None:
    """Send a signal to the main thread."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)
