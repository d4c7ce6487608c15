"""The options of a comparison."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any

from bbfit.checks import Count, Range, check_choice
from bbfit.workers.config import WorkersConfig

SYSTEMS = (
    "bbfit-default",
    "bbfit-default-blend",
    "bbfit-default-coverage",
    "bbfit-rectangles",
    "bbfit-small",
    "bbfit-fine",
    "bbfit",
    "bbfit-few",
    "bbfit-blend",
    "bbfit-many",
    "bbfit-medium",
    "bbfit-most",
    "bbfit-most-coverage",
    "bbfit-bytes",
    "thesis",
    "crossed",
    "slicing",
    "cloud",
    "cloud-many",
    "octahedral",
    "octahedral-flat",
    "octahedral-mask",
    "decimated-vertices",
    "decimated-bytes",
    "thinned",
    "thinned-large",
    "thinned-triangles",
    "height-fields",
    "draco",
    "learned",
    "learned-many",
    "radiance-field",
    "bbfit-maps",
    "baked-maps",
    "fluffed",
)
"""Names of all systems, in the order of tables."""
LIT = ("bbfit-maps", "baked-maps", "fluffed")
"""Those that take a program's light, for which views need suns."""


@dataclass(frozen=True)
class CompareConfig(WorkersConfig):
    """Which systems are compared, how large each is, and where a comparison on many trees runs."""

    systems: tuple[str, ...] = ()
    """Names of the systems. Default: all of them. The table names those that are skipped because a package is not installed."""
    billboards: Count = 8
    """Billboards of the fits that others are compared with, and planes of the smaller billboard cloud."""
    many: Count = 32
    """Billboards of a larger fit, and planes of the larger billboard cloud."""
    few: Count = 2
    """Billboards of bbfit's smallest fit."""
    medium: Count = 125
    """Billboards of a fit with about the vertices of the smaller learned mesh."""
    most: Count = 500
    """Billboards of bbfit's largest fit."""
    crossed: Count = 4
    """Number of crossed planes."""
    directions: Count = 6
    """Number of slicing directions."""
    slices: Count = 5
    """Slices per direction."""
    frames: Annotated[int, Range(2, 256)] = 12
    """Directions along each side of the grid of an octahedral impostor."""
    hemisphere: bool = True
    """Whether all of these directions are above the horizon. Otherwise half of them are below."""
    large_bytes: Count = 1_000_000
    """Most bytes of the larger tree that is thinned out."""
    thinned_triangles: Count = 10_000
    """Triangles of a tree that is thinned out to a number of them."""
    mesh_vertices: Annotated[int, Range(20, 20_000)] = 500
    """Vertices of the smaller learned mesh."""
    mesh_vertices_many: Annotated[int, Range(20, 20_000)] = 2000
    """Vertices of the larger learned mesh."""
    mesh_steps: Count = 600
    """Optimizer steps of a learned mesh."""
    field_steps: Annotated[int, Range(3)] = 3000
    """Optimizer steps of a radiance field."""
    tree_height: Count = 100
    """Height of the tree in pixels in the smaller pictures of the score from afar."""
    fragments_per_triangle: Annotated[float, Range(0, 1e6)] = 3.4
    """How many pixels of triangles (fragments) are shaded in the time that a triangle takes; bbfit frames measures it.
    The cost of drawing counts fragments and triangles."""

    def __post_init__(self) -> None:
        for system in self.systems:
            check_choice("systems", system, SYSTEMS)
        super().__post_init__()

    @property
    def compared(self) -> dict[str, Any]:
        """The options that affect results: all but where tasks run."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name not in WorkersConfig.__dataclass_fields__}
