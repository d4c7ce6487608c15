"""What real programs show of a GLB: their renderers and loaders in a headless Chromium, by a software GPU.

page.js says what a page gives. A further program needs its package in tests/node, a line of ``PACKAGES``, an import in page.html where it
is a module, and a page.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_arrays import matrix
from numpy.typing import NDArray
from playwright.sync_api import Browser, ConsoleMessage, Page, Route

from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light
from bbfit.geometry.opengl import camera_to_world_matrix, projection_matrix
from bbfit.glb import gltf_parts

HERE = Path(__file__).parent
NODE = HERE.parent / "node"
PROGRAMS = HERE.parents[1] / "bbfit" / "rivals" / "programs"
# No such host: every request is answered from the disk.
ORIGIN = "https://viewer.invalid"
SCRIPT = "text/javascript"
TYPES = {".html": "text/html", ".js": SCRIPT, ".mjs": SCRIPT, ".wasm": "application/wasm", ".glb": "model/gltf-binary"}
# The programs: the name of the page and the package of npm.
PACKAGES = {
    "three": "three",
    "babylon": "@babylonjs/core",
    "playcanvas": "playcanvas",
    "model-viewer": "@google/model-viewer",
    "cesium": "cesium",
    "filament": "filament",
}


@dataclass(frozen=True)
class BrowserMaterial:
    """A material as the program's loader made it."""

    name: str
    """As in the file."""
    kind: str
    """The program's class. In three.js, MeshBasicMaterial is unlit and MeshStandardMaterial lit."""
    alpha_test: float
    """Least alpha drawn; 0 draws all."""
    transparent: bool
    """Whether it is blended, and sorted from back to front."""
    side: str
    """``front`` (back faces are culled), ``back`` or ``double``."""
    size: tuple[int, int] | None
    """Width and height of its color texture, if it has one."""
    min_filter: int | None
    """glTF's number of the minification filter."""
    mag_filter: int | None
    """glTF's number of the magnification filter."""
    compressed: bool
    """Whether the texture lies compressed in the GPU's memory."""


@dataclass(frozen=True)
class BrowserShow:
    """What a program shows of a model."""

    images: NDArray[np.float64]
    """Display-referred RGB over white in [0, 1], one sample a pixel, [V, H, W, 3]."""
    calls: tuple[int, ...]
    """Draw calls of each view; a blended material that shows both sides takes two a mesh, the back faces first. Zeros of most programs,
    which do not tell."""
    triangles: tuple[int, ...]
    """Triangles drawn in each view, counted once a draw call; zeros where calls are."""
    materials: tuple[BrowserMaterial, ...]
    """Materials of the meshes that are shown, if the program's page tells."""
    warnings: tuple[str, ...]
    """What the program warned of."""


