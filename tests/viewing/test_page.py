"""The viewer's page in a real browser."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest
from numpy.typing import NDArray
from page_browser import HEIGHT, WIDTH, Browse, Tab, colored, wait_for
from playwright.sync_api import Page
from skimage.color import rgb2lab

import bbfit
from bbfit.exporting.lod import glb_counts
from bbfit.viewing.server import Viewer

Opened = tuple[Viewer, Tab]
DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(autouse=True)
def at_the_start(opened: Opened) -> Iterator[None]:
    """Every test begins with both trees side by side in the same window, and ends without errors in the browser."""
    _, tab = opened
    tab.resize(WIDTH, HEIGHT)
    tab.select("show", "both")
    tab.select("alpha", "mask")
    tab.select("level", "1")
    tab.do(lambda page: page.get_by_label("plane outlines").uncheck())
    tab.evaluate("document.activeElement.blur()")  # a field that has the focus keeps what was typed
    tab.evaluate("bbfit.viewer.fitTree()")
    yield
    assert not tab.errors


def box(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Lowest and highest row and column that hold 1 % of the pixels of the fullest."""
    ends = []
    for axis in (1, 0):
        count = mask.sum(axis)
        filled = np.flatnonzero(count > 0.01 * count.max())
        ends += [filled[0], filled[-1]]
    return np.array(ends)


