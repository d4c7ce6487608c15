"""Write the small tree in data/ and its views: python scripts/make_data.py

The tree is a young apple tree that bbfit grows with reduced parameters. SEED determines all random numbers. The views need Blender.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import trimesh

import bbfit

DATA = Path(__file__).resolve().parents[1] / "data"
SEED = 5
VIEWS = bbfit.ViewsConfig(count=24, size=128, samples=64)


def make_tree(seed: int) -> trimesh.Scene:
    """Grow a tree with a tenth of the twigs and leaves of an apple tree, and with larger leaves."""
    figures = replace(
        bbfit.load_species("apple"),
        name="young_apple",
        scale=4.0,
        scale_v=0.5,
        branches=(1, 14, 9, 0),
        base_size=(0.3, 0.02, 0.02, 0.02),
        down_angle_v=(0, -10, 20, 30),
        curve_res=(4, 5, 3, 0),
        leaves=16,
        leaf_scale=0.24,
        leaf_scale_x=0.8,
    )
    return bbfit.grow(figures, seed=seed, detail=0.45)


def main() -> None:
    """Write data/tree.glb and data/views."""
    bbfit.write_tree(make_tree(SEED), DATA / "tree.glb")
    shutil.rmtree(DATA / "views", ignore_errors=True)
    bbfit.render_views(DATA / "tree.glb", DATA / "views", VIEWS)


if __name__ == "__main__":
    main()
