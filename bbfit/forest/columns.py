"""The columns of tree registers: what their names mean in six languages, and how their cells are read."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from bbfit.checks import fail

Coordinates = Literal["degrees", "meters"]
"""The unit of coordinates: longitude and latitude in degrees, or plain or projected meters."""
# For each value of a tree the names of columns, without accents, spaces and signs, the most telling first.
NAMES: Mapping[str, tuple[str, ...]] = {
    "longitude": ("longitude", "lon", "lng", "long", "geolon", "laengengrad", "langengrad", "lengtegraad", "longitud", "longitudine"),
    "latitude": ("latitude", "lat", "geolat", "breitengrad", "breedtegraad", "latitud", "latitudine"),
    "x": (
        *("x", "easting", "east", "rechtswert", "ostwert", "xcoord", "xcoordinate", "xkoordinate", "coordx", "coordonneex", "xcoordinaat"),
        *("xrd", "xutm", "utmx", "coordenadax", "coordinatax"),
    ),
    "y": (
        *("y", "northing", "north", "hochwert", "nordwert", "ycoord", "ycoordinate", "ykoordinate", "coordy", "coordonneey", "ycoordinaat"),
        *("yrd", "yutm", "utmy", "coordenaday", "coordinatay"),
    ),
    "point": ("geopoint2d", "geopoint", "shape", "thegeom", "geom", "geometry", "geometrie", "wkt", "wktgeom"),
    "z": ("z", "elevation", "groundheight", "gelaendehoehe", "gelandehohe", "altitude"),
    "height": (
        *("height", "heightm", "treeheight", "treeheightm", "totalheight", "heightft", "treeheightft", "hoehe", "hohe", "hoehem", "hohem"),
        *("baumhoehe", "baumhohe", "baumhoehem", "baumhohem", "hauteur", "hauteurm", "hauteurenm", "hauteurtotale", "hoogte", "hoogtem"),
        *("boomhoogte", "altura", "alturam", "altezza", "altezzam", "heightcm", "treeheightcm"),
    ),
    "crown": (
        *("crown", "crowndiameter", "crowndiameterm", "crownwidth", "crownspread", "spread", "kronendurchmesser", "kronedurch"),
        *("crownft", "crowndiameterft", "crowncm", "crowndiametercm"),
        *("kronendurchmesserm", "kronenbreite", "kronedurchmesser", "diametrecouronne", "envergure", "kroondiameter", "diametrocopa"),
    ),
    "turn": ("turn", "rotation", "angle", "drehung"),
    "scale": ("scale", "factor", "massstab"),
    "species": (
        *("species", "scientificname", "botanicalname", "latinname", "scientific", "sciname", "botname", "speciesbotanical", "spclatin"),
        *("treespecies", "taxon", "taxonname", "speciesname", "artbot", "artlatein", "artlat", "baumartlat", "baumartlatein", "gattungart"),
        *("gattungartlatein", "baumart", "art", "artdtsch", "baumartdeutsch", "nomlatin", "nomscientifique", "espece", "essence"),
        *("libellefrancais", "soortnaam", "soortnaamtop", "boomsoort", "soort", "wetenschappelijkenaam", "nombrecientifico", "especie"),
        *("nomescientifico", "specie", "commonname", "speciescommon", "spccommon", "treename"),
    ),
    "genus": ("genus", "gattung", "gattunglat", "genre", "geslacht", "genero", "genere"),
}
"""Names of columns for each value of a tree, without accents, spaces and signs."""
_UNITS = {"ft": 0.3048, "feet": 0.3048, "foot": 0.3048, "cm": 0.01, "m": 1.0}
# Feet as a word of their own, also in HtFt, or right behind what is measured; not in "Luft". No common word ends in cm.
_FEET_AT_END = r"(?:^|[^A-Za-z]|[a-z](?=F)|(?i:height|ht|crown|diameter|width|spread))(?P<feet>(?i:feet|foot|ft))"
_UNIT_AT_END = re.compile(rf"(?:{_FEET_AT_END}|(?P<cm>(?i:cm)))[^A-Za-z]*$")
_FEET_AND_INCHES = re.compile("\\d\\s*['\"\u2019\u201d\u2032\u2033]")
_NUMBER = re.compile(r"\d+(?:[.,]\d+)?")
_POINT = re.compile(r"\s*POINT\s*Z?\s*\(\s*(\S+)\s+(\S+?)(?:\s+(\S+?))?\s*\)\s*", re.IGNORECASE)
_EMPTY = ("", "na", "n/a", "nan", "null", "none", "-", "?", "unknown", "unbekannt", "inconnu", "onbekend")


@dataclass(frozen=True)
class Columns:
    """Which column of a table has which value of a tree."""

    names: Mapping[str, str]
    """The names of the columns in the table, by the keys of :data:`NAMES`."""
    units: Mapping[str, float]
    """Factors to meters of the columns of lengths that are not in meters, by the same keys."""

    @property
    def places(self) -> tuple[str, ...]:
        """The keys of the columns of coordinates: longitude and latitude, x and y, or point; empty if there are none."""
        for pair in (("longitude", "latitude"), ("x", "y"), ("point",)):
            if all(key in self.names for key in pair):
                return pair
        return ()


def plain(text: str) -> str:
    """A text in lower case, without accents, spaces and signs, to compare names."""
    letters = unicodedata.normalize("NFKD", text.replace("ß", "ss").casefold())
    return "".join(letter for letter in letters if letter.isalnum())


def find_columns(header: Iterable[str], given: Sequence[str] = ()) -> Columns:
    """The columns of a table with a header. ``given`` names some of them, as in ``height=BAUMHOEHE``; they take precedence.

    Raises InputError if a given column is not in the header or has no known key.
    """
    names = [name for name in header if isinstance(name, str)]
    plains = dict[str, str]()
    for name in names:
        plains.setdefault(plain(name), name)
    found = dict[str, str]()
    for key, known in NAMES.items():
        match = next((plains[word] for word in known if word in plains), None)
        if match is not None:
            found[key] = match
    found |= dict(_given(each, names) for each in given)
    units = dict[str, float]()
    for key in {"height", "crown"} & found.keys():
        unit = _UNIT_AT_END.search(found[key])
        units |= {key: _UNITS["feet" if unit["feet"] else "cm"]} if unit else {}
    return Columns(found, units)


def check_given(columns: Sequence[str]) -> None:
    """Require that each of ``columns`` has the form ``KEY=NAME`` with a key of :data:`NAMES`."""
    for each in columns:
        key, sign, name = each.partition("=")
        if not sign or not name or key not in NAMES:
            fail("columns", f"expected KEY=NAME with a KEY of {', '.join(NAMES)}, got {each!r}", "for example height=BAUMHOEHE")


def _given(each: str, names: Sequence[str]) -> tuple[str, str]:
    key, _, name = each.partition("=")
    if name not in names:
        fail("columns", f"the table has no column {name}", f"it has {', '.join(names[:40])}")
    return key, name


def is_empty(value: Any) -> bool:
    """Whether a cell says nothing."""
    return value is None or (isinstance(value, str) and value.strip().casefold() in _EMPTY)


def number(value: Any, *, comma: bool) -> float:
    """The number in a cell, with ``comma`` also if it has a decimal comma. Raises ``ValueError`` if it is no finite number."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError("is no number")
    if isinstance(value, str):
        value = value.strip()
        if comma and value.count(",") == 1 and "." not in value:
            value = value.replace(",", ".")
    try:
        found = float(value)
    except (ValueError, OverflowError):
        raise ValueError("is no number") from None
    if not math.isfinite(found):
        raise ValueError("is no finite number")
    return found


