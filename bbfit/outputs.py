"""Output folders: one process at a time writes to a folder, and no file that bbfit did not write is replaced.

A folder that bbfit writes to has up to two hidden files. ``.bbfit.lock`` is locked by the process that works in the folder, and names it.
``.bbfit.json`` lists the files that bbfit wrote with their digests, and the work that was begun and not finished.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from bbfit.checks import InputError, fail
from bbfit.files import read_json, remove_parts, write_json
from bbfit.provenance import digest_file

LOCK_FILE, WRITTEN_FILE = ".bbfit.lock", ".bbfit.json"
_ASIDE = re.compile(r"\.changed\d*$")
_OTHER = "choose another output folder"
# Seconds to wait for a lock that other processes hold only for a moment.
_MOMENT = 30.0
_log = logging.getLogger(__name__)


def output_folder(name: str, path: str | Path) -> Path:
    """Create an output folder if it does not exist, and return it.

    If ``path`` or a part of it is a file, or the folder cannot be written to, this raises ``InputError`` with the option's ``name``.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        fail(name, f"{path} is a file, not a folder", _OTHER)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except (FileExistsError, NotADirectoryError):
        fail(name, f"a part of {path} is a file, not a folder", _OTHER)
    except OSError as error:
        fail(name, f"{path} cannot be written to ({error.strerror})", f"{_OTHER} or free the disk")
    return path


