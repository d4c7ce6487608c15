"""The tree itself in fewer bytes: Draco's mesh compression (https://google.github.io/draco), by the package DracoPy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bbfit.checks import check_range, fail
from bbfit.rivals.mesh_parts import tree_parts
from bbfit.tree_files.gltf_materials import pictures_size
from bbfit.tree_files.tree_file import TreeFile

# The highest level of compression.
_LEVEL = 10
# Estimated bytes of a glTF's JSON for the scene, and for a mesh with its material.
_FRAME, _FRAME_A_MESH = 600, 700


@dataclass(frozen=True)
class DracoSize:
    """Size of a tree with Draco compression of its meshes."""

    bytes: int
    """Compressed meshes, unchanged textures and an estimate of the JSON."""
    vertices: int
    """Vertices after decompression; quantization may merge some."""


def draco_size(tree: str | Path | TreeFile, *, position_bits: int = 14) -> DracoSize:
    """Compress every mesh of a .glb, .gltf or .obj as glTF's KHR_draco_mesh_compression would, with texture coordinates and normals.

    A coordinate of a position takes ``position_bits`` bits, 1 to 30. As in Draco's own encoder, whose highest level of compression is used,
    texture coordinates take 12 and normals 10. Raises ``MissingFileError`` or ``InputError`` if the file cannot be used or the package
    DracoPy is missing.
    """
    check_range("position_bits", position_bits, 1, 30)
    draco = _draco()
    total, vertices = _FRAME, 0
    tree = TreeFile.open(tree)
    scene = tree.scene()
    for mesh in scene.geometry.values():
        uv = getattr(mesh.visual, "uv", None)
        # A PLY of the mesh has normals only if the mesh was loaded with normals.
        header = mesh.export(file_type="ply", include_attributes=False)[:1000]
        normals = mesh.vertex_normals if b"property float nx" in header else None
        data = draco.encode(
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.uint32),
            quantization_bits=position_bits,
            compression_level=_LEVEL,
            tex_coord=None if uv is None else np.asarray(uv, np.float64),
            normals=None if normals is None else np.asarray(normals, np.float64),
            tex_coord_quantization_bits=12,
            normal_quantization_bits=10,
        )
        total += len(data) + _FRAME_A_MESH
        vertices += len(draco.decode(data).points)
    return DracoSize(total + pictures_size(tree), vertices)


def draco_geometry_bytes(tree: str | Path | TreeFile, error: float) -> int:
    """Bytes of the triangles of a .glb, .gltf or .obj alone, whose positions are wrong by an ``error`` > 0, the root mean square in meters.

    Draco rounds the coordinates of each mesh to fractions of its extent. Three coordinates that are rounded to multiples of q are wrong by
    q / 2. Raises the errors of :func:`draco_size`.
    """
    check_range("error", error, 0, math.inf, open_low=True, open_high=True)
    draco, total = _draco(), 0
    for part in tree_parts(TreeFile.open(tree)):
        bits = min(max(1, math.ceil(math.log2((np.ptp(part.points, axis=0).max() + 1e-30) / (2 * error)))), 30)
        points, faces = part.points.astype(np.float32), part.faces.astype(np.uint32)
        total += len(draco.encode(points, faces, quantization_bits=bits, compression_level=_LEVEL))
    return total


def _draco() -> Any:
    try:
        import DracoPy
    except ImportError:
        fail("draco", "the package DracoPy is not installed", 'pip install "bbfit[rivals]"')
    return DracoPy
