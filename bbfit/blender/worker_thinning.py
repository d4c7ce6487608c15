"""Thin the meshes of a tree out. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

# A material is foliage if none of its islands is longer than this share of the tree's diagonal. Leaves and cards are shorter, stems longer.
FOLIAGE_LENGTH = 0.25
# Leaves are enlarged by at most this factor to compensate for removed leaves.
MAX_GROWTH = 4.0
# What is seen of the area of a stem, whose far side is hidden, relative to that of a leaf. A quarter is no better.
BARK_SEEN = 0.5
# Triangles that a leaf or a part of the bark keeps in the mean. Parts that cannot have them go. Fewer leaves of more triangles each are
# worse, and so are more twigs of fewer triangles: their tubes collapse, and that of the trunk too. Measured on training views of four
# trees.
LEAF_TRIANGLES, BARK_TRIANGLES = 1, 16
# Leaves with pictures keep the triangles of a rectangle.
RECTANGLE = 2
# Leaves are modeled as fronts and backs if more than this share of their triangles has another one of the same corners.
DOUBLE = 0.5
# Leaves are flat if the lengths of their vector areas have at least this share of their areas.
FLAT = 0.7
# An equilateral triangle whose circumscribed circle has a radius of 1, and its area.
CORNERS, AREA = np.array([[0, 1], [0.75**0.5, -0.5], [-(0.75**0.5), -0.5]]), 0.75 * 3**0.5
# Vertices of split bark are one if they are so near each other, in meters. Blender merges none at a distance of 0.
MERGED = 1e-6
# The attribute of polygons that holds their island before edges collapse.
ISLAND = "bbfit_island"
# Bark and foliage may exceed their numbers of triangles by this factor. If more remain, further parts go, at least a tenth of them at a
# time, in at most so many attempts.
OVERSHOOT, ATTEMPTS, FEWER = 1.01, 8, 0.9


@dataclass(frozen=True)
class Islands:
    """The connected components ("islands") of a mesh of P vertices and T triangles.

    Triangles are connected if they share a vertex, or the ends of an edge of one material have the same places: files split vertices where
    normals differ, as those of flat faces do.
    """

    labels: np.ndarray
    """Island of each vertex, [P]."""
    triangles: np.ndarray
    """Vertices of each triangle, [T, 3]."""
    materials: np.ndarray
    """Material slot of each triangle, [T]."""
    areas: np.ndarray
    """Area of each triangle, [T]."""
    lengths: np.ndarray
    """Diagonal of the bounding box of each triangle's island, [T]."""
    centers: np.ndarray
    """The mean of each island's vertices, [I, 3]."""
    double: np.ndarray
    """Whether another triangle of the same material has the same corners, [T]."""
    split: bool
    """Whether islands consist of parts that share no vertices."""


def thinned(meshes: list[Any], triangles: int) -> list[list[Any]]:
    """Thin a tree out to about ``triangles``: take whole leaves and twigs away, collapse edges of what remains, and enlarge the leaves.

    What remains of each mesh are up to two meshes, in the same frame. Bark and foliage share the triangles by the areas that one sees of
    them. Both keep as many parts as can have a few triangles each (``BARK_TRIANGLES``, ``LEAF_TRIANGLES``): leaves evenly, and large parts
    of the bark more likely than small ones, so that the trunk stays. Flat leaves without pictures stay whole or become a triangle
    (:func:`flattened`). The edges of all else collapse where this changes its shape least. Then each leaf gets back its center and its
    area, and more area for the leaves that are gone (Cook et al., "Stochastic Simplification of Aggregate Detail", SIGGRAPH 2007).
    """
    originals = [islands(mesh) for mesh in meshes]
    points = np.concatenate([coordinates(mesh)[np.unique(each.triangles)] for mesh, each in zip(meshes, originals, strict=True)])
    length = FOLIAGE_LENGTH * float(np.linalg.norm(np.ptp(points, axis=0)))
    leaves = [~np.isin(each.materials, each.materials[each.lengths >= length]) for each in originals]
    bark = [~each for each in leaves]
    leaf_area, bark_area = (sum(float(of.areas[each].sum()) for of, each in zip(originals, kind, strict=True)) for kind in (leaves, bark))
    share = leaf_area / max(leaf_area + BARK_SEEN * bark_area, 1e-30)
    of_leaves = min(sum(int(each.sum()) for each in leaves), round(share * triangles))
    textured = any(shows_picture(mesh, original.materials[each]) for mesh, original, each in zip(meshes, originals, leaves, strict=True))
    doubled = sum(int((original.double & each).sum()) for original, each in zip(originals, leaves, strict=True))
    sides = 2 if doubled > DOUBLE * sum(int(each.sum()) for each in leaves) else 1
    stems = reduced(meshes, originals, bark, triangles - of_leaves, BARK_TRIANGLES, by_area=True)
    rest = triangles - sum(len(mesh.loop_triangles) for mesh in stems if mesh)
    if textured or not flat(meshes, originals, leaves, sides):
        crowns = reduced(meshes, originals, leaves, rest, RECTANGLE if textured else LEAF_TRIANGLES, by_area=False, sides=sides)
    else:
        crowns = whole_or_flattened(meshes, originals, leaves, rest, sides)
    for mesh, original, crown in zip(meshes, originals, crowns, strict=True):
        if crown:
            restore_leaves(crown, original, coordinates(mesh))
    for mesh in filter(None, [*stems, *crowns]):
        mesh.attributes.remove(mesh.attributes[ISLAND])
    return [[mesh for mesh in both if mesh] for both in zip(stems, crowns, strict=True)]


