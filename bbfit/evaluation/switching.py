"""At which size on the screen a level of detail takes over: where its error is hidden, and where it also draws faster."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.evaluation.color_error import mean_color_error, share_within
from bbfit.evaluation.shading import triangle_fragments
from bbfit.evaluation.silhouettes import scale_within, worst_silhouette
from bbfit.exporting.config import ExportConfig, LodConfig, Outline
from bbfit.exporting.model import shipped_model
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.cards import CardRenderer
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

# The most halvings of textures: each doubles the padding around them, so an atlas of a handful of texels would become large.
_MOST_HALVINGS = 5


@dataclass(frozen=True)
class DrawingCost:
    """What a graphics card does to draw a model."""

    triangles: int
    """Number of triangles."""
    fragments: float
    """Fragments, hidden and transparent ones included, at a scale of one pixel per meter. They grow with the square of the scale."""

    def at(self, scale: float, fragments_per_triangle: float) -> float:
        """The cost at a scale in pixels per meter, in fragments."""
        return fragments_per_triangle * self.triangles + self.fragments * scale**2

    def faster_below(self, other: DrawingCost, fragments_per_triangle: float) -> float:
        """The scale in pixels per meter below which this model draws faster than another; 0 without fewer triangles, or infinity.

        A model with fewer triangles has fewer fragments too, or else it draws faster only where those are few.
        """
        saved, added = other.triangles - self.triangles, self.fragments - other.fragments
        if saved <= 0:
            return 0.0
        return math.sqrt(fragments_per_triangle * saved / added) if added > 0 else math.inf


@dataclass(frozen=True)
class Switch:
    """The scale at which a level replaces the next finer one. The defaults are those of the tree itself."""

    scale: float = math.inf
    """The level is shown below this scale, in pixels per meter on the screen. Infinity for the finest level."""
    silhouette_scale: float = math.inf
    """The scale below which the error of its silhouette is within the bound."""
    color_scale: float = math.inf
    """The scale below which the error of its colors is."""
    errors: tuple[float, float] = (0.0, 0.0)
    """The error of its silhouette in the worst training view and in the worst held-out view, in meters."""
    color_errors: tuple[float, float] = (0.0, 0.0)
    """The mean error of its colors at ``scale`` in the training views and in the held-out views."""
    halvings: int = 0
    """How many times its textures can be halved and still have a texel for each pixel at that scale."""
    outline: Outline | None = None
    """The outline that draws fastest there; ``None`` where the export options decide."""
    cost: DrawingCost | None = None
    """What it costs to draw; ``None`` where that does not count."""
    faster_scale: float = math.inf
    """The scale below which it draws faster than the level that it replaces."""

    def cost_at(self, scale: float, fragments_per_triangle: float) -> float:
        """Its cost at a scale in pixels per meter, in fragments; 0 where that does not count."""
        return self.cost.at(scale, fragments_per_triangle) if self.cost else 0.0


@dataclass(frozen=True)
class Candidate:
    """A model that may become a level of detail."""

    draw: Callable[[Camera], Tensor]
    """Draws what it shows to a camera of the views, as for :func:`~bbfit.evaluation.scoring.held_out`."""
    costs: Callable[[], Mapping[Outline | None, DrawingCost]]
    """Computes what it costs to draw, with each outline that it may have; ``None`` is that of a mesh."""
    texel_density: float | None = None
    """Texels per meter; ``None`` for a mesh, whose textures stay as they are."""


def cloud_candidate(cloud: BillboardCloud, views: ViewSet, export: ExportConfig) -> Candidate:
    """A billboard cloud with the outlines that the export options allow. Its fragments are counted in ``views``."""

    def cost(outline: Outline) -> DrawingCost:
        cards = shipped_model(cloud, replace(export, outline=outline, textures="png", mip_files=False, mipmaps=False)).cards
        triangles = sum(len(card.corners) - 2 for card in cards.cards)
        return DrawingCost(triangles, fragments_per_square_meter(CardRenderer(cards).fragments, views))

    outlines = get_args(Outline) if export.outline is None else (export.outline,)
    shown = replace(export, textures="png", mip_files=False, split=False)  # parts of a billboard look like the whole
    return Candidate(shipped_model(cloud, shown).draw, lambda: {outline: cost(outline) for outline in outlines}, cloud.texel_density)


def mesh_cost(triangles: NDArray[np.floating], views: ViewSet) -> DrawingCost:
    """What a mesh costs to draw. ``triangles`` are corners in meters, [T, 3, 3]."""
    corners = torch.tensor(triangles, dtype=torch.float64)
    return DrawingCost(len(corners), fragments_per_square_meter(lambda camera: triangle_fragments(corners, camera), views))


def switches(
    candidates: Sequence[Candidate],
    views: ViewDataset,
    config: LodConfig,
    *,
    tree: DrawingCost | None = None,
    on_level: Callable[[int], None] = lambda done: None,
) -> list[Switch | None]:
    """The switch of each candidate, finest first; ``None`` for one that nowhere draws faster than a level whose error is hidden too.

    The bounds hold in the training views. Speed counts if ``config.fragments_per_triangle`` is given: then a level takes over only from
    the distance from which it also draws faster. It need not wait for a finer level whose error is hidden only from farther away. ``tree``
    is the cost of the tree itself, if that is a level. ``on_level`` is called with the number of finished candidates.
    """
    view_scale, found = float(pixels_per_meter(views.train.cameras)), list[Switch]()
    for candidate in candidates:
        error, held_out_error = (worst_silhouette(candidate.draw, split) / view_scale for split in (views.train, views.test))
        silhouette = scale_within(error, config.error_pixels)
        color = view_scale * share_within(candidate.draw, views.train, config.color_error)
        finer = () if config.fragments_per_triangle is not None else (switch.scale for switch in found)
        scale = min(view_scale, silhouette, color, *finer)
        found.append(Switch(scale, silhouette, color, (error, held_out_error)))
        on_level(len(found))
    chosen = list[Switch | None](found)
    if config.fragments_per_triangle is not None:
        outlined = [
            [replace(switch, outline=outline, cost=cost) for outline, cost in candidate.costs().items()]
            for switch, candidate in zip(found, candidates, strict=True)
        ]
        chosen = _fastest(outlined, config.fragments_per_triangle, tree)
    if not config.original and chosen[0]:
        chosen[0] = replace(chosen[0], scale=math.inf)
    return [switch and _measured(switch, candidate, views) for switch, candidate in zip(chosen, candidates, strict=True)]


def _measured(switch: Switch, candidate: Candidate, views: ViewDataset) -> Switch:
    """The switch with its errors of color and its halvings, which depend on the final scale."""
    view_scale = float(pixels_per_meter(views.train.cameras))
    share = min(1.0, switch.scale / view_scale)
    colors, held_out_colors = (mean_color_error(candidate.draw, split, share) for split in (views.train, views.test))
    density = candidate.texel_density
    halvings = 0 if density is None or math.isinf(switch.scale) else max(0, math.floor(math.log2(density / switch.scale)))
    return replace(switch, color_errors=(colors, held_out_colors), halvings=min(halvings, _MOST_HALVINGS))


def _fastest(found: Sequence[Sequence[Switch]], fragments_per_triangle: float, tree: DrawingCost | None) -> list[Switch | None]:
    """The levels that draw fastest somewhere among those whose error is hidden, with the scales from which they do.

    ``found`` has the outlines of each level. Of two models, the one with fewer triangles is the faster one below a certain scale. So each
    level is followed by the one that, coming from large scales, is the first to be both acceptable and faster.
    """
    chosen: list[Switch | None] = [None] * len(found)
    number, cost = -1, tree
    if cost is None:
        finest = min(found[0], key=lambda switch: switch.cost_at(switch.scale, fragments_per_triangle))
        number, chosen[0], cost = 0, finest, finest.cost
    while cost:
        following = [
            (later, replace(switch, scale=min(switch.scale, faster), faster_scale=faster))
            for later in range(number + 1, len(found))
            for switch in found[later]
            if switch.cost and (faster := switch.cost.faster_below(cost, fragments_per_triangle)) > 0
        ]
        if not following:
            break
        number, switch = max(following, key=lambda pair: (pair[1].scale, -pair[1].cost_at(pair[1].scale, fragments_per_triangle)))
        chosen[number], cost = switch, switch.cost
    return chosen


def fragments_per_square_meter(fragments: Callable[[Camera], float], views: ViewSet) -> float:
    """The mean over views of a model's fragments, at a scale of one pixel per meter.

    ``fragments`` returns the number for one camera, as for :func:`~bbfit.evaluation.shading.score_shading`.
    """
    scale = float(pixels_per_meter(views.cameras))
    return sum(fragments(views.cameras[index]) for index in range(len(views))) / max(1, len(views)) / scale**2
