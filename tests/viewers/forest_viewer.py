"""Forests in real programs of a browser; forest_page.js draws them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from browser_viewer import HERE, NODE, ORIGIN, TYPES
from numpy.typing import NDArray
from playwright.sync_api import Browser, Error, Page, Route

_TYPES = TYPES | {".json": "application/json", ".png": "image/png"}


class ForestPage:
    """A page that shows a forest in a program."""

    def __init__(self, browser: Browser, thread: ThreadPoolExecutor, query: str, forest: Path, library: Path) -> None:
        self._thread, self._errors = thread, list[str]()
        self.requested = list[str]()
        """The files of the forest that the page has loaded."""
        self._page = thread.submit(self._open, browser, query, forest, library).result()

    def look(self, **view: Any) -> dict[str, Any]:
        """Draw a view; ``picture`` is [240, 320, 3], and the rest is what the program's page says."""
        try:
            found: dict[str, Any] = self._thread.submit(self._page.evaluate, "view => window.look(view)", view).result()
        except Error as error:
            raise AssertionError([str(error), *self._errors]) from error
        assert not self._errors, self._errors
        return found | {"picture": np.array(found["picture"], np.uint8).reshape(240, 320, 4)[..., :3]}

    def picture(self, **view: Any) -> NDArray[np.uint8]:
        """The picture of a view, [240, 320, 3]."""
        picture: NDArray[np.uint8] = self.look(**view)["picture"]
        return picture

    def close(self) -> None:
        """Close the page."""
        self._thread.submit(self._page.close).result()

    def _open(self, browser: Browser, query: str, forest: Path, library: Path) -> Page:
        page = browser.new_page()
        page.on("pageerror", lambda error: self._errors.append(str(error)))
        page.on("console", lambda message: self._errors.append(message.text) if message.type == "error" else None)
        page.route("**/*", lambda route: self._answer(route, forest, library))
        page.goto(f"{ORIGIN}/forest.html?{query}")
        return page

    def _answer(self, route: Route, forest: Path, library: Path) -> None:
        path = route.request.url.removeprefix(f"{ORIGIN}/").partition("?")[0]
        kind, _, name = path.partition("/")
        file = {"forest": forest / name, "library": library / name, "node_modules": NODE / path}.get(kind, HERE / path)
        if kind == "forest":
            self.requested.append(name)
        if file.is_file():
            route.fulfill(path=file, content_type=_TYPES.get(file.suffix, "application/octet-stream"))
        else:
            route.abort()


@contextmanager
def open_forest(chromium: tuple[Browser, ThreadPoolExecutor], query: str, forest: Path, library: Path) -> Iterator[ForestPage]:
    """A page with a forest in the program of a ``query`` as ``program=cesium``."""
    page = ForestPage(*chromium, query, forest, library)
    try:
        yield page
    finally:
        page.close()
