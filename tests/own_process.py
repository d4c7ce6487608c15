"""A plugin that runs each test with the marker ``ray`` in a pytest process of its own, whose life is bounded.

Ray's native library can crash the process that uses it, and its daemons can outlive that process. Neither may end or hang the other tests.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile

import pytest

LIFE = float(os.environ.get("BBFIT_TESTS_LIFE", "300"))
"""Seconds after which a test's process is killed."""
_INSIDE = "BBFIT_TESTS_OWN_PROCESS"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    """Run the test elsewhere and report how it went."""
    if item.get_closest_marker("ray") is None or _INSIDE in os.environ:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    call = pytest.CallInfo.from_call(lambda: _run(item), "call")
    item.ihook.pytest_runtest_logreport(report=pytest.TestReport.from_item_and_call(item, call))
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def _run(item: pytest.Item) -> None:
    """Fail if the test fails; one whose process is killed by a signal, as by a crash in Ray, gets a second chance."""
    code, output = _attempt(item)
    if code < 0:
        code, again = _attempt(item)
        output += again
    if code:
        pytest.fail(f"its process ended with {code}\n{output}", pytrace=False)


def _attempt(item: pytest.Item) -> tuple[int, str]:
    """Exit status of a pytest process for one test, negative for a signal, and what it printed."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", item.nodeid]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")} | {_INSIDE: "1"}
    # A file and not a pipe: daemons that outlive the process would keep a pipe open.
    with tempfile.TemporaryFile("w+") as printed:
        process = subprocess.Popen(
            command, cwd=item.config.rootpath, env=environment, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(LIFE)
        except subprocess.TimeoutExpired:
            code = 1
            printed.write(f"\nit was killed after {LIFE:g} s\n")
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with whatever it left behind
            process.wait()
        printed.seek(0)
        return code, printed.read()
