"""The opaque backgrounds of the scores, and measures of premultiplied RGBA pictures that are means over them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.evaluation import metrics
from bbfit.evaluation.metrics import Image
from bbfit.images import over_color

BACKGROUNDS: Mapping[str, tuple[float, float, float]] = {
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "grass": (0.25, 0.35, 0.12),
    "sky": (0.55, 0.70, 0.90),
}
"""Display-referred RGB of each background. A white haze is invisible over white, a dark one over black."""


def over_background(target: Tensor, image: Tensor, background: str) -> tuple[Image, Image]:
    """Two premultiplied RGBA pictures [H, W, 4] over one of :data:`BACKGROUNDS`, each float64 [H, W, 3]."""
    color = torch.tensor(BACKGROUNDS[background], dtype=torch.float64)
    return over_color(target, color).numpy(), over_color(image, color).numpy()


def mean_psnr(target: Tensor, image: Tensor) -> float:
    """PSNR in dB of two premultiplied RGBA pictures [H, W, 4], the mean of the decibels over :data:`BACKGROUNDS`."""
    color, alpha = torch.subtract(target, image).double().split([3, 1], -1)
    errors = [(color - alpha * color.new_tensor(background)).square().mean() for background in BACKGROUNDS.values()]
    return sum(metrics.decibels(float(error)) for error in errors) / len(errors)


def mean_flip_map(target: Tensor, image: Tensor) -> NDArray[np.float64]:
    """Perceived difference of each pixel of two premultiplied RGBA pictures [H, W, 4], the mean over :data:`BACKGROUNDS`, [H, W]."""
    total = np.zeros(tuple(target.shape[:2]))
    for name in BACKGROUNDS:
        total += metrics.flip_map(*over_background(target, image, name))
    return total / len(BACKGROUNDS)
