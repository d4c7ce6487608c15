"""Projection of billboards into views, computed in float64."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import pixel_depth, signed_distance, texel_to_pixel
from bbfit.operators.drawing.reference import drawable

# Pixels added to each side of a billboard's box against rounding.
SLACK = 1.0


@dataclass(frozen=True)
class Projection:
    """N billboards in V views, as flat arrays."""

    to_texel: Tensor
    """Homographies from pixel centers to texel centers, float32 [V, N, 3, 3]. They are scaled so that the third coordinate of a pixel's
    image is the reciprocal of the depth (pinhole) or 1 (parallel projection). Differentiable in the placement."""
    nearness: Tensor
    """Rows whose product with a homogeneous pixel is the sort key of layers, float32 [V, N, 3]: the reciprocal of the depth (pinhole) or
    the negative depth (parallel projection)."""
    textures: Tensor
    """First texel of the texture that the view sees, its height and its width, int32 [V, N, 3]."""
    boxes: Tensor
    """First and last column, first and last row of pixels that can show a billboard, int32 [V, N, 4]; empty if it is not drawn."""
    rows_apart: Tensor
    """Distance in rows from which on two pixels read different texels for sure, int32 [V], at most ``height``."""
    width: int
    """Width of the picture in pixels."""
    height: int
    """Height of the picture in pixels."""
    orthographic: bool
    """Whether the views are parallel projections."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """Alpha mode."""
    groups: int = 1
    """Number of consecutive, equally large parts of the views that read disjoint texels."""
    least_pixels: int = 1 << 14
    """Least pixels in a band of rows for a CPU thread."""
    lanes: int = 16
    """Pixels that a CPU thread processes at a time, in vector registers; with 1 it processes a single pixel in all, as on CUDA."""

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def count(self) -> int:
        """Number N of billboards."""
        return self.boxes.shape[1]

    @cached_property
    def most_layers(self) -> int:
        """The largest number of billboards whose boxes have a pixel in common."""
        left, right, top, bottom = self.boxes.long().unbind(-1)
        drawn = ((left <= right) & (top <= bottom)).int()
        counts = self.boxes.new_zeros(len(self), self.height + 1, self.width + 1)
        view = torch.arange(len(self), device=counts.device)[:, None].expand_as(left)
        for sign, row, column in ((1, top, left), (-1, top, right + 1), (-1, bottom + 1, left), (1, bottom + 1, right + 1)):
            counts.index_put_((view, row, column), sign * drawn, accumulate=True)
        return int(counts.cumsum(1).cumsum(2).max()) if counts.numel() else 0

    def take(self, views: Tensor) -> Projection:
        """The projection into some of the views, int64 [B]."""
        per_view = ("to_texel", "nearness", "textures", "boxes", "rows_apart")
        return replace(self, **{name: getattr(self, name)[views] for name in per_view})

    def grouped(self, groups: int) -> Projection:
        """Each of ``groups`` equal parts of the billboards in views of its own: N / groups billboards in groups * V views."""
        if groups == 1:
            return self
        per_plane = ("to_texel", "nearness", "textures", "boxes")
        parts = {name: getattr(self, name).unflatten(1, (groups, -1)).transpose(0, 1).flatten(0, 1) for name in per_plane}
        return replace(self, **parts, rows_apart=self.rows_apart.repeat(groups), groups=groups)


def project(cloud: BillboardCloud, camera: Camera) -> Projection:
    """Project every billboard of a cloud into every view of a batch of cameras. The result is on the cloud's device."""
    placement = ("centers", "rights", "ups", "half_extents")
    cloud = replace(cloud, **{name: getattr(cloud, name).to(torch.float64) for name in placement})
    cameras = camera.batch().to(torch.float64)
    height, width = cameras.height, cameras.width
    visible = drawable(cloud, cameras)
    identity = torch.eye(3, dtype=torch.float64, device=visible.device)
    # Singular matrices are replaced before they are inverted, which keeps gradients finite.
    to_pixel = torch.where(visible[..., None, None], texel_to_pixel(cloud, cameras), identity)
    to_texel = torch.linalg.inv(to_pixel)
    if cameras.orthographic:
        numerator, denominator = pixel_depth(cloud, cameras)
        nearness = -numerator / torch.where(visible, denominator[..., 2], 1)[..., None]
    else:
        nearness = to_texel[..., 2, :]
    table = texture_table(cloud)
    first = table[:, 0] + torch.where(signed_distance(cloud, cameras).detach() >= 0, 0, table[:, 3])
    boxes, rows_apart = _extents(to_pixel.detach(), cloud.texture_sizes, visible, height, width)
    textures = torch.cat([first[..., None], table[:, 1:3].expand(*first.shape, 2)], -1)
    matrices, nearness = to_texel.to(torch.float32), nearness.detach().to(torch.float32)
    return Projection(matrices, nearness, textures, boxes, rows_apart, width, height, cameras.orthographic, cloud.alpha)


