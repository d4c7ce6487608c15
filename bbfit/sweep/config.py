"""The options of a sweep."""

from __future__ import annotations

from dataclasses import dataclass

from bbfit.checks import Count
from bbfit.operators.config import Loss
from bbfit.workers.config import WorkersConfig


@dataclass(frozen=True)
class SweepConfig(WorkersConfig):
    """What a sweep varies, and where it runs."""

    grid: str = "thesis"
    """A YAML file, or a built-in grid: default is one run per tree with the default preset;
    thesis is 24: 2, 3 and 4 billboards, L1 and L2, base, bounded, double and double bounded."""
    billboards: tuple[Count, ...] = ()
    """Numbers of billboards, in place of the grid's."""
    loss: tuple[Loss, ...] = ()
    """Losses, in place of the grid's."""
    variants: tuple[str, ...] = ()
    """Variants of the grid to run. Default: all of them."""
    max_cells: Count = 10_000
    """Most configurations of the grid."""
    retry_failed: bool = False
    """Run again what failed before; otherwise the recorded failure is kept."""
