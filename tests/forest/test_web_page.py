"""The page of a forest, opened from the disk in a real browser."""

from __future__ import annotations

import base64
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from forest_scene import ATLAS, placed, square_glb, tiled, write_library
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page

from bbfit.exporting.encoders import encode_webp
from bbfit.forest.placements import Placements, matrices
from bbfit.forest.web_page import PAGE, PageConfig, write_page
from bbfit.glb import joined_glb, split_glb
from bbfit.library.manifest import Library

WIDTH, HEIGHT, FOV = 360, 240, 55.0
RED, GREEN, BLUE = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.9)
T = TypeVar("T")


class ForestTab:
    """The page in a tab of a browser that is driven from a thread of its own. It draws only when it is told to."""

    def __init__(self, thread: ThreadPoolExecutor, page: Page, address: str) -> None:
        self._thread, self._page, self._address = thread, page, address
        self.errors, self.requests = list[str](), list[str]()
        page.on("console", lambda message: self.errors.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))

    def do(self, action: Callable[[Page], T]) -> T:
        """Do something in the browser's thread."""
        return self._thread.submit(action, self._page).result()

    def evaluate(self, script: str, argument: Any = None) -> Any:
        """The value of a JavaScript expression or function."""
        value = self.do(lambda page: page.evaluate(script, argument))
        assert not self.errors, self.errors
        return value

    def open(self, pose: Sequence[float]) -> dict[str, Any]:
        """Open the page at a pose of the camera, and wait until all is loaded that it shows; returns what the page says of its frame."""
        self.do(lambda page: page.goto(f"{self._address}?antialias=0#{','.join(map(str, pose))}"))
        found = self.evaluate("forest.ready")
        self.evaluate("forest.pause()")
        return found

    def move(self, pose: Sequence[float]) -> dict[str, Any]:
        """Move the camera, and wait until all is loaded that it shows."""
        return self.evaluate("pose => { forest.walker.setPose(...pose); return forest.settled(); }", list(pose))

    def wait_until(self, condition: str) -> None:
        """Wait until a JavaScript expression is true. The page's policy forbids playwright's own way, which evaluates text in the page."""
        until = time.monotonic() + 400
        while not self.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < until, condition
            time.sleep(0.05)

    def picture(self) -> NDArray[np.int64]:
        """What the camera sees, [H, W, 3]."""
        drawn = self.evaluate("""() => {
          const { width, height, values } = forest.pixels();
          let text = "";
          for (let start = 0; start < values.length; start += 8192) text += String.fromCharCode(...values.subarray(start, start + 8192));
          return { width, height, text: btoa(text) };
        }""")
        values = np.frombuffer(base64.b64decode(drawn["text"]), np.uint8).reshape(drawn["height"], drawn["width"], 4)
        return values[::-1, :, :3].astype(np.int64)


Open = Callable[..., ForestTab]


@pytest.fixture
def open_forest(chromium: tuple[Browser, ThreadPoolExecutor], tmp_path: Path) -> Iterator[Open]:
    """Writes the page of a library and parts of placements, and gives a tab for it."""
    browser, thread = chromium
    pages = list[Page]()

    def work(library: Library, parts: Sequence[Placements], config: PageConfig | None = None) -> ForestTab:
        root, stored = tiled(parts)
        index = write_page(tmp_path / "forest", library, root, stored.__getitem__, config)
        assert index == tmp_path / "forest" / PAGE / "index.html"
        pages.append(thread.submit(browser.new_page, viewport={"width": WIDTH, "height": HEIGHT}).result())
        return ForestTab(thread, pages[-1], index.as_uri())

    (tmp_path / "forest").mkdir()
    yield work
    for page in pages:
        thread.submit(page.close).result()


@contextmanager
def level_distances(tab: ForestTab, distances: Sequence[float], fade: float) -> Iterator[None]:
    """Other distances of the levels of the first field while the context lasts."""
    change = """([distances, fade]) => {
      const [field] = forest.trees.fields, before = [field.levels.map(({ distance }) => distance), field.fade];
      field.levels.forEach((level, index) => { level.distance = distances[index]; });
      field.fade = fade;
      return before;
    }"""
    before = tab.evaluate(change, [list(distances), fade])
    yield
    tab.evaluate(change, before)


