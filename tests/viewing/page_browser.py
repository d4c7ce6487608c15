"""A page in a headless Chromium, by a software GPU: pictures of it, and what it asks for and complains of."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import pytest
from browser import open_browser
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page

WIDTH, HEIGHT = 900, 360
# The darkest channel of a pixel of the tree is darker than this, those of the ground's lines are lighter.
DARK = 140
T = TypeVar("T")


class Tab:
    """A tab on one address; its browser is driven from a thread of its own, since playwright leaves an event loop running there."""

    def __init__(self, thread: ThreadPoolExecutor, page: Page) -> None:
        self._thread, self._page = thread, page
        self.errors, self.requests = list[str](), list[str]()

    def do(self, what: Callable[[Page], T]) -> T:
        """Do something in the browser's thread."""
        return self._thread.submit(what, self._page).result()

    def open(self, url: str) -> None:
        """Load a page and note what it asks for and complains of."""
        self._page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self._page.on("pageerror", lambda error: self.errors.append(str(error)))
        self._page.on("request", lambda request: self.requests.append(request.url))
        self._page.on("websocket", lambda socket: self.requests.append(socket.url))
        self._page.goto(f"{url}/?fixedDpr=1")  # else viser draws fewer pixels where it is slow
        # viser warns of the software GPU, over the picture.
        self._page.add_style_tag(content=".mantine-Notifications-root { display: none !important }")

    def text(self, selector: str) -> str:
        """What an element says."""
        return self.do(lambda page: page.evaluate("name => document.querySelector(name)?.textContent ?? ''", selector))

    def frame(self) -> dict[str, Any]:
        """What the page's script has measured."""
        return self.do(lambda page: page.evaluate("window.bbfit.frame"))

    def picture(self) -> NDArray[np.int64]:
        """The scene as it is on the screen, without the labels, [H, W, 3]."""

        def shoot(page: Page) -> bytes:
            page.evaluate("document.querySelector('#bbfit-overlay').style.visibility = 'hidden'")
            try:
                return page.locator("canvas").first.screenshot()
            finally:
                page.evaluate("document.querySelector('#bbfit-overlay').style.visibility = 'visible'")

        return np.asarray(Image.open(io.BytesIO(self.do(shoot))).convert("RGB")).astype(np.int64)

    def still(self) -> NDArray[np.int64]:
        """The scene once it does not change any more."""
        before = self.picture()
        for _ in range(40):
            time.sleep(0.3)
            now = self.picture()
            if before.shape == now.shape and (before == now).all() and not self.frame()["measuring"]:
                return now
            before = now
        pytest.fail("the picture does not come to rest")


@contextmanager
def open_tabs() -> Iterator[Callable[[str], Tab]]:
    """A browser; what is yielded opens a tab on an address. The test fails where there is no browser."""
    with open_browser() as (browser, thread):

        def begin(url: str) -> Tab:
            tab = Tab(thread, browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}))
            tab.open(url)
            return tab

        yield lambda url: thread.submit(begin, url).result()


def wait_for(what: Callable[[], T], seconds: float = 60.0) -> T:
    """Wait until something is true, and return it."""
    until = time.monotonic() + seconds
    while True:
        found = what()
        if found:
            return found
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)


def halves(picture: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The two panes."""
    width = picture.shape[1] // 2
    return picture[:, :width], picture[:, width:]


def colored(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where a tree or an outline is, [H, W]."""
    return picture.min(-1) < DARK
