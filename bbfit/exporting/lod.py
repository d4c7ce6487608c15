"""Several models of one tree as levels of detail in one GLB, with the extension MSFT_lod."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bbfit.exporting.config import Outline
from bbfit.glb import gltf_parts, is_glb, joined_glb, split_glb
from bbfit.model_files import generator

# The lists in a glTF that bbfit writes.
_ITEMS = ("bufferViews", "accessors", "images", "samplers", "textures", "materials", "meshes", "nodes")


@dataclass(frozen=True)
class LodLevel:
    """One level of a file of levels of detail."""

    name: str
    """Name of its node."""
    planes: int | None
    """Number of billboards; ``None`` for the tree itself and for a thinned-out tree."""
    vertices: int
    """Number of vertices in the file."""
    triangles: int
    """Number of triangles in the file."""
    bytes: int
    """Size of the level as a separate file."""
    error_meters: float
    """Error of its silhouette (:func:`bbfit.evaluation.metrics.silhouette_distance`) in the worst training view; 0 for the tree itself."""
    error_pixels: float
    """The same error on the screen, where the level takes over."""
    held_out_error_pixels: float
    """The same error in the worst held-out view, which did not influence the levels."""
    psnr: float | None
    """PSNR in dB in the held-out views at their full size, the mean over four backgrounds; ``None`` for the tree itself."""
    tree_pixels: float | None
    """Height of the tree on the screen in pixels below which the level is shown; ``None`` for the finest level."""
    distance_meters: float
    """Smallest distance of the tree from the camera at which the level is shown, on the screen of the configuration."""
    screen_coverage: float
    """Smallest share of the screen that the tree's bounding sphere covers where the level is shown; 0 for the coarsest level."""
    file: str
    """Name of the level's own GLB file."""
    silhouette_distance_meters: float
    """Distance from which the error of its silhouette is within the bound."""
    color_distance_meters: float
    """Distance from which its colors are (:func:`bbfit.evaluation.color_error.mean_color_error`)."""
    color_error: float
    """Mean error of its colors in the training views where the level takes over, in [0, 1]; 0 for the tree itself."""
    held_out_color_error: float
    """The same error in the held-out views."""
    requested: int | None = None
    """Number of billboards that were requested, which is the name of its run's folder. The fit may have removed some of them."""
    halvings: int = 0
    """How many times the sides of its textures were halved, because it is only seen from afar."""
    outline: Outline | None = None
    """The outline of its billboards, if speed decided about it."""
    speed_distance_meters: float = 0.0
    """Distance from which it draws faster than the level before it; 0 where that does not count."""
    fragments: float | None = None
    """Fragments of a picture of it where it takes over, hidden and transparent ones included; ``None`` where that does not count."""

    @property
    def content(self) -> str:
        """The number of its billboards, ``tree`` for the tree itself, or the number of triangles of a thinned-out tree."""
        if self.planes is not None:
            return str(self.planes)
        return "tree" if self.psnr is None else f"{self.triangles:,} triangles"


def lod_glb(models: Sequence[bytes], levels: Sequence[LodLevel], profile: str | None = None) -> bytes:
    """Join GLB models, the finest first, into one GLB whose first node lists the others as its coarser levels; ``levels`` describes them.

    For the ``profile`` babylon it is the first model alone: Babylon.js takes MSFT_lod for stages of loading, and may show two of them.

    The first model may be any file that :func:`is_self_contained` accepts, and keeps its items and their indices. The others are those of
    :func:`~bbfit.exporting.gltf.glb_bytes`, or thinned-out trees that Blender wrote.

    The scene holds only the first level, under a new node; programs without MSFT_lod show only this level. As the extension requires, the
    nodes of the other levels are outside the scene. The ``extras`` of the first level's node hold the smallest screen coverage of each
    level (``MSFT_screencoverage``) and its smallest distance in meters (``lod_distances``).
    """
    assert len(models) == len(levels) > 0
    if profile == "babylon":
        models, levels = models[:1], levels[:1]
    tree, views = split_glb(models[0])
    roots = [_rooted(tree, levels[0].name, _scene(tree)["nodes"])]
    for level, model in zip(levels[1:], models[1:], strict=True):
        other, contents = split_glb(model)
        roots.append(_append(tree, other, level.name))
        views += contents
    first = tree["nodes"][roots[0]]
    first["extras"] = {
        "MSFT_screencoverage": [level.screen_coverage for level in levels],
        "lod_distances": [level.distance_meters for level in levels],
    }
    if len(roots) > 1:
        first["extensions"] = {"MSFT_lod": {"ids": roots[1:]}}
        tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "MSFT_lod"})
    _scene(tree)["nodes"] = roots[:1]
    tree["asset"]["generator"] = generator()
    return joined_glb({key: value for key, value in tree.items() if value != []}, views)


