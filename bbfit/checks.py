"""Checks of user input. Every message says what is wrong, what was expected, what was given and what to do.

Everything that a user can get wrong raises :class:`InputError` (a ``ValueError``), its subclass :class:`MissingFileError` (also a
``FileNotFoundError``) or :class:`InputTypeError` (also a ``TypeError``). The command line turns exactly these, and operating system
errors, into exit code 2; any other exception is a bug in bbfit.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal, DecimalException
from functools import cache
from math import inf
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

_LONGEST_MESSAGE = 4000
_LARGEST_NUMBER = 10**30
_FACTORS, _LARGEST_AMOUNT = {"k": 1_000, "m": 1_000_000}, 10**15


class InputError(ValueError):
    """The caller's input cannot be used; the message says why and what to do, in one line."""

    def __str__(self) -> str:
        return one_line(" ".join(map(str, self.args)))


class InputTypeError(InputError, TypeError):
    """An argument has the wrong type."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that the caller named does not exist."""

    def __str__(self) -> str:  # not that of FileNotFoundError
        return InputError.__str__(self)


def one_line(text: str) -> str:
    """A text for the terminal: control characters and characters without an encoding as escapes, and the middle of a long text omitted.

    Names and values in messages come from files that nobody has checked.
    """
    if len(text) > _LONGEST_MESSAGE:
        text = f"{text[: _LONGEST_MESSAGE - 200]} ... {text[-190:]}"
    return "".join(letter if letter.isprintable() else _escape(letter) for letter in text)


def _escape(letter: str) -> str:
    """The code of a character. Python keeps the bytes of a path that are not UTF-8 as characters from U+DC80 on."""
    return f"\\x{ord(letter) - 0xDC00:02x}" if 0xDC80 <= ord(letter) <= 0xDCFF else repr(letter)[1:-1]


def in_words(error: Exception) -> str:
    """An error in words for the user: its message, and for an ``OSError`` the file and the system's reason without their numbers."""
    if not isinstance(error, OSError) or isinstance(error, InputError) or error.strerror is None:
        return str(error)
    name = error.filename
    return error.strerror if name is None else f"{os.fsdecode(name) if isinstance(name, bytes) else name} cannot be used ({error.strerror})"


def fail(name: str, problem: str, hint: str = "") -> NoReturn:
    """Raise :class:`InputError` reading ``name: problem; hint``."""
    raise InputError(f"{name}: {problem}" + (f"; {hint}" if hint else ""))


@dataclass(frozen=True)
class Range:
    """The values that a number in a configuration may have, as in ``Annotated[float, Range(0, 1)]``; see :func:`check_fields`."""

    low: float
    """Least value."""
    high: float = inf
    """Greatest value."""
    open_low: bool = False
    """Whether ``low`` itself is excluded."""
    open_high: bool = False
    """Whether ``high`` itself is excluded."""


Count = Annotated[int, Range(1)]
"""A whole number of at least 1."""
Seed = Annotated[int, Range(0)]
"""A seed of random numbers: a whole number of at least 0."""


def check_fields(config: Any) -> None:
    """Require that every field of a dataclass holds what its annotation allows. The message of the error starts with the field's name.

    A ``Literal`` has to hold one of its values, a ``bool`` True or False, and a number with a :class:`Range` one within it. ``None`` is
    allowed where the annotation allows it. Items of a tuple are checked one by one. Other types are not checked.
    """
    hints = _hints(config.__class__)
    for field in fields(config):
        _check(field.name, getattr(config, field.name), hints[field.name])


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _check(name: str, value: Any, hint: Any) -> None:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        kinds = [kind for kind in arguments if kind is not NoneType]
        if value is None and NoneType in arguments:
            return
        if all(get_origin(kind) is Literal for kind in kinds):
            check_choice(name, value, tuple(choice for kind in kinds for choice in get_args(kind)))
        elif len(kinds) == 1:
            _check(name, value, kinds[0])
    elif origin is tuple:
        if not isinstance(value, tuple | list):
            raise InputTypeError(f"{name}: expected a tuple, got {value!r}")
        for item in value:
            _check(name, item, arguments[0])
    elif origin is Literal or hint is bool:
        check_choice(name, value, arguments or (False, True))
    elif origin is Annotated:
        for limits in (each for each in arguments[1:] if isinstance(each, Range)):
            if arguments[0] is int:
                check_count(name, value, int(limits.low))
            check_range(name, value, limits.low, limits.high, open_low=limits.open_low, open_high=limits.open_high)


