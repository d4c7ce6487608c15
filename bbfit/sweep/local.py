"""Tasks on processes of this machine, which may die without taking the rest along."""

from __future__ import annotations

import collections
import multiprocessing
import os
import platform
import signal
import threading
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from bbfit.sweep.tasks import Outcome, Task, attempt

_SPAWN = multiprocessing.get_context("spawn")  # a forked torch or Blender would hang


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    lifeline: Connection
    task: Task | None = None


@dataclass(frozen=True)
class _Waiting:
    tasks: collections.deque[Task] = field(default_factory=collections.deque)
    deaths: collections.Counter[str] = field(default_factory=collections.Counter)


class LocalWorkers:
    """Up to ``count`` processes, by default one for each core, that share the cores; a task that is to run alone has them all.

    A process that dies is replaced, and its task tried again up to ``retries`` times.
    """

    def __init__(self, count: int | None = None, retries: int = 2) -> None:
        self._count, self._retries = count or os.cpu_count() or 1, retries
        self._workers: list[_Worker] = []
        self._waiting = _Waiting()

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            _end(worker)
        self._workers.clear()

    def submit(self, task: Task) -> None:
        """See :class:`~bbfit.sweep.tasks.Workers`."""
        self._waiting.tasks.append(task)
        self._hand_out()

    def next(self) -> tuple[Task, Outcome]:
        """See :class:`~bbfit.sweep.tasks.Workers`."""
        while True:
            self._hand_out()
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
                    ending = _end(worker)
                    self._waiting.deaths[task.name] += 1
                    if self._waiting.deaths[task.name] <= self._retries:
                        self._waiting.tasks.appendleft(task)
                        break
                    reason = f"its process died {self._waiting.deaths[task.name]} times, last by {ending}"
                    return task, Outcome(None, reason, platform.node())

    def _hand_out(self) -> None:
        """Give tasks to whoever has none, in their order."""
        while self._waiting.tasks:
            busy = [worker.task for worker in self._workers if worker.task is not None]
            task = self._waiting.tasks[0]
            if len(busy) >= (1 if task.alone or any(other.alone for other in busy) else self._count):
                return
            idle = next((worker for worker in self._workers if worker.task is None), None)
            if idle is None:
                idle = _start()
                self._workers.append(idle)
            idle.task = self._waiting.tasks.popleft()
            cores = os.cpu_count() or 1
            try:
                idle.pipe.send((idle.task, cores if task.alone else max(1, cores // self._count)))
            except OSError:  # it has died, which the next look at its pipe will tell
                pass


def _start() -> _Worker:
    ours, theirs = _SPAWN.Pipe()
    held, watched = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_serve, args=(theirs, watched), daemon=True)
    process.start()
    theirs.close()
    watched.close()
    return _Worker(process, ours, held)


def _end(worker: _Worker) -> str:
    """End a process if it has not ended; how it did."""
    worker.lifeline.close()
    worker.process.join(1)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.pipe.close()
    code = worker.process.exitcode or 0
    return f"{signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _serve(pipe: Connection, lifeline: Connection) -> None:
    """What a process does: one task after the other, until its parent hangs up or dies."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt from the keyboard is the parent's to handle
    threading.Thread(target=_watch, args=(lifeline,), daemon=True).start()
    while True:
        try:
            task, cores = pipe.recv()
        except EOFError:
            return
        torch.set_num_threads(cores)
        inputs = {name: paths[0] for name, paths in task.inputs.items()}
        pipe.send(attempt(partial(task.work, inputs, task.folder, *task.arguments), platform.node()))


def _watch(lifeline: Connection) -> None:
    """End this process at once when the parent is gone, in the middle of a task if need be."""
    try:
        lifeline.recv()
    except (EOFError, OSError):
        os._exit(1)
