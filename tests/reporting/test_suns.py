"""The light in ``report.html``: a strip under other suns, and a sun to drag around the model."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from billboard_scene import column
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page

from bbfit.evaluation.backgrounds import mean_psnr
from bbfit.evaluation.report import Report
from bbfit.evaluation.scoring import evaluate_model
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import SUNNY, Light, angles_degrees, direction
from bbfit.geometry.orbit import Orbit
from bbfit.images import to_bytes, unpremultiply
from bbfit.rendering.dispatch import render
from bbfit.reporting.html import RunFacts, report_page
from bbfit.reporting.suns import under_suns
from bbfit.views.lit import LitViews
from bbfit.views.view_set import ViewSet

LIGHT = Light.of(direction(20.0, 35.0)[None], 2.5, 0.4)
# Azimuths of the suns that each camera sees besides the baked one. The first camera is 40 degrees high, the others look level.
SUNS = {0: (0, 90, 180, 270), 1: (300, 60, 170, 50), 2: (10, 20)}
T = TypeVar("T")


def pictures(cloud: BillboardCloud, cameras: Camera, light: Light, prefix: str) -> ViewSet:
    """What V cameras see of a cloud in V lights."""
    shown = torch.from_numpy(to_bytes(unpremultiply(render(cloud, cameras, light=light))))
    paths = tuple(Path(f"{prefix}{index}.png") for index in range(len(shown)))
    return ViewSet(paths, cameras.to(torch.float64), dict(zip(paths, shown, strict=True)).__getitem__, light)


@pytest.fixture(scope="module")
def views() -> tuple[ViewSet, LitViews]:
    """Three views of the column, and the same cameras under the sky and under single suns."""
    box = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([0.0, 3.0]), torch.tensor([-1.0, 1.0])).double().numpy()
    target, cloud = torch.tensor([0.0, 1.5, 0.0]).double(), column(LIGHT)
    ring = Orbit(9, (0.0, 40.0)).frame(box, target=target, width=40, height=48).to(torch.float32)
    level = [index for index in range(9) if abs(float(ring.forward[index, 1])) < 1e-3]
    cameras = ring[[next(index for index in range(9) if index not in level), *level[:2]]]
    of_sun = [(camera, direction(azimuth, 25.0)) for camera, azimuths in SUNS.items() for azimuth in azimuths]
    of_sun += [(camera, LIGHT.sun_directions[0]) for camera in SUNS]
    numbers, towards = [camera for camera, _ in of_sun], torch.stack([sun for _, sun in of_sun])
    skies = pictures(cloud, cameras, Light.of(direction(0.0, 90.0).repeat(3, 1), 0.0, 1.0), "sky")
    suns = pictures(cloud, cameras[numbers], Light.of(towards, math.pi, 0.0), "sun")
    return pictures(cloud, cameras, LIGHT[[0, 0, 0]], "view"), LitViews(skies, suns, tuple(numbers))


def scored(cloud: BillboardCloud, views: tuple[ViewSet, LitViews], alpha: Any) -> tuple[ShippedModel, Report]:
    model = shipped_model(cloud, ExportConfig(alpha=alpha, outline="rectangle"))
    return model, evaluate_model(model, views[0], lit=views[1])


@pytest.mark.parametrize("alpha", ["mask", "blend"])
def test_a_level_camera_shows_the_model_under_three_suns_that_are_apart(views: tuple[ViewSet, LitViews], alpha: str) -> None:
    """Two cameras have four suns; of those of the level one, 50 and 60 degrees are near each other."""
    model, report = scored(column(LIGHT), views, alpha)
    assert report.light is not None
    strip = under_suns(model, views[1], report.light.views)
    assert [each.score.sun_azimuth_degrees for each in strip] == [50, 170, 300]
    sunny = views[1].under(*SUNNY)
    for each in strip:
        index = sunny.names.index(each.score.name)
        assert views[1].cameras[index] == 1 and angles_degrees(views[1].directions[index])[0] == each.score.sun_azimuth_degrees
        assert torch.equal(each.target, sunny.targets([index], torch.float64)[0])
        assert mean_psnr(each.target, each.image) == pytest.approx(each.score.psnr)  # the picture that was scored
        assert each.score.psnr > 25
    assert float((strip[0].image - strip[1].image).abs().mean()) > 0.02
    few = under_suns(model, views[1], [view for view in report.light.views if view.sun_azimuth_degrees in (10, 20)])
    assert [each.score.sun_azimuth_degrees for each in few] == [10, 20]


Visit = Callable[..., Any]


@pytest.fixture(scope="module")
def visit(views: tuple[ViewSet, LitViews], tmp_path_factory: pytest.TempPathFactory, chromium: tuple[Browser, ThreadPoolExecutor]) -> Visit:
    """Does something with the report of the column, with its maps or with its light baked, which may complain of nothing."""
    folder, facts = tmp_path_factory.mktemp("suns"), RunFacts("column", {}, {}, {}, {}, [0.2, 0.1])
    for name, cloud in {"maps": column(LIGHT), "baked": column(LIGHT).baked(column(LIGHT).texels)}.items():
        model, report = scored(cloud, views, "blend")
        page = report_page(report, model, views[0], facts, model.glb, views[1])
        (folder / f"{name}.html").write_text(page, encoding="utf-8")
    browser, thread = chromium

    def visited(act: Callable[[Page], T], name: str, width: int) -> T:
        errors = list[str]()
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.on("pageerror", lambda error: errors.append(str(error)))
        try:
            page.goto((folder / f"{name}.html").as_uri())
            for _ in range(2000):
                if page.evaluate("'model' in bbfit"):
                    break
                page.wait_for_timeout(20)
            found = act(page)
            assert errors == []
            return found
        finally:
            page.close()

    return lambda act, name="maps", width=900: thread.submit(visited, act, name, width).result()


def canvas(page: Page) -> NDArray[np.float64]:
    """The model's canvas, [H, W, 3] in [0, 1]."""
    found = page.evaluate("() => { bbfit.model.draw(); return bbfit.model.canvas.toDataURL('image/png'); }")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(found.split(",")[1]))).convert("RGB")) / 255


