"""From a register or an area to placements in a temporary file: two passes in batches, because the origin depends on all trees."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_file, fail
from bbfit.files import PART, PREFIX
from bbfit.forest.columns import Coordinates
from bbfit.forest.config import ForestConfig, RegisterConfig, ScatterConfig
from bbfit.forest.georeference import Origin, kilometers_on_earth, like_degrees, local_from_degrees
from bbfit.forest.planting import planted
from bbfit.forest.registers import ROW, Register
from bbfit.forest.scattering import scatter_area, scattered
from bbfit.forest.species import Match, named_trees, nearest_trees, read_species_table
from bbfit.library.manifest import Library
from bbfit.stages.stage import OnProgress

SUFFIXES = (".csv", ".tsv", ".txt", ".geojson", ".json")
"""The endings of registers."""
_BATCH = 1 << 16
# Farthest tree from the first one, in meters.
_FARTHEST = 200_000.0
# Fewest trees that are too close together for meters, and the least ground of each in square meters.
_FEWEST, _LEAST_GROUND = 10, 0.25


@dataclass(frozen=True)
class SpeciesUse:
    """A species of a register, and the trees of the library that stand for it."""

    name: str
    """Its name in the register; empty for trees without a species."""
    count: int
    """Number of its trees."""
    likeness: str
    """How near the trees are (:class:`~bbfit.forest.species.Match`)."""
    trees: tuple[str, ...]
    """The names of the trees that may stand for it."""


@dataclass(frozen=True)
class Gathered:
    """All placements of a forest in a file, in the order of the register."""

    file: IO[bytes]
    """Records of the type ``RECORD``."""
    count: int
    """Number of trees."""
    skipped: int
    """Number of rows of the register that were left out."""
    origin: Origin
    species: tuple[SpeciesUse, ...]
    """The species, in the order of their numbers in the records. Trees without a species come last, if there are any."""


@contextmanager
def gathered(
    placements: Path | None,
    library: Library,
    folder: Path,
    config: ForestConfig,
    reading: tuple[RegisterConfig, ScatterConfig],
    on_progress: OnProgress,
) -> Iterator[Gathered]:
    """Read a register, or scatter trees, and choose a tree of the library for each. Temporary files lie in ``folder`` until the end.

    ``reading`` says how the register is read, and where trees are scattered.
    Raises InputError with the row and the column if the register cannot be used.
    """
    register, scatter = reading
    table = {} if config.species_table is None else read_species_table(config.species_table, library)
    parts = [tempfile.NamedTemporaryFile(dir=folder, prefix=PREFIX, suffix=PART) for _ in range(2)]
    with parts[0] as rows, parts[1] as records:
        counts = dict[int, int]()
        if placements is None:
            area = scatter_area(scatter, config)
            origin, degrees, skipped = area.origin, False, 0
            for batch, done in scattered(area, scatter, config.seed):
                _append(rows, batch, counts)
                on_progress("scatter", round(1000 * done), 1000, f"{sum(counts.values()):,} trees")
            names = [name for name, _ in scatter.shares]
            matches = [Match(named_trees(library, name, "mix"), "species") for name in names]
            offset = (0.0, 0.0)
        else:
            reader = Register(placements, register)
            extent = _Extent(placements)
            for batch in reader.batches():
                batch["x"] = extent.widened(batch, reader.coordinates or "meters")
                _append(rows, batch, counts)
                on_progress("read", sum(counts.values()), sum(counts.values()), f"{sum(counts.values()):,} trees")
            degrees, names, skipped = reader.coordinates == "degrees", reader.species, reader.skipped
            if not degrees and register.coordinates is None:
                extent.check_meters(sum(counts.values()))
            origin = extent.origin(config, degrees=degrees)
            matches = [nearest_trees(library, name, table) for name in names]
            offset = (origin.east, origin.north)
        matches.append(Match(tuple(range(len(library.trees))), "any"))
        total, done = sum(counts.values()), 0
        for batch in _batches(rows):
            places = np.stack([batch["x"], batch["y"]], -1)
            places = local_from_degrees(origin, places) if degrees else places - offset
            records.write(planted(batch, places, library, matches, config).tobytes())
            done += len(batch)
            on_progress("plant", done, total)
        records.flush()
        used = [(number, name) for number, name in enumerate(names)] + ([(-1, "")] if -1 in counts else [])
        species = tuple(
            SpeciesUse(
                name, counts.get(number, 0), matches[number].likeness, tuple(library.trees[tree].name for tree in matches[number].trees)
            )
            for number, name in used
        )
        yield Gathered(records, total, skipped, origin, species)


class _Extent:
    """The bounds of the coordinates of a register, and its first tree."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._first: NDArray[np.float64] | None = None
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        self._bounds = np.array([self._low, self._high])  # without trees at 0, 0, where many registers have those of unknown place

    def widened(self, batch: NDArray[np.void], coordinates: Coordinates) -> NDArray[np.float64]:
        """Add a batch. Returns its x; longitudes are those nearest to the first one, so that a forest may lie on both sides of 180 degrees.

        Raises InputError if a tree is far away from the first one.
        """
        places = np.stack([batch["x"], batch["y"]], -1)
        first = self._first = places[0] if self._first is None else self._first
        apart = places - first
        if coordinates == "degrees":
            apart[:, 0] = (apart[:, 0] + 180) % 360 - 180
            places[:, 0] = first[0] + apart[:, 0]
            apart *= np.radians(6371e3) * np.array([np.cos(np.radians(first[1])), 1])
        distances = np.hypot(*apart.T)
        far = int(np.argmax(distances))
        if distances[far] > _FARTHEST:
            kind = "feature" if self._path.suffix.lower() in (".geojson", ".json") else "row"
            problem = f"{self._path}, {kind} {batch['row'][far]} is {distances[far] / 1000:,.0f} km away from the first tree"
            fail("placements", f"{problem}, expected at most {_FARTHEST / 1000:g} km", "correct its coordinates, or remove the row")
        self._low, self._high = np.minimum(self._low, places.min(0)), np.maximum(self._high, places.max(0))
        if len(known := places[places.any(1)]):
            self._bounds = np.array([np.minimum(self._bounds[0], known.min(0)), np.maximum(self._bounds[1], known.max(0))])
        return places[:, 0]

    def check_meters(self, count: int) -> None:
        """Require that ``count`` trees with coordinates in meters are not as close together as degrees would be."""
        sides = self._bounds[1] - self._bounds[0]
        if count >= _FEWEST and like_degrees(self._bounds) and 0 < sides.max() ** 2 < count * _LEAST_GROUND:
            problem = f"{self._path} has {count:,} trees on {sides[0]:.3g} by {sides[1]:.3g} meters"
            fail("placements", problem, "give --coordinates degrees, or --coordinates meters if these are meters")

    def origin(self, config: ForestConfig, *, degrees: bool) -> Origin:
        """The origin of the local frame. Raises InputError if a given one is far away from the middle of trees in degrees."""
        middle = (self._low + self._high) / 2
        if degrees:
            origin = Origin(*(config.origin or np.round(middle, 6).tolist()))
            far = kilometers_on_earth(middle[None], np.array([[origin.longitude, origin.latitude]])).item()
            if far > _FARTHEST / 1000:
                problem = f"is {far:,.0f} km away from the trees, expected at most {_FARTHEST / 1000:g} km"
                fail("origin", problem, "give the longitude first, then the latitude")
            return origin
        far = max(np.abs(self._low).max(), np.abs(self._high).max()) > 1e5
        offset = config.origin_meters or (np.round(middle).tolist() if far else (0.0, 0.0))
        return Origin(*(config.origin or (None, None)), *offset)


