"""The sun of the viewer's page: it lights models with maps, and the original, from where the sliders say."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import column
from numpy.typing import NDArray
from page_browser import Browse, Tab, colored
from playwright.sync_api import Page, Route

import bbfit
from bbfit.geometry.light import Light, direction
from bbfit.operators.shading.reference import decode, encode
from bbfit.viewing.server import Viewer

COLOR, LIGHT = (0.6, 0.5, 0.3), Light.of(direction(20.0, 35.0)[None], 2.5, 0.4, (1.0, 0.9, 0.8))
SIDES = {"right": 90, "left": 270}  # azimuths of suns beside a camera in front


@pytest.fixture(scope="module")
def lit(small_run: Path, browse: Browse, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Viewer, Tab]]:
    """The viewer of the small run with a column in place of its billboards, without views, whose light is another, and a tab on it."""
    folder = Path(shutil.copytree(small_run, tmp_path_factory.mktemp("lit") / "lit"))
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"source": str(folder / "gone")}))
    column(LIGHT, COLOR).save(folder / "cloud.safetensors")
    with bbfit.view(folder, port=0) as viewer, browse(viewer.url) as tab:
        tab.wait_until("bbfit.viewer.state.tree && !bbfit.viewer.state.tree.measuring")
        tab.select("level", "1")
        yield viewer, tab
        assert not tab.errors


def look(tab: Tab, azimuth: float) -> None:
    """Turn the camera around the tree, in degrees, at the height of its middle."""
    tab.evaluate(
        "azimuth => { bbfit.viewer.fitTree(); Object.assign(bbfit.viewer.orbit, { azimuth, elevation: 0 }); bbfit.viewer.orbit.update(); }",
        math.radians(azimuth),
    )


def aim(tab: Tab, name: str, value: float) -> None:
    """Move a slider of the sun."""
    tab.evaluate(
        "([name, value]) => { const slider = document.querySelector(`[name=${name}]`); slider.value = value;"
        " slider.dispatchEvent(new Event('input')); }",
        [name, value],
    )


def halves(picture: NDArray[np.int64]) -> tuple[float, float]:
    """Mean values of the left and the right half of what a picture shows."""
    shown = colored(picture)
    middle = int(np.nonzero(shown)[1].mean())
    left, right = np.split(np.arange(picture.shape[1]), [middle])
    return float(picture[:, left][shown[:, left]].mean()), float(picture[:, right][shown[:, right]].mean())


def trunk(picture: NDArray[np.int64]) -> NDArray[np.int64]:
    """The lowest eighth of what a picture shows."""
    rows = np.flatnonzero(colored(picture).any(1))
    return picture[rows[-1] - (rows[-1] - rows[0]) // 8 : rows[-1] + 1]


def test_at_first_the_light_is_that_of_the_views(lit: tuple[Viewer, Tab]) -> None:
    """In the middle the normal points to +Z, so the color is known."""
    _, tab = lit
    look(tab, 0)
    tab.do(lambda page: page.get_by_role("button", name="As in the views").click())
    picture = tab.picture("right")
    irradiance = LIGHT.sun_directions[0, 2] * LIGHT.sun_strengths / math.pi * LIGHT.sun_colors[0] + LIGHT.ambients
    wanted = 255 * encode(decode(torch.tensor(COLOR).double()) * irradiance).numpy()
    np.testing.assert_allclose(picture[picture.shape[0] // 2, picture.shape[1] // 2], wanted, atol=2)
    assert "20°, 35° high; that of the views at 20°, 35°." in tab.text("#sun-note")


@pytest.mark.parametrize("camera", [0, 180])
def test_the_side_towards_the_sun_is_the_brighter_one(lit: tuple[Viewer, Tab], camera: int) -> None:
    """From the front and from behind; the original's trunk is lit alike, by a sun below its crown. Measured: by 25 of 255 or more"""
    _, tab = lit
    look(tab, camera)
    for side, azimuth in SIDES.items():
        aim(tab, "azimuth", (azimuth + camera) % 360)
        for height, pane in ((20, "right"), (5, "left")):
            aim(tab, "height", height)
            picture = tab.picture(pane)
            left, right = halves(picture if pane == "right" else trunk(picture))
            assert (right - left if side == "right" else left - right) > 10


def test_the_sun_moves_by_keys_and_returns(lit: tuple[Viewer, Tab]) -> None:
    _, tab = lit
    look(tab, 0)
    tab.do(lambda page: page.get_by_role("button", name="As in the views").click())
    before = tab.picture("right")

    def press(page: Page) -> None:
        page.get_by_label("azimuth").focus()
        for key in ("ArrowRight", "ArrowRight", "ArrowLeft"):
            page.keyboard.press(key)
        page.get_by_label("height", exact=True).focus()
        page.keyboard.press("End")

    tab.do(press)
    assert "The sun is at 21°, 90° high" in tab.text("#sun-note")
    assert tab.picture("right")[before.shape[0] // 2].mean() < before[before.shape[0] // 2].mean() - 10  # it is overhead now
    tab.do(lambda page: page.get_by_role("button", name="As in the views").click())
    np.testing.assert_array_equal(tab.picture("right"), before)


@pytest.mark.parametrize("camera", [0, 180])
def test_a_turned_tree_of_a_field_is_lit_as_the_tree_under_a_turned_sun(lit: tuple[Viewer, Tab], camera: int) -> None:
    """Turned by 50 degrees and seen from there, it is the tree itself. Measured: pixels differ by 0 of 255, without the turn
    of tangents by 14 from the front and 21 from behind."""
    viewer, tab = lit
    yaw = math.radians(50)
    assert viewer.tree is not None
    x, _, z = viewer.tree.bounds.mean(0)
    place = [x - x * math.cos(yaw) - z * math.sin(yaw), 0, z - z * math.cos(yaw) + x * math.sin(yaw), yaw, 1]

    def plant(route: Route) -> None:
        route.fulfill(body=np.array(place, np.float32).tobytes(), content_type="application/octet-stream")

    tab.select("show", "billboards")
    look(tab, camera)
    aim(tab, "height", 20)
    aim(tab, "azimuth", 70)
    alone = tab.picture("right")
    tab.do(lambda page: page.route("**/field/1/0", plant, times=1))
    tab.do(lambda page: (page.get_by_label("trees").fill("1"), page.get_by_role("button", name="Plant").click()))
    tab.wait_until("bbfit.viewer.field?.places.length === 1 && bbfit.viewer.idle")
    look(tab, camera + 50)
    aim(tab, "azimuth", 120)
    planted = tab.picture("right")
    aim(tab, "azimuth", 70)
    other = tab.picture("right")
    tab.select("show", "both")
    shown = colored(alone) & colored(planted)
    assert shown.mean() > 0.1
    assert np.quantile(abs(alone - planted)[shown], 0.99) <= 2
    assert np.quantile(abs(alone - other)[shown], 0.99) > 10


def test_colors_that_hold_their_light_keep_it(opened: tuple[Viewer, Tab]) -> None:
    """The sliders cannot be used; were they moved, the billboards would not change."""
    _, tab = opened
    tab.select("show", "billboards")
    assert tab.do(lambda page: page.get_by_label("azimuth").is_disabled() and page.get_by_label("height", exact=True).is_disabled())
    assert tab.text("#sun-note") == "The light is in the colors. Fit with --light maps to move the sun."
    before = tab.picture("right")
    aim(tab, "azimuth", 200)
    np.testing.assert_array_equal(tab.picture("right"), before)
