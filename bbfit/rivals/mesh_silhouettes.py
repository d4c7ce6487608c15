"""Silhouette edges of a mesh, and the gradient of a loss as they move."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.rivals.mesh_rays import rays_through

SMOOTHING = 0.3
"""λ of Nicolet et al. 2021: how far a gradient spreads over the surface."""
BOUNDARY_SAMPLES = 0.25
"""Points on the silhouettes for each pixel of the picture."""
BOUNDARY_PIXELS = 0.02
"""How far on either side of a silhouette its two colors are looked up, in pixels."""


class Surface:
    """The triangles between a mesh's distinct points, and the map between points and the latents that are optimized.

    The latents are u = (I + λ L) v with the combinatorial Laplacian L: a step along the gradient by u spreads over the surface
    (Nicolet et al. 2021, "Large Steps in Inverse Rendering of Geometry").
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        """Take vertices, [P, 3], and triangles, int64 [F, 3]; vertices of one place become one point."""
        places, source = np.unique(vertices.numpy(), axis=0, return_inverse=True)
        self.source = torch.from_numpy(source.reshape(-1))
        """The point of each vertex, [P]."""
        self.faces = self.source[faces]
        """Triangles between points, [F, 3]."""
        pairs = torch.cat([self.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
        owner = torch.arange(len(self.faces)).repeat(3)
        self.edges, edge, shared = pairs.sort(-1).values.unique(dim=0, return_inverse=True, return_counts=True)
        """Pairs of points, [E, 2]."""
        # A border has one side. Where more than two triangles meet, two of them represent all.
        first = torch.full((len(self.edges),), -1).scatter_reduce(0, edge, owner, "amax")
        last = torch.full((len(self.edges),), len(owner)).scatter_reduce(0, edge, owner, "amin")
        self.sides, self.border = torch.stack([first, last], -1), shared != 2
        adjacency = torch.zeros(len(places), len(places), dtype=torch.float64)
        adjacency[self.edges[:, 0], self.edges[:, 1]] = 1
        adjacency = adjacency + adjacency.T
        laplacian = torch.diag(adjacency.sum(1)) - adjacency
        self._forward = torch.eye(len(places), dtype=torch.float64) + SMOOTHING * laplacian
        self._inverse = torch.linalg.inv(self._forward).float()

    def latent(self, vertices: Tensor) -> Tensor:
        """Latents, [points, 3], of vertices, [P, 3]."""
        places = torch.zeros(len(self._forward), 3)
        places[self.source] = vertices
        return (self._forward @ places.double()).float()

    def points(self, latent: Tensor) -> Tensor:
        """Points in meters of latents, both [points, 3]."""
        return self._inverse @ latent

    def smoothed(self, gradient: Tensor) -> Tensor:
        """The gradient by the latents of one by the points, both [points, 3]."""
        return self._inverse.T @ gradient

    def silhouette(self, points: Tensor, camera: Camera) -> Tensor:
        """Edges between a triangle that faces the camera and one that does not, and borders, [K, 2]."""
        corners = points[self.faces]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        towards = camera.forward.float() if camera.orthographic else corners[:, 0] - camera.position.float()
        front = (normals * towards).sum(-1) < 0
        return self.edges[self.border | (front[self.sides[:, 0]] != front[self.sides[:, 1]])]


def boundary_gradient(
    surface: Surface,
    points: Tensor,
    camera: Camera,
    slope: Tensor,
    colors: Callable[[Tensor, Tensor], Tensor],
    random: torch.Generator,
    density: float = BOUNDARY_SAMPLES,
) -> Tensor:
    """Gradient of a loss by the points of a mesh, [points, 3], through the motion of silhouettes: an integral along them, by sampling.

    ``slope`` is the derivative of the loss by the premultiplied RGBA of each pixel of the one camera, [H·W, 4]. ``colors`` returns what
    rays of given origins and directions see (``RayCaster.colors``). ``density`` is the number of samples per pixel.
    """
    points = points.detach().requires_grad_()
    ends = camera.project(points.double())[surface.silhouette(points.detach(), camera)]  # [K, 2, 2]
    along = (ends[:, 1] - ends[:, 0]).detach()
    lengths = along.norm(dim=-1).nan_to_num(0)
    if float(lengths.sum()) == 0:
        return torch.zeros_like(points)
    count = max(1, round(density * camera.width * camera.height))
    chosen = torch.multinomial(lengths, count, replacement=True, generator=random)
    part = torch.rand(count, 1, generator=random, dtype=torch.float64)
    places = ends[chosen, 0] * (1 - part) + ends[chosen, 1] * part
    normals = torch.stack([-along[chosen, 1], along[chosen, 0]], -1) / lengths[chosen, None]
    sides = torch.cat([places.detach() - BOUNDARY_PIXELS * normals, places.detach() + BOUNDARY_PIXELS * normals])
    behind, ahead = colors(*rays_through(camera, sides)).chunk(2)
    column, row = places.detach().round().long().unbind(-1)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
    gain = (slope[pixel] * (behind - ahead)).sum(-1).double() * inside * (float(lengths.sum()) / count)
    (gain * (places * normals).sum(-1)).sum().backward()
    assert points.grad is not None
    return points.grad
