"""What makes a result current: the version of the algorithm that made it, the options that affect it, and the contents of its inputs.

Everything in bbfit that keeps results (runs, checkpoints, trials of a budget, sweeps, comparisons, levels of detail, views) compares keys
from :func:`cache_key` and digests from this module. No other module has rules of its own.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

VERSIONS: Mapping[str, int] = {
    "grow": 1,
    "convert": 1,
    "views": 1,
    "budget": 3,
    "fit": 8,
    "export": 3,
    "evaluate": 6,
    "report": 1,
    "lod": 1,
    "compare": 1,
}
"""Versions of the algorithms by name. Raise a number when the results for the same inputs change, so that old results are made again."""
EXECUTION = {"affects_result": False}
"""Metadata of a dataclass field that affects how a result is computed, and not what it is: :func:`identity` leaves the field out."""


def identity(value: Any) -> Any:
    """Reduce a value to the plain JSON that decides whether two results are the same.

    Dataclasses become mappings of their fields, without those that have the metadata :data:`EXECUTION`. Paths become the
    name and the digest of their file. Whole floating point numbers become integers, so that 0 and 0.0 are the same.

    Raises
    ------
    FileNotFoundError
        If a path has no file.
    TypeError
        If a value has no JSON form.
    """
    if is_dataclass(value) and not isinstance(value, type):
        kept = [entry for entry in fields(value) if entry.metadata.get("affects_result", True)]
        return {entry.name: identity(getattr(value, entry.name)) for entry in kept}
    if isinstance(value, Mapping):
        return {str(key): identity(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [identity(entry) for entry in value]
    if isinstance(value, Path):
        return {"name": value.name, "sha256": digest_file(value)}
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{value!r} has no identity")


def cache_key(algorithm: str, *inputs: Any) -> str:
    """SHA-256 over the name and version of an algorithm, as in :data:`VERSIONS`, and the identities of all of its inputs."""
    return sha256(json.dumps([algorithm, VERSIONS[algorithm], identity(inputs)], sort_keys=True).encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of the contents of a file, as hexadecimal digits.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    digest = sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def digest_files(files: Iterable[Path], folder: Path) -> str:
    """SHA-256 over the contents of files and their paths relative to ``folder``; the digest of a single file is that file's own."""
    digests = [(Path(os.path.relpath(file, folder)).as_posix(), digest_file(file)) for file in files]
    return digests[0][1] if len(digests) == 1 else sha256(json.dumps(digests).encode()).hexdigest()
