"""What a fit is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from bbfit.checks import check_choice, check_count, check_range

Preset = Literal["default", "thesis"]
Sides = Literal["one", "two", "pair"]
Bounds = Literal["viewport", "thesis", "silhouette"]
Loss = Literal["l1", "l2"]
Schedule = Literal["cosine", "growth"]

_PRESETS: dict[str, dict[str, Any]] = {
    "default": {
        "bounds": "silhouette",
        "ssim_weight": 0.005,
        "steps": 300,
        "views_per_step": 2,
        "learning_rate": 0.05,
        "schedule": "cosine",
    },
    # Thesis, section 4.4 and 5.
    "thesis": {
        "bounds": "viewport",
        "ssim_weight": 0.0,
        "steps": 10_000,
        "views_per_step": 1,
        "learning_rate": 0.01,
        "schedule": "growth",
    },
}


@dataclass(frozen=True)
class FitConfig:
    """How to fit. A field left at None takes the preset's value."""

    preset: Preset = "default"
    """thesis repeats the thesis's schedule: 10,000 steps of one random view, Adam at 0.01 growing by a tenth, no bounds."""
    billboards: int = 4
    """Number N of upright billboards, at k*180/N degrees through the tree's axis."""
    sides: Sides = "one"
    """one texture for both sides; two, each seen from its own side; or the thesis's pair of rectangles a hair apart."""
    bounds: Bounds | None = None
    """Rectangles that cover the viewport (viewport), the silhouette in the facing view (thesis) or the silhouettes in all
    training views (silhouette). Preset: silhouette; thesis: viewport."""
    texel_density: float = 1.0
    """Texels per pixel where the tree's axis is seen face on."""
    loss: Loss = "l2"
    """Absolute or squared difference of premultiplied RGBA, summed over channels and averaged over pixels."""
    ssim_weight: float | None = None
    """Weight of 1 - SSIM beside the loss. Preset: 0.005; thesis: 0."""
    steps: int | None = None
    """Optimiser steps. Preset: 300; thesis: 10000."""
    views_per_step: int | None = None
    """Training views in every step. Preset: 2; thesis: 1."""
    learning_rate: float | None = None
    """Adam's initial rate. Preset: 0.05; thesis: 0.01."""
    schedule: Schedule | None = None
    """cosine decay to zero, or the thesis's growth by (1 + 0.1 / steps) a step. Preset: cosine; thesis: growth."""
    seed: int = 0
    """Seeds the start textures and the order of views."""
    device: str = "cpu"
    """Torch device to fit on, such as cpu or cuda."""
    checkpoint_every: int = 250
    """Steps between two checkpoints; a killed fit goes on from the last."""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, ("default", "thesis"))
        check_count("billboards", self.billboards)
        check_choice("sides", self.sides, ("one", "two", "pair"))
        check_choice("bounds", self.bounds, (None, "viewport", "thesis", "silhouette"))
        check_range("texel_density", self.texel_density, 0, 16, open_low=True)
        check_choice("loss", self.loss, ("l1", "l2"))
        check_choice("schedule", self.schedule, (None, "cosine", "growth"))
        check_count("seed", self.seed, 0)
        check_count("checkpoint_every", self.checkpoint_every)
        if self.ssim_weight is not None:
            check_range("ssim_weight", self.ssim_weight, 0, 1)
        if self.steps is not None:
            check_count("steps", self.steps)
        if self.views_per_step is not None:
            check_count("views_per_step", self.views_per_step)
        if self.learning_rate is not None:
            check_range("learning_rate", self.learning_rate, 0, 10, open_low=True)

    def resolve(self) -> FitConfig:
        """The same with every ``None`` replaced by the preset's value."""
        preset = _PRESETS[self.preset]
        missing = {f.name: preset[f.name] for f in fields(self) if getattr(self, f.name) is None}
        return replace(self, **missing)