class BrowserViewer:
    """A page with a program, which shows one model after another; made by :func:`open_program`."""

    def __init__(self, browser: Browser, thread: ThreadPoolExecutor, page: str) -> None:
        self._browser, self._thread, self._address = browser, thread, page
        self._page: Page | None = None
        self._glb = Path()
        self._errors, self._warnings = list[str](), list[str]()

    def render(self, glb: Path, camera: Camera, *, node: str | None = None, light: Light | None = None) -> NDArray[np.float64]:
        """Pictures over white of a batch of cameras, [V, H, W, 3]; see :meth:`show`."""
        return self.show(glb, camera, node=node, light=light).images

    def show(self, glb: Path, camera: Camera, *, node: str | None = None, light: Light | None = None) -> BrowserShow:
        """Load a GLB and draw it from a batch of V cameras, in V lights if there are any.

        ``node`` shows only the node of that name with its descendants, in the scene or beside it, as levels of detail are.
        Whatever the page reports as an error is an ``AssertionError``; the next model then has a new page.
        """
        return self._thread.submit(self._show, glb, camera.batch(), node, light).result()

    def surround(self, panorama: NDArray[np.float32]) -> None:
        """Light all models that follow by a panorama, equirectangular and in linear light, [H, W, 3]; three.js only."""
        values = base64.b64encode(np.concatenate([panorama, np.ones_like(panorama[..., :1])], -1)[::-1].tobytes()).decode()
        height, width = panorama.shape[:2]

        def work() -> None:
            self._page = self._page or self._open()
            self._page.evaluate("sky => window.surround(sky)", {"values": values, "width": width, "height": height})

        self._thread.submit(work).result()

    def _show(self, glb: Path, camera: Camera, node: str | None, light: Light | None) -> BrowserShow:
        self._glb = glb
        self._warnings.clear()
        page = self._page = self._page or self._open()
        try:
            materials = page.evaluate("node => window.load(node)", node)
            bounds = extent(glb)
            views = [_draw(page, camera[index], bounds, None if light is None else light[[index]]) for index in range(len(camera))]
            assert not self._errors, self._errors
        except BaseException:
            self._close()
            raise
        images, calls, triangles = zip(*views, strict=True)
        return BrowserShow(np.stack(images), calls, triangles, tuple(map(_material, materials)), tuple(self._warnings))

    def _open(self) -> Page:
        page = self._browser.new_page()
        self._errors.clear()
        page.on("console", self._hear)
        page.on("pageerror", lambda error: self._errors.append(str(error)))
        page.route("**/*", lambda route: _answer(route, self._glb))
        try:
            page.goto(f"{ORIGIN}/{self._address}")
            assert not self._errors, self._errors
        except BaseException:
            page.close()
            raise
        return page

    def _hear(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self._errors.append(message.text)
        elif message.type == "warning" and message.text.startswith(("THREE.", "BJS")):  # others are the GPU driver's, on speed
            self._warnings.append(message.text)

    def _close(self) -> None:
        if self._page is not None:
            self._page.close()
            self._page = None

    def close(self) -> None:
        """Close the page."""
        self._thread.submit(self._close).result()


@contextmanager
def open_program(browser: Browser, thread: ThreadPoolExecutor, program: str, query: str = "") -> Iterator[BrowserViewer]:
    """A page of one of ``PACKAGES`` for as many GLBs as wanted; the test fails where the program is not installed.

    A ``query`` as ``smooth=own`` sets what the program's page says.
    """
    version_of(program)
    with closing(BrowserViewer(browser, thread, f"page.html?program={program}&{query}")) as viewer:
        yield viewer


def version_of(program: str) -> str:
    """The version of one of ``PACKAGES`` that is installed; the test fails where none is."""
    described = NODE / "node_modules" / PACKAGES[program] / "package.json"
    if not described.is_file():
        pytest.fail(f"{PACKAGES[program]} is not installed: install Node.js and run `npm ci` in {NODE}")
    return str(json.loads(described.read_text(encoding="utf-8"))["version"])


def extent(glb: Path) -> NDArray[np.float64]:
    """Least and greatest coordinates of all meshes in a GLB whose nodes are moved or scaled, if at all, on their own, [2, 3]."""
    tree, _ = gltf_parts(glb.read_bytes())
    corners = []
    for node in tree["nodes"]:
        placed = matrix(node)
        for primitive in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            accessor = tree["accessors"][primitive["attributes"]["POSITION"]]
            corners += [placed[:3, :3] @ accessor[end] + placed[:3, 3] for end in ("min", "max")]
    return np.stack([np.min(corners, 0), np.max(corners, 0)])


def _draw(page: Page, camera: Camera, bounds: NDArray[np.float64], light: Light | None) -> tuple[NDArray[np.float64], int, int]:
    distance = float(np.linalg.norm(camera.position.double().numpy() - bounds.mean(0)))
    radius = 1.01 * float(np.linalg.norm(bounds[1] - bounds[0])) / 2
    near, far = max(distance - radius, 1e-3 * distance), distance + radius
    view = {
        "projection": projection_matrix(camera, near, far).T.ravel().tolist(),
        "cameraToWorld": camera_to_world_matrix(camera).T.ravel().tolist(),
        "near": near,
        "far": far,
        "width": camera.width,
        "height": camera.height,
        "light": None if light is None else light_values(light),
    }
    drawn = page.evaluate("view => window.draw(view)", view)
    pixels = np.frombuffer(base64.b64decode(drawn["pixels"]), np.uint8).reshape(camera.height, camera.width, 4)
    return pixels[..., :3] / 255.0, drawn["calls"], drawn["triangles"]


def light_values(light: Light) -> dict[str, Any]:
    """One light as the pages of programs expect it."""
    return {
        "direction": light.sun_directions[0].tolist(),
        "strength": light.sun_strengths.item(),
        "color": light.sun_colors[0].tolist(),
        "ambient": light.ambients.item(),
    }


def _material(found: dict[str, Any]) -> BrowserMaterial:
    picture = found["map"] or {}
    return BrowserMaterial(
        name=found["name"],
        kind=found["type"],
        alpha_test=found["alphaTest"],
        transparent=found["transparent"],
        side=found["side"],
        size=(picture["width"], picture["height"]) if picture else None,
        min_filter=picture.get("min"),
        mag_filter=picture.get("mag"),
        compressed=picture.get("compressed", False),
    )


def _answer(route: Route, glb: Path) -> None:
    """Serve the page, the program, the model and the pictures beside it under the page's own origin; refuse everything else."""
    name = route.request.url.removeprefix(f"{ORIGIN}/").partition("?")[0]
    places = [glb] if name == "model.glb" else [HERE / name, PROGRAMS / name, NODE / "node_modules" / name, glb.parent / name]
    file = next(filter(Path.is_file, places), None)
    if file is None:
        route.abort()
        return
    route.fulfill(path=file, content_type=TYPES.get(file.suffix))
