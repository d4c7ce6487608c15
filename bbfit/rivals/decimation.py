"""The tree with fewer triangles: edge collapse (Garland and Heckbert 1997), and vertex clustering where edge collapse ends.

Quadric error metrics ("Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997) are the common method of mesh
simplification; the package fast-simplification implements it. Edge collapse leaves a few triangles of every connected part, and a tree has
tens of thousands of leaves. For smaller budgets, vertices are merged on a grid (Rossignac and Borrel 1993, "Multi-resolution 3D
approximations for rendering complex scenes"), which ignores connectivity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import InputError, check_count, fail
from bbfit.rivals.mesh_parts import Part, parts_glb, tree_parts, used_vertices
from bbfit.tree_files.gltf_materials import with_transmission
from bbfit.tree_files.tree_file import TreeFile

# Rounds of edge collapse, each with the excess of the previous one as its target; steps of the search for a grid.
_ROUNDS, _STEPS = 4, 24


class TooSmallError(InputError):
    """No triangles of a tree are left within a limit."""


@dataclass(frozen=True)
class DecimatedTree:
    """A tree with fewer triangles, as a GLB file with the tree's materials."""

    glb: bytes
    """Contents of the GLB file."""
    vertices: int
    """Number of vertices."""
    triangles: int
    """Number of triangles."""
    clustered: bool
    """Whether edge collapse was not enough and vertices were clustered."""


def decimate(tree: str | Path | TreeFile, *, vertices: int | None = None, size: int | None = None) -> DecimatedTree:
    """Reduce a .glb, .gltf or .obj to at least 4 ``vertices``, or to a GLB of ``size`` bytes, textures and materials included.

    Parts of different materials stay separate and share the budget by their triangles. Vertices that lie in the same place with the same
    texture coordinates are welded first. Normals are left out: surfaces are flat. JPEG textures are encoded again. Raises
    ``MissingFileError`` or ``InputError`` if the file cannot be used, the package fast-simplification is missing, both limits or neither
    are given; ``TooSmallError`` if nothing is left within the limit.
    """
    if (vertices is None) == (size is None):
        fail("decimate", "expected either vertices or a size", "give one of them")
    limit = vertices if size is None else size
    assert limit is not None
    check_count("vertices" if size is None else "size", limit, 4)
    collapse, tree = _collapser(), TreeFile.open(tree)
    parts = tree_parts(tree)
    names = {part.material.name for part in parts if part.material is not None}
    written = partial(with_transmission, tree=tree, colors=names)
    # What trimesh does not write, of which fewer parts have no more.
    further = len(written(parts_glb(parts))) - len(parts_glb(parts)) if size is not None else 0

    def cost(parts: list[Part]) -> int:
        return sum(len(part.points) for part in parts) if size is None else len(parts_glb(parts)) + further

    whole, now, clustered = parts, cost(parts), False
    if size is not None and (least := _overhead(parts) + further) > limit:
        raise TooSmallError(f"decimate: no triangles are left within the limit: of {limit:,} bytes, materials and textures take {least:,}")
    for _ in range(_ROUNDS):
        if now <= limit:
            break
        share = limit / now if size is None else max(0.0, (limit - _overhead(parts)) / max(1, now - _overhead(parts)))
        fewer = [part for part in (collapse(part, max(1, int(len(part.faces) * share))) for part in parts) if len(part.faces)]
        if not fewer or cost(fewer) >= now:  # nothing is left, or no further edge can collapse
            break
        now, parts = cost(fewer), fewer
    if now > limit:
        # Start again from the whole tree: edge collapse has removed the trunk in favor of leaves that cannot collapse.
        parts, clustered = _clustered(whole, lambda parts: cost(parts) <= limit), True
    return DecimatedTree(
        written(parts_glb(parts)), sum(len(part.points) for part in parts), sum(len(part.faces) for part in parts), clustered
    )


def _collapser() -> Callable[[Part, int], Part]:
    """A function that collapses edges of a part to about a number of triangles, or until no edge can collapse."""
    try:
        import fast_simplification
    except ImportError:
        fail("decimate", "the package fast-simplification is not installed", 'pip install "bbfit[rivals]"')

    def collapse(part: Part, faces: int) -> Part:
        if faces >= len(part.faces):
            return part
        points = np.ascontiguousarray(part.points, np.float32)
        triangles = np.ascontiguousarray(part.faces, np.int32)
        _, _, collapses = fast_simplification.simplify(points, triangles, target_count=faces, return_collapses=True)
        moved, left, became = fast_simplification.replay_simplification(points, triangles, collapses)
        kept = np.nonzero(became >= 0)[0]
        away = np.linalg.norm(points[kept] - moved[became[kept]], axis=1)
        source = np.zeros(len(moved), np.int64)
        far_first = kept[np.argsort(-away, kind="stable")]
        source[became[far_first]] = far_first  # the last one written is the nearest of those that became a vertex
        return used_vertices(part.taken(moved.astype(np.float64), left.astype(np.int64), source))

    return collapse


def _clustered(parts: list[Part], fits: Callable[[list[Part]], bool]) -> list[Part]:
    """Merge vertices on the finest grid whose result fits."""
    points = np.concatenate([part.points for part in parts])
    low, extent = points.min(0), float(np.ptp(points, axis=0).max())
    fine, coarse = math.log(extent / 1e4), math.log(2 * extent)
    best = None
    for _ in range(_STEPS):
        middle = (fine + coarse) / 2
        merged = [part for part in (_merged(part, low, math.exp(middle)) for part in parts) if len(part.faces)]
        if merged and fits(merged):
            best, coarse = merged, middle
        elif merged:
            fine = middle
        else:
            coarse = middle
    if best is None:
        raise TooSmallError("decimate: no triangles are left within the limit")
    return best


def _merged(part: Part, low: NDArray[np.float64], cell: float) -> Part:
    """Merge the vertices in each cell of a grid at their mean position; drop degenerate and duplicate triangles."""
    cells = np.floor((part.points - low) / cell).astype(np.int64)
    _, first, became = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    became = became.reshape(-1)
    counts = np.bincount(became)
    means = np.stack([np.bincount(became, part.points[:, axis]) / counts for axis in range(3)], -1)
    faces = became[part.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return used_vertices(part.taken(means, faces[np.sort(kept)], first))


def _overhead(parts: list[Part]) -> int:
    """Bytes of the file without its triangles: materials, textures and the frame."""
    numbers = sum(part.points.size * 4 + part.faces.size * 4 + (0 if part.uv is None else part.uv.size * 4) for part in parts)
    return len(parts_glb(parts)) - numbers
