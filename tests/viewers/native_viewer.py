"""What VTK, F3D and Panda3D show of a GLB, without a screen, each in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.geometry.camera import Camera

Program = Literal["vtk", "f3d", "panda3d"]
SCRIPT = Path(__file__).with_name("native_script.py")
# Cameras see from this share of their distance to the world's origin to this multiple of it.
CLIP = (1e-2, 1e2)


def render_native(program: Program, model: Path, camera: Camera, *, as_it_comes: bool = False) -> NDArray[np.float64]:
    """Display-referred RGB over white in [0, 1] of a batch of V pinhole cameras, [V, H, W, 3].

    The program is set up as docs/engines.md says, and VTK's anisotropic filter, which bbfit's drawing lacks, is off;
    ``as_it_comes`` leaves VTK's and F3D's settings alone. F3D has no camera with its axis off the picture's middle.

    The test fails where the program is not installed; what it says is the message of an ``AssertionError`` where it fails itself.
    """
    if importlib.util.find_spec(program) is None:
        pytest.fail(f"{program} is not installed: install bbfit with its extra viewers")
    camera = camera.batch()
    assert not camera.orthographic
    with tempfile.TemporaryDirectory(prefix="bbfit-") as folder:
        job = {
            "program": program,
            "model": str(model),
            "folder": folder,
            "width": camera.width,
            "height": camera.height,
            "views": [_view(camera[index]) for index in range(len(camera))],
            "as_it_comes": as_it_comes,
        }
        done = subprocess.run([sys.executable, "-P", str(SCRIPT)], input=json.dumps(job), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        pictures = [np.load(path) for path in sorted(Path(folder).glob("*.npy"))]
    images = np.stack(pictures) / 255.0
    assert images.shape == (len(camera), camera.height, camera.width, 3)
    return images


def _view(camera: Camera) -> dict[str, object]:
    """One camera: its position and axes in the world, and in pixels its focal length and how far its axis is from the picture's middle."""
    k, world = camera.intrinsics.double().numpy(), camera.world_to_camera.double().numpy()
    _, down, forward = world[:3, :3]
    distance = float(camera.position.norm())
    return {
        "position": camera.position.tolist(),
        "forward": forward.tolist(),
        "up": (-down).tolist(),
        "distance": distance,
        "focal": float(k[1, 1]),
        "aside": [float(k[0, 2] - (camera.width - 1) / 2), float(k[1, 2] - (camera.height - 1) / 2)],
        "clip": [CLIP[0] * distance, CLIP[1] * distance],
    }