def amount(name: str, value: int | str) -> int:
    """A whole number, or one with k (thousands) or M (millions) after it, as in ``200k`` and ``1.5M``."""
    if not isinstance(value, str):
        return value
    factor = _FACTORS.get(value[-1:].lower(), 1)
    try:
        number = Decimal(value if factor == 1 else value[:-1]) * factor
    except DecimalException:
        fail(name, f"{value!r} is no number", "write for example 200000, 200k or 1.5M")
    if not number.is_finite() or abs(number) > _LARGEST_AMOUNT or number != int(number):
        fail(name, f"{value!r} is not a whole number", "write for example 200000, 200k or 1.5M")
    return int(number)


def check_record(name: str, value: Any, hint: Any) -> None:
    """Require a value from a file to be what a type says: ``hint`` is a type, such as a dataclass, whose fields are checked too.

    Numbers must be finite. Dataclasses that check themselves when they are made, and ``Any``, are not checked. Unlike a configuration, a
    file is not what a caller gave, so this raises ``TypeError``, to be caught where the file is read.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return
    if origin is Annotated:
        check_record(name, value, arguments[0])
    elif origin in (Union, UnionType):
        kinds = [kind for kind in arguments if kind is not NoneType]
        if value is not None or len(kinds) == len(arguments):
            check_record(name, value, kinds[0])
    elif origin is Literal:
        _require(name, isinstance(value, str | int) and value in arguments, f"one of {arguments}")
    elif origin is tuple:
        _require(name, isinstance(value, tuple), "a tuple")
        for item in value:
            check_record(name, item, arguments[0])
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        _require(name, isinstance(value, Mapping), "a mapping")
        for key, item in value.items():
            check_record(name, key, arguments[0])
            check_record(name, item, arguments[1])
    elif is_dataclass(hint) and isinstance(hint, type):
        _require(name, isinstance(value, hint), hint.__name__)
        if not hasattr(hint, "__post_init__"):
            for each, kind in _hints(hint).items():
                check_record(f"{name}.{each}", getattr(value, each), kind)
    elif hint in (int, float):
        fits = (
            isinstance(value, int if hint is int else int | float)
            and not isinstance(value, bool)
            and -_LARGEST_NUMBER < value < _LARGEST_NUMBER
        )
        _require(name, fits, "a finite number")
    elif isinstance(hint, type):
        _require(name, isinstance(value, hint), hint.__name__)


def _require(name: str, condition: bool, kind: str) -> None:
    if not condition:
        raise TypeError(f"{name} is no {kind}")


def check_range(name: str, value: float, low: float, high: float, *, open_low: bool = False, open_high: bool = False) -> None:
    """Require a finite number with ``low <= value <= high``; an open end is excluded."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputTypeError(f"{name}: expected a number, got {value!r}")
    inside = (low < value if open_low else low <= value) and (value < high if open_high else value <= high) and value != inf
    if not inside:  # NaN is not inside either
        if high == inf:
            expected = f"more than {low:g}" if open_low else f"at least {low:g}"
        else:
            expected = f"a value in {'(' if open_low else '['}{low:g}, {high:g}{')' if open_high else ']'}"
        fail(name, f"expected {expected}, got {value!r}")


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
        shape = "[" + ", ".join("*" if e is None else str(e) for e in expected) + "]"
        fail(name, f"expected shape {shape}, got {list(got)}")


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


def check_output_file(name: str, path: str | Path) -> Path:
    """Require that a file to be written is not a folder; return it as a ``Path``."""
    path = Path(path)
    if path.is_dir():
        fail(name, f"{path} is a folder", "choose another name")
    return path


def check_folder(name: str, path: str | Path) -> Path:
    """Require an existing folder; return it as a ``Path``."""
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"{name}: {path} does not exist; check the spelling")
    if not path.is_dir():
        fail(name, f"{path} is not a folder")
    return path
