"""Growing a tree: from the name of a species to a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

from bbfit.checks import InputTypeError, fail
from bbfit.trees.config import VERTEX_LIMIT, GrowConfig
from bbfit.trees.mesh import count_vertices, leaf_vertices, stem_vertices, tree_parts
from bbfit.trees.species import Species, load_species
from bbfit.trees.tree_writer import scene_of
from bbfit.trees.weber_penn import grow_skeleton

if TYPE_CHECKING:
    import trimesh


def grow(
    species: str | Species,
    *,
    seed: int = 0,
    detail: float = 1.0,
    leaves: float = 1.0,
    max_vertices: int = VERTEX_LIMIT,
) -> trimesh.Scene:
    """Grow a tree after Weber and Penn 1995 (``weber_penn``); the same arguments give the same tree.

    Parameters
    ----------
    species
        A name from ``known_species``, or the result of ``load_species``.
    seed
        At least 0; another seed gives another tree of the same species.
    detail
        Factor on the rings along stems and on the corners of each ring, in [0.1, 10]; it changes neither the stems nor the leaves.
    leaves
        Share of the leaves that grow, in [0, 1]; they are enlarged to keep the total area.
    max_vertices
        Largest number of vertices.

    Returns
    -------
    trimesh.Scene
        One mesh for the bark and one for each leaf tone, with unit normals, texture coordinates and plain materials. Y is up, lengths are
        in meters, and the foot of the trunk is at the origin. Leaf materials are double-sided.

    Raises
    ------
    InputError
        For an unknown species, a value out of range, or a tree of too many vertices.
    """
    config = GrowConfig(seed=seed, detail=detail, leaves=leaves, max_vertices=max_vertices)
    figures = load_species(species) if isinstance(species, str) else species
    if not isinstance(figures, Species):
        raise InputTypeError(f"species: expected a name or a Species, got {species!r}")

    def count(level: int, number: int) -> None:
        if level < figures.levels:
            # A rough bound that limits memory: clones have fewer vertices, and some stems are pruned.
            vertices, limit = stem_vertices(level, figures.curve_res[level], number, detail), 2 * max_vertices
        else:
            vertices, limit = leaf_vertices(figures, number), max_vertices
        if vertices > limit:
            _refuse(figures, config, f"about {vertices:,} vertices in {number:,} {'stems' if level < figures.levels else 'leaves'} alone")

    skeleton = grow_skeleton(figures, seed, count, leaves=leaves)
    if (vertices := count_vertices(skeleton, detail)) > max_vertices:
        in_leaves = leaf_vertices(figures, len(skeleton.leaves.parent))
        _refuse(figures, config, f"{vertices:,} vertices, {in_leaves:,} of them in leaves,")
    return scene_of(tree_parts(skeleton, seed, detail=detail), name=figures.name)


def _refuse(species: Species, config: GrowConfig, vertices: str) -> NoReturn:
    fail(
        species.name,
        f"would have {vertices} at detail {config.detail:g} and leaves {config.leaves:g}; the limit is {config.max_vertices:,}",
        "lower detail (fewer rings and corners on stems) or leaves (fewer, larger leaves), or raise max_vertices",
    )
