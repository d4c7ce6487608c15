"""A Chromium without a window, and the pages in it that draw fields of trees."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

from bbfit.checks import InputError, check_file, fail
from bbfit.frames.config import PACKAGES, FramesConfig, Program

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = ["--no-sandbox", "--disable-dev-shm-usage"]
_SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_CARD = ["--ignore-gpu-blocklist", "--use-gl=angle", "--enable-gpu"]
# No such host: every request is answered from the disk.
_ORIGIN = "https://frames.invalid"
_SCRIPT = "text/javascript"
_TYPES = {".html": "text/html", ".js": _SCRIPT, ".mjs": _SCRIPT, ".wasm": "application/wasm", ".glb": "model/gltf-binary"}
# Scripts of other packages that the pages import.
_SCRIPTS = (("bbfit.frames", "page"), ("bbfit.exporting", "lod_programs"), ("bbfit.rivals", "programs"))


class FieldPage:
    """A page with a program; :func:`open_pages` opens it. ``page/frames.js`` has its functions."""

    def __init__(self, thread: ThreadPoolExecutor, browser: Any, program: Program, modules: Path) -> None:
        """Open the page of a program."""
        self._thread, self._errors, self._modules = thread, list[str](), modules
        self.answers = dict[str, Path | bytes]()
        """What the page finds under other addresses: files or contents, by their paths."""
        self.browser = f"{browser.browser_type.name.capitalize()} {browser.version}"
        """The browser and its version."""
        self._page = thread.submit(self._open, browser, program).result()

    def call(self, name: str, argument: Any = None) -> Any:
        """Call ``window.NAME(argument)`` and return its result. Raises InputError with what the page reports if it fails."""
        from playwright.sync_api import Error

        try:
            return self._thread.submit(self._page.evaluate, f"argument => window.{name}(argument)", argument).result()
        except Error as error:
            reason = (self._errors or str(error).splitlines())[-1]
            raise InputError(f"frames: the browser cannot draw ({reason}); try fewer trees or pixels") from error

    def picture(self) -> bytes:
        """The PNG of what the page shows."""
        return bytes(self._thread.submit(lambda: self._page.locator("canvas").screenshot(type="png")).result())

    def _open(self, browser: Any, program: Program) -> Any:
        page = browser.new_page()
        page.set_default_timeout(0)
        page.on("pageerror", lambda error: self._errors.append(str(error)))
        page.on("console", lambda message: self._errors.append(message.text) if message.type == "error" else None)
        page.route("**/*", self._answer)
        page.goto(f"{_ORIGIN}/frames.html?program={program}")
        return page

    def _answer(self, route: Any) -> None:
        name = route.request.url.removeprefix(f"{_ORIGIN}/").partition("?")[0]
        content = self.answers.get(name)
        if content is None and name.startswith("node_modules/"):
            content = self._modules / name.removeprefix("node_modules/")
        elif content is None:
            scripts = [files(package) / folder / name for package, folder in _SCRIPTS]
            content = next((script.read_bytes() for script in scripts if script.is_file()), None)
        kind = _TYPES.get(Path(name).suffix, "application/octet-stream")
        if isinstance(content, bytes):
            route.fulfill(body=content, content_type=kind)
        elif content is not None and content.is_file():
            route.fulfill(path=content, content_type=kind)
        else:
            route.abort()


@contextmanager
def open_pages(config: FramesConfig) -> Iterator[Mapping[Program, FieldPage]]:
    """A page for each program that draws in a browser. Raises InputError if playwright, a browser or a program is not installed.

    The browser is driven from a thread of its own, because playwright refuses threads with an event loop, such as those of notebooks.
    """
    if not any(PACKAGES[program] for program in config.programs):
        yield {}
        return
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        fail("frames", "playwright is not installed", 'install bbfit with its extra, pip install "bbfit[frames]"')
    executable, modules = find_browser(config.browser), find_modules(config)
    flags = [*_FLAGS, *(_CARD if config.graphics_card else _SOFTWARE)]
    with ThreadPoolExecutor(1) as thread:
        driver = thread.submit(lambda: sync_playwright().start()).result()
        try:
            browser = thread.submit(lambda: driver.chromium.launch(executable_path=executable, args=flags)).result()
            try:
                yield {program: FieldPage(thread, browser, program, modules) for program in config.programs if PACKAGES[program]}
            finally:
                thread.submit(browser.close).result()
        finally:
            thread.submit(driver.stop).result()


def find_browser(browser: Path | None) -> Path:
    """Chromium's program: the one given, or the one on the path. Raises MissingFileError or InputError if there is none."""
    if browser is not None:
        return check_file("browser", browser)
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        fail("browser", "Chromium is not installed", "install it (on Debian and Ubuntu: apt-get install chromium), or give --browser")
    return Path(found)


def find_modules(config: FramesConfig) -> Path:
    """The folder ``node_modules`` with the packages of all programs. Raises InputError if one is missing."""
    here = Path.cwd()
    folders = [config.node_modules] if config.node_modules else [folder / "node_modules" for folder in (here, *here.parents)]
    packages = [package for program in config.programs for package in PACKAGES[program]]
    for folder in folders:
        if all((folder / package / "package.json").is_file() for package in packages):
            return folder
    raise InputError(
        f"node_modules: {' and '.join(packages)} are not in {folders[0]}{'' if config.node_modules else ' or above it'}; "
        f"install them there with npm install {' '.join(packages)}"
    )
