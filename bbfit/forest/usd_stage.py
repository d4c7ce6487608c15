"""A USD stage of a forest: a PointInstancer for each leaf of the quadtree, which loads as a payload, over trees with a variant set ``lod``.

https://openusd.org/release/api/class_usd_geom_point_instancer.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.files import write_bytes
from bbfit.forest.journal import Journal
from bbfit.forest.placements import Placements, quaternions
from bbfit.forest.prototypes import Part, Prototype, read_prototype, rotated
from bbfit.forest.tiles import ForestTile, leaves, read_tile
from bbfit.inputs import InputLimits, reading
from bbfit.library.manifest import Library
from bbfit.outputs import output_folder, remove_results
from bbfit.scratch import ScratchFolder
from bbfit.stages.stage import OnProgress

STAGE, TREES, TEXTURES, USD_TILES, USD_JOURNAL = "forest.usda", "trees", "textures", "tiles", "journal.jsonl"
_HINT = "build the library again"
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# The wrap modes of glTF's samplers in USD.
_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}


def check_usd() -> None:
    """Require OpenUSD. Raises InputError if it is not installed."""
    try:
        import pxr  # noqa: F401
    except ImportError:
        fail("formats", "usd-core is not installed", 'install bbfit with its extra, pip install "bbfit[forest]", or leave out usd')


def write_usd(out: Path, forest: tuple[Path, ForestTile], library: Library, limits: InputLimits, key: str, on_progress: OnProgress) -> None:
    """Write the stage of a ``forest`` (its folder and its root tile) to the folder ``out``.

    ``key`` identifies all inputs. Parts that an interrupted call with the same key has written are kept. Raises InputError if a tree has
    textures that USD does not know.
    """
    folder, root = forest
    for part in (TREES, TEXTURES, USD_TILES):
        output_folder("out", out / part)
    with Journal(out / USD_JOURNAL, key) as journal:
        if not journal.known:
            (out / STAGE).unlink(missing_ok=True)  # until all parts are there, the folder has no stage
            remove_results(out, *(f"{part}/*" for part in (TREES, TEXTURES, USD_TILES)))
        textures = set[str]()
        for tree in range(len(library.trees)):
            if f"tree {tree}" not in journal.known or not (out / TREES / f"tree_{tree}.usdc").is_file():
                _write_tree(out, library, tree, limits, textures)
                journal.add(f"tree {tree}", None)
        tiles, done = list(leaves(root)), 0
        for tile in tiles:
            if tile.name not in journal.known or not (out / USD_TILES / f"{tile.name.replace('/', '_')}.usdc").is_file():
                _write_tile(out, tile, read_tile(folder, tile.name), library)
                journal.add(tile.name, None)
            done += tile.count
            on_progress("usd", done, root.count)
    _write_stage(out, tiles)


def _write_stage(out: Path, tiles: Sequence[ForestTile]) -> None:
    from pxr import UsdGeom

    layer, stage = _new_stage()
    group = UsdGeom.Xform.Define(stage, "/forest").GetPrim()
    stage.SetDefaultPrim(group)
    for tile in tiles:
        name = tile.name.replace("/", "_")
        UsdGeom.Xform.Define(stage, f"/forest/tile_{name}")
    payloads = {f"/forest/tile_{tile.name.replace('/', '_')}": f"./{USD_TILES}/{tile.name.replace('/', '_')}.usdc" for tile in tiles}
    del group, stage
    _save(layer, out / STAGE, payloads=payloads)


def _write_tile(out: Path, tile: ForestTile, placements: Placements, library: Library) -> None:
    """Write the instancer of a leaf. Its prototypes are the trees that it has."""
    from pxr import Gf, UsdGeom, Vt

    layer, stage = _new_stage()
    group = UsdGeom.Xform.Define(stage, "/tile")
    stage.SetDefaultPrim(group.GetPrim())
    center = (np.array(tile.low) + np.array(tile.high)) / 2 * [1, 0, 1]
    group.AddTranslateOp().Set(Gf.Vec3d(*center.tolist()))
    instancer = UsdGeom.PointInstancer.Define(stage, "/tile/trees")
    used, indices = np.unique(placements.trees, return_inverse=True)
    for tree in used:
        prim = stage.DefinePrim(f"/tile/trees/prototypes/tree_{tree}", "Xform")
        prim.SetInstanceable(True)
        instancer.CreatePrototypesRel().AddTarget(prim.GetPath())
    turns = quaternions(placements.turns).astype(np.float16)
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy((placements.positions - center).astype(np.float32)))
    instancer.CreateOrientationsAttr(Vt.QuathArray.FromNumpy(turns))
    instancer.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(placements.scales[:, None].repeat(3, 1).astype(np.float32)))
    if placements.rows is not None:
        instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(placements.rows.astype(np.int64)))
    extent = (np.array([tile.low, tile.high]) - center).astype(np.float32)
    instancer.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
    references = {f"/tile/trees/prototypes/tree_{tree}": f"../{TREES}/tree_{tree}.usdc" for tree in used}
    del prim, instancer, group, stage
    _save(layer, out / USD_TILES / f"{tile.name.replace('/', '_')}.usdc", references=references)


def _write_tree(out: Path, library: Library, tree: int, limits: InputLimits, textures: set[str]) -> None:
    """Write a tree with a variant for each level of detail."""
    from pxr import UsdGeom

    described = library.trees[tree]
    layer, stage = _new_stage()
    prim = UsdGeom.Xform.Define(stage, "/tree").GetPrim()
    stage.SetDefaultPrim(prim)
    prim.SetDisplayName(described.name)
    variants = prim.GetVariantSets().AddVariantSet("lod")
    for level in range(len(described.levels)):
        prototype = read_prototype(library, tree, level, limits)
        variants.AddVariant(f"lod{level}")
        variants.SetVariantSelection(f"lod{level}")
        path = library.folder / described.levels[level].file
        with variants.GetVariantEditContext(), reading("library", path, _HINT):
            materials = [_write_material(stage, out, prototype, number, textures) for number in range(len(_materials(prototype)))]
            for number, part in enumerate(prototype.parts):
                _write_part(stage, prototype, part, number, materials)
    variants.SetVariantSelection("lod0")
    _save(layer, out / TREES / f"tree_{tree}.usdc")


def _write_part(stage: Any, prototype: Prototype, part: Part, number: int, materials: Sequence[Any]) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    for index, primitive in enumerate(prototype.document["meshes"][part.mesh]["primitives"]):
        attributes = primitive["attributes"]
        points = _moved(part, _array(prototype, attributes["POSITION"]))
        corners = _array(prototype, primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(points))
        faces = _triangles(corners.astype(np.int32), primitive.get("mode", 4))
        mesh = UsdGeom.Mesh.Define(stage, f"/tree/part_{number}_{index}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel())))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)]).astype(np.float32)))
        if "NORMAL" in attributes:
            normals = rotated(part.rotation, _array(prototype, attributes["NORMAL"]) / part.scale)
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
            mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if part.scale.prod() < 0:
            mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
        described = _materials(prototype)[primitive["material"]] if "material" in primitive else {}
        pbr = described.get("pbrMetallicRoughness", {})
        if "COLOR_0" in attributes and "baseColorTexture" not in pbr:
            colors = _array(prototype, attributes["COLOR_0"])[:, :3] * pbr.get("baseColorFactor", [1, 1, 1, 1])[:3]
            shown = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
            shown.Set(Vt.Vec3fArray.FromNumpy(colors.astype(np.float32)))
        if (name := _texture_coordinates(pbr.get("baseColorTexture", {}))) in attributes:
            uvs = _transformed(pbr.get("baseColorTexture", {}), _array(prototype, attributes[name])) * [1, -1] + [0, 1]  # from the bottom
            st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
            st.Set(Vt.Vec2fArray.FromNumpy(uvs.astype(np.float32)))
        if "material" in primitive:
            mesh.CreateDoubleSidedAttr(bool(described.get("doubleSided", False)))
            UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[primitive["material"]])


def _transform(texture: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the extension KHR_texture_transform of a reference to a texture says."""
    transform: Mapping[str, Any] = texture.get("extensions", {}).get("KHR_texture_transform", {})
    return transform


