"""Coarse to fine: views and textures at a fraction of their resolution (Burt and Adelson 1983, for pictures; here also for textures)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, unpremultiply
from bbfit.views.view_set import ViewSet

LEAST_SIDE = 16
"""Least side of the pictures of a level, in pixels. Coarser levels are skipped."""


@dataclass(frozen=True)
class Targets:
    """Training views at one resolution."""

    cameras: Camera
    """V cameras at that resolution."""
    views: ViewSet
    """The views at full resolution."""
    shrunk: Tensor | None
    """Premultiplied RGBA, uint8 [V, H, W, 4], or ``None`` at full resolution, which is read from ``views``."""

    @staticmethod
    def at(views: ViewSet, halvings: int) -> Targets:
        """Shrink views by a factor of ``2 ** halvings`` along each side. Each pixel is the mean of the pixels that it covers."""
        if halvings == 0:
            return Targets(views.cameras, views, None)
        width, height = (max(1, round(side / 2**halvings)) for side in (views.cameras.width, views.cameras.height))
        shrunk = torch.empty(len(views), height, width, 4, dtype=torch.uint8)

        def shrink(index: int) -> None:
            picture = views.image(index).float()
            picture[..., :3] *= picture[..., 3:] / 255  # in place, to save memory with many large pictures
            shrunk[index] = interpolate(picture.permute(2, 0, 1)[None], (height, width), mode="area")[0].permute(1, 2, 0).round()

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # each thread has memory of its own
            list(pool.map(shrink, range(len(views))))
        return Targets(views.cameras.resized(width, height), views, shrunk)

    def packed(self, indices: Sequence[int]) -> Tensor:
        """Return the pictures at B indices, uint8 [B, H, W, 4], with straight alpha at full resolution and premultiplied otherwise."""
        pictures = [self.views.image(i) if self.shrunk is None else self.shrunk[i] for i in indices]
        # numpy instead of torch: torch would wake its threads, which then spin on the cores that the kernels need next.
        return torch.from_numpy(np.stack([picture.numpy() for picture in pictures]))

    def pictures(self, indices: Sequence[int]) -> Tensor:
        """Return the pictures at B indices as premultiplied RGBA in [0, 1], float32 [B, H, W, 4]."""
        return self.views.targets(indices) if self.shrunk is None else self.shrunk[list(indices)].float() / 255


def resize_textures(cloud: BillboardCloud, sizes: Tensor) -> BillboardCloud:
    """Resize the textures of a cloud to heights and widths, int64 [N, 2], and filter them as premultiplied colors.

    The colors of fully transparent texels are filtered as straight colors, because the next level of a fit starts from them.
    """
    textures = [_resized(texture, size).reshape(-1, 4) for texture, size in zip(cloud.textures(), sizes.tolist(), strict=True)]
    return replace(cloud, texture_sizes=sizes, texels=torch.cat(textures))


def _resized(texture: Tensor, size: list[int]) -> Tensor:
    """Resize the textures of one billboard, [S, h, w, 4], to a height and width."""
    shrinks = size[0] <= texture.shape[1] and size[1] <= texture.shape[2]
    both = torch.cat([premultiply(texture), texture], -1).permute(0, 3, 1, 2)
    both = interpolate(both, size, mode="area" if shrinks else "bilinear").permute(0, 2, 3, 1)
    return torch.where(both[..., 3:4] > 1e-3, unpremultiply(both[..., :4]), both[..., 4:])


def resampled(cloud: BillboardCloud, onto: BillboardCloud, sizes: Tensor) -> BillboardCloud:
    """Resample the textures of N billboards to new heights and widths, int64 [N, 2], onto other rectangles in the same planes.

    The rectangles of ``onto`` have the axes of ``cloud``; their centers and extents may differ. The filter is that of
    :func:`resize_textures`. A texture continues beyond its border as transparent texels of the border's color.
    """
    if torch.equal(cloud.centers, onto.centers) and torch.equal(cloud.half_extents, onto.half_extents):
        return resize_textures(cloud, sizes)
    textures = []
    for n, (texture, size) in enumerate(zip(cloud.textures(), sizes.tolist(), strict=True)):
        scale = onto.half_extents[n] / cloud.half_extents[n]
        ratio = torch.tensor(texture.shape[1:3]) * scale.flip(0) / torch.tensor(size)  # old texels per new texel, down and across
        if float(ratio.amax()) > 1:
            coarse = [max(1, round(count / max(1.0, float(r)))) for count, r in zip(texture.shape[1:3], ratio, strict=True)]
            texture = _resized(texture, coarse)
        shift = onto.centers[n] - cloud.centers[n]
        across = torch.stack([shift @ cloud.rights[n], -shift @ cloud.ups[n]]) / cloud.half_extents[n]  # new center, in [-1, 1]
        steps = [(2 * torch.arange(count, dtype=torch.float64) + 1) / count - 1 for count in size]
        grid = torch.stack(torch.meshgrid(across[1] + scale[1] * steps[0], across[0] + scale[0] * steps[1], indexing="ij")[::-1], -1)
        grid = grid[None].expand(len(texture), -1, -1, -1).to(texture)
        both = torch.cat([premultiply(texture), texture], -1).permute(0, 3, 1, 2)
        inside = grid_sample(both[:, :4], grid, padding_mode="zeros", align_corners=False).permute(0, 2, 3, 1)
        beyond = grid_sample(both[:, 4:7], grid, padding_mode="border", align_corners=False).permute(0, 2, 3, 1)
        plain = torch.cat([beyond, inside[..., 3:]], -1)
        textures.append(torch.where(inside[..., 3:] > 1e-3, unpremultiply(inside), plain).reshape(-1, 4))
    return replace(onto, texture_sizes=sizes, texels=torch.cat(textures))


def shrunk_sizes(cloud: BillboardCloud, halvings: int) -> Tensor:
    """Divide the texture heights and widths of a cloud by ``2 ** halvings``, rounded up, int64 [N, 2]."""
    return -(-cloud.texture_sizes // 2**halvings)
