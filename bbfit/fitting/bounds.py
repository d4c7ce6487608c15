"""Bounding billboards by what the views show, with OpenCV's bounding rectangles and convex hulls."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.views import ViewSet

# Views that meet a billboard more obliquely than this say nothing useful about its extent.
_OBLIQUE = math.cos(math.radians(60))
# Alpha from which a texel counts as being something.
_OPAQUE = 0.3
# Alpha that does not round to 0 in 8 bits.
_VISIBLE = 0.5 / 255
# Billboards whose cosines differ by less face a view equally well.
_TIE = 1e-3


def facing(camera: Camera, normals: Tensor, target: Tensor) -> Tensor:
    """Cosines between billboard normals and the directions towards each camera, [V, N]; 1 is face on."""
    towards = -camera.forward if camera.orthographic else torch.nn.functional.normalize(camera.position - target, dim=-1)
    return towards @ normals.mT


def facing_view_bounds(planes: BillboardCloud, views: ViewSet, *, pairs: bool) -> Tensor:
    """Bounds of every billboard in the one view that faces it best (thesis, section 6.3).

    Parameters
    ----------
    planes : billboards through a common center, of any extent.
    pairs : whether odd entries are the backs of pairs, which face the other way.

    Returns
    -------
    [N, 4] left, right, bottom, top in meters along the billboard's axes from its center.
    """
    cosines = facing(views.cameras, planes.normals, planes.centers[0])
    if pairs:
        cosines = cosines * torch.tensor([1.0, -1.0]).repeat(len(planes) // 2)
    best = cosines.argmax(0).tolist()
    return torch.stack([_bounds_on_plane(planes, n, views.cameras[view], _box(views, view)) for n, view in enumerate(best)])


def silhouette_bounds(planes: BillboardCloud, views: ViewSet) -> Tensor:
    """Bounds such that in every view the billboard that faces it best covers the whole silhouette.

    Nothing of the tree is then cut off in any training view. Views more than 60 degrees off every billboard's normal (from above, say)
    are covered only as far as the others reach. Same return as :func:`facing_view_bounds`.
    """
    cosines = facing(views.cameras, planes.normals, planes.centers[0]).abs()
    bounds = torch.tensor([math.inf, -math.inf, math.inf, -math.inf], dtype=planes.centers.dtype).repeat(len(planes), 1)
    for view, row in enumerate(cosines):
        outline = _outline(views, view)
        # A view halfway between two billboards counts for both, as it does for both rectangles of a pair.
        for n in torch.nonzero((row > row.max() - _TIE) & (row > _OBLIQUE))[:, 0].tolist():
            bounds[n] = _union(bounds[n], _bounds_on_plane(planes, n, views.cameras[view], outline))
    seen = bounds[:, 0].isfinite()
    if not seen.any():  # only oblique views: fall back to the best there is
        return facing_view_bounds(planes, views, pairs=False)
    widest = torch.stack([bounds[seen, 0].amin(), bounds[seen, 1].amax(), bounds[seen, 2].amin(), bounds[seen, 3].amax()])
    return torch.where(seen[:, None], bounds, widest)


def opaque_bounds(cloud: BillboardCloud) -> Tensor:
    """Bounds of what is not transparent in each billboard's textures; same return as :func:`facing_view_bounds`.

    A margin of two texels is left around it. Where it reaches the border of the texture there may be more beyond, so the bounds then grow
    by a tenth of the side. A billboard without anything on it keeps its bounds.
    """
    bounds = []
    for n, texture in enumerate(cloud.textures()):
        mask = (texture[..., 3].amax(0) > _OPAQUE).numpy().astype(np.uint8)
        x, y, width, height = cv2.boundingRect(mask)
        sides = torch.tensor([mask.shape[1], mask.shape[0]])
        if not width:
            bounds.append(
                torch.stack([-cloud.half_extents[n, 0], cloud.half_extents[n, 0], -cloud.half_extents[n, 1], cloud.half_extents[n, 1]])
            )
            continue
        low, high = torch.tensor([x, y]), torch.tensor([x + width, y + height])
        spare = (sides / 10).ceil().clamp_min(2)
        low = torch.where(low < 1, low - spare, (low - 2).clamp_min(0))
        high = torch.where(high > sides - 1, high + spare, torch.minimum(high + 2, sides))
        meters = (torch.stack([low, high]) / sides * 2 - 1) * cloud.half_extents[n]
        bounds.append(torch.stack([meters[0, 0], meters[1, 0], -meters[1, 1], -meters[0, 1]]))
    return torch.stack(bounds)


def trimmed(cloud: BillboardCloud) -> BillboardCloud:
    """The same picture with rectangles cut, texel by texel, to what eight bits of alpha show of them, and a margin of one texel.

    Billboards that show nothing are left out, but for one if none shows anything.
    """
    shown = [n for n, texture in enumerate(cloud.textures()) if (texture[..., 3] >= _VISIBLE).any()]
    if len(shown) < len(cloud):
        cloud = cloud.take(shown or [0])
    parts, middles, texels, sizes = [], [], [], []
    for texture in cloud.textures():
        mask = (texture[..., 3].amax(0) >= _VISIBLE).numpy().astype(np.uint8)
        x, y, width, height = cv2.boundingRect(mask)
        left, top = max(x - 1, 0), max(y - 1, 0)
        right, bottom = min(x + width + 1, mask.shape[1]), min(y + height + 1, mask.shape[0])
        if not width:
            left, top, right, bottom = 0, 0, 1, 1
        parts.append([(right - left) / mask.shape[1], (bottom - top) / mask.shape[0]])
        middles.append([(left + right) / mask.shape[1] - 1, 1 - (top + bottom) / mask.shape[0]])
        sizes.append([bottom - top, right - left])
        texels.append(texture[:, top:bottom, left:right].reshape(-1, 4))
    middle = torch.tensor(middles, dtype=cloud.centers.dtype) * cloud.half_extents
    return replace(
        cloud,
        centers=cloud.centers + middle[:, :1] * cloud.rights + middle[:, 1:] * cloud.ups,
        half_extents=cloud.half_extents * torch.tensor(parts, dtype=cloud.half_extents.dtype),
        texture_sizes=torch.tensor(sizes),
        texels=torch.cat(texels),
    )


def _union(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(torch.tensor([True, False, True, False]), torch.minimum(a, b), torch.maximum(a, b))


def _outline(views: ViewSet, view: int) -> Tensor:
    """Corners of the convex hull of a view's pixels with alpha > 0, in pixel coordinates of pixel *edges*, [P, 2] float64."""
    mask = (views.image(view)[..., 3] > 0).numpy().astype(np.uint8)
    centers = torch.from_numpy(cv2.convexHull(cv2.findNonZero(mask))[:, 0]).double()
    to_edges = torch.tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]], dtype=torch.float64)
    return (centers[:, None] + to_edges).flatten(0, 1)


