"""Work for tests that other processes can import: it reports that it began, waits at a gate, and ends well or not."""

from __future__ import annotations

import fcntl
import os
import signal
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bbfit.outputs import claimed_folder

_PIPE = "began"


@contextmanager
def watched(marks: Path) -> Iterator[Iterator[tuple[str, int]]]:
    """Name and process of each task that begins from now on; the iterator blocks until one does."""
    os.mkfifo(marks / _PIPE)
    with os.fdopen(os.open(marks / _PIPE, os.O_RDWR)) as pipe:
        yield ((name, int(process)) for name, process in map(str.split, iter(pipe.readline, "")))


@contextmanager
def closed(gate: Path) -> Iterator[None]:
    """Tasks wait at the gate within this block."""
    with gate.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def begun(marks: Path) -> list[str]:
    """Names of all tasks that began, as often as they did."""
    return sorted(path.name.partition(" ")[0] for path in marks.glob("* *"))


def mark(marks: str, name: str) -> None:
    Path(marks, f"{name} {uuid.uuid4()}").touch()
    if (pipe := Path(marks, _PIPE)).exists():
        with pipe.open("w") as file:
            file.write(f"{name} {os.getpid()}\n")


def copy(inputs: Mapping[str, Path], folder: Path, marks: str, name: str, gate: str = "") -> dict[str, Any]:
    """Put together what the inputs hold, once the gate is open."""
    mark(marks, name)
    if gate:
        with Path(gate).open() as file:
            fcntl.flock(file, fcntl.LOCK_SH)
    folder.mkdir(parents=True, exist_ok=True)
    texts = []
    for key in sorted(inputs):
        path = inputs[key]
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        texts += [f"{key} {file.name} {file.read_text()}" for file in files]
    (folder / "sub").mkdir(exist_ok=True)
    (folder / "sub" / "copy.txt").write_text("\n".join(texts))
    return {"name": name, "files": len(texts)}


def beside(inputs: Mapping[str, Path], folder: Path) -> dict[str, Any]:
    """What lies beside an input, as a glTF's buffers do."""
    return {"name": inputs["tree"].name, "beside": (inputs["tree"].parent / "more" / "part.bin").read_text()}


def claim(inputs: Mapping[str, Path], folder: Path) -> dict[str, Any]:
    """Work in the folder, as a run does, and refuse if another process does."""
    with claimed_folder("out", folder):
        return {"name": folder.name}


def fault(inputs: Mapping[str, Path], folder: Path) -> dict[str, Any]:
    raise ZeroDivisionError("a fault of ours")


def bad_input(inputs: Mapping[str, Path], folder: Path) -> dict[str, Any]:
    raise FileNotFoundError(2, "No such file", "leaf.png")


def die(inputs: Mapping[str, Path], folder: Path, marks: str, name: str, times: int) -> dict[str, Any]:
    """Kill its own process, the first few times."""
    mark(marks, name)
    if begun(Path(marks)).count(name) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"name": name}
