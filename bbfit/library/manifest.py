"""``library.json``, which lists the trees of a library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
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
class LevelScore:
    """How a level looks in held-out views, at the size on the screen at which it takes over."""

    tree_pixels: float
    """Height of the tree in those pictures in pixels, at most that in the views."""
    psnr: float
    """PSNR in dB, the mean over four backgrounds."""
    color_error: float
    """Perceived difference (:func:`bbfit.evaluation.color_error.color_error`), in [0, 1]."""
    texels: int
    """Texels of the atlas that it takes up, with the padding of its textures."""


@dataclass(frozen=True)
class AtlasPage:
    """One picture of the atlas."""

    files: tuple[str, ...]
    """Its files, relative to the library's folder."""
    width: int
    """Texels."""
    height: int
    """Texels."""
    used: float
    """Share that textures cover, without their padding."""
    safe_mip_level: int
    """The highest mip level that mixes no two textures."""
    bytes: int
    """Size of its files."""


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
    """The lowest corner of its bounds in meters, Y up. Its trunk stands on the ground at the origin, if its file has it there."""
    high: tuple[float, float, float]
    """The highest corner of its bounds in meters."""
    levels: tuple[LodLevel, ...]
    """Its levels of detail, finest first. ``file`` is relative to the library's folder. The GLBs refer to the library's atlas.
    ``psnr`` and ``bytes`` are those of these files."""
    scores: tuple[LevelScore | None, ...] = ()
    """The score of each level from afar; ``None`` for the tree itself."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each stage."""

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
    """The screen that the distances of levels hold for."""
    atlas: tuple[str, ...]
    """The files that all GLBs share, relative to the folder: pictures of the atlas as PNG and KTX2."""
    trees: tuple[LibraryTree, ...]
    """Its trees."""
    pages: tuple[AtlasPage, ...] = ()
    """The pictures of the atlas: more than one only if one would be too large."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """Trees that are not in the library although they were asked for, by name, with the reason."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the work after the trees: packing and encoding the atlas, the contact sheet."""

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
    outside the folder, or a picture of the atlas has another size.
    """
    folder, limits = check_folder("library", folder), limits or InputLimits()
    path = folder / LIBRARY_FILE
    stored = read_json("library", path)
    with reading("library", path, _HINT):
        if stored["version"] != LIBRARY_VERSION:
            fail("library", f"{path} has version {stored['version']}, expected {LIBRARY_VERSION}", _HINT)
        trees = tuple(_tree(entry) for entry in stored["trees"])
        pages = tuple(AtlasPage(**{**page, "files": tuple(page["files"])}) for page in stored.get("pages", ()))
        more = {name: stored[name] for name in ("failures", "seconds") if name in stored}
        library = Library(folder, Screen(**stored["screen"]), tuple(stored["atlas"]), trees, pages, **more)
        check_record("library", library, Library)
    names = [tree.name for tree in trees]
    if not names or len(set(names)) < len(names):
        fail("library", f"{path} lists {'no tree' if not names else 'two trees with one name'}", _HINT)
    pictures = [*library.atlas, *(file for page in pages for file in page.files)]
    for file in [*pictures, *(level.file for tree in trees for level in tree.levels)]:
        place = limits.referenced("library", path, file, folder)
        if not place.is_file() or not place.stat().st_size:
            fail("library", f"{place}, which {path} lists, is missing or empty", _HINT)
    for page in pages:
        if sum((folder / file).stat().st_size for file in page.files) != page.bytes:
            fail("library", f"{' and '.join(page.files) or 'a picture'} of {folder} has not the size that {path.name} lists", _HINT)
    return library


def _tree(entry: dict[str, Any]) -> LibraryTree:
    levels = tuple(LodLevel(**level) for level in entry["levels"])
    scores = tuple(None if score is None else LevelScore(**score) for score in entry.get("scores", ()))
    corners = {name: tuple(map(float, entry[name])) for name in ("low", "high")}
    return LibraryTree(**{**entry, **corners, "levels": levels, "scores": scores})
