"""A plugin that runs the tests with the marker ``ray`` of a module in a pytest process of their own, whose life is bounded.

Ray's native library can crash the process that uses it, and its daemons can outlive that process. Neither may end or hang the other tests.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

LIFE = float(os.environ.get("BBFIT_TESTS_LIFE", "300"))
"""A process in which no test has ended for so many seconds is killed."""
_REPORTS = "BBFIT_TESTS_REPORTS"
"""In such a process: the file to which it writes a line of JSON for each phase of each test."""
_done: dict[str, list[pytest.TestReport]] = {}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    """Report how the test went elsewhere. With the first of a module, all of the module are run."""
    if not _elsewhere(item):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    if item.nodeid not in _done:
        _run([other for other in item.session.items if other.path == item.path and _elsewhere(other)])
    for report in _done[item.nodeid]:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write down the reports of a process of its own."""
    report = yield
    if _REPORTS in os.environ:
        with Path(os.environ[_REPORTS]).open("a") as file:
            file.write(json.dumps(item.config.hook.pytest_report_to_serializable(config=item.config, report=report)) + "\n")
    return report


def _elsewhere(item: pytest.Item) -> bool:
    return item.get_closest_marker("ray") is not None and _REPORTS not in os.environ


def _run(items: list[pytest.Item]) -> None:
    """Run tests in one process as long as it lives, and in another those that are left.

    A test in which the process is killed by a signal, as by a crash in Ray, gets a second chance.
    """
    waiting, crashed = {item.nodeid: item for item in items}, set[str]()
    while waiting:
        code, output, reports = _attempt(list(waiting.values()))
        _done.update(reports)
        left = [name for name in waiting if name not in reports]
        if not left and code in (0, 1):
            return
        culprit = left[0] if left else list(waiting)[-1]  # the process may also crash when it ends
        left = left or [culprit]
        if code < 0 and culprit not in crashed:
            crashed.add(culprit)
        else:
            reason = f"its process ended with {code}\n{output}"
            _done[culprit] = [pytest.TestReport(culprit, waiting[culprit].location, {}, "failed", reason, "call")]
            left.remove(culprit)
        waiting = {name: waiting[name] for name in left}


def _attempt(items: list[pytest.Item]) -> tuple[int, str, dict[str, list[pytest.TestReport]]]:
    """Exit status of a pytest process, negative for a signal; what it printed; the reports of the tests that ended."""
    config, names = items[0].config, [item.nodeid for item in items]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *names]
    # Files and not pipes: daemons that outlive the process would keep a pipe open.
    with tempfile.TemporaryFile("w+") as printed, tempfile.NamedTemporaryFile("r") as reported:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")} | {_REPORTS: reported.name}
        process = subprocess.Popen(
            command, cwd=config.rootpath, env=environment, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = _exit_status(process, Path(reported.name))
            if code is None:
                code = 1
                printed.write(f"\nit was killed after {LIFE:g} s\n")
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with whatever it left behind
            process.wait()
        printed.seek(0)
        phases = [_report(config, line) for line in reported if line.endswith("\n")]
        ended = {phase.nodeid for phase in phases if phase.when == "teardown"}
        return code, printed.read(), {name: [phase for phase in phases if phase.nodeid == name] for name in names if name in ended}


def _exit_status(process: subprocess.Popen[Any], reported: Path) -> int | None:
    """Wait for a process as long as it reports something within :data:`LIFE`. ``None`` if it does not."""
    size = -1
    while True:
        try:
            return process.wait(LIFE)
        except subprocess.TimeoutExpired:
            if size == (size := reported.stat().st_size):
                return None


def _report(config: pytest.Config, line: str) -> pytest.TestReport:
    return config.hook.pytest_report_from_serializable(config=config, data=json.loads(line))
