"""What surrounds a command: signals, full and plain terminals, odd file names, temporary folders, and what libraries say."""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from interrupting import heed_signals

from bbfit import scratch
from bbfit.cli.stopping import LINE

BBFIT = [sys.executable, "-m", "bbfit.cli"]
SCRIPT = "import sys; from bbfit.cli import main; sys.exit(main())"
ENDINGS = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
DATA = Path(__file__).resolve().parents[1] / "data"


def started(command: list[str | bytes], **environment: str) -> subprocess.Popen[bytes]:
    """Start a process that heeds signals, with pipes."""
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **pipes, env={**os.environ, **environment}, preexec_fn=heed_signals)


def after(process: subprocess.Popen[bytes], line: bytes) -> None:
    """Wait until a process prints a line."""
    assert process.stdout
    while (said := process.stdout.readline()) != line + b"\n":
        assert said, process.communicate()[1].decode()


def stopped(process: subprocess.Popen[bytes], *numbers: int) -> tuple[int, str]:
    """Send signals to a process; its exit code and what it says on standard error."""
    for number in numbers:
        process.send_signal(number)
    _, said = process.communicate(timeout=60)
    return process.returncode, said.decode()


def waiting(name: str, folder: Path) -> str:
    """A folder with a module of a name, which waits when it is imported."""
    (folder / f"{name}.py").write_text("import sys\nprint('importing', flush=True)\nsys.stdin.readline()\n")
    return os.pathsep.join([str(folder), str(Path(__file__).resolve().parents[1])])


@pytest.mark.parametrize(("number", "code"), ENDINGS)
@pytest.mark.parametrize("command", [BBFIT, [sys.executable, "-c", SCRIPT]], ids=["module", "script"])
@pytest.mark.parametrize(("module", "words"), [("tyro", ["--help"]), ("numpy", ["fit", str(DATA / "views"), "--out", "out"])])
def test_stopped_while_it_imports(number: int, code: int, command: list[str], module: str, words: list[str], tmp_path: Path) -> None:
    process = started([*command, *words], PYTHONPATH=waiting(module, tmp_path))
    after(process, b"importing")
    assert stopped(process, number) == (code, f"{LINE}\n")


# A run that does nothing, and whose end takes a while.
_RUN = """
import os, sys, time, bbfit.pipeline
from bbfit.cli import main
from bbfit.scratch import ScratchFolder

def run(*arguments, **options):
    with ScratchFolder() as folder:
        try:
            print("running", flush=True)
            while True:
                time.sleep(0.01)
        finally:
            END

bbfit.pipeline.run = run
sys.exit(main())
"""


def a_run(end: str, tmp_path: Path) -> subprocess.Popen[bytes]:
    code = _RUN.replace("END", textwrap.indent(end, " " * 12).lstrip())
    return started([sys.executable, "-c", code, "fit", str(DATA / "views"), "--out", str(tmp_path / "out")], TMPDIR=str(tmp_path))


def scratch_folders(tmp_path: Path) -> list[Path]:
    return list(tmp_path.glob(f"{scratch.PREFIX}*"))


@pytest.mark.parametrize(("number", "code"), ENDINGS)
def test_a_signal_ends_a_command_in_one_line_and_leaves_no_folder(number: int, code: int, tmp_path: Path) -> None:
    process = a_run("pass", tmp_path)
    after(process, b"running")
    assert len(scratch_folders(tmp_path)) == 1
    assert stopped(process, number) == (code, f"{LINE}\n")
    assert not scratch_folders(tmp_path)


