"""three.js in a browser, and cameras around the noise."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from browser_viewer import BrowserViewer, open_program
from playwright.sync_api import Browser

from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit

sys.path.append(str(Path(__file__).parents[1] / "exporting"))  # for glb_viewer


@pytest.fixture(scope="session")
def three(chromium: tuple[Browser, ThreadPoolExecutor]) -> Iterator[BrowserViewer]:
    """three.js in a browser."""
    with open_program(*chromium, "three") as viewer:
        yield viewer


@pytest.fixture(scope="session")
def around() -> Camera:
    """Five views from around, 64 x 56 pixels, in which two meters are about 28 pixels; the axis passes beside the picture's middle."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double() + torch.tensor([0.0, 1.0, 0.0])
    camera = Orbit(5, (12.0,)).frame(corners.numpy(), target=torch.tensor([0.0, 1.0, 0.0]).double(), width=64, height=56)
    aside = torch.tensor([[0.0, 0, 3.3], [0, 0, -2.6], [0, 0, 0]], dtype=torch.float64)
    return replace(camera, intrinsics=camera.intrinsics + aside)