def shows_picture(mesh: Any, slots: np.ndarray) -> bool:
    """Whether a material in any of these slots of a mesh has a picture."""
    materials = [mesh.materials[slot] for slot in np.unique(slots) if slot < len(mesh.materials)]
    return any(node.type == "TEX_IMAGE" for material in materials if material and material.node_tree for node in material.node_tree.nodes)


def flat(meshes: list[Any], originals: list[Islands], leaves: list[np.ndarray], sides: int) -> bool:
    """Whether leaves are flat, and some have more than one triangle a side."""
    wide = whole = triangles = count = 0.0
    for mesh, original, each in zip(meshes, originals, leaves, strict=True):
        labels, vectors = facing(original, coordinates(mesh), each, sides)
        wide += float(np.linalg.norm(summed(labels, vectors), axis=-1).sum())
        whole += float(np.linalg.norm(vectors, axis=-1).sum())
        triangles, count = triangles + len(labels), count + len(np.unique(labels))
    return triangles > count and wide >= FLAT * whole


def facing(original: Islands, points: np.ndarray, chosen: np.ndarray, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of the sides to which the C ``chosen`` triangles belong, [C], and their vector areas, [C, 3].

    Each island has one number, or with two ``sides`` a number for its front and another for its back.
    """
    corners = points[original.triangles[chosen]]
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    labels = original.labels[original.triangles[chosen, 0]].astype(np.int64)
    front = vectors[largest(labels, original.areas[chosen])[labels]]
    return 2 * labels + ((vectors * front).sum(-1) < 0 if sides == 2 else 0), vectors


def largest(labels: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """The index of the largest among the triangles of each label; 0 for labels without triangles."""
    order, found = np.argsort(areas, kind="stable"), np.zeros(labels.max(initial=-1) + 1, np.int64)
    found[labels[order]] = order
    return found


def summed(labels: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums of ``values``, [C, K], over the elements of each label."""
    return np.stack([np.bincount(labels, column) for column in values.T], -1)


def whole_or_flattened(meshes: list[Any], originals: list[Islands], leaves: list[np.ndarray], triangles: int, sides: int) -> list[Any]:
    """At most ``triangles`` of all ``leaves``: as many leaves as possible, and as many of these as possible whole.

    Both are evenly spread. Leaves that are not whole have a triangle a side.
    """
    labels = [original.labels[original.triangles[:, 0]] for original in originals]
    sizes = [np.bincount(label[each], minlength=len(of.centers)) for label, each, of in zip(labels, leaves, originals, strict=True)]
    places = [np.flatnonzero(size) for size in sizes]
    order = np.argsort(np.concatenate([spread(of.centers[place]) for of, place in zip(originals, places, strict=True)]), kind="stable")
    order = order[: max(triangles, 0) // sides]
    more = np.concatenate([size[place] for size, place in zip(sizes, places, strict=True)])[order] - sides
    states = np.zeros(sum(map(len, places)), np.int8)  # 1: flattened, 2: whole
    states[order] = 1 + (np.cumsum(np.maximum(more, 0)) <= triangles - sides * len(order))
    made = list[Any]()
    for mesh, original, each, label, place in zip(meshes, originals, leaves, labels, places, strict=True):
        state = np.zeros(len(original.centers), np.int8)
        state[place], states = states[: len(place)], states[len(place) :]
        kept = each & (state[label] > 0)
        made.append(flattened(mesh, original, kept, kept & (state[label] == 2), sides) if kept.any() else None)
    return made


def flattened(mesh: Any, original: Islands, kept: np.ndarray, whole: np.ndarray, sides: int) -> Any:
    """The ``kept`` triangles of a mesh, with one triangle for each side of each leaf that is not ``whole``.

    It has the normal, the area and the center of the side, its second moments of area up to a factor, and its tip where the side has it.
    """
    rest = np.flatnonzero(kept & ~whole)
    points = coordinates(mesh)
    labels, vectors = facing(original, points, kept & ~whole, sides)
    numbers, labels = np.unique(labels, return_inverse=True)
    areas = original.areas[rest].astype(np.float64)
    corners = points[original.triangles[rest]].astype(np.float64)
    total, centers = centers_of_area(corners.mean(1), areas, labels, len(numbers))
    offsets = corners - centers[labels][:, None]
    middles = offsets.sum(1)
    moments = np.einsum("tik,til->tkl", offsets, offsets) + middles[:, :, None] * middles[:, None, :]
    sizes, axes = np.linalg.eigh(summed(labels, areas[:, None] * moments.reshape(-1, 9)).reshape(-1, 3, 3) / total[:, None, None])
    along, across = axes[..., 2], axes[..., 1]
    skewed = summed(labels, (areas * (middles * along[labels]).sum(-1) ** 3)[:, None])
    along = np.where(skewed < 0, -1, 1) * along
    turned = (np.cross(along, across) * summed(labels, vectors)).sum(-1, keepdims=True)
    across = np.where(turned < 0, -1, 1) * across
    axes = np.sqrt(np.maximum(sizes[:, 1:], 0))[..., None] * np.stack([across, along], 1)
    axes *= np.sqrt(total / np.maximum(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1]), axis=-1), 1e-30) / AREA)[:, None, None]
    places = centers[:, None] + CORNERS @ axes
    return only(mesh, original, whole, (polygons_of(mesh)[rest[largest(labels, areas)]], places), merge=False)


