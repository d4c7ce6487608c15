"""grow(): the same bytes for the same arguments, what each argument changes, and refusals that come before the memory is taken."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import tracemalloc
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bbfit.checks import InputError, InputTypeError
from bbfit.trees.config import GrowConfig
from bbfit.trees.growth import grow
from bbfit.trees.leaf_shapes import leaf_shape
from bbfit.trees.mesh import count_vertices
from bbfit.trees.species import Species, known_species, load_species
from bbfit.trees.tree_writer import write_tree
from bbfit.trees.weber_penn import grow_skeleton

CHEAP = {"detail": 0.1, "leaves": 0.02}

ELSEWHERE = """
import sys
from bbfit.trees.growth import grow
from bbfit.trees.tree_writer import write_tree
for name in sys.argv[2:]:
    write_tree(grow(name, seed=4, detail=0.1, leaves=0.02), f"{sys.argv[1]}/{name}.glb")
"""


def vertices_of(scene: Any) -> int:
    return sum(len(mesh.vertices) for mesh in scene.geometry.values())


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def small() -> Species:
    """A tree of a few hundred leaves."""
    return replace(load_species("quaking_aspen"), branches=(1, 10, 4, 0), leaves=8)


def test_the_same_seed_gives_the_same_bytes_in_any_process_and_another_seed_others(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    others = [name for name in known_species() if name != "weeping_willow"]
    environment = {**os.environ, "PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", ELSEWHERE, str(tmp_path / "elsewhere"), *others], check=True, env=environment)
    for name in others:
        write_tree(grow(name, seed=4, **CHEAP), tmp_path / "here.glb")
        assert digest(tmp_path / "here.glb") == digest(tmp_path / "elsewhere" / f"{name}.glb"), name
    seen = set()
    for seed in range(6):
        write_tree(grow("acer", seed=seed, **CHEAP), tmp_path / "here.glb")
        seen.add(digest(tmp_path / "here.glb"))
    assert len(seen) == 6


def test_a_name_and_its_figures_grow_the_same_tree() -> None:
    first, second = grow("acer", seed=1, **CHEAP), grow(load_species("acer"), seed=1, **CHEAP)
    assert first.geometry.keys() == second.geometry.keys() and first.metadata["name"] == "acer"
    assert all(np.array_equal(first.geometry[name].vertices, second.geometry[name].vertices) for name in first.geometry)


def test_seed_zero_is_the_default_and_the_tree_stands_at_the_origin() -> None:
    tree, again = grow(small()), grow(small(), seed=0, detail=1.0, leaves=1.0)
    assert np.array_equal(tree.geometry["bark"].vertices, again.geometry["bark"].vertices)
    low, high = tree.bounds
    assert low[1] == 0 and high[1] > 9 and (low[[0, 2]] < 0).all() and (high[[0, 2]] > 0).all()


def test_detail_changes_neither_stems_nor_leaves() -> None:
    scenes = [grow(small(), seed=2, detail=detail) for detail in (0.1, 0.5, 2.0)]
    for name in ("leaf_0", "leaf_1", "leaf_2"):
        coarse, _, fine = (scene.geometry[name] for scene in scenes)
        assert np.array_equal(coarse.faces, fine.faces) and np.array_equal(coarse.visual.uv, fine.visual.uv)
        assert np.array_equal(coarse.vertex_normals, fine.vertex_normals)
        # Leaves stand on the stem as it is drawn, which with few rings cuts its bends short; measured 0.27 m of a tree of 13 m.
        assert 0 < np.abs(coarse.vertices - fine.vertices).max() < 0.4
    barks = [scene.geometry["bark"] for scene in scenes]
    assert len({bark.body_count for bark in barks}) == 1
    assert len(barks[0].vertices) < len(barks[1].vertices) < len(barks[2].vertices)


def test_leaves_change_no_stem_s_number_and_none_leaves_the_bark_alone() -> None:
    whole, few, bare = (grow(small(), seed=2, leaves=share, detail=0.1) for share in (1.0, 0.1, 0.0))
    assert list(bare.geometry) == ["bark"] and bare.is_valid
    assert len({len(scene.geometry["bark"].vertices) for scene in (whole, few, bare)}) == 1
    area = [sum(mesh.area for name, mesh in scene.geometry.items() if name != "bark") for scene in (whole, few)]
    leaf = few.geometry["leaf_0"]
    one = leaf.area * len(leaf_shape(small().leaf_shape).faces) / len(leaf.faces)
    assert abs(area[1] - area[0]) <= 0.501 * one  # by which a tenth of the leaves is no whole number


@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_any_number_of_levels_grows(levels: int) -> None:
    species = replace(load_species("weeping_willow"), levels=levels, branches=(1, 5, 4, 3), leaves=3)
    assert set(grow(species, detail=0.3).geometry) <= {"bark", "leaf_0", "leaf_1", "leaf_2"}


# Limits ---------------------------------------------------------------------------------------------------------------------------------


def test_a_limit_of_just_the_vertices_is_kept_and_one_less_refused_with_their_number() -> None:
    species = small()
    vertices = vertices_of(grow(species, seed=3))
    assert count_vertices(grow_skeleton(species, 3, lambda level, number: None), 1.0) == vertices
    assert vertices_of(grow(species, seed=3, max_vertices=vertices)) == vertices
    with pytest.raises(
        InputError, match=rf"^quaking_aspen: would have {vertices:,} vertices, .* the limit is {vertices - 1:,}; lower detail"
    ):
        grow(species, seed=3, max_vertices=vertices - 1)


def test_a_limit_too_low_is_told_how_many_there_would_be() -> None:
    species = small()
    vertices = vertices_of(grow(species, seed=3))
    for limit in (1, vertices // 100, vertices // 10, vertices // 2):
        with pytest.raises(InputError, match=r"at detail 1 and leaves 1; .* leaves .* or raise max_vertices") as caught:
            grow(species, seed=3, max_vertices=limit)
        found = re.search(r"would have (about )?([\d,]+)", str(caught.value))
        assert found
        said = int(found[2].replace(",", ""))
        assert limit < said < 2 * vertices if found[1] else said == vertices


HUGE: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "branches": ({"branches": (1, 10_000, 10_000, 10_000), "levels": 4, "length": (1, 0.3, 0.6, 0.5), "curve_res": (5, 5, 5, 5)}, {}),
    "segments": ({"branches": (1, 200, 100, 0), "curve_res": (100, 100, 100, 0)}, {}),
    "splits": ({"seg_splits": (10, 10, 10, 10), "curve_res": (100, 100, 20, 0)}, {}),
    "leaves": ({"leaves": 10_000, "branches": (1, 50, 20, 0)}, {}),
    "leaves_of_which_few_are_kept": ({"leaves": 10_000, "branches": (1, 50, 20, 0)}, {"leaves": 1e-3, "detail": 0.1}),
    "leaves_of_which_none_is_kept": ({"leaves": 10_000, "branches": (1, 50, 20, 0)}, {"leaves": 0.0, "detail": 0.1}),
    "detail": ({}, {"detail": 10.0}),
}


@pytest.mark.parametrize("request_name", HUGE)
def test_huge_requests_take_no_memory(request_name: str) -> None:
    figures, arguments = HUGE[request_name]
    species = replace(load_species("quaking_aspen"), **figures)
    grow(small(), max_vertices=100_000)  # what is loaded once
    tracemalloc.start()
    with suppress(InputError):
        grow(species, max_vertices=100_000, **arguments)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6, f"{peak / 1e6:.0f} MB for a limit of 100,000 vertices"  # a tree of that size takes 15 MB


@pytest.mark.parametrize("request_name", ["branches", "segments", "splits", "leaves", "detail"])
def test_huge_requests_are_refused(request_name: str) -> None:
    figures, arguments = HUGE[request_name]
    with pytest.raises(InputError, match=r"quaking_aspen: would have .*; the limit is 100,000; "):
        grow(replace(load_species("quaking_aspen"), **figures), max_vertices=100_000, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed: expected at least 0, got -1"),
        ({"seed": 1.5}, "seed: expected a whole number, got 1.5"),
        ({"detail": 0}, r"detail: expected a value in \[0.1, 10\], got 0"),
        ({"detail": 11.0}, r"detail: expected a value in \[0.1, 10\], got 11.0"),
        ({"detail": float("nan")}, r"detail: expected a value in \[0.1, 10\], got nan"),
        ({"detail": "fine"}, "detail: expected a number, got 'fine'"),
        ({"leaves": -0.1}, r"leaves: expected a value in \[0, 1\], got -0.1"),
        ({"leaves": 1.1}, r"leaves: expected a value in \[0, 1\], got 1.1"),
        ({"max_vertices": 0}, "max_vertices: expected at least 1, got 0"),
        ({"max_vertices": 1e6}, "max_vertices: expected a whole number, got 1000000.0"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    for call in (lambda: GrowConfig(**arguments), lambda: grow("acer", **arguments)):
        with pytest.raises(InputError, match=f"^{message}$"):
            call()


def test_unknown_species_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"quaking_aspen, weeping_willow, acer, .*did you mean acer"):
        grow("acre")


@pytest.mark.parametrize("species", [None, 3, Path("acer")])
def test_what_is_no_species_is_refused(species: Any) -> None:
    with pytest.raises(InputTypeError, match="species"):
        grow(species)
