"""The cloud that a fit starts from: where the billboards stand, how large they are, how many texels they own."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.fitting.bounds import facing_view_bounds, silhouette_bounds
from bbfit.fitting.config import FitConfig
from bbfit.geometry.camera import Camera, convergence_point
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.views import ViewSet

# Distance between the rectangles of a pair, as a share of their half width: "a very small distance" (thesis, section 6.4).
PAIR_GAP = 2e-3


def start_cloud(views: ViewSet, config: FitConfig) -> BillboardCloud:
    """Evenly turned upright billboards through the tree's axis with seeded random textures, float32 on the CPU.

    The axis is the vertical line through the point that the cameras converge on. Unbounded billboards fill the viewport of a camera
    that faces them (thesis, sections 4.2 and 6.3).
    """
    camera, config = views.cameras, config.resolve()
    assert config.billboards is not None and config.texel_density is not None
    axis, focal = convergence_point(camera), pixels_a_metre(camera)
    density = config.texel_density * focal
    size = torch.tensor([camera.height, camera.width])
    sides = config.sides
    planes = even_upright(
        config.billboards,
        axis=axis,
        half_extents=size.flip(0) / focal / 2,
        texture_sizes=_at_least_one(size * config.texel_density),
        sides=sides,
        gap=PAIR_GAP * float(camera.width / focal / 2),
    )
    if config.bounds != "viewport":
        if config.bounds == "thesis":
            bounds = facing_view_bounds(planes, views, pairs=sides == "pair")
        else:
            bounds = silhouette_bounds(planes, views)
        planes = bounded(planes, bounds, density)
    return random_textures(planes.to(torch.float32), planes.texture_sizes, config.seed)


def pixels_a_metre(camera: Camera) -> Tensor:
    """Pixels that a metre takes up where the tree's axis is seen face on, a scalar."""
    focal = camera.intrinsics[:, 0, 0].mean()
    return focal if camera.orthographic else focal / (camera.position - convergence_point(camera)).norm(dim=-1).mean()


def tree_radius(views: ViewSet) -> float:
    """Root mean square distance of the tree from its middle, in metres, as some views show it; as deep as it is wide."""
    alphas = torch.stack([views.image(i)[..., 3].double() for i in range(0, len(views), max(1, len(views) // 8))])
    spread = 0.0
    for weights, share in ((alphas.sum(1), 2.0), (alphas.sum(2), 1.0)):
        weights = weights / weights.sum(-1, keepdim=True)
        at = torch.arange(weights.shape[1], dtype=torch.float64)
        spread += share * float(((weights * at.square()).sum(-1) - (weights * at).sum(-1).square()).mean())
    return math.sqrt(spread) / float(pixels_a_metre(views.cameras))


def random_textures(cloud: BillboardCloud, sizes: Tensor, seed: int) -> BillboardCloud:
    """The same rectangles with random textures of the given sizes, int64 [N, 2]."""
    count = int((sizes.prod(-1) * (1 + cloud.two_sided.long())).sum())
    texels = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed))
    return replace(cloud, texture_sizes=sizes, texels=texels)


def bounded(planes: BillboardCloud, bounds: Tensor, texels_a_metre: Tensor) -> BillboardCloud:
    """Cut billboards down to ``bounds`` ([N, 4] left, right, bottom, top in metres from their centres), textures transparent.

    Each keeps the texels that it covers: square ones, ``texels_a_metre`` to the metre, the rectangle rounded up to whole texels.
    """
    left, right, bottom, top = bounds.unbind(-1)
    size = _at_least_one(torch.stack([top - bottom, right - left], -1) * texels_a_metre)
    middle = torch.stack([left + right, bottom + top], -1) / 2
    texels = int((size.prod(-1) * (1 + planes.two_sided.long())).sum())
    return replace(
        planes,
        centers=planes.centers + middle[:, :1] * planes.rights + middle[:, 1:] * planes.ups,
        half_extents=size.flip(-1) / texels_a_metre / 2,
        texture_sizes=size,
        texels=torch.zeros(1, 4, dtype=planes.texels.dtype).expand(texels, 4),
    )


def _at_least_one(size: Tensor) -> Tensor:
    return size.ceil().long().clamp_min(1)
