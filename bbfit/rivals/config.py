"""The options of a comparison."""

from __future__ import annotations

from dataclasses import dataclass

from bbfit.checks import Count, check_choice, check_fields

SYSTEMS = (
    "bbfit",
    "bbfit-blend",
    "bbfit-many",
    "bbfit-bytes",
    "thesis",
    "crossed",
    "slicing",
    "cloud",
    "cloud-many",
    "decimated-vertices",
    "decimated-bytes",
    "thinned",
    "draco",
    "learned",
    "learned-many",
    "bbfit-maps",
    "baked-maps",
    "fluffed",
)
"""Names of all systems, in the order of tables."""
LIT = ("bbfit-maps", "baked-maps", "fluffed")
"""Those that take a program's light, for which views need suns."""


@dataclass(frozen=True)
class CompareConfig:
    """Which systems are compared, and how large each is."""

    systems: tuple[str, ...] = ()
    """Names of the systems. Default: all of them. The table names those that are skipped because a package is not installed."""
    billboards: Count = 8
    """Billboards of bbfit's smaller fits, and planes of the smaller billboard cloud."""
    many: Count = 32
    """Billboards of bbfit's larger fit, and planes of the larger billboard cloud."""
    crossed: Count = 4
    """Number of crossed planes."""
    directions: Count = 6
    """Number of slicing directions."""
    slices: Count = 5
    """Slices per direction."""
    mesh_vertices: Count = 500
    """Vertices of the smaller learned mesh."""
    mesh_vertices_many: Count = 2000
    """Vertices of the larger learned mesh."""
    mesh_steps: Count = 600
    """Optimizer steps of a learned mesh."""

    def __post_init__(self) -> None:
        for system in self.systems:
            check_choice("systems", system, SYSTEMS)
        check_fields(self)