def projected(points: NDArray[np.float64], pose: Sequence[float]) -> NDArray[np.float64]:
    """Where points, [P, 3], are in the picture of a pose, in pixels from its top left corner, [P, 2]."""
    x, y, z, yaw, pitch = pose
    turn, tilt = np.radians([yaw, pitch])
    right = np.array([np.cos(turn), 0, -np.sin(turn)])
    ahead = np.array([-np.sin(turn) * np.cos(tilt), np.sin(tilt), -np.cos(turn) * np.cos(tilt)])
    relative = points - [x, y, z]
    focal = HEIGHT / 2 / np.tan(np.radians(FOV) / 2)
    depth = relative @ ahead
    return np.stack([WIDTH / 2 + focal * relative @ right / depth, HEIGHT / 2 - focal * relative @ np.cross(right, ahead) / depth], -1)


def is_color(pixel: NDArray[np.int64], color: Sequence[float]) -> bool:
    """Whether a pixel has a hue, in whatever haze."""
    return int(np.argmax(pixel)) == int(np.argmax(color)) and pixel.max() - pixel.min() > 60


def test_each_tree_is_where_its_placement_says(open_forest: Open, tmp_path: Path) -> None:
    """Squares whose middle is 2 m to the east of the trunk at rest: turns count counterclockwise, and sizes scale about the trunk."""
    trees = {name: [square_glb(color, aside=2.0)] for name, color in (("red", RED), ("green", GREEN), ("blue", BLUE))}
    library = write_library(tmp_path / "library", trees, [0.0])
    wide = tuple(replace(tree, low=(1.0, 0.0, -1.0), high=(3.0, 2.0, 1.0)) for tree in library.trees)
    places = placed([[0, 0, -20], [-12, 0, -30], [14, 0, -25], [0, 0, -60]], trees=[0, 1, 2, 1])
    places = replace(places, turns=np.float32([0, 90, 180, 270]), scales=np.float32([1, 2, 1.5, 3]))
    pose = (1.0, 6.0, 4.0, 5.0, -8.0)
    tab = open_forest(replace(library, trees=wide), [places], PageConfig(draw_distance=2000))
    frame = tab.open(pose)
    assert frame["shown"] == frame["loaded"] == 4
    picture = tab.picture()
    middles = matrices(places).reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64) @ [2.0, 1.0, 0.0, 1.0]
    for middle, tree, scale in zip(middles[:, :3], places.trees, places.scales, strict=True):
        color = (RED, GREEN, BLUE)[tree]
        across, down = projected(middle[None], pose)[0]
        assert is_color(picture[int(down), int(across)], color)
        size = HEIGHT / 2 / np.tan(np.radians(FOV) / 2) * float(scale) / np.linalg.norm(middle - pose[:3])  # pixels of half its side
        for side in (-1, 1):
            assert is_color(picture[int(down + 0.8 * side * size), int(across)], color)
            assert not is_color(picture[int(down + 1.25 * side * size), int(across)], color)


def test_it_needs_no_server_and_no_network_and_shows_names_as_they_are(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)], "elm": [square_glb(BLUE)]}, [0.0], shared=True)
    tab = open_forest(library, [placed([[0, 0, -9], [4, 0, -9]], trees=[0, 1])], PageConfig(title="<b>Park & 'wood'"))
    tab.open((0, 2, 0, 0, 0))
    assert all(url.startswith(("file:", "data:", "blob:")) for url in tab.requests)
    assert {url.partition("/page/")[1] for url in tab.requests if url.startswith("file:")} == {"/page/"}
    assert tab.evaluate("[document.title, document.querySelector('h1').textContent]") == ["<b>Park & 'wood'"] * 2
    assert "2 trees" in tab.evaluate("document.getElementById('counts').textContent")
    assert tab.evaluate("forest.renderer.info.memory.textures") == 2, "the atlas, which all models share, and the ground's"
    refused = """new Promise((resolve) => {
      addEventListener("securitypolicyviolation", ({ effectiveDirective }) => resolve(effectiveDirective));
      fetch("https://elsewhere.invalid/").catch(() => {});
    })"""
    assert tab.do(lambda page: page.evaluate(refused)) == "connect-src"


