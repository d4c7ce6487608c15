"""Cache keys change exactly when the result can change."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError, MissingFileError
from bbfit.fitting.config import FitConfig
from bbfit.provenance import EXECUTION, VERSIONS, cache_key, digest_file, digest_files, identity
from bbfit.trees.config import GrowConfig


@dataclass(frozen=True)
class Inner:
    size: float = 2.0
    workers: int = field(default=1, metadata=EXECUTION)


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    names: tuple[str, ...] = ("a",)
    path: Path | None = None


def test_a_dataclass_becomes_its_fields_without_those_of_execution() -> None:
    assert identity(Outer()) == {"inner": {"size": 2}, "names": ["a"], "path": None}
    assert identity(Outer(Inner(workers=8))) == identity(Outer())
    assert identity(Outer(Inner(size=2.5))) != identity(Outer())


@pytest.mark.parametrize(
    ("one", "other"), [(0, 0.0), ((1, 2), [1.0, 2.0]), ({1: "a"}, {"1": "a"}), ({"a": 1, "b": 2}, {"b": 2, "a": 1}), (-0.0, 0)]
)
def test_values_with_the_same_meaning_have_the_same_key(one: Any, other: Any) -> None:
    assert cache_key("fit", one) == cache_key("fit", other)


@pytest.mark.parametrize(
    ("one", "other"), [(1, 1.5), ("1", 1), (None, "None"), ([1, 2], [2, 1]), ([[1], 2], [[1, 2]]), (1, True), ([], {})]
)
def test_values_with_another_meaning_have_another_key(one: Any, other: Any) -> None:
    assert cache_key("fit", one) != cache_key("fit", other)


def test_a_path_counts_by_its_name_and_contents(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    here, there = tmp_path / "sky.hdr", tmp_path / "elsewhere" / "sky.hdr"
    here.write_bytes(b"blue")
    there.write_bytes(b"blue")
    assert identity(Outer(path=here))["path"] == {"name": "sky.hdr", "sha256": hashlib.sha256(b"blue").hexdigest()}
    assert identity(here) == identity(there)
    there.write_bytes(b"gray")
    assert identity(here) != identity(there)
    assert identity(here) != identity(here.rename(tmp_path / "night.hdr"))


def test_a_path_needs_a_file_with_contents(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"none\.hdr does not exist"):
        cache_key("views", ViewsConfig(hdri=tmp_path / "none.hdr"))
    (tmp_path / "empty.hdr").touch()
    with pytest.raises(InputError, match=r"empty\.hdr is empty"):
        identity(tmp_path / "empty.hdr")


@pytest.mark.parametrize("value", [{1, 2}, b"bytes", object(), Outer, [1, {"a": 1j}]])
def test_other_types_are_errors(value: Any) -> None:
    with pytest.raises(TypeError, match="has no identity"):
        identity(value)


def test_a_key_depends_on_the_algorithm_and_on_the_order_of_its_inputs() -> None:
    keys = [cache_key(name, 1, 2) for name in VERSIONS] + [cache_key("fit", 2, 1), cache_key("fit", 1), cache_key("fit", (1, 2))]
    assert len(set(keys)) == len(keys) and all(len(key) == 64 and int(key, 16) >= 0 for key in keys)
    with pytest.raises(KeyError):
        cache_key("unheard of")


@pytest.mark.parametrize(
    ("config", "same", "different"),
    [
        (FitConfig(), {"checkpoint_every": 7, "device": "cuda"}, {"seed": 1}),
        (GrowConfig(), {"max_vertices": 7, "species_file": Path("own.json")}, {"detail": 0.5}),
    ],
)
def test_options_of_execution_do_not_count(config: Any, same: dict[str, Any], different: dict[str, Any]) -> None:
    assert cache_key("fit", replace(config, **same)) == cache_key("fit", config) != cache_key("fit", replace(config, **different))


def test_digests_of_files(tmp_path: Path) -> None:
    """A single file has the digest of its contents; several count with their relative paths, wherever their folder is."""
    for folder in ("here", "there"):
        (tmp_path / folder / "sub").mkdir(parents=True)
        (tmp_path / folder / "a").write_bytes(b"1" * (1 << 20) + b"2")
        (tmp_path / folder / "sub" / "b").write_bytes(b"3")

    def digest(folder: str, *names: str) -> str:
        return digest_files([tmp_path / folder / name for name in names], tmp_path / folder)

    assert digest_file(tmp_path / "here" / "a") == hashlib.sha256(b"1" * (1 << 20) + b"2").hexdigest() == digest("here", "a")
    assert digest("here", "a", "sub/b") == digest("there", "a", "sub/b") != digest("here", "a")
    (tmp_path / "there" / "sub" / "b").rename(tmp_path / "there" / "b")
    assert digest("there", "a", "b") != digest("here", "a", "sub/b")
    (tmp_path / "here" / "sub" / "b").write_bytes(b"4")
    (tmp_path / "there" / "b").rename(tmp_path / "there" / "sub" / "b")
    assert digest("there", "a", "sub/b") != digest("here", "a", "sub/b")
    with pytest.raises(FileNotFoundError):
        digest_file(tmp_path / "none")
