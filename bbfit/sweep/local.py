"""Run tasks in processes on this machine. A process that dies affects only its own task."""

from __future__ import annotations

import collections
import multiprocessing
import os
import platform
import signal
import threading
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from bbfit.sweep.tasks import Outcome, Task, attempt

# A fork of a process that has used torch can hang. Workers are forks of a server that only imports, or new processes on Windows.
_CONTEXT: Any = multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")
_PRELOADED = ["bbfit.pipeline", "bbfit.fitting.fused_pass"]


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    lifeline: Connection
    task: Task | None = None


class LocalWorkers:
    """Up to ``count`` processes (by default one for each core) that share the cores. A task that runs alone gets all cores.

    A process that dies is replaced. Its task is repeated up to ``retries`` times.
    """

    def __init__(self, count: int | None = None, retries: int = 2) -> None:
        self._count, self._retries = count or os.cpu_count() or 1, retries
        self._workers: list[_Worker] = []
        self._waiting = collections.deque[Task]()
        self._crashes = collections.Counter[str]()

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            _stop(worker)
        self._workers.clear()

    def submit(self, task: Task) -> None:
        """Run a task as soon as a process is free."""
        self._waiting.append(task)
        self._assign()

    def next(self) -> tuple[Task, Outcome]:
        """Wait until a task ends. At least one submitted task must be unfinished."""
        while True:
            self._assign()
            busy = {worker.pipe: worker for worker in self._workers if worker.task is not None}
            assert busy, "no task was submitted"
            for pipe in wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]
                task, worker.task = worker.task, None
                assert task
                try:
                    return task, worker.pipe.recv()
                except (EOFError, OSError):
                    self._workers.remove(worker)
                    cause = _stop(worker)
                    self._crashes[task.name] += 1
                    if self._crashes[task.name] <= self._retries:
                        self._waiting.appendleft(task)
                        break
                    reason = f"its process died {self._crashes[task.name]} times, last by {cause}"
                    return task, Outcome(None, reason, platform.node())

    def _assign(self) -> None:
        """Assign waiting tasks to idle processes, in their order."""
        while self._waiting:
            busy = [worker.task for worker in self._workers if worker.task is not None]
            task = self._waiting[0]
            if len(busy) >= (1 if task.alone or any(other.alone for other in busy) else self._count):
                return
            idle = next((worker for worker in self._workers if worker.task is None), None)
            if idle is None:
                idle = _start()
                self._workers.append(idle)
            idle.task = self._waiting.popleft()
            cores = os.cpu_count() or 1
            try:
                idle.pipe.send((idle.task, cores if task.alone else max(1, cores // self._count)))
            except OSError:  # the process has died, and ``next`` will notice it
                pass


def _start() -> _Worker:
    _CONTEXT.set_forkserver_preload(_PRELOADED)
    ours, theirs = _CONTEXT.Pipe()
    held, watched = _CONTEXT.Pipe()
    process = _CONTEXT.Process(target=_run_tasks, args=(theirs, watched, dict(os.environ)), daemon=True)
    process.start()
    theirs.close()
    watched.close()
    return _Worker(process, ours, held)


def _stop(worker: _Worker) -> str:
    """Stop a process if it still runs. Return how it ended."""
    worker.lifeline.close()
    worker.process.join(1)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.pipe.close()
    code = worker.process.exitcode or 0
    return f"{signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _run_tasks(pipe: Connection, lifeline: Connection, environment: dict[str, str]) -> None:
    """The main function of a process: run tasks until the parent closes the pipe or dies."""
    import torch

    os.environ.clear()
    os.environ.update(environment)  # the server has that of its own start
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles keyboard interrupts
    threading.Thread(target=_exit_with_parent, args=(lifeline,), daemon=True).start()
    while True:
        try:
            task, cores = pipe.recv()
        except EOFError:
            return
        torch.set_num_threads(cores)
        inputs = {name: paths[0] for name, paths in task.inputs.items()}
        pipe.send(attempt(partial(task.work, inputs, task.folder, *task.arguments), platform.node()))


def _exit_with_parent(lifeline: Connection) -> None:
    """Exit at once when the parent ends, even in the middle of a task."""
    try:
        lifeline.recv()
    except (EOFError, OSError):
        os._exit(1)
