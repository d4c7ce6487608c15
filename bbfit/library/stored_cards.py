"""Files with the cards of a level: polygons, textures and mip levels, before they share an atlas with others."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.files import write_tensors
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cards import Atlas, Card, Cards
from bbfit.inputs import reading

_ENTRY = "bbfit.cards"


def write_cards(path: Path, cards: Cards, last_level: int) -> None:
    """Write cards to a ``.safetensors`` file atomically, with their mip levels up to ``last_level``; without their light."""
    atlas, first = cards.atlas, cards.cards[0]
    arrays: dict[str, NDArray] = {"image": atlas.image, "corners": atlas.corners, "sizes": atlas.sizes}
    if atlas.surface is not None:
        arrays["surface"] = atlas.surface
    if cards.averaged is not None:
        arrays["averaged"] = cards.averaged
    for name, chain in (("level", cards.chain), ("surface", cards.surface_chain)):
        if chain is not None:  # level 0 is the picture itself
            arrays |= {f"{name}.{number}": level for number, level in enumerate(chain[: last_level + 1]) if number > 0}
    arrays["counts"] = np.array([len(card.corners) for card in cards.cards])
    arrays["points"], arrays["uvs"] = (np.concatenate([getattr(card, name) for card in cards.cards]) for name in ("corners", "uvs"))
    for name in ("normal", "culled", "rectangle", "ranks", "tangent", "origin"):
        if getattr(first, name) is not None:
            arrays[name] = np.array([getattr(card, name) for card in cards.cards])
    tensors = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
    alpha = {name: value for name, value in asdict(cards.alpha).items() if name != "hardness"}  # which may be infinite
    # One entry: the order of several would be random, and so would be the bytes of the file.
    write_tensors(path, tensors, {_ENTRY: json.dumps({"alpha": alpha, "traced": cards.traced})})


def read_cards(path: Path) -> Cards:
    """Read what :func:`write_cards` wrote. Raises ``InputError`` if the file is damaged."""
    from safetensors import safe_open

    with reading("library", path, "remove it, and build the library again"), safe_open(path, "np") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}
        facts = json.loads(file.metadata()[_ENTRY])
        ends = np.cumsum(arrays["counts"])[:-1]
        points, uvs = np.split(arrays["points"], ends), np.split(arrays["uvs"], ends)
        made = [
            Card(
                points[number],
                uvs[number],
                arrays["normal"][number],
                bool(arrays["culled"][number]),
                int(arrays["rectangle"][number]),
                arrays["tangent"][number] if "tangent" in arrays else None,
                arrays["origin"][number] if "origin" in arrays else None,
                (int(arrays["ranks"][number][0]), int(arrays["ranks"][number][1])),
            )
            for number in range(len(points))
        ]
        atlas = Atlas(arrays["image"], arrays["corners"], arrays["sizes"], arrays.get("surface"))
        chain, surface = _levels(arrays, "level", atlas.image), _levels(arrays, "surface", atlas.surface)
        alpha, averaged = AlphaMode(**facts["alpha"]), arrays.get("averaged")
        return Cards(tuple(made), atlas, alpha, chain, surface, averaged, traced=facts["traced"])


def _levels(arrays: dict[str, NDArray], name: str, first: NDArray[np.uint8] | None) -> tuple[NDArray[np.uint8], ...] | None:
    """The mip levels of a picture, ``first`` at level 0. ``None`` if there are no further ones."""
    count = sum(key.startswith(f"{name}.") for key in arrays)
    return None if first is None or count == 0 else (first, *(arrays[f"{name}.{number}"] for number in range(1, count + 1)))
