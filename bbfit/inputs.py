"""The border to files that are read: how large inputs may be, which files they may refer to, and what happens if a reader fails."""

from __future__ import annotations

import codecs
import contextlib
import json
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bbfit.checks import Count, InputError, check_fields, check_folder, fail

SMALLEST, LARGEST = 1e-4, 1e6
"""Range of the size of a tree in meters. ``LARGEST`` also limits the distance of everything from the origin along each axis."""
_LONGEST_REASON = 200
_MOST_VALUES = 10_000_000  # of a JSON text; each takes up to a hundred bytes in memory
_HINTS = {"tree": "export the tree as one .glb file, or ", "views": "copy the pictures into the folder of the views, or "}
_ALLOW = "allow the other folder with --allow-folders"


@dataclass(frozen=True)
class InputLimits:
    """What inputs may be. Nothing that is read is trusted: inputs beyond these limits are refused before they take up memory or time."""

    allow_folders: tuple[Path, ...] = ()
    """Further folders with files that a tree or views may refer to. Default: only the folder of the tree or the views, and those in it."""
    max_input_bytes: Count = 1 << 32
    """Most bytes of a tree's files together."""
    max_input_vertices: Count = 30_000_000
    """Most vertices of a tree, counting those of every instance."""
    max_input_nodes: Count = 100_000
    """Most objects (nodes) of a tree."""
    max_input_pixels: Count = 1 << 26
    """Most pixels of a picture, which is a view or a tree's texture: 8192 x 8192."""
    max_input_frames: Count = 10_000
    """Most views that a folder of views may list."""

    def __post_init__(self) -> None:
        check_fields(self)

    def check(self) -> None:
        """Require that the allowed folders exist."""
        for folder in self.allow_folders:
            check_folder("allow_folders", folder)

    def at_most(self, option: str, name: str, path: str | Path, amount: int, unit: str) -> None:
        """Refuse an input ``name`` of ``path`` with more than the limit ``option`` (the name of a field) of ``unit``."""
        limit = getattr(self, option)
        if amount > limit:
            fail(name, f"{path} has {amount:,} {unit}, more than the limit of {limit:,}", f"--{option.replace('_', '-')} raises it")

    def admits(self, path: Path, folder: Path) -> bool:
        """Whether ``path``, with all symbolic links resolved, lies in ``folder``, in an allowed folder, or below one of them."""
        target = Path(os.path.realpath(path))
        return any(target.is_relative_to(os.path.realpath(root)) for root in (folder, *self.allow_folders))

    def referenced(self, name: str, source: Path, reference: str, folder: Path) -> Path:
        """The path of a file that the input ``name`` in ``source`` refers to as ``reference``, relative to the folder of ``source``.

        The file need not exist. It is not opened. Raises ``InputError`` if the path lies outside ``folder`` and the allowed folders (also
        by symbolic links), or is a device, a pipe or a socket.
        """
        with reading(name, source, "export it again"):
            path = source.parent / reference
            admitted = self.admits(path, folder)
            kind = path.stat().st_mode if path.exists() else None
        if not admitted:
            fail(name, f"{source} refers to {reference}, outside its own folder", _HINTS.get(name, "") + _ALLOW)
        if kind is not None and not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
            fail(name, f"{source} refers to {reference}, which is a device or a pipe", "replace it by a file")
        return path


@contextlib.contextmanager
def reading(name: str, path: str | Path, hint: str) -> Iterator[None]:
    """The boundary around a reader of a file: any failure of it becomes one ``InputError`` of one line.

    Libraries raise errors of all kinds for damaged files, and no list of them is complete. An ``InputError`` passes unchanged. The original
    error is its cause. ``name`` is what the file is for. ``hint`` says what to do.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{name}: {path} cannot be read ({_reason(error)}); {hint}") from error


def _reason(error: Exception) -> str:
    """Why a reader failed, in at most one line."""
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    text = f"{error} is missing" if isinstance(error, KeyError) else getattr(error, "strerror", None) or str(error)
    return " ".join(text.split())[:_LONGEST_REASON] or type(error).__name__


def parse_json(name: str, path: str | Path, data: bytes, hint: str, kind: str = "valid JSON") -> Any:
    """The value of a JSON text. If it is not ``kind``, the message of the ``InputError`` contains ``name``, ``path`` and ``hint``."""
    if sum(data.count(mark) for mark in (b",", b"[", b"{")) > _MOST_VALUES:
        fail(name, f"{path} has more than {_MOST_VALUES:,} values", hint)
    try:
        return json.loads(data.decode("utf-8-sig" if data.startswith(codecs.BOM_UTF8) else "utf-8"))
    except (ValueError, RecursionError) as error:  # very long numbers and very deep lists raise them too
        fail(name, f"{path} is not {kind} ({error})", hint)
