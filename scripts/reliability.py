"""Kill bbfit, take its disk away, and compare what it makes then: python scripts/reliability.py [--kills N] [--seed N] [--only NAME ...]

It prints the table of docs/reliability.md and ends with exit code 1 if a row fails. The rows by name:

run, lod, sweep, compare, watch  the command is killed (SIGKILL) at random moments and started again, until it was killed ``--kills`` times.
          Each time that it ends, its folder is compared with that of a run that nobody disturbed: same files with the same bytes, except
          for seconds, dates and what contains them. Nothing may stay behind: processes, locks, temporary files and folders. ``watch`` is
          ``run`` with ``--watch``
deleted   the output folder is deleted while bbfit renders and while it fits
full      the folder of temporary files (TMPDIR) is full, then the disk of the output folder
shm       there is no /dev/shm
counts    64 and 200 billboards, and folders with one and two training views

Rows that need another file system use a mount namespace (``unshare``), and are skipped with a remark where that is not allowed.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TREE, VIEWS = ROOT / "data" / "tree.glb", ROOT / "data" / "views"
BBFIT = [sys.executable, "-m", "bbfit.cli"]
SMALL = ["--count", "6", "--size", "48", "--samples", "1", "--render-workers", "1"]
QUICK = ["--restarts", "1", "--candidates", "1", "--refinement-rounds", "0"]
FIT = ["--steps", "60", "--restarts", "1", "--refinement-rounds", "1"]
# Texts and pictures that contain seconds or dates.
TIMED = {"run.json", ".bbfit.json", "report.html", "table.png", "quality.png", "compare.md", "table.md"}
SECONDS = {"seconds", "where", "seconds_per_step", "fit_seconds"}


@dataclass
class Row:
    """A row of the table."""

    name: str
    tried: str
    result: str
    failures: list[str] = field(default_factory=list)


class Scratch:
    """A folder with the folders of commands, and a TMPDIR of its own, in which nothing may stay behind."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.temporary = folder, folder / "tmp"
        self.temporary.mkdir()

    def start(self, arguments: list[str], before: list[str] | None = None, **environment: str) -> subprocess.Popen[str]:
        """Start a command of bbfit in a session of its own."""
        variables = os.environ | {"TMPDIR": str(self.temporary), "PYTHONPATH": str(ROOT), "COLUMNS": "200"} | environment
        pipes: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([*(before or []), *BBFIT, *arguments], env=variables, cwd=self.folder, start_new_session=True, **pipes)

    def finish(self, arguments: list[str], before: list[str] | None = None, **environment: str) -> tuple[int, str]:
        """Run a command to its end; the exit code and standard error."""
        process = self.start(arguments, before, **environment)
        return (process.returncode, errors) if (errors := process.communicate()[1]) is not None else (1, "")


def contents(folder: Path) -> dict[str, str]:
    """A digest of each file in a folder, without seconds and dates."""
    return {path.relative_to(folder).as_posix(): digest(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def digest(path: Path) -> str:
    if path.name in TIMED:
        return "present"
    data = path.read_bytes()
    if path.suffix == ".json":
        data = json.dumps(_timeless(json.loads(data)), sort_keys=True).encode()
    elif path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(data.decode())))
        data = json.dumps([{name: value for name, value in row.items() if "seconds" not in name} for row in rows]).encode()
    return sha256(data).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _timeless(each) for name, each in value.items() if name not in SECONDS}
    return [_timeless(each) for each in value] if isinstance(value, list) else value


def left_behind(scratch: Scratch) -> list[str]:
    """Processes of killed commands, temporary folders, locks and parts of files."""
    found = [f"temporary {path.name}" for path in scratch.temporary.iterdir()]
    found += [path.name for path in scratch.folder.rglob(".bbfit*") if path.suffix in (".part", ".lock")]
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if str(scratch.temporary).encode() in (process / "environ").read_bytes():
                found.append(f"process {process.name}")
        except OSError:
            pass
    return found


