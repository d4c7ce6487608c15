"""Tasks on a Ray cluster, whose machines need not share a disk.

What tasks read is put into Ray's object store once, and fetched by each machine once; what they write comes back through it and is put in
its place by the machine that started the sweep. bbfit has to be installed on all machines.
"""

from __future__ import annotations

import re
import socket
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bbfit.checks import fail
from bbfit.files import output_folder, write_bytes
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.tasks import Outcome, Task, attempt

Files = dict[str, bytes]
"""Contents of a folder's files by their paths in it, or of one file by its name."""
# Started without them, Ray would ask for the home of its dashboard and print hints.
_QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "include_dashboard": False}


_COLORS = re.compile("\x1b\\[[0-9;]*m")  # Ray's messages are made for terminals


class RayWorkers:
    """All machines of a Ray cluster.

    Ray starts a task again, up to ``config.retries`` times, whose process or machine dies.
    """

    def __init__(self, config: SweepConfig) -> None:
        try:
            import ray
        except ImportError:
            fail("ray", "it is not installed", 'install bbfit with its extra, pip install "bbfit[cluster]", or leave out --ray')
        self._ray, self._config = ray, config
        self._put: dict[tuple[Path, ...], Any] = {}
        self._running: dict[Any, Task] = {}
        self._started = False

    def __enter__(self) -> RayWorkers:
        ray, address = self._ray, self._config.ray or "local"
        _check_answer(address)
        if not ray.is_initialized():
            try:
                if address == "local":
                    ray.init(**_QUIET)
                else:
                    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
            except (ConnectionError, ValueError, RuntimeError) as error:
                fail(
                    "ray",
                    f"no cluster answers at {address} ({' '.join(str(error).split())[:200]})",
                    "start one with ray start, or say local",
                )
            self._started = True
        self._machine = int(min((node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]), default=0))
        return self

    def __exit__(self, *_: object) -> None:
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        if self._started:
            self._ray.shutdown()

    def submit(self, task: Task) -> None:
        """See :class:`~bbfit.sweep.tasks.Workers`."""
        contents = [self._shared(paths) for paths in task.inputs.values()]
        named = {name: paths[0].name if paths[0].is_file() else "" for name, paths in task.inputs.items()}
        cores = max(self._config.cpus, self._machine) if task.alone else self._config.cpus
        remote = self._ray.remote(_carry_out).options(
            num_cpus=cores,
            num_gpus=self._config.gpus,
            memory=self._config.memory_bytes,
            max_retries=self._config.retries,
            scheduling_strategy="SPREAD",
        )
        self._running[remote.remote(replace(task, inputs={}, folder=Path()), cores, named, *contents)] = task

    def next(self) -> tuple[Task, Outcome]:
        """See :class:`~bbfit.sweep.tasks.Workers`."""
        (reference,), _ = self._ray.wait(list(self._running), num_returns=1)
        task = self._running.pop(reference)
        try:
            outcome, files = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            told = " ".join(_COLORS.sub("", str(error)).split())
            return task, Outcome(None, f"{type(error).__name__}: {told[:300]}", "a node of the cluster that is gone")
        place_files(files, task.folder)
        return task, outcome

    def _shared(self, paths: tuple[Path, ...]) -> Any:
        """Reference to files in the object store, put there when it is first asked for."""
        if paths not in self._put:
            self._put[paths] = self._ray.put(read_files(*paths))
        return self._put[paths]


def _check_answer(address: str) -> None:
    """Refuse an address where nobody listens; Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal()):
        return  # auto, local, or a name that Ray knows
    try:
        socket.create_connection((host.rpartition("/")[2], int(port)), timeout=10).close()
    except OSError as error:
        fail("ray", f"no cluster answers at {address} ({error.strerror or error})", "start one with ray start, or say local")


def read_files(*paths: Path) -> Files:
    """All files of a folder, or some files of which the first lies in the folder that the others are in or below."""
    if paths[0].is_dir():
        folder, paths = paths[0], tuple(sorted(file for file in paths[0].rglob("*") if file.is_file()))
    else:
        folder = paths[0].parent
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def place_files(files: Files, folder: Path) -> None:
    """Write files into a folder, each completely or not at all, in their order."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)


def _carry_out(task: Task, cores: int, named: dict[str, str], *contents: Files) -> tuple[Outcome, Files]:
    """What a machine of the cluster does; returns what was written if it came to an end."""
    import ray
    import torch

    torch.set_num_threads(cores)
    with tempfile.TemporaryDirectory(prefix="bbfit-") as scratch:
        inputs = {}
        for (name, first), files in zip(named.items(), contents, strict=True):
            folder = Path(scratch) / name
            place_files(files, folder)
            inputs[name] = folder / first
        out = output_folder("out", Path(scratch) / "out")
        where = f"node {ray.get_runtime_context().get_node_id()}"
        outcome = attempt(partial(task.work, inputs, out, *task.arguments), where)
        return outcome, read_files(out) if outcome.reason is None else {}
