"""Projection by Warp kernels, for billboards that move: one launch there and one back, where torch would take a hundred small ones."""

# mypy: ignore-errors
# ruff: noqa: UP018 - int(0) declares a variable of a kernel, 0 a constant.

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.kernels import Plane
from bbfit.rendering.launching import FLAGS
from bbfit.rendering.projection import SLACK as SLACK_VALUE
from bbfit.rendering.projection import Projection
from bbfit.rendering.reference import EDGE_ON as EDGE_ON_VALUE

SLACK, EDGE_ON = wp.constant(wp.float64(SLACK_VALUE)), wp.constant(wp.float64(EDGE_ON_VALUE))
# Depth from which a corner counts as lying before the camera.
BEFORE = wp.constant(wp.float64(1e-9))
ZERO, ONE, TWO = wp.constant(wp.float64(0)), wp.constant(wp.float64(1)), wp.constant(wp.float64(2))

mat34d = wp.types.matrix(shape=(3, 4), dtype=wp.float64)
mat43d = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.struct
class Lens:
    """A camera."""

    world_to_pixel: mat34d
    world_to_camera: wp.mat44d
    pixel_to_ray: wp.mat33d
    position: wp.vec3d


@wp.struct
class Rectangle:
    """Where a billboard is: its center, axes and half extents."""

    center: wp.vec3d
    right: wp.vec3d
    up: wp.vec3d
    half: wp.vec2d


@wp.func
def texel_to_world(r: Rectangle, width: wp.float64, height: wp.float64) -> mat43d:
    """See :func:`bbfit.geometry.homography.texel_to_world`."""
    along_x = r.right * (TWO * r.half[0] / width)
    along_y = r.up * (-TWO * r.half[1] / height)
    origin = r.center - (along_x * (width - ONE) + along_y * (height - ONE)) / TWO
    return mat43d(
        along_x[0], along_y[0], origin[0],
        along_x[1], along_y[1], origin[1],
        along_x[2], along_y[2], origin[2],
        ZERO, ZERO, ONE,
    )  # fmt: skip


