"""A sparse grid of voxels: values at the corners of cells, and rays that visit only the cells that are there.

The mask of the cells is the occupancy grid of Müller et al. 2022 ("Instant Neural Graphics Primitives", appendix E.2). Values are
interpolated linearly between the corners, as in Fridovich-Keil et al. 2022 ("Plenoxels", section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from bbfit.checks import check_shape

# The eight corners of a cell, [8, 3].
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
# Rays that are followed at a time, to stay in the processor's cache.
_TOGETHER = 1024


@dataclass(frozen=True)
class Samples:
    """S points on R rays, sorted by ray and then from near to far."""

    rays: Tensor
    """The ray of each, int64 [S], ascending."""
    cells: Tensor
    """The cell of each among those of the grid, int32 [S]."""
    places: Tensor
    """Where in its cell each is, in [0, 1], float32 [S, 3]."""

    def of_rays(self, first: int, last: int) -> Samples:
        """The samples of the rays from ``first`` up to ``last``, which is not included."""
        start, end = torch.searchsorted(self.rays, torch.tensor([first, last])).tolist()
        return Samples(self.rays[start:end] - first, self.cells[start:end], self.places[start:end])


@dataclass(frozen=True)
class VoxelGrid:
    """Some cells of a box of X * Y * Z cubes, and the P corners that they share."""

    cells: NDArray[np.bool_]
    """Which cells are there, [X, Y, Z]."""
    start: NDArray[np.float64]
    """The outer corner of the first cell in meters, [3]."""
    side: float
    """Side of a cell in meters."""

    def __post_init__(self) -> None:
        check_shape("cells", self.cells.shape, (None, None, None))
        check_shape("start", self.start.shape, (3,))

    @cached_property
    def indices(self) -> NDArray[np.int64]:
        """Place of each cell that is there, [C, 3]."""
        return np.argwhere(self.cells)

    @cached_property
    def vertices(self) -> NDArray[np.int64]:
        """Place of each corner, [P, 3]; corner (0, 0, 0) is at ``start``."""
        return np.stack(np.unravel_index(self._joined[0], self._corner_counts), -1)

    @cached_property
    def corners(self) -> Tensor:
        """The eight corners of each cell, int32 [C, 8], the last axis fastest."""
        return torch.from_numpy(self._joined[1].reshape(-1, 8).astype(np.int32))

    def interpolation(self, samples: Samples) -> csr_matrix:
        """The matrix, [S, P], that takes values at the corners to values at samples."""
        high = samples.places
        low = 1 - high
        x, y, z = (torch.stack([low[:, axis], high[:, axis]], -1) for axis in range(3))
        weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1)
        ends = np.arange(0, 8 * len(high) + 1, 8, dtype=np.int32)
        columns = self.corners[samples.cells].reshape(-1)
        return csr_matrix((weights.numpy(), columns.numpy(), ends), (len(high), len(self.vertices)))

    def samples(self, starts: Tensor, rays: Tensor, step: float, offsets: Tensor) -> Samples:
        """Points on rays, one every ``step`` cells, that lie in cells that are there.

        Rays are given by a point in meters and a unit direction, float32 [R, 3] each. ``offsets``, [R] in [0, 1], shift the points of a ray
        by a part of a step.
        """
        starts = (starts - torch.from_numpy(self.start).float()) / self.side
        parts = [self._visited(starts[k : k + _TOGETHER], rays[k : k + _TOGETHER], step, offsets[k : k + _TOGETHER]) for k in _chunks(rays)]
        numbers = torch.cat([part.rays + k for part, k in zip(parts, _chunks(rays), strict=True)])
        return Samples(numbers, torch.cat([part.cells for part in parts]), torch.cat([part.places for part in parts]))

    def halved(self) -> VoxelGrid:
        """The grid with cells of half the side."""
        return VoxelGrid(self.cells.repeat(2, 0).repeat(2, 1).repeat(2, 2), self.start, self.side / 2)

    def carried(self, values: Tensor, part: VoxelGrid) -> Tensor:
        """Values at the corners, [P, C], as values at the corners of a part of the grid, or of its halved grid, [Q, C]."""
        factor = part.cells.shape[0] // self.cells.shape[0]
        slots = self._slots[np.ravel_multi_index(tuple((part.indices // factor).T), self.cells.shape)]
        places = torch.from_numpy((part.indices % factor)[:, None] + _CORNERS).float() / factor
        samples = Samples(torch.arange(8 * len(slots)), slots.repeat_interleave(8), places.reshape(-1, 3))
        result = torch.zeros(len(part.vertices), values.shape[1])
        result[part.corners.reshape(-1).long()] = torch.from_numpy(self.interpolation(samples) @ values.numpy())
        return result

    @property
    def _corner_counts(self) -> tuple[int, ...]:
        return tuple(count + 1 for count in self.cells.shape)

    @cached_property
    def _joined(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The corners of cells in the box, and for the eight of each cell which of them it is."""
        places = (self.indices[:, None] + _CORNERS).reshape(-1, 3)
        return np.unique(np.ravel_multi_index(tuple(places.T), self._corner_counts), return_inverse=True)

    @cached_property
    def _slots(self) -> Tensor:
        """The number of each cell of the box among those that are there, or -1, int32 [X * Y * Z]."""
        slots = np.full(self.cells.size, -1, np.int32)
        slots[self.cells.ravel()] = np.arange(len(self.indices), dtype=np.int32)
        return torch.from_numpy(slots)

    def _visited(self, starts: Tensor, rays: Tensor, step: float, offsets: Tensor) -> Samples:
        """The samples of some rays, whose starts are in cells from the corner of the box."""
        sizes = torch.tensor(self.cells.shape, dtype=torch.int32)
        slopes = 1 / torch.where(rays.abs() < 1e-9, 1e-9, rays)
        ends = torch.stack([-starts * slopes, (sizes - starts) * slopes])
        near, far = ends.amin(0).amax(-1).clamp_min(0), ends.amax(0).amin(-1)
        counts = ((far - near) / step - offsets).ceil().clamp_min(0).long()
        numbers = torch.repeat_interleave(counts)
        index = torch.arange(len(numbers)) - (counts.cumsum(0) - counts).index_select(0, numbers)
        along = near.index_select(0, numbers) + (index + offsets.index_select(0, numbers)) * step
        points = torch.addcmul(starts.index_select(0, numbers), rays.index_select(0, numbers), along[:, None])
        cells = points.floor().int().clamp(torch.zeros_like(sizes), sizes - 1)
        slots = self._slots.index_select(0, (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2])
        kept = torch.nonzero(slots >= 0)[:, 0]
        return Samples(numbers[kept], slots[kept], points[kept] - cells[kept])


def _chunks(rays: Tensor) -> range:
    return range(0, max(len(rays), 1), _TOGETHER)
