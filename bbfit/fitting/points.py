"""Points on a tree: on the triangles of its mesh, or in the visual hull of its views if there is no mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from bbfit.blender.request import RenderedTree
from bbfit.checks import fail
from bbfit.fitting.bark import Bark, bark_of
from bbfit.fitting.clusters import view_projection
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.fitting.visibility import pixels_of, seen_indices, visibility
from bbfit.geometry.camera import Z_UP_TO_Y_UP, Camera, convergence_point
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

if TYPE_CHECKING:
    import trimesh

COUNT = 20_000
"""Default number of points."""
# Points on the mesh for each one that is chosen because views see it.
_DENSE = 5
# Least thickness of wood that has facets, in pixels of the views at the tree's axis, and least number of points on its bark.
_THICK, _LEAST_ON_BARK = 1.5, 30
# Least fraction of the mesh's points, averaged over views, that must project onto the tree in the views.
_AGREEMENT = 0.95
# Pixels that cover less of the mesh than this can be empty in a picture: its few samples miss thin parts. Such points of the mesh must be
# within a few pixels of the tree; all others within one.
_FAINT, _NEAR_FAINT, _NEAR = 0.5, 3, 1
# Largest difference between the corners of the mesh and of the rendered tree, as a fraction of its size.
_SAME_BOUNDS = 1e-3
# Pixels by which silhouettes without a common point are dilated, one after the other, because samples can miss parts thinner than a pixel;
# and further ones for views that bbfit rendered, whose cameras are right.
_DILATIONS, _FURTHER_DILATIONS = (0, 1, 2), (4, 8, 16, 32)
# Most batches of random points.
_ROUNDS = 64
# Least side of the silhouettes that carve the hull, in pixels.
_HULL_SIDE = 256


def placement_points(views: ViewDataset, config: FitConfig, tree: TreeFile | None) -> tuple[Tensor, Bark | None]:
    """Sample the points on a tree that a search for a placement clusters, float64 [P, 3], and find those on thick bark if it asks for them.

    The points are on the tree's mesh, in proportion to what views see of it, or in the visual hull of the views, which does not show what
    is bark. The bark is ``None`` unless ``trunk`` is mesh, and if there is hardly any. Raises the errors of :func:`mesh_points` and
    :func:`hull_points`.
    """
    if tree is None:
        return hull_points(views.train, seed=config.seed, own=views.own), None
    cameras, rendered = views.train.cameras, views.request.tree if views.request else None
    mesh, places, faces = _sampled(tree, views.train, rendered, _DENSE * COUNT, config.seed)
    points = in_world(places, tree)
    chosen = seen_indices(visibility(points, float(mesh.area), cameras), COUNT, config.seed)
    if config.trunk != "mesh":
        return points[chosen], None
    on_bark = torch.zeros(len(points), dtype=torch.bool)
    on_bark[bark_of(mesh, places, faces, _THICK / float(pixels_per_meter(cameras)))] = True
    members = torch.nonzero(on_bark[chosen])[:, 0]
    normals = in_world(mesh.face_normals[faces[chosen[members].numpy()]], tree)
    return points[chosen], Bark(members, normals) if len(members) >= _LEAST_ON_BARK else None


def mesh_points(tree: TreeFile, views: ViewSet, *, rendered: RenderedTree | None = None, count: int = COUNT, seed: int = 0) -> Tensor:
    """Sample ``count`` points on the triangles of a tree's mesh, uniformly by area, float64 [P, 3] in the world of the views.

    The mesh must be readable without Blender. If it is the file that the views were ``rendered`` from, its bounds verify that bbfit reads
    it as Blender does. Otherwise the views verify that the mesh lies where they show the tree. Raises MissingFileError if the file is
    missing, and InputError if it cannot be read, has no triangles, or is not of the tree that the views show.
    """
    return in_world(_sampled(tree, views, rendered, count, seed)[1], tree)


def _sampled(
    tree: TreeFile, views: ViewSet, rendered: RenderedTree | None, count: int, seed: int
) -> tuple[trimesh.Trimesh, NDArray[np.float64], NDArray[np.int64]]:
    """The mesh of :func:`mesh_points`, checked as there, and samples of it in the axes of the file (:func:`mesh_samples`)."""
    mesh = tree.mesh()
    places, faces = mesh_samples(mesh, count, seed)
    points, bounds = in_world(places, tree), in_world(mesh.bounds, tree).sort(0).values
    known = rendered if rendered is not None and rendered.sha256 == tree.digest else None
    if known and known.bounds:
        difference = (bounds - torch.tensor(known.bounds, dtype=torch.float64)).abs().amax()
        if float(difference) <= _SAME_BOUNDS * float((bounds[1] - bounds[0]).norm()):
            return mesh, places, faces
    if _agreement(points, float(mesh.area), views) < _AGREEMENT:
        if known:
            fail("tree", f"bbfit finds the triangles of {tree.path} elsewhere than Blender", "export it from Blender as .glb")
        fail("tree", f"{tree.path} is not where the views show a tree", "give the mesh that they were rendered from, or no mesh")
    return mesh, places, faces


def mesh_samples(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sample ``count`` points on a mesh, uniformly by area: the points, [P, 3], and the triangles that they lie on, [P]."""
    import trimesh

    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def in_world(vectors: NDArray[np.float64], tree: TreeFile) -> Tensor:
    """Turn points or directions in the axes of a tree's file, [P, 3], to the world of the views, whose Y is up, float64 [P, 3]."""
    turned = torch.tensor(np.asarray(vectors), dtype=torch.float64)
    return turned @ torch.tensor(Z_UP_TO_Y_UP, dtype=torch.float64)[:3, :3].mT if tree.up_axis == "z" else turned


