"""The wording of bad input, and what passes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from bbfit.checks import (
    Count,
    InputError,
    InputTypeError,
    MissingFileError,
    Range,
    check_choice,
    check_count,
    check_fields,
    check_file,
    check_folder,
    check_range,
    check_record,
    check_shape,
    fail,
)


def test_errors_are_the_built_in_ones_too() -> None:
    assert issubclass(InputError, ValueError)
    assert issubclass(InputTypeError, InputError) and issubclass(InputTypeError, TypeError)
    assert issubclass(MissingFileError, InputError) and issubclass(MissingFileError, FileNotFoundError)
    assert str(MissingFileError("mesh: a.glb does not exist")) == "mesh: a.glb does not exist"


def test_fail_says_what_is_wrong_and_what_to_do() -> None:
    with pytest.raises(InputError, match=r"^mesh: has no faces; export it anew$"):
        fail("mesh", "has no faces", "export it anew")
    with pytest.raises(InputError, match=r"^mesh: has no faces$"):
        fail("mesh", "has no faces")


@pytest.mark.parametrize(
    ("value", "low", "high", "open_low", "message"),
    [
        (2, 0, 1, False, r"^rate: expected a value in \[0, 1\], got 2$"),
        (0, 0, 1, True, r"^rate: expected a value in \(0, 1\], got 0$"),
        (-1.5, 0, float("inf"), False, r"^rate: expected at least 0, got -1\.5$"),
        (0.0, 0, float("inf"), True, r"^rate: expected more than 0, got 0\.0$"),
        (float("nan"), 0, 1, False, "got nan"),
        (float("nan"), 0, float("inf"), False, "got nan"),
    ],
)
def test_range(value: float, low: float, high: float, open_low: bool, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_range("rate", value, low, high, open_low=open_low)


def test_values_within_their_range_pass() -> None:
    check_range("rate", 0, 0, 1)
    check_range("rate", 1.0, 0, 1, open_low=True)
    check_range("rate", 1e300, 0, float("inf"))
    check_count("count", 1)
    check_count("count", 0, 0)
    check_choice("loss", "l2", ("l1", "l2"))
    check_shape("image", (5, 7, 4), (None, 7, 4))
    check_shape("scalar", (), ())


def test_infinity_is_not_a_number_to_compute_with() -> None:
    with pytest.raises(InputError, match="got inf"):
        check_range("rate", float("inf"), 0, float("inf"))


@pytest.mark.parametrize("value", [True, "1", None, [1]])
def test_wrong_types(value: object) -> None:
    with pytest.raises(InputTypeError, match=r"^rate: expected a number, got "):
        check_range("rate", value, 0, 1)  # type: ignore[arg-type]
    with pytest.raises(InputTypeError, match=r"^count: expected a whole number, got "):
        check_count("count", value)  # type: ignore[arg-type]


def test_count_choice_and_shape() -> None:
    with pytest.raises(InputTypeError, match="whole number"):
        check_count("count", 2.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^count: expected at least 1, got 0$"):
        check_count("count", 0)
    with pytest.raises(InputError, match=r"^loss: expected one of l1, l2, got 'l3'$"):
        check_choice("loss", "l3", ("l1", "l2"))
    for shape in ((4, 3), (4,), (4, 4, 4)):
        with pytest.raises(InputError, match=r"^pose: expected shape \[\*, 4\], got \["):
            check_shape("pose", shape, (None, 4))


def test_files_and_folders(tmp_path: Path) -> None:
    file, empty, missing = tmp_path / "a.glb", tmp_path / "b.glb", tmp_path / "c.glb"
    file.write_bytes(b"x")
    empty.touch()
    assert check_file("tree", str(file)) == file and check_folder("views", str(tmp_path)) == tmp_path
    for path, message in ((missing, "does not exist"), (tmp_path, "is not a file"), (empty, "is empty")):
        with pytest.raises(InputError, match=rf"^tree: .*{path.name}.* {message}|^tree: .*{path.name} {message}"):
            check_file("tree", path)
    for path, message in ((missing, "does not exist"), (file, "is not a folder")):
        with pytest.raises(InputError, match=rf"^views: .*{path.name} {message}"):
            check_folder("views", path)
    with pytest.raises(FileNotFoundError):
        check_file("tree", missing)


@dataclass(frozen=True)
class Options:
    """A field of every kind that is checked, and one that is not."""

    count: Count = 1
    limit: Count | None = None
    corners: Annotated[int, Range(4, 8)] = 4
    cutoff: Annotated[float, Range(0, 1, open_low=True, open_high=True)] = 0.5
    angles: tuple[Annotated[float, Range(-90, 90)], ...] = (0.0,)
    loss: Literal["l1", "l2"] = "l1"
    mode: Literal["mask", "blend"] | None = None
    switch: bool | None = None
    folder: Path | None = None

    def __post_init__(self) -> None:
        check_fields(self)


class Decided(Options):
    """The same, with a choice that has to be made."""

    mode: Literal["mask", "blend"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 0}, "count: expected at least 1, got 0"),
        ({"count": True}, "count: expected a whole number, got True"),
        ({"count": None}, "count: expected a whole number, got None"),
        ({"limit": 0}, "limit: expected at least 1, got 0"),
        ({"corners": 3}, "corners: expected at least 4, got 3"),
        ({"corners": 9}, r"corners: expected a value in \[4, 8\], got 9"),
        ({"corners": 5.0}, "corners: expected a whole number, got 5.0"),
        ({"cutoff": 0}, r"cutoff: expected a value in \(0, 1\), got 0"),
        ({"cutoff": 1.0}, r"cutoff: expected a value in \(0, 1\), got 1.0"),
        ({"cutoff": math.nan}, "cutoff: .*got nan"),
        ({"angles": (0.0, 91.0)}, r"angles: expected a value in \[-90, 90\], got 91.0"),
        ({"angles": 3.0}, "angles: expected a tuple, got 3.0"),
        ({"loss": "l3"}, "loss: expected one of l1, l2, got 'l3'"),
        ({"loss": None}, "loss: expected one of l1, l2, got None"),
        ({"mode": "hash"}, "mode: expected one of mask, blend, got 'hash'"),
        ({"switch": 2}, "switch: expected one of False, True, got 2"),
    ],
)
def test_fields_hold_what_their_annotations_allow(values: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}$"):
        Options(**values)  # type: ignore[arg-type]


def test_allowed_fields_pass() -> None:
    Options(limit=3, corners=8, cutoff=0.99, angles=[-90, 90], mode="blend", switch=False, folder="x")  # type: ignore[arg-type]
    assert Decided(mode="mask").limit is None
    with pytest.raises(InputError, match=r"^mode: expected one of mask, blend, got None$"):
        Decided()


@dataclass(frozen=True)
class Noted:
    """What a file may hold."""

    name: str
    count: int
    ratio: float | None
    kind: Literal["a", "b"]
    items: tuple[float, ...]
    facts: Mapping[str, Any]


NOTED = {"name": "x", "count": 2, "ratio": None, "kind": "a", "items": (1, 2.5), "facts": {"a": object()}}


def test_records_of_files_hold_what_their_types_say() -> None:
    check_record("noted", Noted(**NOTED), Noted)
    check_record("noted", (Noted(**NOTED | {"ratio": 1}),), tuple[Noted, ...])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("name", 3),
        ("count", 2.0),
        ("count", True),
        ("count", 10**40),
        ("count", None),
        ("ratio", math.nan),
        ("ratio", math.inf),
        ("ratio", "1"),
        ("kind", "c"),
        ("kind", []),
        ("items", (1, "2")),
        ("items", 5),
        ("facts", {1: 2}),
        ("facts", None),
    ],
)
def test_records_of_files_with_other_values(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=rf"noted\.{name}"):
        check_record("noted", Noted(**NOTED | {name: value}), Noted)
