"""Launching Warp kernels, and their results as differentiable functions."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.checks import InputError
from bbfit.threads import one_thread

FLAGS = "-march=native -ffp-contract=fast"
"""Clang's flags for CPU kernels; they enable the host's vector instructions and fused multiply-add."""
PIXEL = """
#if defined(__CUDA_ARCH__)
    struct pixel {
        float c[4];
        CUDA_CALLABLE float& operator[](int i) { return c[i]; }
        CUDA_CALLABLE float operator[](int i) const { return c[i]; }
        CUDA_CALLABLE pixel operator+(pixel o) const { return {c[0] + o.c[0], c[1] + o.c[1], c[2] + o.c[2], c[3] + o.c[3]}; }
        CUDA_CALLABLE pixel operator-(pixel o) const { return {c[0] - o.c[0], c[1] - o.c[1], c[2] - o.c[2], c[3] - o.c[3]}; }
        CUDA_CALLABLE pixel operator*(pixel o) const { return {c[0] * o.c[0], c[1] * o.c[1], c[2] * o.c[2], c[3] * o.c[3]}; }
        CUDA_CALLABLE pixel operator*(float s) const { return {c[0] * s, c[1] * s, c[2] * s, c[3] * s}; }
    };
    #define ONE_BY_ONE
#else
    #define ONE_BY_ONE _Pragma("clang loop vectorize(disable)")
    typedef float pixel __attribute__((vector_size(16), aligned(4), may_alias));
#endif
"""
"""C++ of native functions: the type of a pixel or texel in a register. Without it clang splits sums of pixels into single floats.
``ONE_BY_ONE`` before a loop over pixels keeps clang from gathering one channel of many."""
_workers: ContextVar[int] = ContextVar("workers", default=0)
LEAST_PIXELS = 1 << 14
"""Least pixels in a piece for a CPU thread."""


class CacheError(InputError, ImportError):
    """Warp cannot write its compiled kernels. Without them, modules that launch kernels cannot be imported."""


@contextmanager
def cache_of_kernels() -> Iterator[None]:
    """Within this block Warp uses its cache of compiled kernels. If it cannot be written to, this raises :class:`CacheError`."""
    try:
        yield
    except OSError as error:
        place = error.filename or wp.config.kernel_cache_dir or "the cache"
        raise CacheError(
            f"Warp: {place} cannot be written to ({error.strerror or error}), and compiled kernels are kept there; "
            "set the variable WARP_CACHE_PATH to a folder that can"
        ) from None


def _initialize() -> None:
    """Initialize Warp silently. Its C code warns on standard error when there is no GPU."""
    wp.config.log_level = wp.LOG_ERROR
    try:
        kept = os.dup(2)
    except OSError:  # there is no standard error
        with cache_of_kernels():
            wp.init()
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        with cache_of_kernels():
            wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)


_initialize()


def compile_for(kernel: Any, on: Any) -> None:
    """Compile a kernel's module for a device, or load it from the cache, before several threads launch it and each would compile it."""
    with cache_of_kernels():
        kernel.module.load(on, None if on.is_cuda else 1)  # the size of blocks, which is 1 in all launches on a CPU


def compile_together(kernels: Iterable[Any], device: torch.device) -> None:
    """:func:`compile_for` several kernels side by side, which takes less time than one after the other as they are launched."""
    on, modules = wp.device_from_torch(device), list({kernel.module: None for kernel in kernels})
    with cache_of_kernels():
        wp.force_load(on, modules, block_dim=None if on.is_cuda else 1, max_workers=worker_count())


def launch(
    kernel: Any, length: int, least: int, arguments: Sequence[Any], outputs: Sequence[Any] = (), *, across: int = 1, on: Any
) -> None:
    """Launch a kernel over [length, across] on a device: at once on a GPU, in pieces of at least ``least`` of ``length`` on a CPU.

    Warp runs a CPU launch in the calling thread; the pieces share all cores. The kernel's first argument is where its piece begins.
    """
    again = repeated(kernel, lambda thread: arguments, outputs, on)

    def piece(begin: int, end: int) -> None:
        again((end - begin, across), begin)

    in_parallel(piece, [(0, length)] if on.is_cuda else pieces_of(length, least))


def repeated(kernel: Any, arguments: Callable[[int], Sequence[Any]], outputs: Sequence[Any], on: Any) -> Callable[..., None]:
    """A function that launches a kernel on a device, with a size and values of the first parameters, for :func:`in_parallel`.

    ``arguments`` returns the arguments for the other parameters, but ``outputs``, which are the last. It is called once in each thread that
    launches, with the thread's number, at most :func:`worker_count`, and they are packed for the kernel once. That takes longer than the
    launch of a small piece.
    """
    compile_for(kernel, on)
    threads, own = count(), threading.local()

    def again(size: tuple[int, ...], *first: Any) -> None:
        command = getattr(own, "command", None)
        if command is None:
            own.inputs = [*first, *arguments(next(threads))]  # of which the command would not keep the memory alive
            command = own.command = wp.launch(kernel, size, own.inputs, outputs, device=on, record_cmd=True)
        else:
            command.set_dim(size)
            for index, value in enumerate(first):
                command.set_param_at_index(index, value)
        command.launch()

    return again


@contextmanager
def cores_for_kernels() -> Iterator[None]:
    """Within this block torch computes in the calling thread, and CPU launches have the threads that torch had before."""
    token = _workers.set(worker_count())
    try:
        with one_thread():
            yield
    finally:
        _workers.reset(token)


def worker_count() -> int:
    """Number of threads for CPU launches: as many as torch uses (``torch.set_num_threads``, ``OMP_NUM_THREADS``)."""
    return _workers.get() or torch.get_num_threads()


def in_parallel(launch: Callable[..., None], pieces: Iterable[tuple[int, ...]]) -> None:
    """Call ``launch(*piece)`` for every piece on :func:`worker_count` threads and wait until all are done.

    The calling thread takes pieces too and never waits for a thread that has not started. On a busy machine it then does most of the work
    itself, instead of waiting to be scheduled a thousand times a second. An exception in a piece is raised here.
    """
    pieces = list(pieces)
    left = iter(pieces)

    def work() -> None:
        for piece in left:  # the interpreter's lock makes sure that each piece goes to one thread
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


def pieces_of(length: int, least: int, most: int | None = None) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into nearly equal pieces of at least ``least``: at most ``most`` of them, or four for each worker."""
    number = max(1, min(length // max(least, 1), 4 * worker_count() if most is None else most))
    edges = [length * i // number for i in range(number + 1)]
    return [(begin, end) for begin, end in pairwise(edges) if end > begin]


def warp_array(tensor: Tensor, dtype: Any) -> Any:
    """A Warp view of the memory of a contiguous tensor, which it keeps alive."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def struct_array(tensor: Tensor, kind: Any) -> Any:
    """A Warp view of a contiguous tensor whose last dimension is the memory of a struct. It keeps the tensor alive."""
    device, shape = wp.device_from_torch(tensor.device), tuple(tensor.shape[:-1])
    array: Any = wp.array(ptr=tensor.data_ptr(), shape=shape, dtype=kind, device=device)
    array._tensor = tensor  # as wp.from_torch does
    return array


def differentiable(value: Tensor, picture: Tensor, gradient: Tensor) -> Tensor:
    """The scalar ``value``, whose gradient in a finite ``picture`` is ``gradient``, of the picture's shape."""
    return value + (gradient * (picture - picture.detach())).sum()


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="bbfit-launch")