def kills(name: str, arguments: Callable[[Path], list[str]], scratch: Scratch, count: int, chance: random.Random) -> Row:
    """Kill a command at random moments, and compare its results with those of an undisturbed run."""
    undisturbed = scratch.folder / name / "undisturbed"
    undisturbed.mkdir(parents=True)
    began = time.monotonic()
    code, errors = scratch.finish(arguments(undisturbed))
    seconds = time.monotonic() - began
    expected = contents(undisturbed)
    row = Row(name, "", "", [f"undisturbed: exit code {code}: {errors[-300:]}"] if code else [])
    killed = finished = 0
    folder, attempts = scratch.folder / name / "1", 0
    while (killed < count or attempts) and not row.failures:
        folder.mkdir(exist_ok=True)
        process = scratch.start(arguments(folder))
        try:
            errors = process.communicate(timeout=chance.uniform(0.0, seconds) if killed < count else None)[1]
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            killed, attempts = killed + 1, attempts + 1
            continue
        if process.returncode:
            row.failures.append(f"after {attempts} kills: exit code {process.returncode}: {errors[-300:]}")
        got = contents(folder)
        differing = [path for path in sorted(expected.keys() | got.keys()) if expected.get(path) != got.get(path)]
        row.failures += [f"{path} differs after {attempts} kills" for path in differing]
        row.failures += [f"left behind: {each}" for each in _patiently(lambda: left_behind(scratch))]
        finished, attempts = finished + 1, 0
        folder = scratch.folder / name / str(finished + 1)
    row.tried = f"{killed} kills in {finished} runs of {seconds:.0f} s"
    row.result = f"the same {len(expected)} files" if not row.failures else row.failures[0]
    return row


def _patiently(problems: Callable[[], list[str]]) -> list[str]:
    """The problems that have not gone after some seconds, in which the children of a killed process end."""
    until = time.monotonic() + 20
    while (found := problems()) and time.monotonic() < until:
        time.sleep(0.2)
    return found


def refusal(code: int, errors: str) -> list[str]:
    """What is wrong with a refusal: it has to be one line and exit code 2."""
    lines = [line for line in errors.splitlines() if line.startswith("bbfit:")]
    wrong = [f"exit code {code}"] if code != 2 else []
    wrong += ["a traceback"] if "Traceback" in errors else []
    return wrong + ([f"{len(lines)} lines of reason"] if len(lines) != 1 else [])


def deleted(scratch: Scratch) -> Iterator[Row]:
    """Delete the output folder while bbfit works in it."""
    moments = {"rendering": "views/images/0000.png", "fitting": "fit.checkpoint"}
    for moment, file in moments.items():
        out = scratch.folder / f"deleted while {moment}"
        process = scratch.start(["run", str(TREE), "--out", str(out), *SMALL, "--steps", "2000"])
        while process.poll() is None and not (out / file).exists():
            time.sleep(0.02)
        shutil.rmtree(out, ignore_errors=True)
        errors = process.communicate()[1]
        wrong = refusal(process.returncode, errors)
        said = next((line for line in errors.splitlines() if line.startswith("bbfit:")), "nothing")
        yield Row("deleted", f"output folder deleted while {moment}", "one line" if not wrong else said, wrong)


def mounted(command: str) -> list[str]:
    """The start of a command line that first changes the mounts, for the command alone."""
    return ["unshare", "-m", "sh", "-c", f'{command} && exec "$@"', "sh"]


def full(scratch: Scratch) -> Iterator[Row]:
    """Fill the folder of temporary files, then the disk of the output folder."""
    out, small = scratch.folder / "full", scratch.folder / "small disk"
    small.mkdir()
    arguments = ["run", str(TREE), *SMALL, *FIT, "--out"]
    for what, folder, path in (("TMPDIR", scratch.temporary, out), ("the disk of the output folder", small, small / "out")):
        before = mounted(f"mount -t tmpfs -o size=64k none '{folder}' && dd if=/dev/zero of='{folder}/filler' bs=1k count=48 2>/dev/null")
        code, errors = scratch.finish([*arguments, str(path)], before)
        wrong = [] if code == 0 else refusal(code, errors)
        yield Row("full", f"{what} is full", "finished" if code == 0 else "one line" if not wrong else errors[-200:], wrong)
    code, errors = scratch.finish([*arguments, str(out)])
    yield Row("full", "the same command with room", "finished" if code == 0 else errors[-200:], [] if code == 0 else ["failed"])


