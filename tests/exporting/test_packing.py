"""Packing by xatlas in a process of its own; that nothing overlaps is shown on the atlases in test_atlas.py."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from bbfit.exporting.packing import packed

CELLS = np.array([[3, 3], [4, 5], [2, 9], [40, 2]])


def test_the_same_every_time_from_the_origin_on() -> None:
    places = packed(CELLS)
    assert places.dtype == np.int64 and places.shape == (4, 2) and places.min(0).tolist() == [0, 0]
    assert np.array_equal(places, packed(CELLS))


def test_modules_are_found_wherever_this_process_finds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a notebook, say, that has put the project's folder on its path by hand."""
    (tmp_path / "xatlas.py").write_text("import os; os.write(1, b'[[0, 0, 5, 7]]'); os._exit(0)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert packed(np.array([[5, 7]])).tolist() == [[0, 0]]


def test_files_in_the_working_folder_do_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("re", "numpy", "xatlas"):
        (tmp_path / f"{name}.py").write_text("raise ImportError('of the working folder')")
    monkeypatch.chdir(tmp_path)
    assert len(packed(CELLS)) == len(CELLS)


@pytest.mark.parametrize("answer", ["[]", "[[0, 0, 5, 6]]", "[[0, 0, 5, 7], [5, 0, 10, 7]]"])
def test_a_wrong_answer_is_refused(answer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "xatlas.py").write_text(f"import os; os.write(1, b'{answer}'); os._exit(0)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AssertionError, match="xatlas"):
        packed(np.array([[5, 7]]))


def test_a_process_that_fails_is_not_taken_for_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "xatlas.py").write_text("raise ImportError('broken')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(subprocess.CalledProcessError):
        packed(CELLS)


def test_the_process_ends_without_tearing_xatlas_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tearing down is where it can wait for ever (see the module); a stand-in leaves a file behind when that happens."""
    trace = tmp_path / "torn down"
    stand_in = f"""
import numpy as np
class PackOptions: pass
class Atlas:
    width = height = atlas_count = 1
    def add_uv_mesh(self, chart, triangle): pass
    def generate(self, pack_options): pass
    def __getitem__(self, n): return None, None, np.array([[0, 0], [5, 7]])
    def __del__(self): open({str(trace)!r}, "w").close()
"""
    (tmp_path / "xatlas.py").write_text(stand_in)
    monkeypatch.syspath_prepend(tmp_path)
    assert packed(np.array([[5, 7]])).tolist() == [[0, 0]] and not trace.exists()