def length(value: Any, *, comma: bool, factor: float = 1.0) -> float:
    """The length in a cell in meters: a number, or the middle of a class such as ``6-10 m``.

    ``factor`` makes meters of a number without a unit; a unit in the cell takes precedence. Raises ``ValueError`` if there is no number,
    or more than two, or feet and inches.
    """
    try:
        return factor * number(value, comma=comma)
    except ValueError:
        numbers = [float(each.replace(",", ".")) for each in _NUMBER.findall(value)] if isinstance(value, str) else []
        if not 1 <= len(numbers) <= 2 or value.strip().startswith("-") or not all(map(math.isfinite, numbers)):
            raise
        if _FEET_AND_INCHES.search(value):
            raise ValueError("has signs of feet or inches; give meters, or feet as in 12.5 ft") from None
        unit = re.search(r"(?<![^\W\d_])(feet|foot|ft|cm|m)(?![^\W\d_])", value.casefold())
        return (_UNITS[unit[1]] if unit else factor) * sum(numbers) / len(numbers)


def point(value: Any) -> tuple[float, float]:
    """X and y in a cell: ``POINT (x y)`` of well-known text, or ``latitude, longitude``. Raises ``ValueError`` if it is neither."""
    text = value if isinstance(value, str) else ""
    match = _POINT.fullmatch(text)
    if match:
        return number(match[1], comma=False), number(match[2], comma=False)
    parts = text.split(",")
    if len(parts) != 2:
        raise ValueError("is no point")
    return number(parts[1], comma=False), number(parts[0], comma=False)
