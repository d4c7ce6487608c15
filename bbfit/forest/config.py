"""The options of forests."""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from bbfit.checks import Count, Range, Seed, check_fields, check_file, fail
from bbfit.forest.columns import Coordinates, check_given

Format = Literal["glb", "tiles", "usd", "page"]
"""What shows a forest: a GLB, 3D Tiles, a USD stage, or a web page."""


@dataclass(frozen=True)
class RegisterConfig:
    """How a register of trees is read."""

    coordinates: Coordinates | None = None
    """Unit of the coordinates. Default: degrees for GeoJSON and for columns such as longitude and latitude, meters for others.
    Projected coordinates, such as those of UTM, are meters."""
    columns: tuple[str, ...] = ()
    """Columns with unusual names, as KEY=NAME, for example height=H_BAUM.
    KEY is longitude, latitude, x, y, point, z, height, crown, turn, scale, species or genus.
    Names that are common in registers of cities need none."""
    encoding: str = "utf-8-sig"
    """Encoding of a table's text."""
    incomplete: Literal["refuse", "skip"] = "refuse"
    """What to do with rows whose coordinates are missing or cannot be used."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_given(self.columns)
        try:
            known = codecs.lookup(self.encoding)._is_text_encoding  # not one from bytes to bytes
        except (LookupError, ValueError):
            known = False
        if not known:
            fail("encoding", f"{self.encoding!r} is no encoding of text", "for example utf-8 or latin-1")


@dataclass(frozen=True)
class ScatterConfig:
    """Where trees are scattered instead of read from a register. They are random, and no two are closer than a spacing."""

    scatter: tuple[float, ...] = ()
    """Width and depth of a rectangle in meters, east by north, on which trees are scattered. Its middle is the origin."""
    scatter_area: Path | None = None
    """GeoJSON with polygons on which trees are scattered. Their holes stay free."""
    spacing: Annotated[float, Range(0.1, 1e5)] = 6.0
    """Least distance between two scattered trees in meters. An area has about 0.7 trees for each square of this side."""
    mix: tuple[str, ...] = ()
    """Species or trees of the library that are scattered, with their shares as NAME=SHARE, for example acer=3 apple=1.
    Default: all trees of the library in equal shares."""

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.scatter) not in (0, 2) or not all(0.1 <= side <= 2e5 for side in self.scatter):
            fail("scatter", f"expected a width and a depth of 0.1 to 200,000 meters, got {list(self.scatter)}")
        if self.scatter and self.scatter_area is not None:
            fail("scatter_area", "scatter gives an area too", "leave out one of them")
        for each in self.mix:
            name, sign, share = each.rpartition("=")
            if not sign or not name or not _is_share(share):
                fail("mix", f"expected NAME=SHARE with a share above 0, got {each!r}", "for example acer=3 apple=1")

    @property
    def given(self) -> bool:
        """Whether trees are scattered."""
        return bool(self.scatter) or self.scatter_area is not None

    @property
    def shares(self) -> tuple[tuple[str, float], ...]:
        """The names of the mix with their shares."""
        return tuple((name, float(share)) for name, _, share in (each.rpartition("=") for each in self.mix))


@dataclass(frozen=True)
class ForestConfig:
    """What is written of a forest, and how its trees are chosen."""

    formats: tuple[Format, ...] = ("glb", "tiles")
    """What to write: glb (a GLB with instances), tiles (3D Tiles 1.1), usd (a USD stage; it needs the extra forest), page (a web page)."""
    species_table: Path | None = None
    """Table (CSV) of species: names of the register in the first column, and species or trees of the library in the second column.
    Other names go to a tree of the same species, genus, habit or kind."""
    level: Annotated[int, Range(0)] = 0
    """Level of detail of the trees in the GLB, 0 the finest. A tree with fewer levels has its coarsest one.
    The tiles, the USD stage and the page have all levels."""
    origin: tuple[float, ...] = ()
    """Longitude and latitude of the local frame's origin. Default: the middle of the trees.
    For coordinates in meters it places the forest on the Earth; it has no place there by default."""
    origin_meters: tuple[float, ...] = ()
    """Coordinates in meters that lie at the origin. Default: 0 0, and the middle of the trees for coordinates beyond 100,000 meters."""
    sizes: tuple[float, ...] = (0.85, 1.15)
    """Least and largest factor of a tree's own size, for trees whose height, crown and scale are not known."""
    tile_trees: Count = 4096
    """Most trees of a tile."""
    tile_triangles: Count = 2_000_000
    """Most triangles of a tile of 3D Tiles with a finer level of detail, unless it has a single tree."""
    far_pixels: Annotated[float, Range(0.5, 100)] = 4.0
    """Height of the tallest tree on the screen in pixels below which 3D Tiles show a part of the trees, which are wider instead."""
    title: str = "Forest"
    """Title of the page."""
    seed: Seed = 0
    """Seed of what the register does not say: turns, sizes, and which of several like trees."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.formats or len(set(self.formats)) < len(self.formats):
            fail("formats", f"expected one or more different ones, got {list(self.formats)}")
        if len(self.origin) not in (0, 2) or (self.origin and not (abs(self.origin[0]) <= 180 and abs(self.origin[1]) < 90)):
            fail("origin", f"expected a longitude and a latitude in degrees, got {list(self.origin)}", "for example --origin 13.4 52.5")
        if len(self.origin_meters) not in (0, 2) or not all(abs(value) <= 1e8 for value in self.origin_meters):
            fail("origin_meters", f"expected two coordinates in meters, got {list(self.origin_meters)}")
        if len(self.sizes) != 2 or not 0.01 <= self.sizes[0] <= self.sizes[1] <= 100:
            fail("sizes", f"expected two factors from 0.01 to 100, the least first, got {list(self.sizes)}")
        if self.species_table is not None:
            check_file("species_table", self.species_table)


def _is_share(text: str) -> bool:
    try:
        return 0 < float(text) <= 1e9
    except ValueError:
        return False
