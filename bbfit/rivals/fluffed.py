"""Spherical normals: those of a ball around the crown, with which artists light foliage cards evenly ("fluffed" normals).

Modeling tools transfer them from a sphere or from a hull of the crown to the cards.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import texel_to_world


def fluffed(cloud: BillboardCloud) -> BillboardCloud:
    """Give a cloud with maps the normals of a ball; base color, occlusion and alpha stay.

    A normal points to its texel from the mean of all texels, weighted by their alpha. A normal texture holds no normals that point away
    from the viewer, so these are mirrored at the plane: what a viewer sees on the far side of the crown has the light of the near side.
    """
    assert cloud.surface is not None
    points, weights = torch.cat(_texel_centers(cloud)), cloud.texels[:, 3:]
    towards = normalize(points - (points * weights).sum(0) / weights.sum().clamp_min(1e-9), dim=-1)
    owners = torch.repeat_interleave(cloud.texture_sizes.prod(-1) * (1 + cloud.two_sided.long()))
    across = torch.stack([(towards * axes[owners]).sum(-1) for axes in (cloud.rights, cloud.ups)], -1)
    return replace(cloud, surface=torch.cat([(across + 1) / 2, cloud.surface[:, 2:]], -1))


def _texel_centers(cloud: BillboardCloud) -> list[Tensor]:
    """World points of the centers of all texels, front and back, of each billboard, [S * h * w, 3]."""
    centers = []
    for transform, (height, width), two_sided in zip(
        texel_to_world(cloud), cloud.texture_sizes.tolist(), cloud.two_sided.tolist(), strict=True
    ):
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        texels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).to(transform)
        centers.append((texels @ transform[:3].mT).repeat(1 + int(two_sided), 1))
    return centers
