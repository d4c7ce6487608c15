"""Small scenes for the renderer's tests, float64."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit

PLACEMENT = ("centers", "rights", "ups", "half_extents")
CORNERS = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).numpy()
"""Of a cube of two meters around the origin."""


def cloud_of(
    centers: Tensor, rights: Tensor, ups: Tensor, half_extents: Tensor, sizes: list[tuple[int, int]], *, two_sided: bool = False
) -> BillboardCloud:
    """A cloud with random texels strictly inside (0, 1)."""
    texture_sizes = torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2)
    count = int(texture_sizes.prod(-1).sum()) * (1 + two_sided)
    texels = 0.1 + 0.8 * torch.rand(count, 4, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
    two = torch.full((len(texture_sizes),), two_sided)
    return BillboardCloud(centers.double(), rights.double(), ups.double(), half_extents.double(), texture_sizes, two, texels)


def facing_cloud(depths: list[float], sizes: list[tuple[int, int]], half_extents: tuple[float, float] = (1.0, 1.0)) -> BillboardCloud:
    """Upright rectangles that face +Z, at the given distances from :func:`camera_on_z` on its optical axis."""
    n = len(depths)
    centers = torch.stack([torch.zeros(n), torch.zeros(n), -torch.tensor(depths)], -1)
    axes, half = torch.eye(3), torch.tensor(half_extents, dtype=torch.float64)
    return cloud_of(centers, axes[:1].expand(n, 3), axes[1:2].expand(n, 3), half.expand(n, 2), sizes)


def camera_on_z(width: int, height: int, *, fov: float | None = 60.0, extent: float = 4.0) -> Camera:
    """A single camera at the origin that looks along -Z; orthographic without a field of view."""
    pose = look_at(torch.zeros(1, 3, dtype=torch.float64), torch.tensor([0.0, 0, -1], dtype=torch.float64))[0]
    intrinsics = orthographic_intrinsics(extent, width, height) if fov is None else pinhole_intrinsics(fov, width, height)
    return Camera(pose, intrinsics, width, height, fov is None)


def random_scene(seed: int, count: int, *, orthographic: bool) -> tuple[BillboardCloud, Camera]:
    """Tilted, crossing planes of all sizes around a camera that stands outside, or among them, with some planes (partly) behind it."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    axes = torch.linalg.qr(uniform(count, 3, 3) - 0.5).Q
    sizes = torch.randint(1, 9, (count, 2), generator=generator)
    two_sided = uniform(count) < 0.5
    texels = uniform(int((sizes.prod(-1) * (1 + two_sided.long())).sum()), 4)
    texels[:, 3] = (2 * texels[:, 3] - 0.5).clamp(0, 1)  # a quarter each is exactly transparent and exactly opaque
    centers, half_extents = 2 * uniform(count, 3) - 1, 1.5 * uniform(count, 2) + 0.3
    cloud = BillboardCloud(centers, axes[..., 0], axes[..., 1], half_extents, sizes, two_sided, texels)
    width, height = (int(n) for n in torch.randint(1, 20, (2,), generator=generator))
    fov = 20 + 80 * float(uniform(1))
    intrinsics = orthographic_intrinsics(4.0, width, height) if orthographic else pinhole_intrinsics(fov, width, height)
    pose = look_at((2 * uniform(1, 3) - 1) * 4 * uniform(1), 0.5 * uniform(3))[0]
    return cloud, Camera(pose, intrinsics, width, height, orthographic)


def rolled(camera: Camera, degrees: float) -> Camera:
    """The same single camera turned about its optical axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[c, -s], [s, c]])
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)


def tracked(cloud: BillboardCloud) -> tuple[BillboardCloud, dict[str, Tensor]]:
    """The cloud with gradients asked for, and its leaves by name."""
    leaves = {name: getattr(cloud, name).detach().clone().requires_grad_() for name in (*PLACEMENT, "texels")}
    return replace(cloud, **leaves), leaves


def placement_of(cloud: BillboardCloud) -> Tensor:
    """Centers, rights, ups and half extents side by side, float64 [N, 11]."""
    return torch.cat([getattr(cloud, name) for name in PLACEMENT], -1).double()


def placed_at(cloud: BillboardCloud, placement: Tensor) -> BillboardCloud:
    """The cloud with a placement as :func:`placement_of` gives it."""
    return replace(cloud, **dict(zip(PLACEMENT, placement.split((3, 3, 3, 2), -1), strict=True)))


def noise(cloud: BillboardCloud, seed: int = 0) -> BillboardCloud:
    """The cloud with random texels of its dtype."""
    generator = torch.Generator().manual_seed(seed)
    return cloud.with_texels(torch.rand(cloud.texels.shape, generator=generator, dtype=cloud.texels.dtype))


def ring_of(size: int, billboards: int = 4, views: int = 2) -> tuple[BillboardCloud, Camera]:
    """Upright billboards with noise on them, and some views of them as a fit has them, float32."""
    cloud = even_upright(billboards, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([size, size]))
    cameras = Orbit(7, (10.0,)).frame(CORNERS, target=torch.zeros(3).double(), width=size, height=size)
    return noise(cloud), cameras[1 : 1 + views]


def scenes(count: int) -> list[tuple[BillboardCloud, Camera]]:
    """Tilted planes, near, far and partly behind, with textures finer and coarser than pixels, pinhole and parallel."""
    made = []
    for seed in range(count):
        cloud, camera = random_scene(seed, 3, orthographic=seed % 2 == 1)
        sizes = cloud.texture_sizes * (1 + 7 * (seed % 3))
        cloud = replace(cloud, texture_sizes=sizes, texels=torch.zeros(int((sizes.prod(-1) * (1 + cloud.two_sided.long())).sum()), 4))
        made.append((cloud, camera.resized(24, 40)))
        for fov in (35.0, None):
            elevation, extent = -50.0 + 25 * (seed % 5), 1.0 + seed % 3
            made.append((cloud, ring(extent * CORNERS, 31, 60, elevation, fov)))
    return made


def ring(points: np.ndarray, width: int, height: int, elevation: float = 0.0, fov: float | None = 35.0) -> Camera:
    """Three cameras around the origin."""
    return Orbit(3, (elevation,)).frame(points, target=torch.zeros(3).double(), width=width, height=height, fov_x_degrees=fov)


def upright(size: int, count: int = 4) -> BillboardCloud:
    """Billboards as a fit starts with."""
    return even_upright(count, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([size, size]))
