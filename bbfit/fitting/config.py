"""The options of a fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, TypeVar

from bbfit.checks import Count, Range, Seed, check_fields, fail
from bbfit.geometry.alpha import AlphaKind, AlphaMode, Cutoff
from bbfit.operators.config import Backend, Loss
from bbfit.provenance import EXECUTION

Preset = Literal["default", "thesis"]
Sides = Literal["one", "two", "pair"]
Placement = Literal["even", "clusters"]
Orientation = Literal["any", "upright", "free"]
Bounds = Literal["viewport", "thesis", "silhouette"]
Schedule = Literal["cosine", "growth"]
Colors = Literal["views", "matched", "joint"]
Lighting = Literal["baked", "maps"]
Trunk = Literal["mesh", "crossed"]
_OfAlpha = Annotated[float, Range(0, 10)]
_Density = Annotated[float, Range(0, 16, open_low=True)]
_Rate = Annotated[float, Range(0, 10, open_low=True)]
_Palette = Annotated[int, Range(0, 256)]
_Number = Annotated[int, Range(0)]
_Sharpness = Annotated[float, Range(0, 1000)]
_Unit = Annotated[float, Range(0, 1)]
_Layers = Annotated[float, Range(0, 1000, open_low=True)]
_Decay = Annotated[float, Range(0, 0.9999)]
_Config = TypeVar("_Config", bound="FitConfig")

EVEN = 8
"""Number of evenly placed billboards of the default preset."""
# From so many billboards on, searches are short: different clusterings lead to nearly equal results. From _VERY_MANY on, one has to do:
# with 192 billboards, an acer gained 0.03 dB from four candidates in place of one, in five times the time of the search.
_MANY, _VERY_MANY = 12, 32
TRUNK_PLANES = 3
"""Number of planes that cross in each part of a trunk. One of three shows at least cos(30 degrees) = 87 % of its width."""
# When there are many billboards, a trunk has one part for so many of them, up to so many parts.
_PER_PART, _MOST_PARTS = 16, 3
_LOCALITY = 0.5
TRANSPARENT_COLORS = 32
"""Colors of a palette that are left to transparent texels, which filtering shows beside visible ones."""

_PRESETS: dict[str, dict[str, Any]] = {
    "default": {
        "alpha": "mask",
        "placement": "clusters",
        "placement_learning_rate": 0.015,
        "texel_density": 0.8,
        "bounds": "silhouette",
        "loss": "backgrounds",
        "ssim_weight": 0.01,
        "palette": 256,
        "levels": 4,
        "steps": 800,
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
        "alpha_cutoff": 0.5,
        "least_alpha": 0.0,
        "texel_density": 1.0,
        "bounds": "viewport",
        "loss": "l2",
        "colors": "joint",
        "antialiased": False,
        "palette": 0,
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

# Values of the default preset that depend on the alpha mode. A cutoff leaves no half-transparent texels that could smooth an edge, and
# stochastic alpha is the noisier the more of them there are.
_BY_ALPHA: dict[str, dict[str, Any]] = {
    "mask": {
        "most_layers": 2.6,
        "margin": 0.02,
        "alpha_cutoff": 0.2,
        "least_alpha": 0.0,
        "colors": "views",
        "antialiased": True,
        "sharpness_weight": 4.0,
        "binarization_weight": 0.02,
    },
    "blend": {
        "most_layers": 3.2,
        "margin": 0.05,
        "alpha_cutoff": 0.5,
        "least_alpha": 0.08,
        "colors": "matched",
        "antialiased": False,
        "sharpness_weight": 0.2,
        "binarization_weight": 0.0,
    },
    "hash": {
        "most_layers": 3.2,
        "margin": 0.05,
        "alpha_cutoff": 0.5,
        "least_alpha": 0.08,
        "colors": "views",
        "antialiased": False,
        "sharpness_weight": 1.0,
        "binarization_weight": 0.03,
    },
    "coverage": {
        "most_layers": 2.6,
        "margin": 0.03,
        "alpha_cutoff": 0.4,
        "least_alpha": 0.12,
        "colors": "views",
        "antialiased": False,
        "sharpness_weight": 0.2,
        "binarization_weight": 0.0,
    },
}


@dataclass(frozen=True)
class FitConfig:
    """How to fit. A field that is None takes the value of the preset; see :meth:`resolve`."""

    preset: Preset = "default"
    """default is the best that bbfit can do; thesis follows the thesis: 10,000 steps of one random view, no bounds, L2."""
    alpha: AlphaKind | None = None
    """Alpha mode to fit for: mask cuts off below the cutoff; blend blends; hash draws at random with alpha as the probability;
    coverage covers a share of a pixel's samples. Preset: mask; thesis: blend."""
    alpha_cutoff: Cutoff | None = None
    """Least alpha that shows with mask, in (0, 1). The lower, the more leaves remain where mip levels average alpha.
    With coverage it is the cutoff for programs that have masks alone. Preset: 0.2 (mask), 0.4 (coverage) or 0.5; thesis: 0.5."""
    least_alpha: _Unit | None = None
    """Least alpha that remains. Fainter texels become transparent in the end: nobody sees them, but a graphics card would shade them.
    Preset: 0.08 (blend, hash), 0.12 (coverage) or 0 (mask); thesis: 0."""
    billboards: Count | None = None
    """Number of billboards. Preset: as many as pay for this tree, within least_billboards and most_billboards; thesis: 4."""
    least_billboards: Count = 16
    """Least number of billboards that the preset chooses by itself."""
    most_billboards: Count = 384
    """Largest number of billboards that the preset, or a budget, chooses by itself."""
    most_layers: _Layers | None = None
    """How many billboards may lie before each other, on average over the rectangle around the tree, when the fit chooses their number.
    More layers look better, and a graphics card shades all of them. Preset: 2.6 (mask, coverage) or 3.2 (blend, hash)."""
    light: Lighting = "baked"
    """baked: colors contain the light of the views. maps: base color, normals and occlusion, which take the light of a program.
    Maps need views under many lights (suns)."""
    translucency: bool = False
    """Also fit how much light passes through texels (with light maps), as through leaves. Only Babylon.js shows it (profile babylon);
    elsewhere such a model is too bright in front of the sun and too dark behind it."""
    map_steps: Annotated[int, Range(0)] = 100
    """Steps of the optimizer for maps, after those for placement and alpha. With 0, maps are what the views show of the tree's surfaces."""
    placement: Placement | None = None
    """Where billboards start: upright at k*180/N degrees through the tree's axis (even), or where the tree is (clusters).
    A search compares clusterings of points on the mesh or, without a mesh, in the visual hull of the views.
    Preset: clusters; thesis: even."""
    orientation: Orientation = "any"
    """Orientation of clustered billboards: upright, in any direction (free), or whichever of the two fits better (any).
    A single candidate, as for 32 billboards or more, is free with any."""
    locality: _Unit | None = None
    """Compactness of what clustered billboards stand for: the weight of distances within a part of the tree against those from its plane.
    With 0, billboards are slices through the whole tree; the larger it is, the smaller they are, and the less there is to draw.
    Default: 0.5 for twelve billboards or more, else 0."""
    margin: _Unit | None = None
    """Margin around what a compact billboard stands for, as a fraction of the tree's radius.
    The wider it is, the more billboards share leaves, which looks better, and the more pixels a graphics card shades.
    Preset: 0.02 (mask), 0.03 (coverage) or 0.05."""
    trunk: Trunk = "crossed"
    """What shows the trunk, among clustered billboards.
    crossed: planes that cross in the trunk below the crown, three in each of its parts.
    mesh: facets on the bark of the trunk and of thick branches, up into the crown. They need the tree's mesh; without it, planes cross.
    Facets look more solid from near by, and shade more pixels."""
    trunk_billboards: _Number | None = None
    """Number of billboards, out of all, that show the trunk.
    Default with crossed: 9 for 48 billboards or more, 6 for 32, 3 for 12, else none.
    Default with mesh: the share of bark in what the views show of the tree; planes cross if that makes fewer than three."""
    restarts: Count | None = None
    """Independent searches for a placement; the best result is kept. Default: two for eight to eleven billboards, else one."""
    candidates: Count | None = None
    """Clusterings that a search compares; more take longer and may find a better placement.
    Default: 12; 4 for twelve billboards or more, and 1 for 32 or more, of which any clustering is about as good as any other."""
    refinement_rounds: _Number | None = None
    """Rounds that refine the best placement by moving, splitting and merging billboards.
    Default: three fewer than there are billboards, at least one and at most six; none for twelve billboards or more."""
    placement_learning_rate: _Unit | None = None
    """Initial step size of the billboards' placement: radians a step, and fractions of the tree's radius. With 0 they do not move.
    Preset: 0.015; thesis: 0."""
    sides: Sides = "one"
    """one: one texture, seen from both sides. two: a texture for each side. pair: two rectangles a hair apart, as in the thesis."""
    bounds: Bounds | None = None
    """Size of evenly placed billboards: the viewport, the tree in the view that faces them (thesis), or the tree in all views (silhouette).
    Clustered billboards are as large as their clusters.
    Preset: silhouette; thesis: viewport."""
    texel_density: _Density | None = None
    """Texels per pixel of a view along each side, for a billboard that faces the camera at the tree's axis.
    Preset: 0.8; thesis: 1."""
    loss: Loss | None = None
    """Loss to minimize: absolute (l1) or squared (l2) differences of premultiplied RGBA, or squared ones over random backgrounds.
    It is summed over channels and averaged over pixels; for backgrounds it is the expectation.
    Preset: backgrounds; thesis: l2."""
    colors: Colors | None = None
    """What colors are fitted to: the color of the views, whatever alpha is (views), or the loss, together with alpha (joint, matched).
    With views and matched, one factor per channel makes the mean color that of the views in the end.
    Preset: views (mask, coverage, hash) or matched (blend); thesis: joint."""
    antialiased: bool | None = None
    """Fit a mask for programs that smooth its edges by alpha to coverage. Preset: yes; thesis: no. Other alpha modes ignore it."""
    max_texels: Count | None = None
    """Most texels of all billboards together; their density is lowered to stay within it. Default: no limit."""
    palette: _Palette | None = None
    """Number of different colors of all texels, alpha included: 34 to 256, or 0 for any number.
    The PNG then stores one byte a texel instead of four, and leaves hide the difference. Preset: 256; thesis: 0."""
    ssim_weight: _Unit | None = None
    """Weight of 1 - SSIM, which preserves structure, beside the loss. Preset: 0.01; thesis: 0."""
    sharpness_weight: _Sharpness | None = None
    """Weight of the sharpness loss: the squared difference in mean contrast between neighboring pixels, at full resolution.
    Preset: 4 (mask), 0.2 (blend, coverage) or 1 (hash); thesis: 0."""
    binarization_weight: _OfAlpha | None = None
    """Weight that pushes alpha to 0 or 1: of alpha * (1 - alpha), summed over texels, over a view's pixels, at full resolution.
    Preset: 0.02 (mask), 0.03 (hash) or 0 (blend, coverage); thesis: 0."""
    sparsity_weight: _OfAlpha = 0.0
    """Weight of alpha, summed over texels, over a view's pixels, at full resolution. It clears texels that views hardly need.
    Masks of dense trees with alpha to coverage look better with 0.005; trees of needles lose by it."""
    levels: Count | None = None
    """Number of resolutions, from coarse to fine; each doubles the sides of the one before. Steps are divided evenly among them.
    Preset: 4; thesis: 1."""
    steps: Count | None = None
    """Steps of the optimizer. Preset: 800; thesis: 10000."""
    views_per_step: Count | None = None
    """Views in each step at full resolution; each coarser resolution doubles their number. Preset: 2; thesis: 1."""
    learning_rate: _Rate | None = None
    """Initial step size of the optimizer, Adam. Preset: 0.3; thesis: 0.01."""
    beta1: _Decay | None = None
    """Decay rate of Adam's first moment, the mean gradient. Preset: 0.8; thesis: 0.9."""
    beta2: _Decay | None = None
    """Decay rate of Adam's second moment, the mean squared gradient. Preset: 0.95; thesis: 0.999."""
    schedule: Schedule | None = None
    """Schedule of the step size: to zero along a cosine, or by (1 + 0.1 / steps) a step (growth). Preset: cosine; thesis: growth."""
    seed: Seed = 0
    """Seed of the search, of the initial textures and of the order of views."""
    backend: Backend = "auto"
    """Renderer of the fit: the kernels (fused, auto), or the reference, which is many times slower."""
    device: str = field(default="cpu", metadata=EXECUTION)
    """Torch device to fit on, such as cpu or cuda."""
    checkpoint_every: Count = field(default=250, metadata=EXECUTION)
    """Steps between two checkpoints; an interrupted fit resumes from the last one."""

    def __post_init__(self) -> None:
        check_fields(self)

    def coarse(self: _Config) -> _Config:
        """The same for less than full resolution: without the weights that count only there."""
        return replace(self, sharpness_weight=0.0, binarization_weight=0.0, sparsity_weight=0.0)

    def resolve(self) -> ResolvedFit:
        """Replace every ``None`` by the value of the preset; a :class:`ResolvedFit` returns itself.

        Raises
        ------
        InputError
            if the values contradict each other.
        """
        if isinstance(self, ResolvedFit):
            return self
        if self.translucency and self.light != "maps":
            fail("translucency", "it is one of the maps", "add --light maps")
        if self.least_billboards > self.most_billboards:
            problem = f"{self.least_billboards} are more than most_billboards allows, {self.most_billboards}"
            fail("least_billboards", problem, "lower it too")
        preset, given = _PRESETS[self.preset], {name: value for name, value in vars(self).items() if value is not None}
        alpha = given.get("alpha", preset["alpha"])
        values = _BY_ALPHA[alpha] | preset | given
        if values["placement"] == "even":
            values = {"billboards": EVEN} | values
        return ResolvedFit(**_effort(values.get("billboards"), self.trunk) | values)


