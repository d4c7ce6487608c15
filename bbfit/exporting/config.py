"""What an export may choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from bbfit.checks import check_choice, check_count, check_range

Alpha = Literal["blend", "mask"]
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class ExportConfig:
    """How a billboard cloud is written to a model file."""

    alpha: Alpha = "blend"
    """Blend by alpha (smooth edges, drawn back to front), or mask: draw where alpha reaches the cutoff (needs no sorting)."""
    alpha_cutoff: float = 0.5
    """Least alpha that is drawn with mask, in (0, 1]."""
    padding: int = 8
    """Texels kept free around each texture in the atlas, at least 1; with 8 the mip levels 1 to 3 never mix two textures."""
    up: Up = "auto"
    """Up axis of an OBJ file's coordinates. auto: that of the tree's own file where the views tell it (.ply, .stl and .blend are Z up),
    else y. A GLB is Y up, as glTF demands."""

    def __post_init__(self) -> None:
        check_choice("alpha", self.alpha, get_args(Alpha))
        check_range("alpha_cutoff", self.alpha_cutoff, 0, 1, open_low=True)
        check_count("padding", self.padding, 1)
        check_choice("up", self.up, get_args(Up))
