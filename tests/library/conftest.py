"""A library of two trees, which is built once."""

from __future__ import annotations

from pathlib import Path

import pytest

from bbfit.blender.config import ViewsConfig
from bbfit.fitting.config import FitConfig
from bbfit.library.building import build_library
from bbfit.library.config import LibraryConfig
from bbfit.library.manifest import Library
from bbfit.pipeline import RunConfig
from bbfit.trees.config import GrowConfig

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
LEVELS = LibraryConfig(planes=(3, 2), error_pixels=0.5, workers=1)
SMALL = RunConfig(
    grow=GrowConfig(detail=0.1, leaves=0.05),
    views=ViewsConfig(count=8, size=48, samples=1, denoise=False),
    fit=FitConfig(steps=8, candidates=1, refinement_rounds=0, restarts=1),
)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """An acer with seed 1, and a tree from a file. Do not change it."""
    return build_library([TREE], tmp_path_factory.mktemp("library") / "out", LEVELS, SMALL, species=["acer"], seeds=[1])
