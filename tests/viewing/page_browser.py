"""The viewer's page in a headless Chromium with a software GPU: its pictures, its requests and its errors."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page

WIDTH, HEIGHT = 900, 360
# The darkest channel of a pixel of the tree is darker than this, those of the ground's lines are lighter.
DARK = 140
T = TypeVar("T")
Browse = Callable[[str], AbstractContextManager["Tab"]]
"""Opens a tab on an address, and closes it at the end."""


class Tab:
    """A tab. Its browser is driven from a thread of its own, since playwright leaves an event loop running there."""

    def __init__(self, thread: ThreadPoolExecutor, page: Page) -> None:
        self._thread, self._page = thread, page
        self.errors, self.requests = list[str](), list[str]()
        page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))

    def do(self, action: Callable[[Page], T]) -> T:
        """Do something in the browser's thread."""
        return self._thread.submit(action, self._page).result()

    def evaluate(self, script: str, argument: Any = None) -> Any:
        """The value of a JavaScript expression or function."""
        return self.do(lambda page: page.evaluate(script, argument))

    def wait_until(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        wait_for(lambda: self.evaluate(f"Boolean(window.bbfit?.viewer && ({condition}))"))

    def text(self, selector: str) -> str:
        """The text of an element."""
        return self.evaluate("name => document.querySelector(name).textContent", selector)

    def select(self, name: str, value: str) -> None:
        """Choose an option of a control, if another is chosen."""

        def choose(page: Page) -> None:
            control = page.locator(f"[name={name}]")
            if control.input_value() != value:
                control.select_option(value)

        self.do(choose)

    def resize(self, width: int, height: int) -> None:
        """Change the size of the window, and wait until the canvas has followed."""
        self.do(lambda page: page.set_viewport_size({"width": width, "height": height}))
        followed = (
            "(canvas => canvas.width === canvas.clientWidth && canvas.height === canvas.clientHeight)(document.querySelector('canvas'))"
        )
        self.wait_until(f"innerWidth === {width} && innerHeight === {height} && {followed}")

    def picture(self, pane: str) -> NDArray[np.int64]:
        """The left or right pane once everything is loaded and drawn, without its header, [H, W, 3]."""
        self.wait_until("bbfit.viewer.idle")
        content = self.do(lambda page: page.locator(f"#{pane} .area").screenshot())
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(np.int64)


@contextmanager
def open_tab(browser: Browser, thread: ThreadPoolExecutor, url: str) -> Iterator[Tab]:
    """A tab on an address; a tab that stays open would go on drawing."""
    page = thread.submit(browser.new_page, viewport={"width": WIDTH, "height": HEIGHT}).result()
    try:
        tab = Tab(thread, page)
        tab.do(lambda page: page.goto(url))
        yield tab
    finally:
        thread.submit(page.close).result()


def wait_for(condition: Callable[[], T], seconds: float = 400.0) -> T:
    """Wait until something is true, and return it."""
    until = time.monotonic() + seconds
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < until, "the condition has not become true"
        time.sleep(0.05)


def colored(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where a tree or an outline is, [H, W]."""
    return picture.min(-1) < DARK
