"""How a tree is grown: which of its kind, how finely."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bbfit.checks import check_count, check_range
from bbfit.provenance import EXECUTION

VERTEX_LIMIT = 20_000_000
"""Most vertices that a tree may have unless asked otherwise; a willow has half as many."""


@dataclass(frozen=True)
class GrowConfig:
    """How a tree is grown."""

    seed: int = 0
    """Another seed gives another tree of the same species."""
    detail: float = 1.0
    """How fine the bark is, in [0.1, 10]: factor on the rings along stems and on each ring's corners; vertices go by its square."""
    leaves: float = 1.0
    """Share of the leaves that grow, in [0, 1]; fewer are larger, so that their area stays."""
    max_vertices: int = field(default=VERTEX_LIMIT, metadata=EXECUTION)
    """Refuse to grow a tree of more vertices than this."""
    species_file: Path | None = field(default=None, metadata=EXECUTION)
    """Species of your own, laid out like those that come with bbfit (`bbfit grow --list` says where they are)."""

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0)
        check_range("detail", self.detail, 0.1, 10)
        check_range("leaves", self.leaves, 0, 1)
        check_count("max_vertices", self.max_vertices)
