"""Watching a fit."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from page_browser import Browse, wait_for

from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import Step, fit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.viewing.server import Viewer
from bbfit.viewing.watching import Watch, WatchedRun, preview
from bbfit.views.dataset import ViewDataset

DATA = Path(__file__).resolve().parents[2] / "data"


def test_the_page_follows_the_fit_and_ends_with_the_run(small_run: Path, browse: Browse) -> None:
    with Viewer(port=0) as viewer, browse(viewer.url) as tab:
        pictures = list[NDArray[np.int64]]()
        assert "waiting for the first billboards" in tab.text("#right header")
        watched = WatchedRun(small_run, DATA / "views", DATA / "tree.glb", "mask")
        watch = Watch(viewer, watched, interval=0.0, share=1e9)

        def on_step(step: Step) -> None:
            # Previews of all steps would replace each other before the page has loaded them.
            if step.index in (1, 30):
                watch.on_step(step)
                wait_for(lambda: f"step {step.index} of 30, loss" in tab.text("#status"))
                pictures.append(tab.picture("right"))
                assert tab.text("#right header").startswith("2 billboards")

        fit(ViewDataset.load(DATA / "views"), FitConfig(billboards=2, placement="even", steps=30, levels=1), on_step=on_step)
        # Textures begin as noise; the last are those of a tree.
        assert (abs(pictures[0] - pictures[1]).max(-1) > 32).mean() > 0.01
        assert viewer.tree is not None and viewer.tree.live
        watch.finish()
        tab.wait_until("bbfit.viewer.state.tree && !bbfit.viewer.state.tree.live")
        tab.picture("right")
        assert tab.text("#right header").startswith("4 billboards") and "step" not in tab.text("#status")
        assert sum(url.endswith("/original.glb") for url in tab.requests) == 1
        assert not tab.errors


def test_previews_are_few_but_the_last_is_among_them(known_cloud: BillboardCloud, tmp_path: Path) -> None:
    """The fit hands over a copy and goes on; steps that come soon after are passed over."""
    taken = list[int]()
    with (
        Viewer(port=0) as viewer,
        contextlib.closing(Watch(viewer, WatchedRun(tmp_path, DATA / "views", None, "mask"), interval=1e6)) as watch,
    ):

        def step(index: int) -> Step:
            return Step(index, 100, 0.5, 0.1, lambda: (taken.append(index), known_cloud)[1])

        watch.on_step(step(1))
        watch.close()
        watch.on_step(step(2))
        watch.on_step(step(100))
    assert taken == [1, 100]


def test_previews_have_fewer_texels_of_the_same_color(known_cloud: BillboardCloud) -> None:
    texels = known_cloud.texels.clone()
    texels[:] = torch.tensor([0.2, 0.6, 0.4, 0.5])
    flat = replace(known_cloud, texels=texels)
    assert preview(flat, "mask").alpha.kind == "mask"
    torch.testing.assert_close(preview(flat, "blend").texels, texels)
    small = preview(flat, "blend", max_texels=600)
    assert small.texture_sizes.tolist() == [[18, 15], [18, 15]]
    torch.testing.assert_close(small.texels, texels[: len(small.texels)])
    torch.testing.assert_close(small.half_extents, flat.half_extents)
