"""The rectangles of a cloud as flat textured polygons, which is what model files hold."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.exporting.atlas import Atlas, pack_atlas
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import to_bytes


@dataclass(frozen=True)
class Card:
    """A flat convex polygon that shows a part of one texture of the atlas, or all of it."""

    corners: NDArray[np.float64]
    """K >= 3 points in meters, counter-clockwise as seen from where the normal points, [K, 3]."""
    uvs: NDArray[np.float64]
    """Texture coordinates with (0, 0) at the atlas's top-left corner and (1, 1) at its bottom-right corner, [K, 2]."""
    normal: NDArray[np.float64]
    """Unit normal, [3]."""
    culled: bool
    """Whether only the side that the normal points to is shown; otherwise both sides show the same."""
    rectangle: int
    """Which texture of the atlas it shows."""
    origin: NDArray[np.float64] | None = None
    """Point in meters by which programs that sort what is transparent are to sort it, [3]; it then gets a node of its own."""

    @property
    def triangles(self) -> NDArray[np.int64]:
        """A fan of triangles that wind like the polygon, [K - 2, 3]."""
        middle = np.arange(1, len(self.corners) - 1)
        return np.stack([np.zeros_like(middle), middle, middle + 1], -1)


@dataclass(frozen=True)
class Cards:
    """A cloud's cards and their textures."""

    cards: tuple[Card, ...]
    """Q >= 1 of them."""
    atlas: Atlas
    """The textures: per billboard the front, then the back if there is one."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """What their alpha means."""
    chain: tuple[NDArray[np.uint8], ...] | None = None
    """Mip levels that files of them bring, straight RGBA, level 0 first and down to 1 x 1 texel; without any, level 0 is filtered
    bilinearly at every distance."""

    @property
    def vertex_count(self) -> int:
        """Vertices of all cards, with the two that center the bounds of each that has an origin."""
        return sum(len(card.corners) + 2 * (card.origin is not None) for card in self.cards)

    @property
    def visible_alpha(self) -> float:
        """The least alpha that is visible: the cutoff of mask, and 0 for the other modes, which show any alpha above 0."""
        return self.alpha.cutoff if self.alpha.kind == "mask" else 0.0

    def with_cards(self, cards: list[Card]) -> Cards:
        """Other cards of the same textures."""
        return replace(self, cards=tuple(cards))


def cloud_cards(cloud: BillboardCloud, padding: int) -> Cards:
    """Rectangles and atlas that any renderer with bilinear filtering shows as :func:`~bbfit.rendering.reference.render_reference` does.

    A billboard's picture fades to transparent over one texel beyond its outermost texel centers, so half a texel beyond its
    rectangle. Each card is half a texel larger than its rectangle on every side and reaches to the centers of the padding texels
    around its texture. A two-sided billboard gives two cards at the same place, front and back, of opposite winding.

    Textures are rounded to 8 bits, which moves a premultiplied color by at most 1/255 a layer. Transparent texels change their
    color (:func:`~bbfit.exporting.atlas.fill_cell`); that shows within a texel of the silhouette, by at most 1/4 a layer, where they
    had another color before. Alpha is not touched by it.

    Raises
    ------
    InputError
        if the cloud is empty or has values that are not finite.
    """
    if len(cloud) == 0:
        fail("cloud", "has no billboards, so there is nothing to export", "fit it with at least one")
    for name in ("centers", "rights", "ups", "half_extents", "texels"):
        if not getattr(cloud, name).isfinite().all():
            fail("cloud", f"{name} are not all finite numbers", "fit it anew")
    atlas = pack_atlas([to_bytes(side) for texture in cloud.textures() for side in texture], padding)

    centers, rights, ups, half, two_sided = (
        tensor.detach().cpu().double().numpy() for tensor in (cloud.centers, cloud.rights, cloud.ups, cloud.half_extents, cloud.two_sided)
    )
    sizes = cloud.texture_sizes.cpu().numpy()[:, ::-1]  # width, height
    reach = half * (sizes + 1) / sizes
    right, up = rights * reach[:, :1], ups * reach[:, 1:]
    corners = np.stack([centers - right - up, centers + right - up, centers + right + up, centers - right + up], 1)
    normals = np.cross(rights, ups)

    owner = np.repeat(np.arange(len(cloud)), 1 + two_sided.astype(np.int64))
    back = np.diff(owner, prepend=-1) == 0
    low, high = atlas.corners - 0.5, atlas.corners + atlas.sizes + 0.5
    extent = np.array(atlas.image.shape[1::-1])
    uvs = np.stack([low, high], -1)[:, [[0, 1], [0, 1], [0, 1], [0, 1]], [[0, 1], [1, 1], [1, 0], [0, 0]]] / extent
    order = np.where(back[:, None], [1, 0, 3, 2], [0, 1, 2, 3])
    made = zip(
        np.take_along_axis(corners[owner], order[..., None], 1),
        np.take_along_axis(uvs, order[..., None], 1),
        np.where(back[:, None], -1.0, 1.0) * normals[owner],
        two_sided.astype(np.bool_)[owner].tolist(),
        range(len(owner)),
        strict=True,
    )
    return Cards(tuple(Card(*parts) for parts in made), atlas, cloud.alpha)
