"""``library.json``, which lists the trees of a library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bbfit.checks import check_folder, check_record, fail
from bbfit.exporting.lod import LodLevel
from bbfit.files import read_json
from bbfit.inputs import InputLimits, reading
from bbfit.model_files import generator

LIBRARY_FILE = "library.json"
"""The name of the manifest in the folder of a library."""
LIBRARY_VERSION = 1
"""The version of its schema. It rises when a field changes its meaning or goes; new fields may come without."""
_HINT = "build the library again"


@dataclass(frozen=True)
class Screen:
    """The screen for which the distances of levels are computed."""

    height: int
    """Height in pixels."""
    fov_degrees: float
    """Vertical field of view in degrees."""


@dataclass(frozen=True)
class LibraryTree:
    """A tree of a library."""

    name: str
    """Its name, unique in the library."""
    species: str | None
    """Its species; ``None`` if it is not known."""
    seed: int | None
    """The seed that it was grown with; ``None`` for a tree from a file."""
    low: tuple[float, float, float]
    """The lowest corner of its bounds in meters, Y up. Its trunk stands on the ground at the origin."""
    high: tuple[float, float, float]
    """The highest corner of its bounds in meters."""
    levels: tuple[LodLevel, ...]
    """Its levels of detail, finest first. ``file`` is relative to the library's folder. The GLBs refer to the library's atlas."""

    @property
    def height(self) -> float:
        """Its height above the ground, in meters."""
        return self.high[1]


@dataclass(frozen=True)
class Library:
    """A library of trees in a folder."""

    folder: Path
    """The folder."""
    screen: Screen
    atlas: tuple[str, ...]
    """The files that all GLBs share, relative to the folder: pictures of the atlas as PNG and KTX2."""
    trees: tuple[LibraryTree, ...]
    """Its trees."""

    def document(self) -> dict[str, Any]:
        """What ``library.json`` contains."""
        content = {key: value for key, value in asdict(self).items() if key != "folder"}
        return {"version": LIBRARY_VERSION, "generator": generator(), **content}

    def tree(self, name: str) -> LibraryTree:
        """The tree with a name. Raises InputError if there is none."""
        for tree in self.trees:
            if tree.name == name:
                return tree
        fail("library", f"{self.folder} has no tree {name}", f"it has {', '.join(tree.name for tree in self.trees)}")


def read_library(folder: str | Path, limits: InputLimits | None = None) -> Library:
    """The library in a folder.

    Raises MissingFileError or InputError if the folder has no usable ``library.json``, or if a file that it names is missing, empty or lies
    outside the folder.
    """
    folder, limits = check_folder("library", folder), limits or InputLimits()
    path = folder / LIBRARY_FILE
    stored = read_json("library", path)
    with reading("library", path, _HINT):
        if stored["version"] != LIBRARY_VERSION:
            fail("library", f"{path} has version {stored['version']}, expected {LIBRARY_VERSION}", _HINT)
        trees = tuple(_tree(entry) for entry in stored["trees"])
        library = Library(folder, Screen(**stored["screen"]), tuple(stored["atlas"]), trees)
        check_record("library", library, Library)
    names = [tree.name for tree in trees]
    if not names or len(set(names)) < len(names):
        fail("library", f"{path} lists {'no tree' if not names else 'two trees with one name'}", _HINT)
    for file in [*library.atlas, *(level.file for tree in trees for level in tree.levels)]:
        place = limits.referenced("library", path, file, folder)
        if not place.is_file() or not place.stat().st_size:
            fail("library", f"{place}, which {path} lists, is missing or empty", _HINT)
    return library


def _tree(entry: dict[str, Any]) -> LibraryTree:
    levels: Sequence[LodLevel] = [LodLevel(**level) for level in entry["levels"]]
    corners = {name: tuple(map(float, entry[name])) for name in ("low", "high")}
    return LibraryTree(**{**entry, **corners, "levels": tuple(levels)})
