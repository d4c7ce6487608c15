"""The visual hull of a tree (Laurentini 1994): a closed surface around everything that its silhouettes allow."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes
from torch import Tensor

from bbfit.checks import fail
from bbfit.geometry.camera import Camera, convergence_point
from bbfit.views.view_set import ViewSet

COARSE, FINE = 40, 64
"""Cells along the longest side of the grids that find the tree and carve its surface."""
OPAQUE = 0.5
"""Least opacity, anywhere in a cell's picture, that keeps the cell."""
SMALLEST_PART = 0.01
"""Loose parts with less than this share of the surface's triangles are left out."""


def hull_surface(views: ViewSet) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surface of the hull.

    The result is closed (Lorensen and Cline 1987): vertices in meters, [P, 3], and triangles counter-clockwise from outside, [F, 3]. Raises
    ``InputError`` if no point lies inside the silhouettes of all views.
    """
    kept, start, side = hull_grid(views, FINE, OPAQUE)
    smooth = ndimage.gaussian_filter(np.pad(kept, 2), 0.7)
    points, triangles, _, _ = marching_cubes(smooth, min(OPAQUE, 0.5 * float(smooth.max())), gradient_direction="ascent")
    links = coo_matrix((np.ones(len(triangles)), (triangles[:, 0], triangles[:, 1])), shape=(len(points),) * 2)
    part = connected_components(links, directed=False)[1][triangles[:, 0]]
    large = np.bincount(part)[part] >= SMALLEST_PART * len(triangles)
    used, corners = np.unique(triangles[large], return_inverse=True)
    return start + (points[used] - 2) * side, corners.reshape(-1, 3).astype(np.int64)


def hull_grid(views: ViewSet, cells: int, least: float) -> tuple[NDArray[np.float32], NDArray[np.float64], float]:
    """Carve the hull from two grids, the second around the cells of the first one whose opacity is at least ``least``.

    The result is the least opacity over all views of each cell's picture, [X, Y, Z], with about ``cells`` cells along the longest side; the
    center of the first cell, [3]; and the side of a cell, in meters. Raises ``InputError`` if no cell has that opacity.
    """
    center, half = _reach(views.cameras)
    low, high = center - half, center + half
    for count in (COARSE, cells):
        side = float((high - low).max()) / count
        counts = np.maximum(np.ceil((high - low) / side), 1).astype(int) + 2
        start = (low + high - side * (counts - 1)) / 2
        kept = _carve(views, start, side, counts)
        filled = np.argwhere(kept >= least)
        if len(filled) == 0:
            fail("views", "no point lies inside the silhouettes of all views", "check the cameras, and that the pictures show one tree")
        low, high = start + (filled.min(0) - 1) * side, start + (filled.max(0) + 1) * side
    return kept, start, side


def _reach(cameras: Camera) -> tuple[NDArray[np.float64], float]:
    """Center of the cameras' common view, and half the side of a cube that contains what all of them see."""
    center = convergence_point(cameras)
    distance = (cameras.position - center).norm(dim=-1)
    scale = 1 if cameras.orthographic else distance
    half = scale * max(cameras.width, cameras.height) / cameras.intrinsics[:, 0, 0] / 2
    return center.numpy(), float(half.max()) * 1.5  # the tree may stand out of the middle


def _carve(views: ViewSet, start: NDArray[np.float64], side: float, counts: NDArray[np.int64]) -> NDArray[np.float32]:
    """Least opacity over all views of each cell's picture, 0 where a view does not show it, [x, y, z]."""
    axes = [torch.from_numpy(start[axis] + side * np.arange(counts[axis])) for axis in range(3)]
    centers = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    kept, left = torch.ones(len(centers)), torch.arange(len(centers))
    for index in range(len(views)):
        camera = views.cameras[index]
        if not views.shows(index):
            continue  # the tree is too thin to be seen, but not absent
        alpha = views.image(index)[..., 3].float() / 255
        distance = 1.0 if camera.orthographic else float((camera.position - centers.mean(0)).norm())
        footprint = max(1, round(side * float(camera.intrinsics[0, 0]) / distance) | 1)
        for window in ((footprint, 1), (1, footprint)):
            alpha = torch.nn.functional.max_pool2d(alpha[None], window, 1, (window[0] // 2, window[1] // 2))[0]
        kept[left] = torch.minimum(kept[left], _looked_up(alpha, camera.project(centers[left])))
        left = left[kept[left] > 0]
    return kept.reshape(*counts.tolist()).numpy()


def _looked_up(picture: Tensor, points: Tensor) -> Tensor:
    """Values of the pixels that points fall into, 0 outside the picture."""
    x, y = points.nan_to_num(-1).round().long().unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
    return torch.where(inside, picture[y.clamp(0, picture.shape[0] - 1), x.clamp(0, picture.shape[1] - 1)], 0.0)
