"""Work for tests that other processes can import: it tells that it began, and ends well or not."""

from __future__ import annotations

import os
import signal
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def begun(marks: Path) -> list[str]:
    """Names of all tasks that began, as often as they did."""
    return sorted(path.name.partition(" ")[0] for path in marks.glob("* *"))


def mark(marks: str, name: str) -> None:
    Path(marks, f"{name} {uuid.uuid4()}").touch()


def copy(inputs: Mapping[str, Path], folder: Path, marks: str, name: str, gate: str = "") -> dict[str, Any]:
    """Put together what the inputs hold, when the file ``gate`` is there."""
    mark(marks, name)
    while gate and not Path(gate).exists():
        time.sleep(0.02)
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
