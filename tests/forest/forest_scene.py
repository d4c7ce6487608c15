"""A small library of squares in one color each, and forests of them in memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.model import shipped_model
from bbfit.forest.placements import Placements
from bbfit.forest.tiles import ForestTile
from bbfit.geometry.alpha import AlphaKind
from bbfit.geometry.cloud import even_upright
from bbfit.glb import joined_glb, split_glb
from bbfit.library.manifest import LIBRARY_FILE, Library, LibraryTree, Screen, read_library

LOW, HIGH = (-1.0, 0.0, -1.0), (1.0, 2.0, 1.0)
ATLAS = "atlas.png"


def square_glb(color: Sequence[float], side: float = 2.0, *, aside: float = 0.0, holes: int = 0, alpha: AlphaKind = "mask") -> bytes:
    """Two upright squares that cross, one meter above the ground and ``aside`` meters east of the trunk, of integers.

    They have one color. With ``holes``, the seed of random numbers, some texels are cut out, and the others are darker or brighter.
    """
    axis, half = torch.tensor([aside, 1.0, 0.0]), torch.tensor([side / 2, side / 2])
    cloud = even_upright(2, axis=axis, half_extents=half, texture_sizes=torch.tensor([16, 16]))
    texels = torch.tensor([*color, 1.0]).expand_as(cloud.texels).clone()
    if holes:
        random = np.random.default_rng(holes)
        texels[torch.from_numpy(random.random(len(texels)) < 0.3), 3] = 0
        texels[:, :3] *= torch.from_numpy(random.uniform(0.6, 1, (len(texels), 1))).float()
    return shipped_model(cloud.with_texels(texels), ExportConfig(alpha=alpha, outline="rectangle", quantized=True)).glb


def write_library(folder: Path, trees: dict[str, Sequence[bytes]], distances: Sequence[float], *, shared: bool = False) -> Library:
    """A library of trees by their levels, finest first, and the distances from which these are shown.

    With ``shared``, all models show the picture of the first one, as a file beside them.
    """
    folder.mkdir()
    described, picture = [], None
    for name, models in trees.items():
        levels = []
        for number, (glb, distance) in enumerate(zip(models, distances, strict=False)):
            file = f"{name}_LOD{number}.glb"
            if shared:
                content, views = split_glb(glb)
                picture = picture or views[content["images"][0]["bufferView"]]
                content["images"] = [{"uri": ATLAS}]
                glb = joined_glb(content, views)
            (folder / file).write_bytes(glb)
            levels.append(
                LodLevel(f"{name}_LOD{number}", 2, 8, 4, len(glb), 0.0, 0.0, 0.0, None, None, distance, 0.5, file, distance, 0.0, 0.0, 0.0)
            )
        described.append(LibraryTree(name, name, None, LOW, HIGH, tuple(levels)))
    if picture is not None:
        (folder / ATLAS).write_bytes(picture)
    library = Library(folder, Screen(400, 55.0), (ATLAS,) if shared else (), tuple(described))
    (folder / LIBRARY_FILE).write_text(json.dumps(library.document()))
    return read_library(folder)


def placed(positions: ArrayLike, *, turns: float = 0.0, scales: float = 1.0, trees: int | Sequence[int] = 0) -> Placements:
    """Placements at some positions, [P, 3]."""
    places = np.asarray(positions, np.float64)
    count = len(places)
    return Placements(
        places,
        np.broadcast_to(np.float32(turns), count).copy(),
        np.broadcast_to(np.float32(scales), count).copy(),
        np.broadcast_to(np.int32(trees), count).copy(),
    )


def tiled(parts: Sequence[Placements]) -> tuple[ForestTile, dict[str, Placements]]:
    """A quadtree whose root has a leaf for each of at most four parts, and the placements of leaves by name."""
    leaves, stored = [], {}
    for number, part in enumerate(parts):
        name = f"1/{number % 2}/{number // 2}"
        low, high = part.positions.min(0) + LOW, part.positions.max(0) + HIGH
        leaves.append(ForestTile(name, tuple(low.tolist()), tuple(high.tolist()), len(part), ()))
        stored[name] = part
    low = tuple(np.min([leaf.low for leaf in leaves], 0).tolist())
    high = tuple(np.max([leaf.high for leaf in leaves], 0).tolist())
    root = ForestTile("0/0/0", low, high, sum(leaf.count for leaf in leaves), tuple(leaves))
    return (root, stored) if len(leaves) > 1 else (replace(leaves[0], name="0/0/0"), {"0/0/0": parts[0]})
