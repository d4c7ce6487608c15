"""Wavefront OBJ with its material library.

trimesh is not used because it splits polygons into triangles, rounds to a fixed number of decimals and writes no alpha map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.config import ExportConfig
from bbfit.geometry.cards import Cards

_MATERIAL = "billboards"


def obj_bytes(cards: Cards, config: ExportConfig, *, material_file: str) -> bytes:
    """An OBJ file with one polygon per card, in meters, with the up axis ``config.up`` and nine digits, which preserve float32.

    OBJ has no back-face culling. A two-sided billboard becomes two faces of opposite winding, and a comment at the top of the file asks
    the user to turn culling on.
    """
    corners = np.concatenate([card.corners for card in cards.cards])
    normals = np.stack([card.normal for card in cards.cards])
    if config.up == "z":
        corners, normals = _z_up(corners), _z_up(normals)
    uvs = np.concatenate([card.uvs for card in cards.cards]) * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts v from the bottom
    lines = [f"# bbfit billboard cloud, meters, {'Z' if config.up == 'z' else 'Y'} up"]
    if any(card.culled for card in cards.cards):
        lines.append("# has separate front and back faces: turn on back-face culling")
    lines += [f"mtllib {material_file}", "o billboards"]
    lines += _rows("v", corners.astype(np.float32)) + _rows("vt", uvs) + _rows("vn", normals)
    lines += [f"usemtl {_MATERIAL}", "s off"]
    first = 1
    for face, card in enumerate(cards.cards, 1):
        lines.append("f " + " ".join(f"{vertex}/{vertex}/{face}" for vertex in range(first, first + len(card.corners))))
        first += len(card.corners)
    return ("\n".join(lines) + "\n").encode(errors="surrogateescape")


def mtl_bytes(*, texture_file: str, normals_file: str | None = None) -> bytes:
    """The material library: the texture's unlit color (illumination model 0) and its alpha as opacity.

    With normals the color is a matte surface's (illumination model 1), and ``norm`` names their map, as extensions of MTL for physically
    based materials have it. MTL has no map of occlusion.
    """
    lines = [
        "# bbfit billboard cloud",
        f"newmtl {_MATERIAL}",
        "Ka 0 0 0",
        "Kd 1 1 1",
        "Ks 0 0 0",
        "d 1",
        f"illum {0 if normals_file is None else 1}",
        f"map_Kd {texture_file}",
        f"map_d {texture_file}",
        *([] if normals_file is None else [f"norm {normals_file}"]),
    ]
    return ("\n".join(lines) + "\n").encode(errors="surrogateescape")


def _z_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], -1)


def _rows(keyword: str, values: NDArray[np.float64]) -> list[str]:
    # Adding 0 turns -0 into 0.
    return [keyword + " " + " ".join(f"{value:.9g}" for value in row) for row in (values + 0.0).tolist()]
