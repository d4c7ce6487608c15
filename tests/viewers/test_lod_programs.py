"""Levels of detail in real programs, by the files that bbfit writes for them: each shows one level at a time, the one for the distance."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from browser_viewer import HERE, NODE, ORIGIN, TYPES
from numpy.typing import NDArray
from playwright.sync_api import Browser, Error, Page, Route

from bbfit.exporting.config import ExportConfig, LodConfig, Profile
from bbfit.exporting.lod import LodLevel, lod_glb
from bbfit.exporting.lod_files import LOD_FILE, level_file, lod_document, program_files
from bbfit.exporting.model import shipped_model
from bbfit.geometry.cloud import BillboardCloud, even_upright

SUFFIXES = TYPES | {".mjs": TYPES[".js"]}
# The page's screen, for which the distances are.
CONFIG = LodConfig(planes=(2, 1), screen_height=96, screen_width=96, screen_fov_degrees=2.0)
DISTANCES = (0.0, 100.0, 200.0)
BOUNDS = ((-1.0, 0.0, -1.0), (1.0, 2.0, 1.0))
# In meters. Coarser levels are larger, so that each would be seen behind another.
SIDES = (2.0, 2.2, 2.4)
# Distances at which each level is shown alone, also where programs fade or measure from elsewhere.
SHOWN = (90.0, 150.0, 300.0)


def colored(channel: int, side: float) -> BillboardCloud:
    """Two upright squares that cross, opaque in one color."""
    axis, half = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([side / 2, side / 2])
    cloud = even_upright(2, axis=axis, half_extents=half, texture_sizes=torch.tensor([16, 16]))
    return cloud.with_texels(torch.eye(4)[[channel, 3]].sum(0).expand_as(cloud.texels))


def levels_folder(folder: Path, profile: Profile, sides: tuple[float, float, float] = SIDES) -> Path:
    """A red, a green and a blue level, with vertices of integers."""
    folder.mkdir()
    export = ExportConfig(alpha="mask", profile=profile)
    assert export.resolve().quantized
    models = [shipped_model(colored(channel, side), export).glb for channel, side in enumerate(sides)]
    levels = [
        LodLevel(f"oak_LOD{n}", 2, 0, 0, 0, 0.0, 0.0, 0.0, None, None, distance, 0.5**n, level_file("oak", n), distance, 0.0, 0.0, 0.0)
        for n, distance in enumerate(DISTANCES)
    ]
    document = lod_document("oak", levels, CONFIG, BOUNDS)
    (folder / LOD_FILE).write_text(json.dumps(document))
    for level, model in zip(levels, models, strict=True):
        (folder / level.file).write_bytes(model)
    for name, data in program_files(profile, document).items():
        (folder / name).write_bytes(data)
    (folder / "joined.glb").write_bytes(lod_glb(models, levels))
    (folder / "babylon.glb").write_bytes(lod_glb(models, levels, "babylon"))
    return folder


class Levels:
    """A page that shows a folder of levels in a program."""

    def __init__(self, browser: Browser, thread: ThreadPoolExecutor, folder: Path, query: str) -> None:
        self._thread, self._errors = thread, list[str]()
        self._page = thread.submit(self._open, browser, folder, query).result()

    def _open(self, browser: Browser, folder: Path, query: str) -> Page:
        page = browser.new_page()
        page.on("pageerror", lambda error: self._errors.append(str(error)))
        page.on("console", lambda message: self._errors.append(message.text) if message.type == "error" else None)
        page.route("**/*", lambda route: _answer(route, folder))
        page.goto(f"{ORIGIN}/lod.html?{query}")
        return page

    def shares(self, distance: float) -> NDArray[np.float64]:
        """Shares of the picture that are red, green and blue at a distance."""
        try:
            values = self._thread.submit(self._page.evaluate, "distance => window.look(distance)", distance).result()
        except Error as error:
            raise AssertionError(self._errors) from error
        assert not self._errors, self._errors
        bright = np.array(values, np.uint8).reshape(96, 96, 4)[..., :3] > 100
        assert bright.sum(-1).max() == 1, "one color in each pixel"
        return bright.mean((0, 1))

    def close(self) -> None:
        """Close the page."""
        self._thread.submit(self._page.close).result()


def _answer(route: Route, folder: Path) -> None:
    path = route.request.url.removeprefix(f"{ORIGIN}/").partition("?")[0]
    kind, _, name = path.partition("/")
    file = {"levels": folder / name, "node_modules": NODE / path}.get(kind, HERE / path)
    if file.is_file():
        route.fulfill(path=file, content_type=SUFFIXES.get(file.suffix, "application/octet-stream"))
    else:
        route.abort()


def share(distance: float, side: float = 2.0) -> float:
    """Share of the picture that a square covers at a distance."""
    return (side * 48 / np.tan(np.radians(1)) / distance / 96) ** 2


@pytest.mark.parametrize("program", ["three", "field", "babylon", "playcanvas", "cesium"])
def test_programs_show_the_level_of_the_distance_alone(program: str, chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path) -> None:
    profile = "three" if program == "field" else program
    with closing(Levels(*chromium, levels_folder(tmp_path / "levels", profile), f"program={program}")) as page:
        for distance in (*SHOWN, *SHOWN[::-1]):
            found, level = page.shares(distance), sum(distance >= start for start in DISTANCES) - 1
            assert found[level] == pytest.approx(share(distance, SIDES[level]), rel=0.15)
            assert found.sum() == found[level]


@pytest.mark.parametrize("program", ["three", "playcanvas"])
def test_a_larger_copy_has_its_levels_from_farther_away(program: str, chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path) -> None:
    """Also one that three.js cloned."""
    with closing(Levels(*chromium, levels_folder(tmp_path / "levels", program), f"program={program}&scale=2")) as page:
        for level, distance in enumerate(SHOWN):
            found = page.shares(2 * distance)
            assert found[level] == found.sum() == pytest.approx(share(distance, SIDES[level]), rel=0.15)


@pytest.mark.parametrize("program", ["three", "field"])
def test_levels_fade_into_each_other_in_three(program: str, chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path) -> None:
    """Half of the way through the fade, which is a tenth of the distance, each shows about half of the pixels and none is left out."""
    with closing(Levels(*chromium, levels_folder(tmp_path / "levels", "three", (2.0, 2.0, 2.0)), f"program={program}")) as page:
        for portion in (0.25, 0.5, 0.75):
            distance = 100.0 * (1 + 0.1 * portion)
            red, green, blue = page.shares(distance)
            assert red + green == pytest.approx(share(distance), rel=0.1) and blue == 0
            assert green / (red + green) == pytest.approx(portion, abs=0.05)


@pytest.mark.parametrize("way", ["", "&patches=each"])
def test_each_copy_of_a_field_has_the_level_for_its_own_distance_and_size(
    way: str, chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path
) -> None:
    """A copy of half the size shows the level of twice the distance; others are outside the picture and behind the camera."""
    copies = [(0.5, -1.3, 0.5, 0.0), (2.0, 1.2, -1.0, 0.0), (1.0, 10.0, 0.0, 0.0), (1.0, 0.0, 0.0, 400.0)]  # size and place
    matrices = [value for size, *place in copies for value in (size, 0, 0, 0, 0, size, 0, 0, 0, 0, size, 0, *place, 1)]
    query = f"program=field&matrices={json.dumps(matrices, separators=(',', ':'))}{way}"
    with closing(Levels(*chromium, levels_folder(tmp_path / "levels", "three", (2.0, 2.0, 2.0)), query)) as page:
        red, green, blue = page.shares(150.0)
    edge = 150.0 * np.tan(np.radians(1))
    assert blue == pytest.approx(share(300.0), rel=0.1)
    assert red == pytest.approx((edge + 0.8) * 4 / (2 * edge) ** 2, rel=0.05)
    assert green == 0


@pytest.mark.parametrize("name", ["joined.glb", "babylon.glb"])
def test_babylon_never_switches_levels_of_one_file(name: str, chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path) -> None:
    """Its loader takes the levels of MSFT_lod for stages of loading; with the profile there are none, so it cannot show two of them."""
    folder = levels_folder(tmp_path / "levels", "babylon")
    assert (b"MSFT_lod" in (folder / name).read_bytes()) == (name == "joined.glb")
    with closing(Levels(*chromium, folder, f"program=babylon&joined={name}")) as page:
        for distance in SHOWN:
            assert page.shares(distance)[0] == pytest.approx(share(distance), rel=0.15)
