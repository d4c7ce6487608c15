"""The pictures of a view under one light at a time, for ``ViewsConfig.suns``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from bbfit.blender.config import ViewsConfig
from bbfit.geometry.light import QUARTER_TURN, direction, sky, to_z_up

HELD_OUT_SUNS, HELD_OUT_CAMERAS = 4, 8
"""Number of suns that no training camera sees the tree under, and of held-out cameras that see it under each of them."""
# The held-out suns are turned against the others, by degrees.
_TURN = 100.0


@dataclass(frozen=True)
class LitPictures:
    """Pictures of one view under lights of unit strength, and what its surfaces are.

    Sums of them in linear light are pictures under any sun and sky. A matte white surface in the open is white under the sky alone, and,
    if it faces the sun, under a sun alone.
    """

    suns: tuple[tuple[float, float, float], ...]
    """Unit vectors towards the suns, Y up. The first is the sun of the view's own picture, if that has one."""
    picture: Path
    """The view's own picture; the others lie beside it."""

    @property
    def ambient(self) -> Path:
        """The picture under the sky alone."""
        return self._beside("ambient")

    @property
    def of_suns(self) -> list[Path]:
        """The pictures under each sun alone."""
        return [self._beside(f"sun{number}") for number in range(len(self.suns))]

    @property
    def albedo(self) -> Path:
        """The diffuse color of the surfaces."""
        return self._beside("albedo")

    @property
    def normal(self) -> Path:
        """The normals of the surfaces, which face the camera, as (normal + 1) / 2, with Z up."""
        return self._beside("normal")

    @property
    def paths(self) -> list[Path]:
        """All pictures but the view's own."""
        return [self.ambient, *self.of_suns, self.albedo, self.normal]

    def request(self, *, alone: bool = False) -> dict[str, Any]:
        """What the worker needs to render them; ``alone``: the view's own picture only, with the same noise."""
        if alone:
            return light_request(self.suns)
        ambient, *of_suns, albedo, normal = (str(path.resolve()) for path in self.paths)
        return light_request(self.suns) | {"ambient": ambient, "of_suns": of_suns, "albedo": albedo, "normal": normal}

    def _beside(self, kind: str) -> Path:
        return self.picture.with_stem(f"{self.picture.stem}_{kind}")


def light_request(suns: Sequence[tuple[float, float, float]]) -> dict[str, Any]:
    """The worker's request for a view's own picture, from the sky and the first of some suns."""
    return {"suns": list(map(to_z_up, suns)), "ambient": None, "of_suns": [], "albedo": None, "normal": None}


def own_suns(config: ViewsConfig, turn_degrees: float = 0.0) -> list[tuple[float, float, float]]:
    """The sun of the views' own pictures, turned about the vertical, if there is one."""
    return [_rounded(direction(config.sun_azimuth + turn_degrees, config.sun_elevation))] if config.sun_strength else []


def lit_pictures(config: ViewsConfig, pictures: Sequence[Path], train: Sequence[int], test: Sequence[int]) -> dict[int, LitPictures]:
    """The lit pictures by the indices of their views; nothing if there are none.

    Training cameras share suns that are spread over the whole sky, ``config.suns`` for each, in random order. Some held-out cameras, spread
    evenly, have :data:`HELD_OUT_SUNS` others, the same for all of them. One of these is the sun of the views' own pictures, turned by
    :data:`~bbfit.geometry.light.QUARTER_TURN`: what a tree sees that is turned under a fixed sun.
    """
    if not config.suns:
        return {}
    directions = sky(len(train) * config.suns)[np.random.default_rng(config.seed).permutation(len(train) * config.suns)]
    seen = [_rounded(sun) for sun in directions]
    turned = own_suns(config, QUARTER_TURN)
    unseen = [*turned, *(_rounded(sun) for sun in sky(HELD_OUT_SUNS - len(turned), _TURN))]
    suns = {index: seen[place * config.suns :][: config.suns] for place, index in enumerate(train)}
    suns |= dict.fromkeys(spread(test, HELD_OUT_CAMERAS), unseen)
    return {index: LitPictures((*own_suns(config), *suns[index]), pictures[index]) for index in sorted(suns)}


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spread over them."""
    count = min(count, len(indices))
    return [indices[(2 * number + 1) * len(indices) // (2 * count)] for number in range(count)]


def _rounded(vector: Tensor) -> tuple[float, float, float]:
    x, y, z = (round(value, 9) for value in vector.tolist())
    return x, y, z
