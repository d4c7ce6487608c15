"""Options of growing a tree: the seed and the level of detail."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bbfit.checks import check_count, check_range
from bbfit.provenance import EXECUTION

VERTEX_LIMIT = 20_000_000
"""Default limit on a tree's vertices; a willow has half as many."""


@dataclass(frozen=True)
class GrowConfig:
    """Options of growing a tree."""

    seed: int = 0
    """Another seed gives another tree of the same species."""
    detail: float = 1.0
    """Factor on the rings along stems and on the corners of each ring, in [0.1, 10]. The number of bark vertices grows with its square."""
    leaves: float = 1.0
    """Share of the leaves that grow, in [0, 1]. The remaining leaves are enlarged to keep the total area."""
    max_vertices: int = field(default=VERTEX_LIMIT, metadata=EXECUTION)
    """Largest number of vertices; a larger tree is refused."""
    species_file: Path | None = field(default=None, metadata=EXECUTION)
    """Your own species, in the format of the packaged ones (`bbfit grow --list` prints their path)."""

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0)
        check_range("detail", self.detail, 0.1, 10)
        check_range("leaves", self.leaves, 0, 1)
        check_count("max_vertices", self.max_vertices)
