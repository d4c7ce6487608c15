"""Bounds of billboards, from the silhouettes in the views or from opaque texels, by OpenCV's bounding rectangles and convex hulls."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from bbfit.geometry.alpha import VISIBLE
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.views.view_set import ViewSet

# Least cosine between a billboard's normal and a view. More oblique views do not determine the extent of a billboard well.
_OBLIQUE = math.cos(math.radians(60))
# Least alpha of a texel that bounds include.
_OPAQUE = 0.3
# Billboards whose cosines differ by less than this face a view equally well.
_TIE = 1e-3


def facing_cosines(camera: Camera, normals: Tensor, target: Tensor) -> Tensor:
    """Compute the cosines between billboard normals, [N, 3], and the directions from a target, [3], to each camera, [V, N]."""
    towards = -camera.forward if camera.orthographic else torch.nn.functional.normalize(camera.position - target, dim=-1)
    return towards @ normals.mT


def facing_view_bounds(planes: BillboardCloud, views: ViewSet, *, pairs: bool) -> Tensor:
    """Bound every billboard by the silhouette in the view that it faces best (thesis, section 6.3).

    The billboards, of any extent, have a common center. With ``pairs``, odd ones are the backs of pairs, which face the opposite direction.
    Empty views do not count; at least one view is not empty. Returns left, right, bottom and top along the billboard's axes from its
    center, in meters, [N, 4].
    """
    cosines = facing_cosines(views.cameras, planes.normals, planes.centers[0])
    if pairs:
        cosines = cosines * torch.tensor([1.0, -1.0]).repeat(len(planes) // 2)
    best = [next(filter(views.shows, order)) for order in cosines.sort(dim=0, descending=True, stable=True).indices.T.tolist()]
    return torch.stack([_bounds_on_plane(planes, n, views.cameras[view], _box(views, view)) for n, view in enumerate(best)])


def silhouette_bounds(planes: BillboardCloud, views: ViewSet) -> Tensor:
    """Bound the billboards so that in every view the billboard that faces it best covers the whole silhouette.

    These bounds cut off no part of the tree in any view, except in views that are more than 60 degrees off every billboard's normal, for
    example from above. Parameters and result are those of :func:`facing_view_bounds`.
    """
    cosines = facing_cosines(views.cameras, planes.normals, planes.centers[0]).abs()
    bounds = torch.tensor([math.inf, -math.inf, math.inf, -math.inf], dtype=planes.centers.dtype).repeat(len(planes), 1)
    for view, row in enumerate(cosines):
        if not views.shows(view):
            continue
        outline = _outline(views, view)
        # A view halfway between two billboards bounds both, and a view of a pair bounds both of its rectangles.
        for n in torch.nonzero((row > row.max() - _TIE) & (row > _OBLIQUE))[:, 0].tolist():
            bounds[n] = _union(bounds[n], _bounds_on_plane(planes, n, views.cameras[view], outline))
    seen = bounds[:, 0].isfinite()
    if not seen.any():  # only oblique views
        return facing_view_bounds(planes, views, pairs=False)
    widest = torch.stack([bounds[seen, 0].amin(), bounds[seen, 1].amax(), bounds[seen, 2].amin(), bounds[seen, 3].amax()])
    return torch.where(seen[:, None], bounds, widest)


def opaque_bounds(cloud: BillboardCloud, *, grow: bool = True) -> Tensor:
    """Bound the opaque texels of each billboard, with a margin of two texels. The result is that of :func:`facing_view_bounds`.

    Where there are opaque texels at the border of a texture, the tree may extend beyond it, and the bounds ``grow`` by a tenth of that
    side. The bounds of a billboard without opaque texels do not change.
    """
    bounds = []
    for n, texture in enumerate(cloud.textures()):
        mask = (texture[..., 3].amax(0) > _OPAQUE).numpy().astype(np.uint8)
        x, y, width, height = cv2.boundingRect(mask)
        sides = torch.tensor([mask.shape[1], mask.shape[0]])
        if not width:
            half_width, half_height = cloud.half_extents[n]
            bounds.append(torch.stack([-half_width, half_width, -half_height, half_height]))
            continue
        low, high = torch.tensor([x, y]), torch.tensor([x + width, y + height])
        margin = (sides / 10).ceil().clamp_min(2) if grow else torch.zeros(2)
        low = torch.where(low < 1, low - margin, (low - 2).clamp_min(0))
        high = torch.where(high > sides - 1, high + margin, torch.minimum(high + 2, sides))
        meters = (torch.stack([low, high]) / sides * 2 - 1) * cloud.half_extents[n]
        bounds.append(torch.stack([meters[0, 0], meters[1, 0], -meters[1, 1], -meters[0, 1]]))
    return torch.stack(bounds)


def trimmed(cloud: BillboardCloud) -> BillboardCloud:
    """Crop rectangles to the texels whose alpha is not 0 in 8 bits, with a margin of one texel. Renders do not change.

    Transparent billboards are removed. One remains if all of them are transparent.
    """
    visible = [n for n, texture in enumerate(cloud.textures()) if (texture[..., 3] >= VISIBLE).any()]
    if len(visible) < len(cloud):
        cloud = cloud.take(visible or [0])
    parts, middles, sizes, crops = [], [], [], []
    for texture in cloud.textures():
        mask = (texture[..., 3].amax(0) >= VISIBLE).numpy().astype(np.uint8)
        x, y, width, height = cv2.boundingRect(mask)
        left, top = max(x - 1, 0), max(y - 1, 0)
        right, bottom = min(x + width + 1, mask.shape[1]), min(y + height + 1, mask.shape[0])
        parts.append([(right - left) / mask.shape[1], (bottom - top) / mask.shape[0]])
        middles.append([(left + right) / mask.shape[1] - 1, 1 - (top + bottom) / mask.shape[0]])
        sizes.append([bottom - top, right - left])
        crops.append((slice(None), slice(top, bottom), slice(left, right)))

    def cropped(values: Tensor) -> Tensor:
        return torch.cat([texture[crop].reshape(-1, 4) for texture, crop in zip(cloud.textures(values), crops, strict=True)])

    middle = torch.tensor(middles, dtype=cloud.centers.dtype) * cloud.half_extents
    return replace(
        cloud,
        centers=cloud.centers + middle[:, :1] * cloud.rights + middle[:, 1:] * cloud.ups,
        half_extents=cloud.half_extents * torch.tensor(parts, dtype=cloud.half_extents.dtype),
        texture_sizes=torch.tensor(sizes),
        texels=cropped(cloud.texels),
        surface=None if cloud.surface is None else cropped(cloud.surface),
    )


def _union(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(torch.tensor([True, False, True, False]), torch.minimum(a, b), torch.maximum(a, b))


def _silhouette(views: ViewSet, view: int) -> np.ndarray:
    return (views.image(view)[..., 3] > 0).numpy().astype(np.uint8)


def _outline(views: ViewSet, view: int) -> Tensor:
    """Return the corners of the convex hull of a view's pixels with alpha > 0, with their outer edges, in pixels, float64 [P, 2]."""
    centers = torch.from_numpy(cv2.convexHull(cv2.findNonZero(_silhouette(views, view)))[:, 0]).double()
    to_edges = torch.tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]], dtype=torch.float64)
    return (centers[:, None] + to_edges).flatten(0, 1)