@wp.kernel
def _project_planes(
    chosen: wp.array(dtype=wp.int32),
    width: int,
    height: int,
    orthographic: int,
    lenses: wp.array(dtype=Lens),
    rectangles: wp.array(dtype=Rectangle),
    textures: wp.array(dtype=wp.vec4i),
    planes: wp.array2d(dtype=Plane),
    to_texel: wp.array2d(dtype=wp.mat33d),
    rows_apart: wp.array(dtype=wp.int32),
):
    """Launched over views and billboards; ``textures`` are first texel, height, width, and how far on the back's first texel is."""
    b, n = wp.tid()
    lens = lenses[chosen[b]]
    r = rectangles[n]
    texture = textures[n]
    normal = wp.cross(r.right, r.up)
    pose = lens.world_to_camera
    towards = lens.position - r.center
    distance = wp.dot(towards, normal)
    reach = wp.length(towards)
    if orthographic != 0:
        distance = -wp.dot(wp.vec3d(pose[2, 0], pose[2, 1], pose[2, 2]), normal)
        reach = ONE
    visible = wp.abs(distance) > EDGE_ON * reach and r.half[0] != ZERO and r.half[1] != ZERO
    w = wp.float64(texture[2])
    h = wp.float64(texture[1])
    m = wp.identity(n=3, dtype=wp.float64)
    if visible:
        m = lens.world_to_pixel * texel_to_world(r, w, h)
    inverse = wp.inverse(m)
    to_texel[b, n] = inverse

    plane = planes[b, n]
    plane.to_texel = wp.mat33(inverse)
    near = wp.vec3d(inverse[2, 0], inverse[2, 1], inverse[2, 2])
    if orthographic != 0:
        across = wp.vec3d()
        for i in range(3):
            across[i] = pose[i, 0] * normal[0] + pose[i, 1] * normal[1] + pose[i, 2] * normal[2]
        offset = wp.dot(across, wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])) + wp.dot(normal, r.center)
        near = wp.vec3d(across[0], across[1], ZERO) * lens.pixel_to_ray - wp.vec3d(ZERO, ZERO, offset)
        if visible:
            near /= across[2]
    plane.nearness = wp.vec3(near)
    first = texture[0]
    if distance < ZERO:
        first += texture[3]
    plane.texture = wp.vec3i(first, texture[1], texture[2])

    # A margin of one texel around the rectangle: see bbfit.rendering.projection.
    before = bool(True)
    behind = bool(True)
    nearest = wp.float64(wp.inf)
    left, right, top, bottom = wp.float64(wp.inf), wp.float64(-wp.inf), wp.float64(wp.inf), wp.float64(-wp.inf)
    slope_u, slope_v = wp.float64(0.0), wp.float64(0.0)
    for corner in range(4):
        u = wp.where(corner < 2, -ONE, w)
        v = wp.where(corner % 2 == 0, -ONE, h)
        at = m * wp.vec3d(u, v, ONE)
        before = before and at[2] > BEFORE
        behind = behind and at[2] <= ZERO
        nearest = wp.min(nearest, at[2])
        left, right = wp.min(left, at[0] / at[2]), wp.max(right, at[0] / at[2])
        top, bottom = wp.min(top, at[1] / at[2]), wp.max(bottom, at[1] / at[2])
        slope_u = wp.max(slope_u, wp.abs(m[1, 0] * at[2] - at[1] * m[2, 0]))
        slope_v = wp.max(slope_v, wp.abs(m[1, 1] * at[2] - at[1] * m[2, 1]))
    wide, high = wp.float64(width), wp.float64(height)
    box = wp.vec4i(0, width - 1, 0, height - 1)
    apart = int(height)
    if before:
        box = wp.vec4i(
            int(wp.max(wp.ceil(wp.clamp(left - SLACK, -ONE, wide)), ZERO)),
            int(wp.min(wp.floor(wp.clamp(right + SLACK, -ONE, wide)), wide - ONE)),
            int(wp.max(wp.ceil(wp.clamp(top - SLACK, -ONE, high)), ZERO)),
            int(wp.min(wp.floor(wp.clamp(bottom + SLACK, -ONE, high)), high - ONE)),
        )
        apart = int(wp.ceil(wp.clamp(TWO * (slope_u + slope_v) / (nearest * nearest) + SLACK, ONE, high)))
    if behind or not visible:
        box = wp.vec4i(1, 0, 1, 0)
        apart = 1
    plane.box = box
    planes[b, n] = plane
    wp.atomic_max(rows_apart, b, apart)


@wp.kernel
def _pull_back(
    chosen: wp.array(dtype=wp.int32),
    lenses: wp.array(dtype=Lens),
    rectangles: wp.array(dtype=Rectangle),
    textures: wp.array(dtype=wp.vec4i),
    to_texel: wp.array2d(dtype=wp.mat33d),
    of_matrices: wp.array2d(dtype=wp.mat33d),
    of_rectangles: wp.array(dtype=Rectangle),
):
    """Gradients in rectangles from gradients in their matrices; launched over billboards."""
    n = wp.tid()
    g = mat43d()
    for b in range(chosen.shape[0]):
        back = wp.transpose(to_texel[b, n])
        g -= wp.transpose(lenses[chosen[b]].world_to_pixel) * (back * of_matrices[b, n] * back)
    r = rectangles[n]
    w = wp.float64(textures[n][2])
    h = wp.float64(textures[n][1])
    of_origin = wp.vec3d(g[0, 2], g[1, 2], g[2, 2])
    of_x = wp.vec3d(g[0, 0], g[1, 0], g[2, 0]) - of_origin * ((w - ONE) / TWO)
    of_y = wp.vec3d(g[0, 1], g[1, 1], g[2, 1]) - of_origin * ((h - ONE) / TWO)
    out = of_rectangles[n]
    out.center = of_origin
    out.right = of_x * (TWO * r.half[0] / w)
    out.up = of_y * (-TWO * r.half[1] / h)
    out.half = wp.vec2d(TWO / w * wp.dot(of_x, r.right), -TWO / h * wp.dot(of_y, r.up))
    of_rectangles[n] = out


