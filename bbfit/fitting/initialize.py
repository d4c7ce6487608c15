"""The initial cloud of a fit: placement, size and texture sizes of the billboards."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.checks import fail
from bbfit.fitting.bounds import facing_view_bounds, silhouette_bounds
from bbfit.fitting.config import EVEN, FitConfig
from bbfit.geometry.camera import Camera, convergence_point
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.views.view_set import ViewSet

# Distance between the rectangles of a pair, as a fraction of their half width: "a very small distance" (thesis, section 6.4).
PAIR_GAP = 2e-3


def start_cloud(views: ViewSet, config: FitConfig) -> BillboardCloud:
    """Place upright billboards at equal angles through the tree's axis, with random textures, float32 on the CPU.

    The axis is the vertical line through the point that the cameras converge on. With the bounds ``viewport``, billboards fill the picture
    of a camera that faces them (thesis, sections 4.2 and 6.3).
    """
    camera, resolved = views.cameras, config.resolve()
    axis, focal = convergence_point(camera), pixels_per_meter(camera)
    density = resolved.texel_density * float(focal)
    size = torch.tensor([camera.height, camera.width])
    planes = even_upright(
        resolved.billboards or EVEN,
        axis=axis,
        half_extents=size.flip(0) / focal / 2,
        texture_sizes=_at_least_one(size * resolved.texel_density),
        sides=resolved.sides,
        gap=PAIR_GAP * float(camera.width / focal / 2),
    )
    if resolved.bounds == "thesis":
        planes = bounded(planes, facing_view_bounds(planes, views, pairs=resolved.sides == "pair"), density, resolved.max_texels)
    elif resolved.bounds == "silhouette":
        planes = bounded(planes, silhouette_bounds(planes, views), density, resolved.max_texels)
    elif resolved.max_texels is not None:
        planes = sized(planes, density, resolved.max_texels)
    return random_textures(planes.to(torch.float32), planes.texture_sizes, resolved.seed)


def pixels_per_meter(camera: Camera) -> Tensor:
    """Compute the pixels per meter at the tree's axis, perpendicular to the viewing direction, a scalar."""
    focal = camera.intrinsics[:, 0, 0].mean()
    return focal if camera.orthographic else focal / (camera.position - convergence_point(camera)).norm(dim=-1).mean()


def tree_radius(views: ViewSet) -> float:
    """Estimate the root mean square distance of the tree from its center in meters, from a few views, as if as deep as wide."""
    shown = [i for i in range(0, len(views), max(1, len(views) // 8)) if views.shows(i)] or list(filter(views.shows, range(len(views))))
    alphas = torch.stack([views.image(i)[..., 3].double() for i in shown])
    variance = 0.0
    for weights, dimensions in ((alphas.sum(1), 2.0), (alphas.sum(2), 1.0)):
        weights = weights / weights.sum(-1, keepdim=True)
        pixel = torch.arange(weights.shape[1], dtype=torch.float64)
        variance += dimensions * float(((weights * pixel.square()).sum(-1) - (weights * pixel).sum(-1).square()).mean())
    return math.sqrt(variance) / float(pixels_per_meter(views.cameras))


def random_textures(cloud: BillboardCloud, sizes: Tensor, seed: int) -> BillboardCloud:
    """Give a cloud random textures of the given heights and widths, int64 [N, 2]."""
    count = int((sizes.prod(-1) * (1 + cloud.two_sided.long())).sum())
    texels = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed))
    return replace(cloud, texture_sizes=sizes, texels=texels)


def bounded(planes: BillboardCloud, bounds: Tensor, texels_per_meter: float, max_texels: int | None = None) -> BillboardCloud:
    """Resize N billboards to bounds, [N, 4], and allocate their textures as :func:`sized` does.

    The bounds are left, right, bottom and top along the billboards' axes from their centers, in meters.
    """
    left, right, bottom, top = bounds.unbind(-1)
    middle, sides = torch.stack([left + right, bottom + top], -1) / 2, torch.stack([right - left, top - bottom], -1)
    centers = planes.centers + middle[:, :1] * planes.rights + middle[:, 1:] * planes.ups
    return sized(replace(planes, centers=centers, half_extents=sides / 2), texels_per_meter, max_texels)


def sized(cloud: BillboardCloud, texels_per_meter: float, max_texels: int | None = None) -> BillboardCloud:
    """Give billboards transparent textures with square texels, and round the rectangles up to whole texels.

    The texels per meter along each side are lowered if ``max_texels``, the most texels of all billboards together, requires it. Raises
    InputError if there are more textures than ``max_texels`` allows texels.
    """
    sides = 1 + cloud.two_sided.long()
    if max_texels is not None and max_texels < int(sides.sum()):
        fail("max_texels", f"{max_texels} are too few for {int(sides.sum())} textures", "allow more")
    while True:
        sizes = _at_least_one(2 * cloud.half_extents * texels_per_meter).flip(-1)
        count = int((sizes.prod(-1) * sides).sum())
        if max_texels is None or count <= max_texels:
            break
        texels_per_meter *= min(0.995, math.sqrt(max_texels / count))
    half_extents = sizes.flip(-1).to(cloud.half_extents) / texels_per_meter / 2
    return replace(cloud, half_extents=half_extents, texture_sizes=sizes, texels=cloud.texels.new_zeros(1, 4).expand(count, 4))


def _at_least_one(size: Tensor) -> Tensor:
    return size.ceil().long().clamp_min(1)
