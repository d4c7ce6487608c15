"""Which trees stand for a species, where scattered trees are, and what a register leaves open."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from small_library import small_library

from bbfit.checks import InputError
from bbfit.forest.config import ForestConfig, ScatterConfig
from bbfit.forest.georeference import Origin, earth_matrix, local_from_degrees, on_globe
from bbfit.forest.planting import planted, uniform
from bbfit.forest.registers import ROW
from bbfit.forest.scattering import scatter_area, scattered
from bbfit.forest.species import Match, genus_of, nearest_trees, read_species_table
from bbfit.library.manifest import Library


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return small_library(tmp_path_factory.mktemp("library"))


@pytest.mark.parametrize(
    ("name", "tree", "likeness"),
    [
        ("Silver Birch", "birch", "species"),
        ("black_oak", "oak", "species"),
        ("Quercus robur", "oak", "genus"),
        ("Stieleiche", "oak", "genus"),
        ("Betula pendula 'Youngii'", "birch", "genus"),
        ("bouleau", "birch", "genus"),
        ("Acer platanoides", "oak", "habit"),
        ("Érable", "oak", "habit"),
        ("zwarte els", "birch", "habit"),
        ("Picea abies", "fir", "habit"),
        ("Pinus nigra", "fir", "kind"),
        ("Straßenbaum", None, "any"),
        ("", None, "any"),
        ("Rotbuche", "birch", "table"),
    ],
)
def test_the_nearest_tree_stands_for_a_species(name: str, tree: str | None, likeness: str, library: Library) -> None:
    found = nearest_trees(library, name, {"rotbuche": "silver_birch"})
    assert found.likeness == likeness
    assert [library.trees[index].name for index in found.trees] == ([tree] if tree else ["oak", "birch", "fir"])


def test_common_names_have_one_genus() -> None:
    assert genus_of("Spitzahorn") == "acer" and genus_of("London Plane Tree") == "platanus"
    assert genus_of("Horse Chestnut") == "aesculus" and genus_of("Chestnut") == "castanea"


def test_a_table_of_species_names_its_bad_row(library: Library, tmp_path: Path) -> None:
    path = tmp_path / "species.csv"
    path.write_text("register;tree\nRotbuche;oak\nLinde;Silver birch\n")
    assert read_species_table(path, library) == {"rotbuche": "oak", "linde": "Silver birch"}
    for text, message in (
        ("Rotbuche,oak\nLinde,palm\n", "row 2, column 2: .* no species palm"),
        ("Rotbuche\n", "row 1 has no two columns"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_species_table(path, library)


def test_sizes_turns_and_trees_follow_the_register_and_are_random_where_it_is_silent(library: Library) -> None:
    rows = np.zeros(1000, ROW)
    for name in ("height", "crown", "turn", "scale"):
        rows[name] = np.nan
    rows["row"] = np.arange(2, 1002)
    rows["height"][:200], rows["turn"][:100], rows["crown"][200:300], rows["scale"][300:400] = 9.0, -90, 3.2, 2.0
    places = np.random.default_rng(0).random((1000, 2))
    matches = [Match((0, 1, 2), "any")]
    records = planted(rows, places, library, matches, ForestConfig(sizes=(0.5, 2)))
    heights = np.array([tree.height for tree in library.trees])[records["tree"]] * records["scale"]
    np.testing.assert_allclose(heights[:200], 9, rtol=1e-6)
    assert (records["tree"][:200] == 1).all()  # the birch is nearest to 9 m
    assert (records["turn"][:100] == 270).all()
    widths = np.array([0.4 * tree.height for tree in library.trees])[records["tree"]] * records["scale"]
    np.testing.assert_allclose(widths[200:300], 3.2, rtol=1e-6)
    assert (records["scale"][300:400] == 2).all()
    left = records[400:]
    assert np.bincount(left["tree"], minlength=3).min() > 150
    assert 0.5 <= left["scale"].min() < 0.55 and 1.9 < left["scale"].max() <= 2
    assert left["turn"].min() < 5 and left["turn"].max() > 355
    np.testing.assert_array_equal(records["x"], places[:, 0])
    np.testing.assert_array_equal(records["z"], -places[:, 1])
    # A row has the same tree whatever rows are read with it.
    np.testing.assert_array_equal(planted(rows[500:], places[500:], library, matches, ForestConfig(sizes=(0.5, 2))), records[500:])
    assert (planted(rows, places, library, matches, ForestConfig(seed=1))["tree"] != records["tree"]).any()


def test_random_numbers_are_even() -> None:
    values = np.stack([uniform(np.arange(10_000), seed, stream) for seed in (0, 1) for stream in ("tree", "turn")])
    assert np.abs(np.corrcoef(values)[~np.eye(4, dtype=bool)]).max() < 0.05
    assert np.bincount((values[0] * 10).astype(int)).min() > 900 and 0 <= values.min() and values.max() < 1


def _scattered(config: ScatterConfig, seed: int = 0, forest: ForestConfig | None = None) -> tuple[NDArray[np.void], Origin]:
    area = scatter_area(config, forest or ForestConfig())
    return np.concatenate([rows for rows, _ in scattered(area, config, seed)]), area.origin


def test_scattered_trees_keep_their_distance_and_leave_no_gap() -> None:
    rows, _ = _scattered(ScatterConfig(scatter=(700, 500), spacing=5.0))
    places = np.stack([rows["x"], rows["y"]], -1)
    tree = cKDTree(places)
    assert tree.query(places, 2)[0][:, 1].min() >= 5
    assert np.abs(places).max(0) == pytest.approx([350, 250], abs=5)
    everywhere = np.random.default_rng(0).random((20_000, 2)) * [700, 500] - [350, 250]
    away = tree.query(everywhere)[0]
    assert away.max() < 10 and (away > 5).mean() < 0.01  # almost no place has room for another tree
    assert rows["row"].tolist() == list(range(1, len(rows) + 1))
    again, _ = _scattered(ScatterConfig(scatter=(700, 500), spacing=5.0))
    assert again.tobytes() == rows.tobytes()


def test_a_mix_has_its_shares() -> None:
    rows, _ = _scattered(ScatterConfig(scatter=(400, 400), spacing=4.0, mix=("oak=3", "birch=1")))
    assert (rows["species"] == 0).mean() == pytest.approx(0.75, abs=0.02) and set(rows["species"]) == {0, 1}


def test_trees_are_scattered_on_polygons_without_their_holes(tmp_path: Path) -> None:
    square = [[13.4, 52.5], [13.402, 52.5], [13.402, 52.502], [13.4, 52.502], [13.4, 52.5]]
    hole = [[13.4005, 52.5005], [13.4015, 52.5005], [13.4015, 52.5015], [13.4005, 52.5015], [13.4005, 52.5005]]
    path = tmp_path / "park.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [square, hole]}))
    rows, origin = _scattered(ScatterConfig(scatter_area=path, spacing=3.0))
    assert (origin.longitude, origin.latitude) == (13.401, 52.501)
    corners = local_from_degrees(origin, np.array(square)), local_from_degrees(origin, np.array(hole))
    places = np.stack([rows["x"], rows["y"]], -1)
    (low, high), (inner_low, inner_high) = ((ring.min(0), ring.max(0)) for ring in corners)
    assert (places > low - 0.01).all() and (places < high + 0.01).all()
    assert not ((places > inner_low + 0.01) & (places < inner_high - 0.01)).all(1).any()
    area = np.prod(high - low) - np.prod(inner_high - inner_low)
    assert len(rows) * 9 / area == pytest.approx(0.69, abs=0.05)


def test_an_area_in_meters_of_ones_own_may_be_small(tmp_path: Path) -> None:
    path = tmp_path / "plot.geojson"
    square = [[0, 0], [80, 0], [80, 60], [0, 60]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [square], "crs": {"properties": {"name": "our own plot"}}}))
    rows, origin = _scattered(ScatterConfig(scatter_area=path, spacing=4.0))
    assert len(rows) * 16 / 4800 == pytest.approx(0.69, abs=0.1) and not origin.on_earth


def test_where_polygons_overlap_there_are_trees_too(tmp_path: Path) -> None:
    square, beside = ([[x, 0], [x + 200, 0], [x + 200, 200], [x, 200], [x, 0]] for x in (0, 100))
    path = tmp_path / "parks.geojson"
    crs = {"type": "name", "properties": {"name": "EPSG:25833"}}
    path.write_text(json.dumps({"type": "MultiPolygon", "coordinates": [[square], [beside], [square]], "crs": crs}))
    rows, _ = _scattered(ScatterConfig(scatter_area=path, spacing=4.0))
    counts = [((rows["x"] >= x) & (rows["x"] < x + 100)).sum() * 16 / (100 * 200) for x in (0, 100, 200)]
    assert counts == pytest.approx([0.69] * 3, abs=0.06)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"type": "Polygon", "coordinates": [[[13, 52], [14, 52], [13, 53]]], "crs": {"properties": {"name": "EPSG:2263"}}},
            "names the system EPSG:2263, and its corners look like degrees",
        ),
        (
            {"type": "Polygon", "coordinates": [[[1e6, 5e6], [1.1e6, 5e6], [1e6, 6e6]]], "crs": {"properties": {"name": "EPSG:3857"}}},
            "is in EPSG:3857, whose unit is not the meter",
        ),
        ({"type": "Point", "coordinates": [1, 2]}, "'?Point'? is missing"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}, "fewer than three corners"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [400, 0], [0, 1]]]}, "beyond 180 and 90 degrees"),
        ({"type": "FeatureCollection", "features": []}, "has no polygons"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [0, 9]]]}, "km from the origin, expected at most 200"),
    ],
)
def test_bad_areas_are_refused(content: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "park.geojson"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="scatter_area: .*" + message):
        scatter_area(ScatterConfig(scatter_area=path), ForestConfig())


def test_the_local_frame_touches_the_ellipsoid() -> None:
    """Against figures of the ellipsoid: a degree of latitude is 111.267 km at 52.5 degrees, and the Earth drops by d²/2R."""
    origin = Origin(13.4, 52.5)
    east, north = local_from_degrees(origin, np.array([[13.4, 52.6], [13.5, 52.5]])).T
    assert north[0] == pytest.approx(11126.7, rel=2e-4) and abs(east[0]) < 1e-6
    assert east[1] == pytest.approx(6378137 * np.cos(np.radians(52.5)) * np.radians(0.1) * 1.00211, rel=1e-4)
    places, up = on_globe(origin, np.array([[0, 5.0, -10_000]]))
    assert places[0] == pytest.approx([0, 10_000 + 5 * 10_000 / 6.38e6, 5 - 1e8 / 2 / 6.38e6], abs=0.02)
    assert np.degrees(np.arccos(up[0, 2])) == pytest.approx(0.0898, abs=1e-3)
    matrix = earth_matrix(Origin(0.0, 0.0))
    np.testing.assert_allclose(matrix, [[0, 0, 1, 6378137], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(earth_matrix(Origin()), np.eye(4))
