"""As much of the pictures covered by a masked cloud as by the tree."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from bbfit.geometry.camera import Camera, convergence_point
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.config import Backend
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet

# Views that are enough to tell, how far alpha is shifted at most, and how often the interval is halved.
_VIEWS, _MOST, _HALVINGS = 12, 0.3, 8
# Power of the distance from the cutoff, as a share of what it may be, that spreads alpha.
_SPREAD = 0.4
# Degrees that cameras are turned by.
_TURN = 3.0


def matched_coverage(cloud: BillboardCloud, views: ViewSet, backend: Backend = "auto") -> BillboardCloud:
    """A masked cloud with alpha as 8-bit textures hold it, which covers as much of the views as the tree does.

    A fit leaves the alpha of texels that are in some views and not in others within a thousandth of the cutoff, where rounding to 8 bits
    would decide over them all at once. So distances from the cutoff are spread, texels keeping their order. Then alpha is shifted by
    one number, found by bisection, everywhere but where it is 0.

    In the very views that it was fitted to a cloud covers less than from between them, by some per cent: there its layers were made to lie
    behind each other. So cameras are turned about the tree by a few degrees, this way and that, which changes what the tree itself covers
    by next to nothing.

    Parameters
    ----------
    cloud : of mode mask.
    views : training views, of which a dozen around the tree are looked at.
    """
    chosen = [index * len(views) // min(_VIEWS, len(views)) for index in range(min(_VIEWS, len(views)))]
    cameras = _turned(views.cameras[chosen]).to(cloud.texels.device)
    wanted = float(sum(views.image(index)[..., 3].double().mean() / 255 for index in chosen)) / len(chosen)
    rounded = (cloud.texels * 255).round() / 255
    alpha, cutoff = cloud.texels[:, 3], cloud.alpha.cutoff
    room = torch.where(alpha >= cutoff, 1 - cutoff, cutoff)
    spread = cutoff + (alpha - cutoff).sign() * room * ((alpha - cutoff).abs() / room) ** _SPREAD

    def shifted(by: float) -> BillboardCloud:
        moved = (torch.where(alpha > 0, spread + by, 0).clamp(0, 1) * 255).round() / 255
        return cloud.with_texels(torch.cat([rounded[:, :3], moved[:, None]], 1))

    low, high = -_MOST, _MOST
    for _ in range(_HALVINGS):
        drawn = shifted(0.5 * (low + high))
        covered = sum(float(render(drawn, cameras[index], backend=backend)[..., 3].mean()) for index in range(len(chosen))) / len(chosen)
        low, high = (0.5 * (low + high), high) if covered < wanted else (low, 0.5 * (low + high))
    return shifted(0.5 * (low + high))


def _turned(cameras: Camera) -> Camera:
    """Cameras that circle what they look at by :data:`_TURN` degrees, one this way, the next that way."""
    middle = convergence_point(cameras).to(cameras.world_to_camera)
    turns = torch.eye(4).to(cameras.world_to_camera).repeat(len(cameras), 1, 1)
    angle = math.radians(_TURN) * (1 - 2 * (torch.arange(len(cameras)) % 2)).to(middle)
    turns[:, 0, 0], turns[:, 0, 2], turns[:, 2, 0], turns[:, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    turns[:, :3, 3] = middle - (turns[:, :3, :3] @ middle)
    return replace(cameras, world_to_camera=cameras.world_to_camera @ turns)
