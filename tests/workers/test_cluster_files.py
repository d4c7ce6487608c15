"""What work on a cluster does without one: files on their way, and an address where nobody listens."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from bbfit.checks import InputError
from bbfit.workers.cluster import RayWorkers, _same_handlers, read_files, write_files
from bbfit.workers.config import WorkersConfig


def test_an_address_without_a_cluster_is_refused() -> None:
    with (
        pytest.raises(InputError, match=r"ray: no cluster answers at 127.0.0.1:1 .*; start one with ray start"),
        RayWorkers(WorkersConfig(ray="127.0.0.1:1")),
    ):
        pass


def test_files_are_read_and_placed_as_they_lie(tmp_path: Path) -> None:
    """A folder, a single file, and a file with what it refers to."""
    (tmp_path / "tree" / "more").mkdir(parents=True)
    (tmp_path / "tree" / "tree.gltf").write_bytes(b"g")
    (tmp_path / "tree" / "more" / "part.bin").write_bytes(b"b")
    (tmp_path / "tree" / "other.txt").write_bytes(b"o")
    tree, part = tmp_path / "tree" / "tree.gltf", tmp_path / "tree" / "more" / "part.bin"
    assert read_files(tree) == {"tree.gltf": b"g"}
    assert read_files(tree, part) == {"tree.gltf": b"g", "more/part.bin": b"b"}
    assert read_files(tmp_path / "tree") == {"more/part.bin": b"b", "other.txt": b"o", "tree.gltf": b"g"}
    write_files(read_files(tmp_path / "tree"), tmp_path / "copy")
    assert (tmp_path / "copy" / "more" / "part.bin").read_bytes() == b"b"


def test_files_outside_the_folder_of_a_tree_are_refused(tmp_path: Path) -> None:
    """Their copies would lie outside the folder of the task."""
    (tmp_path / "tree").mkdir()
    for name in ("tree/tree.obj", "bark.png"):
        (tmp_path / name).write_bytes(b"x")
    for outside in (tmp_path / "bark.png", tmp_path / "tree" / ".." / "bark.png"):
        with pytest.raises(InputError, match=r"ray: .*bark\.png lies outside .*tree; put all files of a tree into one folder"):
            read_files(tmp_path / "tree" / "tree.obj", outside)


def test_ray_may_not_take_over_signals() -> None:
    def mine(number: int, frame: object) -> None: ...

    before = signal.signal(signal.SIGTERM, mine)
    try:
        with _same_handlers():
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as Ray does
        assert signal.getsignal(signal.SIGTERM) is mine
    finally:
        signal.signal(signal.SIGTERM, before)
