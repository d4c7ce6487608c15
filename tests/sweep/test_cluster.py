"""Sweeps on Ray: a cluster of two nodes with one core each on this machine, of which one is killed in the middle."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import gated_work
import pytest
import ray
from billboard_scene import crossing_billboards, write_views
from one_at_a_time import one_at_a_time
from ray.cluster_utils import Cluster

from bbfit.blender.config import ViewsConfig
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.scheduling import SweepResult, run_sweep
from bbfit.trees.config import GrowConfig
from bbfit.workers.cluster import RayWorkers
from bbfit.workers.tasks import Task

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
# Ray leaves sockets to the garbage collector, and warns of its own coming changes.
pytestmark = [pytest.mark.filterwarnings("ignore::ResourceWarning"), pytest.mark.filterwarnings("ignore::FutureWarning")]


@pytest.fixture(scope="module")
def head() -> Iterator[Cluster]:
    """A node with one core."""
    with one_at_a_time("ray"), pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))  # so that nodes can import the work of these tests
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        yield made
        ray.shutdown()
        made.shutdown()


@pytest.fixture
def cluster(head: Cluster) -> Iterator[Cluster]:
    """The head alone; the tests add the node that they kill."""
    yield head
    ray.shutdown()
    for node in list(head.worker_nodes):
        head.remove_node(node)


def test_a_node_that_is_killed_costs_only_what_it_was_running(cluster: Cluster, tmp_path: Path) -> None:
    """Some tasks are finished, two run, one on each node's core, and more wait when the second node is killed."""
    node = cluster.add_node(num_cpus=1)
    marks, inputs, gate = tmp_path / "marks", tmp_path / "views", tmp_path / "gate"
    marks.mkdir()
    (inputs / "images").mkdir(parents=True)
    (inputs / "images" / "a.txt").write_text("1")
    early, late = [f"early{number}" for number in range(4)], [f"late{number}" for number in range(6)]
    with RayWorkers(SweepConfig(ray=cluster.address)) as workers, gated_work.watched(marks) as starts:

        def submit(name: str, *gates: str) -> None:
            workers.submit(Task(name, gated_work.copy, {"views": (inputs,)}, tmp_path / "out" / name, (str(marks), name, *gates)))

        for name in early:
            submit(name)
        outcomes = {task.name: outcome for task, outcome in (workers.next() for _ in early)}
        # What all tasks read is put into the object store once: the late ones see what the early ones saw.
        (inputs / "images" / "a.txt").write_text("2")
        with gated_work.closed(gate):
            for name in late:
                submit(name, str(gate))
            for _ in range(len(early) + 2):
                next(starts)
            cluster.remove_node(node, allow_graceful=False)
        outcomes |= {task.name: outcome for task, outcome in (workers.next() for _ in late)}
    assert all(outcome.reason is None for outcome in outcomes.values())
    began = Counter(gated_work.begun(marks))
    assert began.keys() == {*early, *late}
    assert all(began[name] == 1 for name in early), "what was finished is not done again"
    assert sum(began[name] for name in late) == len(late) + 1, "one task was running on the killed node, and began again"
    assert len({outcomes[name].where for name in late}) == 1
    for name in outcomes:
        assert (tmp_path / "out" / name / "sub" / "copy.txt").read_text() == "views a.txt 1"


def test_a_sweep_on_a_cluster_is_the_sweep_on_one_machine(cluster: Cluster, tmp_path: Path) -> None:
    """Fits, with one node killed after the first result; then nothing is left to do, and this machine finds the same."""
    node = cluster.add_node(num_cpus=1)
    (tmp_path / "oak").mkdir()
    write_views(tmp_path / "oak", crossing_billboards(), count=6)
    config = {"loss": ("l2",), "billboards": (2, 3, 4), "variants": ("base",)}

    def kill(stage: str, done: int, total: int, note: str = "") -> None:
        if stage == "runs" and done == 1 and node in cluster.list_all_nodes():
            cluster.remove_node(node, allow_graceful=False)

    short, on_ray = RunConfig(fit=FitConfig(steps=12)), SweepConfig(ray=cluster.address, **config)
    there = run_sweep(tmp_path / "ray", on_ray, short, views=[tmp_path / "oak"], on_progress=kill)
    assert node not in cluster.list_all_nodes() and [row.reason for row in there.rows] == [None] * 3
    results = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ray" / "results").iterdir()}
    assert run_sweep(tmp_path / "ray", on_ray, short, views=[tmp_path / "oak"]).kept == 3
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ray" / "results").iterdir()} == results
    here = run_sweep(tmp_path / "here", SweepConfig(workers=1, **config), short, views=[tmp_path / "oak"])
    for one, other in zip(there.rows, here.rows, strict=True):
        assert one.folder == other.folder and one.facts and other.facts
        assert one.facts["report"]["over"] == other.facts["report"]["over"]
        made = tmp_path / "ray" / one.folder
        assert (made / "model.glb").read_bytes() == (tmp_path / "here" / other.folder / "model.glb").read_bytes()
        assert {path.name for path in made.iterdir()} == {path.name for path in (tmp_path / "here" / other.folder).iterdir()}


