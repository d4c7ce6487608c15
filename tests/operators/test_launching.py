"""Pieces of work on several threads: each is done once, what goes wrong is told, and nobody waits for what has not begun."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from threading import Barrier, Event, Lock, Thread, get_ident

import pytest
import torch

from bbfit.operators.launching import CacheError, cache_of_kernels, cores_for_kernels, in_parallel, pieces_of, worker_count

PATIENCE = 20.0
"""Seconds after which something is taken to hang."""


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets how many threads there are, for one test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_kernels_get_the_threads_that_torch_would_use(threads: Callable[[int], None]) -> None:
    threads(3)
    with pytest.raises(KeyError), cores_for_kernels():
        assert (torch.get_num_threads(), worker_count()) == (1, 3)
        with cores_for_kernels():
            assert (torch.get_num_threads(), worker_count()) == (1, 3)
        assert (torch.get_num_threads(), worker_count()) == (1, 3)
        raise KeyError
    assert (torch.get_num_threads(), worker_count()) == (3, 3)


def in_time(work: Callable[[], None]) -> None:
    """Do some work in a thread of its own; fail if it does not end."""
    caught: list[BaseException] = []

    def guarded() -> None:
        try:
            work()
        except BaseException as error:
            caught.append(error)

    thread = Thread(target=guarded, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    assert not thread.is_alive(), "it hangs"
    for error in caught:
        raise error


class Watch:
    """Counts the calls of every piece, and how many run at a time."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.calls, self.running, self.most, self.callers = Counter[tuple[int, ...]](), 0, 0, set[int]()
        self._seconds, self._lock = seconds, Lock()

    def __call__(self, *piece: int) -> None:
        with self._lock:
            self.calls[piece] += 1
            self.running += 1
            self.most = max(self.most, self.running)
            self.callers.add(get_ident())
        try:
            time.sleep(self._seconds)
            self.work(*piece)
        finally:
            with self._lock:
                self.running -= 1

    def work(self, *piece: int) -> None:
        """What a piece does beside being counted."""


@pytest.mark.parametrize("number", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 500])
def test_every_piece_is_launched_once(threads: Callable[[int], None], number: int, count: int) -> None:
    threads(number)
    assert worker_count() == number
    for _ in range(5):
        watch = Watch()
        in_parallel(watch, ((i, i * i) for i in range(count)))
        assert watch.calls == {(i, i * i): 1 for i in range(count)} and watch.running == 0


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_caller_is_one_of_the_threads(threads: Callable[[int], None], number: int) -> None:
    """As many pieces as threads wait for each other; then no more than so many run at a time."""
    threads(number)
    meeting, watch = Barrier(number), Watch()
    watch.work = lambda *piece: meeting.wait(PATIENCE)  # type: ignore[method-assign, assignment]
    in_parallel(watch, [(i,) for i in range(number)])
    assert len(watch.callers) == number and get_ident() in watch.callers
    watch = Watch(0.002)
    in_parallel(watch, [(i,) for i in range(30)])
    assert get_ident() in watch.callers and watch.most <= number


def test_one_piece_is_for_the_caller(threads: Callable[[int], None]) -> None:
    threads(3)
    watch = Watch()
    in_parallel(watch, [(1, 2)])
    assert watch.callers == {get_ident()} and watch.calls == {(1, 2): 1}


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("bad", range(6))
def test_what_any_piece_raises_is_raised(threads: Callable[[int], None], number: int, bad: int) -> None:
    threads(number)
    watch = Watch(0.005)

    def work(piece: int) -> None:
        if piece == bad:
            raise KeyError(piece)
        time.sleep(0.01)

    watch.work = work  # type: ignore[method-assign, assignment]
    with pytest.raises(KeyError, match=str(bad)):
        in_parallel(watch, [(i,) for i in range(6)])
    assert watch.running == 0 and max(watch.calls.values()) == 1
    done = Watch()
    in_parallel(done, [(i,) for i in range(6)])
    assert done.calls == {(i,): 1 for i in range(6)}


