"""The trees of a study."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bbfit.checks import check_count, check_file, check_folder, fail
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.species import load_species


@dataclass(frozen=True)
class Source:
    """A tree of a study."""

    name: str
    """The name of its folder and of its rows."""
    species: str | None = None
    """The species to grow."""
    tree: Path | None = None
    """The file of a tree to render."""
    views: Path | None = None
    """The folder of existing views."""


def sources(
    species: Sequence[str], trees: Sequence[str | Path], views: Sequence[str | Path], species_file: Path | None = None
) -> list[Source]:
    """The trees of a sweep with unique names: that of the species, the file or the folder, with the parent folder's if they coincide.

    ``trees`` are files, ``views`` are folders, and ``species_file`` contains more species. Raises ``MissingFileError`` or ``InputError`` if
    there are no trees, one does not exist, or two have the same name.
    """
    result = [Source(load_species(name, species_file).name, species=name) for name in species]
    on_disk = [(path, Source(_plain(path.stem), tree=check_file("tree", path))) for path in map(Path, trees)]
    for folder in views:
        path = check_folder("views", folder).resolve()
        path = path.parent if path.name == "views" else path  # a run calls its folder of views so
        on_disk.append((path, Source(_plain(path.name), views=Path(folder))))
    names = [source.name for source in result] + [source.name for _, source in on_disk]
    for path, source in on_disk:  # tree libraries often have a folder for each tree, with the same file name in all folders
        result.append(
            source if names.count(source.name) == 1 else replace(source, name=f"{_plain(path.resolve().parent.name)}_{source.name}")
        )
    if not result:
        fail("sweep", "there are no trees", "give species, trees or views")
    for source in result:
        if sum(other.name == source.name for other in result) > 1:
            fail("sweep", f"two trees are called {source.name}", "rename one, or omit one")
    return result


def seeded_sources(
    species: Sequence[str], seeds: Sequence[int], trees: Sequence[str | Path], species_file: Path | None = None
) -> list[tuple[Source, int]]:
    """Each species with every seed, then the files ``trees``, with seed 0. With several seeds a grown tree's name ends with its seed.

    Raises the errors of :func:`sources`, and ``InputError`` if there are no seeds, or a seed is negative or given twice.
    """
    for seed in seeds:
        check_count("seeds", seed, 0)
    if not seeds or len(set(seeds)) < len(seeds):
        fail("seeds", f"expected different ones, got {list(seeds)}")
    found = sources(species, trees, (), species_file)
    grown = [source for source in found if source.species is not None]
    named = [(replace(source, name=f"{source.name}_{seed}") if len(seeds) > 1 else source, seed) for source in grown for seed in seeds]
    made = named + [(source, 0) for source in found if source.species is None]
    if len({source.name for source, _ in made}) < len(made):
        fail("trees", "two trees have the same name", "rename one, or omit one")
    return made


def task_inputs(source: Source, tree: TreeFile | None, species_file: Path | None, hdri: Path | None) -> dict[str, tuple[Path, ...]]:
    """The input files of a task that grows or renders a tree: those of ``tree``, or the file with its species, and the environment."""
    inputs = {"tree": tree.files} if tree else {}
    if source.species is not None and species_file is not None:
        inputs["species_file"] = (species_file,)
    return inputs if hdri is None else inputs | {"hdri": (hdri,)}


def _plain(name: str) -> str:
    """A name in which bytes that are not UTF-8 are written as numbers."""
    return os.fsencode(name).decode(errors="backslashreplace")
