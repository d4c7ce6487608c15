"""The search for a placement: fit many clusterings at a low resolution, fit the best of them longer, and refine the best one."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter

import torch
from torch import Tensor

from bbfit.fitting.clusters import Planes, best_planes, cluster_planes, moments, rectangles, splatted, split_planes, view_projection
from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.initialize import pixels_per_meter, tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.fitting.points import pixels_of, point_colors
from bbfit.fitting.steps import Stepper
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.image_loss.reference import pixel_loss_reference
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet

SIDE = 64
"""Approximate side of the pictures that the search renders, in pixels."""
# Learning rate of the candidates, and of everything after them.
_RATE, _LATER_RATE = 0.15, 0.06
# A clustering supplies three quarters of the billboards. Additions supply the rest, one in four.
_BILLBOARDS_PER_ADDITION = 4
# Alternatives for each addition, and alternatives in each refinement round, which include the unchanged cloud.
_ADDITION_WAYS, _REFINEMENT_WAYS = 4, 5
# Views in every step.
_BATCH = 8
# Random planes that are scored for a new billboard. The plane takes the points within _NEAR times the tree's radius.
_NEAR, _PLANES = 0.08, 150
# Margin around the points of a billboard, as a fraction of the tree's radius.
_MARGIN = 0.06


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


USUAL = Effort()
"""The effort of every fit."""


def find_placement(
    views: ViewSet, points: Tensor, config: ResolvedFit, on_progress: Callable[[int, int], None] | None = None, effort: Effort = USUAL
) -> BillboardCloud:
    """Search for the placement of billboards that explains the training views best at a low resolution.

    Each of ``restarts`` searches clusters the points on the tree, float64 [P, 3], from ``candidates`` random starts and fits each
    clustering, placement and textures, for a few steps. The best 30 % continue for more steps. A search then adds the last quarter of the
    billboards to the best clouds, by splitting a billboard or by placing one where the loss is largest.

    ``refinement_rounds`` rounds then refine the cloud with the least loss. Each round compares four changes. Two move a billboard whose
    removal raises the loss little to where the loss is largest. One removes such a billboard and splits another. One merges two billboards
    whose points lie almost on one plane and places the spare one where the loss is largest. A round keeps the best change only if it lowers
    the loss.

    ``on_progress`` is called after every step with the work done and the total work, in steps of one candidate. The result is float32 on
    the CPU and has fitted textures, with the texel density of pictures of about :data:`SIDE` pixels.
    """
    return _Search(views, points, config, on_progress or (lambda done, total: None), effort).best()


class _Search:
    def __init__(
        self, views: ViewSet, points: Tensor, config: ResolvedFit, on_progress: Callable[[int, int], None], effort: Effort = USUAL
    ) -> None:
        self._config, self._points, self._on_progress, self._effort = replace(config.coarse(), ssim_weight=0.0), points, on_progress, effort
        side = min(views.cameras.width, views.cameras.height)
        self._targets = Targets.at(views, max(0, round(math.log2(side / SIDE))))
        self._pictures = self._targets.pictures(range(len(views)))
        cameras = self._targets.cameras
        self._density = float(pixels_per_meter(cameras)) * config.texel_density
        self._projection = view_projection(cameras)
        self._pixels = [pixels_of(points, cameras[index]) for index in range(len(cameras))]
        self._all_upright = config.orientation == "upright"
        self._colors = point_colors(self._pixels, self._pictures)
        self._radius = tree_radius(views)
        self._added = config.billboards // _BILLBOARDS_PER_ADDITION
        self._clusters, self._survivors = config.billboards - self._added, max(1, round(effort.survivors * config.candidates))
        self._generator, self._proposed, self._done = torch.Generator().manual_seed(config.seed), 0, 0
        # Clouds that get additions. Every addition halves their number, and few billboards limit it, so that the search stays short.
        self._chains = min(self._survivors, max(1, config.billboards // 2))
        completed = sum(max(1, self._chains >> addition) for addition in range(self._added))
        each = effort.steps * config.candidates + effort.more_steps * self._survivors + effort.mend_steps * _ADDITION_WAYS * completed
        self._total = config.restarts * each + effort.mend_steps * _REFINEMENT_WAYS * config.refinement_rounds

    def best(self) -> BillboardCloud:
        """See :func:`find_placement`."""
        best = min((self._searched(number) for number in range(self._config.restarts)), key=itemgetter(1))
        for number in range(self._config.refinement_rounds):
            best = min(best, self._best_of([best[0], *self._revised(best[0], number)]), key=itemgetter(1))
        return best[0]

    def _searched(self, number: int) -> tuple[BillboardCloud, float]:
        """Run search ``number``. Return its cloud and the loss."""
        config = self._config
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            clouds = list(pool.map(self._clustered, range(number * config.candidates, (number + 1) * config.candidates)))
        clouds, losses = self._fitted(clouds, self._effort.steps, _RATE)
        survivors = sorted(range(len(clouds)), key=losses.__getitem__)[: self._survivors]
        clouds, losses = self._fitted([clouds[index] for index in survivors], self._effort.more_steps, _LATER_RATE)
        best = sorted(zip(clouds, losses, strict=True), key=itemgetter(1))[: self._chains]
        for _ in range(self._added):
            best = sorted((self._best_of(self._extended(cloud)) for cloud, _ in best), key=itemgetter(1))
            best = best[: max(1, len(best) // 2)]
        return best[0]

    def _best_of(self, clouds: list[BillboardCloud]) -> tuple[BillboardCloud, float]:
        """Fit clouds for some steps. Return the best one and its loss."""
        return min(zip(*self._fitted(clouds, self._effort.mend_steps, _LATER_RATE), strict=True), key=itemgetter(1))

    def _without(self, cloud: BillboardCloud) -> list[tuple[BillboardCloud, Tensor]]:
        """Remove each billboard in turn. Return the clouds and their losses of every pixel, the least mean loss first."""
        clouds = [cloud.take(k for k in range(len(cloud)) if k != removed) for removed in range(len(cloud))]
        return sorted(((other, self._losses(other)) for other in clouds), key=lambda pair: float(pair[1].mean()))

    def _upright(self, index: int) -> bool:
        return self._all_upright or (self._config.orientation == "any" and index % 2 == 0)

    def _clustered(self, index: int) -> BillboardCloud:
        """Cluster the points from random start number ``index``."""
        generator = torch.Generator().manual_seed((self._config.seed << 16) + index)
        planes = cluster_planes(self._points, self._clusters, self._projection, upright=self._upright(index), generator=generator)
        return self._textured(torch.arange(len(self._points)), planes)

    def _extended(self, cloud: BillboardCloud) -> list[BillboardCloud]:
        """Add one billboard to a cloud in several ways: split a billboard, or place one where the loss is large."""
        weight = self._weights(self._losses(cloud))
        return [self._split(cloud, weight), *(self._with_another(cloud, weight) for _ in range(_ADDITION_WAYS - 1))]

    def _revised(self, cloud: BillboardCloud, number: int) -> list[BillboardCloud]:
        """Change a cloud in the four ways of refinement round ``number``; see :func:`find_placement`."""
        if len(cloud) == 1:
            weight = self._weights(self._losses(cloud))
            return [self._proposal(weight) for _ in range(_REFINEMENT_WAYS - 1)]
        without = self._without(cloud)
        (first, losses), (second, second_losses) = (without[(2 * number + k) % min(4, len(without))] for k in range(2))
        weight = self._weights(losses)
        merged = self._merged(cloud, number)
        return [
            self._with_another(first, weight),
            self._with_another(second, self._weights(second_losses)),
            self._split(first, weight),
            self._with_another(merged, self._weights(self._losses(merged))),
        ]

    def _with_another(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        return BillboardCloud.joined([cloud, self._proposal(weight)])

    def _nearest(self, cloud: BillboardCloud) -> Tensor:
        """Return the index of the billboard nearest to each point, [P].

        The distance is the displacement that views see when the point moves onto the plane and from there into the rectangle.
        """
        cloud = cloud.to(torch.float64)
        offset = self._points[:, None] - cloud.centers
        x, y = ((offset * axis).sum(-1).abs() for axis in (cloud.rights, cloud.ups))
        beyond = (torch.stack([x, y], -1) - cloud.half_extents).clamp_min(0)
        visible = ((cloud.normals @ self._projection) * cloud.normals).sum(-1)
        return ((offset * cloud.normals).sum(-1).square() * visible + beyond.square().sum(-1)).argmin(-1)

    def _split(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        """Replace a billboard by two. The billboard is chosen at random, with the losses on its points as weights."""
        nearest = self._nearest(cloud)
        losses = torch.zeros(len(cloud), dtype=weight.dtype).index_add_(0, nearest, weight)
        split = int(torch.multinomial(losses, 1, generator=self._generator))
        members = torch.nonzero(nearest == split)[:, 0]
        axes = torch.stack([cloud.normals[split], cloud.rights[split], cloud.ups[split]])
        planes = split_planes(self._points[members], axes, self._projection, upright=self._all_upright)
        return BillboardCloud.joined([cloud.take(k for k in range(len(cloud)) if k != split), self._textured(members, planes)])

    def _merged(self, cloud: BillboardCloud, number: int) -> BillboardCloud:
        """Replace two billboards by one. Rounds take turns with the three pairs whose merging adds least to the squared distances."""
        nearest, upright = self._nearest(cloud), self._all_upright
        sums = moments(self._points, nearest, len(cloud))
        pairs = torch.combinations(torch.arange(len(cloud)))
        normals, offsets, squares = best_planes(sums[pairs].sum(1), upright=upright)
        increase = squares - best_planes(sums, upright=upright)[2][pairs].sum(1)
        pair = int(increase.argsort()[number % min(3, len(pairs))])
        merged = torch.isin(torch.arange(len(cloud)), pairs[pair])
        members = torch.nonzero(merged[nearest])[:, 0]
        others = cloud.take(torch.nonzero(~merged)[:, 0].tolist())
        return BillboardCloud.joined([others, self._on_plane(members, normals[pair], offsets[pair])])

    def _on_plane(self, members: Tensor, normal: Tensor, offset: Tensor) -> BillboardCloud:
        """Place one billboard on a plane around the points at the indices ``members``."""
        return self._textured(members, Planes(normal[None], offset[None], torch.zeros(len(members), dtype=torch.int64)))

    def _textured(self, members: Tensor, planes: Planes) -> BillboardCloud:
        """Place billboards on planes around the points at the indices ``members`` and splat the points into the textures."""
        points, colors = self._points[members], self._colors[members]
        without_textures = rectangles(points, planes, self._density, _MARGIN * self._radius, two_sided=self._config.sides == "two")
        return splatted(without_textures, points, colors, planes.labels).to(torch.float32)

    def _fitted(self, clouds: list[BillboardCloud], steps: int, rate: float) -> tuple[list[BillboardCloud], list[float]]:
        """Fit clouds of equal size side by side, placement and textures. Return the clouds and their losses over all views."""
        config, joined = self._config, BillboardCloud.joined(clouds)
        movement = Movement(joined, self._radius) if config.placement_learning_rate else None
        stepper = Stepper(joined.to(config.device), self._targets, config, movement, groups=len(clouds))
        for step in range(steps):
            decay = 0.5 * (1 + math.cos(math.pi * step / steps))
            batch = torch.randperm(len(self._targets.cameras), generator=self._generator)[:_BATCH].tolist()
            stepper.step(batch, rate * decay, config.placement_learning_rate * decay)
            self._done += len(clouds)
            self._on_progress(self._done, self._total)
        clouds = stepper.finish().parts(len(clouds))
        return clouds, [float(self._losses(cloud).mean()) for cloud in clouds]

    def _losses(self, cloud: BillboardCloud) -> Tensor:
        """Compute the loss of every pixel of every training view, [V, H, W]."""
        device = self._config.device
        image = render(cloud.to(device), self._targets.cameras.to(device), backend=self._config.backend)
        return pixel_loss_reference(image.cpu(), self._pictures, self._config.loss)

    def _weights(self, losses: Tensor) -> Tensor:
        """Average the losses of the pixels that show each point, float64 [P]."""
        weight = torch.zeros(len(self._points))
        for (index, inside), loss in zip(self._pixels, losses, strict=True):
            weight += loss.flatten()[index] * inside
        return (weight / len(losses)).clamp_min(1e-12).double()

    def _proposal(self, weight: Tensor) -> BillboardCloud:
        """Place a billboard where the loss is large, on the best of many random planes through points (Fischler and Bolles 1981)."""
        upright, generator = self._upright(self._proposed), self._generator
        self._proposed += 1
        samples = self._points[torch.multinomial(weight, 3000, replacement=True, generator=generator)]
        corners = samples[torch.randint(len(samples), (_PLANES, 3), generator=generator)]
        along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        if upright:
            across = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(along)
        normals = torch.nn.functional.normalize(torch.linalg.cross(along, across), dim=-1)
        near = _NEAR * self._radius
        visible = ((normals @ self._projection) * normals).sum(-1).clamp_min(1e-12).sqrt()
        distance = (samples @ normals.mT - (normals * corners[:, 0]).sum(-1)) * visible
        score = torch.exp(-((distance / near) ** 2)).sum(0)
        best = int(torch.where(normals.norm(dim=-1) > 0.5, score, -1).argmax())  # collinear points define no plane
        normal, offset = normals[best], normals[best] @ corners[best, 0]
        members = torch.nonzero((self._points @ normal - offset).abs() * visible[best] < near)[:, 0]
        members = members[torch.multinomial(weight[members], min(2000, len(members)), replacement=True, generator=generator)]
        return self._on_plane(members, normal, offset)