def drag(page: Page, right: float, down: float) -> None:
    """Drag the sun to a place in the circle, whose radius is 1."""
    page.evaluate("document.querySelector('.stage').scrollIntoView()")
    box = page.locator("#dial").bounding_box()
    assert box is not None
    middle, radius = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), 0.4 * box["width"]
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + radius * right, middle[1] + radius * down, steps=3)
    page.mouse.up()


def said(page: Page) -> str:
    return page.evaluate("document.getElementById('sun-place').textContent")


def test_the_sun_lights_the_side_that_it_is_dragged_to(visit: Visit) -> None:
    """Whatever side of the model the camera sees. In the middle it is overhead, and nothing changes when the pointer only passes."""

    def act(page: Page) -> None:
        for camera in (0, math.pi):
            page.evaluate("azimuth => { bbfit.model.orbit.azimuth = azimuth; bbfit.model.orbit.update(); }", camera)
            for right in (-1, 1):
                drag(page, 0.8 * right, 0)
                image = canvas(page)
                rows, columns = image.shape[0] // 2, image.shape[1] // 2
                left_half, right_half = image[rows, columns - 100 : columns - 40].mean(), image[rows, columns + 40 : columns + 100].mean()
                assert right * (right_half - left_half) > 0.1
                assert said(page) == f"The sun is at {90 if (right == 1) == (camera == 0) else 270}°, 18° high."
        drag(page, 0, 0)
        assert said(page).endswith(", 90° high.")
        page.mouse.move(10, 10)
        assert said(page).endswith(", 90° high.")

    visit(act)


def test_the_model_begins_in_the_light_of_the_views_and_keys_move_the_sun(visit: Visit) -> None:
    """In the middle of the picture the normal points to +Z, so the sun's cosine is known."""

    def act(page: Page) -> None:
        first = canvas(page)
        assert said(page) == "The sun is at 20°, 35° high."
        middle = first[first.shape[0] // 2, first.shape[1] // 2]
        wanted = render(column(LIGHT), front(), light=LIGHT)[24, 20, :3]
        np.testing.assert_allclose(middle, wanted.numpy(), atol=0.01)
        page.focus("#dial")
        for key in ("ArrowLeft", "ArrowLeft", "ArrowUp"):
            page.keyboard.press(key)
        assert said(page) == "The sun is at 10°, 40° high."
        assert page.evaluate("document.getElementById('dial').getAttribute('aria-valuetext')") == said(page)
        assert np.abs(canvas(page) - first).max() > 0.01
        for _ in range(30):
            page.keyboard.press("ArrowDown")
        assert said(page) == "The sun is at 10°, 0° high."
        page.keyboard.press("Home")
        np.testing.assert_array_equal(canvas(page), first)

    visit(act)


def front() -> Camera:
    """A camera at +Z that looks at the column's middle."""
    pose = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, -1, 8], [0, 0, 0, 1]])
    return Camera(pose, torch.tensor([[80.0, 0, 19.5], [0, 80, 23.5], [0, 0, 1]]), 40, 48, False)


def test_the_strip_is_there_and_only_maps_have_a_sun(visit: Visit) -> None:
    def act(page: Page) -> dict[str, Any]:
        return page.evaluate(
            "({ dial: document.querySelectorAll('#dial').length, width: document.documentElement.scrollWidth,"
            " captions: [...document.querySelectorAll('#suns figcaption')].map(caption => caption.textContent),"
            " sizes: [...document.querySelectorAll('#suns img')].map(image => image.complete && image.naturalWidth),"
            " note: document.querySelector('#suns .note').textContent })"
        )

    for name, width in (("maps", 360), ("baked", 360), ("maps", 1200)):
        found = visit(act, name, width)
        assert found["width"] == width and found["sizes"] == [40] * 6
        assert [caption.split(" dB")[0].rsplit(" ", 1)[0] for caption in found["captions"]] == [
            f"sun at {azimuth}°, 25° high: PSNR" for azimuth in (50, 170, 300)
        ]
        assert found["dial"] == (name == "maps") and ("which no sun changes" in found["note"]) == (name == "baked")


def test_a_report_without_other_suns_has_no_strip(views: tuple[ViewSet, LitViews]) -> None:
    model, report = scored(column(LIGHT), views, "blend")
    page = partial(report_page, model=model, views=views[0], facts=RunFacts("column", {}, {}, {}, {}, [0.2]), glb=model.glb)
    assert 'id="suns"' in page(report, lit=views[1])
    assert 'id="suns"' not in page(report) and 'id="suns"' not in page(replace(report, light=None), lit=views[1])
