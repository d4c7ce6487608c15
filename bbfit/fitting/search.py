"""The search for a placement: fit many clusterings at a low resolution, fit the best of them longer, and refine the best one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import torch
from torch import Tensor

from bbfit.fitting.bark import Bark
from bbfit.fitting.config import TRUNK_PLANES, ResolvedFit, crossed_in_trunk
from bbfit.fitting.initialize import pixels_per_meter, tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.fitting.moves import ADDITIONS, REFINEMENTS, Moves
from bbfit.fitting.points import SeenPoints
from bbfit.fitting.steps import Stepper, pass_of
from bbfit.fitting.trunk import trunk_points
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.image_loss.reference import pixel_loss_reference
from bbfit.rendering.dispatch import render
from bbfit.threads import one_thread
from bbfit.views.view_set import ViewSet

SIDE = 64
"""Approximate side of the pictures that the search renders, in pixels."""
# Learning rate of the candidates, and of everything after them.
_RATE, _LATER_RATE = 0.15, 0.06
# A clustering supplies three quarters of the billboards. Additions supply the rest, one in four, unless there are too many.
_BILLBOARDS_PER_ADDITION = 4
# Views in every step.
_BATCH = 8


@dataclass(frozen=True)
class Effort:
    """The length of the parts of a search."""

    steps: int = 30
    """Steps of every candidate."""
    more_steps: int = 50
    """Further steps of the surviving candidates."""
    mend_steps: int = 40
    """Steps of every alternative in additions and refinement rounds."""
    survivors: float = 0.3
    """Fraction of the candidates that survive."""
    most_additions: int = 8
    """Most billboards that are added one by one, each of which fits all of them anew. A clustering supplies the others."""


USUAL = Effort()
"""The effort of every fit."""
QUICK = Effort(more_steps=30, most_additions=0)
"""The effort of a comparison of numbers of billboards."""
LEAST_GAIN_DB = 0.3
"""Least gain at a low resolution, in dB, for which the number of billboards may double."""
# Numbers of billboards that are tried first and, if they are not too many, next.
_FIRST, _SECOND = 32, 384
# Most searches for that choice.
_SEARCHES = 4
# Share of bark above which a tree is bare, and all billboards are for all of its points.
_BARE = 0.9
# Margin around the points of a facet of bark, as a fraction of the tree's radius.
_FACET_MARGIN = 0.005
# Least alpha of a texel that counts in layers.
_VISIBLE = 0.05


def find_placement(
    views: ViewSet,
    points: Tensor,
    config: ResolvedFit,
    on_progress: Callable[[int, int], None] | None = None,
    effort: Effort = USUAL,
    bark: Bark | None = None,
) -> BillboardCloud:
    """Search for the placement of billboards that explains the training views best at a low resolution.

    Each of ``restarts`` searches clusters the points on the tree, float64 [P, 3], from ``candidates`` random starts and fits each
    clustering, placement and textures, for a few steps. The best 30 % continue for more steps. Unless the clusters are compact
    (``locality``), a search then adds the last quarter of the billboards, but at most eight, to the best clouds, by splitting a billboard
    or by placing one where the loss is largest.

    ``refinement_rounds`` rounds then refine the cloud with the least loss (:meth:`~bbfit.fitting.moves.Moves.refined`). A round keeps the
    best change only if it lowers the loss.

    ``trunk_billboards`` of the billboards are not searched for. With ``trunk`` mesh they are facets of the ``bark``, if it is known which
    points are on it, and as many as its share of all points, unless their number is given. Else, or if that makes fewer than three, they
    cross in the parts of the trunk below the crown (:func:`~bbfit.fitting.trunk.trunk_points`), unless the tree has none. Their textures
    show the points there.

    If ``billboards`` is None, their number is chosen at the knee of the curve, within ``least_billboards`` and ``most_billboards``. What a
    graphics card pays for is the pixels that it shades, and they grow with the number of layers before each other. Two or three quick
    searches with one candidate measure the layers of few and of many billboards, and the number of billboards with ``most_layers`` is
    interpolated on a logarithmic scale. If a doubling of the number would gain less than :data:`LEAST_GAIN_DB`, it is the smaller one.

    ``on_progress`` is called with the work done and the total work. The result is float32 on the CPU and has fitted textures, with the
    texel density of pictures of about :data:`SIDE` pixels.
    """
    tree, on_progress = _Tree(views, points, bark), on_progress or (lambda done, total: None)
    with pass_of(config).cores():
        if config.billboards is not None:
            return _found(tree, config, on_progress, effort)[0]
        cloud = _at_the_knee(tree, config, on_progress)
    on_progress(_SEARCHES, _SEARCHES)
    return cloud


class _Tree:
    """What a search knows of a tree, whatever the number of billboards."""

    def __init__(self, views: ViewSet, points: Tensor, bark: Bark | None) -> None:
        side = min(views.cameras.width, views.cameras.height)
        self.views, self.bark, self.radius, self.threads = views, bark, tree_radius(views), torch.get_num_threads()
        self.targets = Targets.at(views, max(0, round(math.log2(side / SIDE))))
        self.pictures = self.targets.pictures(range(len(views)))
        self.points = SeenPoints.of(points, self.targets.cameras, self.pictures)

    @cached_property
    def trunk(self) -> Tensor:
        """Indices of the points below the crown (:func:`~bbfit.fitting.trunk.trunk_points`)."""
        return trunk_points(self.points.places, self.views)


def _found(tree: _Tree, config: ResolvedFit, on_progress: Callable[[int, int], None], effort: Effort) -> tuple[BillboardCloud, _Search]:
    """The placement of a known number of billboards, and the search that found it."""
    own, count, bark, points = config.trunk_billboards, config.billboards, tree.bark, tree.points
    assert count is not None  # see counted()
    if config.trunk == "mesh":
        share = 0.0 if bark is None else len(bark.members) / len(points.places)
        faceted = min(round(count * share) if own is None else own, count - 1)
        if bark is not None and faceted >= TRUNK_PLANES:
            others = torch.ones(len(points.places), dtype=torch.bool)
            others[bark.members] = share > _BARE
            search = _Search(tree, points.take(others), _of_the_crown(config, count - faceted), on_progress, effort)
            return BillboardCloud.joined([search.best(), search.faceted(points.take(bark.members), bark.normals, faceted)]), search
        own = min(crossed_in_trunk(count), count if own is None else own)
    assert own is not None  # see counted()
    trunk = tree.trunk if own else torch.zeros(0, dtype=torch.int64)
    search = _Search(tree, points, _of_the_crown(config, count - (own if len(trunk) else 0)), on_progress, effort)
    best = search.best()
    return (BillboardCloud.joined([best, search.moves.crossed(trunk, own)]) if len(trunk) else best), search


def _of_the_crown(config: ResolvedFit, count: int) -> ResolvedFit:
    """The same for the ``count`` billboards that the search finds, without those of the trunk."""
    return replace(config, billboards=count, trunk_billboards=0)


def _at_the_knee(tree: _Tree, config: ResolvedFit, on_progress: Callable[[int, int], None]) -> BillboardCloud:
    """The placement of as many billboards as pay for the tree; see :func:`find_placement`."""

    tries = itertools.count(1)

    def tried(count: int) -> _Trial:
        whole = config.counted(count)
        brief = replace(whole, restarts=1, candidates=1, refinement_rounds=0)
        cloud, search = _found(tree, brief, lambda done, total: None, QUICK)
        on_progress(next(tries), _SEARCHES)
        return _Trial(count, cloud if brief == whole else None, search.layers(cloud), search.decibels(cloud))

    def chosen(count: int, *trials: _Trial) -> BillboardCloud:
        clouds = [trial.cloud for trial in trials if trial.count == count and trial.cloud is not None]
        return clouds[0] if clouds else _found(tree, config.counted(count), lambda done, total: None, QUICK)[0]

    limit, most = config.most_layers, config.most_billboards
    trial = tried(min(max(_FIRST, config.least_billboards), most))
    further = {min(max(_SECOND, trial.count), most), most} if trial.layers <= limit else {config.least_billboards}
    for count in sorted(further - {trial.count}):
        few, many = sorted([trial, tried(count)], key=attrgetter("count"))
        doublings = math.log2(many.count / few.count)
        if many.decibels - few.decibels < LEAST_GAIN_DB * doublings or few.layers >= limit:
            return chosen(few.count, few)
        if many.layers > limit:
            position = (limit - few.layers) / (many.layers - few.layers)
            return chosen(round(few.count * 2 ** (doublings * position)), few, many)
        trial = many
    return chosen(trial.count, trial)


@dataclass(frozen=True)
class _Trial:
    """What a short search with one candidate says of a number of billboards."""

    count: int
    cloud: BillboardCloud | None
    """The placement, if a whole search would have found the same."""
    layers: float
    """As :meth:`_Search.layers`."""
    decibels: float
    """Quality at the resolution of the search."""


class _Search:
    def __init__(
        self, tree: _Tree, points: SeenPoints, config: ResolvedFit, on_progress: Callable[[int, int], None], effort: Effort
    ) -> None:
        self._config, self._on_progress, self._effort = replace(config.coarse(), ssim_weight=0.0, colors="joint"), on_progress, effort
        self._tree, self._generator, self._locality = tree, torch.Generator().manual_seed(config.seed), config.locality
        self.moves = Moves(points, config, tree.radius, self._generator)
        assert config.billboards and config.candidates and config.restarts and config.refinement_rounds is not None  # see counted()
        self._restarts, self._candidates, self._rounds = config.restarts, config.candidates, config.refinement_rounds
        # An addition is a slice through the whole tree, and compact parts leave none out.
        self._added = 0 if self._locality else min(config.billboards // _BILLBOARDS_PER_ADDITION, effort.most_additions)
        self._clusters, self._survivors = config.billboards - self._added, max(1, round(effort.survivors * config.candidates))
        self._done = 0
        # Clouds that get additions. Every addition halves their number, and few billboards limit it, so that the search stays short.
        self._chains = min(self._survivors, max(1, config.billboards // 2))
        completed = sum(max(1, self._chains >> addition) for addition in range(self._added))
        each = effort.steps * config.candidates + effort.more_steps * self._survivors + effort.mend_steps * ADDITIONS * completed
        self._total = config.restarts * each + effort.mend_steps * (1 + REFINEMENTS) * config.refinement_rounds

    def faceted(self, points: SeenPoints, normals: Tensor, count: int) -> BillboardCloud:
        """At most ``count`` billboards for P points on bark with unit normals, [P, 3], with hardly a margin."""
        config = replace(self._config, margin=_FACET_MARGIN, locality=1.0)
        return Moves(points, config, self._tree.radius, self._generator).faceted(normals, count)

    def layers(self, cloud: BillboardCloud) -> float:
        """How many visible texels of a cloud lie before each other in a pixel of the rectangle around the tree, on average over views."""
        cameras, cloud = self._tree.targets.cameras, cloud.to(torch.float64)
        visible = torch.stack([(texture[..., 3] > _VISIBLE).double().mean() for texture in cloud.textures()])
        facing = (cameras.batch().forward.double() @ cloud.normals.mT).abs().mean(0)
        drawn = float((4 * cloud.half_extents.prod(-1) * visible * facing).sum()) * float(pixels_per_meter(cameras)) ** 2
        shown = self._tree.pictures[..., 3] > 0
        height, width = (_extent(shown.any(axis)) for axis in (2, 1))
        return drawn / max(float((height * width).mean()), 1.0)

    def decibels(self, cloud: BillboardCloud) -> float:
        """Quality of a cloud at the resolution of the search, in dB."""
        return -10 * math.log10(max(float(self._losses(cloud).mean()), 1e-12))

    def best(self) -> BillboardCloud:
        """See :func:`find_placement`."""
        best = self._best_of([self.searched(number) for number in range(self._restarts)])
        for number in range(self._rounds):
            best = self._best_of([best, *self._mended([best, *self.moves.refined(best, number, self._losses)])])
        return best

    def searched(self, number: int) -> BillboardCloud:
        """Run search ``number``. Return its cloud."""
        with one_thread(), ThreadPoolExecutor(self._tree.threads) as pool:
            starts = range(number * self._candidates, (number + 1) * self._candidates)
            clouds = list(pool.map(lambda start: self.moves.clustered(start, self._clusters), starts))
        clouds = self._ranked(self._fitted(clouds, self._effort.steps, _RATE))[: self._survivors]
        clouds = self._ranked(self._fitted(clouds, self._effort.more_steps, _LATER_RATE))[: self._chains]
        for _ in range(self._added):
            clouds = self._ranked([self._best_of(self._mended(self.moves.extended(cloud, self._losses))) for cloud in clouds])
            clouds = clouds[: max(1, len(clouds) // 2)]
        return clouds[0]

    def _ranked(self, clouds: list[BillboardCloud]) -> list[BillboardCloud]:
        """Clouds in the order of their losses over all views, the least first."""
        return sorted(clouds, key=lambda cloud: float(self._losses(cloud).mean())) if len(clouds) > 1 else clouds

    def _best_of(self, clouds: list[BillboardCloud]) -> BillboardCloud:
        return self._ranked(clouds)[0]

    def _mended(self, clouds: list[BillboardCloud]) -> list[BillboardCloud]:
        """Fit changed clouds for some steps."""
        return self._fitted(clouds, self._effort.mend_steps, _LATER_RATE)

    def _fitted(self, clouds: list[BillboardCloud], steps: int, rate: float) -> list[BillboardCloud]:
        """Fit clouds of equal size side by side, placement and textures."""
        config, joined = self._config, BillboardCloud.joined(clouds)
        movement = Movement(joined, self._tree.radius, grow=not self._locality) if config.placement_learning_rate else None
        stepper = Stepper(joined.to(config.device), self._tree.targets, config, movement, groups=len(clouds))
        for step in range(steps):
            decay = 0.5 * (1 + math.cos(math.pi * step / steps))
            batch = torch.randperm(len(self._tree.targets.cameras), generator=self._generator)[:_BATCH].tolist()
            stepper.step(batch, rate * decay, config.placement_learning_rate * decay)
            self._done += len(clouds)
            self._on_progress(self._done, self._total)
        return stepper.finish().parts(len(clouds))

    def _losses(self, cloud: BillboardCloud) -> Tensor:
        """Compute the loss of every pixel of every training view, [V, H, W]."""
        device = self._config.device
        image = render(cloud.to(device), self._tree.targets.cameras.to(device), backend=self._config.backend)
        return pixel_loss_reference(image.cpu(), self._tree.pictures, self._config.loss)


def _extent(shown: Tensor) -> Tensor:
    """Distance from the first to the last true value of each row, both included, bool [V, L] -> float64 [V]."""
    places = torch.arange(1, shown.shape[1] + 1, dtype=torch.float64)
    last = (places * shown).amax(1)
    first = torch.where(shown, places, torch.inf).amin(1)
    return torch.where(last > 0, last - first + 1, 0)
