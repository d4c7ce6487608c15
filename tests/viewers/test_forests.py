"""Forests in real programs: where their trees stand, how large they are, and which level of detail they have."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from forest_viewer import ForestPage, open_forest
from numpy.typing import NDArray
from playwright.sync_api import Browser

sys.path.append(str(Path(__file__).parents[1] / "forest"))
from small_library import COLORS, SCREEN, small_library

from bbfit.forest.building import Forest, build_forest
from bbfit.forest.config import ForestConfig, ScatterConfig
from bbfit.forest.placements import matrices
from bbfit.forest.tiles import leaves
from bbfit.library.manifest import read_library

# Each level has a brightness of its own, so that pictures say which one is shown.
BRIGHTNESS = (1.0, 0.7, 0.4)
LONGITUDE, LATITUDE = 13.4, 52.5
# Trees of the library at places and with heights of their own; the last one is 6.8 km in the east.
REGISTER = [("oak", 13.4, 52.5, 12.0), ("birch", 13.4003, 52.5001, 10.0), ("fir", 13.3997, 52.5001, 15.0), ("oak", 13.5, 52.5, 9.0)]
# The picture has as many pixels for an angle as the screen of the library.
FOV = float(np.degrees(2 * np.arctan(240 / SCREEN.height * np.tan(np.radians(SCREEN.fov_degrees / 2)))))
Chromium = tuple[Browser, ThreadPoolExecutor]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("library")
    small_library(folder, planes=(3, 3, 3), brightness=BRIGHTNESS, integers=("birch",))
    return folder


@pytest.fixture(scope="module")
def berlin(library: Path, tmp_path_factory: pytest.TempPathFactory) -> Forest:
    """A forest on the Earth, in tiles of one tree."""
    folder = tmp_path_factory.mktemp("berlin")
    rows = [f"{species},{longitude},{latitude},{height}" for species, longitude, latitude, height in REGISTER]
    (folder / "trees.csv").write_text("\n".join(["species,lon,lat,height", *rows]))
    config = ForestConfig(formats=("glb", "tiles"), origin=(LONGITUDE, LATITUDE), tile_trees=1)
    return build_forest(folder / "trees.csv", library, folder / "forest", config)


@pytest.fixture(scope="module")
def cesium(berlin: Forest, library: Path, chromium: Chromium) -> Iterator[ForestPage]:
    """Cesium, with the forest on the Earth."""
    with open_forest(chromium, f"program=cesium&longitude={LONGITUDE}&latitude={LATITUDE}", berlin.folder, library) as page:
        yield page


@pytest.mark.parametrize(("distance", "level"), [(75.0, 0), (200.0, 1), (700.0, 2)])
@pytest.mark.parametrize("tree", range(4))
def test_cesium_shows_trees_where_they_are(tree: int, distance: float, level: int, berlin: Forest, cesium: ForestPage) -> None:
    """Upright and at their size: from the ground to the height that the register has, by Cesium's own ellipsoid."""
    species, longitude, latitude, height = REGISTER[tree]
    x, _, z = _place(berlin, tree + 2)
    middle = height / 2 - np.hypot(x, z) ** 2 / 2 / 6.38e6
    view = {"eye": [x, middle, z + distance], "target": [x, middle, z], "fov": FOV}
    found = cesium.look(**view, places=[[longitude, latitude, 0], [longitude, latitude, height]], pick=[160, 120])
    (left, foot), (right, top) = found["pixels"]
    rows, columns = np.nonzero(_covered(found["picture"], species))
    assert rows.min() == pytest.approx(top, abs=2) and rows.max() + 1 == pytest.approx(foot, abs=2)
    assert columns.mean() + 0.5 == pytest.approx((left + right) / 2, abs=1)
    assert left == pytest.approx(right, abs=0.5)
    width = 0.4 * (foot - top)
    assert 0.7 * width - 1 < np.ptp(columns) + 1 < width + 1  # planes that cross, turned by any angle
    assert found["picked"] == {"height": pytest.approx(height), "row": tree + 2, "species": species}
    np.testing.assert_allclose(found["picture"][120, 160], _displayed(COLORS[species], BRIGHTNESS[level]), atol=4)


def _place(forest: Forest, row: int) -> NDArray[np.float64]:
    """Where the tree of a row stands, [3]."""
    for tile in leaves(forest.root):
        placements = forest.read(tile.name)
        if placements.rows is not None and (placements.rows == row).any():
            return np.asarray(placements.positions[placements.rows == row][0])
    raise AssertionError(row)


def _displayed(color: tuple[int, int, int], brightness: float) -> NDArray[np.float64]:
    """What is shown of a color that a material darkens, in linear light."""
    linear = (np.array(color) / 255) ** 2.2 * brightness
    return np.asarray(255 * linear ** (1 / 2.2))


def _covered(picture: NDArray[np.uint8], species: str) -> NDArray[np.bool_]:
    """The pixels that a tree of a species covers: those whose strongest channel is that of its color."""
    channel = int(np.argmax(COLORS[species]))
    others = np.delete(picture.astype(int), channel, -1).max(-1)
    return np.asarray(picture[..., channel].astype(int) > others + 15)


