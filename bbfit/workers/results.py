"""The results of tasks: one small JSON file for each, named by its cache key."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from bbfit.checks import InputError, check_record
from bbfit.files import read_json, remove_parts, write_json
from bbfit.inputs import reading
from bbfit.outputs import output_folder
from bbfit.workers.tasks import Outcome


class Results:
    """A folder of results."""

    def __init__(self, folder: Path) -> None:
        """Create the folder if it does not exist."""
        self._folder = output_folder("out", folder)
        remove_parts(folder)

    def get(self, key: str) -> Outcome | None:
        """The stored outcome with a key. ``None`` if its file is missing or damaged."""
        path = self._path(key)
        if not path.is_file():
            return None
        try:
            content: Any = read_json("result", path)
            with reading("result", path, "remove it"):
                outcome = Outcome(**content["outcome"])
                check_record("outcome", outcome, Outcome)
                _check_numbers((outcome.facts or {}).get("report", {}))
                return outcome
        except InputError:
            return None

    def put(self, key: str, outcome: Outcome, request: dict[str, Any]) -> None:
        """Store an outcome atomically, with a description of its inputs for the reader."""
        write_json(self._path(key), {"request": request, "outcome": asdict(outcome)})

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"


def _check_numbers(report: dict[str, Any]) -> None:
    """Require numbers, texts, lists or nothing, in dictionaries to any depth."""
    for name, value in report.items():
        if isinstance(value, dict):
            _check_numbers(value)
        elif not isinstance(value, str | list):
            check_record(name, value, float | None)