def reduced(
    meshes: list[Any], originals: list[Islands], chosen: list[np.ndarray], triangles: int, least: float, *, by_area: bool, sides: int = 1
) -> list[Any]:
    """The ``chosen`` triangles of each mesh, reduced to about ``triangles`` of all; ``None`` where nothing remains.

    As many islands remain as can have ``least`` triangles a side in the mean. Islands stay whole if they have fewer in the mean, or no more
    than a rectangle, which would vanish as a whole. ``by_area``: the larger an island, the likelier it remains.
    """
    import bpy

    total = sum(int(each.sum()) for each in chosen)
    count = sum(len(np.unique(original.labels[original.triangles[each, 0]])) for original, each in zip(originals, chosen, strict=True))
    if triangles < 1 or not count:
        return [None for _ in meshes]
    mean = total / count
    share = triangles / count / (mean if mean <= sides * RECTANGLE else min(sides * least, mean))
    made = list[Any]()
    for _ in range(ATTEMPTS):
        bpy.data.batch_remove([mesh for mesh in made if mesh])
        made = collapsed(meshes, originals, sampled(originals, chosen, share, by_area=by_area), triangles, merge=by_area)
        got = sum(len(mesh.loop_triangles) for mesh in made if mesh)
        if got <= OVERSHOOT * triangles or share * count <= 1:
            break
        # The edges of small closed surfaces and of some leaves cannot collapse so far.
        share = min(share, 1.0) * min(triangles / got, FEWER)
    return made


def sampled(originals: list[Islands], chosen: list[np.ndarray], share: float, *, by_area: bool) -> list[np.ndarray]:
    """Which of the ``chosen`` triangles of each mesh remain, if a ``share`` of their islands does, at least one of each mesh."""
    kept = list[np.ndarray]()
    for original, each in zip(originals, chosen, strict=True):
        labels = original.labels[original.triangles[:, 0]]
        numbers = np.unique(labels[each])
        areas = np.bincount(labels[each], original.areas[each], len(original.centers))[numbers] if by_area else 1.0
        # Weighted sampling without replacement (Efraimidis and Spirakis 2006), with evenly spread numbers in place of random ones.
        order = np.argsort(-np.log1p(-spread(original.centers[numbers])) / np.maximum(areas, 1e-30), kind="stable")
        kept.append(each & np.isin(labels, numbers[order[: math.ceil(share * len(numbers))]]))
    return kept


