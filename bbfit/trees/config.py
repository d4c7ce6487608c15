"""The options of growing a tree."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from bbfit.checks import Count, Range, Seed, check_fields
from bbfit.provenance import EXECUTION

VERTEX_LIMIT = 20_000_000
"""Default limit of a tree's vertices; a willow has half as many."""


@dataclass(frozen=True)
class GrowConfig:
    """Options of growing a tree."""

    seed: Seed = 0
    """Seed of the tree: each seed grows a different tree of the species."""
    detail: Annotated[float, Range(0.1, 10)] = 1.0
    """Fineness of the bark, in [0.1, 10]: a factor on the rings along stems and on each ring's corners; vertices grow with its square."""
    leaves: Annotated[float, Range(0, 1)] = 1.0
    """Share of the leaves that grow, in [0, 1]; fewer leaves are larger, so that their total area stays."""
    max_vertices: Count = field(default=VERTEX_LIMIT, metadata=EXECUTION)
    """Refuse to grow a tree of more vertices than this."""
    species_file: Path | None = field(default=None, metadata=EXECUTION)
    """File with your own species, in the format of those that come with bbfit (`bbfit grow --list` prints where they are)."""

    def __post_init__(self) -> None:
        check_fields(self)
