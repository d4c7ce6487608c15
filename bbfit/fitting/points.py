"""Where a tree is: points on its triangles, or in the visual hull of its views where there is no mesh."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from bbfit.checks import fail
from bbfit.fitting.initialize import pixels_a_meter
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, convergence_point
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewSet

COUNT = 20_000
"""Points that are drawn unless said otherwise."""
# Points of a mesh that must lie on the tree in a training view, on average, for the two to belong together.
_AGREEMENT = 0.95
# Random points that the hull is carved from at a time, and how often at most.
_CARVED, _ROUNDS = 1 << 18, 64
# Side of the silhouettes that the hull is carved with, in pixels, at least.
_HULL_SIDE = 256


def mesh_points(tree: TreeFile, views: ViewSet, *, count: int = COUNT, seed: int = 0) -> Tensor:
    """Points on the triangles of a tree's mesh, evenly by area, [P, 3] float64, in the world of the views.

    Parameters
    ----------
    tree
        A tree whose triangles can be read without Blender.
    views : views of the same tree, which the mesh is checked against.

    Raises
    ------
    MissingFileError, InputError
        if the file is missing, cannot be read, has no triangles, or is not of the tree that the views show.
    """
    import trimesh

    sampled, _ = trimesh.sample.sample_surface(tree.mesh(), count, seed=seed)
    points = torch.tensor(sampled, dtype=torch.float64)
    if tree.up_axis == "z":
        points = points @ torch.tensor(Z_UP_TO_Y_UP, dtype=torch.float64)[:3, :3].mT
    seen = []
    for index in range(0, len(views), max(1, len(views) // 8)):
        # A pixel more on every side, since thin parts can be missed by a pixel's few samples.
        mask = max_pool2d((views.image(index)[..., 3] > 0).float()[None], 3, 1, 1)[0] > 0
        seen.append(_inside(points, views.cameras[index], mask, beyond=True).double().mean())
    if float(torch.stack(seen).mean()) < _AGREEMENT:
        fail("tree", f"{tree.path} is not where the views show a tree", "give the mesh that they were rendered from, or no mesh")
    return points


def hull_points(views: ViewSet, *, count: int = COUNT, seed: int = 0) -> Tensor:
    """Points in the visual hull (Laurentini 1994): wherever no view shows the background, [P, 3] float64.

    Raises
    ------
    InputError
        if the silhouettes have nothing in common, because the cameras or the pictures are wrong.
    """
    cameras = views.cameras
    halvings = max(0, int(math.log2(min(cameras.width, cameras.height) / _HULL_SIDE)))
    side = 1 << halvings
    masks = []
    for index in range(len(views)):
        alpha = (views.image(index)[..., 3] > 0).float()
        masks.append(max_pool2d(alpha[None], side, ceil_mode=True)[0] > 0)
    # Beyond the picture there is nothing either, unless the tree is cut off by its border.
    cropped = [bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()) for mask in masks]
    cameras = cameras.resized(masks[0].shape[1], masks[0].shape[0])
    center, extent = convergence_point(cameras), max(cameras.width, cameras.height) / float(pixels_a_meter(cameras))
    low, high = center - extent / 2, center + extent / 2
    generator, found = torch.Generator().manual_seed(seed), list[Tensor]()
    for _ in range(_ROUNDS):
        points = low + (high - low) * torch.rand(_CARVED, 3, dtype=torch.float64, generator=generator)
        for index, mask in enumerate(masks):
            points = points[_inside(points, cameras[index], mask, beyond=cropped[index])]
        found.append(points)
        if sum(map(len, found)) >= count:
            break
        if len(found) == 1 and len(points):  # from now on only where the hull is
            margin = 0.02 * extent
            low, high = torch.maximum(low, points.amin(0) - margin), torch.minimum(high, points.amax(0) + margin)
    hull = torch.cat(found)[:count]
    if not len(hull):
        fail("views", "their silhouettes have no point in common", "check the cameras, or give the tree's mesh")
    return hull


def point_colors(pixels: list[tuple[Tensor, Tensor]], pictures: Tensor) -> Tensor:
    """Straight RGB of points as views show them on average, occlusion ignored, [P, 3] float32.

    Parameters
    ----------
    pixels : :func:`pixels_of` the points, of each view.
    pictures : premultiplied RGBA, [V, H, W, 4].
    """
    total = torch.zeros(len(pixels[0][0]), 4)
    for (index, inside), picture in zip(pixels, pictures, strict=True):
        total += picture.view(-1, 4)[index] * inside[:, None]
    return total[:, :3] / total[:, 3:].clamp_min(1e-6)


def pixels_of(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The pixel in which a single camera sees each point, counted row by row, int32 [P], and whether that is in the picture, bool [P].

    Of points that are not in the picture it is pixel 0.
    """
    x, y = camera.project(points).nan_to_num(nan=-1).round().clamp(-1, max(camera.width, camera.height)).int().unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return torch.where(inside, y * camera.width + x, 0), inside


def _inside(points: Tensor, camera: Camera, mask: Tensor, *, beyond: bool = False) -> Tensor:
    """Which points one camera sees on a mask [H, W]; ``beyond`` is the answer for those outside the picture."""
    index, inside = pixels_of(points, camera)
    return torch.where(inside, mask.flatten()[index], beyond)
