"""Thinned-out trees with vertices of integers in real programs: they show what they show with floats."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from browser_viewer import extent, open_program
from playwright.sync_api import Browser

from bbfit.blender.conversion import tree_as_glb
from bbfit.evaluation.metrics import psnr
from bbfit.exporting.vertex_formats import quantized_tree
from bbfit.geometry.light import Light, sky
from bbfit.geometry.orbit import Orbit

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A thinned-out tree with floats, with integers, and with half of the triangles."""
    folder = tmp_path_factory.mktemp("models")
    floats = tree_as_glb(TREE, folder / "floats.glb", triangles=4000)
    integers = folder / "integers.glb"
    integers.write_bytes(quantized_tree(floats.read_bytes()))
    return floats, integers, tree_as_glb(TREE, folder / "fewer.glb", triangles=2000)


@pytest.mark.parametrize("program", ["three", "babylon"])
def test_a_program_shows_integers_as_floats(
    program: str, models: tuple[Path, Path, Path], chromium: tuple[Browser, ThreadPoolExecutor]
) -> None:
    low, high = torch.from_numpy(extent(models[0]))
    corners = torch.cartesian_prod(*torch.stack([low, high], -1))
    cameras = Orbit(3, (20.0,)).frame(corners.numpy(), target=(low + high) / 2, width=128, height=128)
    lights = Light.of(sky(3, 40.0), 1.8 * torch.pi, 0.4)
    with open_program(*chromium, program) as viewer:
        floats, integers, fewer = (viewer.render(path, cameras, light=lights) for path in models)
    assert floats.min() < 0.3 and floats.std() > 0.1  # a tree over white
    assert psnr(floats, integers) >= 40  # measured 50.1
    assert psnr(floats, fewer) < 30  # measured 23.6
