"""``run.json``: which stage of a run was done with which inputs, what it wrote, how long it took."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from bbfit.checks import InputError
from bbfit.files import read_json, write_json

RECORD_FILE = "run.json"
"""The record's name in a run's folder."""
STAGE_VERSIONS = {"grow": 1, "budget": 3, "fit": 8, "export": 3, "evaluate": 7, "report": 1}
"""Raise a stage's number when its results change for the same inputs, so that old results are made anew."""
_PACKAGES = ("bbfit", "torch", "kornia", "numpy", "opencv-contrib-python-headless", "bpy", "trimesh", "xatlas", "scikit-image", "warp-lang")


def record_head(source: str, config: Mapping[str, Any], seeds: Mapping[str, int]) -> dict[str, Any]:
    """What is told of a run besides its stages: its source, its resolved configuration, its seeds, the versions and the machine."""
    return {
        "source": source,
        "config": plain(config),
        "seeds": dict(seeds),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "machine": platform.platform(),
    }


class Record:
    """The record of one run, kept on disk after every stage."""

    def __init__(self, folder: Path, head: dict[str, Any]) -> None:
        """Take up what ``folder`` holds; ``head`` is what is told of the run besides its stages, such as its resolved configuration."""
        self.folder, self.head, self.skipped = folder, head, list[str]()
        path = folder / RECORD_FILE
        try:
            earlier = read_json("run", path) if path.is_file() else {}
        except InputError:
            earlier = {}  # a damaged record only costs the skipping
        stages = earlier.get("stages") if isinstance(earlier, dict) else None
        self.stages = {name: stage for name, stage in stages.items() if _is_stage(stage)} if isinstance(stages, dict) else {}

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of the stages done so far."""
        return {name: stage["seconds"] for name, stage in self.stages.items()}

    def stands(self, stage: str, inputs: str) -> bool:
        """Whether a stage was done with these inputs and nobody touched what it wrote."""
        done = self.stages.get(stage)
        if done is None or done["inputs"] != inputs:
            return False
        if any(hash_file(self.folder / name) != digest for name, digest in done["outputs"].items()):
            return False
        self.skipped.append(stage)
        return True

    def done(self, stage: str, inputs: str, outputs: list[str], seconds: float) -> None:
        """Note a finished stage."""
        hashes = {name: hash_file(self.folder / name) for name in outputs}
        self.stages[stage] = {"inputs": inputs, "outputs": hashes, "seconds": round(seconds, 3)}
        write_json(self.folder / RECORD_FILE, self.head | {"stages": self.stages})


def _is_stage(entry: Any) -> bool:
    """Whether an entry of ``run.json`` is whole."""
    kinds = {"inputs": str, "outputs": dict, "seconds": int | float}
    return isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())


def plain(value: Any) -> Any:
    """A configuration as JSON holds it, paths as text."""
    return json.loads(json.dumps(value, default=str))


def hash_inputs(stage: str, *inputs: Any) -> str:
    """SHA-256 over what a stage's results depend on: the inputs, and the version of the stage that makes them."""
    return sha256(json.dumps([stage, STAGE_VERSIONS[stage], *inputs], sort_keys=True, default=str).encode()).hexdigest()


def hash_file(path: Path) -> str | None:
    """SHA-256 of a file, ``None`` if there is none."""
    return sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
