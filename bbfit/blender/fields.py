"""Render a field of copies of a tree with Cycles, and measure what that costs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.pictures import frames, worker_settings
from bbfit.blender.processes import BlenderPool, require_bpy
from bbfit.files import write_bytes
from bbfit.geometry.camera import Camera
from bbfit.scratch import ScratchFolder
from bbfit.tree_files.tree_file import TreeFile


@dataclass(frozen=True)
class RenderCost:
    """What a picture costs."""

    seconds: float
    """Time of the render: scene, acceleration structure and paths, without reading the tree's file."""
    bytes: int
    """Most memory of Blender's process."""


def render_field(
    tree: str | Path | TreeFile, matrices: NDArray[np.float32], camera: Camera, reach: float, picture: Path, config: ViewsConfig
) -> RenderCost:
    """Render copies of a tree into a PNG file, in the light of views, without denoising. The copies share the tree's data.

    Parameters
    ----------
    tree
        A tree, as for :func:`~bbfit.blender.views_folder.render_views`.
    matrices
        Where each copy stands, [N, 16], column after column, for a world with Y up.
    camera
        A single camera with a square picture.
    reach
        Nothing is farther away from the camera, in meters.
    picture
        The PNG file to write, in an existing folder.
    config
        Light, samples and device.

    Raises
    ------
    MissingFileError, InputError
        If the tree cannot be used, if the picture cannot be written, or if Blender is not installed.
    BlenderError
        If Blender crashes.
    """
    tree, cameras = TreeFile.open(tree), camera.batch()
    require_bpy()
    with ScratchFolder() as scratch:
        write_bytes(scratch / "matrices.bin", matrices.astype(np.float32).tobytes())
        (frame,) = frames(cameras, [picture], [0], [(1e-3 * reach, reach)], config)
        with BlenderPool(worker_settings(tree, config, cameras.width, 1) | {"denoise": False}) as pool:
            cost = pool.render_field(scratch / "matrices.bin", frame)
    return RenderCost(cost["seconds"], cost["bytes"])
