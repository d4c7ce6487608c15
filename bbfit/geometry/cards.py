"""Cards: the flat textured polygons and the atlas that model files of a cloud contain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.light import Light

MASK_RIM = 0.5
"""Share of a mask's cutoff from which outlines contain alpha. Programs that draw smooth edges (alpha to coverage) show half a pixel
outside the cutoff's contour, where the ramp ``(alpha - cutoff) / fwidth(alpha) + 0.5`` is above 0; at 1 outlines end at the contour."""


@dataclass(frozen=True)
class Atlas:
    """R textures in one picture, texel for texel."""

    image: NDArray[np.uint8]
    """Straight-alpha RGBA, [H, W, 4]; both sides are multiples of 4."""
    corners: NDArray[np.int64]
    """Column and row of the top-left texel of each texture, [R, 2]."""
    sizes: NDArray[np.int64]
    """Width and height of each texture in texels, [R, 2]."""
    surface: NDArray[np.uint8] | None = None
    """Normals in the axes of each texture, as (n + 1) / 2, and occlusion, [H, W, 4]; [H, W, 5] with translucency, if there is any.
    ``None`` if colors contain the light."""

    @property
    def used(self) -> float:
        """Share of the picture that textures cover, in (0, 1]."""
        height, width = self.image.shape[:2]
        return float(self.sizes.prod(-1).sum() / (height * width))


@dataclass(frozen=True)
class Card:
    """A flat convex polygon that shows a texture of the atlas or a part of it."""

    corners: NDArray[np.float64]
    """K >= 3 points in meters, counter-clockwise as seen from where the normal points, [K, 3]."""
    uvs: NDArray[np.float64]
    """Texture coordinates with (0, 0) at the atlas's top-left corner and (1, 1) at its bottom-right corner, [K, 2]."""
    normal: NDArray[np.float64]
    """Unit normal, [3]."""
    culled: bool
    """Whether only the front is drawn, the side that the normal points to; otherwise both sides show the same. Seen from behind, the
    normals of such a card's texture turn as a whole (glTF 2.0, section 3.9.6)."""
    rectangle: int
    """Index of its texture in the atlas."""
    tangent: NDArray[np.float64] | None = None
    """For cards that take light: the unit vector from the texture's left to its right, [3]. The normals of a texture have the axes
    ``tangent``, up along the texture, and ``normal``."""
    origin: NDArray[np.float64] | None = None
    """Point in meters by which programs sort the card if it is blended, [3]; cards with the same origin are one node."""
    ranks: tuple[int, int] = (0, 0)
    """For a card with an origin: the places of its front and of its back in the order in which its node draws them. A culled card has only
    the first."""

    @property
    def triangles(self) -> NDArray[np.int64]:
        """A fan of triangles with the winding of the polygon, [K - 2, 3]."""
        middle = np.arange(1, len(self.corners) - 1)
        return np.stack([np.zeros_like(middle), middle, middle + 1], -1)


@dataclass(frozen=True)
class Cards:
    """A cloud's cards and their textures."""

    cards: tuple[Card, ...]
    """Q >= 1 cards."""
    atlas: Atlas
    """The textures: for each billboard the front, then the back if it has one."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """The alpha mode of all cards."""
    chain: tuple[NDArray[np.uint8], ...] | None = None
    """Mip levels of the files, straight RGBA, from level 0 to 1 x 1 texel. Without them level 0 is filtered bilinearly at every
    distance."""
    surface_chain: tuple[NDArray[np.uint8], ...] | None = None
    """The same of ``atlas.surface``."""
    averaged: NDArray[np.uint8] | None = None
    """Level 0 for programs that cannot read ``chain`` and average the levels themselves: ``atlas.image`` with filled gaps, [H, W, 4].
    ``None`` if it is the same."""
    light: Light | None = None
    """The light in which cards with a surface are drawn unless another is given, a batch of one."""
    traced: bool = False
    """Whether the cards are for a path tracer, such as Blender's Cycles. There, light reaches a card from its visible side only, also where
    the normals of its texture lean to the other side, and occlusion has no effect."""

    @property
    def vertex_count(self) -> int:
        """Vertices of all cards, with two more for each node of cards with an origin, which center its bounds."""
        return sum(len(card.corners) for card in self.cards) + 2 * len(self.nodes)

    @property
    def nodes(self) -> list[list[Card]]:
        """The cards of each node, for all cards with an origin."""
        found = dict[tuple[float, ...], list[Card]]()
        for card in self.cards:
            if card.origin is not None:
                found.setdefault(tuple(card.origin.tolist()), []).append(card)
        return list(found.values())

    @property
    def node_count(self) -> int:
        """Nodes of a GLB, one draw call each: :attr:`nodes`, one for the other cards that are culled, and one for those that are not."""
        return len(self.nodes) + len({card.culled for card in self.cards if card.origin is None})

    @property
    def visible_alpha(self) -> float:
        """The least alpha that is visible: the cutoff of mask, and 0 for the other modes, which show any alpha above 0."""
        return self.alpha.cutoff if self.alpha.kind == "mask" else 0.0

    @property
    def outlined_alpha(self) -> float:
        """The least alpha that outlines contain: all that is visible, and for mask also the rim of smooth edges (:data:`MASK_RIM`)."""
        return self.visible_alpha * MASK_RIM

    def with_cards(self, cards: list[Card]) -> Cards:
        """Other cards with the same textures."""
        return replace(self, cards=tuple(cards))


def texture_axes(card: Card) -> NDArray[np.float64]:
    """The axes of the normals in a card's texture: its tangent, up along the texture, and its normal, [3, 3]; NaN without a tangent."""
    if card.tangent is None:
        return np.full((3, 3), np.nan)
    up = np.cross(card.normal, card.tangent)
    return np.stack([card.tangent, up * np.sign(-texture_slopes(card)[1] @ up), card.normal])  # v grows downwards


def texture_slopes(card: Card) -> NDArray[np.float64]:
    """How a point of a card moves with u and with v, in meters for the whole atlas, [2, 3]."""
    return np.linalg.pinv(card.uvs - card.uvs.mean(0)) @ (card.corners - card.corners.mean(0))
