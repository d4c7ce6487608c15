"""Binary glTF 2.0 with embedded textures; trimesh writes the geometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.config import ExportConfig, ResolvedExport
from bbfit.exporting.encoders import encode_ktx2, encode_webp
from bbfit.exporting.splitting import centered
from bbfit.exporting.vertex_formats import on_grid, quantized, with_short_indices
from bbfit.geometry.cards import Card, Cards, texture_axes
from bbfit.glb import joined_glb, split_glb
from bbfit.images import encode_png
from bbfit.model_files import glb_of_scene

# Numbers that glTF 2.0 borrows from OpenGL (specification, section 5.26).
_SAMPLER = {"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}  # linear, clamped to the edge
_WITH_MIPS = _SAMPLER | {"minFilter": 9987}  # trilinear
# Pictures of cards with maps beside the atlas.
_MAPS = ("normals", "occlusion")
# Pictures by name.
_Pictures = dict[str, tuple[list[NDArray[np.uint8]], bool]]
_TRANSMISSION = "KHR_materials_diffuse_transmission"
# Channels of a surface without translucency.
_OPAQUE_CHANNELS = 4
# The name under which trimesh writes tangents.
_TANGENT = "_TANGENT"
_EXTENSIONS = {"webp": ("EXT_texture_webp", "image/webp"), "ktx2": ("KHR_texture_basisu", "image/ktx2")}


def glb_bytes(
    cards: Cards,
    config: ExportConfig,
    on_picture: Callable[[int, int], None] = lambda done, total: None,
    *,
    files: Mapping[str, str] | None = None,
) -> bytes:
    """A GLB file with one mesh for the cards that show both sides, one for those with back-face culling, and one per node of split cards.

    Cards with maps have a matte material (``KHR_materials_specular`` with the factor 0) with textures of base color, normals and occlusion,
    and tangents. Translucency is the alpha of the occlusion's texture, from which ``KHR_materials_diffuse_transmission`` takes it.

    The node of cards with an origin is at that origin, and two vertices that no triangle uses center the mesh's bounds on it: programs
    sort blended meshes by one or the other. For programs that sort by the nearest point of a bounding sphere, all spheres have one radius.
    The node's triangles are the cards' fronts and backs in the order of ``Card.ranks``, with back-face culling; a front and a back share
    their vertices. For programs that do not cull what is blended, they are the fronts alone, double-sided. The sampler uses mip levels if
    the file includes them (``ktx2``) or if the options let programs compute them
    (:meth:`~bbfit.exporting.config.ExportConfig.mipmapped`). ``on_picture`` is called with the number of encoded pictures and their total.

    With ``files``, the GLB contains no pictures and refers to those files instead: to the addresses by the names of :func:`texture_files`.
    """
    import trimesh
    from PIL import Image

    resolved = config.resolve()
    cards = on_grid(cards) if resolved.quantized else cards
    placeholder = Image.new("RGBA", (1, 1))  # trimesh writes texture coordinates for textured materials only
    scene = trimesh.Scene(base_frame="billboard_cloud")
    radius = None
    if resolved.program.nearest:
        radius = max((float(np.linalg.norm(np.ptp(centered(node), 0))) / 2 for node in cards.nodes), default=None)
    for name, chosen in _meshes(cards).items():
        origin = chosen[0].origin
        one_sided = chosen[0].culled or (origin is not None and resolved.program.culls)
        material = trimesh.visual.material.PBRMaterial(
            name="billboards_two_sided" if one_sided else "billboards",
            baseColorTexture=placeholder,
            alphaMode="MASK" if cards.alpha.tested else "BLEND",
            alphaCutoff=float(cards.alpha.cutoff) if cards.alpha.tested else None,
            doubleSided=not one_sided,
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        points, uvs, normals, tangents = _vertices(chosen, radius)
        mesh = trimesh.Trimesh(
            points,
            _triangles(chosen, both=one_sided),
            vertex_normals=normals,
            # trimesh counts v from the bottom and flips it when it writes.
            visual=trimesh.visual.TextureVisuals(uv=np.stack([uvs[:, 0], 1 - uvs[:, 1]], -1), material=material),
            process=False,
        )
        if cards.atlas.surface is not None:
            mesh.vertex_attributes[_TANGENT] = tangents
        place = None if origin is None else trimesh.transformations.translation_matrix(origin)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=place)
    # Without light nothing reads normals, which are a third of a vertex.
    lit = cards.atlas.surface is not None or resolved.material == "pbr"
    pictures = _pictures(cards)
    glb = glb_of_scene(scene, lambda tree: _complete(tree, cards, list(pictures), resolved), normals=lit)
    tree, views = split_glb(glb)
    views = with_short_indices(tree, views)
    if resolved.quantized:
        views = quantized(tree, views, cards)
    images = _with_images(tree, list(pictures), resolved)
    if files is not None:
        tree["images"] = [{"uri": files[name], "mimeType": kind, "name": picture} for name, picture, kind in images]
        return joined_glb(tree, _without_placeholder(tree, views))
    contents = texture_files(cards, resolved, on_picture)
    at = tree["images"][0]["bufferView"]
    places = [at, *range(len(views), len(views) + len(images) - 1)]
    tree["bufferViews"] += [{} for _ in places[1:]]
    views += [b""] * (len(places) - 1)
    for place, (name, _, _) in zip(places, images, strict=True):
        views[place] = contents[name]
    tree["images"] = [{"bufferView": place, "mimeType": kind, "name": name} for place, (_, name, kind) in zip(places, images, strict=True)]
    return joined_glb(tree, views)


def texture_names(config: ResolvedExport, *, maps: bool) -> list[str]:
    """The names of the pictures of a GLB as files, in their order; ``maps``: with normals and occlusion."""
    return [f"{picture}.{ending}" for picture in ("atlas", *(_MAPS if maps else ())) for ending in _endings(config)]


def texture_files(
    cards: Cards, config: ResolvedExport, on_picture: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, bytes]:
    """The encoded pictures of a GLB by their names as files (:func:`texture_names`). ``on_picture`` is as for :func:`glb_bytes`."""
    pictures, contents = _pictures(cards), dict[str, bytes]()
    for number, (name, (levels, is_color)) in enumerate(pictures.items()):
        on_picture(number, len(pictures))
        for ending in _endings(config):
            if ending == "png":
                data = encode_png(cards.averaged if name == "atlas" and cards.averaged is not None else levels[0])
            else:
                data = encode_webp(levels[0]) if ending == "webp" else encode_ktx2(levels, srgb=is_color)
            contents[f"{name}.{ending}"] = data
    on_picture(len(pictures), len(pictures))
    return contents


def _endings(config: ResolvedExport) -> list[str]:
    """The endings of a picture's files: PNG, unless it is left out, and that of the requested format."""
    if config.textures == "png":
        return ["png"]
    return ["png", config.textures] if config.fallback else [config.textures]