def test_an_atlas_may_be_webp_alone(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0], shared=True)
    path = tmp_path / "library" / "oak_LOD0.glb"
    content, views = split_glb(path.read_bytes())
    image = np.asarray(Image.open(tmp_path / "library" / ATLAS).convert("RGBA"))
    (tmp_path / "library" / "atlas.webp").write_bytes(encode_webp(image, lossless=True))
    content.update(images=[{"uri": "atlas.webp"}], extensionsUsed=["KHR_materials_unlit", "EXT_texture_webp"])
    content["textures"] = [{"sampler": 0, "extensions": {"EXT_texture_webp": {"source": 0}}}]
    path.write_bytes(joined_glb(content, views))
    tab = open_forest(library, [placed([[0, 0, -4]])])
    tab.open((0, 1.7, 0, 0, 0))
    across, down = projected(np.array([[0.0, 1, -4]]), (0, 1.7, 0, 0, 0))[0]
    assert is_color(tab.picture()[int(down), int(across)], RED)
    assert all(url.startswith(("file:", "data:", "blob:")) and not url.endswith(".webp") for url in tab.requests)


@pytest.mark.parametrize("alpha", ["mask", "blend", "coverage"])
def test_a_cross_fade_changes_no_pixel_by_more_than_the_two_levels_differ(alpha: str, open_forest: Open, tmp_path: Path) -> None:
    """Each pixel is exactly that of one of the levels, and the share of the coarser one is the progress."""
    levels = [square_glb(GREEN, holes=3, alpha=alpha), square_glb(BLUE, 2.4, holes=4, alpha=alpha)]
    library = write_library(tmp_path / "library", {"oak": levels}, [0.0, 10.0])
    tab = open_forest(library, [placed([[0, 0, -3]])])
    pose = (0.4, 1.7, 0.0, 0.0, -10.0)
    tab.open(pose)
    away = float(np.linalg.norm(np.subtract(pose[:3], [0, 1, -3])))
    pictures = []
    for distance in (2 * away, away / 2):
        with level_distances(tab, [0.0, distance], 0.1):
            pictures.append(tab.picture())
    fine, coarse = pictures
    differs = (fine != coarse).any(-1)
    assert differs.mean() > 0.1
    for progress in (0.1, 0.35, 0.5, 0.8):
        with level_distances(tab, [0.0, away / (1 + 0.1 * progress)], 0.1):
            frame = tab.picture()
        assert (np.abs(frame - fine) <= np.abs(coarse - fine)).all()
        assert ((frame == fine).all(-1) | (frame == coarse).all(-1)).all()
        assert (frame == coarse).all(-1)[differs].mean() == pytest.approx(progress, abs=0.03)


def test_where_fading_trees_overlap_each_pixel_shows_each_of_them_at_one_level(open_forest: Open, tmp_path: Path) -> None:
    """Three trees behind each other, each at its own progress, which grows with distance.

    A pixel's noise is the same for all trees. So each pixel is that of a frame in which some of the farthest trees show the coarser level
    alone and the others the finer one; there are four such frames. It is never the ground or the sky behind half-drawn trees.
    """
    library = write_library(tmp_path / "library", {"oak": [square_glb(GREEN, holes=3), square_glb(BLUE, 2.4, holes=4)]}, [0.0, 10.0])
    middles = np.array([[0, 1, -4.0], [0.3, 1, -4.4], [-0.3, 1, -4.8]])
    tab = open_forest(library, [placed(middles - [0, 1, 0], turns=30)])
    tab.open((0, 1.7, 0, 0, 0))
    away = np.linalg.norm(middles - [0, 1.7, 0], axis=-1)
    switches = [0.5 * away[0], *(away[:-1] + away[1:]) / 2, 2 * away[-1]]
    whole = []
    for switch in switches:
        with level_distances(tab, [0.0, switch], 0.0):
            whole.append(tab.picture())
    assert min((one != other).any(-1).mean() for one, other in itertools.combinations(whole, 2)) > 0.01
    with level_distances(tab, [0.0, 0.95 * away[0]], 0.4):
        frame = tab.picture()
        progress = tab.evaluate("[...forest.trees.fields[0].progress.slice(0, 3)]")
    assert 0.05 < min(progress) and max(progress) < 0.95
    matches = np.stack([(frame == picture).all(-1) for picture in whole])
    assert matches.any(0).all()
    assert all((match & ~np.delete(matches, index, 0).any(0)).any() for index, match in enumerate(matches))


