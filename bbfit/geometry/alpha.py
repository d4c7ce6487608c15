"""The three alpha modes: how a program that draws a model uses alpha."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from bbfit.checks import Range, check_choice, check_range

AlphaKind = Literal["mask", "blend", "hash"]
Cutoff = Annotated[float, Range(0, 1, open_low=True, open_high=True)]
"""Least alpha that shows with mask, in (0, 1)."""


@dataclass(frozen=True)
class AlphaMode:
    """The opacity of a texture sample as a function of its filtered alpha."""

    kind: AlphaKind = "blend"
    """blend: as opaque as alpha says. mask: opaque where alpha is at least the cutoff, and nothing elsewhere (glTF 2.0, section 3.9.4).
    hash: opaque with alpha as the probability, drawn anew for every pixel and texture (Wyman and McGuire 2017, "Hashed Alpha Testing")."""
    cutoff: float = 0.5
    """Least alpha that shows with mask, in (0, 1)."""
    hardness: float = math.inf
    """Slope, with mask, of the ramp from nothing to opaque, whose middle is the cutoff. Finite only while textures are fitted; at least
    the slope at which alpha 0 is nothing and alpha 1 opaque."""
    antialiased: bool = False
    """Whether a mask is drawn with alpha to coverage, which smooths its edges: the opacity rises from nothing to opaque over one pixel
    around the cutoff (:func:`bbfit.operators.drawing.compositing.opacity`). Other modes ignore it."""

    def __post_init__(self) -> None:
        check_choice("alpha", self.kind, get_args(AlphaKind))
        check_range("alpha_cutoff", self.cutoff, 0, 1, open_low=True, open_high=True)
        check_range("hardness", min(self.hardness, 1e30), 0.5 / min(self.cutoff, 1 - self.cutoff), 1e30)