@pytest.mark.parametrize("again", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("end", ["time.sleep(1000)", "import tidying"])
def test_a_second_signal_ends_it_at_once(again: int, end: str, tmp_path: Path) -> None:
    (tmp_path / "tidying.py").write_text("import time\ntime.sleep(1000)\n")
    process = a_run(f"sys.path.insert(0, {str(tmp_path)!r})\nprint('tidying', flush=True)\n{end}", tmp_path)
    after(process, b"running")
    process.send_signal(signal.SIGINT)
    after(process, b"tidying")
    assert stopped(process, again) == (130, f"{LINE}\n")
    assert not scratch_folders(tmp_path)


def test_a_signal_while_the_process_ends_says_nothing_of_python(tmp_path: Path) -> None:
    """A thread that the end waits for, as of a pool."""
    thread = "import threading\nthreading.Thread(target=sys.stdin.readline).start()\nprint('tidied', flush=True)"
    process = a_run(thread, tmp_path)
    after(process, b"running")
    process.send_signal(signal.SIGINT)
    after(process, b"tidied")
    assert process.stderr and process.stderr.readline().decode() == f"{LINE}\n"
    assert stopped(process, signal.SIGINT) == (130, "")


def test_a_signal_in_a_finalizer_is_not_lost(tmp_path: Path) -> None:
    end = "pass"
    code = _RUN.replace("END", end).replace(
        'print("running", flush=True)',
        "class Thing:\n                def __del__(self):\n                    print('running', flush=True)\n"
        "                    while not os.path.exists('sent'): pass\n            Thing()",
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "fit", str(DATA / "views"), "--out", "out"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        preexec_fn=heed_signals,
    )
    after(process, b"running")
    process.send_signal(signal.SIGTERM)
    (tmp_path / "sent").touch()
    assert stopped(process) == (143, f"{LINE}\n")


def test_signals_that_are_ignored_stay_so(tmp_path: Path) -> None:
    """As those of a terminal that is closed, under nohup."""
    code = _RUN.replace("END", "pass")
    ignoring = f"import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n{code}"
    process = started([sys.executable, "-c", ignoring, "fit", str(DATA / "views"), "--out", "out"], TMPDIR=str(tmp_path))
    after(process, b"running")
    assert stopped(process, signal.SIGHUP, signal.SIGTERM) == (143, f"{LINE}\n")


def test_folders_of_killed_processes_are_removed_at_the_next_start(tmp_path: Path) -> None:
    living, killed = a_run("pass", tmp_path), a_run("pass", tmp_path)
    for process in (living, killed):
        after(process, b"running")
    (tmp_path / f"{scratch.PREFIX}link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    killed.kill()
    killed.communicate()
    assert len(scratch_folders(tmp_path)) == 3
    subprocess.run([*BBFIT, "grow", "--list"], check=True, stdout=subprocess.DEVNULL, env={**os.environ, "TMPDIR": str(tmp_path)})
    assert len(scratch_folders(tmp_path)) == 2 and (tmp_path / "elsewhere").is_dir()
    stopped(living, signal.SIGTERM)
    assert [path.name for path in scratch_folders(tmp_path)] == [f"{scratch.PREFIX}link"]


def test_view_ends_by_sigterm(tmp_path: Path) -> None:
    code = """
import contextlib, sys, types, bbfit.viewing.server as server
from bbfit.cli import main
server.view = lambda *a, **k: contextlib.nullcontext(types.SimpleNamespace(url="http://x:8080", notes=()))
sys.exit(main())
"""
    process = started([sys.executable, "-c", code, "view", str(tmp_path)])
    after(process, b"viewer at http://x:8080 (Ctrl-C ends it)")
    assert stopped(process, signal.SIGTERM) == (143, f"{LINE}\n")


# A sweep with one tree, in which views.render takes forever.
def test_a_sweep_that_is_stopped_ends_its_processes_and_removes_their_folders(tmp_path: Path) -> None:
    (tmp_path / "works.py").write_text(
        "import os, time\nfrom bbfit.scratch import ScratchFolder\n"
        "def work(inputs, folder):\n    with ScratchFolder():\n        print(os.getpid(), flush=True)\n        time.sleep(1000)\n"
    )
    code = """
import sys, works, bbfit.sweep.scheduling as scheduling
from pathlib import Path
from bbfit.cli import main
from bbfit.workers.local import LocalWorkers
from bbfit.workers.tasks import Task

def run_sweep(*arguments, **options):
    with LocalWorkers(1) as workers:
        workers.submit(Task("work", works.work, {}, Path()))
        workers.next()

if __name__ == "__main__":
    scheduling.run_sweep = run_sweep
    sys.exit(main())
"""
    (tmp_path / "program.py").write_text(code)
    process = started([sys.executable, str(tmp_path / "program.py"), "sweep", "--out", str(tmp_path / "out")], TMPDIR=str(tmp_path))
    assert process.stdout
    worker = os.pidfd_open(int(process.stdout.readline()))
    assert len(scratch_folders(tmp_path)) == 1
    assert stopped(process, signal.SIGTERM) == (143, f"{LINE}\n")
    assert select.select([worker], [], [], 0)[0]
    os.close(worker)
    assert not scratch_folders(tmp_path)


def said_by(words: list[str | bytes], **environment: str) -> tuple[int, bytes, bytes]:
    """Exit code, standard output and standard error of a command."""
    done = subprocess.run([*BBFIT, *words], capture_output=True, env={**os.environ, **environment})
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", [["grow", "--list"], ["--help"]], ids=" ".join)
def test_output_that_is_full_is_one_line(words: list[str], unbuffered: str) -> None:
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([*BBFIT, *words], stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert (done.returncode, done.stderr) == (2, "bbfit: standard output cannot be written to (No space left on device)\n")


@pytest.mark.parametrize("words", [["grow", "--list"], ["run", "--help"]], ids=" ".join)
def test_a_terminal_that_knows_ascii_alone(words: list[str]) -> None:
    code, out, err = said_by(words, LC_ALL="C", PYTHONUTF8="0", PYTHONIOENCODING="ascii")
    assert code == 0 and out.isascii() and not err
    assert words == ["run", "--help"] or b"13 +- 3" in out


@pytest.mark.parametrize("name", [b"c/[/b].glb", b"[red]:evergreen_tree:.glb", b"caf\xe9.glb"], ids=["markup", "emoji", "latin"])
def test_odd_names_are_shown_as_they_are(name: bytes, tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/" + name
    Path(os.fsdecode(path)).parent.mkdir(parents=True, exist_ok=True)
    shown = path.replace(b"\xe9", rb"\xe9")
    code, out, err = said_by([b"grow", b"acer", b"--out", path, b"--detail", b"0.1", b"--leaves", b"0"])
    assert code == 0 and shown + b"  " in out and not err
    code, out, err = said_by([b"export", path, b"--out", path])
    assert code == 2 and b"bbfit: cloud: " + shown in err and err.count(b"\n") == 1


def test_a_fit_from_and_to_a_folder_whose_name_is_not_utf8(views_folder: Path, tmp_path: Path) -> None:
    views, out = os.fsencode(tmp_path) + b"/v\xff[/b]", os.fsencode(tmp_path) + b"/o\xff[/b]"
    shutil.copytree(views_folder, os.fsdecode(views))
    quick = ["--billboards", "1", "--placement", "even", "--steps", "2", "--levels", "1"]
    code, said, err = said_by([b"fit", views, b"--out", out, *quick])
    assert code == 0, err
    assert rb"/o\xff[/b]: report.html" in said
    assert Path(os.fsdecode(out), "report.html").stat().st_size


@pytest.mark.parametrize(("host", "says"), [("nowhere.invalid", "nowhere.invalid"), ("a..b", "it is not a name")])
def test_hosts_are_refused_in_words(host: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from bbfit.checks import InputError
    from bbfit.viewing.address import listen
    from bbfit.workers.cluster import _check_address

    with pytest.raises(InputError, match="host: ") as refused:
        listen(host, 0, lambda address, family: None)
    assert says in str(refused.value) and "[Errno" not in str(refused.value)
    with pytest.raises(InputError, match="ray: no cluster answers at") as refused:
        _check_address(f"{host}:6379")
    assert "[Errno" not in str(refused.value)
    with pytest.raises(InputError, match="it is not an address"):
        _check_address("127.0.0.1:" + "9" * 30)


def test_without_a_home_the_variable_for_kernels_is_named(tmp_path: Path, views_folder: Path) -> None:
    (tmp_path / "home").write_text("a file")
    words = ["fit", str(views_folder), "--out", str(tmp_path / "out"), "--steps", "2", "--billboards", "1", "--placement", "even"]
    environment = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home" / "cache"), "PYTHONWARNINGS": ""}
    environment = {**os.environ, **environment}
    environment.pop("WARP_CACHE_PATH", None)
    done = subprocess.run([*BBFIT, *words], capture_output=True, text=True, env=environment)
    assert done.returncode == 2
    assert "WARP_CACHE_PATH" in done.stderr.splitlines()[-1] and "Traceback" not in done.stderr and "[Errno" not in done.stderr


def test_libraries_say_nothing_of_their_own(tmp_path: Path) -> None:
    """Unless the user asks for it."""
    code = """
import logging, sys, types, warnings
from bbfit.cli import main

def run(*arguments, **options):
    import cv2
    warnings.warn("a warning")
    logging.getLogger("trimesh").warning("another")
    cv2.imread("nowhere.png")
    raise SystemExit(7)

sys.modules["bbfit.pipeline"] = types.SimpleNamespace(RunConfig=dict, run=run)
sys.exit(main())
"""
    words = ["fit", str(DATA / "views"), "--out", str(tmp_path / "out")]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONWARNINGS", "OPENCV_LOG_LEVEL")}
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (7, "")
    asked = subprocess.run([sys.executable, "-W", "default", "-c", code, *words], capture_output=True, text=True, env=environment)
    assert "UserWarning: a warning" in asked.stderr
