"""Blender in worker processes: start them, send them frames, and replace those that crash."""

from __future__ import annotations

import importlib.util
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bbfit.checks import InputError, fail
from bbfit.scratch import ScratchFolder

WORKER = Path(__file__).with_name("worker.py")
"""The script that each worker process runs."""
RESTARTS = 2
"""How many crashed processes a render replaces."""
_LOG_LINES = 3


class BlenderError(InputError):
    """Blender crashed. The message gives the place, the finished pictures, and the end of Blender's output."""


def require_bpy() -> None:
    """Raise an :class:`~bbfit.checks.InputError` that says what to install if Blender's module bpy is missing."""
    if importlib.util.find_spec("bpy") is None:
        fail(
            "Blender",
            "its module bpy is not installed",
            'install bbfit with its extra, pip install "bbfit[blender]" (".[blender]" in its source folder), on Python 3.11, '
            "or give a folder of views",
        )


class Blender:
    """One worker process, and a thread that reads its answers and puts them on a queue as (worker, event) pairs."""

    def __init__(self, settings: dict[str, Any], scratch: str, events: queue.Queue[tuple[Blender, dict[str, Any]]]) -> None:
        self._log = tempfile.TemporaryFile()
        # A scratch folder for the files that a killed Blender leaves behind, and no settings or add-ons of the user.
        environment = os.environ | {"TMPDIR": scratch, "TEMP": scratch, "TMP": scratch, "BLENDER_USER_RESOURCES": scratch}
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=environment,
            start_new_session=True,  # the parent handles keyboard interrupts
        )
        self._listener = threading.Thread(target=self._listen, args=(events,), daemon=True)
        self._listener.start()
        self.send(settings)

    @property
    def pid(self) -> int:
        """The worker's process id."""
        return self._process.pid

    def send(self, request: dict[str, Any]) -> None:
        """Send the settings or a frame. If the worker has died, the queue gets an ``exit`` event, and this method raises nothing."""
        assert self._process.stdin
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            pass

    def _listen(self, events: queue.Queue[tuple[Blender, dict[str, Any]]]) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            if not line.endswith(b"\n"):
                break  # the process died in the middle of a message
            event: dict[str, Any] = json.loads(line)
            payload = self._process.stdout.read(event["payload"])
            if len(payload) < event["payload"]:
                break
            events.put((self, event | {"payload": payload}))
        events.put((self, {"event": "exit"}))

    def exit_reason(self) -> str:
        """How the process ended, and the last lines of its output, on one line."""
        code = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").splitlines()
        output = [line.strip() for line in lines if line.strip() and not line.startswith("Fra:")][-_LOG_LINES:]
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        return f"{reason}; its last output: {' | '.join(output)}" if output else reason

    def stop(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        for stream in (self._process.stdin, self._process.stdout, self._log):
            try:
                assert stream
                stream.close()
            except OSError:  # data could not be flushed, because the process has ended
                pass


class BlenderPool:
    """Blender processes that load the same tree. This is a context manager: leaving it kills all processes."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._events: queue.Queue[tuple[Blender, dict[str, Any]]] = queue.Queue()
        self._scratch = ScratchFolder()
        self._workers: list[Blender] = []

    def __enter__(self) -> BlenderPool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._scratch.remove()

    def _start(self, *, measure: bool) -> Blender:
        self._workers.append(Blender(self._settings | {"measure": measure}, str(self._scratch.path), self._events))
        return self._workers[-1]

    def _next(self) -> tuple[Blender, dict[str, Any]]:
        worker, event = self._events.get()
        if event["event"] == "refused":
            fail(*event["reason"])
        return worker, event

    def load(self) -> dict[str, Any]:
        """Start the first process, which loads and measures the tree. Raises :class:`BlenderError`, or ``InputError`` for an unusable tree.

        The result has ``vertices`` and ``faces`` (counts), ``blender`` (version), and ``payload`` (the vertices as raw float32, Z up).
        """
        return self._start_first("reading", measure=True)

    def convert(self, triangles: int | None) -> Path:
        """Write the tree as a GLB file with at most about ``triangles`` triangles. Leaving the pool removes the file.

        Raises :class:`BlenderError` if Blender crashes, and ``InputError`` if the tree cannot be read or written.
        """
        path = self._scratch.path / "tree.glb"
        self._settings = self._settings | {"convert": {"path": str(path), "triangles": triangles}}
        self._start_first("converting", measure=False)
        return path

    def render_field(self, matrices: Path, frame: dict[str, Any]) -> dict[str, Any]:
        """Render copies of the tree, whose matrices a file holds, once. Raises :class:`BlenderError` if Blender crashes.

        The result has the ``seconds`` of the render and the most memory of the process, ``bytes``.
        """
        self._settings = self._settings | {"field": {"matrices": str(matrices), "frame": frame}}
        return self._start_first("rendering copies of", measure=False)

    def check(self) -> None:
        """Start a process that checks the device and the panorama of the settings, without a tree. Raises ``InputError`` if not usable."""
        self._start(measure=False)
        worker, event = self._next()
        if event["event"] == "exit":
            raise BlenderError(f"Blender: crashed while checking the device and the panorama ({worker.exit_reason()}); choose others")

    def _start_first(self, activity: str, *, measure: bool) -> dict[str, Any]:
        """Start a process and return its first answer."""
        self._start(measure=measure)
        worker, event = self._next()
        if event["event"] == "exit":
            raise BlenderError(
                f"Blender: crashed while {activity} {self._settings['tree']} ({worker.exit_reason()}); "
                "open the file in Blender to see whether it is damaged"
            )
        return event

    def render(self, frames: list[dict[str, Any]], workers: int, finished: int, on_done: Callable[[int], None]) -> None:
        """Render frames (:func:`~bbfit.blender.pictures.frames`) on the loaded process and ``workers - 1`` more.

        A process that crashes is replaced, and its frame is rendered again. After more than :data:`RESTARTS` crashes, this raises
        :class:`BlenderError`. If a picture cannot be written, it raises ``InputError``. ``on_done`` is called after each picture with the
        number of finished pictures, which includes the ``finished`` ones that existed already.
        """
        waiting, crashes, total = deque(frames), 0, finished + len(frames)
        assigned: dict[Blender, dict[str, Any]] = {}

        def assign(worker: Blender) -> None:
            if waiting:
                assigned[worker] = waiting.popleft()
                worker.send(assigned[worker])

        assign(self._workers[0])
        for _ in range(min(workers, len(frames)) - 1):
            self._start(measure=False)
        while finished < total:
            worker, event = self._next()
            frame = assigned.pop(worker, None)
            if event["event"] == "exit":
                crashes += 1
                if frame is not None:
                    waiting.appendleft(frame)
                if crashes > RESTARTS:
                    where = f"at {Path(frame['path']).name}" if frame else "while reading the tree"
                    raise BlenderError(
                        f"Blender: crashed {crashes} times, last {where} ({worker.exit_reason()}); "
                        f"{finished} of {total} views are finished and kept, start again to continue"
                    )
                self._start(measure=False)
                continue
            if event["event"] == "done":
                finished += 1
                on_done(finished)
            assign(worker)