def test_trees_are_rendered_on_the_cluster_and_their_views_come_back(cluster: Cluster, tmp_path: Path) -> None:
    """A file and a species, each with four views and a second picture of the held-out one; started again, neither is rendered again."""
    assert cluster.address
    views = ViewsConfig(count=4, size=48, samples=1, denoise=False)
    grown = GrowConfig(detail=0.1, leaves=0.02)
    stages = RunConfig(grow=grown, views=views, fit=FitConfig(billboards=2, candidates=1, refinement_rounds=0, steps=4))
    config = SweepConfig(grid="default", ray=cluster.address)

    def sweep() -> SweepResult:
        return run_sweep(tmp_path, config, stages, species=["acer"], trees=[TREE])

    first = sweep()
    assert [(row.tree, row.reason) for row in first.rows] == [("acer", None), ("tree", None)]
    pictures = {path: path.stat().st_mtime_ns for path in (tmp_path / "trees").rglob("images/*.png")}
    assert len(pictures) == 10 and (tmp_path / "trees" / "acer" / "tree.glb").is_file()
    assert all((tmp_path / row.folder / "model.glb").is_file() for row in first.rows)
    again = sweep()
    assert again.kept == 2 and pictures == {path: path.stat().st_mtime_ns for path in (tmp_path / "trees").rglob("images/*.png")}


def test_local_workers_do_not_join_a_running_cluster(cluster: Cluster) -> None:
    with RayWorkers(SweepConfig(ray="local")):
        assert ray.get_runtime_context().gcs_address != cluster.address


def test_failures_on_a_cluster_are_recorded(cluster: Cluster, tmp_path: Path) -> None:
    """Bad input, a fault, and a process that kills itself more often than it is started again."""
    marks = tmp_path / "marks"
    marks.mkdir()
    config = SweepConfig(ray=cluster.address, retries=1)
    with RayWorkers(config) as workers:
        tasks = [
            Task("bad", gated_work.bad_input, {}, tmp_path / "bad"),
            Task("fault", gated_work.fault, {}, tmp_path / "fault"),
            Task("doomed", gated_work.die, {}, tmp_path / "doomed", (str(marks), "doomed", 99)),
            Task("hardy", gated_work.die, {}, tmp_path / "hardy", (str(marks), "hardy", 1)),
        ]
        for task in tasks:
            workers.submit(task)
        outcomes = {task.name: outcome for task, outcome in (workers.next() for _ in tasks)}
    assert outcomes["bad"].reason == "leaf.png cannot be used (No such file)"
    assert outcomes["fault"].reason == "ZeroDivisionError: a fault of ours"
    assert outcomes["doomed"].facts is None and "WorkerCrashedError" in str(outcomes["doomed"].reason)
    assert outcomes["hardy"].facts == {"name": "hardy"}
    assert gated_work.begun(marks) == ["doomed", "doomed", "hardy", "hardy"]


def test_tasks_ask_for_what_was_declared(cluster: Cluster, tmp_path: Path) -> None:
    """What no node has is waited for; a task that wants a machine to itself asks for all cores of the smallest."""
    cluster.add_node(num_cpus=3)
    with RayWorkers(SweepConfig(ray=cluster.address, cpus=2, memory="50M")) as workers:
        task = Task("nap", gated_work.copy, {}, tmp_path, (str(tmp_path), "nap", str(tmp_path / "gate")))
        with gated_work.watched(tmp_path) as starts, gated_work.closed(tmp_path / "gate"):
            workers.submit(task)
            next(starts)
            while ray.available_resources().get("CPU") != 2:  # which nodes report at intervals
                time.sleep(0.05)
            assert ray.cluster_resources()["memory"] - ray.available_resources()["memory"] == 50_000_000
        assert workers.next()[1].reason is None
