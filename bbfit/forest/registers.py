"""Tree registers: tables (CSV) and GeoJSON with a tree in each row, read in batches, so that a register need not fit in memory."""

from __future__ import annotations

import codecs
import csv
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import InputError, fail
from bbfit.forest import columns
from bbfit.forest.columns import Columns, Coordinates, find_columns
from bbfit.forest.config import RegisterConfig
from bbfit.forest.georeference import coordinates_of, is_projected
from bbfit.inputs import reading

ROW = np.dtype(
    [
        *[(name, "<f8") for name in ("x", "y", "z")],
        *[(name, "<f4") for name in ("height", "crown", "turn", "scale")],
        *[("species", "<i4"), ("row", "<i8")],
    ]
)
"""A row of a register: its numbers in meters and degrees, NaN where it has none, and its species as an index into the names, or -1."""
_BATCH = 1 << 16
_MOST_SPECIES = 65_535  # the numbers of 16 bits that tiles have for names
_PIECE, _LONGEST_FEATURE = 1 << 20, 1 << 22
_DELIMITERS = ",;\t|"
_FEATURES = re.compile(r'"features"\s*:\s*\[')
_HINT = "export it again as CSV or GeoJSON with points"
# Highest tree of a register in meters. The highest known one has 116 m.
_HIGHEST, _WIDEST = 150.0, 100.0


