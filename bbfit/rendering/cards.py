"""Renderer of exported cards: what a graphics card shows, with bilinear or trilinear filtering and the alpha mode.

Unlike the renderer of clouds it knows what files add: 8-bit textures, polygons smaller than their rectangles, culling, mip levels. It does
not model that graphics cards round the level of detail and the filter weights to about 8 bits, and that they compute derivatives from
differences between neighboring pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bbfit.checks import check_choice, fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.light import Light
from bbfit.operators.cards.reference import composited, draw_cards_reference, hits, shown
from bbfit.operators.cards.sheets import prepared_cards, seen_axes
from bbfit.operators.config import Backend


def draw_cards(
    cards: Cards, camera: Camera, light: Light | None = None, *, backend: Backend = "auto", multisampled: bool | None = None
) -> Tensor:
    """Draw cards on the CPU as a graphics card does: premultiplied RGBA in [0, 1], float32 [H, W, 4] for one camera and [V, H, W, 4] for a
    batch.

    Without mip levels, with one sample a pixel, and for cards that show their whole rectangles, the picture equals that of
    :func:`~bbfit.rendering.dispatch.render` up to the rounding of textures to 8 bits. Filtering and blending use display-referred values,
    as fits do. Programs that filter in linear light show slightly lighter colors and the same alpha.

    With mip levels the level of detail is log2 of the larger norm of the texel coordinates' derivatives along the screen's two axes (OpenGL
    4.6, section 8.14.1), exact for every pixel and clamped to the existing levels. The bilinear samples of the two nearest levels are
    interpolated (LINEAR_MIPMAP_LINEAR), straight color and alpha separately, and the result is tested or blended. Beyond its border the
    atlas is clamped.

    Cards with maps are shaded after filtering, per pixel, as graphics cards do (:mod:`bbfit.operators.shading` shades texels instead), or
    as a path tracer does (``cards.traced``). From behind, a card that shows both sides has opposite normals.

    A sample of a pixel shows a card if it lies in the polygon. Texture coordinates are those of the pixel's center, even if it lies
    outside, as graphics cards compute them (OpenGL 4.6, section 14.3.1). Layers are ordered by their depth at the center, as in
    :func:`~bbfit.operators.drawing.compositing.composite`. A plane shows nothing edge-on and behind the camera.

    Parameters
    ----------
    cards
        Polygons, their atlas and their mip levels, which need not reach down to one texel. Without levels the atlas is filtered bilinearly
        at every distance (sampler LINEAR).
    camera
        One camera or V cameras.
    light
        For cards with maps: the light of each view, or one for all. Default: ``cards.light``.
    backend
        ``reference``: torch; ``fused`` and ``auto``: a Warp kernel, which draws the same but for rounding.
    multisampled
        Whether a pixel is the mean of four samples, as in programs with multisampling, and not that of its center alone. By default not
        for hard masks and hash (:attr:`~bbfit.geometry.alpha.AlphaMode.multisampled`).

    Raises
    ------
    InputError
        If a level is not uint8 or not half as large as the level before, rounded down.
    """
    return CardRenderer(cards, backend=backend, multisampled=multisampled).draw(camera, light)


class CardRenderer:
    """Draws cards as :func:`draw_cards` does, for many cameras: what does not depend on the camera is computed once."""

    def __init__(self, cards: Cards, *, backend: Backend = "auto", multisampled: bool | None = None) -> None:
        check_choice("backend", backend, ("auto", "reference", "fused"))
        self._prepared, self._fused = prepared_cards(cards, multisampled=multisampled), backend != "reference"

    def draw(self, camera: Camera, light: Light | None = None) -> Tensor:
        """See :func:`draw_cards`."""
        cards, cameras = self._prepared.cards, camera.batch()
        light = cards.light if light is None else light
        if light is not None and cards.atlas.surface is None:
            fail("light", "the light of these cards is in their textures", "leave it out")
        with torch.no_grad():
            if self._fused:
                from bbfit.operators.cards.fused import draw_cards_fused  # warp takes a while to start

                image = draw_cards_fused(self._prepared, cameras, light)
            else:
                image = draw_cards_reference(self._prepared, cameras, light)
        return image if camera.batched else image[0]

    def surfaces(self, camera: Camera) -> Tensor:
        """What the surfaces are that cards with maps show to a single camera, without light: premultiplied base color, display-referred,
        premultiplied normals in the world, and alpha, float32 [H, W, 7]."""
        with torch.no_grad():
            met, straight = shown(self._prepared, camera)
            normals = normalize(2 * straight[:, 4:7] - 1, dim=-1)
            in_world = (normals[:, None] @ seen_axes(self._prepared.sheets, camera)[0, met.sheet].float())[:, 0]
            return composited(torch.cat([straight[:, :3], in_world], -1), straight[:, 3], met, self._prepared, camera.batch())[0]

    def fragments(self, camera: Camera) -> int:
        """How many fragments a graphics card shades for a single camera: the pixel centers inside the polygons of all layers.

        Parts behind the camera and culled sides do not count. Early depth tests, which may save some, are not assumed: an alpha test
        prevents them. The further pixels of 2 x 2 blocks that only serve derivatives are left out.
        """
        if self._fused:
            from bbfit.operators.cards.fused import count_fragments_fused  # warp takes a while to start

            return count_fragments_fused(self._prepared, camera.batch())
        return len(hits(self._prepared.cards, self._prepared.sheets, camera).x)
