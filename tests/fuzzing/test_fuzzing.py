"""Hostile inputs for every reader: it succeeds or refuses in one line, shows nothing, and changes nothing. ``scripts/fuzz`` tries more."""

from __future__ import annotations

import os
import tempfile
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from bbfit.checks import InputError

from .targets import TARGETS, Files, Target, place

EXAMPLES = 100


def contents(folder: Path) -> dict[str, str]:
    """The digests of the files in a folder."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
    return {path.relative_to(folder).as_posix(): sha256(path.read_bytes()).hexdigest() for path in paths}


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_inputs_are_read_or_refused_in_one_line(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    target: Target = TARGETS[name]

    @settings(
        max_examples=max(int(EXAMPLES * target.weight), 8),
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.inputs)
    def attempt(files: Files) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            folder = place(files, Path(scratch))
            before = contents(folder)
            try:
                target.read(folder)
            except InputError as error:
                message = str(error)
                assert message.isprintable() and len(message) < 5000, message
                assert not isinstance(error.__cause__, MemoryError)
                os.fsencode(message)
                if name != "checkpoints":  # which a fit replaces by its own
                    assert contents(folder) == before

    attempt()
    shown = capfd.readouterr()
    assert not shown.err, shown.err
