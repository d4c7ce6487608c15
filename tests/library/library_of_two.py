"""The options of the small library that the tests share."""

from __future__ import annotations

from pathlib import Path

from bbfit.blender.config import ViewsConfig
from bbfit.fitting.config import FitConfig
from bbfit.library.config import LibraryConfig
from bbfit.pipeline import RunConfig
from bbfit.trees.config import GrowConfig

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
LEVELS = LibraryConfig(planes=(3, 2), error_pixels=0.5, workers=1)
SMALL = RunConfig(
    grow=GrowConfig(detail=0.1, leaves=0.05),
    views=ViewsConfig(count=8, size=48, samples=1, denoise=False),
    fit=FitConfig(steps=8, candidates=1, refinement_rounds=0, restarts=1),
)
