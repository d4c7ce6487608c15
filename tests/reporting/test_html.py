"""``report.html`` in a real browser: it works from the disk alone, shows what it should, and believes nothing that users named."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page

from bbfit.blender.config import ViewsConfig
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.evaluation.metrics import psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import over_color
from bbfit.pipeline import RunConfig, RunResult, run
from bbfit.rendering.cards import draw_cards
from bbfit.reporting.charts import worst_views

# What a folder and a picture may be called.
EVIL = "<img src=x onerror=alert(1)> & \"tree\" 'of' {{ 7 * 7 }} </script><script>alert(2)<"
DATA = Path(__file__).resolve().parents[2] / "data"
CONFIG = RunConfig(fit=FitConfig(billboards=2, candidates=2, refinement_rounds=0, steps=40), views=ViewsConfig())
Visit = Callable[..., Any]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes to OpenCV's


@pytest.fixture(scope="module")
def result(views_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of views of a tree with an evil name, in a folder of that name; one of the held-out views is called so too."""
    folder = tmp_path_factory.mktemp("evil")
    evil = EVIL.replace("/", "\N{DIVISION SLASH}")
    views = Path(shutil.copytree(views_folder, folder / evil))
    transforms = json.loads((views / "transforms_test.json").read_text())
    frame = transforms["frames"][0]
    (views / f"{frame['file_path']}.png").rename(views / "images" / f"{evil}.png")
    frame["file_path"] = f"images/{evil}"
    (views / "transforms_test.json").write_text(json.dumps(transforms))
    request = json.loads((DATA / "views" / "views.json").read_text())
    request["tree"]["name"] = f"{evil}.glb"
    (views / "views.json").write_text(json.dumps(request))
    return run(views, folder / "run", CONFIG)


@pytest.fixture(scope="module")
def visit(result: RunResult, chromium: tuple[Browser, ThreadPoolExecutor]) -> Iterator[Visit]:
    """Does something with a page; the page may complain of nothing and ask for nothing.

    Where no options are given, it is the page that the tests before have seen, with whatever view and camera they left.
    """
    browser, thread = chromium
    seen = list[tuple[Page, list[str]]]()

    def load(width: int = 1200, height: int = 800, scheme: Any = "light", path: Path | None = None) -> tuple[Page, list[str]]:
        complaints: list[str] = []
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme, reduced_motion="reduce")
        page.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("dialog", lambda dialog: (complaints.append(f"dialog {dialog.message}"), dialog.dismiss()))
        page.on("request", lambda request: complaints.append(request.url) if request.url.startswith(("http", "ws", "file")) else None)
        try:
            page.goto((path or result.folder / "report.html").as_uri())
            wait_until(page, "'model' in bbfit")
        except BaseException:
            page.close()
            raise
        return page, complaints

    def visited(act: Callable[[Page], Any], options: dict[str, Any]) -> Any:
        page, complaints = seen.pop() if seen and not options else load(**options)
        try:
            found = act(page)
            # The page itself is the one file that is asked for. What SwiftShader says of its speed is not the page's.
            assert [text for text in complaints[1:] if "GPU stall" not in text and "swiftshader" not in text.lower()] == []
        except BaseException:
            page.close()
            raise
        if options:
            page.close()
        else:
            seen.append((page, complaints))
        return found

    yield lambda act, **options: thread.submit(visited, act, options).result()
    for page, _ in seen:
        thread.submit(page.close).result()


def pictures(page: Page) -> list[str]:
    return page.evaluate("[...document.querySelectorAll('.strip img')].map(image => image.src)")


def place(page: Page) -> int:
    return int(page.evaluate("document.getElementById('view').value"))


def caption(page: Page) -> str:
    return page.evaluate("document.getElementById('caption').textContent")


def wait_until(page: Page, condition: str) -> None:
    """Wait until a JavaScript expression is true. The page's policy forbids playwright's own way, which needs ``eval`` in the page."""
    for _ in range(2000):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(20)
    pytest.fail(f"not true within 40 seconds: {condition}")


def drawn(page: Page) -> tuple[NDArray[np.float64], Camera]:
    """The model's canvas over its background, [H, W, 3], and the camera that it was seen by."""
    found = page.evaluate(
        "() => { const { canvas, camera, draw } = bbfit.model; draw(); return [canvas.toDataURL('image/png'), canvas.width, canvas.height,"
        " camera.matrixWorld.elements, camera.projectionMatrix.elements]; }"
    )
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(found[0].split(",")[1]))).convert("RGB")) / 255
    width, height = found[1:3]
    pose, projection = (np.array(matrix).reshape(4, 4).T for matrix in found[3:])
    focal = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    intrinsics = torch.tensor([[focal[0], 0, (width - 1) / 2], [0, focal[1], (height - 1) / 2], [0, 0, 1]])
    return image, Camera(torch.tensor(FLIP @ np.linalg.inv(pose)).float(), intrinsics.float(), width, height, False)