def _effort(count: int | None, trunk: Trunk) -> dict[str, Any]:
    """The defaults that depend on the number of billboards: how long to search for a placement, and how many show the trunk."""
    if count is None:
        return {}
    shown = {"trunk_billboards": crossed_in_trunk(count)} if trunk == "crossed" else {}
    if count >= _MANY:
        return {"restarts": 1, "candidates": 4 if count < _VERY_MANY else 1, "refinement_rounds": 0, "locality": _LOCALITY} | shown
    rounds = min(6, max(1, count - 3))
    return {"restarts": min(2, max(1, count // 4)), "candidates": 12, "refinement_rounds": rounds, "locality": 0.0} | shown


def crossed_in_trunk(count: int) -> int:
    """How many of ``count`` billboards cross in the trunk by default."""
    return TRUNK_PLANES * min(max(count // _PER_PART, 1), _MOST_PARTS) if count >= _MANY else 0


class ResolvedFit(FitConfig):
    """A :class:`FitConfig` in which only ``max_texels`` may be ``None``, and, until the fit has chosen it, the number of billboards.

    The length of the search and the number of the trunk's billboards depend on that number, and are then ``None`` too.

    Raises InputError if a value is missing, or values contradict each other.
    """

    alpha: AlphaKind
    alpha_cutoff: Cutoff
    least_alpha: _Unit
    most_layers: _Layers
    margin: _Unit
    placement: Placement
    placement_learning_rate: _Unit
    bounds: Bounds
    texel_density: _Density
    loss: Loss
    colors: Colors
    antialiased: bool
    palette: _Palette
    ssim_weight: _Unit
    sharpness_weight: _Sharpness
    binarization_weight: _OfAlpha
    levels: Count
    steps: Count
    views_per_step: Count
    learning_rate: _Rate
    beta1: _Decay
    beta2: _Decay
    schedule: Schedule

    @property
    def drawn_alpha(self) -> AlphaMode:
        """The alpha mode in which finished textures are drawn to fit their colors; on average, ``hash`` looks like ``blend``."""
        if self.alpha == "mask":
            return AlphaMode("mask", self.alpha_cutoff, antialiased=self.antialiased)
        return AlphaMode("coverage", self.alpha_cutoff, samples=0) if self.alpha == "coverage" else AlphaMode()

    def counted(self, count: int) -> ResolvedFit:
        """The same with a number of billboards, if it is not chosen yet, and with a search of the length that suits it."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return ResolvedFit(**{"billboards": count} | _effort(count, self.trunk) | given)

    def __post_init__(self) -> None:
        super().__post_init__()
        textures = (self.billboards or self.most_billboards) * (1 if self.sides == "one" else 2)
        if self.max_texels is not None and self.max_texels < textures:
            fail("max_texels", f"{self.max_texels} are too few for {textures} textures", "allow more")
        fewest = self.billboards or self.least_billboards
        if self.placement == "clusters" and (self.trunk_billboards or 0) >= fewest:
            fail("trunk_billboards", f"{self.trunk_billboards} of {fewest} billboards leave none for the crown", "allow fewer")
        if 0 < self.palette <= TRANSPARENT_COLORS + 1:
            fail("palette", f"{self.palette} colors are too few", f"allow at least {TRANSPARENT_COLORS + 2}, or 0 for any number")
        if self.sides == "pair" and self.placement == "clusters":
            fail("sides", "pairs need an even placement around an axis", "add --placement even, or choose one or two")
