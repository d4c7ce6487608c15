"""A fit that is looked on at."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from page_browser import Tab, halves, wait_for

from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import Step, fit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.viewing import watching
from bbfit.viewing.page import Page
from bbfit.viewing.watching import Watch, preview
from bbfit.views import ViewDataset

DATA = Path(__file__).resolve().parents[2] / "data"


def test_the_page_follows_the_fit_and_ends_with_the_run(
    small_run: Path, browse: Callable[[str], Tab], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "_EVERY", 0.0)
    monkeypatch.setattr(watching, "_SHARE", 1e9)
    with Page(port=0) as page:
        tab, pictures = browse(page.url), list[NDArray[np.int64]]()
        watch = Watch(page, small_run, DATA / "views", DATA / "tree.glb", "mask")

        def on_step(step: Step) -> None:
            watch.on_step(step)
            if step.index in (1, 30):
                # The step before may still be drawn when this one comes.
                wait_for(lambda: f"step {step.index} of 30, loss" in tab.text("#bbfit-frame") or watch.on_step(step))
                assert wait_for(lambda: tab.text("#bbfit-label-1")).startswith("2 billboards")
                pictures.append(halves(tab.still())[1])

        fit(ViewDataset.load(DATA / "views"), FitConfig(billboards=2, placement="even", steps=30, levels=1), on_step=on_step)
        # Textures begin as noise; the last are those of a tree.
        assert (abs(pictures[0] - pictures[1]).max(-1) > 32).mean() > 0.01
        (visitor,) = page.visitors
        assert visitor.subject.live
        watch.finish()
        wait_for(lambda: tab.text("#bbfit-label-1").startswith("4 billboards") and "step" not in tab.text("#bbfit-frame"))
        assert not visitor.subject.live
        assert not tab.errors


def test_pictures_are_few_but_the_last_is_among_them(known_cloud: BillboardCloud, tmp_path: Path) -> None:
    """The fit hands over a copy and goes on; steps that come soon after are passed over."""
    taken = list[int]()
    with Page(port=0) as page, contextlib.closing(Watch(page, tmp_path, DATA / "views", None, "mask")) as watch:

        def step(index: int) -> Step:
            return Step(index, 100, 0.5, 0.1, lambda: (taken.append(index), known_cloud)[1])

        watch.on_step(step(1))
        wait_for(lambda: watch.spent)
        watch.on_step(step(2))
        watch.on_step(step(100))
    assert taken == [1, 100]


def test_previews_have_fewer_texels_of_the_same_color(known_cloud: BillboardCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    texels = known_cloud.texels.clone()
    texels[:] = torch.tensor([0.2, 0.6, 0.4, 0.5])
    flat = replace(known_cloud, texels=texels)
    assert preview(flat, "mask").alpha.kind == "mask"
    torch.testing.assert_close(preview(flat, "blend").texels, texels)
    monkeypatch.setattr(watching, "_TEXELS", 600)
    small = preview(flat, "blend")
    assert small.texture_sizes.tolist() == [[18, 15], [18, 15]]
    torch.testing.assert_close(small.texels, texels[: len(small.texels)])
    torch.testing.assert_close(small.half_extents, flat.half_extents)
