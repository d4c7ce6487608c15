"""Masks as blended textures, for programs that blend everything with alpha."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.drawing.compositing import coverage


def smoothed(cloud: BillboardCloud) -> BillboardCloud:
    """A cloud with the alpha mode ``mask`` or ``coverage`` as one with ``blend`` that looks like it; of other modes it is the cloud itself.

    The alpha of a texel becomes the share of it that the mask covers: from 0 to 1 over one texel across the cutoff's contour
    (:func:`~bbfit.operators.drawing.compositing.coverage`; central differences are the change of alpha from texel to texel). So edges are
    one texel wide, the interior is opaque, and what was under the cutoff is gone.
    """
    if not cloud.alpha.tested:
        return cloud
    if cloud.alpha.kind == "coverage":
        return replace(cloud, alpha=AlphaMode())
    texels = [_smoothed(side, cloud.alpha).reshape(-1, 4) for texture in cloud.textures() for side in texture]
    return replace(cloud, texels=torch.cat(texels), alpha=AlphaMode())


def _smoothed(texture: Tensor, mode: AlphaMode) -> Tensor:
    """A straight-alpha texture, [h, w, 4], with the mask's coverage of each texel as its alpha."""
    alpha = texture[..., 3]
    down, across = (torch.from_numpy(slope)[1:-1, 1:-1].to(alpha) for slope in np.gradient(np.pad(alpha.detach().cpu().numpy(), 1)))
    return torch.cat([texture[..., :3], coverage(alpha, torch.hypot(down, across), mode)[..., None]], -1)
