"""The systems that ``bbfit compare`` runs on a tree."""

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
    """Systems to compare, and their sizes."""

    systems: tuple[str, ...] = ()
    """Names of the systems; all if left out. Systems whose package is not installed are skipped and reported."""
    billboards: int = 8
    """Planes of bbfit's smaller fits and of the smaller billboard cloud."""
    many: int = 32
    """Planes of the larger fit and of the larger billboard cloud."""
    crossed: int = 4
    """Number of crossed planes."""
    directions: int = 6
    """Number of slicings."""
    slices: int = 5
    """Slices per slicing."""
    mesh_vertices: int = 500
    """Vertices of the smaller learned mesh."""
    mesh_vertices_many: int = 2000
    """Vertices of the larger learned mesh."""
    mesh_steps: int = 600
    """Optimization steps of a learned mesh."""

    def __post_init__(self) -> None:
        for system in self.systems:
            check_choice("systems", system, SYSTEMS)
        for name in ("billboards", "many", "crossed", "directions", "slices", "mesh_vertices", "mesh_vertices_many", "mesh_steps"):
            check_count(name, getattr(self, name))
