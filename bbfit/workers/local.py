"""Run tasks in processes on this machine. A process that dies affects only its own task."""

from __future__ import annotations

import collections
import logging
import multiprocessing
import os
import platform
import signal
import tempfile
import threading
import time
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from types import FrameType
from typing import Any

from bbfit.outputs import wait_until_free
from bbfit.scratch import ScratchFolder, remove_own
from bbfit.workers.tasks import Outcome, Task, attempt

# A fork of a process that has used torch can hang. Workers are forks of a server that only imports, or new processes on Windows.
_CONTEXT: Any = multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")
_PRELOADED = ["bbfit.pipeline", "bbfit.fitting.fused_pass"]
# Seconds that a process has to end its task, with the Blender that it started, when its parent ends.
_PATIENCE = 1.0
# Most bytes of the path of the folder for temporary files, to which the path of a socket adds 55.
_LONGEST_PLACE = 48


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
            worker.lifeline.close()  # all of them end at the same time
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
    before, tempfile.tempdir = tempfile.tempdir, _folder_of_the_server()
    try:
        process.start()
    finally:
        tempfile.tempdir = before
    theirs.close()
    watched.close()
    return _Worker(process, ours, held)


@cache
def _folder_of_the_server() -> str | None:
    """The folder for the socket of the server that workers are forks of, until this process ends.

    The path of a socket may have about 100 bytes. Where one in a folder of bbfit's own would be longer, there is no such folder.
    """
    if len(os.fsencode(tempfile.gettempdir())) > _LONGEST_PLACE:
        return None
    folder = ScratchFolder()
    Finalize(None, folder.remove, exitpriority=-101)  # after multiprocessing has removed its own folder in this one
    return str(folder.path)


def _stop(worker: _Worker) -> str:
    """Stop a process if it still runs. Return how it ended."""
    worker.lifeline.close()
    worker.process.join(2 * _PATIENCE)
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
    logging.getLogger().addHandler(logging.NullHandler())  # libraries have no place to log to
    orphaned = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        if orphaned.is_set():  # otherwise the signal is for the parent, which handles it
            raise KeyboardInterrupt

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), stop)
    threading.Thread(target=_exit_with_parent, args=(lifeline, orphaned), daemon=True).start()
    try:
        while True:
            task, cores = pipe.recv()
            torch.set_num_threads(cores)
            inputs = {name: paths[0] for name, paths in task.inputs.items()}
            wait_until_free(task.folder)  # by a process of a killed sweep, which ends with its parent, but not at the same moment
            pipe.send(attempt(partial(task.work, inputs, task.folder, *task.arguments), platform.node()))
    except (EOFError, BrokenPipeError):
        return
    except KeyboardInterrupt:
        os._exit(1)


def _exit_with_parent(lifeline: Connection, orphaned: threading.Event) -> None:
    """Exit when the parent ends, even in the middle of a task: in an orderly way, or at once if that takes long."""
    try:
        lifeline.recv()
    except (EOFError, OSError):
        orphaned.set()
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            time.sleep(_PATIENCE)
        remove_own()
        os._exit(1)
