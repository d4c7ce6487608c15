"""The rectangles of a cloud as cards."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.exporting.atlas import pack_atlas
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import to_bytes


def cloud_cards(cloud: BillboardCloud, padding: int, halvings: int = 0, *, traced: bool = False, paired: bool = False) -> Cards:
    """Rectangles and an atlas for which bilinear filtering gives the picture of :func:`~bbfit.rendering.dispatch.render`.

    A billboard's picture fades to transparent over one texel beyond its outermost texel centers, so half a texel beyond its rectangle. Each
    card is therefore half a texel larger than its rectangle on every side and reaches to the centers of the padding texels around its
    texture. A two-sided billboard becomes two cards in the same place, front and back, of opposite winding. So does a one-sided billboard
    with maps, with one texture for both: programs that show a quad from behind turn the whole normal, and one that points up would point
    down. ``traced`` is for programs that cull nothing (``Cards.traced``): there such a billboard is one card that shows both sides. With
    ``paired``, one without maps becomes a pair as well. After ``halvings`` halvings of the atlas's sides, which may follow, textures still
    have ``padding`` and are made of whole blocks.

    Textures are rounded to 8 bits, which changes a premultiplied color by at most 1/255 per layer. Transparent texels get another color
    (:func:`~bbfit.exporting.atlas.fill_cell`), which changes colors near the silhouette by at most 1/4 per layer, but no alpha. Raises
    InputError if the cloud is empty or has values that are not finite.
    """
    if len(cloud) == 0:
        fail("cloud", "has no billboards, so there is nothing to export", "fit it with at least one")
    for name in ("centers", "rights", "ups", "half_extents", "texels"):
        if not getattr(cloud, name).isfinite().all():
            fail("cloud", f"{name} are not all finite numbers", "fit it again")
    atlas = pack_atlas([to_bytes(side) for texture in cloud.textures() for side in texture], padding, _surfaces(cloud), halvings)

    centers, rights, ups, half, two_sided = (
        tensor.detach().cpu().double().numpy() for tensor in (cloud.centers, cloud.rights, cloud.ups, cloud.half_extents, cloud.two_sided)
    )
    sizes = cloud.texture_sizes.cpu().numpy()[:, ::-1]  # width, height
    reach = half * (sizes + 1) / sizes
    right, up = rights * reach[:, :1], ups * reach[:, 1:]
    corners = np.stack([centers - right - up, centers + right - up, centers + right + up, centers - right + up], 1)
    normals = np.cross(rights, ups)

    culled = two_sided.astype(np.bool_) | paired | (cloud.surface is not None and not traced)
    owner = np.repeat(np.arange(len(cloud)), 1 + culled)
    back = np.diff(owner, prepend=-1) == 0
    textures = 1 + two_sided.astype(np.int64)
    rectangle = (textures.cumsum() - textures)[owner] + (back & (textures[owner] == 2))
    low, high = (atlas.corners - 0.5)[rectangle], (atlas.corners + atlas.sizes + 0.5)[rectangle]
    extent = np.array(atlas.image.shape[1::-1])
    uvs = np.stack([low, high], -1)[:, [[0, 1], [0, 1], [0, 1], [0, 1]], [[0, 1], [1, 1], [1, 0], [0, 0]]] / extent
    order = np.where(back[:, None], [1, 0, 3, 2], [0, 1, 2, 3])
    made = zip(
        np.take_along_axis(corners[owner], order[..., None], 1),
        np.take_along_axis(uvs, order[..., None], 1),
        np.where(back[:, None], -1.0, 1.0) * normals[owner],
        culled[owner].tolist(),
        rectangle.tolist(),
        rights[owner] if cloud.surface is not None else [None] * len(owner),
        strict=True,
    )
    return Cards(tuple(Card(*parts) for parts in made), atlas, cloud.alpha, light=cloud.light, traced=traced)


def _surfaces(cloud: BillboardCloud) -> list[NDArray[np.uint8]] | None:
    """For each texture its normals, as (n + 1) / 2, and occlusion, uint8 [h, w, 4]; [h, w, 5] with translucency, if there is any."""
    if cloud.surface is None:
        return None
    maps = torch.cat([(cloud.tangent_normals + 1) / 2, cloud.surface[:, 2 : 4 if cloud.translucent else 3]], -1)
    return [to_bytes(side) for texture in cloud.textures(maps) for side in texture]