def _agreement(points: Tensor, area: float, views: ViewSet) -> float:
    """The fraction of points on a mesh of ``area`` square meters that project onto the tree in the views, averaged over some views."""
    fractions = []
    for index in range(0, len(views), max(1, len(views) // 8)):
        camera = views.cameras[index]
        mask = (views.image(index)[..., 3] > 0).float()[None]
        near, nearby = (max_pool2d(mask, 2 * reach + 1, 1, reach)[0] > 0 for reach in (_NEAR, _NEAR_FAINT))
        # The expected coverage of the 3 x 3 pixels around each pixel: a surface shows half of its area on average.
        pixel, inside = pixels_of(points, camera)
        scale = torch.full_like(points[:, 0], float(camera.intrinsics[0, 0]))
        if not camera.orthographic:
            scale = scale / (points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3])
        shown = torch.where(inside, scale.square() * area / len(points) / 2, 0).float()
        covered = torch.zeros(mask.numel()).index_add_(0, pixel, shown).view_as(mask)
        faint = avg_pool2d(covered, 3, 1, 1)[0] < _FAINT
        fractions.append(_inside(points, camera, near | (nearby & faint), outside=True).double().mean())
    return float(torch.stack(fractions).mean())


def hull_points(views: ViewSet, *, count: int = COUNT, seed: int = 0, batch: int = 1 << 18, own: bool = False) -> Tensor:
    """Sample at most ``count`` points uniformly in the visual hull of the views, float64 [P, 3].

    The visual hull (Laurentini 1994) is the space that no view shows as background. The views carve ``batch`` random points at a time.
    Empty views do not carve. If the silhouettes have no point in common, they are dilated by one or two pixels, because samples can miss
    thin parts, and further if the views are bbfit's ``own``. Raises InputError if they still have none, because the cameras or the pictures
    are wrong.
    """
    for pixels in _DILATIONS + (_FURTHER_DILATIONS if own else ()):
        if len(hull := _carved(views, count, seed, batch, pixels)):
            return hull
    fail("views", "the silhouettes have no point in common", "check the cameras, or give the tree's mesh")


def _carved(views: ViewSet, count: int, seed: int, batch: int, dilation: int) -> Tensor:
    """The points of :func:`hull_points`, of silhouettes that are dilated by some pixels."""
    views = views.take(list(filter(views.shows, range(len(views)))))
    cameras = views.cameras
    halvings = max(0, int(math.log2(min(cameras.width, cameras.height) / _HULL_SIDE)))
    side = 1 << halvings
    masks = [max_pool2d((views.image(i)[..., 3] > 0).float()[None], side, ceil_mode=True)[0] > 0 for i in range(len(views))]
    masks = [max_pool2d(mask.float()[None], 2 * dilation + 1, 1, dilation)[0] > 0 for mask in masks] if dilation else masks
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
    return torch.cat(batches)[:count]


@dataclass(frozen=True)
class SeenPoints:
    """P points on a tree, and what V views show of them."""

    places: Tensor
    """Coordinates, float64 [P, 3]."""
    pixels: list[tuple[Tensor, Tensor]]
    """The :func:`~bbfit.fitting.visibility.pixels_of` the points in each view."""
    colors: Tensor
    """Straight RGB (:func:`point_colors`), float32 [P, 3]."""
    projection: Tensor
    """What the views see of a displacement (:func:`~bbfit.fitting.clusters.view_projection`), float64 [3, 3]."""
    pixels_per_meter: float
    """Of the views, at the tree's axis."""

    @staticmethod
    def of(points: Tensor, cameras: Camera, pictures: Tensor) -> SeenPoints:
        """Points, float64 [P, 3], in pictures of the cameras, premultiplied RGBA, float32 [V, H, W, 4]."""
        pixels = [pixels_of(points, cameras[index]) for index in range(len(cameras))]
        return SeenPoints(points, pixels, point_colors(pixels, pictures), view_projection(cameras), float(pixels_per_meter(cameras)))

    def take(self, members: Tensor) -> SeenPoints:
        """Some of the points, by their indices, int64, or a mask, bool [P]."""
        pixels = [(index[members], inside[members]) for index, inside in self.pixels]
        return replace(self, places=self.places[members], pixels=pixels, colors=self.colors[members])


def point_colors(pixels: list[tuple[Tensor, Tensor]], pictures: Tensor) -> Tensor:
    """Average the colors of P points over the views, without regard to occlusion, to straight RGB, float32 [P, 3].

    ``pixels`` are the :func:`pixels_of` the points in each view. ``pictures`` are premultiplied RGBA, [V, H, W, 4].
    """
    total = torch.zeros(len(pixels[0][0]), 4)
    for (index, inside), picture in zip(pixels, pictures, strict=True):
        total += picture.view(-1, 4)[index] * inside[:, None]
    return total[:, :3] / total[:, 3:].clamp_min(1e-6)


def _inside(points: Tensor, camera: Camera, mask: Tensor, *, outside: bool) -> Tensor:
    """Whether each point projects onto a mask [H, W] in a single camera; ``outside`` is the value for points outside the picture."""
    index, inside = pixels_of(points, camera)
    return torch.where(inside, mask.flatten()[index], outside)
