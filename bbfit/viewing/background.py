"""Work beside a page, which ends with it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Background:
    """Threads that are waited for when the page is closed: one that is cut off in the middle of its work would crash the process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = set[threading.Thread]()
        self._closed = threading.Event()

    @property
    def closed(self) -> bool:
        """Whether work is to end as soon as it can."""
        return self._closed.is_set()

    def start(self, work: Callable[[], None], *, after: float = 0.0) -> None:
        """Do some work in a thread of its own, ``after`` so many seconds; none is begun any more once this is closed."""

        def do() -> None:
            try:
                if not self._closed.wait(after):
                    work()
            finally:
                with self._lock:
                    self._threads.discard(thread)

        thread = threading.Thread(target=do, daemon=True)
        with self._lock:
            if self._closed.is_set():
                return
            self._threads.add(thread)
            thread.start()

    def close(self, seconds: float = 60.0) -> None:
        """Begin nothing more, and wait for what is being done, but not longer than some seconds."""
        self._closed.set()
        until = time.monotonic() + seconds
        with self._lock:
            threads = list(self._threads)
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, until - time.monotonic()))
