"""The guards of the test run itself: neither a dead worker of pytest-xdist nor a crash in Ray can hang it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parent


def pytest_on(source: str, folder: Path, *arguments: str, **environment: str) -> tuple[int, str]:
    """Exit status and output of pytest on one file in a process of its own."""
    (folder / "test_it.py").write_text(source)
    (folder / "conftest.py").write_text("from own_process import pytest_runtest_makereport, pytest_runtest_protocol")
    given = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")} | environment
    given["PYTHONPATH"] = os.pathsep.join(filter(None, (str(TESTS), given.get("PYTHONPATH"))))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments, "test_it.py"]
    with (folder / "output").open("w") as output:  # and no pipe, which would stay open as long as any process that inherits it
        code = subprocess.run(command, cwd=folder, env=given, stdout=output, stderr=subprocess.STDOUT).returncode
    return code, (folder / "output").read_text()


def test_a_worker_that_dies_unnoticed_ends_the_run(tmp_path: Path) -> None:
    """A process that it has forked holds its pipe; without the guard, pytest-xdist waits for that process forever."""
    source = """
import os, pathlib, signal
def test_dies():
    if os.fork() == 0:
        pathlib.Path("holder").write_text(str(os.getpid()))
        signal.pause()
    while not (pathlib.Path("holder").exists() and pathlib.Path("holder").read_text()):
        pass
    os.kill(os.getpid(), signal.SIGKILL)
"""
    try:
        code, output = pytest_on(source, tmp_path, "-p", "dead_workers", "--numprocesses", "1", BBFIT_TESTS_GRACE="1")
    finally:
        os.kill(int((tmp_path / "holder").read_text()), signal.SIGKILL)
    assert code == 1 and "worker gw0 died and pytest-xdist did not notice" in output


def test_a_crash_costs_one_test_only_and_may_happen_once(tmp_path: Path) -> None:
    source = """
import os, pathlib, signal, pytest
pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings("ignore")]
def crash():
    os.kill(os.getpid(), signal.SIGSEGV)
def test_crashes_once():
    if not pathlib.Path("crashed").exists():
        pathlib.Path("crashed").touch()
        crash()
def test_crashes_again(): crash()
def test_fails(): assert 1 == 2
@pytest.fixture(scope="module")
def shared():
    yield os.getpid()
def test_passes(shared): assert shared == os.getpid()
def test_is_beside_it(shared): assert shared == os.getpid()
"""
    code, output = pytest_on(source, tmp_path)
    assert code == 1 and "2 failed, 3 passed" in output
    assert output.count("\nits process ended with -11") == 1 and "assert 1 == 2" in output


def test_a_crash_at_the_end_may_happen_once(tmp_path: Path) -> None:
    source = """
import atexit, os, pathlib, signal, pytest
pytestmark = pytest.mark.ray
def crash():
    if len(pathlib.Path("ends").read_text()) < LIMIT:
        os.kill(os.getpid(), signal.SIGSEGV)
def test_first(): pass
def test_last():
    with pathlib.Path("ends").open("a") as ends:
        ends.write(".")
    atexit.register(crash)
"""
    code, output = pytest_on(source.replace("LIMIT", "2"), tmp_path)
    assert code == 0 and "2 passed" in output
    code, output = pytest_on(source.replace("LIMIT", "9"), tmp_path)
    assert code == 1 and "1 failed, 1 passed" in output


def test_a_test_that_hangs_is_killed(tmp_path: Path) -> None:
    source = """
import signal, pytest
@pytest.mark.ray
def test_hangs(): signal.pause()
"""
    code, output = pytest_on(source, tmp_path, BBFIT_TESTS_LIFE="1")
    assert code == 1 and "it was killed after 1 s" in output
