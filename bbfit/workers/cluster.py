"""Run tasks on a Ray cluster, whose machines need not share a disk.

Each input is put into Ray's object store once, and each machine fetches it once. The output files return through the object store to the
machine that submitted the tasks, which writes them. bbfit must be installed on all machines.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bbfit.checks import fail, in_words
from bbfit.files import write_bytes
from bbfit.outputs import output_folder
from bbfit.scratch import ScratchFolder
from bbfit.workers.config import WorkersConfig
from bbfit.workers.tasks import Outcome, Task, attempt

Files = dict[str, bytes]
"""The contents of files by their paths relative to a folder."""
# Without these options, Ray prints hints.
_QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
# The color codes in Ray's messages.
_COLORS = re.compile("\x1b\\[[0-9;]*m")


class RayWorkers:
    """All machines of a Ray cluster. Raises ``InputError`` if Ray is not installed or, on entering the context, if no cluster answers.

    If the process or the machine of a task dies, Ray repeats the task up to ``config.retries`` times.
    """

    def __init__(self, config: WorkersConfig) -> None:
        try:
            import ray
        except ImportError:
            fail("ray", "it is not installed", 'install bbfit with its extra, pip install "bbfit[cluster]", or omit --ray')
        self._ray, self._config = ray, config
        self._references: dict[tuple[Path, ...], Any] = {}
        self._running: dict[Any, Task] = {}
        self._started = False

    def __enter__(self) -> RayWorkers:
        ray, address = self._ray, self._config.ray or "local"
        _check_address(address)
        if not ray.is_initialized():
            try:
                with _same_handlers():
                    if address == "local":  # without an address, Ray would join a cluster of this machine, if it finds one
                        ray.init("local", include_dashboard=False, **_QUIET)
                    else:
                        ray.init(address, **_QUIET)
            except (ConnectionError, ValueError, RuntimeError) as error:
                fail(
                    "ray",
                    f"no cluster answers at {address} ({' '.join(str(error).split())[:200]})",
                    "start one with ray start, or use local",
                )
            self._started = True
        self._smallest_machine = int(min((node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]), default=0))
        return self

    def __exit__(self, *_: object) -> None:
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        if self._started:
            self._ray.shutdown()

    def submit(self, task: Task) -> None:
        """Run a task as soon as the cluster has room. The errors of :func:`read_files` are raised."""
        contents = [self._reference(paths) for paths in task.inputs.values()]
        main_files = {name: paths[0].name if paths[0].is_file() else "" for name, paths in task.inputs.items()}
        cores = max(self._config.cpus, self._smallest_machine) if task.alone else self._config.cpus
        remote = self._ray.remote(_run_remotely).options(
            num_cpus=cores,
            num_gpus=self._config.gpus,
            memory=self._config.memory_bytes,
            max_retries=self._config.retries,
            scheduling_strategy="SPREAD",
        )
        self._running[remote.remote(replace(task, inputs={}, folder=Path()), cores, main_files, *contents)] = task

    def next(self) -> tuple[Task, Outcome]:
        """Wait until a task ends. At least one submitted task must be unfinished."""
        (reference,), _ = self._ray.wait(list(self._running), num_returns=1)
        task = self._running.pop(reference)
        try:
            outcome, files = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            message = " ".join(_COLORS.sub("", str(error)).split())
            return task, Outcome(None, f"{type(error).__name__}: {message[:300]}", "a lost node of the cluster")
        write_files(files, task.folder)
        return task, outcome

    def _reference(self, paths: tuple[Path, ...]) -> Any:
        """The reference to files in the object store, which are put there on the first call."""
        if paths not in self._references:
            self._references[paths] = self._ray.put(read_files(*paths))
        return self._references[paths]


@contextmanager
def _same_handlers() -> Iterator[None]:
    """Keep the handlers of signals. Ray's own one for SIGTERM prints a stack trace and ends the process."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                if callable(handler):
                    signal.signal(number, handler)


def _check_address(address: str) -> None:
    """Require that a server listens at an address. Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal()):
        return  # auto, local, or another name that Ray knows
    try:
        socket.create_connection((host.rpartition("/")[2], int(port)), timeout=10).close()
    except (OSError, UnicodeError, OverflowError) as error:
        reason = in_words(error) if isinstance(error, OSError) else "it is not an address"
        fail("ray", f"no cluster answers at {address} ({reason})", "start one with ray start, or use local")


def read_files(*paths: Path) -> Files:
    """Read all files of a folder, or a tuple of files. Raises ``InputError`` if one of them lies outside the folder of the first."""
    if paths[0].is_dir():
        folder, paths = paths[0], tuple(sorted(file for file in paths[0].rglob("*") if file.is_file()))
    else:
        folder = paths[0].parent
    names = {Path(os.path.relpath(path, folder)).as_posix(): path for path in paths}
    for name, path in names.items():
        if name.startswith("../"):
            fail("ray", f"{path} lies outside {folder}", "put all files of a tree into one folder")
    return {name: path.read_bytes() for name, path in names.items()}


def write_files(files: Files, folder: Path) -> None:
    """Write files into a folder in their order, each atomically."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)


def _run_remotely(task: Task, cores: int, main_files: dict[str, str], *contents: Files) -> tuple[Outcome, Files]:
    """Run a task on a machine of the cluster. Return the output files too if the task succeeded."""
    import ray
    import torch

    torch.set_num_threads(cores)
    with ScratchFolder() as scratch:
        inputs = {}
        for (name, main_file), files in zip(main_files.items(), contents, strict=True):
            folder = scratch / name
            write_files(files, folder)
            inputs[name] = folder / main_file
        out = output_folder("out", scratch / "out")
        where = f"node {ray.get_runtime_context().get_node_id()}"
        outcome = attempt(partial(task.work, inputs, out, *task.arguments), where)
        return outcome, read_files(out) if outcome.reason is None else {}
