"""How a sweep is carried out: which grid, on how many processes or machines."""

from __future__ import annotations

from dataclasses import dataclass

from bbfit.budget.config import amount
from bbfit.checks import check_count, check_range, fail
from bbfit.operators.config import Loss


@dataclass(frozen=True)
class SweepConfig:
    """What a sweep varies and what it runs on."""

    grid: str = "thesis"
    """A YAML file, or a built-in grid: default is one run a tree by the default preset;
    thesis is 24: 2, 3 and 4 billboards, L1 and L2, base, bounded, double and double bounded."""
    billboards: tuple[int, ...] = ()
    """Numbers of billboards, in place of the grid's."""
    loss: tuple[Loss, ...] = ()
    """Losses, in place of the grid's."""
    variants: tuple[str, ...] = ()
    """Which of the grid's variants; all if left out."""
    steps: int | None = None
    """Optimizer steps of every run, in place of the preset's."""
    retry_failed: bool = False
    """Try again what failed in an earlier start; otherwise its failure stands."""
    workers: int | None = None
    """Runs at a time on this machine, which share its cores; left out, one for each core. Ray decides by cpus itself."""
    ray: str | None = None
    """Address of a Ray cluster to run on (HOST:PORT, or auto for the one of this machine), or local to start Ray on this machine."""
    cpus: int = 1
    """Cores that Ray keeps for a run."""
    gpus: float = 0.0
    """GPUs that Ray keeps for a run; say also on what to fit, as in --fit.device cuda."""
    memory: int | str | None = None
    """Bytes of memory that Ray keeps for a run; 4000M is understood."""
    retries: int = 2
    """How often a run is started again whose process or machine died."""

    def __post_init__(self) -> None:
        for count in self.billboards:
            check_count("billboards", count)
        for name in ("steps", "workers"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))
        check_count("cpus", self.cpus)
        check_range("gpus", self.gpus, 0, 64)
        check_count("retries", self.retries, 0)
        if self.memory is not None:
            check_count("memory", amount("memory", self.memory))
        if self.ray is None and (self.gpus or self.memory is not None):
            fail("gpus" if self.gpus else "memory", "it is Ray that keeps it for a run", "add --ray ADDRESS, or leave it out")
        if self.ray is not None and self.workers is not None:
            fail("workers", "on Ray the cores decide how many runs there are at a time", "say cpus instead")

    @property
    def memory_bytes(self) -> int | None:
        """``memory`` as a number."""
        return None if self.memory is None else amount("memory", self.memory)