@pytest.mark.parametrize("who", ["caller", "helper"])
def test_after_an_error_no_piece_is_still_running(threads: Callable[[int], None], who: str) -> None:
    """Both threads have begun a piece when one of them fails; the other takes its time."""
    threads(2)
    here, meeting, ended = get_ident(), Barrier(2), list[int]()

    def launch(piece: int) -> None:
        meeting.wait(PATIENCE)
        if (get_ident() == here) == (who == "caller"):
            raise KeyError(who)
        time.sleep(0.2)
        ended.append(piece)

    with pytest.raises(KeyError, match=who):
        in_parallel(launch, [(0,), (1,)])
    assert len(ended) == 1


@pytest.mark.parametrize("number", [1, 2, 3])
def test_pieces_may_have_pieces(threads: Callable[[int], None], number: int) -> None:
    threads(number)
    inner = Watch(0.001)

    def outer(piece: int) -> None:
        in_parallel(inner, [(piece, i) for i in range(5)])

    in_time(lambda: in_parallel(outer, [(i,) for i in range(8)]))
    assert inner.calls == {(a, b): 1 for a in range(8) for b in range(5)}


def test_a_call_does_not_wait_for_helpers_that_have_not_begun(threads: Callable[[int], None]) -> None:
    """All threads of the pool are held by pieces of other calls; the caller then does everything, and nobody does it again later."""
    threads(2)
    release, held = Event(), threading.Semaphore(0)

    def hold(piece: int) -> None:
        held.release()
        assert release.wait(PATIENCE)

    others = [Thread(target=in_parallel, args=(hold, [(0,), (1,)]), daemon=True) for _ in range(2)]
    try:
        for other in others:
            other.start()
        for _ in range(4):  # two callers, and both threads of the pool
            assert held.acquire(timeout=PATIENCE)
        watch = Watch()
        in_time(lambda: in_parallel(watch, [(i,) for i in range(10)]))
        assert watch.calls == {(i,): 1 for i in range(10)} and len(watch.callers) == 1
    finally:
        release.set()
    for other in others:
        other.join(PATIENCE)
        assert not other.is_alive()
    again = Watch()
    in_parallel(again, [(i,) for i in range(10)])
    assert watch.calls == again.calls == {(i,): 1 for i in range(10)}


@pytest.mark.parametrize("count", [0, 1, 5, 20, 64, 1000])
@pytest.mark.parametrize("least", [0, 1, 7, 64, 5000])
@pytest.mark.parametrize("most", [None, 1, 3])
def test_pieces_are_about_equal_parts_of_the_whole(threads: Callable[[int], None], count: int, least: int, most: int | None) -> None:
    threads(2)
    pieces = pieces_of(count, least, most)
    assert [i for begin, end in pieces for i in range(begin, end)] == list(range(count))
    assert all(end == begin for (_, end), (begin, _) in pairwise(pieces))
    lengths = [end - begin for begin, end in pieces]
    assert len(pieces) == (min(max(1, count // max(least, 1)), 8 if most is None else most) if count else 0)
    assert not lengths or (max(lengths) - min(lengths) <= 1 and (len(lengths) == 1 or min(lengths) >= least))


def test_kernels_are_compiled_once(tmp_path: Path) -> None:
    """Not also for blocks of more than one thread, which no launch on a CPU has."""
    script = """
import torch
from bbfit.operators.sharpness.fused import sharpness_fused
pictures = torch.rand(2, 1, 16, 16, 4)
sharpness_fused(*pictures)
"""
    cache = tmp_path / "cache"
    subprocess.run([sys.executable, "-c", script], check=True, env={**os.environ, "WARP_CACHE_PATH": str(cache)})
    modules = [path.parent.name.rpartition("_")[0] for path in cache.rglob("*.o")]
    assert modules and len(modules) == len(set(modules))


def test_a_cache_that_cannot_be_written_is_named_with_its_variable(tmp_path: Path) -> None:
    """When Warp starts, and when a kernel is compiled."""
    with pytest.raises(CacheError, match=r"^Warp: /there cannot be written to \(Read-only file system\).*WARP_CACHE_PATH"):
        with cache_of_kernels():
            raise OSError(30, "Read-only file system", "/there")
    (tmp_path / "file").touch()
    script = "import bbfit.operators.launching"
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file" / "cache")}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert "CacheError: Warp: " in done.stderr.splitlines()[-1] and "WARP_CACHE_PATH" in done.stderr