def foot(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Lowest row, and mean column of the lowest eighth, which is trunk alone."""
    low, high = box(mask)[:2]
    trunk = mask[high - (high - low) // 8 : high + 1]
    return np.array([high, np.nonzero(trunk)[1].mean()])


def content(viewer: Viewer, path: str) -> bytes:
    """What the viewer sends for a path."""
    found = viewer.content(path)
    assert found
    return found[1]


def vertices(tab: Tab) -> int:
    """How many the right header says the model has."""
    said = re.search(r"([\d,]+) vertices", tab.text("#right header"))
    assert said
    return int(said[1].replace(",", ""))


def test_both_trees_are_in_the_same_place_of_their_panes(opened: Opened) -> None:
    """They are seen by one camera: their pictures coincide, and they have about the same color."""
    left, right = opened[1].picture("left"), opened[1].picture("right")
    ours, theirs = colored(right), colored(left)
    assert theirs.mean() > 0.02
    # Crowns of four planes do not reach as far as the tree's everywhere.
    np.testing.assert_allclose(foot(ours), foot(theirs), atol=2)
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.4


def test_both_trees_have_the_same_brightness(opened: Opened) -> None:
    """The mean colors differ by at most 2.5 (CIE76) over four sides, and by 3.5 as the page begins.

    Measured: 1.7 and 2.7, on another processor 1.8 and 3.0. Kernels round as the processor does, and so small a fit then has other errors
    in a single view.
    """
    _, tab = opened
    means = []
    for degrees in (0, 90, 180, 270):
        tab.evaluate("degrees => { bbfit.viewer.orbit.azimuth = degrees * Math.PI / 180; bbfit.viewer.orbit.update(); }", degrees)
        means.append([(picture[colored(picture)] / 255).mean(0) for picture in map(tab.picture, ("left", "right"))])
    found = [float(np.linalg.norm(np.subtract(*map(rgb2lab, pair)))) for pair in (means[0], np.mean(means, 0))]
    assert found[0] <= 3.5 and found[1] <= 2.5
    sun, dull, bright = tab.evaluate("bbfit.viewer.shares")
    assert sun < 1.5 and 0.1 < dull + bright < 1, "less of the sky's light comes out of the crown than reaches it"


def test_the_page_is_dark_on_dark_screens(opened: Opened) -> None:
    _, tab = opened
    tab.do(lambda page: page.emulate_media(color_scheme="dark"))
    dark = tab.picture("right")
    assert np.median(dark) < 40 < dark.max()
    shades = tab.evaluate("['header b', 'aside', 'select'].map((name) => getComputedStyle(document.querySelector(name)).color)")
    assert all(min(map(int, re.findall(r"\d+", shade))) > 200 for shade in shades)
    tab.do(lambda page: page.emulate_media(color_scheme="light"))
    assert np.median(tab.picture("right")) == 255


def test_the_tree_is_upright_on_the_ground_and_fills_its_pane(opened: Opened) -> None:
    """The trunk is narrow and below, the crown above; the camera looks a little down at the tree's middle."""
    left = opened[1].picture("left")
    low, high = box(colored(left))[:2]
    widths = colored(left).sum(1)
    assert widths[high - (high - low) // 10 : high].mean() < 0.3 * widths[low : (low + high) // 2].mean()
    assert abs((low + high) / 2 - left.shape[0] / 2) < 0.1 * left.shape[0]
    assert 0.7 < (high - low) / left.shape[0] < 1


def test_nothing_is_requested_from_another_machine(opened: Opened) -> None:
    hosts = {urlparse(url).netloc for url in opened[1].requests if urlparse(url).scheme not in ("data", "blob")}
    assert hosts == {urlparse(opened[0].url).netloc}


def test_headers_describe_the_models(opened: Opened, small_run: Path) -> None:
    """The original's file, and the one that the run has exported."""
    _, tab = opened
    tab.picture("left")
    original, billboards = (glb_counts(path.read_bytes())[0] for path in (DATA / "tree.glb", small_run / "model.glb"))
    assert tab.text("#left header").startswith(f"original{original:,} vertices · ")
    assert re.fullmatch(rf"4 billboards{billboards:,} vertices · \d+ KiB · mask", tab.text("#right header"))


def test_outlines_are_drawn_around_the_billboards_alone(opened: Opened) -> None:
    _, tab = opened
    before = tab.picture("left"), tab.picture("right")
    tab.do(lambda page: page.get_by_label("plane outlines").click())
    np.testing.assert_array_equal(before[0], tab.picture("left"))
    changed = abs(before[1] - tab.picture("right")).max(-1) > 16
    assert changed.sum() > 300


def test_outlines_take_no_more_memory_while_the_camera_turns(opened: Opened) -> None:
    _, tab = opened
    tab.do(lambda page: page.get_by_label("plane outlines").click())
    before = tab.picture("right")

    def turned() -> dict[str, int]:
        tab.do(lambda page: page.evaluate("bbfit.viewer.orbit.azimuth += 0.1; bbfit.viewer.orbit.update()"))
        assert not np.array_equal(before, tab.picture("right"))
        return tab.do(lambda page: page.evaluate("bbfit.viewer.memory"))

    first, *others = (turned() for _ in range(4))
    assert others == [first] * 3


def test_keys_turn_and_zoom(opened: Opened) -> None:
    _, tab = opened
    tab.picture("left")

    def pose() -> list[float]:
        return tab.do(lambda page: page.evaluate("['azimuth', 'elevation', 'distance'].map((name) => bbfit.viewer.orbit[name])"))

    before = pose()
    for key in ("ArrowRight", "ArrowUp", "+", "-", "-"):
        tab.do(lambda page, key=key: page.locator("canvas").press(key))
    turned = [after - value for after, value in zip(pose(), before, strict=True)]
    assert turned == pytest.approx([np.pi / 36, np.pi / 36, before[2] * (1 / 0.9 - 1)])
    tab.do(lambda page: page.locator("canvas").press("Control+ArrowLeft"))  # belongs to the browser
    assert pose()[0] == pytest.approx(before[0] + np.pi / 36)


@pytest.mark.parametrize("alpha", ["blend", "hash", "coverage"])
def test_alpha_modes_change_the_billboards_alone(opened: Opened, alpha: str) -> None:
    _, tab = opened
    before = tab.picture("left"), tab.picture("right")
    tab.select("alpha", alpha)
    np.testing.assert_array_equal(before[0], tab.picture("left"))
    assert (abs(before[1] - tab.picture("right")).max(-1) > 16).mean() > 0.005
    assert f" · {alpha}" in tab.text("#right header")
    assert "fitted for mask" in tab.text("#alpha-note")
    for lacking in ("hash", "coverage"):
        assert (f"glTF has no {lacking}" in tab.text("#alpha-note")) == (alpha == lacking)


def test_a_model_can_be_cut_up_for_sorting(opened: Opened) -> None:
    _, tab = opened
    assert tab.do(lambda page: page.get_by_label("cut up").is_disabled())
    tab.select("alpha", "blend")
    tab.picture("right")
    whole = vertices(tab)
    tab.do(lambda page: page.get_by_label("cut up").check())
    assert colored(tab.picture("right")).mean() > 0.02
    assert "blend, cut up" in tab.text("#right header")
    assert vertices(tab) > whole
    tab.do(lambda page: page.get_by_label("cut up").uncheck())


def test_either_tree_alone_fills_the_picture(opened: Opened) -> None:
    _, tab = opened
    tab.select("show", "original")
    original = tab.picture("left")
    tab.select("show", "billboards")
    billboards = tab.picture("right")
    ours, theirs = colored(billboards), colored(original)
    assert original.shape[1] > 550
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.4
    assert abs(box(theirs)[2:].mean() - original.shape[1] / 2) < 30
    assert 0.7 < np.diff(box(theirs)[:2])[0] / original.shape[0] < 1


def test_the_level_follows_the_distance(opened: Opened) -> None:
    """Near, the original is in both panes; the billboards are from where their error does not show."""
    _, tab = opened
    tab.select("level", "distance")
    distance = tab.evaluate("bbfit.viewer.focalLength() / bbfit.viewer.state.tree.levels[1].scale")

    def go(meters: float) -> None:
        tab.do(lambda page: (page.get_by_label("in meters").fill(str(meters)), page.keyboard.press("Enter")))

    go(0.9 * distance)
    assert abs(tab.picture("left") - tab.picture("right")).max() <= 24  # where lines of the ground are thinner than a pixel
    assert tab.text("#right header").startswith("original")
    go(1.1 * distance)
    assert abs(tab.picture("left") - tab.picture("right")).max() > 24
    assert tab.text("#right header").startswith("4 billboards")
    assert tab.text("#levels .now").startswith("4 billboards: from ")


def test_the_coarsest_level_that_may_be_shown_is_chosen(opened: Opened) -> None:
    levels = [{"scale": None}, {"scale": 40}, {"scale": 10}, {"scale": None}]
    chosen = opened[1].evaluate(
        "levels => [100, 40, 39.9, 10, 9.9].map((scale) => bbfit.viewer.chooseLevel(levels, scale))",
        levels,
    )
    assert chosen == [0, 0, 1, 1, 2]


def test_a_meter_is_as_large_as_a_pinhole_camera_shows_it(opened: Opened) -> None:
    """Half of the pane's height is seen under half of the field of view."""
    _, tab = opened
    focal, fov, height = tab.evaluate(
        "[bbfit.viewer.focalLength(), bbfit.viewer.orbit.camera.fov, document.querySelector('#right .area').clientHeight]"
    )
    assert focal * math.tan(math.radians(fov / 2)) == pytest.approx(height / 2)


def test_steps_of_the_slider_are_equal_factors(opened: Opened) -> None:
    _, tab = opened
    distances = tab.evaluate("Array.from({ length: 201 }, (_, step) => bbfit.viewer.distanceOf(step))")
    np.testing.assert_allclose(np.diff(np.log(distances)), np.log(400) / 200, rtol=1e-9)
    assert tab.evaluate("distances => distances.map(bbfit.viewer.stepOf)", distances) == list(range(201))
    assert tab.evaluate("bbfit.viewer.stepOf(0)") == 0


def test_slider_and_camera_follow_each_other(opened: Opened) -> None:
    _, tab = opened
    slider = "const slider = document.querySelector('[name=slider]');"
    tab.evaluate(f"() => {{ {slider} slider.value = 120; slider.dispatchEvent(new Event('input')); }}")
    far = tab.evaluate("bbfit.viewer.orbit.distance")
    assert far == pytest.approx(tab.evaluate("bbfit.viewer.distanceOf(120)"))
    tab.wait_until("bbfit.viewer.idle")
    assert float(tab.evaluate("document.querySelector('[name=meters]').value")) == pytest.approx(far, rel=1e-3)
    tab.do(lambda page: (page.mouse.move(150, 200), page.mouse.wheel(0, -600)))
    tab.wait_until(f"bbfit.viewer.orbit.distance < {0.9 * far}")
    tab.wait_until("document.querySelector('[name=slider]').value == bbfit.viewer.stepOf(bbfit.viewer.orbit.distance)")


def test_dragging_turns_the_camera_and_keeps_it_upright(opened: Opened) -> None:
    _, tab = opened
    before = tab.picture("left")

    def drag(page: Page) -> None:
        page.mouse.move(150, 200)
        page.mouse.down()
        page.mouse.move(210, 2000, steps=4)
        page.mouse.up()

    tab.do(drag)
    tab.wait_until("bbfit.viewer.orbit.elevation > 1.5")
    assert -0.7 < tab.evaluate("bbfit.viewer.orbit.azimuth") < -0.4
    right = tab.evaluate("[...bbfit.viewer.orbit.camera.matrixWorld.elements].slice(0, 3)")
    assert abs(right[1]) < 1e-6
    assert (tab.picture("left") != before).any()


def test_ten_thousand_trees_and_the_time_of_a_frame(opened: Opened, small_run: Path) -> None:
    """Near trees are the exported model, far ones have smaller textures; every tree has as many triangles as the model of its level."""
    viewer, tab = opened
    tree = json.loads(content(viewer, "/state"))["tree"]
    models = [content(viewer, f"/{tree['generation']}/model/{level['cloud']}/{level['halvings']}/mask.glb") for level in tree["field"]]
    assert glb_counts(models[0]) == glb_counts((small_run / "model.glb").read_bytes())
    tab.select("level", "distance")
    tab.do(lambda page: (page.get_by_label("trees").fill("10000"), page.get_by_role("button", name="Plant").click()))
    tab.wait_until("bbfit.viewer.field?.places.length === 10000 && bbfit.viewer.idle")
    picture = tab.picture("right")
    frame, counts = tab.evaluate("[bbfit.viewer.frame, bbfit.viewer.field.counts]")
    assert tab.text("#right header").startswith("10,000 trees")
    assert sum(counts) == 10_000
    assert counts[-1] > counts[0]
    assert frame["triangles"] == sum(count * glb_counts(model)[1] for count, model in zip(counts, models, strict=True))
    assert frame["calls"] <= len(counts) + 1
    assert colored(picture)[picture.shape[0] // 2 :].mean() > 0.3
    assert re.search(r"\d ms per frame \(\d+ per second\) · \d+\.\d ms to draw", tab.text("#frame"))
    assert np.median(frame["intervals"]) > 0.5 * np.median(frame["durations"]) > 0
    tab.select("show", "both")
    assert colored(tab.picture("left")).mean() > 0.02


def test_every_tab_has_controls_of_its_own(opened: Opened, browse: Browse) -> None:
    viewer, tab = opened
    with browse(viewer.url) as other:
        other.picture("left")
        other.select("show", "original")
        assert tab.evaluate("document.querySelector('[name=show]').value") == "both"
    assert colored(tab.picture("left")).mean() > 0.02


@pytest.mark.parametrize(("width", "height"), [(390, 844), (700, 500), (1280, 800)])
def test_nothing_is_covered_or_cut_off(opened: Opened, width: int, height: int) -> None:
    """Panes, headers and the panel's controls do not overlap on phones or screens, and the page is no wider than the window."""
    _, tab = opened
    tab.resize(width, height)
    for pane in ("left", "right"):
        mask = colored(tab.picture(pane))
        edges = box(mask)
        assert edges[0] > 0 and edges[1] < mask.shape[0] - 1 and edges[2] > 0 and edges[3] < mask.shape[1] - 1
        assert max(np.diff(edges[:2])[0] / mask.shape[0], np.diff(edges[2:])[0] / mask.shape[1]) > 0.6
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    boxes = json.loads(
        tab.evaluate("JSON.stringify([...document.querySelectorAll('header, .area, aside')].map((e) => e.getBoundingClientRect()))")
    )
    assert len(boxes) == 5
    for index, one in enumerate(boxes):
        for two in boxes[:index]:
            across = min(one["right"], two["right"]) - max(one["left"], two["left"])
            down = min(one["bottom"], two["bottom"]) - max(one["top"], two["top"])
            assert min(across, down) < 0.5


def test_the_page_reports_that_the_viewer_has_ended(small_run: Path, browse: Browse) -> None:
    with bbfit.view(small_run, port=0) as viewer, browse(viewer.url) as tab:
        tab.picture("left")
        viewer.close()
        wait_for(lambda: "has ended" in tab.text("#status"))
