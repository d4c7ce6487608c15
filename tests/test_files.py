"""Files appear whole or not at all."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from full_disk import FULL, full_disk
from safetensors import safe_open

from bbfit.checks import InputError
from bbfit.files import read_json, remove_parts, write_bytes, write_json, write_pieces, write_tensors


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_writing_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    for data in (b"first", b"second, longer", b""):
        write_bytes(path, data)
        assert path.read_bytes() == data and names(tmp_path) == ["a.bin"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_a_full_disk_leaves_the_old_file_and_no_part(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")
    with full_disk(), pytest.raises(InputError, match=FULL):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_no_part(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")

    def pieces() -> Iterator[bytes]:
        yield b"ne"
        raise error

    with pytest.raises(InputError if isinstance(error, OSError) else type(error)):
        write_pieces(path, pieces())
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.bin"]


def test_what_cannot_be_put_in_its_place_leaves_no_part(tmp_path: Path) -> None:
    (tmp_path / "a.bin" / "in the way").mkdir(parents=True)
    with pytest.raises(InputError, match=r"a\.bin cannot be written"):
        write_bytes(tmp_path / "a.bin", b"new")
    assert names(tmp_path) == ["a.bin"] and names(tmp_path / "a.bin") == ["in the way"]


def test_pieces_make_one_file_or_none(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_pieces(path, (bytes([value]) * 3 for value in (1, 2)))
    assert path.read_bytes() == b"\1\1\1\2\2\2"

    def breaking_off() -> Iterator[bytes]:
        yield b"new"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_pieces(path, breaking_off())
    assert path.read_bytes() == b"\1\1\1\2\2\2" and names(tmp_path) == ["a.bin"]


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".bbfit-abc.part").write_bytes(b"half")
    (tmp_path / "mine.part").write_bytes(b"kept")
    (tmp_path / ".video.mp4.part").write_bytes(b"kept")
    remove_parts(tmp_path)
    assert names(tmp_path) == [".video.mp4.part", "mine.part"]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere/a\.bin cannot be written \(No such file or directory\)"):
        write_bytes(tmp_path / "nowhere" / "a.bin", b"x")


def test_json_round_trip(tmp_path: Path) -> None:
    value = {"psnr": 27.4, "tree": "Ahorn äöü", "views": [1, 2, None]}
    write_json(tmp_path / "a.json", value)
    assert read_json("metrics", tmp_path / "a.json") == value


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {"a": [1, float("nan")]}, {"a": {1, 2}}])
def test_what_json_cannot_hold_is_refused_before_anything_is_written(tmp_path: Path, value: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        write_json(tmp_path / "a.json", value)
    assert names(tmp_path) == []


@pytest.mark.parametrize("data", [b"", b"{", b'{"a": 1', b"\xff\xfe\x00", b"{'a': 1}"])
def test_damaged_json_is_named(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"^run: .*run\.json is not valid JSON .*restore it$"):
        read_json("run", path)


def test_tensors_round_trip(tmp_path: Path) -> None:
    tensors = {"a": torch.rand(3, 2), "b": torch.tensor([True, False]), "c": torch.arange(4)}
    write_tensors(tmp_path / "a.safetensors", tensors, {"format": "x"})
    with safe_open(tmp_path / "a.safetensors", framework="pt") as file:
        assert file.metadata() == {"format": "x"}
        for name, tensor in tensors.items():
            assert torch.equal(file.get_tensor(name), tensor) and file.get_tensor(name).dtype == tensor.dtype
    assert names(tmp_path) == ["a.safetensors"]
