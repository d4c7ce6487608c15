"""A small finished run, a browser, and a page on that run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from page_browser import Tab, open_tabs, wait_for

from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig, run
from bbfit.viewing.page import Page
from bbfit.viewing.subject import open_run
from bbfit.viewing.visitor import Visitor

DATA = Path(__file__).resolve().parents[2] / "data"
FIT = FitConfig(billboards=4, placement="even", steps=120)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the project's own tree. Do not change it."""
    return run(DATA / "views", tmp_path_factory.mktemp("viewing") / "small", RunConfig(tree=DATA / "tree.glb", fit=FIT)).folder


@pytest.fixture(scope="session")
def browse() -> Iterator[Callable[[str], Tab]]:
    """Opens tabs."""
    with open_tabs() as begin:
        yield begin


@pytest.fixture(scope="module")
def seen(small_run: Path, browse: Callable[[str], Tab]) -> Iterator[tuple[Page, Visitor, Tab]]:
    """A page on the small run, its one visitor, and that visitor's browser."""
    with Page(port=0) as page:
        page.show(open_run(small_run))
        tab = browse(page.url)
        visitor = wait_for(lambda: next(iter(page.visitors), None))
        wait_for(lambda: "being measured" not in visitor.panel.readout.content if hasattr(visitor, "panel") else False)
        wait_for(lambda: "vertices" in tab.text("#bbfit-label-1"))
        yield page, visitor, tab
