"""Cache keys: the version of an algorithm, the options that affect its result, and the contents of its inputs.

A stored result is current if its cache key is that of the requested result. All code in bbfit that stores results (runs, checkpoints,
trials of a budget, sweeps, comparisons, levels of detail, views) compares keys from :func:`cache_key` and digests from this module.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from bbfit.checks import check_file

VERSIONS: Mapping[str, int] = {
    "grow": 2,
    "convert": 4,
    "views": 8,
    "budget": 18,
    "fit": 27,
    "export": 20,
    "evaluate": 20,
    "report": 14,
    "lod": 16,
    "compare": 14,
    "frames": 3,
    "library": 9,
    "forest": 4,
}
"""Version of each algorithm. Increase it when the result for the same inputs changes, so that stored results are computed again."""
EXECUTION = {"affects_result": False}
"""Metadata of a dataclass field that affects the computation but not its result. :func:`identity` omits such fields."""


def identity(value: Any) -> Any:
    """Convert a value to JSON that is the same for two values exactly if both lead to the same result.

    The value is a dataclass, mapping, list, tuple, path, number, string, boolean or ``None``, nested to any depth; any other type raises
    ``TypeError``. Dataclasses become mappings of their fields, except the fields with the metadata :data:`EXECUTION`. A path becomes the
    name and the digest of its file, which must exist and not be empty (``MissingFileError``, ``InputError``). Floating-point numbers
    without a fraction become integers, so that 0 and 0.0 are the same.
    """
    if is_dataclass(value) and not isinstance(value, type):
        included = [entry for entry in fields(value) if entry.metadata.get("affects_result", True)]
        return {entry.name: identity(getattr(value, entry.name)) for entry in included}
    if isinstance(value, Mapping):
        return {str(key): identity(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [identity(entry) for entry in value]
    if isinstance(value, Path):
        return {"name": value.name, "sha256": digest_file(check_file("file", value))}
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{value!r} has no identity")


def cache_key(algorithm: str, *inputs: Any) -> str:
    """The key of the result of an algorithm in :data:`VERSIONS` for all inputs that it depends on.

    It is the SHA-256 over the algorithm's name and version and the :func:`identity` of the inputs, as 64 hexadecimal digits. The errors of
    :func:`identity` are raised.
    """
    return sha256(json.dumps([algorithm, VERSIONS[algorithm], identity(inputs)], sort_keys=True).encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of the contents of a file, as 64 hexadecimal digits. Raises ``FileNotFoundError`` if the file does not exist."""
    digest = sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def digest_files(files: Iterable[Path], folder: Path) -> str:
    """SHA-256 over the contents of files and their paths relative to ``folder``. A single file has the digest of its contents alone."""
    digests = [(Path(os.path.relpath(file, folder)).as_posix(), digest_file(file)) for file in files]
    return digests[0][1] if len(digests) == 1 else sha256(json.dumps(digests).encode()).hexdigest()


def installed_version(package: str) -> str | None:
    """The version of an installed package, or ``None`` if it is not installed, such as bbfit in a source folder."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
