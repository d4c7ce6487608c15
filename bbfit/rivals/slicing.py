"""Slicing and blending (Jakulin 2000, "Interactive Vegetation Rendering with Slicing and Blending", Eurographics short presentations).

Implemented from the paper's abstract: a slice is a planar layer with an alpha texture, a set of parallel slices is a
slicing; a view from anywhere on a circle around the tree is drawn by blending between the nearest two slicings; six slicings of five
slices each are enough.

Choices of this module: slices show the same texture from both sides, so opposite directions share a slicing and the six are 30 degrees
apart. Slabs of equal thickness partition the tree, with each slice in the middle of its slab. The two slicings are drawn separately and
their pictures mixed with weights that are linear in the angle. The paper keeps trunk and limbs as a mesh and slices only twigs and leaves;
this module slices the whole tree, so a stem that a slab cuts shows its inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbfit.blender.pictures import vertical_axis
from bbfit.checks import check_count, check_shape, fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.dispatch import render
from bbfit.rivals.baking import BakeConfig, Slabs, bake, tree_triangles
from bbfit.rivals.crossed import upright_slabs
from bbfit.tree_files.tree_file import TreeFile


@dataclass(frozen=True)
class Slicings:
    """D stacks of parallel slices; a view shows at most two."""

    clouds: tuple[BillboardCloud, ...]
    """The slices of each direction, D clouds."""
    azimuths_degrees: tuple[float, ...]
    """Direction of each slicing's normal in [0, 180), evenly spaced: 0 is +Z, 90 is +X."""
    axis: Tensor
    """Point of the tree from which the direction towards a camera is taken, [3]."""

    def __post_init__(self) -> None:
        check_shape("axis", tuple(self.axis.shape), (3,))
        even = np.arange(len(self.clouds)) * 180.0 / max(1, len(self.clouds))
        if not self.clouds or not np.allclose(self.azimuths_degrees, even):
            fail("azimuths", f"expected {even.tolist()} for {len(self.clouds)} slicings, got {list(self.azimuths_degrees)}")

    def weights(self, camera: Camera) -> list[tuple[int, float]]:
        """The two slicings nearest to a camera's azimuth, or the only one, and their weights, which sum to 1.

        A parallel camera's direction is its own, a pinhole's that of its center. A camera straight above has azimuth 0.
        """
        towards = -camera.forward if camera.orthographic else camera.position - self.axis.to(camera.position)
        azimuth = float(torch.atan2(towards[0], towards[2])) * 180 / np.pi if float(towards[::2].norm()) > 1e-9 else 0.0
        count = len(self.clouds)
        place = (azimuth % 180) * count / 180
        first = int(place)
        if count == 1:
            return [(0, 1.0)]
        return [(first % count, 1 - (place - first)), ((first + 1) % count, place - first)]

    def draw(self, camera: Camera, drawn: Sequence[Callable[[Camera], Tensor]] | None = None) -> Tensor:
        """Draw the tree as premultiplied RGBA, [V, H, W, 4] ([H, W, 4] for a single camera).

        ``drawn`` are functions that draw each direction's slices for one camera. Default: those that draw the textures bilinearly.
        """
        if camera.batched:
            return torch.stack([self.draw(camera[index], drawn) for index in range(len(camera))])
        drawn = drawn or [partial(render, cloud) for cloud in self.clouds]
        return torch.stack([weight * drawn[index](camera) for index, weight in self.weights(camera) if weight > 0]).sum(0)


def slicing(
    tree: str | Path | TreeFile,
    config: BakeConfig,
    *,
    directions: int = 6,
    slices: int = 5,
    folder: str | Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Slicings:
    """Slice a tree into ``slices`` >= 1 slices along each of ``directions`` >= 1 directions at equal angles over 180 degrees.

    Empty slices are left out. With ``config.two_sided`` slices have back textures, unlike in the paper. For everything else see ``bake``.
    """
    check_count("directions", directions)
    check_count("slices", slices)
    points = tree_triangles(tree).reshape(-1, 3)
    axis = vertical_axis(points.min(0), points.max(0), config.views.axis)
    azimuths = [k * 180.0 / directions for k in range(directions)]
    slabs = Slabs.joined([upright_slabs(points, axis, azimuth, slices) for azimuth in azimuths])
    cloud = bake(tree, slabs, config, fill_cuts=True, folder=folder, on_progress=on_progress)
    return Slicings(_by_direction(cloud, azimuths), tuple(azimuths), axis)


def _by_direction(cloud: BillboardCloud, azimuths: list[float]) -> tuple[BillboardCloud, ...]:
    """The slices of each direction, distinguished by their normals."""
    angle = torch.tensor(azimuths, dtype=cloud.centers.dtype).deg2rad()
    normals = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], -1)
    nearest = (cloud.normals @ normals.mT).argmax(-1)
    return tuple(cloud.take(torch.nonzero(nearest == k)[:, 0].tolist()) for k in range(len(azimuths)))