def _box(views: ViewSet, view: int) -> Tensor:
    """Return the corners of the bounding rectangle of a view's pixels with alpha > 0, as :func:`_outline`."""
    x, y, width, height = cv2.boundingRect(_silhouette(views, view))
    return torch.tensor([[x, y], [x + width, y], [x + width, y + height], [x, y + height]], dtype=torch.float64) - 0.5


def _bounds_on_plane(planes: BillboardCloud, n: int, camera: Camera, pixels: Tensor) -> Tensor:
    """Project pixels, [P, 2], through one camera onto plane ``n`` and return their left, right, bottom and top, [4]."""
    point = torch.stack([planes.rights[n], planes.ups[n], planes.centers[n]], -1)
    plane_to_world = torch.cat([point, torch.tensor([[0.0, 0.0, 1.0]], dtype=point.dtype)])
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], -1)
    on_plane = homogeneous @ torch.linalg.inv(camera.world_to_pixel @ plane_to_world).mT
    coordinates = on_plane[:, :2] / on_plane[:, 2:]
    (left, bottom), (right, top) = coordinates.amin(0), coordinates.amax(0)
    return torch.stack([left, right, bottom, top])


def smallest_rectangle(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the smallest rectangle around points in a plane, [P, 2].

    It is rotated, by 45 degrees at most, only if that makes it at least a fifth smaller. Returns its center, [2], the unit vector along its
    width, [2], and its half width and half height, [2].
    """
    low, high = points.amin(0), points.amax(0)
    upright = torch.tensor([1.0, 0.0], dtype=points.dtype)
    (x, y), (width, height), degrees = cv2.minAreaRect(points.float().numpy())
    if width * height >= 0.8 * float((high - low).prod()):
        return (low + high) / 2, upright, (high - low) / 2
    while abs(degrees) > 45:
        width, height, degrees = height, width, degrees - math.copysign(90, degrees)
    angle = math.radians(degrees)
    axis = torch.tensor([math.cos(angle), math.sin(angle)], dtype=points.dtype)
    return torch.tensor([x, y], dtype=points.dtype), axis, torch.tensor([width / 2, height / 2], dtype=points.dtype)
