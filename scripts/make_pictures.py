"""Make docs/species.png, one view of every species that bbfit grows: python scripts/make_pictures.py (needs Blender)"""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bbfit
from bbfit.images import over_colour
from bbfit.trees.species import known_species

DOCS = Path(__file__).resolve().parents[1] / "docs"
SEED = 1
SIZE = 480
# Millions of leaves are more than a thumbnail needs.
LEAVES = {"weeping_willow": 0.3, "douglas_fir": 0.5, "silver_birch": 0.7}


def picture(name: str, folder: Path) -> np.ndarray:
    """A tree of the species over white, [H, W, 3], cut to what is not empty."""
    tree = folder / f"{name}.glb"
    bbfit.write_tree(bbfit.grow(name, seed=SEED, leaves=LEAVES.get(name, 1.0)), tree)
    bbfit.render_views(tree, folder / name, bbfit.ViewsConfig(count=2, size=SIZE, samples=64))
    views = bbfit.ViewDataset.load(folder / name)
    return over_colour(views.train.targets([0])[0], 1.0).numpy()


def main() -> None:
    """Draw all of them in two rows."""
    names = known_species()
    figure, axes = plt.subplots(2, len(names) // 2, figsize=(12, 6.9))
    with tempfile.TemporaryDirectory() as folder:
        for axis, name in zip(axes.flat, names, strict=True):
            species = bbfit.load_species(name)
            axis.imshow(picture(name, Path(folder)))
            axis.set_title(f"{name}, {species.scale:g} ± {species.scale_v:g} m", fontsize=11)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(DOCS / "species.png", dpi=100)


if __name__ == "__main__":
    main()
