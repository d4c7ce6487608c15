"""Crossed planes: upright planes through the tree's axis, each with the tree's picture as seen along its normal.

Asset tools make them for distant trees (Unity's ``createBillboard``, SpeedTree's billboards, crossed quads in games).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.blender.pictures import vertical_axis
from bbfit.checks import check_count
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rivals.baking import BakeConfig, Slabs, bake, tree_triangles
from bbfit.tree_files.tree_file import TreeFile

# Margin of a slab's depth on either side as a share of the tree's size, so that geometry on its border is visible.
_SLACK = 1e-4


def crossed_planes(
    tree: str | Path | TreeFile,
    count: int,
    config: BakeConfig,
    *,
    folder: str | Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> BillboardCloud:
    """N >= 1 upright billboards at k·180°/N degrees through the tree's axis, each showing all of the tree in parallel projection.

    The axis is the one that the views' cameras circle (``config.views.axis``). Billboard 0 faces the first view. Rectangles are cropped to
    their visible part. For everything else see ``bake``.
    """
    check_count("billboards", count)
    points = tree_triangles(tree).reshape(-1, 3)
    axis = vertical_axis(points.min(0), points.max(0), config.views.axis)
    slabs = Slabs.joined([upright_slabs(points, axis, degrees, 1) for degrees in np.arange(count) * 180.0 / count])
    # A plane through the axis instead of the middle of the slab.
    normals = torch.linalg.cross(slabs.rights, slabs.ups)
    ahead = ((axis - slabs.centers) * normals).sum(-1, keepdim=True)
    slabs = Slabs(slabs.centers + ahead * normals, slabs.rights, slabs.ups, slabs.half_extents, slabs.depths - ahead)
    return bake(tree, slabs, config, folder=folder, on_progress=on_progress)


def upright_slabs(points: NDArray[np.floating], axis: Tensor, azimuth_degrees: float, count: int) -> Slabs:
    """S parallel upright slabs of equal thickness that partition points, with planes in their middles, ordered from back to front.

    The points, [P, 3], are in meters. The normal has the given azimuth as in ``Orbit`` (0 is +Z, 90 is +X) about ``axis``, [3], which only
    decides which side is the front.
    """
    angle = math.radians(azimuth_degrees)
    right, up, normal = (
        np.array([math.cos(angle), 0.0, -math.sin(angle)]),
        np.array([0.0, 1.0, 0.0]),
        np.array([math.sin(angle), 0.0, math.cos(angle)]),
    )
    frame = np.stack([right, up, normal])
    local = (points - axis.numpy()) @ frame.T
    low, high = local.min(0), local.max(0)
    slack = _SLACK * float((high - low).max())
    thickness = max(float(high[2] - low[2]) / count, slack)
    middle = (low + high) / 2
    ahead = middle[2] + (np.arange(count) - (count - 1) / 2) * thickness
    offsets = np.stack([np.full(count, middle[0]), np.full(count, middle[1]), ahead], -1)
    depths = np.tile([-thickness / 2, thickness / 2], (count, 1))
    depths[0, 0] -= slack
    depths[-1, 1] += slack
    return Slabs(
        axis + torch.from_numpy(offsets @ frame),
        torch.from_numpy(np.tile(right, (count, 1))),
        torch.from_numpy(np.tile(up, (count, 1))),
        torch.from_numpy(np.tile((high - low)[:2] / 2, (count, 1))),
        torch.from_numpy(depths),
    )
