"""A plugin for pytest-xdist: a worker process that died ends the test run instead of hanging it.

pytest-xdist learns from the end of a pipe that a worker has died. A process that the worker forked, such as one of Ray's, may keep that
pipe open; then pytest waits forever. This plugin watches the worker processes themselves.
"""

from __future__ import annotations

import os
import select
import sys
import threading
from typing import Any

import pytest

GRACE = float(os.environ.get("BBFIT_TESTS_GRACE", "60"))
"""Seconds that pytest-xdist has to notice by itself that a worker has ended."""
_noticed: dict[str, threading.Event] = {}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_newgateway(gateway: Any) -> None:
    """Watch a worker from its start."""
    channel = gateway.remote_exec("import os; channel.send(os.getpid())")
    pid = channel.receive()
    channel.waitclose()
    _noticed[gateway.id] = threading.Event()
    threading.Thread(target=_watch, args=(gateway.id, os.pidfd_open(pid)), daemon=True).start()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """pytest-xdist has noticed that a worker has ended."""
    _noticed[node.gateway.id].set()


def _watch(name: str, process: int) -> None:
    select.select([process], [], [])  # until it has ended
    if not _noticed[name].wait(GRACE):
        sys.__stderr__.write(f"\nworker {name} died and pytest-xdist did not notice: the test run ends here\n")
        sys.__stderr__.flush()
        os._exit(1)
