"""Writing files completely or not at all: everything goes to a temporary name in the same folder and is renamed into place."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bbfit.checks import fail

if TYPE_CHECKING:  # growing a tree need not wait for torch
    from torch import Tensor

PART = ".part"
"""Ending of the temporary names, which start with a dot."""


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically; on any failure the old file stays as it was.

    Raises
    ------
    InputError
        if the disk is full or the folder is missing or not writable; the partial file is removed.
    """
    write_pieces(path, (data,))


def write_pieces(path: str | Path, pieces: Iterable[bytes]) -> None:
    """Write a file as :func:`write_bytes` does, one piece after the other, so that it need not fit into memory."""
    path = Path(path)
    try:
        _replace(path, pieces)
    except OSError as error:
        fail("out", f"{path} cannot be written ({error.strerror})", "free the disk or choose another place, then start again")


def _replace(path: Path, pieces: Iterable[bytes]) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=PART)
    try:
        with os.fdopen(handle, "wb") as file:
            file.writelines(pieces)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON atomically; NaN and infinity are refused."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(name: str, path: Path) -> Any:
    """Read a JSON file, with an :class:`~bbfit.checks.InputError` that names it when it is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # also numbers too long and lists too deep to be read
        fail(name, f"{path} is not valid JSON ({error})", "remove the file or restore it")


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file atomically."""
    from safetensors.torch import save

    write_bytes(path, save(dict(tensors), dict(metadata)))


def output_folder(name: str, path: str | Path) -> Path:
    """Create an output folder if need be and require that it can be written to; return it as a ``Path``."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        fail(name, f"{path} is a file, not a folder", "choose another output folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        for leftover in path.glob(f".*{PART}"):  # of a process that was killed while it wrote
            leftover.unlink(missing_ok=True)
    except (FileExistsError, NotADirectoryError):
        fail(name, f"a part of {path} is a file, not a folder", "choose another output folder")
    except OSError as error:
        fail(name, f"{path} cannot be written to ({error.strerror})", "choose another output folder or free the disk")
    return path
