"""The rectangles of a cloud as textured quads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.exporting.atlas import Atlas, pack_atlas
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import to_bytes

# Two triangles that wind like their quad.
TRIANGLES = ((0, 1, 2), (0, 2, 3))


@dataclass(frozen=True)
class Quads:
    """Q textured quads in the cloud's world, one for each rectangle of the atlas."""

    corners: NDArray[np.float64]
    """Corner points in metres, counter-clockwise as seen from where the normal points, [Q, 4, 3]."""
    normals: NDArray[np.float64]
    """Unit normals, [Q, 3]."""
    uvs: NDArray[np.float64]
    """Texture coordinates with (0, 0) at the atlas's top-left corner and (1, 1) at its bottom-right corner, [Q, 4, 2]."""
    culled: NDArray[np.bool_]
    """Whether only the side that the normal points to is shown, [Q]; the other quads show the same from both sides."""
    atlas: Atlas
    """The textures: per billboard the front, then the back if there is one."""

    def triangles(self, chosen: NDArray[np.intp]) -> NDArray[np.int64]:
        """Vertex indices of the chosen quads' triangles, [2 * len(chosen), 3], counting their corners only."""
        return (np.array(TRIANGLES) + 4 * np.arange(len(chosen))[:, None, None]).reshape(-1, 3)


def cloud_quads(cloud: BillboardCloud, padding: int) -> Quads:
    """Quads and atlas that any renderer with bilinear filtering shows as :func:`~bbfit.rendering.reference.render_reference` does.

    A billboard's picture fades to transparent over one texel beyond its outermost texel centres, so half a texel beyond its
    rectangle. Each quad is half a texel larger than its rectangle on every side and reaches to the centres of the padding texels
    around its texture. A two-sided billboard gives two quads at the same place, front and back, of opposite winding.

    Textures are rounded to 8 bits, which moves a premultiplied colour by at most 1/255 a layer. Transparent texels change their
    colour (:func:`~bbfit.exporting.atlas.fill_cell`); that shows within a texel of the silhouette, by at most 1/4 a layer, where they
    had another colour before. Alpha is not touched by it.

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
    return Quads(
        np.take_along_axis(corners[owner], order[..., None], 1),
        np.where(back[:, None], -1.0, 1.0) * normals[owner],
        np.take_along_axis(uvs, order[..., None], 1),
        two_sided.astype(np.bool_)[owner],
        atlas,
    )
