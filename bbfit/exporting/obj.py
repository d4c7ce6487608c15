"""Wavefront OBJ with its material library.

Written here rather than by trimesh, which splits quads into triangles, rounds to a fixed number of decimals and has no alpha map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.quads import Quads

_MATERIAL = "billboards"


def obj_bytes(quads: Quads, config: ExportConfig, *, material_file: str) -> bytes:
    """An OBJ file: four vertices for each quad, in metres, ``config.up`` up; nine digits, which give every float32 back.

    OBJ cannot say whether a face is culled from behind. A two-sided billboard is written as two quads of opposite winding, and the
    file's header asks for culling where there are any.
    """
    corners, normals = quads.corners.reshape(-1, 3), quads.normals
    if config.up == "z":
        corners, normals = _z_up(corners), _z_up(normals)
    uvs = quads.uvs.reshape(-1, 2) * [1, -1] + [0, 1]  # OBJ counts v from the bottom
    lines = [f"# bbfit billboard cloud, metres, {'Z' if config.up == 'z' else 'Y'} up"]
    if quads.culled.any():
        lines.append("# has separate front and back faces: turn on back-face culling")
    lines += [f"mtllib {material_file}", "o billboards"]
    lines += _rows("v", corners) + _rows("vt", uvs) + _rows("vn", normals)
    lines += [f"usemtl {_MATERIAL}", "s off"]
    for quad in range(len(normals)):
        first = 4 * quad + 1
        lines.append("f " + " ".join(f"{vertex}/{vertex}/{quad + 1}" for vertex in range(first, first + 4)))
    return ("\n".join(lines) + "\n").encode()


def mtl_bytes(*, texture_file: str) -> bytes:
    """The material library: the texture's colour as it is (illumination model 0, no lighting) and its alpha as opacity."""
    lines = [
        "# bbfit billboard cloud",
        f"newmtl {_MATERIAL}",
        "Ka 0 0 0",
        "Kd 1 1 1",
        "Ks 0 0 0",
        "d 1",
        "illum 0",
        f"map_Kd {texture_file}",
        f"map_d {texture_file}",
    ]
    return ("\n".join(lines) + "\n").encode()


def _z_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], -1)


def _rows(keyword: str, values: NDArray[np.float64]) -> list[str]:
    # Adding zero turns -0 into 0.
    return [keyword + " " + " ".join(f"{value:.9g}" for value in row) for row in (values + 0.0).tolist()]
