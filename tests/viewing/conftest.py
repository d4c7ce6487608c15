"""A small finished run, a browser, and the viewer of that run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from page_browser import Tab, open_tabs

import bbfit
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig, run
from bbfit.viewing.server import Viewer

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
def opened(small_run: Path, browse: Callable[[str], Tab]) -> Iterator[tuple[Viewer, Tab]]:
    """The viewer of the small run, once its billboards are measured, and a tab on it."""
    with bbfit.view(small_run, port=0) as viewer:
        tab = browse(viewer.url)
        tab.wait_until("bbfit.viewer.state.tree && !bbfit.viewer.state.tree.measuring")
        yield viewer, tab