def collapsed(meshes: list[Any], originals: list[Islands], kept: list[np.ndarray], triangles: int, *, merge: bool) -> list[Any]:
    """The ``kept`` triangles of each mesh, whose edges collapse until about ``triangles`` of all are left.

    ``merge`` joins vertices of the same place first, in meshes whose islands share none: edges of single triangles collapse to nothing.
    """
    import bpy

    ratio = triangles / max(sum(int(each.sum()) for each in kept), 1)
    made = list[Any]()
    for mesh, original, each in zip(meshes, originals, kept, strict=True):
        if not each.any():
            made.append(None)
            continue
        part = bpy.data.objects.new("part", only(mesh, original, each, merge=merge and original.split))
        bpy.context.scene.collection.objects.link(part)
        if ratio < 1:
            modifier = part.modifiers.new("bbfit", "DECIMATE")
            modifier.ratio, modifier.use_collapse_triangulate = ratio, True
        depsgraph = bpy.context.evaluated_depsgraph_get()
        reduced_mesh = bpy.data.meshes.new_from_object(part.evaluated_get(depsgraph), depsgraph=depsgraph)
        bpy.data.batch_remove([part.data])  # and the object with it
        reduced_mesh.calc_loop_triangles()
        made.append(reduced_mesh if len(reduced_mesh.polygons) else None)
    return made


def spread(points: np.ndarray) -> np.ndarray:
    """Different numbers in [0, 1) for points, [P, 3], so that the points with numbers below any bound are spread evenly among all.

    They are those of van der Corput's sequence, along Morton's curve through the points.
    """
    low = points.min(0, initial=np.inf)
    scale = 1023 / max(float((points - low).max(initial=0)), 1e-30)
    cells = ((points - low) * scale).astype(np.int64)
    code = sum(((cells >> bit & 1) << [3 * bit, 3 * bit + 1, 3 * bit + 2]).sum(-1) for bit in range(10))
    rank, values = np.empty(len(points), np.int64), np.zeros(len(points))
    rank[np.argsort(code, kind="stable")] = np.arange(len(points))
    for bit in range(max(len(points) - 1, 1).bit_length()):
        values += (rank >> bit & 1) / 2 ** (bit + 1)
    return values


def only(mesh: Any, original: Islands, kept: np.ndarray, flat: tuple[np.ndarray, np.ndarray] | None = None, *, merge: bool) -> Any:
    """A copy of a mesh with the polygons of the ``kept`` triangles alone; an island is kept as a whole or not at all.

    ``merge`` makes vertices of the same place one. ``flat``: further triangles, which are like polygons of the mesh, [F], and have corners
    at other places, [F, 3, 3]. Polygons have the attribute ``ISLAND``.
    """
    import bmesh

    polygons = polygons_of(mesh)
    stays, labels = np.zeros(len(mesh.polygons), bool), np.zeros(len(mesh.polygons), np.int32)
    stays[polygons[kept]], labels[polygons] = True, original.labels[original.triangles[:, 0]]
    copy, edited = mesh.copy(), bmesh.new()
    copy.attributes.new(ISLAND, "INT", "FACE").data.foreach_set("value", labels)
    edited.from_mesh(copy)
    faces = list(edited.faces)
    for like, places in zip(map(faces.__getitem__, flat[0]), flat[1], strict=True) if flat else ():
        corners = [edited.verts.new(place, loop.vert) for place, loop in zip(places.tolist(), like.loops, strict=False)]
        for loop, other in zip(edited.faces.new(corners, like).loops, like.loops, strict=False):
            loop.copy_from(other)
    bmesh.ops.delete(edited, geom=[face for face in faces if not stays[face.index]], context="FACES")
    if merge:
        bmesh.ops.remove_doubles(edited, verts=edited.verts, dist=MERGED)
    edited.to_mesh(copy)
    edited.free()
    return copy


