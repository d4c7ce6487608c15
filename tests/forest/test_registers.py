"""Registers of trees: what is read from the columns of cities, and the line that names the row and the column of a bad value."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.checks import InputError
from bbfit.forest.columns import find_columns, length, number
from bbfit.forest.config import RegisterConfig
from bbfit.forest.registers import Register


def read(path: Path, **config: Any) -> tuple[Register, NDArray[np.void]]:
    register = Register(path, RegisterConfig(**config))
    return register, np.concatenate(list(register.batches()))


def table(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "trees.csv"
    path.write_bytes(text.encode(encoding))
    return path


def collection(*features: Any, **members: Any) -> str:
    return json.dumps({"type": "FeatureCollection", **members, "features": list(features)})


def feature(*place: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": "Point", "coordinates": list(place)}, "properties": properties}


CITIES = {
    "plain": ("x,y,height,species\n10,20,5,oak\n", (10, 20, 5, "oak")),
    "german": ("\ufeffBaumart;Höhe (m);Rechtswert;Hochwert\nWinterlinde;12,5;391234,5;5820000\n", (391234.5, 5820000, 12.5, "Winterlinde")),
    "berlin": ("gattung,art_bot,baumhoehe,lon,lat\nAcer,platanoides,7,13.4,52.5\n", (13.4, 52.5, 7, "Acer platanoides")),
    "vienna": ("SHAPE,GATTUNG_ART,BAUMHOEHE\nPOINT (16.3 48.2),Tilia cordata (Linde),6-10 m\n", (16.3, 48.2, 8, "Tilia cordata (Linde)")),
    "paris": ("geo_point_2d;GENRE;ESPECE;HAUTEUR (m)\n48.85,2.34;Platanus;x hispanica;15\n", (2.34, 48.85, 15, "Platanus x hispanica")),
    "new york": (
        "latitude,longitude,spc_latin,height_ft\n40.7,-73.9,Gleditsia inermis,100\n",
        (-73.9, 40.7, 30.48, "Gleditsia inermis"),
    ),
    "amsterdam": ("SOORTNAAM\tBOOMHOOGTE\tLNG\tLAT\nUlmus\tb. 6 tot 9 m.\t4.9\t52.3\n", (4.9, 52.3, 7.5, "Ulmus")),
    "no height": ("x,y,height,species\n10,20,0,\n", (10, 20, math.nan, None)),
}


@pytest.mark.parametrize("city", CITIES)
def test_columns_of_cities_are_known(city: str, tmp_path: Path) -> None:
    text, (x, y, height, species) = CITIES[city]
    register, rows = read(table(tmp_path, text))
    assert len(rows) == 1 and rows["row"][0] == 2
    assert (rows["x"][0], rows["y"][0], rows["height"][0]) == pytest.approx((x, y, height), nan_ok=True)
    assert (register.species[rows["species"][0]] if rows["species"][0] >= 0 else None) == species
    assert register.coordinates == ("degrees" if abs(x) <= 180 and city not in ("plain", "no height") else "meters")


def test_geojson_is_read_feature_by_feature(tmp_path: Path) -> None:
    path = tmp_path / "trees.geojson"
    path.write_text(collection(feature(13.4, 52.5, art="Eiche", hoehe="12,5"), feature(13.5, 52.6, 40.0, species="Betula", turn=90)))
    register, rows = read(path)
    assert register.species == ["Eiche", "Betula"] and register.coordinates == "degrees"
    assert rows["x"].tolist() == [13.4, 13.5] and rows["row"].tolist() == [1, 2]
    assert rows["height"][0] == pytest.approx(12.5) and np.isnan(rows["height"][1]) and rows["turn"][1] == 90
    path.write_text(collection(feature(391000, 5820000), crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25833"}}))
    assert read(path)[0].coordinates == "meters"


def test_long_files_are_read_in_batches(tmp_path: Path) -> None:
    """More than the pieces in which a file is read, with features that cross them."""
    count = 70_000
    places = np.random.default_rng(0).random((count, 2))
    path = table(tmp_path, "x,y\n" + "".join(f"{x},{y}\n" for x, y in places.tolist()))
    batches = list(Register(path, RegisterConfig()).batches())
    assert [len(batch) for batch in batches] == [65_536, count - 65_536]
    np.testing.assert_array_equal(np.concatenate(batches)["x"], places[:, 0])
    path = tmp_path / "trees.json"
    path.write_text(collection(*[feature(x, y, name="ö" * 30) for x, y in places[:20_000].tolist()]))
    assert path.stat().st_size > 3 << 20
    np.testing.assert_array_equal(read(path)[1]["y"], places[:20_000, 1])


def test_given_columns_take_precedence_and_incomplete_rows_may_be_left_out(tmp_path: Path) -> None:
    path = table(tmp_path, "A,B,height,H2\n1,2,5,7\n,3,5,7\n4,nan,5,7\n5,6,5,8\n")
    register, rows = read(path, columns=("x=A", "y=B", "height=H2"), incomplete="skip")
    assert rows["x"].tolist() == [1, 5] and rows["height"].tolist() == [7, 8] and rows["row"].tolist() == [2, 5]
    assert register.skipped == 2


TABLES = {
    "no coordinates": ("height,species\n3,oak\n", r"trees.csv has no columns of coordinates .*it has height, species"),
    "half of them": ("x,height\n3,5\n", "has no columns of coordinates"),
    "empty place": ("x,y\n1,2\n,3\n", r"row 3, column x is empty; correct it, or remove the row"),
    "nan": ("lon,lat\n13,52\nnan,52\n", r"row 3, column lon is NaN"),
    "infinite": ("lon,lat\n13,1e999\n", r"row 2, column lat is '1e999', which is no finite number"),
    "text": ("x,y\n1,here\n", r"row 2, column y is 'here', which is no number"),
    "out of range": ("lon,lat\n13,95\n", r"row 2, column lat is 95, expected degrees from -90 to 90"),
    "meters as degrees": ("longitude,latitude\n391000,5820000\n", r"row 2, column longitude is 391000, .*--coordinates meters"),
    "mixed systems": (
        "x,y\n391000,5820000\n13.4,52.5\n",
        r"row 3, column x and y is \(13.4, 52.5\), .* like degrees, and row 2 does not",
    ),
    "mixed systems 2": ("x,y\n13.4,52.5\n391000,5820000\n", r"row 3, .* looks like meters, and row 2 does not"),
    "short row": ("x,y,height\n1,2,3\n4\n", r"row 3, column y is empty"),
    "negative height": ("x,y,height\n1,2,-3\n", r"row 2, column height is -3 m, expected 0 to 150 m"),
    "huge height": ("x,y,height\n1,2,1200\n", r"row 2, column height is 1200 m"),
    "bad scale": ("x,y,scale\n1,2,0\n", r"row 2, column scale is 0, not more than 0"),
    "no trees": ("x,y\n", "has no trees"),
    "far away meters": ("x,y\n1e9,2\n", r"row 2, column x is \(1e\+09, 2\)"),
    "quotes": ('x,y\n1,"2\n', "row 2 cannot be read"),
    "decimal commas between commas": (
        "lon,lat,species\n13,38,52,51,Acer\n",
        r"row 2 has 5 cells, and the header has 3; put cells that contain ','",
    ),
    "no place": ("lon,lat\n13,52\n0,0\n", r"row 3, column lon and lat is 0, 0, which is no place of a tree"),
    "feet and inches": ("x,y,height\n1,2,6' 10\"\n", "row 2, column height is .* has signs of feet or inches"),
}


def test_of_two_columns_of_one_name_the_first_counts(tmp_path: Path) -> None:
    _, rows = read(table(tmp_path, "x,y,height,height\n1,2,3,9\n4,5,6\n"))
    assert rows["height"].tolist() == [3, 6]


@pytest.mark.parametrize("name", TABLES)
def test_bad_rows_are_named(name: str, tmp_path: Path) -> None:
    text, message = TABLES[name]
    with pytest.raises(InputError, match="^placements: .*" + message) as caught:
        read(table(tmp_path, text))
    assert len(str(caught.value).splitlines()) == 1


DOCUMENTS = {
    "cut short": (collection(feature(1, 2))[:-30], "feature 1 is cut short or no JSON"),
    "cut at the end": (collection(feature(1, 2))[:-1], "does not end as JSON after feature 1"),
    "no features": ('{"type": "Point", "coordinates": [1, 2]}', "is no GeoJSON with features"),
    "a line": (
        collection({"geometry": {"type": "LineString", "coordinates": [[1, 2]]}}),
        "feature 1, .* is a LineString, not a Point",
    ),
    "no geometry": (collection(feature(1, 2), {"geometry": None}), "feature 2, column geometry is missing"),
    "no numbers": (collection(feature("a", 2)), r"feature 1, column geometry has \['a', 2\], which is no number"),
    "out of range": (collection(feature(1, 2), feature(181, 2)), "feature 2, column geometry is 181, expected degrees from -180 to 180"),
    "a number": (collection(3), "feature 1 is no object"),
    "degrees, said to be meters": (
        collection(feature(13, 52), crs={"type": "name", "properties": {"name": "EPSG:2263"}}),
        r"feature 1, column geometry is \(13, 52\), which looks like degrees, and the file names the system EPSG:2263; give --coordinates",
    ),
    "web mercator": (
        collection(feature(1.4e6, 6.8e6), crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}),
        "trees.geojson is in urn:.*3857, whose unit is not the meter on the ground; export it in EPSG:4326",
    ),
    "bad height": (collection(feature(1, 2, height=[1])), r"feature 1, column height is \[1\], which is no number"),
    "nan": ('{"features": [{"geometry": {"type": "Point", "coordinates": [NaN, 1]}}]}', "which is no finite number"),
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_bad_features_are_named(name: str, tmp_path: Path) -> None:
    text, message = DOCUMENTS[name]
    path = tmp_path / "trees.geojson"
    path.write_text(text)
    with pytest.raises(InputError, match="^placements: .*" + message):
        read(path)


@pytest.mark.parametrize(
    ("crs", "unit"),
    [
        ({"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::4269"}}, "degrees"),
        ({"type": "EPSG", "properties": {"code": 4326}}, "degrees"),
        ({"type": "name", "properties": {"name": "http://www.opengis.net/def/crs/EPSG/0/4326"}}, "degrees"),
        ({"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG:9.9.1:4326"}}, "degrees"),
        ({"type": "name", "properties": {"name": "our own plot"}}, "meters"),
        ({"properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}, "type": "name"}, "degrees"),
        (None, "degrees"),
    ],
)
def test_systems_of_geojson_are_known(crs: Any, unit: str, tmp_path: Path) -> None:
    """Also beside a name of the collection itself."""
    path = tmp_path / "trees.geojson"
    path.write_text(collection(feature(-79.4, 43.6), crs=crs, name="EPSG:25833 trees"))
    assert read(path)[0].coordinates == unit


@pytest.mark.parametrize(
    "name", ["EPSG:3857", "urn:ogc:def:crs:ESRI::102100", "http://www.opengis.net/def/crs/EPSG/0/3857", "urn:ogc:def:crs:EPSG:9.9.1:3857"]
)
def test_web_mercator_is_refused_under_all_its_names(name: str, tmp_path: Path) -> None:
    path = tmp_path / "trees.geojson"
    path.write_text(collection(feature(1.4e6, 6.8e6), crs={"type": "name", "properties": {"name": name}}))
    with pytest.raises(InputError, match="whose unit is not the meter on the ground"):
        read(path)
    assert read(path, coordinates="meters")[0].coordinates == "meters"


@pytest.mark.parametrize("coordinates", [None, "meters"])
def test_zeros_for_an_unknown_place_can_be_left_out(coordinates: str | None, tmp_path: Path) -> None:
    """But not a tree at the origin of meters of one's own."""
    path = table(tmp_path, "x,y\n391000,5820000\n391001,5820001\n0,0\n")
    register, rows = read(path, incomplete="skip", coordinates=coordinates)
    assert rows["row"].tolist() == [2, 3] and register.skipped == 1
    with pytest.raises(InputError, match="row 4, column x and y is 0, 0, which is no place of a tree"):
        read(path, coordinates=coordinates)
    assert len(read(table(tmp_path, "x,y\n0,0\n500,200\n"), coordinates=coordinates)[1]) == 2
    path = tmp_path / "trees.geojson"
    path.write_text(collection(feature(0, 0), feature(391000, 5820000), crs={"type": "name", "properties": {"name": "EPSG:25833"}}))
    assert read(path, incomplete="skip", coordinates=coordinates)[1]["row"].tolist() == [2]


