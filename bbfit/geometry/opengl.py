"""Cameras as OpenGL and WebGL have them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.geometry.camera import Camera

# OpenCV's camera axes to OpenGL's: +Y up, -Z forward.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def projection_matrix(camera: Camera, near: float, far: float) -> NDArray[np.float64]:
    """OpenGL's projection of one camera, [4, 4]: from its axes as OpenGL has them (+Y up, -Z forward) to clip coordinates.

    ``near`` and ``far`` are depths in meters. Pixel x, whose center is the whole number, lies at (2 x + 1) / width - 1 of OpenGL's picture,
    which reaches from -1 to 1.
    """
    to_clip = np.array([[2 / camera.width, 0, 1 / camera.width - 1], [0, -2 / camera.height, 1 - 1 / camera.height], [0, 0, 1]])
    x, y, w = to_clip @ camera.camera_to_pixel.double().numpy()
    if camera.orthographic:
        z = np.array([0, 0, 2 / (far - near), -(far + near) / (far - near)])
    else:
        z = np.array([0, 0, (far + near) / (far - near), -2 * far * near / (far - near)])
    return np.stack([x, y, z, w]) @ _FLIP


def camera_to_world_matrix(camera: Camera) -> NDArray[np.float64]:
    """The place and the axes of one camera as OpenGL has them (+X right, +Y up, -Z forward), [4, 4]."""
    return camera.camera_to_world.double().numpy() @ _FLIP