def islands(mesh: Any) -> Islands:
    """Compute the connected components of a mesh."""
    (triangles, areas, materials), points = triangles_of(mesh), coordinates(mesh)
    links = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    own, _ = connected(links, len(points))
    places = numbered(points)
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.where((places[edges[:, :1]] <= places[edges[:, 1:]]), edges, edges[:, ::-1])
    first, second = equal_pairs(places[edges], np.repeat(materials, 3))
    number, labels = connected(np.concatenate([links, np.column_stack([edges[first, 0], edges[second, 0]])]), len(points))
    low, high = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
    np.minimum.at(low, labels, points)
    np.maximum.at(high, labels, points)
    lengths = np.linalg.norm(high - low, axis=-1)[labels[triangles[:, 0]]]
    counts = np.maximum(np.bincount(labels, minlength=number), 1)
    centers = np.stack([np.bincount(labels, points[:, axis], number) / counts for axis in range(3)], -1)
    double = np.zeros(len(triangles), bool)
    double[np.concatenate(equal_pairs(np.sort(places[triangles], axis=1), materials))] = True
    return Islands(labels, triangles, materials, areas, lengths, centers, double, split=number < own)


def numbered(points: np.ndarray) -> np.ndarray:
    """A number for each of the points, [P, 3], at least one; equal points have the same. Takes half of the time of ``np.unique``."""
    order = np.lexsort(points.T)
    numbers = np.zeros(len(points), np.int64)
    numbers[order[1:]] = np.cumsum((points[order[1:]] != points[order[:-1]]).any(-1))
    return numbers


def equal_pairs(rows: np.ndarray, materials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of rows that are equal, with equal materials, one after another: those of the first and of the second of each pair."""
    keys = [materials, *rows.T]
    order = np.lexsort(keys)
    same = np.logical_and.reduce([key[order[1:]] == key[order[:-1]] for key in keys])
    return order[:-1][same], order[1:][same]


def connected(links: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """The number of connected components of ``count`` vertices with ``links``, [L, 2], and the component of each vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(links), bool), (links[:, 0], links[:, 1])), (count, count))
    return connected_components(graph, directed=False)


def coordinates(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh, [P, 3] float32."""
    values = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", values.ravel())
    return values


def polygons_of(mesh: Any) -> np.ndarray:
    """The polygon of each triangle of a mesh, [T]."""
    polygons = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    return polygons


def triangles_of(mesh: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangles of a mesh: their vertices, [T, 3], areas, [T], and material slots, [T]."""
    mesh.calc_loop_triangles()
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    areas = np.empty(len(triangles), np.float32)
    mesh.loop_triangles.foreach_get("area", areas)
    materials = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", materials)
    return triangles, areas, materials[polygons_of(mesh)]


def restore_leaves(mesh: Any, original: Islands, places: np.ndarray) -> None:
    """Give each remaining leaf of a mesh of foliage its center of area in ``original``, whose vertices have ``places``, and its area there,
    enlarged so that each material has its area in ``original``. No leaf shrinks, or grows by more than ``MAX_GROWTH``.
    """
    (triangles, areas, materials), points = triangles_of(mesh), coordinates(mesh)
    sources = np.empty(len(mesh.polygons), np.int32)
    mesh.attributes[ISLAND].data.foreach_get("value", sources)
    leaf = sources[polygons_of(mesh)]
    labels, count = original.labels[original.triangles[:, 0]], len(original.centers)
    had, before = centers_of_area(places[original.triangles].mean(1), original.areas, labels, count)
    (has, after), growth = centers_of_area(points[triangles].mean(1), areas, leaf, count), np.ones(count)
    for material in np.unique(materials):
        kept = np.unique(leaf[materials == material])
        missing = original.areas[original.materials == material].sum(dtype=np.float64) / had[kept].sum()
        growth[kept] = np.clip(np.sqrt(missing * had[kept] / has[kept]), 1.0, MAX_GROWTH)
    corners, leaves = triangles.ravel(), np.repeat(leaf, 3)
    points[corners] = before[leaves] + growth[leaves, None] * (points[corners] - after[leaves])
    mesh.vertices.foreach_set("co", points.ravel())
    mesh.update()


def centers_of_area(middles: np.ndarray, areas: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Areas, [I], and centers of area, [I, 3], of ``count`` parts of a mesh, from the middle, the area and the part of each triangle."""
    weights = np.maximum(areas.astype(np.float64), 1e-30)
    total = np.maximum(np.bincount(labels, weights, count), 1e-30)
    return total, np.stack([np.bincount(labels, weights * along, count) / total for along in middles.T], -1)
