"""The plane homographies between a billboard's texels and a camera's pixels.

A texel (x, y) of a billboard lies at the world point ``texel_to_world @ (x, y, 1)``; projecting it is linear in homogeneous
coordinates, so texel and pixel are related by one 3x3 matrix (Hartley and Zisserman 2004, section 2.3 and equation 8.1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud


def texel_to_world(cloud: BillboardCloud) -> Tensor:
    """Affine maps from homogeneous texel coordinates to homogeneous world points, [N, 4, 3]."""
    size = cloud.texture_sizes.flip(-1).to(cloud.half_extents)  # width, height
    step = 2 * cloud.half_extents / size  # meters a texel
    along_x = cloud.rights * step[:, :1]
    along_y = -cloud.ups * step[:, 1:]
    origin = cloud.centers - (along_x * (size[:, :1] - 1) + along_y * (size[:, 1:] - 1)) / 2
    top = torch.stack([along_x, along_y, origin], -1)
    bottom = torch.tensor([0.0, 0.0, 1.0], dtype=top.dtype, device=top.device).expand(len(top), 1, 3)
    return torch.cat([top, bottom], -2)


def texel_to_pixel(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Homographies from texel centers to pixel centers, [V, N, 3, 3]; singular where a plane is seen edge-on."""
    return camera.batch().world_to_pixel[:, None] @ texel_to_world(cloud)


def pixel_depth(cloud: BillboardCloud, camera: Camera) -> tuple[Tensor, Tensor]:
    """Rows whose quotient is the depth at which a pixel's ray meets a plane, numerator and denominator, both [V, N, 3].

    The ray of the homogeneous pixel p meets the plane (numerator . p) / (denominator . p) meters along the camera's +Z: behind the
    camera where that is negative, at infinity, on the plane's horizon, where the denominator vanishes. Nothing is inverted that
    depends on the plane, so planes seen edge-on do no harm, and coincident planes have exactly equal depths whatever their textures.
    """
    camera = camera.batch()
    rotation, translation = camera.world_to_camera[:, None, :3, :3], camera.world_to_camera[:, None, :3, 3]
    normals = (rotation * cloud.normals[:, None]).sum(-1)  # in camera axes, [V, N, 3]
    offset = (normals * ((rotation * cloud.centers[:, None]).sum(-1) + translation)).sum(-1, keepdim=True)
    to_ray = torch.linalg.inv(camera.intrinsics)  # pixel -> (x, y, 1)
    last = torch.tensor([0.0, 0.0, 1.0], dtype=normals.dtype, device=normals.device)
    if camera.orthographic:  # rays start at (x, y, 0) and run along (0, 0, 1)
        return offset * last - (normals * (1 - last)) @ to_ray, normals[..., 2:] * last
    return offset * last, normals @ to_ray


def signed_distance(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Signed distance of each camera from each plane, [V, N]: positive in front, negative behind, zero edge-on.

    In meters for a pinhole; for parallel projection the sine of the angle between the viewing direction and the plane.
    """
    camera = camera.batch()
    if camera.orthographic:
        return -(camera.forward @ cloud.normals.mT)
    towards = camera.position[:, None] - cloud.centers
    return (towards * cloud.normals).sum(-1)
