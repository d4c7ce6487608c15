"""Starting Warp kernels: on a GPU at once, on a CPU in pieces on all cores, since Warp runs a CPU launch in the calling thread."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
import warp as wp

FLAGS = "-march=native -ffp-contract=fast"
"""Clang's flags for CPU kernels: without them multiplications and additions are not fused."""


def _initialize() -> None:
    """Start Warp without a word: a library does not print, and a machine without a GPU is nothing to warn of, though Warp's C code does."""
    wp.config.log_level = wp.LOG_ERROR
    try:
        kept = os.dup(2)
    except OSError:  # there is no standard error to keep quiet
        wp.init()
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)


_initialize()


def worker_count() -> int:
    """Threads that CPU launches are spread over: as many as torch uses (``torch.set_num_threads``, ``OMP_NUM_THREADS``)."""
    return torch.get_num_threads()


def in_parallel(launch: Callable[..., None], pieces: Iterable[tuple[int, ...]]) -> None:
    """Call ``launch(*piece)`` for every piece on :func:`worker_count` threads; return when all are done, raise what one raised.

    The calling thread takes pieces like the others, and does not wait for one that has not begun: on a machine that is busy with other
    things it then does most of the work itself, in place of waiting for its turn a thousand times a second.
    """
    pieces = list(pieces)
    left = iter(pieces)

    def work() -> None:
        for piece in left:  # each goes to one thread: the interpreter's lock is held between them
            launch(*piece)

    helpers = min(worker_count(), len(pieces)) - 1
    others = [_pool(worker_count()).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


def pieces_of(count: int, least: int, most: int | None = None) -> list[tuple[int, int]]:
    """Cut ``range(count)`` into about equal pieces of at least ``least``: at most ``most``, or a few for each worker."""
    number = max(1, min(count // max(least, 1), 4 * worker_count() if most is None else most))
    edges = [count * i // number for i in range(number + 1)]
    return [(begin, end) for begin, end in pairwise(edges) if end > begin]


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="bbfit-launch")
