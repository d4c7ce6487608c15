"""Growing a tree: from the name of a species to a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bbfit.checks import fail
from bbfit.trees.config import VERTEX_LIMIT, GrowConfig
from bbfit.trees.leaf_shapes import leaf_shape
from bbfit.trees.mesh import count_vertices, tree_parts
from bbfit.trees.species import Species, load_species
from bbfit.trees.tree_file import scene_of
from bbfit.trees.weber_penn import grow_skeleton

if TYPE_CHECKING:
    import trimesh

# Vertices of the plainest stem there is: a cone on a triangle, whose seam is there twice.
_LEAST_STEM = 5


def grow(
    species: str | Species,
    *,
    seed: int = 0,
    detail: float = 1.0,
    leaves: float = 1.0,
    max_vertices: int = VERTEX_LIMIT,
) -> trimesh.Scene:
    """Grow a tree after Weber and Penn 1995 (:mod:`bbfit.trees.weber_penn`); the same arguments give the same tree.

    Parameters
    ----------
    species : one of :func:`~bbfit.trees.species.known_species`, or figures from :func:`~bbfit.trees.species.load_species`.
    seed : at least 0; another seed, another tree of the kind.
    detail : factor on the rings along stems and on the corners of each ring, in (0, 10]; it changes neither the stems nor the leaves.
    leaves : share of the leaves that is kept, in [0, 1]; those grow so that the area of all stays.
    max_vertices : most vertices that the tree may have.

    Returns
    -------
    A mesh for the bark and one for each leaf tone; Y up, metres, the foot of the trunk at the origin, unit normals, texture coordinates,
    plain materials of which the leaves' are double-sided.

    Raises
    ------
    InputError
        for an unknown species, a value out of range, or a tree of too many vertices.
    """
    config = GrowConfig(seed=seed, detail=detail, leaves=leaves, max_vertices=max_vertices)
    if isinstance(species, str):
        species = load_species(species)
    corners = len(leaf_shape(species.leaf_shape).points)

    def count(level: int, number: int) -> None:
        least = number * (corners if level == species.levels else _LEAST_STEM)
        if least > max_vertices:
            _refuse(species, config, f"at least {least:,} vertices")

    skeleton = grow_skeleton(species, seed, count, leaves=leaves)
    if (vertices := count_vertices(skeleton, detail)) > max_vertices:
        _refuse(species, config, f"{vertices:,} vertices, {corners * len(skeleton.leaves.parent):,} of them in leaves,")
    return scene_of(tree_parts(skeleton, seed, detail=detail), name=species.name)


def _refuse(species: Species, config: GrowConfig, vertices: str) -> None:
    fail(
        species.name,
        f"would have {vertices} at detail {config.detail:g} and leaves {config.leaves:g}; the limit is {config.max_vertices:,}",
        "lower detail (fewer rings and corners on stems) or leaves (fewer, larger leaves), or raise max_vertices",
    )
