"""Cameras, and the conventions of all of bbfit.

World
    Right-handed, Y up, meters, as in glTF.
Camera axes
    +X right, +Y down, +Z forward, as in OpenCV and kornia.
Pixels
    (0, 0) is the *center* of the top-left pixel, in images and textures alike.

Only :func:`camera_from_nerf` and :func:`camera_to_nerf` convert to and from the Z-up worlds of Blender and of the NeRF-synthetic layout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import check_count, check_shape, fail

# Viewing directions with a shorter horizontal part count as straight up or down.
VERTICAL = 1e-6
# (x, y, z) of a Z-up world -> (x, z, -y) of bbfit's.
Z_UP_TO_Y_UP: tuple[tuple[float, ...], ...] = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))


@dataclass(frozen=True)
class Camera:
    """One camera, or a batch of V cameras that share an image size.

    An integer index into a batch gives one camera (no leading dimension), any other index a smaller batch.
    """

    world_to_camera: Tensor
    """Rigid transform, [V, 4, 4] or [4, 4]."""
    intrinsics: Tensor
    """Calibration matrix, [V, 3, 3] or [3, 3]: focal lengths in pixels (pixels per meter when orthographic) and principal point."""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    orthographic: bool = False
    """Parallel projection along +Z instead of a pinhole."""

    def __post_init__(self) -> None:
        lead = tuple(self.world_to_camera.shape[:-2])
        if len(lead) > 1:
            fail("world_to_camera", f"expected shape [V, 4, 4] or [4, 4], got {list(self.world_to_camera.shape)}")
        check_shape("world_to_camera", tuple(self.world_to_camera.shape), (*lead, 4, 4))
        check_shape("intrinsics", tuple(self.intrinsics.shape), (*lead, 3, 3))
        check_count("width", self.width)
        check_count("height", self.height)

    @staticmethod
    def joined(cameras: Sequence[Camera]) -> Camera:
        """The views of one or more cameras or batches, which must have one size and one projection, in one batch."""
        batches, first = [camera.batch() for camera in cameras], cameras[0]
        transforms, intrinsics = (torch.cat([getattr(batch, name) for batch in batches]) for name in ("world_to_camera", "intrinsics"))
        return Camera(transforms, intrinsics, first.width, first.height, first.orthographic)

    @property
    def batched(self) -> bool:
        """Whether there is a leading view dimension."""
        return self.world_to_camera.ndim == 3

    def __len__(self) -> int:
        if not self.batched:
            raise TypeError("a single camera has no length; use camera.batch()")
        return self.world_to_camera.shape[0]

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> Camera:
        if not self.batched:
            raise TypeError("a single camera cannot be indexed; use camera.batch()")
        return Camera(self.world_to_camera[index], self.intrinsics[index], self.width, self.height, self.orthographic)

    def batch(self) -> Camera:
        """The same cameras with a leading view dimension."""
        if self.batched:
            return self
        return Camera(self.world_to_camera[None], self.intrinsics[None], self.width, self.height, self.orthographic)

    def to(self, target: torch.device | torch.dtype | str) -> Camera:
        """Move to a device or convert to a dtype."""
        return Camera(self.world_to_camera.to(target), self.intrinsics.to(target), self.width, self.height, self.orthographic)

    def resized(self, width: int, height: int) -> Camera:
        """The same cameras with pictures of ``width`` x ``height`` pixels of the same field of view."""
        scale = torch.tensor([width / self.width, height / self.height], dtype=self.intrinsics.dtype, device=self.intrinsics.device)
        intrinsics = self.intrinsics.clone()
        intrinsics[..., :2, :] *= scale[:, None]
        intrinsics[..., :2, 2] += (scale - 1) / 2  # pixel centers lie at whole numbers, so the corner is at -1/2
        return Camera(self.world_to_camera, intrinsics, width, height, self.orthographic)

    def turned(self, degrees: float, axis: Tensor) -> Camera:
        """The same cameras turned around the vertical axis through a point, [3], counter-clockwise seen from above: to greater azimuths."""
        angle = math.radians(degrees)
        back = torch.eye(4, dtype=self.world_to_camera.dtype, device=self.world_to_camera.device)  # turns the world instead
        back[0, 0] = back[2, 2] = math.cos(angle)
        back[0, 2], back[2, 0] = -math.sin(angle), math.sin(angle)
        axis = axis.to(back)
        back[:3, 3] = axis - back[:3, :3] @ axis
        return Camera(self.world_to_camera @ back, self.intrinsics, self.width, self.height, self.orthographic)

    @property
    def camera_to_world(self) -> Tensor:
        """Rigid transform from camera axes to the world, same shape as ``world_to_camera``."""
        rotation = self.world_to_camera[..., :3, :3].mT
        translation = -(rotation @ self.world_to_camera[..., :3, 3:])
        bottom = self.world_to_camera[..., 3:, :]
        return torch.cat([torch.cat([rotation, translation], -1), bottom], -2)

    @property
    def position(self) -> Tensor:
        """Camera centers in the world, [V, 3] or [3]."""
        return self.camera_to_world[..., :3, 3]

    @property
    def forward(self) -> Tensor:
        """Unit viewing directions in the world, [V, 3] or [3]."""
        return self.world_to_camera[..., 2, :3]

    @property
    def camera_to_pixel(self) -> Tensor:
        """Homogeneous projection of camera-space points, [V, 3, 4] or [3, 4].

        A pinhole gives (x·z, y·z, z), an orthographic camera (x, y, 1) (Hartley and Zisserman 2004, equations 6.1 and 6.19).
        """
        k = self.intrinsics
        column = torch.zeros_like(k[..., :, :1])
        if not self.orthographic:
            return torch.cat([k, column], -1)
        return torch.stack([k[..., :, 0], k[..., :, 1], column[..., 0], k[..., :, 2]], -1)

    @property
    def world_to_pixel(self) -> Tensor:
        """Homogeneous projection of world points, [V, 3, 4] or [3, 4]."""
        return self.camera_to_pixel @ self.world_to_camera

    def project(self, points: Tensor) -> Tensor:
        """Pixel coordinates of world points.

        Parameters
        ----------
        points
            World points in meters, [P, 3].

        Returns
        -------
        Tensor
            [V, P, 2] or [P, 2] pixel coordinates; NaN for points at or behind a pinhole camera.
        """
        homogeneous = torch.cat([points, torch.ones_like(points[:, :1])], -1)
        projected = homogeneous @ self.world_to_pixel.mT
        scale = projected[..., 2:]
        return torch.where(scale > 0, projected[..., :2] / scale, torch.nan)


def pinhole_intrinsics(fov_x_degrees: float, width: int, height: int) -> Tensor:
    """Intrinsics of a pinhole with square pixels and a centered principal point, [3, 3] float64.

    The field of view spans pixel *edges*, as in Blender and in the NeRF-synthetic layout. The principal point, which is relative to pixel
    centers, is therefore ((width - 1) / 2, (height - 1) / 2).
    """
    return _intrinsics(focal_pixels(width, fov_x_degrees), width, height)


def focal_pixels(side: float, fov_degrees: float) -> float:
    """The focal length in pixels of a picture whose side of ``side`` pixels has a field of view of ``fov_degrees``.

    A length of a meter that faces the camera has this many pixels at a distance of a meter.
    """
    return side / 2 / math.tan(math.radians(fov_degrees) / 2)


def orthographic_intrinsics(extent_x: float, width: int, height: int) -> Tensor:
    """Intrinsics of an orthographic camera whose image is ``extent_x`` meters wide, [3, 3] float64."""
    return _intrinsics(width / extent_x, width, height)


def _intrinsics(focal: float, width: int, height: int) -> Tensor:
    center = ((width - 1) / 2, (height - 1) / 2)
    return torch.tensor([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], dtype=torch.float64)


def look_at(position: Tensor, target: Tensor) -> Tensor:
    """World-to-camera transforms, [V, 4, 4], of cameras at [V, 3] that look at a target, [3] or [V, 3], with the world's Y up, in meters.

    A camera straight above or below its target takes the world's -Z as the image's up direction.
    """
    forward = torch.nn.functional.normalize(target - position, dim=-1)
    up = torch.zeros_like(forward)
    up[:, 1] = 1
    vertical = forward[:, ::2].norm(dim=-1) < VERTICAL
    up[vertical] = torch.tensor([0.0, 0.0, -1.0], dtype=up.dtype, device=up.device)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], -2)
    transform = torch.eye(4, dtype=position.dtype, device=position.device).repeat(len(position), 1, 1)
    transform[:, :3, :3] = rotation
    transform[:, :3, 3] = -(rotation @ position[..., None])[..., 0]
    return transform


def camera_from_nerf(camera_to_world: Tensor) -> Tensor:
    """World-to-camera transforms in bbfit's conventions from camera-to-world matrices of the NeRF-synthetic layout, both [V, 4, 4].

    The layout's world is Z up; its cameras look along -Z with +Y up (OpenGL).
    """
    axes = torch.tensor(Z_UP_TO_Y_UP, dtype=camera_to_world.dtype, device=camera_to_world.device)
    ours = axes @ camera_to_world @ _flip_yz(camera_to_world)
    return torch.linalg.inv(ours)


def camera_to_nerf(world_to_camera: Tensor) -> Tensor:
    """The inverse of :func:`camera_from_nerf`, [V, 4, 4] -> [V, 4, 4]."""
    axes = torch.tensor(Z_UP_TO_Y_UP, dtype=world_to_camera.dtype, device=world_to_camera.device)
    return axes.mT @ torch.linalg.inv(world_to_camera) @ _flip_yz(world_to_camera)


def _flip_yz(like: Tensor) -> Tensor:
    return torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=like.dtype, device=like.device))


def convergence_point(camera: Camera) -> Tensor:
    """The point nearest to all optical axes in the least-squares sense, [3]: the target of a ring of cameras.

    Raises ``InputError`` if the axes are parallel, so that no such point is determined.
    """
    camera = camera.batch()
    direction = camera.forward
    across = torch.eye(3, dtype=direction.dtype, device=direction.device) - direction[:, :, None] * direction[:, None, :]
    normal = across.sum(0)
    if torch.linalg.cond(normal) > 1e8:
        fail("cameras", "all look the same way, so the tree's axis is unknown", "give views from around the tree")
    return torch.linalg.solve(normal, (across @ camera.position[..., None]).sum(0))[:, 0]
