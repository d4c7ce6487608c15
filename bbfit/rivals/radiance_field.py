"""A rival to billboards: a radiance field (Mildenhall et al. 2020, "NeRF") in a sparse grid of voxels, learned from the views.

A ray collects the color and density of the points on it by the volume rendering of NeRF (section 4, equation 3). The field is a sparse grid
in place of a network: colors and densities at the corners of voxels, interpolated linearly and refined from coarse to fine, with a total
variation loss (Fridovich-Keil et al. 2022, "Plenoxels", sections 3.1 to 3.4). Densities are interpolated before they are activated, which
makes sharper surfaces (Sun et al. 2022, "Direct Voxel Grid Optimization", section 4.2).

Choices of this module: the visual hull bounds the first grid. Colors do not depend on the direction, because the views' light is baked. The
loss is the expected squared error over a random gray background, in closed form. A value that is shipped has 8 bits.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_matrix
from torch import Tensor

from bbfit.checks import check_count, check_shape, fail
from bbfit.geometry.camera import Camera
from bbfit.rivals.mesh_hull import hull_grid
from bbfit.rivals.mesh_rays import pixel_rays
from bbfit.rivals.voxel_grid import Samples, VoxelGrid
from bbfit.views.view_set import ViewSet

CELLS = 256
"""Most cells along the longest side of a tree whose number is not given."""
LEVELS = 3
"""Grids that are learned, each with cells of half the side of those before."""
STEP = 1.0
"""Distance of the points on a ray, in cells."""
BATCH = 8192
"""Rays of an optimizer step."""
RATE = 0.1
"""Step of a value; it falls to a tenth while the last grid is learned."""
SMOOTHNESS = 1e-3
"""Weight of the total variation."""
UNSEEN = 0.01
"""A cell that has a smaller share than this in the color of every ray is left out."""
FAINT = 0.02
"""Least opacity of a picture that counts as the tree."""
START = -3.0
"""Density of the first grid."""
# Colors are values from -2 to 2, for 0 to 1, and densities from -8 to 8, which softplus makes positive: all change at about one rate.
_COLORS = 2.0
_LIMITS = torch.tensor([_COLORS, _COLORS, _COLORS, 8.0])
# Share of the cells whose variation a step takes, and what rounds the tip of the absolute value.
_VARIED, _ROUND = 1 / 16, 1e-4
# Rays that are drawn at a time.
_TOGETHER = 1 << 14
# What a file begins with: cells along x, y and z, the corner of the first one and the side in meters.
_HEAD = struct.Struct("<3I4d")


@dataclass(frozen=True)
class RadianceField:
    """Colors and densities at the corners of a sparse grid's cells."""

    grid: VoxelGrid
    values: Tensor
    """RGB, and a density before its activation, uint8 [P, 4]."""

    def __post_init__(self) -> None:
        check_shape("values", tuple(self.values.shape), (len(self.grid.vertices), 4))

    @staticmethod
    def from_bytes(data: bytes) -> RadianceField:
        """Read what :meth:`to_bytes` wrote. Raises ``InputError`` for anything else."""
        try:
            content = zlib.decompress(data)
            *counts, x, y, z, side = _HEAD.unpack_from(content)
            mask = np.frombuffer(content, np.uint8, -(-math.prod(counts) // 8), _HEAD.size)
            cells = np.unpackbits(mask, count=math.prod(counts)).reshape(counts).astype(bool)
            values = np.frombuffer(content, np.uint8, offset=_HEAD.size + len(mask)).reshape(4, -1).T.copy()
        except (zlib.error, struct.error, ValueError) as error:
            fail("radiance field", f"the data is damaged ({error})", "learn it anew")
        return RadianceField(VoxelGrid(cells, np.array([x, y, z]), side), torch.from_numpy(values))

    def to_bytes(self) -> bytes:
        """The mask of the cells and the values, channel by channel, compressed by zlib."""
        head = _HEAD.pack(*self.grid.cells.shape, *self.grid.start, self.grid.side)
        return zlib.compress(head + np.packbits(self.grid.cells).tobytes() + self.values.T.contiguous().numpy().tobytes(), 9)

    @cached_property
    def bytes(self) -> int:
        """The size of the file."""
        return len(self.to_bytes())

    def draw(self, camera: Camera) -> Tensor:
        """Draw one view with a ray through the center of each pixel: premultiplied RGBA in [0, 1], float32 [H, W, 4].

        Raises ``InputError`` for a batch of cameras.
        """
        starts, rays = _centers(camera)
        values = ((self.values.float() / 255 * 2 - 1) * _LIMITS).numpy()
        parts = []
        for first in range(0, len(rays), _TOGETHER):
            some = slice(first, first + _TOGETHER)
            samples = self.grid.samples(starts[some], rays[some], STEP, torch.full((len(rays[some]),), 0.5))
            parts.append(_blended(torch.from_numpy(self.grid.interpolation(samples) @ values), samples.rays, len(rays[some]), STEP)[0])
        return torch.cat(parts).reshape(camera.height, camera.width, 4)

    def samples(self, camera: Camera) -> float:
        """Points that a ray of one camera visits, in the mean over those rays that visit any."""
        starts, rays = _centers(camera)
        visited = self.grid.samples(starts, rays, STEP, torch.full((len(rays),), 0.5)).rays
        return len(visited) / max(1, len(visited.unique_consecutive()))


def learn_radiance_field(
    views: ViewSet,
    *,
    steps: int = 3000,
    cells: int | None = None,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> RadianceField:
    """Learn a radiance field from views of a tree.

    A grid that covers the visual hull is learned first. Cells that no ray sees are left out, the others are halved, and so on.

    Parameters
    ----------
    views
        Pictures from around the tree.
    steps
        Optimizer steps; half of them for the last grid.
    cells
        Cells of the last grid along the longest side of the tree, about. Default: one for each pixel along the longer side of a picture, at
        least 32 and at most :data:`CELLS`.
    seed
        Seed of the order of the rays and the places of the points on them.
    on_step
        Called after each step with its number, from 1, and its loss.

    Raises
    ------
    InputError
        If an argument is out of range, or the views share no common silhouette.
    """
    check_count("steps", steps, LEVELS)
    if cells is None:
        cells = min(max(views.cameras.width, views.cameras.height, 4 << LEVELS), CELLS)
    check_count("cells", cells, 4 << LEVELS)
    check_count("seed", seed, 0)
    random = torch.Generator().manual_seed(seed)
    kept, start, side = hull_grid(views, cells >> (LEVELS - 1), FAINT)
    grid = VoxelGrid(_grown(kept >= FAINT), start - side / 2, side)
    values = torch.zeros(len(grid.vertices), 4)
    values[:, 3] = START
    starts, rays, colors = _shuffled(views, random)
    done = 0
    for level in range(LEVELS):
        samples = grid.samples(starts, rays, STEP, torch.rand(len(rays), generator=random))
        hit, numbers = samples.rays.unique_consecutive(return_inverse=True)
        starts, rays, colors = starts[hit], rays[hit], colors[hit]
        lesson = _Lesson(grid, Samples(numbers, samples.cells, samples.places), colors, STEP * 2.0 ** (LEVELS - 1 - level))
        last = level == LEVELS - 1
        end = steps if last else steps * (level + 1) // (2 * (LEVELS - 1))
        values = lesson.learn(values, range(done, end), random, 0.1 if last else 1.0, on_step or (lambda step, loss: None))
        done, seen = end, lesson.seen(values)
        smaller = VoxelGrid(grid.cells & (seen if last else _grown(seen)), grid.start, grid.side)
        finer = smaller if last else smaller.halved()
        grid, values = finer, grid.carried(values, finer)
    return RadianceField(grid, ((values / _LIMITS + 1) / 2 * 255).round().byte())


class _Lesson:
    """A grid, and the rays that it is learned from: their samples, and their colors [R, 4]."""

    def __init__(self, grid: VoxelGrid, samples: Samples, colors: Tensor, length: float) -> None:
        """``length`` is the distance of samples in cells of the last grid, for which densities count."""
        self._grid, self._colors, self._length = grid, colors, length
        self._parts = [(first, samples.of_rays(first, first + BATCH)) for first in range(0, len(colors), BATCH)]

    def learn(self, values: Tensor, steps: range, random: torch.Generator, fall: float, on_step: Callable[[int, float], None]) -> Tensor:
        """Values after some steps, at the end of which the step size is ``fall`` times that of the beginning."""
        values = values.clone().requires_grad_()
        optimizer = torch.optim.Adam([values], RATE, betas=(0.9, 0.99), eps=1e-12)
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, fall ** (1 / max(1, len(steps))))
        order: list[int] = []
        for step in steps:
            order = order or torch.randperm(len(self._parts), generator=random).tolist()
            first, samples = self._parts[order.pop()]
            colors = self._colors[first : first + BATCH]
            seen, _ = _blended(self._interpolated(values, samples), samples.rays, len(colors), self._length)
            loss = _loss(seen - colors)
            optimizer.zero_grad()
            (loss + SMOOTHNESS * self._variation(values, random)).backward()
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                values.clamp_(-_LIMITS, _LIMITS)
            on_step(step + 1, float(loss.detach()))
        return values.detach()

    def seen(self, values: Tensor) -> NDArray[np.bool_]:
        """The cells of the box that have a share of more than ``UNSEEN`` in the color of a ray."""
        most = torch.zeros(len(self._grid.indices))
        for first, samples in self._parts:
            count = len(self._colors[first : first + BATCH])
            _, weights = _blended(self._interpolated(values, samples), samples.rays, count, self._length)
            most.scatter_reduce_(0, samples.cells.long(), weights, "amax")
        mask = np.zeros_like(self._grid.cells)
        mask[self._grid.cells] = most.numpy() > UNSEEN
        return mask

    def _interpolated(self, values: Tensor, samples: Samples) -> Tensor:
        result: Tensor = _Product.apply(values, self._grid.interpolation(samples))
        return result

    def _variation(self, values: Tensor, random: torch.Generator) -> Tensor:
        """Mean difference of corners along the edges of some cells."""
        cells = torch.randint(len(self._grid.corners), (math.ceil(_VARIED * len(self._grid.corners)),), generator=random)
        corners = values[self._grid.corners[cells].long()].reshape(-1, 2, 2, 2, 4)
        return sum((corners.diff(dim=axis).square() + _ROUND).sqrt().mean() for axis in (1, 2, 3))  # type: ignore[return-value]


class _Product(torch.autograd.Function):
    """The product of a sparse matrix, [S, P], and values, [P, C], which is several times faster in SciPy than in torch."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: csr_matrix) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ values.detach().numpy())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.matrix.T @ gradient.contiguous().numpy()), None


def _blended(values: Tensor, rays: Tensor, count: int, length: float) -> tuple[Tensor, Tensor]:
    """Colors of ``count`` rays, premultiplied RGBA [R, 4], and the weight in them of each sample, [S] (NeRF, equation 3)."""
    depths = torch.nn.functional.softplus(values[:, 3]) * length
    before = depths.double().cumsum(0) - depths
    first = torch.searchsorted(rays, rays)  # the first sample of each one's ray
    weights = (before[first] - before).exp().float() * -torch.expm1(-depths)
    colors = torch.cat([0.5 + values[:, :3] / (2 * _COLORS), torch.ones(len(values), 1)], -1)
    return torch.zeros(count, 4).index_add(0, rays, weights[:, None] * colors), weights


def _loss(errors: Tensor) -> Tensor:
    """Mean squared error of premultiplied RGBA, [R, 4], over a gray background that is random in [0, 1]: mean 1/2, variance 1/12."""
    alpha = errors[:, 3:]
    return (errors[:, :3] - alpha / 2).square().mean() + alpha.square().mean() / 12


def _centers(camera: Camera) -> tuple[Tensor, Tensor]:
    if camera.batched:
        fail("camera", "expected one camera, got a batch", "draw its cameras one by one")
    return pixel_rays(camera, torch.full((camera.height * camera.width, 2), 0.5), 1)


def _shuffled(views: ViewSet, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, directions and colors of the rays through all pixels, in random order, float32 [R, 3], [R, 3] and [R, 4]."""
    rays = [(*_centers(views.cameras[index]), views.targets([index]).reshape(-1, 4)) for index in range(len(views))]
    order = torch.randperm(sum(len(part[0]) for part in rays), generator=random)
    starts, directions, colors = (torch.cat(parts)[order] for parts in zip(*rays, strict=True))
    return starts, directions, colors


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells and their neighbors."""
    return np.asarray(ndimage.binary_dilation(cells, np.ones((3, 3, 3))))