def is_self_contained(path: Path) -> bool:
    """Whether a file is a GLB of glTF 2.0 with all its data in its one binary chunk, so that others can be joined to it.

    Raises InputError if the file is a damaged GLB.
    """
    data = path.read_bytes()
    if not is_glb(data):
        return False
    tree, _ = gltf_parts(data, "tree", path)
    uris = [item for kind in ("buffers", "images") for item in tree.get(kind, []) if "uri" in item]
    return len(tree.get("buffers", [])) == 1 and not uris and bool(tree.get("scenes"))


def _scene(tree: dict[str, Any]) -> dict[str, Any]:
    """The scene that programs show."""
    scene: dict[str, Any] = tree["scenes"][tree.get("scene", 0)]
    return scene


def _append(tree: dict[str, Any], other: dict[str, Any], name: str) -> int:
    """Append the items of another glTF in place under a new node, whose name prefixes theirs; return the node's index."""
    at = {kind: len(tree.setdefault(kind, [])) for kind in _ITEMS}

    def moved(item: dict[str, Any], **kinds: str) -> dict[str, Any]:
        return item | {key: item[key] + at[kind] for key, kind in kinds.items() if key in item}

    def with_moved_textures(item: dict[str, Any]) -> dict[str, Any]:
        inner = {key: with_moved_textures(value) for key, value in item.items() if isinstance(value, dict)}
        return moved(item | inner, index="textures")

    tree["bufferViews"] += other["bufferViews"]
    tree["accessors"] += [moved(accessor, bufferView="bufferViews") for accessor in other["accessors"]]
    tree["images"] += [moved(image, bufferView="bufferViews") for image in other.get("images", [])]
    tree["samplers"] += other.get("samplers", [])
    for texture in other.get("textures", []):
        sources = {extension: moved(entry, source="images") for extension, entry in texture.get("extensions", {}).items()}
        tree["textures"].append(moved(texture, sampler="samplers", source="images") | ({"extensions": sources} if sources else {}))
    tree["materials"] += [with_moved_textures(material) for material in other.get("materials", [])]
    for mesh in other["meshes"]:
        primitives = [
            moved(primitive, indices="accessors", material="materials")
            | {"attributes": {key: index + at["accessors"] for key, index in primitive["attributes"].items()}}
            for primitive in mesh["primitives"]
        ]
        tree["meshes"].append(mesh | {"name": f"{name}_{mesh['name']}", "primitives": primitives})
    for node in other["nodes"]:
        children = {"children": [child + at["nodes"] for child in node["children"]]} if "children" in node else {}
        tree["nodes"].append(moved(node, mesh="meshes") | children | {"name": f"{name}_{node['name']}"})
    for key in ("extensionsUsed", "extensionsRequired"):
        if key in other:
            tree[key] = sorted({*tree.get(key, ()), *other[key]})
    return _rooted(tree, name, [node + at["nodes"] for node in _scene(other)["nodes"]])


def _rooted(tree: dict[str, Any], name: str, children: list[int]) -> int:
    """Put nodes under a new one; return its index."""
    tree["nodes"].append({"name": name, "children": children})
    return len(tree["nodes"]) - 1


def glb_counts(glb: bytes) -> tuple[int, int]:
    """Vertices and triangles of everything that nodes of a GLB show; a mesh counts for each of its nodes, strips and fans as they are."""
    tree, _ = split_glb(glb)
    vertices = triangles = 0
    for node in tree["nodes"]:
        for primitive in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            count = tree["accessors"][primitive["attributes"]["POSITION"]]["count"]
            corners = tree["accessors"][primitive["indices"]]["count"] if "indices" in primitive else count
            vertices += count
            triangles += {4: corners // 3, 5: max(0, corners - 2), 6: max(0, corners - 2)}.get(primitive.get("mode", 4), 0)
    return vertices, triangles
