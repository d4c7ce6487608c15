"""The pictures of a view under one light at a time, which ``ViewsConfig.suns`` asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from bbfit.blender.config import ViewsConfig
from bbfit.geometry.light import direction, sky

HELD_OUT_SUNS = 4
"""Number of suns under which every held-out camera sees the tree; no training camera does."""
# The held-out suns are turned against the others.
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

    def request(self, *, only_light: bool = False) -> dict[str, Any]:
        """What the worker needs to render them; ``only_light``: the view's own picture in the same light, and no other."""
        paths = [None] * len(self.paths) if only_light else [str(path.resolve()) for path in self.paths]
        suns = [[x, -z, y] for x, y, z in self.suns]
        return {"suns": suns, "ambient": paths[0], "of_suns": paths[1:-2], "albedo": paths[-2], "normal": paths[-1]}

    def _beside(self, kind: str) -> Path:
        return self.picture.with_stem(f"{self.picture.stem}_{kind}")


def lit_pictures(config: ViewsConfig, pictures: Sequence[Path], test: Sequence[int]) -> list[LitPictures]:
    """The lit pictures of each view, or nothing if there are none.

    Training cameras share suns that are spread over the whole sky, ``config.suns`` for each, in random order. Held-out cameras have
    :data:`HELD_OUT_SUNS` others, the same for all.
    """
    if not config.suns:
        return []
    held_out, count = set(test), (len(pictures) - len(test)) * config.suns
    order = np.random.default_rng(config.seed).permutation(count)
    own = [_rounded(direction(config.sun_azimuth, config.sun_elevation))] if config.sun_strength else []
    training = [_rounded(sun) for sun in sky(count)[order]]
    unseen = [_rounded(sun) for sun in sky(HELD_OUT_SUNS, _TURN)]
    result = []
    for index, picture in enumerate(pictures):
        suns = unseen if index in held_out else [training.pop() for _ in range(config.suns)]
        result.append(LitPictures((*own, *suns), picture))
    return result


def _rounded(vector: Tensor) -> tuple[float, float, float]:
    x, y, z = (round(value, 9) for value in vector.tolist())
    return x, y, z
