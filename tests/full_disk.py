"""A disk that is full, as far as this process can tell."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

FULL = "File too large"
"""The reason that the system gives within :func:`full_disk`."""


@contextmanager
def full_disk(left: int = 0) -> Iterator[None]:
    """No file can grow beyond ``left`` bytes within this block."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
