"""Blender in processes of its own: started, fed frame by frame, watched, and replaced when one crashes."""

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

WORKER = Path(__file__).with_name("worker.py")
RESTARTS = 2
_LOG_LINES = 3


class BlenderError(InputError):
    """Blender crashed; the message says where, what is kept, and what it said last."""


def require_bpy() -> None:
    """Refuse, with what to install, where there is no Blender."""
    if importlib.util.find_spec("bpy") is None:
        fail(
            "Blender",
            "its module bpy is not installed",
            'install bbfit with its extra, pip install "bbfit[blender]" (".[blender]" in its source folder), on Python 3.11, '
            "or give a folder of views",
        )


class Blender:
    """One worker process and the thread that listens to it. Events go to a queue as (worker, event) pairs."""

    def __init__(self, job: dict[str, Any], scratch: str, events: queue.Queue[tuple[Blender, dict[str, Any]]]) -> None:
        self._log = tempfile.TemporaryFile()
        # Own folders for what Blender leaves behind when it is killed, and no settings or add-ons of the user's.
        environment = os.environ | {"TMPDIR": scratch, "TEMP": scratch, "TMP": scratch, "BLENDER_USER_RESOURCES": scratch}
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=environment,
            start_new_session=True,  # an interrupt from the keyboard is the parent's to handle
        )
        self._listener = threading.Thread(target=self._listen, args=(events,), daemon=True)
        self._listener.start()
        self.send(job)

    @property
    def pid(self) -> int:
        """The worker's process id."""
        return self._process.pid

    def send(self, request: dict[str, Any]) -> None:
        """Hand over a job or a frame. A worker that is gone says so through its queue, not here."""
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

    def last_words(self) -> str:
        """Why the process ended and the last lines that it printed, on one line."""
        code = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").splitlines()
        told = [line.strip() for line in lines if line.strip() and not line.startswith("Fra:")][-_LOG_LINES:]
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        return f"{reason}; its last words: {' | '.join(told)}" if told else reason

    def stop(self) -> None:
        """End the process now."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        for stream in (self._process.stdin, self._process.stdout, self._log):
            try:
                assert stream
                stream.close()
            except OSError:  # what was still to be flushed to a process that is gone
                pass


class BlenderPool:
    """Blender processes that hold the same tree. A context manager: leaving it ends them all."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._job = job
        self._events: queue.Queue[tuple[Blender, dict[str, Any]]] = queue.Queue()
        self._scratch = tempfile.TemporaryDirectory(prefix="bbfit-", ignore_cleanup_errors=True)
        self._workers: list[Blender] = []

    def __enter__(self) -> BlenderPool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._scratch.cleanup()

    def _start(self, *, measure: bool) -> Blender:
        self._workers.append(Blender(self._job | {"measure": measure}, self._scratch.name, self._events))
        return self._workers[-1]

    def _next(self) -> tuple[Blender, dict[str, Any]]:
        worker, event = self._events.get()
        if event["event"] == "refused":
            fail(*event["reason"])
        return worker, event

    def load(self) -> dict[str, Any]:
        """Start a first process and return what it says of the tree: ``vertices``, ``faces``, ``blender``, ``payload``."""
        return self._first("reading", measure=True)

    def convert(self, triangles: int | None) -> Path:
        """Write the tree as a GLB file with at most about so many triangles; the file goes when the pool does.

        Raises
        ------
        BlenderError
            when Blender crashes.
        InputError
            when the tree cannot be read or written.
        """
        path = Path(self._scratch.name) / "tree.glb"
        self._job = self._job | {"convert": {"path": str(path), "triangles": triangles}}
        self._first("converting", measure=False)
        return path

    def _first(self, doing: str, *, measure: bool) -> dict[str, Any]:
        """Start a process and return its first answer."""
        self._start(measure=measure)
        worker, event = self._next()
        if event["event"] == "exit":
            raise BlenderError(
                f"Blender: crashed while {doing} {self._job['tree']} ({worker.last_words()}); "
                "open the file in Blender itself to see whether it is damaged"
            )
        return event

    def render(self, frames: list[dict[str, Any]], workers: int, kept: int, on_done: Callable[[int], None]) -> None:
        """Render frames on the loaded process and ``workers - 1`` more.

        A process that crashes is replaced and its frame tried again, :data:`RESTARTS` times in all. ``on_done`` is called with the
        number of finished views after each; ``kept`` of them stood before.

        Raises
        ------
        BlenderError
            when Blender crashes once more.
        InputError
            when a picture cannot be written.
        """
        waiting, crashes, total = deque(frames), 0, kept + len(frames)
        in_hand: dict[Blender, dict[str, Any]] = {}

        def give(worker: Blender) -> None:
            if waiting:
                in_hand[worker] = waiting.popleft()
                worker.send(in_hand[worker])

        give(self._workers[0])
        for _ in range(min(workers, len(frames)) - 1):
            self._start(measure=False)
        while kept < total:
            worker, event = self._next()
            frame = in_hand.pop(worker, None)
            if event["event"] == "exit":
                crashes += 1
                if frame is not None:
                    waiting.appendleft(frame)
                if crashes > RESTARTS:
                    where = f"at {Path(frame['path']).name}" if frame else "while reading the tree"
                    raise BlenderError(
                        f"Blender: crashed {crashes} times, last {where} ({worker.last_words()}); "
                        f"{kept} of {total} views are finished and kept, start again to go on"
                    )
                self._start(measure=False)
                continue
            if event["event"] == "done":
                kept += 1
                on_done(kept)
            give(worker)
