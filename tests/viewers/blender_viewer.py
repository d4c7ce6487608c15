"""What the real Blender shows of a GLB or an OBJ: its importer's materials, rendered by Cycles or EEVEE, in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.geometry.camera import Camera, camera_to_nerf
from bbfit.geometry.light import Light, to_z_up

SCRIPT = Path(__file__).with_name("blender_script.py")
# Cameras see from this share of their distance to the world's origin to this multiple of it, and a kilometre at least.
CLIP = (1e-2, 1e2)


def render_blender(
    model: Path,
    camera: Camera,
    *,
    samples: int = 1,
    light: Light | None = None,
    panorama: Path | None = None,
    as_it_comes: bool = False,
    eevee: bool = False,
) -> NDArray[np.float64]:
    """Display-referred RGB over white in [0, 1] of a batch of V cameras, in V lights or in one panorama if given, [V, H, W, 3];
    view transform Standard.

    The light reaches billboards as docs/engines.md sets Blender up for it, with no shadows of billboards on each other and with no
    correction of bumps; ``as_it_comes`` leaves both on. A panorama is an equirectangular picture in linear light.

    Every sample lies at the center of its pixel, so more than one only matters where Cycles chooses at random. Blender blends layers in
    linear light; the picture over the white is composited as bbfit does its own, display-referred. ``eevee`` needs OpenGL, and always uses
    mip levels.

    The test fails where Blender is not installed; what Blender says is the message of an ``AssertionError`` where it fails itself.
    """
    if importlib.util.find_spec("bpy") is None:
        pytest.fail("Blender is not installed: pip install bpy, or bbfit with its extra blender, on Python 3.11")
    camera = camera.batch()
    with tempfile.TemporaryDirectory(prefix="bbfit-") as folder:
        job = {
            "model": str(model),
            "folder": folder,
            "views": [_view(camera[index]) for index in range(len(camera))],
            "orthographic": camera.orthographic,
            "width": camera.width,
            "height": camera.height,
            "samples": samples,
            "lights": None if light is None else [_lamp(light[[index]]) for index in range(len(light))],
            "panorama": None if panorama is None else str(panorama),
            "as_it_comes": as_it_comes,
            "eevee": eevee,
        }
        # Its own folder for what Blender leaves behind, and no settings or add-ons of the user's.
        environment = os.environ | dict.fromkeys(("TMPDIR", "TEMP", "TMP", "BLENDER_USER_RESOURCES"), folder)
        done = subprocess.run([sys.executable, "-P", str(SCRIPT)], input=json.dumps(job), capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        pictures = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(Path(folder).glob("*.png"))]
    images = np.stack(pictures)[..., [2, 1, 0, 3]] / 65535.0
    assert images.shape == (len(camera), camera.height, camera.width, 4)
    color, alpha = images[..., :3], images[..., 3:]
    return color * alpha + 1 - alpha


def _view(camera: Camera) -> dict[str, Any]:
    """One camera in Blender's terms: shifts are in widths of the picture, from its middle."""
    k, width, height = camera.intrinsics.double().numpy(), camera.width, camera.height
    assert math.isclose(k[0, 0], k[1, 1], rel_tol=1e-6) and k[0, 1] == 0, "pixels must be square"
    distance = float(camera.position.norm())
    return {
        "camera_to_world": camera_to_nerf(camera.world_to_camera.double()[None])[0].tolist(),
        "angle": 2 * math.atan(width / (2 * k[0, 0])),
        "extent": width / k[0, 0],
        "shift": [((width - 1) / 2 - k[0, 2]) / width, (k[1, 2] - (height - 1) / 2) / width],
        "clip": [CLIP[0] * distance, max(CLIP[1] * distance, 1000.0)],
    }


def _lamp(light: Light) -> dict[str, Any]:
    """One light in Blender's terms."""
    return {
        "towards": to_z_up(light.sun_directions[0].tolist()),
        "strength": light.sun_strengths.item(),
        "color": light.sun_colors[0].tolist(),
        "ambient": light.ambients.item(),
    }
