"""Changes of a placement: which billboards a cloud could have instead, by the points on the tree and by the losses."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bbfit.fitting.bark import facets
from bbfit.fitting.clusters import Planes, best_planes, cluster_planes, moments, rectangles, splatted, split_planes
from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.points import SeenPoints
from bbfit.fitting.trunk import crossed_planes, trunk_parts
from bbfit.geometry.cloud import BillboardCloud

Losses = Callable[[BillboardCloud], Tensor]
"""The loss of every pixel of every view, [V, H, W]."""
ADDITIONS, REFINEMENTS = 4, 4
"""Number of the clouds that :meth:`Moves.extended` and :meth:`Moves.refined` return."""
# Random planes that are scored for a new billboard. The plane takes the points within _NEAR times the tree's radius.
_NEAR, _PLANES = 0.08, 150
# Margin around the points of a billboard that is a slice through the whole tree, as a fraction of the tree's radius.
_SLICE_MARGIN = 0.06


class Moves:
    """Placements for points on a tree, and other placements made from them.

    All clouds are float32 on the CPU. Their textures show the points in their colors. ``radius`` is that of the tree in meters.
    ``generator`` makes all random choices but those of :meth:`clustered`.
    """

    def __init__(self, seen: SeenPoints, config: ResolvedFit, radius: float, generator: torch.Generator) -> None:
        self.seen, self._config, self._radius, self._generator = seen, config, radius, generator
        self._points, self._density = seen.places, seen.pixels_per_meter * config.texel_density
        self._locality = config.locality or 0.0
        self._all_upright, self._proposed = config.orientation == "upright", 0

    def clustered(self, index: int, count: int) -> BillboardCloud:
        """``count`` billboards: a clustering of the points from random start number ``index``."""
        generator = torch.Generator().manual_seed((self._config.seed << 16) + index)
        planes = cluster_planes(
            self._points, count, self.seen.projection, upright=self._upright(index), generator=generator, locality=self._locality
        )
        return self._textured(torch.arange(len(self._points)), planes)

    def crossed(self, members: Tensor, count: int) -> BillboardCloud:
        """``count`` upright billboards that cross in the trunk, whose points have the indices ``members``.

        Those of each of the trunk's parts (:func:`~bbfit.fitting.trunk.trunk_parts`) cross in its middle and are around all of its points.
        """
        billboards = []
        for part, number in trunk_parts(self._points[members], count):
            planes = crossed_planes(self._points[members[part]], number)
            billboards += [self._on_plane(members[part], *plane) for plane in zip(planes.normals, planes.offsets, strict=True)]
        return BillboardCloud.joined(billboards)

    def faceted(self, normals: Tensor, count: int) -> BillboardCloud:
        """At most ``count`` billboards on the surface of wood, for points on its bark with unit normals, [P, 3].

        See :func:`~bbfit.fitting.bark.facets`.
        """
        return self._textured(torch.arange(len(self._points)), facets(self._points, normals, count, self._generator))

    def extended(self, cloud: BillboardCloud, losses: Losses) -> list[BillboardCloud]:
        """Add one billboard to a cloud in :data:`ADDITIONS` ways: split a billboard, or place one where the loss is large."""
        weight = self._weights(losses(cloud))
        return [self.split(cloud, weight), *(self._with_another(cloud, weight) for _ in range(ADDITIONS - 1))]

    def refined(self, cloud: BillboardCloud, number: int, losses: Losses) -> list[BillboardCloud]:
        """Change a cloud in the :data:`REFINEMENTS` ways of refinement round ``number`` and keep the number of its billboards.

        Two move a billboard whose removal raises the loss little to where the loss is largest. One removes such a billboard and splits
        another. One merges two billboards whose points lie almost on one plane and places the spare one where the loss is largest.
        """
        if len(cloud) == 1:
            weight = self._weights(losses(cloud))
            return [self._proposal(weight) for _ in range(REFINEMENTS)]
        without = _without(cloud, losses)
        (first, first_losses), (second, second_losses) = (without[(2 * number + k) % min(4, len(without))] for k in range(2))
        weight = self._weights(first_losses)
        merged = self.merged(cloud, number)
        return [
            self._with_another(first, weight),
            self._with_another(second, self._weights(second_losses)),
            self.split(first, weight),
            self._with_another(merged, self._weights(losses(merged))),
        ]

    def nearest(self, cloud: BillboardCloud) -> Tensor:
        """Return the index of the billboard nearest to each point, [P].

        The distance is the displacement that views see when the point moves onto the plane and from there into the rectangle.
        """
        cloud = cloud.to(torch.float64)
        offset = self._points[:, None] - cloud.centers
        x, y = ((offset * axis).sum(-1).abs() for axis in (cloud.rights, cloud.ups))
        beyond = (torch.stack([x, y], -1) - cloud.half_extents).clamp_min(0)
        visible = ((cloud.normals @ self.seen.projection) * cloud.normals).sum(-1)
        return ((offset * cloud.normals).sum(-1).square() * visible + beyond.square().sum(-1)).argmin(-1)

    def split(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        """Replace a billboard by two. The billboard is chosen at random, by the sums of the weights of its points, float64 [P]."""
        nearest = self.nearest(cloud)
        losses = torch.zeros(len(cloud), dtype=weight.dtype).index_add_(0, nearest, weight)
        split = int(torch.multinomial(losses, 1, generator=self._generator))
        members = torch.nonzero(nearest == split)[:, 0]
        axes = torch.stack([cloud.normals[split], cloud.rights[split], cloud.ups[split]])
        planes = split_planes(self._points[members], axes, self.seen.projection, upright=self._all_upright, locality=self._locality)
        return BillboardCloud.joined([cloud.take(k for k in range(len(cloud)) if k != split), self._textured(members, planes)])

    def merged(self, cloud: BillboardCloud, number: int) -> BillboardCloud:
        """Replace two billboards by one. Rounds take turns with the three pairs whose merging adds least to the squared distances."""
        nearest, upright = self.nearest(cloud), self._all_upright
        sums = moments(self._points, nearest, len(cloud))
        pairs = torch.combinations(torch.arange(len(cloud)))
        normals, offsets, squares = best_planes(sums[pairs].sum(1), self.seen.projection, upright=upright)
        increase = squares - best_planes(sums, self.seen.projection, upright=upright)[2][pairs].sum(1)
        pair = int(increase.argsort()[number % min(3, len(pairs))])
        merged = torch.isin(torch.arange(len(cloud)), pairs[pair])
        members = torch.nonzero(merged[nearest])[:, 0]
        others = cloud.take(torch.nonzero(~merged)[:, 0].tolist())
        return BillboardCloud.joined([others, self._on_plane(members, normals[pair], offsets[pair])])

    def _with_another(self, cloud: BillboardCloud, weight: Tensor) -> BillboardCloud:
        return BillboardCloud.joined([cloud, self._proposal(weight)])

    def _upright(self, index: int) -> bool:
        return self._all_upright or (self._config.orientation == "any" and index % 2 == 1)

    def _weights(self, losses: Tensor) -> Tensor:
        """Average the losses of the pixels that show each point, float64 [P]."""
        weight = torch.zeros(len(self._points))
        for (index, inside), loss in zip(self.seen.pixels, losses, strict=True):
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
        visible = ((normals @ self.seen.projection) * normals).sum(-1).clamp_min(1e-12).sqrt()
        distance = (samples @ normals.mT - (normals * corners[:, 0]).sum(-1)) * visible
        score = torch.exp(-((distance / near) ** 2)).sum(0)
        best = int(torch.where(normals.norm(dim=-1) > 0.5, score, -1).argmax())  # collinear points define no plane
        normal, offset = normals[best], normals[best] @ corners[best, 0]
        members = torch.nonzero((self._points @ normal - offset).abs() * visible[best] < near)[:, 0]
        members = members[torch.multinomial(weight[members], min(2000, len(members)), replacement=True, generator=generator)]
        return self._on_plane(members, normal, offset)

    def _on_plane(self, members: Tensor, normal: Tensor, offset: Tensor) -> BillboardCloud:
        """Place one billboard on a plane around the points at the indices ``members``."""
        return self._textured(members, Planes(normal[None], offset[None], torch.zeros(len(members), dtype=torch.int64)))

    def _textured(self, members: Tensor, planes: Planes) -> BillboardCloud:
        """Place billboards on planes around the points at the indices ``members`` and splat the points into the textures."""
        points, colors = self._points[members], self.seen.colors[members]
        margin = (self._config.margin if self._locality else _SLICE_MARGIN) * self._radius
        without_textures = rectangles(points, planes, self._density, margin, two_sided=self._config.sides == "two")
        return splatted(without_textures, points, colors, planes.labels).to(torch.float32)


def _without(cloud: BillboardCloud, losses: Losses) -> list[tuple[BillboardCloud, Tensor]]:
    """Remove each billboard in turn. Return the clouds and their losses of every pixel, the least mean loss first."""
    clouds = [cloud.take(k for k in range(len(cloud)) if k != removed) for removed in range(len(cloud))]
    return sorted(((other, losses(other)) for other in clouds), key=lambda pair: float(pair[1].mean()))
