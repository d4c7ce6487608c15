"""Points on a tree: on the triangles of its mesh, or in the visual hull of its views if there is no mesh."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from bbfit.checks import fail
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, convergence_point
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewSet

COUNT = 20_000
"""Default number of points."""
# Least fraction of the mesh's points, averaged over views, that must project onto the tree in the views.
_AGREEMENT = 0.95
# Most batches of random points.
_ROUNDS = 64
# Least side of the silhouettes that carve the hull, in pixels.
_HULL_SIDE = 256


def mesh_points(tree: TreeFile, views: ViewSet, *, count: int = COUNT, seed: int = 0) -> Tensor:
    """Sample ``count`` points on the triangles of a tree's mesh, uniformly by area, float64 [P, 3] in the world of the views.

    The views verify that the mesh, which must be readable without Blender, lies where they show the tree. Raises MissingFileError if the
    file is missing, and InputError if it cannot be read, has no triangles, or is not of the tree that the views show.
    """
    import trimesh

    samples, _ = trimesh.sample.sample_surface(tree.mesh(), count, seed=seed)
    points = torch.tensor(samples, dtype=torch.float64)
    if tree.up_axis == "z":
        points = points @ torch.tensor(Z_UP_TO_Y_UP, dtype=torch.float64)[:3, :3].mT
    fractions = []
    for index in range(0, len(views), max(1, len(views) // 8)):
        # Dilate the silhouette by one pixel, because the few samples of a pixel can miss thin parts.
        mask = max_pool2d((views.image(index)[..., 3] > 0).float()[None], 3, 1, 1)[0] > 0
        fractions.append(_inside(points, views.cameras[index], mask, outside=True).double().mean())
    if float(torch.stack(fractions).mean()) < _AGREEMENT:
        fail("tree", f"{tree.path} is not where the views show a tree", "give the mesh that they were rendered from, or no mesh")
    return points


def hull_points(views: ViewSet, *, count: int = COUNT, seed: int = 0, batch: int = 1 << 18) -> Tensor:
    """Sample at most ``count`` points uniformly in the visual hull of the views, float64 [P, 3].

    The visual hull (Laurentini 1994) is the space that no view shows as background. The views carve ``batch`` random points at a time.
    Raises InputError if the silhouettes have no point in common, because the cameras or the pictures are wrong.
    """
    cameras = views.cameras
    halvings = max(0, int(math.log2(min(cameras.width, cameras.height) / _HULL_SIDE)))
    side = 1 << halvings
    masks = [max_pool2d((views.image(i)[..., 3] > 0).float()[None], side, ceil_mode=True)[0] > 0 for i in range(len(views))]
    # Space outside a picture is background too, unless the border of the picture cuts off the tree.
    cropped = [bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()) for mask in masks]
    cameras = cameras.resized(masks[0].shape[1], masks[0].shape[0])
    center, extent = convergence_point(cameras), max(cameras.width, cameras.height) / float(pixels_per_meter(cameras))
    low, high = center - extent / 2, center + extent / 2
    generator, batches = torch.Generator().manual_seed(seed), list[Tensor]()
    for _ in range(_ROUNDS):
        points = low + (high - low) * torch.rand(batch, 3, dtype=torch.float64, generator=generator)
        for index, mask in enumerate(masks):
            points = points[_inside(points, cameras[index], mask, outside=cropped[index])]
        batches.append(points)
        if sum(map(len, batches)) >= count:
            break
        if len(batches) == 1 and len(points):  # restrict the next rounds to the surroundings of the hull
            margin = 0.02 * extent
            low, high = torch.maximum(low, points.amin(0) - margin), torch.minimum(high, points.amax(0) + margin)
    hull = torch.cat(batches)[:count]
    if not len(hull):
        fail("views", "the silhouettes have no point in common", "check the cameras, or give the tree's mesh")
    return hull


def point_colors(pixels: list[tuple[Tensor, Tensor]], pictures: Tensor) -> Tensor:
    """Average the colors of P points over the views, without regard to occlusion, to straight RGB, float32 [P, 3].

    ``pixels`` are the :func:`pixels_of` the points in each view. ``pictures`` are premultiplied RGBA, [V, H, W, 4].
    """
    total = torch.zeros(len(pixels[0][0]), 4)
    for (index, inside), picture in zip(pixels, pictures, strict=True):
        total += picture.view(-1, 4)[index] * inside[:, None]
    return total[:, :3] / total[:, 3:].clamp_min(1e-6)


def pixels_of(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project points, [P, 3], to the pixels of a single camera.

    Returns the indices of the pixels, row by row, int32 [P], 0 outside the picture, and whether each point is inside it, bool [P].
    """
    x, y = camera.project(points).nan_to_num(nan=-1).round().clamp(-1, max(camera.width, camera.height)).int().unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return torch.where(inside, y * camera.width + x, 0), inside


def _inside(points: Tensor, camera: Camera, mask: Tensor, *, outside: bool) -> Tensor:
    """Whether each point projects onto a mask [H, W] in a single camera; ``outside`` is the value for points outside the picture."""
    index, inside = pixels_of(points, camera)
    return torch.where(inside, mask.flatten()[index], outside)
