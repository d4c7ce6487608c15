"""A stage of a long computation as a value, and the record of a folder, which skips stages whose results are current."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bbfit.checks import InputError, check_record
from bbfit.files import read_json, write_json
from bbfit.outputs import Written
from bbfit.provenance import cache_key, digest_file, installed_version

RECORD_FILE = "run.json"
"""The name of the record in a folder."""
_KINDS: dict[str, Any] = {"inputs": str, "outputs": dict[str, str], "seconds": float}
_PACKAGES = ("bbfit", "torch", "kornia", "numpy", "opencv-contrib-python-headless", "bpy", "trimesh", "xatlas", "scikit-image", "warp-lang")


class OnProgress(Protocol):
    """A callback for the progress of a long computation."""

    def __call__(self, stage: str, done: int, total: int, note: str = "", /) -> None:
        """Report that ``done`` of ``total`` units of ``stage`` are finished. ``note`` is a short text such as the loss."""


def silent(stage: str, done: int, total: int, note: str = "") -> None:
    """An :class:`OnProgress` that reports nothing."""


@dataclass(frozen=True)
class Stage:
    """A computation with a name, all inputs that its results depend on, and the files that it writes to its folder."""

    name: str
    """The name, unique in the folder."""
    inputs: tuple[Any, ...]
    """Everything that the results depend on: configurations, digests, and other values with an :func:`~bbfit.provenance.identity`."""
    outputs: tuple[str, ...]
    """The files that ``work`` writes, relative to the folder. ``*`` matches any characters, for files whose number is not known."""
    work: Callable[[OnProgress], float | None]
    """Writes the outputs. May return the seconds of all attempts. Otherwise the record measures this one."""
    algorithm: str | None = None
    """The name in :data:`~bbfit.provenance.VERSIONS` of the algorithm. ``None`` is the name of the stage."""
    temporary: tuple[str, ...] = ()
    """Files that ``work`` keeps in the folder to continue from. They are removed once the stage is recorded."""
    claims: bool = True
    """Whether the record protects files of the user under the names of the outputs. ``False`` if ``work`` does so itself."""

    @property
    def key(self) -> str:
        """The cache key of the results. Raises the errors of :func:`~bbfit.provenance.identity`."""
        return cache_key(self.algorithm or self.name, *self.inputs)


class Record:
    """The finished stages of a folder, with their inputs, outputs and seconds. They are stored in ``run.json``."""

    def __init__(self, folder: Path, head: Mapping[str, Any] | None = None, inputs: Iterable[Path | None] = ()) -> None:
        """Read the record of ``folder``, if it exists.

        ``head`` contains the other fields of the record (:func:`record_head`), by default those that it has. ``inputs`` are files that no
        stage may replace.
        """
        self.folder, self.skipped, self._inputs = folder, list[str](), tuple(filter(None, inputs))
        path = folder / RECORD_FILE
        try:
            earlier = read_json("run", path) if path.is_file() else {}
        except InputError:
            earlier = {}  # without a record, the stages are repeated
        self.stages, self._stored = recorded_stages(earlier), _head_of(earlier)
        self.head = dict(self._stored if head is None else head)
        self._written = Written(folder)
        for name, entry in self.stages.items():
            self._written.adopt(name, entry["outputs"])
        if self.stages:
            self._written.adopt(RECORD_FILE, self._written.digests((RECORD_FILE,)))

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of each recorded stage."""
        return {name: entry["seconds"] for name, entry in self.stages.items()}

    def is_current(self, stage: Stage) -> bool:
        """Whether the stage was finished with the same inputs, and its output files have not changed since."""
        return self._is_current(stage, stage.key)

    def _is_current(self, stage: Stage, key: str) -> bool:
        entry = self.stages.get(stage.name)
        if entry is None or entry["inputs"] != key or not {name for name in stage.outputs if "*" not in name} <= entry["outputs"].keys():
            return False
        return all((file := self.folder / path).is_file() and digest_file(file) == digest for path, digest in entry["outputs"].items())

    def check(self, outputs: Mapping[str, tuple[str, ...]]) -> None:
        """Require that stages can write their outputs, given by the stage's name: that no file of the user and no input has such a name.

        Raises ``InputError`` with the file. :meth:`run` checks it too, but only after the work of earlier stages.
        """
        for name, files in {RECORD_FILE: (RECORD_FILE,), **outputs}.items():
            self._written.check(name, files, self._inputs)

    def run(self, stage: Stage, on_progress: OnProgress = silent) -> bool:
        """Run a stage and record it, or skip it if its results are current. Returns whether the stage was run.

        An output that has changed since it was recorded is kept under another name. Raises ``InputError`` if an output would replace a
        file of the user or an input, and ``InputError`` or ``OSError`` if the work does. The record then stays as it was.
        """
        key = stage.key  # before the work, during which an input file may change
        if self._is_current(stage, key):
            self.skipped.append(stage.name)
            return False
        names = (*stage.outputs, *stage.temporary) if stage.claims else ()
        self._written.begin(stage.name, names, self._inputs)
        started = time.perf_counter()
        try:
            seconds = stage.work(on_progress)
        except BaseException:
            self._written.abandon(stage.name, names)
            raise
        elapsed = time.perf_counter() - started if seconds is None else seconds
        digests = self._written.digests(stage.outputs)
        self.stages[stage.name] = {"inputs": key, "outputs": digests, "seconds": round(elapsed, 3)}
        self._write()
        for name in stage.temporary:
            (self.folder / name).unlink(missing_ok=True)
        self._written.finish(stage.name, digests)
        return True

    def finish(self) -> None:
        """Write the record if its other fields have changed since its last stage, which may have been skipped."""
        if self.head != self._stored:
            self._write()

    def _write(self) -> None:
        self._written.begin(RECORD_FILE, (RECORD_FILE,), self._inputs)
        write_json(self.folder / RECORD_FILE, self.head | {"stages": self.stages})
        self._stored = _head_of(read_json("run", self.folder / RECORD_FILE))
        self._written.finish(RECORD_FILE, self._written.digests((RECORD_FILE,)))


def record_head(source: str, config: Mapping[str, Any], seeds: Mapping[str, int]) -> dict[str, Any]:
    """The fields of a record besides its stages: source, resolved configuration as JSON, seeds, versions of packages, and the machine."""
    versions = {"python": platform.python_version()} | {name: installed_version(name) for name in _PACKAGES}
    return {"source": source, "config": dict(config), "seeds": dict(seeds), "versions": versions, "machine": platform.platform()}


def recorded_stages(record: Any) -> dict[str, dict[str, Any]]:
    """The stages in the contents of a ``run.json``, which may be anything, with their ``inputs``, ``outputs`` and ``seconds``."""
    stages = record.get("stages") if isinstance(record, dict) else None
    return {name: _entry(stage) for name, stage in stages.items() if _is_entry(stage)} if isinstance(stages, dict) else {}


def _head_of(record: Any) -> dict[str, Any]:
    """The fields besides the stages in the contents of a ``run.json``."""
    return {name: value for name, value in record.items() if name != "stages"} if isinstance(record, dict) else {}


def _is_entry(entry: Any) -> bool:
    try:
        check_record("stage", entry, dict)
        for name, kind in _KINDS.items():
            check_record(name, entry.get(name), kind)
    except TypeError:
        return False
    return True


def _entry(entry: dict[str, Any]) -> dict[str, Any]:
    return {name: entry[name] for name in _KINDS}
