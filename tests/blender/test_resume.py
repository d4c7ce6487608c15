"""Kills, crashes and second starts: finished views are kept, unfinished ones are not taken for finished."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from interrupting import heed_signals

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import BlenderError, render_views
from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.cli.stopping import LINE
from bbfit.files import read_json
from bbfit.images import read_rgba

from .conftest import SMALL, box

CONFIG = ViewsConfig(**SMALL)

_RENDER = """
import sys
from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
tree, out, samples, size, limit, workers, hold = sys.argv[1:]
if int(limit):
    import resource
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.RLIM_INFINITY))
def on_progress(done, total):
    print(done, flush=True)
    if done == int(hold):
        sys.stdin.readline()
paths = {"samples": int(samples), "training_samples": int(samples), "denoise": False}
config = ViewsConfig(count=4, size=int(size), elevations=(0.0,), turned=0, render_workers=int(workers), **paths)
render_views(tree, out, config, on_progress=on_progress)
"""


def start(
    tree: Path, out: Path, *, samples: int = 4, size: int = 32, limit: int = 0, workers: int = 1, hold: int = -1
) -> subprocess.Popen[str]:
    """Render views in a process that may be killed; after ``hold`` views it hands over no more, and goes on with a line of input."""
    arguments = [sys.executable, "-c", _RENDER, str(tree), str(out), *map(str, (samples, size, limit, workers, hold))]
    return subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def blenders(parent: int) -> list[int]:
    """The Blender processes that a process has started."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(pid) for pid in children if b"worker.py" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def wait_for_end(process: int) -> None:
    """Wait for a process, which need not be a child of this one, by a descriptor of it."""
    select.select([process], [], [])
    os.close(process)


def times(out: Path) -> dict[str, int]:
    """When each picture was written."""
    return {path.name: path.stat().st_mtime_ns for path in sorted((out / "images").iterdir())}


def assert_same_pictures(out: Path, expected: Path) -> None:
    """Pixel for pixel, and nothing left over."""
    names = [path.name for path in sorted((expected / "images").iterdir())]
    assert [path.name for path in sorted((out / "images").iterdir())] == names
    for name in names:
        np.testing.assert_array_equal(read_rgba(out / "images" / name), read_rgba(expected / "images" / name))
    for name in ("transforms_train.json", "transforms_test.json"):
        assert (out / name).read_bytes() == (expected / name).read_bytes()


def test_killed_in_the_middle_and_started_again(thing_glb: Path, tmp_path: Path) -> None:
    """Blender dies with its parent; only what is missing or cut short is rendered again; pixels are those of an unbroken run."""
    out, config = tmp_path / "views", ViewsConfig(**SMALL | {"samples": 200, "training_samples": 200})
    parent = start(thing_glb, out, samples=200, workers=2, hold=2)
    assert parent.stdout
    for _ in range(3):  # 0, 1, 2 views
        parent.stdout.readline()
    workers = [os.pidfd_open(pid) for pid in blenders(parent.pid)]
    assert len(workers) == 2
    parent.kill()
    parent.communicate()
    for worker in workers:
        wait_for_end(worker)
    assert not (out / "transforms_train.json").exists()
    assert read_json("views", out / "views.json")["complete"] is False

    finished = times(out)
    kept = [name for name in finished if name.endswith("g")]
    assert 2 <= len(kept) < 4
    cut = out / "images" / kept[0]
    cut.write_bytes(cut.read_bytes()[:-20])
    (out / "images/.bbfit-0003.part").write_bytes(b"half a picture")
    progress: list[int] = []
    render_views(thing_glb, out, config, on_progress=lambda done, total: progress.append(done))
    assert progress == list(range(len(kept) - 1, 5))
    later = times(out)
    assert [name for name in kept if later[name] == finished[name]] == kept[1:]
    assert read_json("views", out / "views.json")["complete"] is True
    assert_same_pictures(out, render_views(thing_glb, tmp_path / "unbroken", config))


