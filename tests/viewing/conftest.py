"""A small finished run, a browser, and the viewer of that run."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from page_browser import Browse, Tab, open_tab
from playwright.sync_api import Browser

import bbfit
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig, run
from bbfit.viewing.server import Viewer

DATA = Path(__file__).resolve().parents[2] / "data"
FIT = FitConfig(billboards=4, placement="even", steps=120)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the project's own tree, in few pieces, because a browser draws some models ten thousand times. Do not change it."""
    config = RunConfig(tree=DATA / "tree.glb", fit=FIT, export=ExportConfig(pieces=2))
    return run(DATA / "views", tmp_path_factory.mktemp("viewing") / "small", config).folder


@pytest.fixture(scope="session")
def browse(chromium: tuple[Browser, ThreadPoolExecutor]) -> Browse:
    """Opens tabs."""
    return partial(open_tab, *chromium)


@pytest.fixture(scope="module")
def opened(small_run: Path, browse: Browse) -> Iterator[tuple[Viewer, Tab]]:
    """The viewer of the small run, once its billboards are measured, and a tab on it."""
    with bbfit.view(small_run, port=0) as viewer, browse(viewer.url) as tab:
        tab.wait_until("bbfit.viewer.state.tree && !bbfit.viewer.state.tree.measuring")
        yield viewer, tab