class Register:
    """A register that is being read; iterate over :meth:`batches` once, then the other attributes are complete."""

    def __init__(self, path: Path, config: RegisterConfig) -> None:
        """Prepare to read a file with the ending ``.csv``, ``.tsv``, ``.txt``, ``.geojson`` or ``.json``."""
        self.path, self._config = path, config
        self.species = list[str]()
        """The names of species in the order of their first row."""
        self.skipped = 0
        """Number of rows that were left out, because they have no usable coordinates."""
        self.coordinates: Coordinates | None = config.coordinates
        """The unit of its coordinates, known after the first row."""
        self._numbers = dict[str, int]()
        self._comma = True
        self._kinds = dict[str, int]()  # the first rows with coordinates like degrees and like projected meters
        self._header: Columns | None = None  # of a table
        self._known = dict[tuple[str, ...], Columns]()
        self._unseen = {each.partition("=")[2] for each in config.columns}  # given columns that no feature had so far
        self._system: str | None = None  # what a GeoJSON names as its reference system
        self._is_projected = False

    def batches(self) -> Iterator[NDArray[np.void]]:
        """Its rows as records of the type :data:`ROW`, at most 65,536 at a time.

        Raises InputError with the row and the column if a value cannot be used, or if the coordinates have different reference systems.
        """
        with reading("placements", self.path, _HINT):
            found = self._features() if self.path.suffix.lower() in (".geojson", ".json") else self._table()
            batch, total = list[tuple[Any, ...]](), 0
            for row, values, geometry in found:
                record = self._record(row, values, geometry)
                if record is None:
                    self.skipped += 1
                    continue
                batch.append(record)
                if len(batch) == _BATCH:
                    yield np.array(batch, ROW)
                    total, batch = total + len(batch), []
            if batch:
                yield np.array(batch, ROW)
        if not total and not batch:
            fail("placements", f"{self.path} has no trees", _HINT)
        if self._header is None and self._unseen:
            fail("columns", f"no feature of {self.path} has the property {min(self._unseen)}", "correct its name, or leave it out")

    def _table(self) -> Iterator[tuple[int, Mapping[str, Any], Any]]:
        """The rows of a table: their numbers as spreadsheet programs count, their cells by the columns' names."""
        with self.path.open(encoding=self._config.encoding, newline="") as file:
            rows = None
            try:
                head = file.readline(_PIECE)
                delimiter = max(_DELIMITERS, key=head.count)
                self._comma = delimiter != ","
                file.seek(0)
                rows = csv.reader(file, delimiter=delimiter, strict=True)
                header = [name.strip() for name in next(rows, [])]
                found = find_columns(header, self._config.columns)
                if not found.places:
                    fail(
                        "placements",
                        f"{self.path} has no columns of coordinates such as x and y, or longitude and latitude",
                        f"it has {', '.join(header[:40]) or 'none'}; name them as in --columns x={header[0] if header else 'NAME'} y=...",
                    )
                self._header = found
                for number, cells in enumerate(rows, 2):
                    if any(cell.strip() for cell in cells[len(header) :]):
                        problem = f"{self.path}, row {number} has {len(cells)} cells, and the header has {len(header)}"
                        fail("placements", problem, f"put cells that contain {delimiter!r} into quotes")
                    if any(cells):
                        yield number, dict(reversed([*zip(header, cells, strict=False)])), None  # of two columns of a name the first counts
            except UnicodeDecodeError as error:
                encoding = "utf-16" if error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "latin-1"
                fail("placements", f"{self.path} is no text in {self._config.encoding} ({error.reason})", f"try --encoding {encoding}")
            except csv.Error as error:
                fail("placements", f"{self.path}, row {rows.line_num if rows else 1} cannot be read ({error})", _HINT)

    def _features(self) -> Iterator[tuple[int, Mapping[str, Any], Any]]:
        """The features of a GeoJSON, one at a time: their numbers from 1, their properties and their geometries."""
        with self.path.open(encoding="utf-8-sig") as file:
            text = file.read(_PIECE)
            start = _FEATURES.search(text)
            if start is None:
                fail("placements", f"{self.path} is no GeoJSON with features", _HINT)
            self._note_system(text[: start.start()])
            yield from self._each_feature(file, text[start.end() :])

    def _each_feature(self, file: TextIO, text: str) -> Iterator[tuple[int, Mapping[str, Any], Any]]:
        decoder, at, number = json.JSONDecoder(), 0, 0
        while True:
            while at < len(text) and text[at] in " \t\r\n,":
                at += 1
            if at < len(text) and text[at] == "]":
                break
            try:
                feature, end = decoder.raw_decode(text, at)
            except (ValueError, RecursionError) as error:
                more = file.read(_PIECE) if len(text) - at < _LONGEST_FEATURE else ""
                if not more:
                    fail("placements", f"{self.path}, feature {number + 1} is cut short or no JSON ({error})", _HINT)
                text, at = text[at:] + more, 0
                continue
            number, at = number + 1, end
            if at > _PIECE:
                text, at = text[at:], 0
            yield (number, *self._feature(number, feature))
        tail = text[at + 1 :] + file.read(_PIECE)
        try:
            json.loads('{"features": []' + tail)
        except (ValueError, RecursionError) as error:
            fail("placements", f"{self.path} does not end as JSON after feature {number} ({error})", _HINT)

    def _feature(self, number: int, feature: Any) -> tuple[Mapping[str, Any], Any]:
        """The properties and the geometry of a feature."""
        if not isinstance(feature, dict):
            fail("placements", f"feature {number} is no object", _HINT)
        properties = feature.get("properties")
        return properties if isinstance(properties, dict) else {}, feature.get("geometry")

    def _point(self, row: int, geometry: Any) -> list[Any]:
        """The coordinates of a geometry."""
        if not isinstance(geometry, dict):
            self._refuse(row, "geometry", "is missing")
        place = geometry.get("coordinates")
        if geometry.get("type") == "MultiPoint" and isinstance(place, list) and len(place) == 1:
            place = place[0]
        elif geometry.get("type") != "Point":
            self._refuse(row, "geometry", f"is a {str(geometry.get('type'))[:40]}, not a Point")
        if not isinstance(place, list) or not 2 <= len(place) <= 4:
            self._refuse(row, "geometry", "has no coordinates")
        return place

    def _note_system(self, head: str) -> None:
        """The unit of a GeoJSON's coordinates, by the member ``crs`` of older files."""
        system = re.search(r'"crs"\s*:\s*\{[^{}]*"properties"\s*:\s*\{[^{}]*"(name|code)"\s*:\s*"?([^",}]*)', head)
        name = None if system is None else f"EPSG:{system[2].strip()}" if system[1] == "code" else system[2]
        try:
            self.coordinates = self.coordinates or coordinates_of(name) or "meters"
        except ValueError as error:
            fail("placements", f"{self.path} {error}", "export it in EPSG:4326, or give --coordinates meters")
        self._system, self._is_projected = name, is_projected(name)

    def _record(self, row: int, values: Mapping[str, Any], geometry: Any) -> tuple[Any, ...] | None:
        """The record of a row, or ``None`` if it has no usable coordinates and such rows are left out."""
        found = self._columns(values)
        try:
            x, y, z = self._place(row, values, geometry, found)
            self._check_place(row, x, y, found)
        except InputError:
            if self._config.incomplete == "skip":
                return None
            raise
        self._check_system(row, x, y, found)
        height = self._length(row, values, found, "height", _HIGHEST)
        crown = self._length(row, values, found, "crown", _WIDEST)
        scale = self._number(row, values, found, "scale")
        if scale <= 0:
            self._refuse(row, found.names["scale"], f"is {scale:g}, not more than 0")
        return x, y, z, height, crown, self._number(row, values, found, "turn"), scale, self._species(row, values, found), row

    def _columns(self, values: Mapping[str, Any]) -> Columns:
        """The columns of a table, or of the properties of a feature, which may differ between features."""
        if self._header is not None:
            return self._header
        keys = tuple(values)
        if keys not in self._known:
            if len(self._known) > 1000:
                self._known.clear()
            self._unseen -= set(keys)
            self._known[keys] = find_columns(keys, [each for each in self._config.columns if each.partition("=")[2] in values])
        return self._known[keys]

    def _place(self, row: int, values: Mapping[str, Any], geometry: Any, found: Columns) -> tuple[float, float, float]:
        z = self._number(row, values, found, "z")
        if self._header is None:
            place = self._point(row, geometry)
            try:
                x, y = (columns.number(value, comma=False) for value in place[:2])
            except ValueError as error:
                self._refuse(row, "geometry", f"has {place!r:.60}, which {error}")
            return x, y, z
        keys = found.places
        if keys == ("point",):
            x, y = self._cell(row, values, found, "point", columns.point)
        else:
            x, y = (self._cell(row, values, found, key, lambda value: columns.number(value, comma=self._comma)) for key in keys)
        if self.coordinates is None:
            degrees = keys == ("longitude", "latitude") or (keys == ("point",) and abs(x) <= 180 and abs(y) <= 90)
            self.coordinates = "degrees" if degrees else "meters"
        return x, y, z

    def _check_place(self, row: int, x: float, y: float, found: Columns) -> None:
        """Require a place on the Earth."""
        names = self._place_names(found)
        if self.coordinates == "degrees":
            if x == y == 0:
                self._refuse(row, " and ".join(names), "is 0, 0, which is no place of a tree")
            for value, most, name in ((x, 180, names[0]), (y, 90, names[-1])):
                if abs(value) > most:
                    problem = f"is {value:g}, expected degrees from -{most} to {most}"
                    self._refuse(row, name, problem, "if these are meters, give --coordinates meters; do not mix reference systems")
            return
        if max(abs(x), abs(y)) > 1e8:
            self._refuse(row, names[0], f"is ({x:g}, {y:g}), expected meters up to 100,000,000")
        if x == y == 0 and ("meters" in self._kinds or self._is_projected):
            self._refuse(row, " and ".join(names), "is 0, 0, which is no place of a tree")
        if (kind := _kind(x, y)) is not None:
            self._kinds.setdefault(kind, row)

    def _check_system(self, row: int, x: float, y: float, found: Columns) -> None:
        """Require the reference system of the rows before, unless the unit of the coordinates is given."""
        if self.coordinates == "degrees" or self._config.coordinates is not None:
            return
        names = self._place_names(found)
        if self._is_projected and _kind(x, y) == "degrees":
            problem = f"is ({x:g}, {y:g}), which looks like degrees, and the file names the system {str(self._system)[:60]}"
            self._refuse(row, " and ".join(names), problem, "give --coordinates degrees or --coordinates meters")
        if len(self._kinds) == 2:
            kind = _kind(x, y)
            other = next(number for name, number in self._kinds.items() if name != kind)
            problem = f"is ({x:g}, {y:g}), which looks like {kind}, and row {other} does not"
            hint = "give all rows one reference system; if all are meters, give --coordinates meters"
            self._refuse(row, " and ".join(names), problem, hint)

    def _place_names(self, found: Columns) -> list[str]:
        """The names of the columns of coordinates."""
        return [found.names[key] for key in found.places] if self._header is not None else ["geometry"]

    def _cell(self, row: int, values: Mapping[str, Any], found: Columns, key: str, read: Any) -> Any:
        name = found.names[key]
        value = values.get(name)
        if columns.is_empty(value):
            self._refuse(row, name, f"is {'NaN' if str(value).strip().casefold() == 'nan' else 'empty'}")
        try:
            return read(value)
        except ValueError as error:
            self._refuse(row, name, f"is {value!r:.60}, which {error}")

    def _number(self, row: int, values: Mapping[str, Any], found: Columns, key: str) -> float:
        """An optional number: NaN if there is no such column, or its cell is empty."""
        if key not in found.names or columns.is_empty(values.get(found.names[key])):
            return math.nan
        value = self._cell(row, values, found, key, lambda value: columns.number(value, comma=self._comma))
        if abs(value) > 1e6:
            self._refuse(row, found.names[key], f"is {value:g}, expected at most 1,000,000")
        return float(value)

    def _length(self, row: int, values: Mapping[str, Any], found: Columns, key: str, most: float) -> float:
        """An optional length in meters. Registers write 0 where they do not know it."""
        if key not in found.names or columns.is_empty(values.get(found.names[key])):
            return math.nan
        factor = found.units.get(key, 1.0)
        value = self._cell(row, values, found, key, lambda value: columns.length(value, comma=self._comma, factor=factor))
        if not 0 <= value <= most:
            self._refuse(row, found.names[key], f"is {value:g} m, expected 0 to {most:g} m")
        return value or math.nan

    def _species(self, row: int, values: Mapping[str, Any], found: Columns) -> int:
        words = [values.get(found.names[key]) for key in ("genus", "species") if key in found.names]
        genus, *epithet = [str(word).strip()[:200] for word in words if not columns.is_empty(word)] or [""]
        name = genus if not epithet else epithet[0] if epithet[0].casefold().startswith(genus.casefold()) else f"{genus} {epithet[0]}"
        if not name:
            return -1
        if name not in self._numbers:
            if len(self.species) == _MOST_SPECIES:
                self._refuse(
                    row, found.names.get("species", "species"), f"is one more species than {_MOST_SPECIES:,}", "choose another column"
                )
            self._numbers[name] = len(self.species)
            self.species.append(name)
        return self._numbers[name]

    def _refuse(self, row: int, column: str, problem: str, hint: str = "") -> NoReturn:
        """Raise InputError for a cell."""
        kind = "feature" if self.path.suffix.lower() in (".geojson", ".json") else "row"
        hint = hint or "correct it, or remove the row"
        fail("placements", f"{self.path}, {kind} {row}, column {column} {problem}", hint)


def _kind(x: float, y: float) -> str | None:
    """What coordinates look like: degrees, or projected meters; ``None`` if they may be both or neither."""
    if abs(x) <= 180 and abs(y) <= 90:
        return "degrees"
    return "meters" if max(abs(x), abs(y)) > 1e4 else None
