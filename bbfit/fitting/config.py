"""What a fit is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from bbfit.checks import check_choice, check_count, check_range, fail
from bbfit.geometry.alpha import AlphaKind, check_cutoff
from bbfit.operators.config import Backend, Loss
from bbfit.provenance import EXECUTION

Preset = Literal["default", "thesis"]
Sides = Literal["one", "two", "pair"]
Placement = Literal["even", "clusters"]
Orientation = Literal["any", "upright", "free"]
Bounds = Literal["viewport", "thesis", "silhouette"]
Schedule = Literal["cosine", "growth"]

_PRESETS: dict[str, dict[str, Any]] = {
    "default": {
        "alpha": "mask",
        "billboards": 8,
        "placement": "clusters",
        "placement_learning_rate": 0.015,
        "bounds": "silhouette",
        "loss": "backgrounds",
        "ssim_weight": 0.01,
        "levels": 4,
        "steps": 1200,
        "views_per_step": 2,
        "learning_rate": 0.3,
        "beta1": 0.8,
        "beta2": 0.95,
        "schedule": "cosine",
    },
    # Thesis, section 4.4 and 5.
    "thesis": {
        "alpha": "blend",
        "billboards": 4,
        "placement": "even",
        "placement_learning_rate": 0.0,
        "texel_density": 1.0,
        "bounds": "viewport",
        "loss": "l2",
        "ssim_weight": 0.0,
        "sharpness_weight": 0.0,
        "binarization_weight": 0.0,
        "levels": 1,
        "steps": 10_000,
        "views_per_step": 1,
        "learning_rate": 0.01,
        "beta1": 0.9,
        "beta2": 0.999,
        "schedule": "growth",
    },
}

# What the default preset takes by the alpha mode: what is cut off has no half-transparent texels to smooth it, and drawing by chance is
# the noisier the more there are.
_BY_ALPHA: dict[str, dict[str, Any]] = {
    "mask": {"texel_density": 1.0, "sharpness_weight": 24.0, "binarization_weight": 0.06},
    "blend": {"texel_density": 1.25, "sharpness_weight": 14.0, "binarization_weight": 0.004},
    "hash": {"texel_density": 1.25, "sharpness_weight": 14.0, "binarization_weight": 0.03},
}


@dataclass(frozen=True)
class FitConfig:
    """How to fit. A field left at None takes the preset's value."""

    preset: Preset = "default"
    """default is the best that bbfit knows; thesis is as the thesis did it: 10,000 steps of one random view, no bounds, L2."""
    alpha: AlphaKind | None = None
    """How alpha will be drawn: cut off below the cutoff (mask), blended (blend), or by chance with alpha as the probability (hash).
    Preset: mask; thesis: blend."""
    alpha_cutoff: float = 0.5
    """Least alpha that shows with mask, in (0, 1)."""
    billboards: int | None = None
    """How many billboards there are. Preset: 8; thesis: 4."""
    placement: Placement | None = None
    """Where billboards start: upright at k*180/N degrees through the tree's axis (even), or where the tree is (clusters).
    Clusters are found by a search over clusterings of points on the mesh or, without one, in the visual hull of the views.
    Preset: clusters; thesis: even."""
    orientation: Orientation = "any"
    """How clusters may stand: upright, leaning any way (free), or as does better (any)."""
    restarts: int | None = None
    """Searches for a placement, of which the best one counts. Left out: two from eight billboards on, else one."""
    candidates: int = 12
    """Clusterings that a search compares; more take longer and may find a better one."""
    refinement_rounds: int | None = None
    """Rounds in which the best placement found is revised, by moving, splitting and merging billboards.
    Left out: five for eight billboards, at least one and at most six."""
    placement_learning_rate: float | None = None
    """How fast billboards move while they are fitted, at first: radians a step, and shares of the tree's radius. 0: they stay.
    Preset: 0.015; thesis: 0."""
    sides: Sides = "one"
    """one texture seen from both sides; two, each seen from its own side; or the thesis's pair of rectangles a hair apart."""
    bounds: Bounds | None = None
    """How large evenly placed billboards are: as the viewport, as the tree in the facing view (thesis), or as the tree in all (silhouette).
    Clustered ones are as large as what they carry.
    Preset: silhouette; thesis: viewport."""
    texel_density: float | None = None
    """Texels per pixel of a view, both ways, where the tree's axis is seen face on. Preset: 1 (mask) or 1.25; thesis: 1."""
    loss: Loss | None = None
    """What is made small: absolute (l1) or squared (l2) differences of premultiplied RGBA, or squared ones over random backgrounds.
    They are summed over channels and averaged over pixels; of backgrounds it is the expectation.
    Preset: backgrounds; thesis: l2."""
    max_texels: int | None = None
    """Texels of all billboards at most, for which their density is lowered. Left out: any number."""
    ssim_weight: float | None = None
    """Weight of 1 - SSIM, which keeps structure, beside the loss. Preset: 0.01; thesis: 0."""
    sharpness_weight: float | None = None
    """Weight against blur: of the squared difference in mean contrast of neighboring pixels, at full resolution.
    Preset: 24 (mask) or 14; thesis: 0."""
    binarization_weight: float | None = None
    """Weight for opaque leaves and clear air: of alpha * (1 - alpha), summed over texels, over a view's pixels, at full resolution.
    Preset: 0.06 (mask), 0.004 (blend) or 0.03 (hash); thesis: 0."""
    levels: int | None = None
    """How many resolutions there are, from coarse to fine, sides doubling from each to the next; steps are shared out evenly.
    Preset: 4; thesis: 1."""
    steps: int | None = None
    """Steps of the optimizer. Preset: 1200; thesis: 10000."""
    views_per_step: int | None = None
    """Views that a step looks at, at full resolution; twice as many at each coarser one. Preset: 2; thesis: 1."""
    learning_rate: float | None = None
    """Step size of the optimizer, Adam, at first. Preset: 0.3; thesis: 0.01."""
    beta1: float | None = None
    """What is left of Adam's first moment, the mean gradient, after a step. Preset: 0.8; thesis: 0.9."""
    beta2: float | None = None
    """What is left of Adam's second moment, the mean squared gradient, after a step. Preset: 0.95; thesis: 0.999."""
    schedule: Schedule | None = None
    """How the step size changes: to zero along a cosine, or by (1 + 0.1 / steps) a step (growth). Preset: cosine; thesis: growth."""
    seed: int = 0
    """Another seed gives another search, other start textures and another order of views."""
    backend: Backend = "auto"
    """What draws while fitting: the kernels (fused, auto), or the reference, which is many times slower."""
    device: str = field(default="cpu", metadata=EXECUTION)
    """Torch device to fit on, such as cpu or cuda."""
    checkpoint_every: int = field(default=250, metadata=EXECUTION)
    """Steps between two checkpoints; a fit that was stopped goes on from the last."""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, ("default", "thesis"))
        check_choice("alpha", self.alpha, (None, *get_args(AlphaKind)))
        check_cutoff("alpha_cutoff", self.alpha_cutoff)
        if self.billboards is not None:
            check_count("billboards", self.billboards)
        check_choice("placement", self.placement, (None, "even", "clusters"))
        check_choice("orientation", self.orientation, ("any", "upright", "free"))
        if self.restarts is not None:
            check_count("restarts", self.restarts)
        check_count("candidates", self.candidates)
        if self.refinement_rounds is not None:
            check_count("refinement_rounds", self.refinement_rounds, 0)
        if self.placement_learning_rate is not None:
            check_range("placement_learning_rate", self.placement_learning_rate, 0, 1)
        check_choice("sides", self.sides, ("one", "two", "pair"))
        check_choice("bounds", self.bounds, (None, "viewport", "thesis", "silhouette"))
        if self.texel_density is not None:
            check_range("texel_density", self.texel_density, 0, 16, open_low=True)
        if self.max_texels is not None:
            check_count("max_texels", self.max_texels)
        check_choice("loss", self.loss, (None, "l1", "l2", "backgrounds"))
        check_choice("schedule", self.schedule, (None, "cosine", "growth"))
        check_count("seed", self.seed, 0)
        check_count("checkpoint_every", self.checkpoint_every)
        if self.ssim_weight is not None:
            check_range("ssim_weight", self.ssim_weight, 0, 1)
        if self.sharpness_weight is not None:
            check_range("sharpness_weight", self.sharpness_weight, 0, 1000)
        if self.binarization_weight is not None:
            check_range("binarization_weight", self.binarization_weight, 0, 10)
        check_choice("backend", self.backend, ("auto", "reference", "fused"))
        if self.levels is not None:
            check_count("levels", self.levels)
        if self.steps is not None:
            check_count("steps", self.steps)
        if self.views_per_step is not None:
            check_count("views_per_step", self.views_per_step)
        if self.learning_rate is not None:
            check_range("learning_rate", self.learning_rate, 0, 10, open_low=True)
        for name in ("beta1", "beta2"):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), 0, 0.9999)

    def coarse(self) -> FitConfig:
        """The same for less than full resolution: without the weights that count only there."""
        return replace(self, sharpness_weight=0.0, binarization_weight=0.0)

    def resolve(self) -> FitConfig:
        """The same with every ``None`` replaced by the preset's value.

        Raises
        ------
        InputError
            if the values do not go together.
        """
        preset = _PRESETS[self.preset]
        preset = _BY_ALPHA[self.alpha or preset["alpha"]] | preset
        missing = {name: value for name, value in preset.items() if getattr(self, name) is None}
        resolved = replace(self, **missing)
        textures = (resolved.billboards or 0) * (1 if resolved.sides == "one" else 2)
        if resolved.max_texels is not None and resolved.max_texels < textures:
            fail("max_texels", f"{resolved.max_texels} are too few for {textures} textures", "allow more")
        if resolved.restarts is None:
            assert resolved.billboards is not None
            resolved = replace(resolved, restarts=min(2, max(1, resolved.billboards // 4)))
        if resolved.refinement_rounds is None:
            assert resolved.billboards is not None
            resolved = replace(resolved, refinement_rounds=min(6, max(1, resolved.billboards - 3)))
        if resolved.sides == "pair" and resolved.placement == "clusters":
            fail("sides", "pairs stand evenly around an axis, not in clusters", "add --placement even, or choose one or two")
        return resolved