class Projector:
    """Projects billboards, of which only the placement changes, into some of V views at a time.

    Means what :func:`bbfit.rendering.projection.project` does, up to the rounding of float64.
    """

    def __init__(self, cloud: BillboardCloud, cameras: Camera) -> None:
        cameras = cameras.batch().to(torch.float64)
        self._cameras, self._device = cameras, cloud.texels.device
        parts = (cameras.world_to_pixel, cameras.world_to_camera, torch.linalg.inv(cameras.intrinsics), cameras.position)
        self._lenses = torch.cat([part.flatten(1) for part in parts], -1).to(self._device)
        area = cloud.texture_sizes.prod(-1)
        owned = area * (1 + cloud.two_sided.long())
        textures = torch.stack([owned.cumsum(0) - owned, *cloud.texture_sizes.unbind(-1), area * cloud.two_sided], -1)
        self._textures = textures.to(torch.int32).to(self._device)
        self._last: tuple[Tensor, ...] | None = None

    def project(self, placement: Tensor, chosen: Sequence[int]) -> Projection:
        """What the chosen views see of the billboards.

        Parameters
        ----------
        placement : centers, rights, ups and half extents side by side, float64 [N, 11].
        """
        views, count = len(chosen), len(placement)
        placement = placement.to(self._device, torch.float64).contiguous()
        on = torch.tensor(chosen, dtype=torch.int32, device=self._device)
        planes = torch.empty(views, count, 19, dtype=torch.int32, device=self._device)
        to_texel = torch.empty(views, count, 3, 3, dtype=torch.float64, device=self._device)
        rows_apart = torch.ones(views, dtype=torch.int32, device=self._device)
        self._last = (on, placement, to_texel)
        cameras = self._cameras
        wp.launch(
            _project_planes,
            (views, count),
            [
                wp.from_torch(on),
                cameras.width,
                cameras.height,
                int(cameras.orthographic),
                _structs(self._lenses, Lens),
                _structs(placement, Rectangle),
                wp.from_torch(self._textures, dtype=wp.vec4i),
            ],
            [_structs(planes, Plane), wp.from_torch(to_texel, dtype=wp.mat33d), wp.from_torch(rows_apart)],
            device=wp.device_from_torch(self._device),
        )
        return Projection(
            planes[..., :9].view(torch.float32).unflatten(-1, (3, 3)),
            planes[..., 9:12].view(torch.float32),
            planes[..., 12:15],
            planes[..., 15:19],
            rows_apart,
            cameras.width,
            cameras.height,
            cameras.orthographic,
        )

    def pull_back(self, of_matrices: Tensor) -> Tensor:
        """The gradient in the last projected placement, float64 [N, 11], from that in its matrices ``to_texel``, float64 [B, N, 3, 3]."""
        assert self._last is not None
        on, placement, to_texel = self._last
        of_placement = torch.empty_like(placement)
        wp.launch(
            _pull_back,
            len(placement),
            [
                wp.from_torch(on),
                _structs(self._lenses, Lens),
                _structs(placement, Rectangle),
                wp.from_torch(self._textures, dtype=wp.vec4i),
                wp.from_torch(to_texel, dtype=wp.mat33d),
                wp.from_torch(of_matrices.contiguous(), dtype=wp.mat33d),
            ],
            [_structs(of_placement, Rectangle)],
            device=wp.device_from_torch(self._device),
        )
        return of_placement


def _structs(tensor: Tensor, kind: type) -> wp.array:
    """A Warp view of a tensor whose last dimension is the memory of a struct; the tensor must outlive it."""
    return wp.array(ptr=tensor.data_ptr(), shape=tuple(tensor.shape[:-1]), dtype=kind, device=wp.device_from_torch(tensor.device))
