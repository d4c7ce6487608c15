"""The search for a placement: many clusterings are fitted at a low resolution, the best ones longer, and the best one is revised."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from operator import itemgetter

import torch
from torch import Tensor

from bbfit.fitting.clusters import Planes, best_planes, cluster_planes, moments, rectangles, seen_across, splatted, split_planes
from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.initialize import pixels_a_meter, tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.losses import pixel_losses
from bbfit.fitting.movement import Movement
from bbfit.fitting.points import pixels_of, point_colors
from bbfit.fitting.steps import make_stepper
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet

SIDE = 64
"""About the width of the pictures that the search is done on, in pixels."""
# Steps of every candidate, of those that survive, and of every alternative later on; their rates; how many survive.
_STEPS, _MORE_STEPS, _MEND_STEPS = 30, 50, 40
_RATE, _LATER_RATE = 0.15, 0.06
_SURVIVORS = 0.3
# One in so many billboards does not come from a clustering but is added to it; alternatives for each, and in every revision.
_ADDED, _ADDITIONS, _REVISIONS = 4, 4, 5
# Views in every step.
_BATCH = 8
# Points nearer to a new plane than this share of the tree's radius are what it carries; planes tried for each.
_NEAR, _TRIALS = 0.08, 150
# Margin around what a billboard carries, as a share of the tree's radius.
_MARGIN = 0.06


def find_placement(
    views: ViewSet, points: Tensor, config: ResolvedFit, on_work: Callable[[int, int], None] | None = None
) -> BillboardCloud:
    """Billboards placed where the tree is, with textures fitted at a low resolution.

    Clusterings of the points from different random starts, upright and free, are fitted for a few steps each in which billboards move with
    their textures; the best third goes on for longer. To the best of these the last quarter of the billboards is added, by splitting one or
    where the loss is largest. That is done ``searches`` times, and the cloud with the least loss on the training views is revised: a
    billboard that is missed least, since others carry the same or there is little to carry, is put where the loss is largest, or given up
    to split another; or two whose points lie almost on one plane are merged to have one free. Whatever lowers the loss stays.

    Parameters
    ----------
    views : training views.
    points : on the tree, [P, 3] float64.
    config : resolved; ``billboards``, ``searches``, ``candidates``, ``revisions``, ``orientation`` and ``seed`` matter.
    on_work : told how much of the work is done and how much there is, in steps of one candidate.

    Returns
    -------
    Float32 on the CPU; textures of :data:`SIDE` texels where the full resolution has as many as a view is wide.
    """
    return _Search(views, points, config, on_work or (lambda done, total: None)).best()


class _Search:
    def __init__(self, views: ViewSet, points: Tensor, config: ResolvedFit, on_work: Callable[[int, int], None]) -> None:
        self._config, self._points, self._on_work = replace(config.coarse(), ssim_weight=0.0), points, on_work
        side = min(views.cameras.width, views.cameras.height)
        self._targets = Targets.at(views, max(0, round(math.log2(side / SIDE))))
        self._pictures = self._targets.pictures(range(len(views)))
        cameras = self._targets.cameras
        self._density = float(pixels_a_meter(cameras)) * config.texel_density
        self._seen = seen_across(cameras)
        self._pixels = [pixels_of(points, cameras[index]) for index in range(len(cameras))]
        self._all_upright = config.orientation == "upright"
        self._colors = point_colors(self._pixels, self._pictures)
        self._radius = tree_radius(views)
        self._added = config.billboards // _ADDED
        self._clusters, self._survivors = config.billboards - self._added, max(1, round(_SURVIVORS * config.candidates))
        self._generator, self._proposed, self._done = torch.Generator().manual_seed(config.seed), 0, 0
        # So many of them are completed, half as many after every addition; fewer where that would take long beside the fit.
        self._chains = min(self._survivors, max(1, config.billboards // 2))
        completed = sum(max(1, self._chains >> addition) for addition in range(self._added))
        each = _STEPS * config.candidates + _MORE_STEPS * self._survivors + _MEND_STEPS * _ADDITIONS * completed
        self._total = config.restarts * each + _MEND_STEPS * _REVISIONS * config.refinement_rounds

    def best(self) -> BillboardCloud:
        """See :func:`find_placement`."""
        best = min((self._searched(number) for number in range(self._config.restarts)), key=itemgetter(1))
        for turn in range(self._config.refinement_rounds):
            best = min(best, self._best_of([best[0], *self._revised(best[0], turn)]), key=itemgetter(1))
        return best[0]

    def _searched(self, number: int) -> tuple[BillboardCloud, float]:
        """What search ``number`` finds, and its loss."""
        config = self._config
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            clouds = list(pool.map(self._clustered, range(number * config.candidates, (number + 1) * config.candidates)))
        clouds, losses = self._fitted(clouds, _STEPS, _RATE)
        chosen = sorted(range(len(clouds)), key=losses.__getitem__)[: self._survivors]
        clouds, losses = self._fitted([clouds[index] for index in chosen], _MORE_STEPS, _LATER_RATE)
        grown = sorted(zip(clouds, losses, strict=True), key=itemgetter(1))[: self._chains]
        for _ in range(self._added):
            grown = sorted((self._best_of(self._extended(cloud)) for cloud, _ in grown), key=itemgetter(1))
            grown = grown[: max(1, len(grown) // 2)]
        return grown[0]

    def _best_of(self, clouds: list[BillboardCloud]) -> tuple[BillboardCloud, float]:
        """The best of some clouds after some steps, and its loss."""
        return min(zip(*self._fitted(clouds, _MEND_STEPS, _LATER_RATE), strict=True), key=itemgetter(1))

    def _without(self, cloud: BillboardCloud) -> list[tuple[BillboardCloud, Tensor]]:
        """A cloud without one of its billboards, and its losses of every pixel, for each of them; what is missed least first."""
        rests = [cloud.take(k for k in range(len(cloud)) if k != dropped) for dropped in range(len(cloud))]
        return sorted(((rest, self._losses(rest)) for rest in rests), key=lambda pair: float(pair[1].mean()))

    def _upright(self, index: int) -> bool:
        return self._all_upright or (self._config.orientation == "any" and index % 2 == 0)

    def _clustered(self, index: int) -> BillboardCloud:
        """Clusters from random start number ``index``."""
        generator = torch.Generator().manual_seed((self._config.seed << 16) + index)
        planes = cluster_planes(self._points, self._clusters, self._seen, upright=self._upright(index), generator=generator)
        return self._textured(torch.arange(len(self._points)), planes)

    def _extended(self, cloud: BillboardCloud) -> list[BillboardCloud]:
        """A cloud with one billboard more, in several ways: by splitting one, and through points where the loss is large."""
        weight = self._weights(self._losses(cloud))
        return [self._split(cloud, weight), *(self._with_another(cloud, weight) for _ in range(_ADDITIONS - 1))]

    def _revised(self, cloud: BillboardCloud, turn: int) -> list[BillboardCloud]:
        """A cloud with one billboard moved, in two ways; with one given up to split another; and with two merged to have one free."""
        if len(cloud) == 1:
            weight = self._weights(self._losses(cloud))
            return [self._proposal(weight) for _ in range(_REVISIONS - 1)]
        without = self._without(cloud)
        (rest, losing), (other, also_losing) = (without[(2 * turn + k) % min(4, len(without))] for k in range(2))
        weight = self._weights(losing)
        merged = self._merged(cloud, turn)
        return [
            self._with_another(rest, weight),
            self._with_another(other, self._weights(also_losing)),
            self._split(rest, weight),
            self._with_another(merged, self._weights(self._losses(merged))),
        ]

    def _with_another(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        return BillboardCloud.joined([cloud, self._proposal(weight)])

    def _carried(self, cloud: BillboardCloud) -> Tensor:
        """Which billboard each point is nearest to, by how far views see it moved onto the plane and, from there, into the rectangle."""
        cloud = cloud.to(torch.float64)
        offset = self._points[:, None] - cloud.centers
        x, y = ((offset * axis).sum(-1).abs() for axis in (cloud.rights, cloud.ups))
        beyond = (torch.stack([x, y], -1) - cloud.half_extents).clamp_min(0)
        visible = ((cloud.normals @ self._seen) * cloud.normals).sum(-1)
        return ((offset * cloud.normals).sum(-1).square() * visible + beyond.square().sum(-1)).argmin(-1)

    def _split(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        """A cloud with two billboards for the points of one, which is drawn by the losses on its points."""
        carried = self._carried(cloud)
        shares = torch.zeros(len(cloud), dtype=weight.dtype).index_add_(0, carried, weight)
        chosen = int(torch.multinomial(shares, 1, generator=self._generator))
        held = torch.nonzero(carried == chosen)[:, 0]
        axes = torch.stack([cloud.normals[chosen], cloud.rights[chosen], cloud.ups[chosen]])
        planes = split_planes(self._points[held], axes, self._seen, upright=self._all_upright)
        return BillboardCloud.joined([cloud.take(k for k in range(len(cloud)) if k != chosen), self._textured(held, planes)])

    def _merged(self, cloud: BillboardCloud, turn: int) -> BillboardCloud:
        """A cloud with one billboard for the points of two: of one of the three pairs whose points that moves least farther."""
        carried, upright = self._carried(cloud), self._all_upright
        sums = moments(self._points, carried, len(cloud))
        pairs = torch.combinations(torch.arange(len(cloud)))
        normals, offsets, squares = best_planes(sums[pairs].sum(1), upright=upright)
        farther = squares - best_planes(sums, upright=upright)[2][pairs].sum(1)
        chosen = int(farther.argsort()[turn % min(3, len(pairs))])
        merged = torch.isin(torch.arange(len(cloud)), pairs[chosen])
        held = torch.nonzero(merged[carried])[:, 0]
        rest = cloud.take(torch.nonzero(~merged)[:, 0].tolist())
        return BillboardCloud.joined([rest, self._on_plane(held, normals[chosen], offsets[chosen])])

    def _on_plane(self, held: Tensor, normal: Tensor, offset: Tensor) -> BillboardCloud:
        """One billboard for some of the points, given by their indices."""
        return self._textured(held, Planes(normal[None], offset[None], torch.zeros(len(held), dtype=torch.int64)))

    def _textured(self, held: Tensor, planes: Planes) -> BillboardCloud:
        points, colors = self._points[held], self._colors[held]
        without_textures = rectangles(points, planes, self._density, _MARGIN * self._radius, two_sided=self._config.sides == "two")
        return splatted(without_textures, points, colors, planes.labels).to(torch.float32)

    def _fitted(self, clouds: list[BillboardCloud], steps: int, rate: float) -> tuple[list[BillboardCloud], list[float]]:
        """Clouds of equal numbers after some steps in which the billboards move with their textures, and their losses over all views."""
        config, together = self._config, BillboardCloud.joined(clouds)
        movement = Movement(together, self._radius) if config.placement_learning_rate else None
        stepper = make_stepper(together.to(config.device), self._targets, config, movement, groups=len(clouds))
        for step in range(steps):
            fall = 0.5 * (1 + math.cos(math.pi * step / steps))
            chosen = torch.randperm(len(self._targets.cameras), generator=self._generator)[:_BATCH].tolist()
            stepper.step(chosen, rate * fall, config.placement_learning_rate * fall)
            self._done += len(clouds)
            self._on_work(self._done, self._total)
        clouds = stepper.finish().parts(len(clouds))
        return clouds, [float(self._losses(cloud).mean()) for cloud in clouds]

    def _losses(self, cloud: BillboardCloud) -> Tensor:
        """The loss of every pixel of every training view, [V, H, W]."""
        device = self._config.device
        image = render(cloud.to(device), self._targets.cameras.to(device), backend=self._config.backend)
        return pixel_losses(image.cpu(), self._pictures, self._config.loss)

    def _weights(self, losses: Tensor) -> Tensor:
        """The mean loss where views see each point, float64 [P]."""
        weight = torch.zeros(len(self._points))
        for (index, inside), loss in zip(self._pixels, losses, strict=True):
            weight += loss.flatten()[index] * inside
        return (weight / len(losses)).clamp_min(1e-12).double()

    def _proposal(self, weight: Tensor) -> BillboardCloud:
        """A billboard through points where the loss is large: of random planes (Fischler and Bolles 1981) that with most of it near."""
        upright, generator = self._upright(self._proposed), self._generator
        self._proposed += 1
        drawn = self._points[torch.multinomial(weight, 3000, replacement=True, generator=generator)]
        corners = drawn[torch.randint(len(drawn), (_TRIALS, 3), generator=generator)]
        along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        if upright:
            across = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(along)
        normals = torch.nn.functional.normalize(torch.linalg.cross(along, across), dim=-1)
        near = _NEAR * self._radius
        visible = ((normals @ self._seen) * normals).sum(-1).clamp_min(1e-12).sqrt()
        distance = (drawn @ normals.mT - (normals * corners[:, 0]).sum(-1)) * visible
        score = torch.exp(-((distance / near) ** 2)).sum(0)
        chosen = int(torch.where(normals.norm(dim=-1) > 0.5, score, -1).argmax())  # three points in a row make no plane
        normal, offset = normals[chosen], normals[chosen] @ corners[chosen, 0]
        held = torch.nonzero((self._points @ normal - offset).abs() * visible[chosen] < near)[:, 0]
        held = held[torch.multinomial(weight[held], min(2000, len(held)), replacement=True, generator=generator)]
        return self._on_plane(held, normal, offset)