def _vertices(
    chosen: list[Card], radius: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """Of a mesh: points relative to its origin, texture coordinates, normals and tangents; two more vertices center it on an origin."""
    points, uvs = [card.corners for card in chosen], [card.uvs for card in chosen]
    counts = [len(card.corners) for card in chosen]
    origin = chosen[0].origin
    if origin is not None:
        points, uvs = [*points, centered(chosen, radius)], [*uvs, chosen[-1].uvs[[0, 0]]]
        counts[-1] += 2
    normals = np.concatenate([np.tile(card.normal, (count, 1)) for card, count in zip(chosen, counts, strict=True)])
    tangents = np.concatenate([_tangents(card, count) for card, count in zip(chosen, counts, strict=True)])
    return np.concatenate(points) - (0.0 if origin is None else origin), np.concatenate(uvs), normals, tangents


def _tangents(card: Card, count: int) -> NDArray[np.float32]:
    """The tangents of a card's vertices, [count, 4]: glTF's bitangent, ``cross(normal, tangent) * w``, points up along the texture."""
    right, up, normal = texture_axes(card)
    handed = np.sign(np.cross(normal, right) @ up)
    return np.tile(np.append(right, handed).astype(np.float32), (count, 1))


def _triangles(chosen: list[Card], *, both: bool) -> NDArray[np.int64]:
    """The triangles of a mesh in the order of drawing, [T, 3]; ``both`` adds the backs of cards with an origin that are not culled."""
    first = np.cumsum([0, *(len(card.corners) for card in chosen)]).tolist()
    if chosen[0].origin is None:
        return np.concatenate([card.triangles + start for card, start in zip(chosen, first, strict=False)])
    faces = list[tuple[int, NDArray[np.int64]]]()
    for card, start in zip(chosen, first, strict=False):
        front = card.triangles + start
        faces += [(card.ranks[0], front)] + ([(card.ranks[1], front[:, ::-1])] if both and not card.culled else [])
    return np.concatenate([triangles for _, triangles in sorted(faces, key=lambda face: face[0])])


def _meshes(cards: Cards) -> dict[str, list[Card]]:
    """The cards of each mesh, by the mesh's name."""
    meshes = dict[str, list[Card]]()
    for name, culled in (("billboards", False), ("billboards_two_sided", True)):
        together = [card for card in cards.cards if card.culled == culled and card.origin is None]
        meshes |= {name: together} if together else {}
    return meshes | {f"billboards_{index}": node for index, node in enumerate(cards.nodes)}


def _complete(tree: dict[str, Any], cards: Cards, pictures: list[str], config: ResolvedExport) -> None:
    """Add to trimesh's glTF what trimesh cannot write, except for the pictures."""
    # trimesh lists the picture once per material.
    assert len({image["bufferView"] for image in tree["images"]}) == 1
    tree["images"] = [{"bufferView": tree["images"][0]["bufferView"]}]
    tree["textures"] = [{"sampler": 0, "name": name} for name in pictures]
    tree["samplers"] = [_WITH_MIPS if config.has_mips or config.mipmapped(cards.alpha) else _SAMPLER]
    used = set(tree.get("extensionsUsed", ()))
    for material in tree["materials"]:
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        if cards.atlas.surface is not None:
            material |= {"normalTexture": {"index": 1}, "occlusionTexture": {"index": 2}}
            material["extensions"] = {"KHR_materials_specular": {"specularFactor": 0.0}}
            if cards.atlas.surface.shape[-1] > _OPAQUE_CHANNELS:
                material["extensions"][_TRANSMISSION] = {
                    "diffuseTransmissionFactor": 1.0,
                    "diffuseTransmissionTexture": {"index": 2},
                    "diffuseTransmissionColorTexture": {"index": 0},
                }
        elif config.material == "unlit":
            material["extensions"] = {"KHR_materials_unlit": {}}
        elif config.material == "emissive":
            # A black metal reflects nothing, and emission is blended by the alpha of the base color.
            material["pbrMetallicRoughness"] |= {"baseColorFactor": [0.0, 0.0, 0.0, 1.0], "metallicFactor": 1.0}
            material |= {"emissiveTexture": {"index": 0}, "emissiveFactor": [1.0, 1.0, 1.0]}
        used |= set(material.get("extensions", ()))
        if cards.alpha.kind in ("hash", "coverage"):  # which glTF lacks
            material["extras"] = {"alphaMode": cards.alpha.kind.upper()}
    for mesh in tree["meshes"]:
        for attributes in (primitive["attributes"] for primitive in mesh["primitives"]):
            if _TANGENT in attributes:
                attributes["TANGENT"] = attributes.pop(_TANGENT)  # trimesh writes attributes of its own choice only
    if used:
        tree["extensionsUsed"] = sorted(used)


def _pictures(cards: Cards) -> _Pictures:
    """The pictures by name: their mip levels, or level 0 alone, uint8 [h, w, C], and whether they are colors."""
    pictures = {"atlas": (list(cards.chain or [cards.atlas.image]), True)}
    if cards.atlas.surface is not None:
        levels = cards.surface_chain or [cards.atlas.surface]
        pictures["normals"] = [np.ascontiguousarray(level[..., :3]) for level in levels], False
        # Occlusion as gray, then translucency, if there is any.
        pictures["occlusion"] = [np.concatenate([level[..., 3:4].repeat(3, -1), level[..., 4:]], -1) for level in levels], False
    return pictures


def _with_images(tree: dict[str, Any], pictures: list[str], config: ResolvedExport) -> list[tuple[str, str, str]]:
    """Let the textures of a glTF refer to its images, by their numbers; of each image the name as a file, its picture, and its type."""
    extension, kind = _EXTENSIONS.get(config.textures, ("", ""))
    images = list[tuple[str, str, str]]()
    for texture, name in zip(tree["textures"], pictures, strict=True):
        for ending in _endings(config):
            if ending == "png":
                texture["source"] = len(images)
            else:
                texture["extensions"] = {extension: {"source": len(images)}}
            images.append((f"{name}.{ending}", name, "image/png" if ending == "png" else kind))
    if extension:
        tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), extension})
        if not config.fallback:
            tree["extensionsRequired"] = sorted({*tree.get("extensionsRequired", ()), extension})
    return images


def _without_placeholder(tree: dict[str, Any], views: list[bytes]) -> list[bytes]:
    """The contents of the buffer views without that of trimesh's picture; the JSON gets the new numbers of the others."""
    used = sorted({accessor["bufferView"] for accessor in tree["accessors"]})
    for accessor in tree["accessors"]:
        accessor["bufferView"] = used.index(accessor["bufferView"])
    tree["bufferViews"] = [tree["bufferViews"][number] for number in used]
    return [views[number] for number in used]
