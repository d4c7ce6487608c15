"""Output folders: one process at a time, and nothing of the user is replaced."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bbfit.checks import InputError
from bbfit.outputs import LOCK_FILE, WRITTEN_FILE, Written, claimed_folder, output_folder, single_files, used_folder

# Claims the folder of its argument, says so, and keeps it until its standard input ends.
HOLDER = """
import sys
from bbfit.outputs import claimed_folder
with claimed_folder("out", sys.argv[1]) as folder:
    print("claimed", flush=True)
    sys.stdin.read()
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_output_folder_is_made(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    assert output_folder("out", str(folder)) == folder and folder.is_dir()
    (folder / "old.txt").write_text("kept")
    output_folder("out", folder)
    assert names(folder) == ["old.txt"]


def test_an_output_folder_that_is_a_file_or_within_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file", tmp_path / "file" / "a", tmp_path / "file" / "a" / "b"):
        with pytest.raises(InputError, match=r"^out: .*choose another output folder"):
            output_folder("out", path)
    assert (tmp_path / "file").read_text() == "x"


def test_an_output_folder_that_cannot_be_written_to_is_refused() -> None:
    """The system's own folder of processes holds no files of ours."""
    with pytest.raises(InputError, match=r"^out: .* cannot be written to \(.*\); choose"):
        output_folder("out", "/proc")


def test_a_folder_that_stays_empty_is_removed_with_the_parents_that_were_made_for_it(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for use in (used_folder, claimed_folder):
        with pytest.raises(InputError, match="refused"), use("out", tmp_path / "mine" / "a" / "b"):
            raise InputError("refused")
        assert names(tmp_path / "mine") == []
        with use("out", tmp_path / "mine"):
            pass
        assert (tmp_path / "mine").is_dir()
    with claimed_folder("out", tmp_path / "a" / "b") as folder:
        (folder / "cloud").write_text("kept")
        (folder / "empty" / "inside").mkdir(parents=True)
    assert names(tmp_path / "a" / "b") == ["cloud"]


@pytest.mark.parametrize("killed", [True, False])
def test_another_process_is_refused_by_its_name_until_it_ends_or_is_killed(tmp_path: Path, killed: bool) -> None:
    folder = tmp_path / "run"
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdin and holder.stdout and holder.stdout.readline() == b"claimed\n"
    (folder / ".bbfit-1.part").write_bytes(b"of the other process")
    with pytest.raises(InputError, match=rf"^out: .*run is in use by process {holder.pid} on .* since .* \(-c .*\); wait"):
        with claimed_folder("out", folder):
            pass
    assert (folder / ".bbfit-1.part").exists()
    if killed:
        holder.kill()
    else:
        holder.stdin.close()
    holder.wait()
    holder.stdin.close()
    holder.stdout.close()
    with claimed_folder("out", folder):
        assert names(folder) == [LOCK_FILE]
        assert json.loads((folder / LOCK_FILE).read_text())["pid"] == os.getpid()
    assert not (folder / LOCK_FILE).exists()


def test_a_folder_is_claimed_once_in_a_process(tmp_path: Path) -> None:
    with claimed_folder("out", tmp_path), pytest.raises(InputError, match=f"in use by process {os.getpid()}"):
        with claimed_folder("out", tmp_path):
            pass


@pytest.mark.parametrize("damage", [None, "", "[]", '{"written": 3}', '{"written": {"tree.glb": 1}}', '{"begun": {"grow": 1}}'])
def test_a_file_of_the_user_is_never_replaced(tmp_path: Path, damage: str | None) -> None:
    (tmp_path / "tree.glb").write_text("mine")
    if damage is not None:
        (tmp_path / WRITTEN_FILE).write_text(damage)
    before = names(tmp_path)
    with pytest.raises(InputError, match=r"^out: .*tree\.glb exists, and is a file that bbfit did not write; move it away"):
        Written(tmp_path).begin("grow", ["tree.glb"])
    assert (tmp_path / "tree.glb").read_text() == "mine" and names(tmp_path) == before


def test_a_file_is_replaced_by_what_wrote_it_alone(tmp_path: Path) -> None:
    for text in ("first", "second"):
        with single_files("bbfit grow", tmp_path, ["tree.glb"]):
            (tmp_path / "tree.glb").write_text(text)
    with pytest.raises(InputError, match=r"tree\.glb exists, and is a file that bbfit wrote by another step \(bbfit grow\)"):
        Written(tmp_path).begin("evaluate", ["tree.glb"])
    (tmp_path / "tree.glb").write_text("edited")
    with pytest.raises(InputError, match=r"tree\.glb has changed since bbfit wrote it"), single_files("bbfit grow", tmp_path, ["tree.glb"]):
        pass
    assert (tmp_path / "tree.glb").read_text() == "edited" and names(tmp_path) == [WRITTEN_FILE, "tree.glb"]


def test_a_result_that_was_changed_is_kept_under_another_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for text in ("first", "second", "third"):
        written = Written(tmp_path)
        written.begin("fit", ["a.txt", "b*.txt"])
        (tmp_path / "a.txt").write_text("result")
        (tmp_path / "b1.txt").write_text("result")
        written.finish("fit", written.digests(["a.txt", "b*.txt"]))
        (tmp_path / "a.txt").write_text(f"edited {text}")
    assert [path.read_text() for path in sorted(tmp_path.glob("a.txt*"))] == ["edited third", "edited first", "edited second"]
    assert "a.txt has changed since bbfit wrote it; it is now a.txt.changed" in caplog.text and "b1" not in caplog.text


def test_a_name_in_brackets_is_no_pattern(tmp_path: Path) -> None:
    Written(tmp_path).begin("lod", ["oak [1].glb"])
    (tmp_path / "oak [1].glb").write_text("half done")
    (tmp_path / "oak 1.glb").write_text("mine")
    Written(tmp_path).begin("lod", ["oak [1].glb"])
    with pytest.raises(InputError, match=r"oak 1\.glb exists"):
        Written(tmp_path).begin("lod", ["oak 1.glb"])


def test_what_was_begun_and_killed_may_be_replaced(tmp_path: Path) -> None:
    Written(tmp_path).begin("fit", ["cloud", "mip*.png"])
    (tmp_path / "cloud").write_text("half done")
    (tmp_path / "mip1.png").write_text("half done")
    (tmp_path / "model").write_text("mine")
    Written(tmp_path).begin("fit", ["cloud", "mip*.png"])
    assert names(tmp_path) == [WRITTEN_FILE, "cloud", "mip1.png", "model"]
    with pytest.raises(InputError, match="model exists"):
        Written(tmp_path).begin("fit", ["cloud", "model"])
    with pytest.raises(InputError, match="cloud exists"):
        Written(tmp_path).begin("export", ["cloud"])


@pytest.mark.parametrize("link", [False, True])
def test_an_input_is_not_replaced_even_if_bbfit_wrote_it(tmp_path: Path, link: bool) -> None:
    with single_files("lod", tmp_path, ["tree.glb"]):
        (tmp_path / "tree.glb").write_text("tree")
    given = tmp_path / "link.glb" if link else tmp_path / "tree.glb"
    if link:
        given.symlink_to("tree.glb")
    with pytest.raises(InputError, match=r"^out: .*tree\.glb is an input, which the results would replace"):
        Written(tmp_path).check("lod", ["tree.glb"], [given, tmp_path / "missing"])


def test_a_refused_command_leaves_no_list_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError), single_files("bbfit grow", tmp_path, ["tree.glb"]):
        raise InputError("refused")
    assert names(tmp_path) == []