def check_placements(placements: Path | None, config: ForestConfig, register: RegisterConfig, scatter: ScatterConfig) -> None:
    """Require either a register with a known ending or an area, and options that fit."""
    if (placements is None) != scatter.given:
        fail("placements", "expected a register, or an area to scatter trees on", "give PLACEMENTS, or --scatter, or --scatter-area")
    if placements is None:
        for option in ("columns", "coordinates"):
            if getattr(register, option):
                fail(option, "a register is not read where trees are scattered", f"omit {option}")
        return
    check_file("placements", placements)
    if placements.suffix.lower() not in SUFFIXES:
        fail("placements", f"{placements} ends in {placements.suffix or 'nothing'}", f"expected one of {', '.join(SUFFIXES)}")
    if scatter.mix:
        fail("mix", "the register has the species", "omit the mix")
    if register.coordinates == "degrees" and config.origin_meters:
        fail("origin_meters", "the coordinates are degrees", "omit it")


def _append(file: IO[bytes], batch: NDArray[np.void], counts: dict[int, int]) -> None:
    """Append a batch to a temporary file, and count its species."""
    file.write(batch.astype(ROW, copy=False).tobytes())
    file.flush()
    for number, count in zip(*np.unique(batch["species"], return_counts=True), strict=True):
        counts[int(number)] = counts.get(int(number), 0) + int(count)


def _batches(file: IO[bytes]) -> Iterator[NDArray[np.void]]:
    file.seek(0)
    while data := file.read(_BATCH * ROW.itemsize):
        yield np.frombuffer(data, ROW)
