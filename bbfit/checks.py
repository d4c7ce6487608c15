"""One wording for bad input: what is wrong, what was expected, what was got, what to do.

Everything that a user can get wrong raises :class:`InputError` (a ``ValueError``), its subclass :class:`MissingFileError` (also a
``FileNotFoundError``) or :class:`InputTypeError` (also a ``TypeError``). The command line turns exactly these, and operating system
errors, into exit code 2; any other exception is a fault of ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn


class InputError(ValueError):
    """The caller's input cannot be used; the message says why and what to do."""


class InputTypeError(InputError, TypeError):
    """An argument has the wrong type."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that the caller named does not exist."""

    def __str__(self) -> str:
        return str(self.args[0])


def fail(name: str, problem: str, hint: str = "") -> NoReturn:
    """Raise :class:`InputError` reading ``name: problem; hint``."""
    raise InputError(f"{name}: {problem}" + (f"; {hint}" if hint else ""))


def check_range(name: str, value: float, low: float, high: float, *, open_low: bool = False) -> None:
    """Require ``low <= value <= high`` (``low < value`` with ``open_low``) and a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputTypeError(f"{name}: expected a number, got {value!r}")
    inside = (low < value if open_low else low <= value) and value <= high and value != float("inf")
    if not inside:  # NaN lands here too
        if high == float("inf"):
            wanted = f"more than {low:g}" if open_low else f"at least {low:g}"
        else:
            wanted = f"a value in {'(' if open_low else '['}{low:g}, {high:g}]"
        fail(name, f"expected {wanted}, got {value!r}")


def check_count(name: str, value: int, least: int = 1) -> None:
    """Require a whole number of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputTypeError(f"{name}: expected a whole number, got {value!r}")
    if value < least:
        fail(name, f"expected at least {least}, got {value}")


def check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    """Require one of ``choices``."""
    if value not in choices:
        fail(name, f"expected one of {', '.join(map(str, choices))}, got {value!r}")


def check_shape(name: str, got: tuple[int, ...], expected: tuple[int | None, ...]) -> None:
    """Require a shape; ``None`` matches any length."""
    fits = len(got) == len(expected) and all(e is None or e == g for g, e in zip(got, expected, strict=True))
    if not fits:
        wanted = "[" + ", ".join("*" if e is None else str(e) for e in expected) + "]"
        fail(name, f"expected shape {wanted}, got {list(got)}")


def check_file(name: str, path: str | Path) -> Path:
    """Require an existing, readable, non-empty file; return it as a ``Path``."""
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"{name}: {path} does not exist; check the spelling")
    if not path.is_file():
        fail(name, f"{path} is not a file")
    if path.stat().st_size == 0:
        fail(name, f"{path} is empty; get the file anew")
    return path


def check_folder(name: str, path: str | Path) -> Path:
    """Require an existing folder; return it as a ``Path``."""
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"{name}: {path} does not exist; check the spelling")
    if not path.is_dir():
        fail(name, f"{path} is not a folder")
    return path
