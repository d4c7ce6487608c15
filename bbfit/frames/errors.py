"""How far a model, drawn in three.js at the size that it has in a field, is from the tree."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bbfit.evaluation import metrics
from bbfit.evaluation.afar import seen_afar, shown_height
from bbfit.evaluation.backgrounds import BACKGROUNDS, over_background
from bbfit.evaluation.scoring import view_angles
from bbfit.frames.browser import FieldPage
from bbfit.frames.models import DrawnModel
from bbfit.geometry.camera import Camera
from bbfit.geometry.opengl import camera_to_world_matrix, projection_matrix
from bbfit.images import over_color
from bbfit.reporting.plots import spread_views
from bbfit.views.view_set import ViewSet


@dataclass(frozen=True)
class SizeError:
    """The error of a model in pictures of one size."""

    tree_pixels: float
    """Mean height of the tree in the pictures, in pixels."""
    flip: float
    """FLIP, the mean over backgrounds, views and pixels."""
    psnr: float | None
    """PSNR in dB, the mean over backgrounds and views; ``None`` if a picture has no error."""


def size_error(model: DrawnModel, page: FieldPage, views: ViewSet, tree_pixels: int, count: int) -> SizeError | None:
    """The error of a model in at most ``count`` of some held-out views, in pictures in which the tree is ``tree_pixels`` high.

    The targets are the views, averaged to that size; if they are smaller, they keep their own size. The page has loaded the model, and
    draws it over each background with four samples a pixel. Colors of a model that takes a program's light are not those of the views. Its
    pictures by Blender are averaged to the size instead, so they have no aliasing at all; ``None`` if there are none. The same holds for
    the level of detail that is shown at that size.
    """
    flips, psnrs, heights = [], [], []
    for index in spread_views(view_angles(views.cameras).numpy(), count):
        height = shown_height(views, index)
        if height == 0:
            continue
        view = seen_afar(views, index, tree_pixels / height)
        target, camera = view.target, view.camera
        heights.append(view.tree_pixels)
        rendered = None
        for name, color in BACKGROUNDS.items():
            if rendered is None:
                background = torch.tensor(color, dtype=torch.float64)
                pair = over_color(target, background).numpy(), _drawn(page, camera, color).numpy()
                level = page.call("level")
                if model.lit[level]:
                    if not (model.pictures and model.pictures[level]):
                        return None
                    rendered = ViewSet.of_files(model.pictures[level], views.cameras).draw(camera)
            if rendered is not None:
                pair = over_background(target, rendered, name)
            flips.append(metrics.flip(*pair))
            psnrs.append(metrics.psnr(*pair))
    if not heights:
        return None
    psnr = None if metrics.decibels(0.0) in psnrs else float(np.mean(psnrs))
    return SizeError(float(np.mean(heights)), float(np.mean(flips)), psnr)


def _drawn(page: FieldPage, camera: Camera, color: tuple[float, float, float]) -> Tensor:
    """What the page draws over a color, float64 RGB [H, W, 3]."""
    reach = 4 * float(camera.position.norm()) + 1.0
    view = {
        "width": camera.width,
        "height": camera.height,
        "projection": projection_matrix(camera, 1e-3 * reach, reach).T.ravel().tolist(),
        "cameraToWorld": camera_to_world_matrix(camera).T.ravel().tolist(),
        "fov": math.degrees(2 * math.atan(camera.height / 2 / float(camera.intrinsics[1, 1]))),
        "color": list(color),
    }
    pixels = np.frombuffer(base64.b64decode(page.call("picture", view)), np.uint8).reshape(camera.height, camera.width, 4)
    return torch.from_numpy(pixels[::-1, :, :3].astype(np.float64) / 255)
