"""What an interrupted work has finished: a line of JSON for each part, so that the next start does none of them again."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import IO, Any


class Journal:
    """A file to which finished parts are appended. This is a context manager, which closes the file."""

    def __init__(self, path: Path, key: str) -> None:
        """Read the parts of a journal with the same ``key``; begin a new one if there is none."""
        self._path, self._key = path, key
        self.known = dict[str, Any]()
        """The finished parts by their names."""
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Journal:
        lines = self._path.read_bytes().split(b"\n") if self._path.is_file() else []
        whole = lines[:-1]  # the last line may be cut short
        if whole and whole[0] == self._key.encode():
            for line in whole[1:]:
                try:
                    name, value = json.loads(line)
                except (ValueError, TypeError):
                    break
                self.known[str(name)] = value
        kept = [self._key.encode(), *(json.dumps(part).encode() for part in self.known.items())]
        self._file = self._path.open("wb")
        self._file.write(b"\n".join(kept) + b"\n")
        self._file.flush()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, name: str, value: Any) -> None:
        """Append a finished part."""
        assert self._file is not None
        self._file.write(json.dumps([name, value]).encode() + b"\n")
        self._file.flush()