# The command, which hands over no more after two views.
_COMMAND = """
import sys
import bbfit.blender.views_folder as views_folder
from bbfit.cli import main
render_views = views_folder.render_views
def held(tree, out, config, on_progress):
    def hold(done, total):
        print(done, flush=True)
        if done == 2:
            sys.stdin.readline()
    return render_views(tree, out, config, on_progress=hold)
views_folder.render_views = held
sys.exit(main())
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_stopped_in_the_middle_and_started_again(number: int, code: int, thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    """Blender ends with the command, no temporary folder is left, and the same command goes on."""
    out, temporary = tmp_path / "views", tmp_path / "temporary"
    temporary.mkdir()
    words = ["views", str(thing_glb), "--out", str(out)]
    words += ["--count", "4", "--size", "32", "--samples", "4", "--training-samples", "4", "--no-denoise", "--turned", "0"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = os.environ | {"TMPDIR": str(temporary)}
    command = [sys.executable, "-c", _COMMAND, *words, "--render-workers", "2"]
    parent = subprocess.Popen(command, **pipes, text=True, env=environment, preexec_fn=heed_signals)
    assert parent.stdout
    for _ in range(3):  # 0, 1, 2 views
        parent.stdout.readline()
    workers = [os.pidfd_open(pid) for pid in blenders(parent.pid)]
    assert len(workers) == 2 and list(temporary.iterdir())
    parent.send_signal(number)
    _, said = parent.communicate()
    assert (parent.returncode, said) == (code, f"{LINE}\n")
    for worker in workers:
        assert select.select([worker], [], [], 0)[0]  # it has ended
        os.close(worker)
    assert not list(temporary.iterdir())
    finished = {name: time for name, time in times(out).items() if name.endswith("g")}
    assert main(words) == 0
    assert times(out) == times(out) | finished
    assert_same_pictures(out, unbroken)


@pytest.mark.usefixtures("broken_blender")
def test_finished_folder_needs_no_blender(thing_glb: Path, unbroken: Path) -> None:
    before, progress = times(unbroken), []
    render_views(thing_glb, unbroken, CONFIG, on_progress=lambda done, total: progress.append((done, total)))
    assert progress == [(4, 4)] and times(unbroken) == before


def test_two_workers_make_no_difference(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    out = render_views(thing_glb, tmp_path / "views", ViewsConfig(**SMALL | {"render_workers": 2}))
    assert_same_pictures(out, unbroken)
    render_views(thing_glb, out, ViewsConfig(**SMALL | {"render_workers": 3, "render_device": "cuda"}))  # all stands, so none is asked for


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size": 64}, "size 32, not 64"),
        ({"elevations": (0.0, 20.0)}, "elevations 0, not 0 20"),
        ({"seed": 7}, "seed 0, not 7"),
        ({"orthographic": True}, "orthographic False, not True"),
        ({"hdri": "sky"}, "hdri None, not sky.hdr"),
    ],
)
def test_other_settings_are_refused(thing_glb: Path, unbroken: Path, tmp_path: Path, change: dict[str, Any], said: str) -> None:
    if "hdri" in change:
        change = {"hdri": tmp_path / "sky.hdr"}
        change["hdri"].write_bytes(b"not looked into")
    before = times(unbroken), (unbroken / "views.json").read_bytes()
    with pytest.raises(InputError, match=f"{said}; choose another output folder, or remove"):
        render_views(thing_glb, unbroken, ViewsConfig(**SMALL | change))
    assert (times(unbroken), (unbroken / "views.json").read_bytes()) == before


def test_another_tree_is_refused(unbroken: Path, tmp_path: Path) -> None:
    for name, said in (("other.glb", "another tree, thing.glb"), ("thing.glb", "an earlier version of thing.glb")):
        trimesh.Scene([box((0, 0, 0), (1, 1, 1), (9, 9, 9))]).export(str(tmp_path / name))
        with pytest.raises(InputError, match=said):
            render_views(tmp_path / name, unbroken, CONFIG)


def test_folder_with_other_content_is_refused(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    views = tmp_path / "views"
    shutil.copytree(unbroken, views)
    (views / "views.json").unlink()
    with pytest.raises(InputError, match="views from elsewhere"):
        render_views(thing_glb, views, CONFIG)
    (views / "transforms_train.json").unlink()
    (views / "transforms_test.json").unlink()
    with pytest.raises(InputError, match="views from elsewhere"):
        render_views(thing_glb, views, CONFIG)
    (views / "views.json").write_text("[]")
    with pytest.raises(InputError, match="was not written by bbfit"):
        render_views(thing_glb, views, CONFIG)
    (views / "views.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        render_views(thing_glb, views, CONFIG)
    with pytest.raises(InputError, match="is a file, not a folder"):
        render_views(thing_glb, views / "views.json", CONFIG)


def killing(progress: list[int], last: int) -> Callable[[int, int], None]:
    """Kill Blender after each of the first ``last`` views, before it is handed another."""

    def on_progress(done: int, total: int) -> None:
        progress.append(done)
        if 1 <= done <= last:
            (pid,) = blenders(os.getpid())
            process = os.pidfd_open(pid)
            os.kill(pid, signal.SIGKILL)
            wait_for_end(process)

    return on_progress


def test_crashed_worker_is_replaced(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    progress: list[int] = []
    out = render_views(thing_glb, tmp_path / "views", CONFIG, on_progress=killing(progress, 2))
    assert progress == [0, 1, 2, 3, 4]
    assert_same_pictures(out, unbroken)


def test_blender_that_crashes_again_and_again(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    """It is said at which frame and what is kept; and the next start goes on from there."""
    out = tmp_path / "views"
    with pytest.raises(BlenderError, match=r"crashed 3 times, last at 0003\.png \(signal 9.*3 of 4 views are finished and kept"):
        render_views(thing_glb, out, CONFIG, on_progress=killing([], 3))
    assert len(times(out)) == 3 and not (out / "transforms_train.json").exists()
    progress: list[int] = []
    render_views(thing_glb, out, CONFIG, on_progress=lambda done, total: progress.append(done))
    assert progress == [3, 4]
    assert_same_pictures(out, unbroken)


@pytest.mark.usefixtures("broken_blender")
def test_crash_while_reading(thing_glb: Path, tmp_path: Path) -> None:
    with pytest.raises(BlenderError, match=r"crashed while reading .*thing\.glb \(signal 6; its last output: out of luck\)"):
        render_views(thing_glb, tmp_path / "views", CONFIG)
    assert not (tmp_path / "views").exists()


def test_full_disk_is_told_and_survived(thing_glb: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands in for the full disk: it lets views.json pass and cuts the pictures."""
    out, limit = tmp_path / "views", 2500
    parent = start(thing_glb, out, samples=1, size=96, limit=limit)
    _, said = parent.communicate()
    assert parent.returncode == 1
    assert re.search(r"InputError: views: .*0000\.png could not be .*; free the disk .*then start again", said), said
    assert not list((out / "images").glob("[0-9]*")) and not (out / "transforms_train.json").exists()
    again = start(thing_glb, out, samples=1, size=96)
    again.communicate()
    assert again.returncode == 0
    assert min(path.stat().st_size for path in (out / "images").iterdir()) > limit
    assert len(list((out / "images").iterdir())) == 4


def test_picture_that_cannot_be_put_in_its_place(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    out = tmp_path / "views"
    shutil.copytree(unbroken, out)
    (out / "images/0001.png").unlink()
    (out / "images/0001.png/in the way").mkdir(parents=True)
    with pytest.raises(InputError, match=r"0001\.png could not be written \(Is a directory\); free the disk or make"):
        render_views(thing_glb, out, CONFIG)
