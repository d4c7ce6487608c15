"""The commands ``bbfit view`` and ``bbfit fit --watch``, in processes of their own."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from interrupting import heed_ctrl_c

from bbfit.cli import main

DATA = Path(__file__).resolve().parents[2] / "data"
BBFIT = [sys.executable, "-W", "error", "-m", "bbfit.cli"]


def test_view_says_where_it_is_and_ends_by_ctrl_c(small_run: Path) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([*BBFIT, "view", str(small_run), "--port", "0"], **pipes, text=True, preexec_fn=heed_ctrl_c)
    assert process.stdout is not None
    found = re.fullmatch(r"viewer at (http://127\.0\.0\.1:\d+) \(Ctrl-C ends it\)\n", process.stdout.readline())
    try:
        assert found is not None
        with urllib.request.urlopen(found[1], timeout=30) as answer:
            assert answer.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


def test_watching_where_nobody_can_stop_it_ends_with_the_run(views_folder: Path, tmp_path: Path) -> None:
    words = ["fit", str(views_folder), "--out", str(tmp_path / "run"), "--watch", "--port", "0"]
    fit = ["--billboards", "1", "--placement", "even", "--steps", "4", "--levels", "1"]
    done = subprocess.run([*BBFIT, *words, *fit], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("viewer at http://127.0.0.1:")
    assert done.stderr == "" or "Traceback" not in done.stderr
    assert (tmp_path / "run" / "model.glb").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "nowhere"], "run: nowhere does not exist"),
        (["view", str(DATA / "views")], "holds no cloud.safetensors"),
        (["view", str(DATA / "tree.glb")], "is not a folder"),
        (["view", "RUN", "--port", "70000"], "port: expected 0 to 65535, got 70000"),
        (["view", "RUN", "--host", "192.0.2.1"], "host: cannot listen on 192.0.2.1"),
        (["view", "RUN", "--original-bytes", "-1"], "original_bytes: expected at least 0"),
    ],
)
def test_errors_are_said_in_a_line(words: list[str], message: str, small_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(small_run) if word == "RUN" else word for word in words]) == 2
    assert message in capsys.readouterr().err
