"""The four alpha modes: how a program that draws a model uses alpha."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from bbfit.checks import Range, check_choice, check_count, check_range, fail

AlphaKind = Literal["mask", "blend", "hash", "coverage"]
Cutoff = Annotated[float, Range(0, 1, open_low=True, open_high=True)]
"""Least alpha that shows with mask, in (0, 1)."""
VISIBLE = 0.5 / 255
"""Least alpha of a texel that is visible: a smaller one becomes 0 in 8 bits."""
SAMPLES = 4
"""Samples of a pixel in most programs with multisampling, WebGL among them."""


@dataclass(frozen=True)
class AlphaMode:
    """The opacity of a texture sample as a function of its filtered alpha."""

    kind: AlphaKind = "blend"
    """blend: as opaque as alpha says. mask: opaque where alpha is at least the cutoff, and nothing elsewhere (glTF 2.0, section 3.9.4).
    hash: opaque with alpha as the probability, drawn anew for every pixel and texture (Wyman and McGuire 2017, "Hashed Alpha Testing").
    coverage: alpha is the share of a pixel's samples that the texture covers (alpha to coverage; OpenGL 4.6, section 17.3.1)."""
    cutoff: float = 0.5
    """Least alpha that shows with mask, in (0, 1); with coverage, what files give programs that have masks alone."""
    hardness: float = math.inf
    """Slope, with mask, of the ramp from nothing to opaque, whose middle is the cutoff. Finite only while textures are fitted; at least
    the slope at which alpha 0 is nothing and alpha 1 opaque."""
    antialiased: bool = False
    """Whether a mask is drawn with alpha to coverage, which smooths its edges: the opacity rises from nothing to opaque over one pixel
    around the cutoff (:func:`bbfit.operators.drawing.compositing.opacity`). Other modes are never antialiased."""
    samples: int = SAMPLES
    """Samples of a pixel, of which coverage covers a whole number; 0: so many that this does not show."""

    def __post_init__(self) -> None:
        check_choice("alpha", self.kind, get_args(AlphaKind))
        if self.antialiased and self.kind != "mask":
            fail("antialiased", f"alpha to coverage smooths masks, not {self.kind}", "choose mask")
        check_count("samples", self.samples, 0)
        check_range("alpha_cutoff", self.cutoff, 0, 1, open_low=True, open_high=True)
        check_range("hardness", min(self.hardness, 1e30), 0.5 / min(self.cutoff, 1 - self.cutoff), 1e30)

    @property
    def tested(self) -> bool:
        """Whether alpha is tested: a program draws some of a pixel's samples, or all or nothing, and need not sort."""
        return self.kind in ("mask", "coverage")

    @property
    def nested(self) -> bool:
        """Whether all layers cover the same samples of a pixel first (:func:`bbfit.operators.drawing.compositing.layer_weights`)."""
        return self.antialiased or self.kind == "coverage"

    @property
    def multisampled(self) -> bool:
        """Whether a pixel has several samples, so that edges of cards are smooth. Hard masks and hash are drawn with one."""
        return self.kind == "blend" or self.nested