def test_levels_are_loaded_when_a_copy_is_near_enough_for_them(open_forest: Open, tmp_path: Path) -> None:
    models = [square_glb(color) for color in (RED, GREEN, BLUE)]
    tab = open_forest(write_library(tmp_path / "library", {"oak": models}, [0.0, 20.0, 60.0]), [placed([[0, 0, 0]])])

    def loaded() -> list[str]:
        return sorted({url.rpartition("/models/")[2] for url in tab.requests if "/models/" in url})

    # The distances hold for a screen of 400 lines, this one has 240.
    for meters, color, files in ((100, BLUE, ["0-2.js"]), (30, GREEN, ["0-1.js", "0-2.js"]), (5, RED, ["0-0.js", "0-1.js", "0-2.js"])):
        (tab.open if meters == 100 else tab.move)((0, 1.7, meters, 0, 0))
        picture = tab.picture()
        across, down = projected(np.array([[0.0, 1, 0]]), (0, 1.7, meters, 0, 0))[0]
        assert is_color(picture[int(down), int(across)], color)
        assert loaded() == files


def test_tiles_are_loaded_near_the_camera_and_freed_when_they_are_far(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)], "elm": [square_glb(BLUE)]}, [0.0])
    parts = [placed([[x, 0, -5], [x + 5, 0, -9], [x, 0, -12]], trees=[0, 1, 1]) for x in (0.0, 1000.0, 2000.0)]
    tab = open_forest(library, parts, PageConfig(draw_distance=600))
    frame = tab.open((0, 1.7, 0, 0, 0))
    assert (frame["tiles"], frame["loaded"], frame["shown"]) == (["1/0/0"], 3, 3)
    before = tab.picture()
    frame = tab.move((500, 1.7, 0, 0, 0))
    assert (frame["tiles"], frame["loaded"], frame["shown"]) == (["1/0/0", "1/1/0"], 6, 0)
    assert tab.move((760, 1.7, 0, 0, 0))["tiles"] == ["1/1/0"], "beyond 1.25 draw distances it is freed"
    assert tab.evaluate("forest.trees.fields.map(({ count }) => count)") == [1, 2]
    assert tab.move((2000, 1.7, 0, 0, 0))["tiles"] == ["1/0/1"]
    assert tab.evaluate("forest.renderOnce().shown") == 3
    assert tab.evaluate("() => { forest.setDistance(1500); return forest.settled(); }")["tiles"] == ["1/1/0", "1/0/1"]
    tab.evaluate("forest.setDistance(600)")
    tab.move((0, 1.7, 0, 0, 0))
    np.testing.assert_array_equal(tab.picture(), before)


def test_trees_beyond_the_draw_distance_are_not_drawn(open_forest: Open, tmp_path: Path) -> None:
    """Of one tile, which is loaded as a whole. The distance counts along the ground."""
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0])
    tab = open_forest(library, [placed([[0, 0, -z] for z in (50, 90, 110, 150)])], PageConfig(draw_distance=100))
    assert tab.open((0, 1.7, 0, 0, 0))["loaded"] == 4
    assert tab.evaluate("forest.renderOnce().shown") == 2
    assert tab.move((0, 60, 0, 0, -40))["shown"] == 2
    assert tab.evaluate("() => { forest.setDistance(120); return forest.renderOnce().shown; }") == 3