def test_the_page_loads_without_complaint_and_shows_what_is_there(visit: Visit, result: RunResult) -> None:
    def act(page: Page) -> None:
        headings = page.evaluate("[...document.querySelectorAll('h2')].map(heading => heading.textContent)")
        figures = ["The billboards", "From a distance", "The fit", "Where the time went"]
        assert headings == ["From every side", "The model", "Numbers", *figures, "Options"]
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        key = page.evaluate("document.querySelector('.key').textContent")
        mean = result.report.mean.over.mean
        for figure in (f"{mean.psnr:.2f} dB", f"{mean.ssim:.3f}", f"{mean.flip:.3f}", "8", f"{result.report.bytes.model:,}"):
            assert figure in key
        assert page.locator("#billboards figure").count() == 2
        options = page.evaluate("document.getElementById('options').textContent")
        assert "fit.billboards" in options and "fit.steps" in options and "scikit-image" in options

    visit(act)


def test_what_users_named_is_text_and_nothing_else(visit: Visit, result: RunResult) -> None:
    evil = EVIL.replace("/", "\N{DIVISION SLASH}")

    def act(page: Page) -> None:
        assert page.evaluate("document.title") == f"{evil} as 2 billboards"
        assert page.evaluate("document.querySelector('h1').textContent") == f"{evil} as 2 billboards"
        assert page.locator("[onerror]").count() == 0
        names = {view["name"] for view in page.evaluate("JSON.parse(document.getElementById('data').textContent).views")}
        assert evil in names
        seen = set()
        for _ in range(4):
            page.click("#after")
            seen.add(caption(page).split(":")[0])
        assert evil in seen

    visit(act)


def test_the_slider_shows_other_views(visit: Visit, result: RunResult) -> None:
    views = sorted(result.report.views, key=lambda view: view.azimuth_degrees)

    def act(page: Page) -> None:
        shown = []
        for number, view in enumerate(views):
            page.evaluate("n => { const s = document.getElementById('view'); s.value = n; s.dispatchEvent(new Event('input')); }", number)
            psnr = view.measures.over.mean.psnr, view.measures.over_white.psnr
            assert f"azimuth {view.azimuth_degrees:.0f}°" in caption(page)
            assert "PSNR {:.2f} dB ({:.2f} over white)".format(*psnr) in caption(page)
            shown.append(tuple(pictures(page)))
        assert len({part for parts in shown for part in parts}) == 3 * len(views)
        page.focus("#view")
        page.keyboard.press("ArrowLeft")
        assert place(page) == len(views) - 2 and tuple(pictures(page)) == shown[-2]
        page.click("#before")
        assert place(page) == len(views) - 3
        for _ in range(3):
            page.click("#after")
        assert place(page) == 0 and tuple(pictures(page)) == shown[0]  # round the tree and on

    visit(act)


def test_pictures_are_the_views_and_the_renders(visit: Visit, result: RunResult) -> None:
    def act(page: Page) -> list[list[str]]:
        return page.evaluate("JSON.parse(document.getElementById('data').textContent).views.map(view => [view.name, ...view.pictures])")

    from bbfit.evaluation.scoring import held_out
    from bbfit.views.dataset import ViewDataset

    views = ViewDataset.load(Path(json.loads((result.folder / "run.json").read_text())["source"])).test
    for name, *uris in visit(act):
        index = views.names.index(name)
        for truth, uri in zip(held_out(shipped_model(result.cloud).draw, views, index), uris[:2], strict=True):
            image = np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGBA")) / 255
            premultiplied = torch.tensor(np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], -1))
            assert psnr(over_color(truth).numpy(), over_color(premultiplied).numpy()) > 33  # lossy, for its size
        assert Image.open(io.BytesIO(base64.b64decode(uris[2].split(",")[1]))).size == (48, 40)


