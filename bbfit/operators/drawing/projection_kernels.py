"""Warp kernels that project moving billboards and differentiate the projection; one source for the CPU and CUDA.

**Forward.** A billboard with center c, unit axes r and u, half extents (a, b) and a texture of w x h texels has the texel-to-world matrix

    R = [[2a/w r, -2b/h u, o], [0, 0, 1]],    o = c - (w-1)/2 (2a/w r) - (h-1)/2 (-2b/h u),

and the homography from pixels to texels H = (W R)^-1, where W is the camera's world-to-pixel matrix (Hartley and Zisserman 2004, section
8.1.1: the image of a plane).

**Backward.** For a derivative G in H, d(M^-1) = -M^-1 dM M^-1 with M = W R gives

    dL/dR = -W^T H^T G H^T,

summed over views. Let x, y, o be its columns for the first three rows of R, after -(w-1)/2 o and -(h-1)/2 o were added to x and y. Then

    dL/dc = o,    dL/dr = 2a/w x,    dL/du = -2b/h y,    dL/da = 2/w x . r,    dL/db = -2/h y . u.
"""

# mypy: ignore-errors
# ruff: noqa: UP018 - int(0) declares a variable of a kernel, 0 a constant.

from __future__ import annotations

import warp as wp

from bbfit.operators.drawing.projection import SLACK as SLACK_VALUE
from bbfit.operators.drawing.reference import EDGE_ON as EDGE_ON_VALUE
from bbfit.operators.drawing.tile_kernels import Plane
from bbfit.operators.launching import FLAGS

SLACK, EDGE_ON = wp.constant(wp.float64(SLACK_VALUE)), wp.constant(wp.float64(EDGE_ON_VALUE))
# Least depth of a corner in front of the camera.
BEFORE = wp.constant(wp.float64(1e-9))
ZERO, ONE, TWO = wp.constant(wp.float64(0)), wp.constant(wp.float64(1)), wp.constant(wp.float64(2))

mat34d = wp.types.matrix(shape=(3, 4), dtype=wp.float64)
mat43d = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.struct
class Lens:
    """A camera's matrices."""

    world_to_pixel: mat34d
    world_to_camera: wp.mat44d
    pixel_to_ray: wp.mat33d
    position: wp.vec3d


@wp.struct
class Rectangle:
    """A billboard's center, axes and half extents."""

    center: wp.vec3d
    right: wp.vec3d
    up: wp.vec3d
    half: wp.vec2d


@wp.func
def texel_to_world(r: Rectangle, width: wp.float64, height: wp.float64) -> mat43d:
    """R, as :func:`bbfit.geometry.homography.texel_to_world`."""
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
def project_planes(
    chosen: wp.array(dtype=wp.int32),
    lenses: wp.array(dtype=Lens),
    rectangles: wp.array(dtype=Rectangle),
    textures: wp.array(dtype=wp.vec4i),  # texture_table of the projection module
    width: int,
    height: int,
    orthographic: int,
    planes: wp.array2d(dtype=Plane),
    to_texel: wp.array2d(dtype=wp.mat33d),
    rows_apart: wp.array(dtype=wp.int32),
):
    """Write what :class:`bbfit.operators.drawing.projection.Projection` holds; launched over views and billboards."""
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

    # With a margin of one texel around the rectangle, as in bbfit.operators.drawing.projection.
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
def pull_back(
    chosen: wp.array(dtype=wp.int32),
    lenses: wp.array(dtype=Lens),
    rectangles: wp.array(dtype=Rectangle),
    textures: wp.array(dtype=wp.vec4i),
    to_texel: wp.array2d(dtype=wp.mat33d),
    of_matrices: wp.array2d(dtype=wp.mat33d),
    of_rectangles: wp.array(dtype=Rectangle),
):
    """Write the gradients in rectangles for gradients in their homographies; launched over billboards."""
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