def test_a_blank_behind_the_last_column_is_no_cell(tmp_path: Path) -> None:
    assert len(read(table(tmp_path, "x,y\n1,2, \n3,4,\n"))[1]) == 2


def test_given_meters_are_not_guessed_about(tmp_path: Path) -> None:
    path = table(tmp_path, "x,y\n10,20\n12000,300\n")
    with pytest.raises(InputError, match="if all are meters, give --coordinates meters"):
        read(path)
    assert read(path, coordinates="meters")[1]["x"].tolist() == [10, 12000]


def test_what_cannot_be_used_is_left_out_and_mixed_systems_are_not(tmp_path: Path) -> None:
    path = tmp_path / "trees.geojson"
    line = {"geometry": {"type": "LineString", "coordinates": [[1, 2]]}}
    path.write_text(collection({"geometry": {"type": "Point", "coordinates": []}}, line, feature(0, 0), feature(13, 52)))
    register, rows = read(path, incomplete="skip")
    assert register.skipped == 3 and rows["row"].tolist() == [4]
    with pytest.raises(InputError, match=r"row 3, .* looks like meters, and row 2 does not"):
        read(table(tmp_path, "x,y\n0,0\n391000,5820000\n391001,5820000\n"), incomplete="skip")


def test_a_given_property_that_no_feature_has_is_named(tmp_path: Path) -> None:
    path = tmp_path / "trees.geojson"
    path.write_text(collection(feature(13, 52, H=5), feature(13, 52)))
    assert read(path, columns=("height=H",))[1]["height"][0] == 5
    with pytest.raises(InputError, match=r"columns: no feature of .*trees.geojson has the property HH"):
        read(path, columns=("height=HH",))


