"""What a sweep has computed, one small file a result, named by the hash of all that it depends on."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from bbfit.checks import InputError
from bbfit.files import output_folder, read_json, write_json
from bbfit.sweep.tasks import Outcome


class Results:
    """A folder of results."""

    def __init__(self, folder: Path) -> None:
        """Make the folder if need be."""
        self._folder = output_folder("out", folder)

    def get(self, key: str) -> Outcome | None:
        """What an earlier start found; a damaged file counts as none."""
        path = self._path(key)
        if not path.is_file():
            return None
        try:
            content: Any = read_json("result", path)
            return Outcome(**content["outcome"])
        except (InputError, KeyError, TypeError):
            return None

    def put(self, key: str, outcome: Outcome, request: dict[str, Any]) -> None:
        """Keep a result beside what was asked for, completely or not at all."""
        write_json(self._path(key), {"request": request, "outcome": asdict(outcome)})

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"