def _box(views: ViewSet, view: int) -> Tensor:
    """Corners of the bounding rectangle of a view's alpha > 0, as :func:`_outline`."""
    mask = (views.image(view)[..., 3] > 0).numpy().astype(np.uint8)
    x, y, width, height = cv2.boundingRect(mask)
    return torch.tensor([[x, y], [x + width, y], [x + width, y + height], [x, y + height]], dtype=torch.float64) - 0.5


def _bounds_on_plane(planes: BillboardCloud, n: int, camera: Camera, pixels: Tensor) -> Tensor:
    """Bounds of pixels, [P, 2], projected through one camera onto plane ``n``: left, right, bottom, top, [4]."""
    point = torch.stack([planes.rights[n], planes.ups[n], planes.centers[n]], -1)
    plane_to_world = torch.cat([point, torch.tensor([[0.0, 0.0, 1.0]], dtype=point.dtype)])
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], -1)
    on_plane = homogeneous @ torch.linalg.inv(camera.world_to_pixel @ plane_to_world).mT
    coordinates = on_plane[:, :2] / on_plane[:, 2:]
    (left, bottom), (right, top) = coordinates.amin(0), coordinates.amax(0)
    return torch.stack([left, right, bottom, top])


def smallest_rectangle(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Center, unit axis along its width, half width and height, [2] each, of the smallest rectangle around points of a plane, [P, 2].

    It is turned only if that makes it a fifth smaller, and then by 45 degrees at most.
    """
    low, high = points.amin(0), points.amax(0)
    upright = torch.tensor([1.0, 0.0], dtype=points.dtype)
    (x, y), (width, height), degrees = cv2.minAreaRect(points.float().numpy())
    if width * height >= 0.8 * float((high - low).prod()):
        return (low + high) / 2, upright, (high - low) / 2
    while abs(degrees) > 45:
        width, height, degrees = height, width, degrees - math.copysign(90, degrees)
    turn = math.radians(degrees)
    axis = torch.tensor([math.cos(turn), math.sin(turn)], dtype=points.dtype)
    return torch.tensor([x, y], dtype=points.dtype), axis, torch.tensor([width / 2, height / 2], dtype=points.dtype)