def test_held_out_views_are_over_the_chosen_background(visit: Visit) -> None:
    """Chosen by arrow keys. The textures keep their checkerboard, and a new page begins with white again."""

    def act(page: Page) -> None:
        names = page.evaluate("[...document.querySelectorAll('input[name=over]')].map(input => input.value)")
        assert names == [*BACKGROUNDS, "checkerboard"]
        target, other = page.locator(".strip .picture").first, page.locator(".worst .picture").first
        texture = page.locator("#billboards .picture").first
        paper = texture.evaluate("element => getComputedStyle(element).background")
        page.focus("input[name=over]:checked")
        seen = list[bytes]()
        for name, color in BACKGROUNDS.items():
            assert page.evaluate("document.activeElement.value") == name
            for picture in (target, other):  # their corners are transparent
                pixel = np.asarray(Image.open(io.BytesIO(picture.screenshot())).convert("RGB"))[5, -5]
                assert np.abs(pixel - 255 * np.array(color)).max() <= 1
            seen.append(target.screenshot())
            page.keyboard.press("ArrowRight")
        assert "repeating-conic-gradient" in target.evaluate("element => getComputedStyle(element).backgroundImage")
        assert len({*seen, target.screenshot()}) == 5
        assert texture.evaluate("element => getComputedStyle(element).background") == paper

    visit(act, width=1100)
    assert visit(lambda page: page.evaluate("document.querySelector('input[name=over]:checked').value"), width=1100) == "white"


def test_charts_follow_the_view_and_lead_to_it(visit: Visit, result: RunResult) -> None:
    report = result.report

    def middle(page: Page, name: str) -> NDArray[np.float64]:
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        return np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])

    def act(page: Page) -> None:
        marks = page.evaluate("JSON.parse(document.getElementById('data').textContent).marks")
        for index, view in enumerate(report.views):
            page.locator(f"#azimuth-ssim-{index} use").click(force=True)
            assert f"PSNR {view.measures.over.mean.psnr:.2f} dB" in caption(page)
            for name in ("psnr", "ssim", "flip"):
                point, cursor = middle(page, f"azimuth-{name}-{index}"), middle(page, f"azimuth-cursor-{name}")
                assert abs(point[0] - cursor[0]) < 1
            assert page.evaluate("[...document.querySelectorAll('svg .now')].map(point => point.id)") == [
                f"azimuth-{name}-{index}" for name in ("psnr", "ssim", "flip")
            ]
            # Azimuth 0 is at +Z, at the bottom of the plan; 90 degrees at +X, at its right.
            left, top, scale = page.evaluate(
                "() => { const svg = document.getElementById('plan-eye').ownerSVGElement, box = svg.getBoundingClientRect();"
                " return [box.x, box.y, box.width / svg.viewBox.baseVal.width]; }"
            )
            x, y = middle(page, "plan-eye") - [left + scale * marks["x"], top + scale * marks["y"]]
            away = (np.degrees(np.arctan2(x, y)) - view.azimuth_degrees + 180) % 360 - 180
            assert abs(away) < 2 and np.hypot(x, y) > 100

    visit(act)


def test_the_worst_views_are_marked_and_shown(visit: Visit, result: RunResult) -> None:
    worst = worst_views(result.report.views)

    def act(page: Page) -> None:
        marked = page.evaluate(
            "[...document.querySelectorAll('.bad')].map(bad => bad.textContent + ' of '"
            " + bad.closest('figure').querySelector('button').dataset.view)"
        )
        values = {name: getattr(result.report.views[index].measures.over.mean, name) for name, index in worst.items()}
        wanted = [f"{name.upper()} {value:.{2 if name == 'psnr' else 3}f} of {worst[name]}" for name, value in values.items()]
        assert sorted(marked) == sorted(wanted)
        page.locator(f".pictures[data-view='{worst['ssim']}']").click()
        assert f"SSIM {values['ssim']:.3f}" in caption(page)

    visit(act)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_model_is_drawn_as_bbfit_draws_it(visit: Visit, result: RunResult, scheme: str) -> None:
    image, camera = visit(drawn, scheme=scheme, width=700)
    paper = torch.tensor([1.0, 1.0, 1.0] if scheme == "light" else [0x1D / 255, 0x21 / 255, 0x26 / 255])
    drawing = draw_cards(shipped_model(result.cloud).cards, camera).double()
    wanted = over_color(drawing, paper.double()).numpy()
    assert psnr(wanted, over_color(torch.zeros_like(drawing), paper.double()).numpy()) < 22  # there is something to see
    assert psnr(wanted, image) > 28  # antialiased edges differ


