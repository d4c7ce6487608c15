"""The threads that torch computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Within this block torch computes in the calling thread.

    Short operations on many cores wait for each other's threads. On two busy cores that takes several times as long. After an operation,
    the threads wait for the next one on their cores, for milliseconds, and hold up other work there.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