def texture_table(cloud: BillboardCloud) -> Tensor:
    """First texel, height and width of each texture, and the distance from there to the back's first texel, int32 [N, 4]."""
    area = cloud.texture_sizes.prod(-1)
    owned = area * (1 + cloud.two_sided.long())
    return torch.stack([owned.cumsum(0) - owned, *cloud.texture_sizes.unbind(-1), area * cloud.two_sided], -1).to(torch.int32)


def _extents(to_pixel: Tensor, sizes: Tensor, visible: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """``boxes`` and ``rows_apart`` of :class:`Projection`, for rectangles with a margin of one texel."""
    last = sizes.to(to_pixel).flip(-1)  # the margin reaches from texel -1 to texel w or h
    us = torch.stack([-torch.ones_like(last[:, 0]), last[:, 0]], -1)
    vs = torch.stack([-torch.ones_like(last[:, 1]), last[:, 1]], -1)
    one = torch.ones(len(sizes), 2, 2, dtype=to_pixel.dtype, device=to_pixel.device)
    corners = torch.stack([us[:, :, None] * one, vs[:, None, :] * one, one], -1).flatten(1, 2)  # [N, 4, 3]
    x, y, depth = (corners @ to_pixel.mT).unbind(-1)  # [V, N, 4]
    before, behind = (depth > 1e-9).all(-1), (depth <= 0).all(-1)
    whole = torch.tensor([0, width - 1, 0, height - 1], dtype=to_pixel.dtype, device=to_pixel.device)
    px, py = x / depth, y / depth
    box = torch.stack([px.amin(-1) - SLACK, px.amax(-1) + SLACK, py.amin(-1) - SLACK, py.amax(-1) + SLACK], -1)
    box = torch.where(before[..., None], box, whole).nan_to_num()
    box = torch.cat([box[..., :2].clamp(-1, width), box[..., 2:].clamp(-1, height)], -1)
    first, final = box[..., 0::2].ceil().clamp_min(0), torch.minimum(box[..., 1::2].floor(), whole[1::2])
    box = torch.stack([first, final], -1).flatten(-2)
    hidden = torch.tensor([1, 0, 1, 0], dtype=to_pixel.dtype, device=to_pixel.device)
    box = torch.where((visible & ~behind)[..., None], box, hidden)

    # Two pixels share a texel if both of their texel coordinates differ by less than 2. The numerator of dy/du = (y_u z - y z_u) / z^2 is
    # linear in v and independent of u, and vice versa for dy/dv. So its values at the corners and the least depth bound the slopes.
    y_row, z_row = to_pixel[..., None, 1, :], to_pixel[..., None, 2, :]
    slopes = (y_row[..., :2] * depth[..., None] - y[..., None] * z_row[..., :2]).abs().amax(-2)  # [V, N, 2]
    rows = 2 * slopes.sum(-1) / depth.amin(-1).square() + SLACK
    rows = torch.where(before, rows, height).nan_to_num(nan=height).clamp(1, height)
    rows = torch.where(visible & ~behind, rows, 1)
    apart = rows.amax(-1) if rows.shape[-1] else rows.new_ones(len(rows))
    return box.to(torch.int32), apart.ceil().to(torch.int32)
