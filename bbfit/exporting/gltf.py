"""Binary glTF 2.0 with embedded textures; trimesh writes the geometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from bbfit.exporting.cards import Card, Cards
from bbfit.exporting.config import ExportConfig
from bbfit.images import encode_png
from bbfit.model_files import glb_of_scene, joined_glb, split_glb

# Numbers that glTF 2.0 borrows from OpenGL (specification, section 5.26).
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}  # linear, trilinear, clamped to the edge


def glb_bytes(cards: Cards, config: ExportConfig) -> bytes:
    """A GLB file: one mesh for the cards shown from both sides, one for those culled from behind, and one for each that has an origin.

    The materials are unlit (``KHR_materials_unlit``), as the textures hold colours with the light in them. Viewers without that
    extension see a rough dielectric.
    """
    import trimesh
    from PIL import Image

    standin = Image.new("RGBA", (1, 1))  # trimesh writes texture coordinates for textured materials only
    scene = trimesh.Scene(base_frame="billboard_cloud")
    for name, chosen in _meshes(cards).items():
        material = trimesh.visual.material.PBRMaterial(
            name="billboards_two_sided" if chosen[0].culled else "billboards",
            baseColorTexture=standin,
            alphaMode=config.alpha.upper(),
            alphaCutoff=float(config.alpha_cutoff) if config.alpha == "mask" else None,
            doubleSided=not chosen[0].culled,
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        origin = chosen[0].origin
        uvs, points = np.concatenate([card.uvs for card in chosen]), np.concatenate([card.corners for card in chosen])
        first = np.cumsum([0, *(len(card.corners) for card in chosen)])
        mesh = trimesh.Trimesh(
            points if origin is None else points - origin,
            np.concatenate([card.triangles + start for card, start in zip(chosen, first, strict=False)]),
            vertex_normals=np.concatenate([np.tile(card.normal, (len(card.corners), 1)) for card in chosen]),
            # trimesh counts v from the bottom and turns it over on writing.
            visual=trimesh.visual.TextureVisuals(uv=np.stack([uvs[:, 0], 1 - uvs[:, 1]], -1), material=material),
            process=False,
        )
        place = None if origin is None else trimesh.transformations.translation_matrix(origin)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=place)
    tree, views = split_glb(glb_of_scene(scene, _complete))
    views[tree["images"][0]["bufferView"]] = encode_png(cards.atlas.image)
    return joined_glb(tree, views)


def _meshes(cards: Cards) -> dict[str, list[Card]]:
    """What goes into a mesh of its own, by name."""
    meshes = dict[str, list[Card]]()
    for name, culled in (("billboards", False), ("billboards_two_sided", True)):
        together = [card for card in cards.cards if card.culled == culled and card.origin is None]
        apart = [card for card in cards.cards if card.culled == culled and card.origin is not None]
        meshes |= {name: together} if together else {}
        meshes |= {f"{name}_{index}": [card] for index, card in enumerate(apart)}
    return meshes


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
