"""Formulas of Weber and Penn 1995 for lengths, radii and the pruning envelope; section numbers are the paper's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bbfit.trees.skeleton import Array
from bbfit.trees.species import Species

TAPERED_CYLINDRICAL = 4
PRUNING_ENVELOPE = 8
_SHAPES: tuple[Callable[[Array], Array], ...] = (
    lambda ratio: 0.2 + 0.8 * ratio,  # conical
    lambda ratio: 0.2 + 0.8 * np.sin(np.pi * ratio),  # spherical
    lambda ratio: 0.2 + 0.8 * np.sin(0.5 * np.pi * ratio),  # hemispherical
    lambda ratio: np.ones_like(ratio),  # cylindrical
    lambda ratio: 0.5 + 0.5 * ratio,  # tapered cylindrical
    lambda ratio: np.where(ratio <= 0.7, ratio / 0.7, (1 - ratio) / 0.3),  # flame
    lambda ratio: 1 - 0.8 * ratio,  # inverse conical
    lambda ratio: np.where(ratio <= 0.7, 0.5 + 0.5 * ratio / 0.7, 0.5 + 0.5 * (1 - ratio) / 0.3),  # tend flame
)


def shape_ratio(shape: int, ratio: Array, species: Species) -> Array:
    """Length of branches against their height in the crown (section 4.3's table); ``ratio`` is 0 at the top and 1 at the crown's base."""
    if shape != PRUNING_ENVELOPE:
        return _SHAPES[shape](ratio)
    below_peak = 1 - species.prune_width_peak
    inside = np.clip(ratio, 0, 1)
    upper = (inside / below_peak) ** species.prune_power_high
    lower = ((1 - inside) / species.prune_width_peak) ** species.prune_power_low
    return np.where((ratio < 0) | (ratio > 1), 0.0, np.where(inside < below_peak, upper, lower))


def stem_radius(species: Species, level: int, radius: Array, length: Array, shares: Array) -> Array:
    """Radius along stems without flare and lobes, by nTaper (section 4.4): cylinder at 0, cone at 1, rounded end at 2, beads up to 3."""
    taper = species.taper[level]
    straight = taper if taper < 1 else 2 - taper if taper < 2 else 0.0
    cone = radius * (1 - straight * shares)
    if taper < 1:
        return cone
    to_tip = (1 - shares) * length
    depth = np.where((taper < 2) | (to_tip < cone), 1.0, taper - 2)
    bead = to_tip if taper < 2 else np.abs(to_tip - 2 * cone * np.floor(to_tip / (2 * cone) + 0.5))
    ball = np.sqrt(np.maximum(cone**2 - (bead - cone) ** 2, 0))
    if taper < 2:
        return np.where(bead >= cone, cone, ball)
    return (1 - depth) * cone + depth * ball


def in_envelope(species: Species, scale: float, points: Array) -> NDArray[np.bool_]:
    """Whether points [..., 3] lie in the pruning envelope of a tree of this scale (section 4.6)."""
    height = (scale - points[..., 2]) / (scale * (1 - species.base_size[0]))
    return np.hypot(points[..., 0], points[..., 1]) / scale < species.prune_width * shape_ratio(PRUNING_ENVELOPE, height, species)
