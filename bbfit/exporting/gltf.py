"""Binary glTF 2.0 with an embedded texture, written by trimesh."""

from __future__ import annotations

from typing import Any

import numpy as np

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.quads import Quads
from bbfit.model_files import glb_of_scene

# Numbers that glTF 2.0 borrows from OpenGL (specification, section 5.26).
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}  # linear, trilinear, clamped to the edge


def glb_bytes(quads: Quads, config: ExportConfig) -> bytes:
    """A GLB file: one mesh for the quads shown from both sides, one for those culled from behind.

    The materials are unlit (``KHR_materials_unlit``), as the textures hold colours with the light in them. Viewers without that
    extension see a rough dielectric.
    """
    import trimesh
    from PIL import Image

    picture = Image.fromarray(quads.atlas.image)
    scene = trimesh.Scene(base_frame="billboard_cloud")
    for culled, name in ((False, "billboards"), (True, "billboards_two_sided")):
        chosen = np.flatnonzero(quads.culled == culled)
        if len(chosen) == 0:
            continue
        material = trimesh.visual.material.PBRMaterial(
            name=name,
            baseColorTexture=picture,
            alphaMode=config.alpha.upper(),
            alphaCutoff=float(config.alpha_cutoff) if config.alpha == "mask" else None,
            doubleSided=not culled,
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        uvs = quads.uvs[chosen].reshape(-1, 2)
        mesh = trimesh.Trimesh(
            quads.corners[chosen].reshape(-1, 3),
            quads.triangles(chosen),
            vertex_normals=quads.normals[chosen].repeat(4, 0),
            # trimesh counts v from the bottom and turns it over on writing.
            visual=trimesh.visual.TextureVisuals(uv=np.stack([uvs[:, 0], 1 - uvs[:, 1]], -1), material=material),
            process=False,
        )
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    return glb_of_scene(scene, _complete)


def _complete(tree: dict[str, Any]) -> None:
    """Add to trimesh's glTF what it has no means to say."""
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "KHR_materials_unlit"})
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["samplers"] = [_SAMPLER]
    # trimesh lists the picture once for each material.
    assert len({image["bufferView"] for image in tree["images"]}) == 1
    tree["images"] = [tree["images"][0] | {"name": "atlas"}]
    tree["textures"] = [{"source": 0, "sampler": 0, "name": "atlas"}]
    for material in tree["materials"]:
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
