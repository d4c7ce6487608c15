"""What Blender's EEVEE shows of exported cards, drawn by bbfit's reference renderer with EEVEE's way of reading textures."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.light import Light
from bbfit.operators.cards.reference import draw_cards_by
from bbfit.operators.cards.sampling import MipChain, footprint, sampled
from bbfit.operators.cards.sheets import prepared_cards
from bbfit.operators.shading.reference import decode, encode

LEVEL_BIAS = -0.62
"""What EEVEE of Blender 4.5 adds to the level of detail: a mask of noise that faces the camera is 65 dB from it so, and at -0.61 or -0.63
39 dB at most."""


def draw_as_eevee(cards: Cards, camera: Camera, light: Light | None = None) -> Tensor:
    """Draw cards with hard edges as EEVEE does, with one sample a pixel: premultiplied RGBA in [0, 1], float32 [V, H, W, 4].

    EEVEE takes finer levels of detail than OpenGL by itself and mixes colors in linear light. It lights polygons by the sun from both sides
    and by the whole sky, where Cycles lights the visible side. Like Cycles it ignores occlusion.
    """
    prepared = prepared_cards(replace(cards, traced=False), multisampled=False)
    return draw_cards_by(_sampled, prepared, camera.batch(), light)


def _sampled(levels: MipChain, uv: Tensor, detail: Tensor) -> Tensor:
    colors, others = (levels.texels.float() / 255).tensor_split([3], -1)
    mixed = sampled(torch.cat([decode(colors), others], -1), footprint(levels, uv, detail + LEVEL_BIAS))
    mixed[:, 7:8] = 1  # occlusion
    return 255 * torch.cat([encode(mixed[:, :3]), mixed[:, 3:]], -1)
