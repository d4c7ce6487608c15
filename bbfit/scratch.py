"""Temporary folders. They are removed even if their process is killed: by the next process of bbfit that starts.

A process holds a lock on each of its folders. The system releases the lock when the process ends, however it ends, so a folder that
nobody has locked belongs to a dead process. Where a folder cannot be locked, as on Windows, only its own process removes it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PREFIX = "bbfit-scratch-"
"""The names of all temporary folders begin so."""
# The folders of this process, for the case that it has to end without leaving their blocks.
_OPEN = set["ScratchFolder"]()


class ScratchFolder:
    """A new temporary folder. This is a context manager: leaving it removes the folder. Folders of dead processes are removed before."""

    def __init__(self) -> None:
        remove_abandoned()
        self.path, self._lock = _new_folder()
        _OPEN.add(self)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the folder with everything in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        _OPEN.discard(self)
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


@contextlib.contextmanager
def named_in_utf8(path: Path) -> Iterator[Path]:
    """The path of a file for libraries that take only UTF-8: a link to the file where its own path is something else."""
    if not _has_other_bytes(path):
        yield path
        return
    with ScratchFolder() as folder:
        link = folder / "file"
        link.symlink_to(path.resolve())
        yield link


def _has_other_bytes(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return True
    return False


def remove_own() -> None:
    """Remove all folders of this process, because it is about to end at once."""
    for folder in list(_OPEN):
        folder.remove()


def remove_abandoned() -> None:
    """Remove the temporary folders of processes that have ended without removing them."""
    with contextlib.suppress(OSError):  # there is no folder for temporary files, or it cannot be listed
        with os.scandir(tempfile.gettempdir()) as entries:
            found = [Path(entry.path) for entry in entries if entry.name.startswith(PREFIX)]
        for path in found:
            with contextlib.suppress(OSError):
                lock = _locked(path)
                shutil.rmtree(path, ignore_errors=True)
                os.close(lock)


def _new_folder() -> tuple[Path, int | None]:
    """A new folder and the descriptor that holds its lock, if there are locks."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=PREFIX))
        try:
            lock = _locked(path)
        except (BlockingIOError, FileNotFoundError):  # in this moment another process took it for abandoned
            continue
        except OSError:
            return path, None
        if path.exists():
            return path, lock
        os.close(lock)


def _locked(path: Path) -> int:
    """Lock a folder of this user. Return the descriptor that holds the lock. Raises ``OSError`` if this is not possible."""
    if fcntl is None:
        raise OSError("folders cannot be locked")
    lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_uid != os.getuid():
            raise PermissionError(f"{path} belongs to another user")
    except BaseException:
        os.close(lock)
        raise
    return lock
