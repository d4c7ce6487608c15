"""The tree itself in fewer bytes: Draco's mesh compression (https://google.github.io/draco), by the package DracoPy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bbfit.checks import check_range, fail
from bbfit.tree_files.gltf_materials import pictures_size
from bbfit.tree_files.tree_file import TreeFile

# Estimated bytes of a glTF's JSON for the scene, and for a mesh with its material.
_FRAME, _FRAME_A_MESH = 600, 700


@dataclass(frozen=True)
class DracoSize:
    """Size of a tree with Draco compression of its meshes."""

    bytes: int
    """Compressed meshes, unchanged textures and an estimate of the JSON."""
    vertices: int
    """Vertices after decompression; quantization may merge some."""


def draco_size(tree: str | Path | TreeFile, *, position_bits: int = 14, error: float | None = None) -> DracoSize:
    """Compress every mesh of a .glb, .gltf or .obj as glTF's KHR_draco_mesh_compression would, with texture coordinates and normals.

    A coordinate of a position takes ``position_bits`` bits, 1 to 30. As in Draco's own encoder, whose highest level of compression is used,
    texture coordinates take 12 and normals 10. With ``error``, positions take as many bits as this root mean square in meters needs:
    three coordinates that are rounded to multiples of q are wrong by q / 2. Raises ``MissingFileError`` or ``InputError`` if the file
    cannot be used or the package DracoPy is missing.
    """
    check_range("position_bits", position_bits, 1, 30)
    try:
        import DracoPy
    except ImportError:
        fail("draco", "the package DracoPy is not installed", 'pip install "bbfit[rivals]"')
    total, vertices = _FRAME, 0
    tree = TreeFile.open(tree)
    scene = tree.scene()
    if error is not None:
        position_bits = min(max(1, math.ceil(math.log2(scene.extents.max() / (2 * error)))), 30)
    for mesh in scene.geometry.values():
        uv = getattr(mesh.visual, "uv", None)
        # A PLY of the mesh has normals only if the mesh was loaded with normals.
        header = mesh.export(file_type="ply", include_attributes=False)[:1000]
        normals = mesh.vertex_normals if b"property float nx" in header else None
        data = DracoPy.encode(
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.uint32),
            quantization_bits=position_bits,
            compression_level=10,
            tex_coord=None if uv is None else np.asarray(uv, np.float64),
            normals=None if normals is None else np.asarray(normals, np.float64),
            tex_coord_quantization_bits=12,
            normal_quantization_bits=10,
        )
        total += len(data) + _FRAME_A_MESH
        vertices += len(DracoPy.decode(data).points)
    return DracoSize(total + pictures_size(tree), vertices)