def shm(scratch: Scratch) -> Iterator[Row]:
    """Work without shared memory."""
    without = mounted("mount -t tmpfs -o ro,size=4k none /dev/shm")
    for command in (["run", str(TREE), *SMALL, *FIT], ["sweep", "--trees", str(TREE), "--grid", "default", *SMALL, *FIT]):
        code, errors = scratch.finish([*command, "--out", str(scratch.folder / f"{command[0]} without shm")], without)
        yield Row(
            "shm", f"{command[0]} without /dev/shm", "finished" if code == 0 else errors[-200:], [] if code == 0 else [f"exit code {code}"]
        )


def counts(scratch: Scratch) -> Iterator[Row]:
    """Many billboards, and few views."""
    for number in (64, 200):
        out = scratch.folder / f"{number} billboards"
        code, errors = scratch.finish(["fit", str(VIEWS), "--out", str(out), "--billboards", str(number), "--steps", "40", *QUICK])
        good = code == 0 and (out / "model.glb").stat().st_size > 0
        yield Row("counts", f"{number} billboards", "finished" if good else errors[-200:], [] if good else [f"exit code {code}"])
    for number in (2, 3):
        out = scratch.folder / f"{number} views"
        code, errors = scratch.finish(["run", str(TREE), "--out", str(out), *SMALL, *FIT, "--count", str(number)])
        wrong = [] if code == 0 else refusal(code, errors)
        result = "finished" if code == 0 else next((line for line in errors.splitlines() if line.startswith("bbfit:")), errors[-200:])
        yield Row("counts", f"{number - 1} of {number} views for training", result, wrong)


def commands() -> dict[str, Callable[[Path], list[str]]]:
    """The commands that are killed, by the row's name."""
    grid = ["--grid", "thesis", "--billboards", "2", "--loss", "l1", "--variants", "base", "bounded", "--workers", "2"]
    systems = ["--systems", "bbfit", "crossed", "cloud", "--billboards", "3"]
    return {
        "run": lambda folder: ["run", str(TREE), "--out", str(folder / "out"), *SMALL, *FIT],
        "watch": lambda folder: ["run", str(TREE), "--out", str(folder / "out"), *SMALL, *FIT, "--watch", "--port", "0"],
        "lod": lambda folder: ["lod", str(TREE), "--out", str(folder / "lod.glb"), "--planes", "4", "2", *SMALL, *FIT],
        "sweep": lambda folder: ["sweep", "--trees", str(TREE), "--out", str(folder / "out"), *grid, *SMALL, "--steps", "60"],
        "compare": lambda folder: ["compare", str(TREE), "--out", str(folder / "out"), *systems, *SMALL, *FIT],
    }


def main() -> int:
    """Run the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[])
    options = parser.parse_args()
    chance, failed = random.Random(options.seed), False
    others: dict[str, Callable[[Scratch], Iterator[Row]]] = {"deleted": deleted, "full": full, "shm": shm, "counts": counts}
    print("| row | what happened | result |\n| --- | --- | --- |", flush=True)
    for name in [*commands(), *others]:
        if options.only and name not in options.only:
            continue
        with tempfile.TemporaryDirectory(prefix="reliability-") as folder:
            scratch = Scratch(Path(folder))
            if name in ("full", "shm") and subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
                rows = iter([Row(name, "a file system that is full or missing", "skipped: this process may not change its mounts")])
            elif name not in others:
                rows = iter([kills(name, commands()[name], scratch, options.kills, chance)])
            else:
                rows = others[name](scratch)
            for row in rows:
                result = f"FAILED: {'; '.join(row.failures)}; {row.result}" if row.failures else row.result
                print(f"| {row.name} | {row.tried} | {' '.join(result.split())} |", flush=True)
                failed |= bool(row.failures)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
