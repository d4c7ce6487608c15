"""What a GLB file says about itself: the names of its parts, and facts about the tree, the light and the score."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cards import Cards
from bbfit.glb import joined_glb, split_glb

NAMESPACE = "bbfit"
"""The key of bbfit's facts in ``asset.extras`` and in the extras of nodes."""
# What glb_bytes calls nodes, meshes and materials, or how it begins their names.
_GENERIC = "billboards"
_DIGITS = 5


@dataclass(frozen=True)
class Description:
    """Facts about a model that its polygons and textures do not show. What is ``None`` is not known and is left out."""

    name: str
    """The tree's name, which nodes, meshes, materials and pictures get."""
    billboards: int
    """Number of billboards."""
    alpha: AlphaMode
    """The alpha mode for which the file was made."""
    light: str
    """``"baked"``: the colors contain the light. ``"maps"``: the program lights the model, and the sun below is that of its views."""
    sun_direction: tuple[float, ...] | None = None
    """Unit vector towards the sun of the views, Y up."""
    sun_strength: float | None = None
    """Strength of that sun in watts per square meter."""
    ambient: float | None = None
    """Strength of the sky: the linear color of a matte white surface in the open without the sun."""
    tree_bounds: tuple[tuple[float, ...], ...] | None = None
    """Lowest and highest corner of the original tree's bounding box in meters, Y up."""
    score: dict[str, float] | None = None
    """``psnr`` in dB, ``flip`` and ``views``, the number of held-out views of which they are means, over four backgrounds."""
    distances: dict[str, float | None] | None = None
    """``near_meters`` and ``far_meters``, between which the model looks like the tree, and the screen for which they hold:
    ``screen_height`` in pixels and ``screen_fov_degrees``."""


def described_glb(glb: bytes, description: Description, cards: Cards) -> bytes:
    """The file of ``cards`` (:func:`~bbfit.exporting.gltf.glb_bytes`) with names and facts; its geometry and pictures stay as they are.

    The facts are in ``asset.extras.bbfit`` (glTF 2.0, section 3.2). Programs that ignore the asset's extras may keep those of nodes:
    each node in the scene has the tree's bounds and the distances there. ``bounds`` are those of the cards.
    """
    tree, contents = split_glb(glb)
    for kind in ("nodes", "meshes", "materials"):
        for item in tree[kind]:
            item["name"] = description.name + item["name"].removeprefix(_GENERIC)
    for item in (*tree["images"], *tree["textures"]):
        item["name"] = f"{description.name}_{item['name']}"
    tree["scenes"][tree["scene"]]["name"] = description.name
    alpha: dict[str, Any] = {"mode": description.alpha.kind}
    alpha |= {"cutoff": description.alpha.cutoff} if description.alpha.tested else {}
    light = {"sun_direction": description.sun_direction, "sun_strength": description.sun_strength, "ambient": description.ambient}
    corners = np.concatenate([card.corners for card in cards.cards])
    bounds = [corners.min(0).tolist(), corners.max(0).tolist()]
    places = {"bounds": bounds, "tree_bounds": description.tree_bounds, "distances": description.distances}
    facts = {
        "tree": description.name,
        "billboards": description.billboards,
        "alpha": alpha,
        "light": _known({"kind": description.light, **light}),
        "score": description.score,
        **places,
    }
    tree["asset"]["extras"] = {NAMESPACE: _rounded(_known(facts))}
    for node in tree["scenes"][tree["scene"]]["nodes"]:
        tree["nodes"][node]["extras"] = {NAMESPACE: _rounded(_known({name: places[name] for name in ("tree_bounds", "distances")}))}
    return joined_glb(tree, contents)


def _known(facts: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in facts.items() if value is not None}


def _rounded(value: Any) -> Any:
    """JSON with numbers of five significant digits."""
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(inner) for inner in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
