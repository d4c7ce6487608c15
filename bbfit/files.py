"""Write files atomically: under a temporary name in the same folder, then renamed. A file is complete or does not change."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bbfit.checks import fail
from bbfit.inputs import parse_json, reading

if TYPE_CHECKING:  # importing torch would delay commands that do not need it
    from torch import Tensor

PREFIX, PART = ".bbfit-", ".part"
"""How the names of temporary files start and end."""
_LARGEST_JSON = 1 << 28


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically. If this fails, an existing file stays as it was, and the temporary file is removed.

    Raises ``InputError`` if the disk is full, or the folder is missing or not writable.
    """
    write_pieces(path, (data,))


def write_pieces(path: str | Path, pieces: Iterable[bytes]) -> None:
    """Write a file piece by piece, so that it need not fit in memory. Otherwise as :func:`write_bytes`, with the same errors."""
    path = Path(path)
    try:
        _replace(path, pieces)
    except OSError as error:
        fail("out", f"{path} cannot be written ({error.strerror})", "free the disk or choose another place, then start again")


def _replace(path: Path, pieces: Iterable[bytes]) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=PREFIX, suffix=PART)
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
    """Write ``value`` as indented JSON atomically, with the errors of :func:`write_bytes`. NaN and infinity raise ``ValueError``."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(name: str, path: Path) -> Any:
    """Read a JSON file. If it is not valid or too large, the message of the ``InputError`` calls the input ``name``."""
    hint = "remove the file or restore it"
    if path.exists() and not path.is_file():
        fail(name, f"{path} is not a file", hint)
    with reading(name, path, hint):
        if (size := path.stat().st_size) > _LARGEST_JSON:
            fail(name, f"{path} has {size:,} bytes, more than {_LARGEST_JSON:,}", hint)
        return parse_json(name, path, path.read_bytes(), hint)


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file atomically, with the errors of :func:`write_bytes`."""
    from safetensors.torch import save

    write_bytes(path, save(dict(tensors), dict(metadata)))


def remove_parts(folder: Path) -> None:
    """Remove the temporary files of killed processes from a folder to which no other process writes."""
    for temporary in folder.glob(f"{PREFIX}*{PART}"):
        with contextlib.suppress(OSError):
            temporary.unlink()
