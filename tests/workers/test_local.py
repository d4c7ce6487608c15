"""Tasks in processes of their own: what they return, what they leave behind, and what happens when they die."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import gated_work

from bbfit.outputs import claimed_folder
from bbfit.workers.local import LocalWorkers
from bbfit.workers.tasks import Outcome, Task, Work


def carried_out(workers: LocalWorkers, tasks: list[Task]) -> dict[str, Outcome]:
    for task in tasks:
        workers.submit(task)
    return {task.name: outcome for task, outcome in (workers.next() for _ in tasks)}


def task(name: str, work: Work, folder: Path, *arguments: object, alone: bool = False) -> Task:
    return Task(name, work, {}, folder, arguments, alone)


def test_tasks_read_and_write_where_they_are_told_to(tmp_path: Path) -> None:
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "a.txt").write_text("1")
    (tmp_path / "views" / "b.txt").write_text("2")
    (tmp_path / "tree.txt").write_text("3")
    inputs = {"views": (tmp_path / "views",), "tree": (tmp_path / "tree.txt",)}
    with LocalWorkers(2) as workers:
        tasks = [Task(name, gated_work.copy, inputs, tmp_path / name, (str(tmp_path), name)) for name in ("x", "y", "z")]
        outcomes = carried_out(workers, tasks)
    for name in ("x", "y", "z"):
        assert outcomes[name].facts == {"name": name, "files": 3} and outcomes[name].reason is None
        assert (tmp_path / name / "sub" / "copy.txt").read_text() == "tree tree.txt 3\nviews a.txt 1\nviews b.txt 2"


def test_a_failure_is_recorded_and_the_rest_goes_on(tmp_path: Path) -> None:
    with LocalWorkers(1) as workers:
        tasks = [
            task("fault", gated_work.fault, tmp_path),
            task("bad", gated_work.bad_input, tmp_path),
            task("good", gated_work.copy, tmp_path / "good", str(tmp_path), "good"),
        ]
        outcomes = carried_out(workers, tasks)
    assert outcomes["good"].facts == {"name": "good", "files": 0}
    assert outcomes["fault"].reason == "ZeroDivisionError: a fault of ours" and "gated_work.py" in (outcomes["fault"].trace or "")
    assert outcomes["bad"].reason == "leaf.png cannot be used (No such file)" and outcomes["bad"].trace is None


def test_a_process_that_dies_costs_its_own_task_only(tmp_path: Path) -> None:
    """Killed twice a task is tried a third time; killed thrice it counts as failed."""
    marks = str(tmp_path)
    with LocalWorkers(2, retries=2) as workers:
        tasks = [
            task("hardy", gated_work.die, tmp_path, marks, "hardy", 2),
            task("doomed", gated_work.die, tmp_path, marks, "doomed", 99),
            *(task(name, gated_work.copy, tmp_path / name, marks, name) for name in ("a", "b", "c")),
        ]
        outcomes = carried_out(workers, tasks)
    assert outcomes["hardy"].facts == {"name": "hardy"}
    assert outcomes["doomed"].reason == "its process died 3 times, last by SIGKILL"
    assert all(outcomes[name].reason is None for name in ("a", "b", "c"))
    assert gated_work.begun(tmp_path) == ["a", "b", "c", *["doomed"] * 3, *["hardy"] * 3]


def test_tasks_that_want_a_machine_to_themselves_run_alone(tmp_path: Path) -> None:
    """The one behind it begins when it has ended."""
    marks, gate = str(tmp_path), tmp_path / "gate"
    with LocalWorkers(2) as workers, gated_work.watched(tmp_path) as began:
        with gated_work.closed(gate):
            workers.submit(task("first", gated_work.copy, tmp_path / "first", marks, "first", str(gate), alone=True))
            workers.submit(task("second", gated_work.copy, tmp_path / "second", marks, "second"))
            assert next(began)[0] == "first" and gated_work.begun(tmp_path) == ["first"]
        ended, _ = workers.next()
        assert ended.name == "first" and gated_work.begun(tmp_path) == ["first"]
        assert workers.next()[0].name == "second"


def test_processes_end_with_their_parent(tmp_path: Path) -> None:
    """Even when it is killed, in the middle of a task."""
    script = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
import gated_work
from bbfit.workers.local import LocalWorkers
from bbfit.workers.tasks import Task
if __name__ == "__main__":
    with LocalWorkers(1) as workers:
        workers.submit(Task("nap", gated_work.copy, {{}}, Path({str(tmp_path)!r}), ({str(tmp_path)!r}, "nap", {str(tmp_path / "gate")!r})))
        workers.next()
"""
    (tmp_path / "parent.py").write_text(script)
    with gated_work.watched(tmp_path) as began, gated_work.closed(tmp_path / "gate"):
        with subprocess.Popen([sys.executable, str(tmp_path / "parent.py")]) as parent:
            _, child = next(began)
            process = os.pidfd_open(child)
            parent.send_signal(signal.SIGKILL)
        select.select([process], [], [])  # until it has ended
        os.close(process)


def test_a_task_waits_until_a_killed_sweep_has_left_its_folder(tmp_path: Path) -> None:
    with LocalWorkers(1) as workers:
        assert carried_out(workers, [task("warm", gated_work.claim, tmp_path / "warm")])["warm"].reason is None
        with claimed_folder("out", tmp_path / "run"):
            workers.submit(task("again", gated_work.claim, tmp_path / "run"))
            time.sleep(0.5)  # in which the task would be refused
        _, outcome = workers.next()
    assert outcome.reason is None and outcome.facts == {"name": "run"}


def test_leaving_ends_what_still_runs(tmp_path: Path) -> None:
    with gated_work.watched(tmp_path) as began, gated_work.closed(tmp_path / "gate"):
        with LocalWorkers(1) as workers:
            workers.submit(task("nap", gated_work.copy, tmp_path / "nap", str(tmp_path), "nap", str(tmp_path / "gate")))
            _, child = next(began)
            assert Path(f"/proc/{child}").exists()
        assert not Path(f"/proc/{child}").exists()