def check_room(folder: Path, needed: int) -> None:
    """Require that ``needed`` bytes are free on the disk of an existing output folder."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        fail("out", f"{folder} is on a disk with {free:,} free bytes, and {needed:,} may be needed", f"{_OTHER} or free the disk")


@contextlib.contextmanager
def used_folder(name: str, path: str | Path) -> Iterator[Path]:
    """Create an output folder as :func:`output_folder` does, for the work in this context.

    If the folder did not exist before, those of its folders and of the parents created for it that are empty at the end are removed.
    """
    path = Path(path)
    created = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield output_folder(name, path)
    finally:
        below = [Path(place) for place, _, _ in os.walk(path, topdown=False)][:-1] if created else []
        for folder in (*below, *created):  # the innermost first
            with contextlib.suppress(OSError):
                folder.rmdir()  # which fails if it is not empty


@contextlib.contextmanager
def claimed_folder(name: str, path: str | Path) -> Iterator[Path]:
    """A folder as of :func:`used_folder` to which no other process writes until the context ends.

    Temporary files of killed processes are removed. The operating system releases the lock of a killed process. Raises the errors of
    :func:`output_folder`, and ``InputError`` with the name of the other process if one works in the folder.
    """
    with used_folder(name, path) as folder, _lock(folder / LOCK_FILE, name, 0.0):
        remove_parts(folder)
        yield folder


def wait_until_free(folder: Path) -> None:
    """Wait until no process works in a folder that processes of a killed parent may not have left yet: at most 30 seconds."""
    if folder.is_dir():
        with contextlib.suppress(InputError), _lock(folder / LOCK_FILE, "out", _MOMENT):
            pass


@contextlib.contextmanager
def single_files(by: str, folder: Path, names: Sequence[str], inputs: Iterable[Path] = (), stale: Sequence[str] = ()) -> Iterator[None]:
    """Write files with ``names`` (which may contain ``*``) to any folder, such as that of the user, in the context.

    ``stale`` are further names of files beside earlier results. Those that the command ``by`` wrote and nobody has changed are removed in
    the end. Raises ``InputError`` if there is a file with one of ``names`` already that ``by`` did not write, or that has changed since.
    """
    written = Written(folder)
    written.begin(by, names, inputs, keep_changed=False)
    try:
        yield
        written.remove(by, stale)
    finally:
        written.finish(by, written.digests([name for name in names if "*" in name or (folder / name).is_file()]))


@contextlib.contextmanager
def _lock(path: Path, name: str, wait: float) -> Iterator[None]:
    lock = FileLock(path, thread_local=False)
    try:
        lock.acquire(timeout=wait)
    except Timeout:
        fail(name, f"{path.parent} is in use by {_holder(path)}", f"wait until it ends, or {_OTHER}")
    except OSError as error:
        fail(name, f"{path.parent} cannot be locked ({error.strerror})", _OTHER)
    try:
        arguments = " ".join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])[:200]
        holder = {"pid": os.getpid(), "host": platform.node(), "command": arguments, "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        with contextlib.suppress(OSError):
            path.write_text(json.dumps(holder), encoding="utf-8")
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is locked: whoever waits for this file sees that it is gone, and makes a new one
        lock.release()


def _holder(path: Path) -> str:
    try:
        holder = json.loads(path.read_text(encoding="utf-8"))
        return f"process {int(holder['pid'])} on {holder['host']} since {holder['since']} ({holder['command']})"
    except (OSError, ValueError, LookupError, TypeError):
        return "another process"


def results(folder: Path, pattern: str) -> list[Path]:
    """The files in a folder that match a pattern, without those that were renamed because somebody had changed them."""
    return [path for path in sorted(folder.glob(pattern)) if path.is_file() and not _ASIDE.search(path.name)]


def remove_results(folder: Path, *patterns: str, but: Collection[Path] = ()) -> None:
    """Remove the files of earlier work from a folder, ``but`` some.

    :meth:`Written.begin` comes first, which refuses or renames those of the user.
    """
    for pattern in patterns:
        for path in results(folder, pattern):
            if path not in but:
                path.unlink()


class Written:
    """The files that bbfit wrote to a folder, by their paths relative to it, and by what: the name of a stage or a command.

    Work ``begin``s before it writes and ``finish``es after it. What was begun and not finished may have written any of its files.
    """

    def __init__(self, folder: Path) -> None:
        """Read ``.bbfit.json`` of ``folder``. If it is missing or damaged, nothing counts as written."""
        self._folder = folder
        self._files, self._begun = dict[str, dict[str, str]](), dict[str, list[str]]()
        self._read()

    def adopt(self, by: str, digests: dict[str, str]) -> None:
        """Count files as written which another record lists, unless they are known already."""
        for path, digest in digests.items():
            self._files.setdefault(path, {"by": by, "sha256": digest})

    def check(self, by: str, names: Sequence[str], inputs: Iterable[Path] = ()) -> list[Path]:
        """Require that no file of ``names`` (which may contain ``*``) is foreign or one of ``inputs``. Return those that exist.

        A file is foreign if ``by`` did not write it. Raises ``InputError`` with its path.
        """
        existing = self._existing(names)
        inputs = [path for path in inputs if path.exists()]
        for path in existing:
            shown = os.path.normpath(path)
            if any(path.samefile(given) for given in inputs):
                fail("out", f"{shown} is an input, which the results would replace", "choose another place for the results")
            relative = self._relative(path)
            known = self._files.get(relative)
            begun = any(relative == name or ("*" in name and fnmatch(relative, name)) for name in self._begun.get(by, ()))
            if not begun and (known is None or known["by"] != by):
                maker = "did not write" if known is None else f"wrote by another step ({known['by']})"
                fail("out", f"{shown} exists, and is a file that bbfit {maker}", "move it away, or choose another place for the results")
        return existing

    def begin(self, by: str, names: Sequence[str], inputs: Iterable[Path] = (), *, keep_changed: bool = True) -> None:
        """Record that files are about to be written, after :meth:`check`.

        A file that has changed since ``by`` wrote it is renamed with the suffix ``.changed``, or refused unless ``keep_changed``.
        """
        for path in self.check(by, names, inputs):
            known = self._files.get(self._relative(path))
            if self._begun.get(by) or known is None or digest_file(path) == known["sha256"]:
                continue
            if not keep_changed:
                fail("out", f"{path} has changed since bbfit wrote it", "move it away, or choose another place for the results")
            places = (path.with_name(f"{path.name}.changed{number if number > 1 else ''}") for number in itertools.count(1))
            aside = next(place for place in places if not place.exists())
            path.rename(aside)
            _log.warning("%s has changed since bbfit wrote it; it is now %s", path, aside.name)
        with self._changing():
            self._begun[by] = list(names)

    def digests(self, names: Sequence[str]) -> dict[str, str]:
        """The digests of files by path. Raises ``FileNotFoundError`` if a file is missing whose name has no ``*``."""
        paths = [path for name in names for path in (self._existing([name]) if "*" in name else [self._folder / name])]
        return {self._relative(path): digest_file(path) for path in paths}

    def finish(self, by: str, digests: dict[str, str]) -> None:
        """Record that work was finished, and the files that it wrote."""
        with self._changing():
            self._begun.pop(by, None)
            self._files |= {path: {"by": by, "sha256": digest} for path, digest in digests.items()}

    def abandon(self, by: str, names: Sequence[str]) -> None:
        """Record that work which was begun ended without a result. Files that it wrote still count as its own."""
        left = (self._relative(path) for path in self._existing(names))
        if all(path in self._files and self._files[path]["sha256"] == digest_file(self._folder / path) for path in left):
            with contextlib.suppress(InputError), self._changing():  # the folder may be gone, which was the reason
                self._begun.pop(by, None)

    def remove(self, by: str, names: Sequence[str]) -> None:
        """Remove files with ``names`` (which may contain ``*``) that ``by`` wrote and nobody has changed."""
        for path in self._existing(names):
            if self._files.get(self._relative(path)) == {"by": by, "sha256": digest_file(path)}:
                path.unlink()

    def _existing(self, names: Sequence[str]) -> list[Path]:
        paths = [path for name in names for path in (results(self._folder, name) if "*" in name else [self._folder / name])]
        return [path for path in paths if path.is_file()]

    def _relative(self, path: Path) -> str:
        return Path(os.path.relpath(path, self._folder)).as_posix()

    def _read(self) -> None:
        path = self._folder / WRITTEN_FILE
        try:
            content: Any = read_json("out", path) if path.is_file() else {}
            files = {name: {"by": str(entry["by"]), "sha256": str(entry["sha256"])} for name, entry in content.get("written", {}).items()}
            begun = {str(by): [str(name) for name in names] for by, names in content.get("begun", {}).items()}
        except (InputError, AttributeError, LookupError, TypeError):
            return
        self._files, self._begun = self._files | files, begun

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        """Change the list while no other process does, and write it."""
        with _lock(self._folder / f"{WRITTEN_FILE}.lock", "out", _MOMENT):
            self._read()
            yield
            if self._files or self._begun:
                write_json(self._folder / WRITTEN_FILE, {"written": self._files, "begun": self._begun})
            else:
                (self._folder / WRITTEN_FILE).unlink(missing_ok=True)
