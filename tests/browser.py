"""A headless Chromium with a software GPU, for whatever has to be seen in a browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, sync_playwright

BROWSERS = ("chromium", "google-chrome", "chromium-browser")
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]


@contextmanager
def open_browser() -> Iterator[tuple[Browser, ThreadPoolExecutor]]:
    """A browser, and the one thread that may speak to it; the test fails where none is installed.

    It is driven from a thread of its own, since playwright leaves an event loop running in the thread that it works in.
    """
    chromium = next(filter(None, map(shutil.which, BROWSERS)), None)
    if chromium is None:
        pytest.fail(f"no browser is installed: install one of {', '.join(BROWSERS)} (apt-get install chromium)")
    with ThreadPoolExecutor(1) as thread:
        driver = thread.submit(lambda: sync_playwright().start()).result()
        try:
            browser = thread.submit(lambda: driver.chromium.launch(executable_path=chromium, args=FLAGS)).result()
            try:
                yield browser, thread
            finally:
                thread.submit(browser.close).result()
        finally:
            thread.submit(driver.stop).result()