def _texture_coordinates(texture: Mapping[str, Any]) -> str:
    """The attribute with the coordinates of a reference to a texture."""
    return f"TEXCOORD_{_transform(texture).get('texCoord', texture.get('texCoord', 0))}"


def _transformed(texture: Mapping[str, Any], uvs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates in the picture of a reference to a texture: scaled, rotated against the clock, and moved, in this order."""
    transform = _transform(texture)
    cos, sin = math.cos(angle := transform.get("rotation", 0.0)), math.sin(angle)
    return uvs * transform.get("scale", [1, 1]) @ np.array([[cos, -sin], [sin, cos]]) + transform.get("offset", [0, 0])


def _write_material(stage: Any, out: Path, prototype: Prototype, number: int, textures: set[str]) -> Any:
    """A UsdPreviewSurface. The colors of an unlit material are emitted."""
    from pxr import Gf, Sdf, UsdShade

    described = _materials(prototype)[number]
    pbr = described.get("pbrMetallicRoughness", {})
    color, alpha = pbr.get("baseColorFactor", [1, 1, 1, 1])[:3], float(pbr.get("baseColorFactor", [1, 1, 1, 1])[3])
    unlit = "KHR_materials_unlit" in described.get("extensions", {})
    path = f"/tree/materials/material_{number}"
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0 if unlit else float(pbr.get("roughnessFactor", 1)))
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0 if unlit else float(pbr.get("metallicFactor", 1)))
    shown = surface.CreateInput("emissiveColor" if unlit else "diffuseColor", Sdf.ValueTypeNames.Color3f)
    opacity = surface.CreateInput("opacity", Sdf.ValueTypeNames.Float)
    if unlit:
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0, 0, 0))
    mode = described.get("alphaMode", "OPAQUE")
    if "baseColorTexture" in pbr:
        reader = UsdShade.Shader.Define(stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        texture = UsdShade.Shader.Define(stage, f"{path}/color")
        texture.CreateIdAttr("UsdUVTexture")
        address = _texture(out, prototype, pbr["baseColorTexture"]["index"], textures)
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(address))
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
        texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*map(float, color), alpha))
        sampler = _sampler(prototype, pbr["baseColorTexture"]["index"])
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, Sdf.ValueTypeNames.Token).Set(_WRAPS[sampler.get(side, 10497)])
        shown.ConnectToSource(texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        if mode != "OPAQUE":
            opacity.ConnectToSource(texture.CreateOutput("a", Sdf.ValueTypeNames.Float))
    else:
        if number in _colored(prototype):
            reader = UsdShade.Shader.Define(stage, f"{path}/vertices")
            reader.CreateIdAttr("UsdPrimvarReader_float3")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
            reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(*map(float, color)))
            shown.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
        else:
            shown.Set(Gf.Vec3f(*map(float, color)))
        opacity.Set(alpha if mode != "OPAQUE" else 1.0)
    if mode == "MASK":
        surface.CreateInput("opacityThreshold", Sdf.ValueTypeNames.Float).Set(float(described.get("alphaCutoff", 0.5)))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _colored(prototype: Prototype) -> set[int]:
    """The materials of meshes whose vertices have colors."""
    primitives = [primitive for mesh in prototype.document["meshes"] for primitive in mesh["primitives"]]
    return {primitive["material"] for primitive in primitives if "material" in primitive and "COLOR_0" in primitive["attributes"]}


def check_usd_textures(document: Mapping[str, Any], name: str) -> None:
    """Require that the textures of the tree ``name``, whose glTF is ``document``, are PNG or JPEG, which USD knows. Raises InputError."""
    if any("source" not in texture for texture in document.get("textures", [])):
        fail(
            "usd",
            f"the tree {name} of the library has no PNG or JPEG texture",
            "build the library with PNG too, or without original and thinned trees whose files have others",
        )


def _texture(out: Path, prototype: Prototype, index: int, textures: set[str]) -> str:
    """The address of a texture, relative to the trees, after it was copied. USD knows PNG and JPEG."""
    texture = prototype.document["textures"][index]
    source = texture["source"]  # check_usd_textures
    file, image = prototype.images[source], prototype.document["images"][source]
    if file is None:
        view = prototype.document["bufferViews"][image["bufferView"]]
        data = prototype.binary[(start := view.get("byteOffset", 0)) : start + view["byteLength"]]
        suffix = {"image/png": ".png", "image/jpeg": ".jpg"}[image["mimeType"]]
    else:
        data, suffix = file.read_bytes(), file.suffix.lower()
    name = f"{sha256(data).hexdigest()[:16]}{suffix}"  # the same in whatever order trees are written
    if name not in textures:
        textures.add(name)
        write_bytes(out / TEXTURES / name, data)
    return f"../{TEXTURES}/{name}"


def _sampler(prototype: Prototype, index: int) -> dict[str, Any]:
    """The sampler of a texture; its defaults are those of glTF."""
    number = prototype.document["textures"][index].get("sampler")
    return {} if number is None else prototype.document["samplers"][number]


def _materials(prototype: Prototype) -> list[dict[str, Any]]:
    return list(prototype.document.get("materials", []))


def _array(prototype: Prototype, index: int) -> NDArray[np.float64]:
    """The numbers of an accessor, [count, C]; normalized ones are in [-1, 1]."""
    accessor = prototype.document["accessors"][index]
    view = prototype.document["bufferViews"][accessor["bufferView"]]
    kind, width, count = np.dtype(_NUMBERS[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", kind.itemsize * width)
    data = np.ndarray((count, width), kind, prototype.binary, start, (stride, kind.itemsize)).astype(float)
    if not np.isfinite(data).all():
        raise ValueError("a number is not finite")
    return np.maximum(data / np.iinfo(kind).max, -1) if accessor.get("normalized") else data


def _moved(part: Part, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of a part where they are in the tree."""
    return rotated(part.rotation, points * part.scale) + part.translation


def _triangles(corners: NDArray[np.int32], mode: int) -> NDArray[np.int32]:
    """The triangles of a list, a strip or a fan, [T, 3]."""
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == 5:
        strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], -1)
        strip[1::2] = strip[1::2, [1, 0, 2]]
        return strip
    if mode == 6:
        return np.stack([np.broadcast_to(corners[0], len(corners) - 2), corners[1:-1], corners[2:]], -1).astype(np.int32)
    raise ValueError("a mesh has no triangles")


def _new_stage() -> tuple[Any, Any]:
    """A layer in memory, and a stage on it. The layer lives longer."""
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.CreateAnonymous(".usda")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return layer, stage


def _save(layer: Any, path: Path, references: Mapping[str, str] | None = None, payloads: Mapping[str, str] | None = None) -> None:
    """Write a layer atomically; OpenUSD itself writes in place. Its stage has ended, so that nothing looks for the files of references."""
    from pxr import Sdf

    for prim, address in (references or {}).items():
        layer.GetPrimAtPath(Sdf.Path(prim)).referenceList.Prepend(Sdf.Reference(address))
    for prim, address in (payloads or {}).items():
        layer.GetPrimAtPath(Sdf.Path(prim)).payloadList.Prepend(Sdf.Payload(address))
    with ScratchFolder() as scratch:
        layer.Export(str(scratch / path.name))
        write_bytes(path, (scratch / path.name).read_bytes())