@pytest.mark.parametrize(
    ("column", "cell", "meters"),
    [
        *(("HeightFt", "10", 3.048), ("TreeHeightFt", "10", 3.048), ("Height (ft.)", "10", 3.048), ("height", "35 ft", 10.668)),
        *(("height", "25-35 feet", 9.144), ("height", "120 cm", 1.2), ("height_ft", "12 m", 12.0), ("height_cm", "120", 1.2)),
        *(("HtFt", "10", 3.048), ("TREEHTFT", "10", 3.048), ("HoeheCm", "120", 1.2), ("HAUTEURCM", "1450", 14.5)),
        *(
            ("Höhe (m)", "7.5", 7.5),
            ("Höhe, Luft", "7.5", 7.5),
            ("SCHAFT", "7.5", 7.5),
            ("height", "b. 6 tot 9 m.", 7.5),
            ("height", "10m", 10.0),
        ),
    ],
)
def test_lengths_have_the_unit_of_their_cell_or_column(column: str, cell: str, meters: float, tmp_path: Path) -> None:
    path = table(tmp_path, f'x,y,"{column}"\n1,2,{cell}\n')
    assert read(path, columns=(f"height={column}",))[1]["height"][0] == pytest.approx(meters)


def test_other_encodings_are_named(tmp_path: Path) -> None:
    path = table(tmp_path, "x,y,Höhe\n1,2,3\n", "latin-1")
    with pytest.raises(InputError, match=r"is no text in utf-8-sig .*--encoding latin-1"):
        read(path)
    assert read(path, encoding="latin-1")[1]["height"].tolist() == [3]
    path = table(tmp_path, "x,y,Höhe\n1,2,3\n", "utf-16")
    with pytest.raises(InputError, match=r"is no text in utf-8-sig .*--encoding utf-16"):
        read(path)
    assert read(path, encoding="utf-16")[1]["height"].tolist() == [3]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"columns": ("height",)}, "expected KEY=NAME"),
        ({"columns": ("size=A",)}, "expected KEY=NAME with a KEY of longitude"),
        ({"encoding": "nonsense"}, "'nonsense' is no encoding"),
        ({"encoding": "zlib"}, "'zlib' is no encoding of text"),
        ({"coordinates": "feet"}, "expected one of degrees, meters"),
    ],
)
def test_bad_options_are_refused(config: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        RegisterConfig(**config)


def test_numbers_and_lengths() -> None:
    assert number("1e3", comma=False) == 1000 and number("3,5", comma=True) == 3.5
    assert length("6-10 m", comma=False) == 8 and length("ca. 7,5 m", comma=True) == 7.5
    for text in ("1,5", "", "x", True, None):
        with pytest.raises(ValueError, match="no number"):
            number(text, comma=False)
    for text in ("-5 m", "1-2-3", "high"):
        with pytest.raises(ValueError, match="no number"):
            length(text, comma=False)
    with pytest.raises(InputError, match="the table has no column C; it has A, B"):
        find_columns(["A", "B"], ["x=C"])