def test_keys_and_pointer_move_the_camera_as_the_help_says(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0])
    tab = open_forest(library, [placed([[0, 0, -50]])], PageConfig(draw_distance=300))
    tab.open((3, 1.7, 5, 90, 0))

    def pose() -> list[float]:
        return tab.evaluate("(({ camera: { position: { x, y, z } }, yaw, pitch }) => [x, y, z, yaw, pitch])(forest.walker)")

    def step(*keys: str, seconds: float = 1.0) -> list[float]:
        for key in keys:
            tab.do(lambda page, key=key: page.keyboard.down(key))
        tab.evaluate("seconds => forest.walker.step(seconds)", seconds)
        for key in keys:
            tab.do(lambda page, key=key: page.keyboard.up(key))
        return pose()

    assert pose() == pytest.approx([3, 1.7, 5, 90, 0])
    assert step("w") == pytest.approx([-1, 1.7, 5, 90, 0]), "yaw 90 looks west"
    assert step("d") == pytest.approx([-1, 1.7, 1, 90, 0])
    assert step("a") == pytest.approx([-1, 1.7, 5, 90, 0])
    assert step("s", "Shift") == pytest.approx([15, 1.7, 5, 90, 0])
    assert step("ArrowUp", "ArrowRight") == pytest.approx([15 - 8**0.5, 1.7, 5 - 8**0.5, 90, 0])
    assert step("e") == pytest.approx([15 - 8**0.5, 1.7, 5 - 8**0.5, 90, 0]), "who walks stays on the ground"
    step("f")
    assert tab.evaluate("forest.walker.flying")
    tab.evaluate("forest.walker.setPose(0, 20, 0, 0, -30)")
    assert step("w") == pytest.approx([0, 20 - 7.5, -15 * 3**0.5 / 2, 0, -30])
    assert step("e")[1] == pytest.approx(27.5) and step("q")[1] == pytest.approx(12.5)
    assert step("f")[1] == pytest.approx(1.7)

    tab.evaluate("forest.walker.setPose(0, 1.7, 0, 0, 0)")
    tab.do(lambda page: page.focus("[name=distance]"))
    assert step("w") == pytest.approx([0, 1.7, -4, 0, 0]), "letters move the camera wherever the focus is"
    assert step("ArrowUp") == pytest.approx([0, 1.7, -4, 0, 0]) and tab.evaluate("forest.data.drawDistance") == 300
    assert tab.evaluate("document.forms[0].elements.distance.value") == "350", "arrows move the slider"

    def drag(page: Page) -> None:
        page.mouse.move(180, 150)
        page.mouse.down()
        page.mouse.move(180 + HEIGHT / 4, 150 - HEIGHT / 8)
        page.mouse.up()

    tab.evaluate("forest.walker.setPose(0, 1.7, 0, 0, 0)")
    tab.do(drag)
    assert pose()[3:] == pytest.approx([FOV / 4, -FOV / 8]), "what one drags stays under the pointer"
    tab.evaluate("forest.describe()")
    assert tab.evaluate("location.hash") == f"#0,1.7,0,{FOV / 4},{round(-FOV / 8, 2)}"
    tab.evaluate("location.hash = '#7,30,8,10,-5'")
    tab.evaluate("new Promise((resolve) => setTimeout(resolve, 50))")
    assert pose() == pytest.approx([7, 30, 8, 10, -5])
    tab.do(lambda page: page.keyboard.press("l"))
    assert tab.evaluate("document.querySelector('[name=levels]').checked && !document.getElementById('levels').hidden")


def test_the_page_draws_by_itself_and_shows_the_time_of_a_frame(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0])
    tab = open_forest(library, [placed([[0, 0, -9], [3, 0, -9]])])
    tab.open((0, 2, 0, 0, 0))
    tab.evaluate("forest.resume()")
    tab.wait_until("document.getElementById('status').textContent === ''")
    tab.wait_until("Number(document.getElementById('time').textContent) > 0")
    assert tab.evaluate("['shown', 'loaded'].map((name) => document.getElementById(name).textContent)") == ["2", "2"]


def test_the_ground_follows_the_trunks(open_forest: Open, tmp_path: Path) -> None:
    """A slope of 1 in 10, from trees 4 m apart."""
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0])
    x, z = (values.ravel() for values in np.meshgrid(np.arange(-60.0, 61, 4), np.arange(-60.0, 61, 4)))
    tab = open_forest(library, [placed(np.stack([x, 0.1 * x + 7, z], -1))], PageConfig(draw_distance=100))
    tab.open((0, 8.7, 0, 0, 0))
    assert not tab.evaluate("forest.walker.flying"), "eyes 1.7 m above the ground"
    heights = tab.evaluate("[-50, -20, 0, 33, 50].map((x) => forest.ground.heightAt(x, 3))")
    np.testing.assert_allclose(heights, [2, 5, 7, 10.3, 12], atol=0.2)
    tab.evaluate("forest.walker.setPose(50, 30, 3, 0, 0); forest.walker.setFlying(false)")
    assert tab.evaluate("forest.camera.position.y") == pytest.approx(12 + 1.7, abs=0.2)


def test_a_missing_file_is_named(open_forest: Open, tmp_path: Path) -> None:
    library = write_library(tmp_path / "library", {"oak": [square_glb(RED)]}, [0.0])
    tab = open_forest(library, [placed([[0, 0, -9]])])
    (tmp_path / "forest" / PAGE / "data" / "tiles" / "0-0-0.js").unlink()
    with pytest.raises(Exception, match=r"data/tiles/0-0-0\.js is missing"):
        tab.open((0, 2, 0, 0, 0))
