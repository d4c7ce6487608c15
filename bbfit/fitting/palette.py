"""A palette for all texels of a cloud: PNG files of at most 256 colors store one byte a texel instead of four."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.fitting.config import TRANSPARENT_COLORS
from bbfit.geometry.alpha import VISIBLE, AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, unpremultiply

# Texels that the palette is chosen from, those among them that the first colors are, iterations, and the seed of the choice.
_SAMPLE, _FIRST, _ITERATIONS, _SEED = 40_000, 8_000, 12, 0
# Of a mask's alpha, differences count within so much of the cutoff, where edges are.
_EDGE = 0.25
# Steps from the darkest to the brightest occlusion.
_OCCLUSIONS = 63


def palettized(cloud: BillboardCloud, count: int) -> BillboardCloud:
    """Give the texels of a cloud few different values of color and alpha, so that a palette of ``count`` colors holds them.

    With 0 the cloud is returned as it is. The values are those of :func:`few_colors`. All texels are rounded to 8 bits. Maps get few
    values too (:func:`few_surfaces`), so that palettes hold normals and occlusion.
    """
    if not count:
        return cloud
    surface = None if cloud.surface is None else few_surfaces(cloud, count)
    return replace(cloud, texels=few_colors(cloud.texels, cloud.alpha, count), surface=surface)


def few_colors(texels: Tensor, alpha: AlphaMode, count: int) -> Tensor:
    """Round straight-alpha texels in [0, 1], [P, 4], to 8 bits and to few different values of color and alpha.

    :data:`~bbfit.fitting.config.TRANSPARENT_COLORS` of the ``count`` colors are left to transparent texels, so ``count`` is larger. The
    values are the means of clusters of visible texels by k-means (Lloyd 1982; start by Arthur and Vassilvitskii 2007), of the quantity
    whose squared differences a viewer sees in an alpha mode (:func:`_seen`). Transparent texels are only rounded.

    Neighboring leaves differ by more than neighboring colors of the palette do, so that no bands show, and no dithering is needed.
    """
    rounded, visible = (texels * 255).round() / 255, torch.nonzero(texels[:, 3] >= VISIBLE)[:, 0]
    if len(visible) == 0:
        return rounded
    straight = texels[visible].detach().cpu().float()
    seen = _seen(straight, alpha)
    means = _clustered(seen, count - TRANSPARENT_COLORS)
    labels = vq(seen, means)[0]
    palette = unpremultiply(_means(premultiply(straight), labels, torch.zeros(len(means), 4)))
    palette = (palette * 255).round().clamp(min=torch.tensor([0.0, 0.0, 0.0, 1.0])) / 255
    return rounded.index_copy(0, visible.to(texels.device), palette[labels].to(texels))


def few_surfaces(cloud: BillboardCloud, count: int) -> Tensor:
    """Round the maps of a cloud, [P, 4], so that the pictures of their normals and of their occlusion have few colors and compress well.

    Normals get ``count`` - 1 different values, which leaves one to the gaps of an atlas: the means of clusters by k-means of those of
    visible texels. Occlusion is rounded to 6 bits. Of a translucent cloud, pairs of occlusion and translucency, which share a picture, get
    ``count`` - 1 values in the same way.
    """
    assert cloud.surface is not None
    visible, across = cloud.texels[:, 3] >= VISIBLE, cloud.surface[:, :2]
    if visible.any():
        normals = nearest_means(cloud.tangent_normals, visible, count - 1)
        across = ((normalize(normals, dim=-1)[:, :2] + 1) / 2).clamp(0, 1).to(across)
    if cloud.translucent and visible.any():
        return torch.cat([across, nearest_means(cloud.surface[:, 2:], visible, count - 1).to(across)], 1)
    occlusion = (cloud.surface[:, 2:3] * _OCCLUSIONS).round() / _OCCLUSIONS
    return torch.cat([across, occlusion, cloud.surface[:, 3:]], 1)


def nearest_means(points: Tensor, chosen: Tensor, count: int) -> Tensor:
    """Points, [P, C], each moved to the nearest mean of at most ``count`` clusters (k-means) of those that ``chosen``, [P], selects.

    The result is float32 [P, C]. At least one point must be chosen.
    """
    values = points.float().numpy()
    means = _clustered(values[chosen.numpy()], count)
    return torch.from_numpy(means[vq(values, means)[0]])


def _clustered(points: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """The means of at most ``count`` clusters of points, [P, C], from a sample of them."""
    generator = np.random.default_rng(_SEED)
    sample = points[generator.permutation(len(points))[:_SAMPLE]]
    # Choosing the first means takes longest. Those of a part of the sample end in equally good clusters, if there are colors enough.
    first = sample if len(np.unique(sample, axis=0)) <= count else sample[:_FIRST]
    means, _ = kmeans2(first, min(count, len(np.unique(first, axis=0))), iter=1, minit="++", rng=generator)
    for _ in range(_ITERATIONS):
        means = _means(torch.from_numpy(sample), vq(sample, means)[0], torch.from_numpy(means)).numpy()
    return means


def _means(points: Tensor, labels: NDArray[np.int32], otherwise: Tensor) -> Tensor:
    """The means of the points, [P, C], of each cluster, and those of ``otherwise``, [K, C], for clusters without points."""
    index, count = torch.from_numpy(labels).long(), len(otherwise)
    number = torch.bincount(index, minlength=count)[:, None]
    sums = torch.zeros(count, points.shape[1], dtype=torch.float64).index_add_(0, index, points.double())
    return torch.where(number > 0, sums / number.clamp_min(1), otherwise.double()).to(points.dtype)


def _seen(texels: Tensor, alpha: AlphaMode) -> NDArray[np.float32]:
    """What a viewer sees of straight-alpha texels, [P, 4], as points whose squared distances are squared differences of pictures.

    A blended layer of premultiplied color c and alpha a over a gray background b shows c + (1 - a) b. For b uniform in [0, 1], the mean
    squared difference of two layers in one channel is (dc - da / 2)^2 + da^2 / 12. A mask shows the straight color where alpha reaches the
    cutoff, and its edges depend on alpha near the cutoff.
    """
    if alpha.kind == "mask":
        edge = ((texels[:, 3:] - alpha.cutoff) / _EDGE).tanh() * _EDGE
        return torch.cat([texels[:, :3] * (texels[:, 3:] / alpha.cutoff).clamp(max=1), edge], 1).numpy()
    color, opaque = texels[:, :3] * texels[:, 3:], texels[:, 3:]
    return torch.cat([color - opaque / 2, opaque / 2], 1).numpy()
