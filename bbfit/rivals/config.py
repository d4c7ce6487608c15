"""Which systems a tree is given to, to be compared."""

from __future__ import annotations

from dataclasses import dataclass

from bbfit.checks import check_choice, check_count

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
)
"""Names of all systems, in the order of tables."""


@dataclass(frozen=True)
class CompareConfig:
    """What a tree's views are compared with."""

    systems: tuple[str, ...] = ()
    """Which systems, by name; all if left out. Those that need a package which is not installed are said to be left out."""
    billboards: int = 8
    """Planes of bbfit's smaller fits and of the smaller billboard cloud."""
    many: int = 32
    """Planes of a larger fit and of the larger billboard cloud."""
    crossed: int = 4
    """Crossed planes."""
    directions: int = 6
    """Slicings."""
    slices: int = 5
    """Slices of each."""
    mesh_vertices: int = 500
    """Vertices of the smaller learned mesh."""
    mesh_vertices_many: int = 2000
    """Vertices of the larger learned mesh."""
    mesh_steps: int = 600
    """Steps in which a mesh is learned."""

    def __post_init__(self) -> None:
        for system in self.systems:
            check_choice("systems", system, SYSTEMS)
        for name in ("billboards", "many", "crossed", "directions", "slices", "mesh_vertices", "mesh_vertices_many", "mesh_steps"):
            check_count(name, getattr(self, name))
