"""The search for a placement: many clusterings are fitted at a low resolution, the best ones longer, and the best one is mended."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from bbfit.fitting.clusters import Planes, cluster_planes, rectangles, seen_across, splatted
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import pixels_a_metre, tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.losses import pixel_losses
from bbfit.fitting.movement import Movement
from bbfit.fitting.points import point_colours
from bbfit.fitting.steps import make_stepper
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet

SIDE = 64
"""About the width of the pictures that the search is done on, in pixels."""
# Steps of every candidate, of those that survive, and of every relocation; their rates; how many survive.
_STEPS, _MORE_STEPS, _MEND_STEPS = 30, 50, 40
_RATE, _LATER_RATE = 0.15, 0.1
_SURVIVORS = 0.3
# Relocations that are tried side by side, of which the best counts: a fixed number, so that results do not hang on the cores.
_AT_ONCE = 2
# Views in every step.
_BATCH = 8
# Points nearer to a new plane than this share of the tree's radius are what it carries; planes tried for each.
_NEAR, _TRIALS = 0.08, 150
# Margin around what a billboard carries, as a share of the tree's radius.
_MARGIN = 0.06


@dataclass(frozen=True)
class _Candidate:
    cloud: BillboardCloud
    loss: float
    seed: int


def find_placement(views: ViewSet, points: Tensor, config: FitConfig, on_work: Callable[[int, int], None] | None = None) -> BillboardCloud:
    """Billboards placed where the tree is, with textures fitted at a low resolution.

    Clusterings of the points from different random starts, upright and free, are fitted for a few steps each in which billboards move with
    their textures; the best third goes on for longer; then the billboard that is missed least is taken away and put where the loss is
    largest, again and again, and stays there if that lowers the loss on the training views.

    Parameters
    ----------
    views : training views.
    points : on the tree, [P, 3] float64.
    config : resolved; ``billboards``, ``candidates``, ``relocations``, ``orientation`` and ``seed`` matter.
    on_work : told how much of the work is done, in candidates and relocations.

    Returns
    -------
    Float32 on the CPU; textures of :data:`SIDE` texels where the full resolution has as many as a view is wide.
    """
    return _Search(views, points, config, on_work or (lambda done, total: None)).best()


class _Search:
    def __init__(self, views: ViewSet, points: Tensor, config: FitConfig, on_work: Callable[[int, int], None]) -> None:
        self._config, self._points, self._on_work = (
            replace(config, ssim_weight=0.0, sharpness_weight=0.0, crispness_weight=0.0),
            points,
            on_work,
        )
        side = min(views.cameras.width, views.cameras.height)
        self._targets = Targets.at(views, max(0, round(math.log2(side / SIDE))))
        self._pictures = self._targets.pictures(range(len(views)))
        cameras = self._targets.cameras
        assert config.texel_density is not None
        self._density = float(pixels_a_metre(cameras)) * config.texel_density
        self._seen = seen_across(cameras)
        self._colours = point_colours(points, views, cameras, self._pictures)
        # One view after the other: of all at once the intermediate results take a gigabyte.
        pixels = [cameras[index].project(points).nan_to_num(nan=-1).round().clamp(-1, 1 << 20).int() for index in range(len(cameras))]
        self._pixels = torch.stack(pixels)  # [V, P, 2]
        self._radius = tree_radius(views)
        self._survivors = max(1, round(_SURVIVORS * config.candidates))
        self._done, self._total = 0, config.candidates + self._survivors + config.relocations

    def best(self) -> BillboardCloud:
        """See :func:`find_placement`."""
        config = self._config
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            first = sorted(self._tell(pool.map(self._candidate, range(config.candidates))), key=lambda candidate: candidate.loss)
            longer = pool.map(lambda one: self._fitted(one.cloud, _MORE_STEPS, _LATER_RATE, one.seed), first[: self._survivors])
            best = min(self._tell(longer), key=lambda candidate: candidate.loss)
            refused = 0
            for index in range(0, config.relocations, _AT_ONCE):
                several = range(index, min(index + _AT_ONCE, config.relocations))
                others = self._tell(pool.map(self._relocations_of(best, refused), several))
                refused = refused + _AT_ONCE if min(other.loss for other in others) >= best.loss else 0
                best = min(best, *others, key=lambda candidate: candidate.loss)
        return best.cloud

    def _tell(self, candidates: Iterable[_Candidate]) -> list[_Candidate]:
        """All candidates, with every one counted when it is there."""
        done = []
        for candidate in candidates:
            done.append(candidate)
            self._done += 1
            self._on_work(self._done, self._total)
        return done

    def _upright(self, index: int) -> bool:
        return self._config.orientation == "upright" or (self._config.orientation == "any" and index % 2 == 0)

    def _candidate(self, index: int) -> _Candidate:
        """Clusters from random start number ``index``, fitted a little."""
        assert self._config.billboards is not None
        generator = torch.Generator().manual_seed((self._config.seed << 16) + index)
        planes = cluster_planes(self._points, self._config.billboards, self._seen, upright=self._upright(index), generator=generator)
        return self._fitted(self._textured(self._points, self._colours, planes), _STEPS, _RATE, index)

    def _textured(self, points: Tensor, colours: Tensor, planes: Planes) -> BillboardCloud:
        bare = rectangles(points, planes, self._density, _MARGIN * self._radius, two_sided=self._config.sides == "two")
        return splatted(bare, points, colours, planes.labels).to(torch.float32)

    def _fitted(self, cloud: BillboardCloud, steps: int, rate: float, seed: int) -> _Candidate:
        """A candidate after some steps in which the billboards move with their textures."""
        config = self._config
        movement = Movement(cloud, self._radius) if config.placement_rate else None
        stepper = make_stepper(cloud.to(config.device), self._targets, config, movement)
        generator = torch.Generator().manual_seed((config.seed << 16) + seed)
        for step in range(steps):
            fall = 0.5 * (1 + math.cos(math.pi * step / steps))
            chosen = torch.randperm(len(self._targets.cameras), generator=generator)[:_BATCH].tolist()
            stepper.step(chosen, rate * fall, (config.placement_rate or 0.0) * fall)
        return _Candidate(stepper.cloud, float(self._losses(stepper.cloud).mean()), seed)

    def _losses(self, cloud: BillboardCloud) -> Tensor:
        """The loss of every pixel of every training view, [V, H, W]."""
        assert self._config.loss is not None
        device = self._config.device
        image = render(cloud.to(device), self._targets.cameras.to(device), backend=self._config.backend)
        return pixel_losses(image.cpu(), self._pictures, self._config.loss)

    def _relocations_of(self, best: _Candidate, refused: int) -> Callable[[int], _Candidate]:
        """Makes relocation number ``index`` of ``best``: a billboard that is little missed is taken to where the loss is large."""
        cloud = best.cloud
        without = [part(cloud, [k for k in range(len(cloud)) if k != dropped]) for dropped in range(len(cloud))]
        losses = [self._losses(rest) for rest in without]
        least_missed = torch.tensor([float(loss.mean()) for loss in losses]).argsort().tolist()

        def relocation(index: int) -> _Candidate:
            dropped = least_missed[(refused + index % _AT_ONCE) // 2 % min(3, len(cloud))]
            generator = torch.Generator().manual_seed((self._config.seed << 16) + index)
            added = self._proposal(losses[dropped], self._upright(index), generator)
            return self._fitted(joined(without[dropped], added), _MEND_STEPS, _LATER_RATE, index)

        return relocation

    def _proposal(self, losses: Tensor, upright: bool, generator: torch.Generator) -> BillboardCloud:
        """A billboard through points where the loss is large: of random planes (Fischler and Bolles 1981) that with most of it near."""
        views, height, width = losses.shape
        x, y = self._pixels.unbind(-1)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        flat = (torch.arange(views)[:, None] * height + y.clamp(0, height - 1)) * width + x.clamp(0, width - 1)
        weight = torch.where(inside, losses.flatten()[flat], 0).mean(0).clamp_min(1e-12).double()
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
        points, colours = self._points[held], self._colours[held]
        planes = Planes(normal[None], offset[None], torch.zeros(len(held), dtype=torch.int64), 0.0)
        return self._textured(points, colours, planes)


def part(cloud: BillboardCloud, kept: list[int]) -> BillboardCloud:
    """Some of the billboards of a cloud."""
    textures = cloud.textures()
    texels = [textures[k].reshape(-1, 4) for k in kept]
    others = {field.name: getattr(cloud, field.name)[kept] for field in fields(cloud) if field.name != "texels"}
    return BillboardCloud(**others, texels=torch.cat(texels) if texels else cloud.texels[:0])


def joined(a: BillboardCloud, b: BillboardCloud) -> BillboardCloud:
    """The billboards of two clouds."""
    return BillboardCloud(**{field.name: torch.cat([getattr(a, field.name), getattr(b, field.name)]) for field in fields(a)})
