"""The options of work on many trees: where it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bbfit.checks import Count, Range, amount, check_count, check_fields, fail


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """The processes or machines that run tasks."""

    workers: Count | None = None
    """Number of simultaneous tasks on this machine, which share its cores. Default: one per core. Ray derives it from cpus."""
    ray: str | None = None
    """Address of a Ray cluster to run on (HOST:PORT, or auto for the one of this machine), or local to start Ray on this machine."""
    cpus: Count = 1
    """Cores that Ray reserves for a task."""
    gpus: Annotated[float, Range(0, 64)] = 0.0
    """GPUs that Ray reserves for a task; add --device cuda, so that the fit uses them."""
    memory: int | str | None = None
    """Bytes of memory that Ray reserves for a task, such as 4000M."""
    retries: Annotated[int, Range(0)] = 2
    """How often a task is restarted after its process or machine died."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.memory is not None:
            check_count("memory", amount("memory", self.memory))
        if self.ray is None and (self.gpus or self.memory is not None):
            fail("gpus" if self.gpus else "memory", "only Ray reserves it for a run", "add --ray ADDRESS, or leave it out")
        if self.ray is not None and self.workers is not None:
            fail("workers", "on Ray the cores decide how many runs there are at a time", "give cpus instead")

    @property
    def memory_bytes(self) -> int | None:
        """``memory`` as a number."""
        return None if self.memory is None else amount("memory", self.memory)