@pytest.fixture(scope="module")
def wood(library: Path, tmp_path_factory: pytest.TempPathFactory) -> Forest:
    """A forest of some hundred trees in meters, in tiles of 40."""
    folder = tmp_path_factory.mktemp("wood")
    scatter = ScatterConfig(scatter=(160, 120), spacing=8)
    return build_forest(scatter, library, folder / "forest", ForestConfig(formats=("glb", "tiles"), tile_trees=40, level=1, far_pixels=100))


VIEWS = {
    "from above": {"eye": [0, 220, 1], "target": [0, 0, 0], "fov": 45},
    "from the side": {"eye": [60, 8, 140], "target": [10, 6, 0], "fov": 50},
    "from within": {"eye": [3, 3, 5], "target": [-40, 5, -30], "fov": 60},
}


@pytest.fixture(scope="module")
def copies(wood: Forest, library: Path, chromium: Chromium) -> dict[str, NDArray[np.uint8]]:
    """What three.js shows of the views with a copy of a tree's own GLB for each placement, without instances."""
    trees, found = read_library(library).trees, []
    for tile in leaves(wood.root):
        placements = wood.read(tile.name)
        for tree, matrix in zip(placements.trees, matrices(placements), strict=True):
            found.append({"file": trees[tree].levels[1].file, "matrix": matrix.tolist()})
    (wood.folder / "copies.json").write_text(json.dumps(found))
    with open_forest(chromium, "program=plain", wood.folder, library) as page:
        return {name: page.picture(**view) for name, view in VIEWS.items()}


@pytest.mark.parametrize("program", ["three", "babylon", "playcanvas"])
def test_programs_show_instances_as_copies(
    program: str, wood: Forest, library: Path, copies: dict[str, NDArray[np.uint8]], chromium: Chromium
) -> None:
    """Of the pixels, at most some at the edges of masks differ, where single precision decides."""
    with open_forest(chromium, f"program={program}", wood.folder, library) as page:
        for name, view in VIEWS.items():
            picture = page.picture(**view)
            assert 0.1 < (picture.min(-1) < 250).mean() < 1, name
            differs = np.abs(picture.astype(int) - copies[name]).max(-1) > 8
            assert differs.mean() < 0.002, (name, differs.mean())


def test_cesium_shows_plain_meters_like_copies(
    wood: Forest, library: Path, copies: dict[str, NDArray[np.uint8]], chromium: Chromium
) -> None:
    """The same places and sizes at every level; colors are those of the level, and every tree is covered by one tile."""
    with open_forest(chromium, "program=cesium", wood.folder, library) as page:
        for name, view in VIEWS.items():
            found = page.look(**view)
            covered, expected = (picture.min(-1) < 250 for picture in (found["picture"], copies[name]))
            assert (covered & expected).sum() / (covered | expected).sum() > 0.9, name
            assert found["trees"] <= len(wood)


def test_far_tiles_show_a_part_of_the_trees_that_covers_as_much(wood: Forest, library: Path, chromium: Chromium) -> None:
    areas = []
    with open_forest(chromium, "program=cesium", wood.folder, library) as page:
        for distance, fov, trees in ((300, 35, len(wood)), (1500, 12, 40)):
            found = page.look(eye=[0, 0.5 * distance, 0.87 * distance], target=[0, 0, 0], fov=fov)
            assert found["trees"] == trees
            side = 2 * distance * np.tan(np.radians(fov / 2))
            areas.append((found["picture"].min(-1) < 250).mean() * side**2)
    assert areas[1] == pytest.approx(areas[0], rel=0.4)


def test_blender_reads_the_usd_stage(library: Path, tmp_path: Path) -> None:
    """Each tree is an instance of a mesh where it stands, upright in Blender's axes, turned and scaled."""
    if importlib.util.find_spec("bpy") is None:
        pytest.fail("Blender is not installed: pip install bpy, or bbfit with its extra blender, on Python 3.11")
    scatter = ScatterConfig(scatter=(60, 50), spacing=8)
    forest = build_forest(scatter, library, tmp_path / "forest", ForestConfig(formats=("usd",), tile_trees=20))
    script, stage = Path(__file__).with_name("forest_blender_script.py"), forest.folder / "usd" / "forest.usda"
    environment = os.environ | dict.fromkeys(("TMPDIR", "BLENDER_USER_RESOURCES"), str(tmp_path))
    done = subprocess.run([sys.executable, "-P", str(script), str(stage)], capture_output=True, text=True, check=True, env=environment)
    found = np.array(json.loads(done.stdout.splitlines()[-1]))
    placed = np.concatenate([matrices(forest.read(tile.name)) for tile in leaves(forest.root)])
    to_blender = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    expected = to_blender @ placed.reshape(-1, 4, 4).transpose(0, 2, 1)
    assert len(found) == len(forest) == len(expected)
    for values in (found, expected):
        values[:] = values[np.lexsort(np.round(values[:, :2, 3], 1).T)]
    np.testing.assert_allclose(found, expected, atol=3e-3)
