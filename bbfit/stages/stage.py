"""A stage of long work as a value, and the record of a folder, which skips a stage whose results are current."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

from bbfit.checks import InputError
from bbfit.files import read_json, write_json
from bbfit.provenance import cache_key, digest_file

RECORD_FILE = "run.json"
"""The name of the record in a folder."""
_PACKAGES = ("bbfit", "torch", "kornia", "numpy", "opencv-contrib-python-headless", "bpy", "trimesh", "xatlas", "scikit-image", "warp-lang")


class OnProgress(Protocol):
    """A callback for the progress of long work."""

    def __call__(self, stage: str, done: int, total: int, note: str = "", /) -> None:
        """``done`` of ``total`` units of ``stage`` are finished; ``note`` is a short text such as the loss."""


def silent(stage: str, done: int, total: int, note: str = "") -> None:
    """An :class:`OnProgress` that reports nothing."""


@dataclass(frozen=True)
class Stage:
    """A piece of work with a name, all inputs that its results depend on, and the files that it writes into its folder."""

    name: str
    """Unique in its folder."""
    inputs: tuple[Any, ...]
    """Whatever the results depend on: configurations, digests, and other values that have an :func:`~bbfit.provenance.identity`."""
    outputs: tuple[str, ...]
    """Files that the work writes, relative to the folder. ``*`` stands for any characters where their number is not known before."""
    work: Callable[[OnProgress], float | None]
    """Writes the outputs. Returns the seconds that it took, if earlier attempts count too."""
    algorithm: str | None = None
    """The entry of :data:`~bbfit.provenance.VERSIONS` that the results depend on. ``None``: the entry called like the stage."""

    @property
    def key(self) -> str:
        """The identity of the results."""
        return cache_key(self.algorithm or self.name, *self.inputs)


class Record:
    """The stages that were done in a folder: with which inputs, which files they wrote, and how long they took. Kept in ``run.json``."""

    def __init__(self, folder: Path, head: Mapping[str, Any] | None = None) -> None:
        """Read the record of ``folder``, if there is one. ``head`` holds what is recorded besides the stages (:func:`record_head`)."""
        self.folder, self.head, self.skipped = folder, dict(head or {}), list[str]()
        path = folder / RECORD_FILE
        try:
            earlier = read_json("run", path) if path.is_file() else {}
        except InputError:
            earlier = {}  # a damaged record costs only the skipping
        stages = earlier.get("stages") if isinstance(earlier, dict) else None
        self.stages = {name: stage for name, stage in stages.items() if _is_entry(stage)} if isinstance(stages, dict) else {}

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of each recorded stage."""
        return {name: entry["seconds"] for name, entry in self.stages.items()}

    def is_current(self, stage: Stage) -> bool:
        """Whether the stage was done with the same inputs and nobody has changed the files that it wrote since."""
        entry = self.stages.get(stage.name)
        if entry is None or entry["inputs"] != stage.key:
            return False
        files = {name: self.folder / name for name in entry["outputs"]}
        return all(file.is_file() and digest_file(file) == entry["outputs"][name] for name, file in files.items())

    def run(self, stage: Stage, on_progress: OnProgress = silent) -> bool:
        """Do the work of a stage and record it, unless its results are current. Returns whether the work was done."""
        if self.is_current(stage):
            self.skipped.append(stage.name)
            return False
        begun = time.perf_counter()
        seconds = stage.work(on_progress)
        matches = {name: sorted(self.folder.glob(name)) if "*" in name else [self.folder / name] for name in stage.outputs}
        paths = list(chain.from_iterable(matches.values()))
        digests = {Path(os.path.relpath(path, self.folder)).as_posix(): digest_file(path) for path in paths}
        elapsed = time.perf_counter() - begun if seconds is None else seconds
        self.stages[stage.name] = {"inputs": stage.key, "outputs": digests, "seconds": round(elapsed, 3)}
        write_json(self.folder / RECORD_FILE, self.head | {"stages": self.stages})
        return True


def record_head(source: str, config: Mapping[str, Any], seeds: Mapping[str, int]) -> dict[str, Any]:
    """The part of a record besides its stages: source, resolved configuration as JSON, seeds, versions of packages, and the machine."""
    versions = {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}
    return {"source": source, "config": dict(config), "seeds": dict(seeds), "versions": versions, "machine": platform.platform()}


def _is_entry(entry: Any) -> bool:
    kinds = {"inputs": str, "outputs": dict, "seconds": int | float}
    return isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
