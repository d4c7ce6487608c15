"""The files of a forest's page, and what it says of the ground."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forest_scene import ATLAS, placed, square_glb, tiled, write_library

from bbfit.checks import InputError
from bbfit.forest.ground_map import CELLS, GroundMap
from bbfit.forest.tiles import ForestTile
from bbfit.forest.web_page import PAGE, PAGE_FILES, PageConfig, near_distance, tile_bytes, write_page
from bbfit.glb import joined_glb, split_glb
from bbfit.library.manifest import Library

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def unpacked(folder: Path, name: str) -> bytes:
    """The bytes in a data file of the page."""
    found = re.fullmatch(r'packs\.arrive\("(.*)", "(.*)"\);\n', (folder / PAGE / "data" / f"{name}.js").read_text())
    assert found and found[1] == name
    return base64.b64decode(found[2], validate=True)


def described(folder: Path) -> dict[str, Any]:
    """What the page knows of the forest."""
    text = (folder / PAGE / "data" / "forest.js").read_text()
    return json.loads(text.removeprefix("window.forestData = ").removesuffix(";\n"))


def written(folder: Path, library: Library, config: PageConfig | None = None) -> dict[str, Any]:
    """Write the page of two trees; what it knows."""
    root, stored = tiled([placed([[0, 0, 0], [9, 0, 5]], trees=[0, len(library.trees) - 1])])
    write_page(folder, library, root, stored.__getitem__, config)
    return described(folder)


def test_a_page_has_each_file_once_and_all_are_listed(tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)], "elm": [square_glb(BLUE)]}, [0.0], shared=True)
    known = written(tmp_path, library)
    assert [tree["levels"][0]["pictures"] for tree in known["trees"]] == [{ATLAS: "pictures/0"}] * 2
    assert unpacked(tmp_path, "pictures/0") == (tmp_path / "library" / ATLAS).read_bytes()
    assert unpacked(tmp_path, "models/1-0") == (tmp_path / "library" / "elm_LOD0.glb").read_bytes()
    files = {path for path in (tmp_path / PAGE).rglob("*") if path.is_file()}
    assert files == {path for pattern in PAGE_FILES for path in tmp_path.glob(pattern) if path.is_file()}
    before = {path: path.read_bytes() for path in files}
    (tmp_path / PAGE / "data" / "tiles" / "3-1-1.js").write_text("of an earlier forest")
    written(tmp_path, library)
    assert {path: path.read_bytes() for path in (tmp_path / PAGE).rglob("*") if path.is_file()} == before


def test_levels_in_large_files_are_left_out_but_the_coarsest(tmp_path: Path) -> None:
    models = [square_glb(RED, holes=1), square_glb(RED)]
    library = write_library(tmp_path / "library", {"oak": models}, [0.0, 10.0])
    sizes = [level.bytes for level in library.trees[0].levels]
    assert sizes[1] < sizes[0]
    for limit, kept in ((sizes[0], ["models/0-0", "models/0-1"]), (sizes[0] - 1, ["models/0-1"]), (1, ["models/0-1"])):
        known = written(tmp_path, library, PageConfig(level_bytes=limit))
        assert [level["pack"] for level in known["trees"][0]["levels"]] == kept


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content["textures"][0].pop("source"), "KTX2 textures alone"),
        (lambda content: content.update(images=[{"uri": "../secret.png"}]), "outside its own folder"),
        (lambda content: content.update(images=[{"uri": "gone.png"}]), "gone.png"),
        (lambda content: content.update(textures=[{"source": 7}]), "oak_LOD0.glb"),
    ],
)
def test_a_library_that_the_page_cannot_show_is_refused(change: Any, message: str, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0], shared=True)
    (tmp_path / "secret.png").write_bytes(b"secret")
    path = tmp_path / "library" / "oak_LOD0.glb"
    content, views = split_glb(path.read_bytes())
    change(content)
    path.write_bytes(joined_glb(content, views))
    with pytest.raises(InputError, match=message):
        written(tmp_path, library)
    assert not (tmp_path / PAGE / "index.html").exists()


def test_a_tile_s_bytes_keep_placements_to_a_tenth_of_a_millimeter(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    positions = random.uniform(0, 1000, (5, 3)) + np.array([4e5, 100, -7e5])
    places = replace(placed(positions, trees=[3, 0, 2, 2, 1]), turns=random.uniform(0, 360, 5).astype(np.float32))
    corner = tuple((positions.min(0) - 1).tolist())
    content = tile_bytes(places, corner)
    assert int.from_bytes(content[:4], "little") == 5
    np.testing.assert_array_equal(np.frombuffer(content, "<u2", 5, 4), places.trees)
    rows = np.frombuffer(content, "<f4", 25, 4 + 12).reshape(5, 5)
    np.testing.assert_allclose(rows[:3].T + corner, positions, atol=1e-4)
    np.testing.assert_array_equal(rows[3], places.turns)
    np.testing.assert_array_equal(rows[4], places.scales)
    assert len(content) == 4 + 12 + 100


def test_the_ground_has_the_mean_height_of_its_trunks_and_the_share_that_crowns_cover() -> None:
    ground = GroundMap((0.0, 0.0), (float(CELLS), 2.0 * CELLS), np.array([0.5, 2.0]))
    ground.add(placed([[0.5, 3, 1.0]], trees=0))
    ground.add(placed([[0.2, 5, 0.5], [10.5, 7, 21]], trees=1, scales=2.0))
    cover = ground.cover() / 255
    assert cover[0, 0] == pytest.approx(1 - np.exp(-(0.5 + 8) / 2), abs=0.003)  # a cell has 2 square meters
    assert cover[10, 10] == pytest.approx(1 - np.exp(-8 / 2), abs=0.003)
    assert np.count_nonzero(cover) == 2
    heights = ground.heights()
    assert heights is not None
    assert (heights[0, 0], heights[10, 10], heights[-1, -1], heights[0, 1]) == (4, 7, 7, 4)


def test_trees_on_a_plane_have_no_relief() -> None:
    ground = GroundMap((0.0, 0.0), (1.0, 1.0), np.ones(1))
    ground.add(placed([[0.5, 0.0, 0.5]]))
    assert ground.heights() is None


@pytest.mark.parametrize(("spacing", "expected"), [(50.0, 6000.0), (4.0, 500.0), (1.0, 200.0)])
def test_the_draw_distance_is_such_that_a_bounded_number_of_trees_is_near(spacing: float, expected: float) -> None:
    """Leaves of 1,000 trees side by side: at most 60,000 trees within pi d squared, save at the least distance."""
    side = spacing * 1000**0.5
    cells = [(side * x, side * z) for x in range(30) for z in range(30)]
    tiles = [ForestTile(f"{x}/{z}", (x, 0.0, z), (x + side, 9.0, z + side), 1000, ()) for x, z in cells]
    assert near_distance(tiles) == expected
