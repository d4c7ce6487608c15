"""The corners of a billboard cloud's rectangles, and the bounds of its visible part."""

from __future__ import annotations

import torch
from torch import Tensor

from bbfit.checks import check_range, fail
from bbfit.geometry.cloud import BillboardCloud

_SIGNS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


def corners(cloud: BillboardCloud) -> Tensor:
    """The corners of a cloud's rectangles in order around each, from the lower left as seen from the front, [N, 4, 3] float64 in meters."""
    right, up = (cloud.rights * cloud.half_extents[:, :1]).double()[:, None], (cloud.ups * cloud.half_extents[:, 1:]).double()[:, None]
    across, upwards = torch.tensor(_SIGNS, dtype=torch.float64, device=cloud.centers.device)[..., None].unbind(1)
    return cloud.centers.double()[:, None] + across * right + upwards * up


def shown_bounds(cloud: BillboardCloud, *, spared: float = 0.0) -> Tensor:
    """Lowest and highest corner of a cloud's texels with at least half of the largest alpha, [2, 3] float64 in meters.

    The share ``spared`` of those texels may lie outside on each side of each axis, for stray texels. Raises ``InputError`` if the cloud has
    no billboards, or the share is not in [0, 0.5).
    """
    check_range("spared", spared, 0, 0.49)
    if not len(cloud):
        fail("cloud", "has no billboards, so there is nothing to show", "fit it with at least one")
    least, points = cloud.texels[:, 3].max() / 2, list[Tensor]()
    for textures, (first, right, _, left) in zip(cloud.textures(), corners(cloud), strict=True):
        height, width = textures.shape[1:3]
        row, column = torch.nonzero(textures[..., 3].amax(0) >= least).double().unbind(-1)
        points.append(first + ((column + 0.5) / width)[:, None] * (right - first) + (1 - (row + 0.5) / height)[:, None] * (left - first))
    shown = torch.cat(points).sort(0).values
    beyond = int(spared * len(shown))
    return torch.stack([shown[beyond], shown[len(shown) - 1 - beyond]])
