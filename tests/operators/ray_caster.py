"""A second renderer for tests: every pixel's ray is met with every plane, in float64 numpy, with nothing shared with bbfit's own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud


def cast(cloud: BillboardCloud, camera: Camera) -> NDArray[np.float64]:
    """Premultiplied RGBA, [H, W, 4], of a single camera."""
    pose, k = camera.world_to_camera.double().numpy(), camera.intrinsics.double().numpy()
    rotation, translation = pose[:3, :3], pose[:3, 3]
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    flat = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1]], -1)
    zeros, ones = np.zeros_like(flat[..., :1]), np.ones_like(flat[..., :1])
    if camera.orthographic:
        starts, rays = np.concatenate([flat, zeros], -1), np.concatenate([flat * 0, ones], -1)
    else:
        starts, rays = np.zeros((*flat.shape[:2], 3)), np.concatenate([flat, ones], -1)
    starts, rays = (starts - translation) @ rotation, rays @ rotation  # the world's axes; one unit along a ray is one meter of depth
    eye = -rotation.T @ translation

    layers, depths = [], []
    for n, texture in enumerate(cloud.textures()):
        center, right, up = (t[n].detach().double().numpy() for t in (cloud.centers, cloud.rights, cloud.ups))
        normal = np.cross(right, up)
        facing = -rotation[2] @ normal if camera.orthographic else (eye - center) @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (center - starts) @ normal / (rays @ normal)
        met = (depth > 0) & np.isfinite(depth) & (abs(facing) > 1e-9)
        depth = np.where(met, depth, np.inf)
        hit = starts + rays * np.where(met, depth, 0)[..., None] - center
        height, width = texture.shape[1:3]
        half_width, half_height = cloud.half_extents[n].tolist()
        column = (hit @ right / half_width + 1) * width / 2 - 0.5
        row = (1 - hit @ up / half_height) * height / 2 - 0.5
        side = 1 if len(texture) == 2 and facing < 0 else 0
        layer = _bilinear(texture[side].detach().double().numpy(), column, row)
        layers.append(layer * met[..., None])
        depths.append(depth)

    image = np.zeros((camera.height, camera.width, 4))
    if not layers:
        return image
    order = np.argsort(np.stack(depths), 0, kind="stable")  # the lower index in front where depths are equal
    sorted_layers = np.take_along_axis(np.stack(layers), order[..., None], 0)
    for layer in sorted_layers[::-1]:
        image = layer + image * (1 - layer[..., 3:])
    return image


def _bilinear(texture: NDArray[np.float64], column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Straight color clamped at the border, alpha fading to zero beyond it; premultiplied after filtering."""
    height, width = texture.shape[:2]
    left, top = np.floor(column), np.floor(row)
    color, alpha = np.zeros((*column.shape, 3)), np.zeros(column.shape)
    for x, y in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        weight = (1 - abs(column - x)) * (1 - abs(row - y))
        tap = texture[np.clip(y, 0, height - 1).astype(int), np.clip(x, 0, width - 1).astype(int)]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        color += weight[..., None] * tap[..., :3]
        alpha += weight * inside * tap[..., 3]
    return np.concatenate([color * alpha[..., None], alpha[..., None]], -1)