def test_the_model_turns_upright_once_the_page_is_clicked(visit: Visit) -> None:
    def act(page: Page) -> None:
        def pose() -> NDArray[np.float64]:
            page.evaluate("bbfit.model.draw()")
            return np.array(page.evaluate("[...bbfit.model.camera.matrixWorld.elements]")).reshape(4, 4).T

        page.evaluate("document.getElementById('model').scrollIntoView()")
        box = page.locator(".stage").bounding_box()
        assert box is not None
        at = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        before, scrolled = pose(), page.evaluate("scrollY")
        page.mouse.move(*at)
        page.mouse.wheel(0, -60)
        wait_until(page, f"scrollY === {scrolled - 60}")  # the wheel scrolls the page past the model
        assert np.array_equal(pose(), before)
        page.mouse.click(*at)
        page.mouse.wheel(0, -60)
        wait_until(page, f"Math.abs(bbfit.model.camera.position.z - {before[2, 3]}) > 0.05")
        assert page.evaluate("scrollY") == scrolled - 60
        nearer = pose()
        assert np.linalg.norm(nearer[:3, 3]) < np.linalg.norm(before[:3, 3])
        page.mouse.down()
        page.mouse.move(at[0] + 60, at[1] + 25, steps=4)
        page.mouse.up()
        wait_until(page, f"Math.abs(bbfit.model.camera.position.x - {nearer[0, 3]}) > 0.2")
        after = pose()
        assert abs(after[1, 0]) < 1e-6 and after[1, 1] > 0  # its right stays level, its top up
        page.evaluate("scrollTo(0, 0)")
        page.locator("#turn").wait_for()

    visit(act)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1200])
def test_it_reads_on_phones_and_screens_in_light_and_dark(visit: Visit, width: int, scheme: str) -> None:
    def act(page: Page) -> None:
        assert page.evaluate("document.documentElement.scrollWidth") == width
        wide = page.evaluate(
            "[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1).map(e => e.tagName)"
        )
        assert wide == []
        ink, paper, label = page.evaluate(
            "[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor,"
            " getComputedStyle(document.querySelector('svg text')).fill].map(c => c.match(/\\d+/g).slice(0, 3).map(Number))"
        )
        light, dark = (max, min) if scheme == "light" else (min, max)
        assert light(np.mean(ink), np.mean(paper)) == np.mean(paper) and dark(np.mean(ink), np.mean(paper)) == np.mean(ink)
        assert contrast(ink, paper) > 7 and contrast(label, paper) > 4.5  # WCAG 2.2's levels AAA and AA
        size = "element => parseFloat(getComputedStyle(element).fontSize)"
        small = page.evaluate(f"Math.min(...[...document.querySelectorAll('p, td, li, figcaption')].map({size}))")
        assert small >= 14

    visit(act, width=width, scheme=scheme)


def contrast(one: list[float], other: list[float]) -> float:
    """WCAG 2.2's contrast ratio of two sRGB colors in [0, 255]."""

    def luminance(color: list[float]) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in np.array(color) / 255]
        return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize(
    "export",
    [ExportConfig(alpha="blend"), ExportConfig(alpha="hash", textures="ktx2", fallback=False), ExportConfig(material="pbr", corners=6)],
)
def test_every_kind_of_export_has_a_page(visit: Visit, views_folder: Path, tmp_path: Path, export: ExportConfig) -> None:
    config = RunConfig(fit=FitConfig(billboards=2, placement="even", sides="two", steps=8), export=export)
    made = run(views_folder, tmp_path, config)
    image, _ = visit(drawn, path=made.folder / "report.html")
    assert (image.min(-1) < 0.9).mean() > 0.01
    assert BillboardCloud.load(tmp_path / "cloud.safetensors").two_sided.all()


def test_many_billboards_are_a_sheet_with_their_sizes_in_tooltips(visit: Visit, views_folder: Path, tmp_path: Path) -> None:
    made = run(views_folder, tmp_path, RunConfig(fit=FitConfig(billboards=60, placement="even", texel_density=0.3, steps=1)))

    def act(page: Page) -> None:
        titles = page.evaluate("[...document.querySelectorAll('.textures figure')].map(figure => figure.title)")
        assert len(titles) == 60 and all(
            re.fullmatch(r"\d+\.\d x \d+\.\d m, \d+ x \d+ texels, \S+ % opaque(, leans \d+°)?", title) for title in titles
        )
        assert page.evaluate("document.getElementById('billboards').offsetHeight") < 1200  # 5,000 with 60 captions
        assert page.evaluate("document.documentElement.scrollWidth") == 360

    visit(act, path=made.folder / "report.html", width=360)
