"""``bbfit forest``: from a register or an area to the files that show the forest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bbfit.checks import check_record, fail
from bbfit.files import read_json, write_json, write_pieces
from bbfit.forest.config import ForestConfig, Format, RegisterConfig, ScatterConfig
from bbfit.forest.gathering import SpeciesUse, check_placements, gathered
from bbfit.forest.georeference import Origin
from bbfit.forest.instances import InstancedGltf, Instances
from bbfit.forest.placements import Placements
from bbfit.forest.prototypes import read_prototype
from bbfit.forest.tiles import FOREST_FILE, TILES, ForestTile, leaves, read_tile, write_tiles
from bbfit.forest.tileset import JOURNAL, SCHEMA, SHARED, TILESET, write_tileset
from bbfit.forest.usd_stage import STAGE, TEXTURES, TREES, USD_JOURNAL, USD_TILES, check_usd, check_usd_textures, write_usd
from bbfit.forest.web_page import PAGE_FILES, PageConfig, check_page_textures, page_loads, write_page
from bbfit.inputs import InputLimits, reading
from bbfit.library.manifest import LIBRARY_FILE, Library, read_library
from bbfit.model_files import generator
from bbfit.outputs import claimed_folder, output_folder
from bbfit.provenance import digest_files
from bbfit.stages.stage import OnProgress, Record, Stage, silent

GLB_FILE = "forest.glb"
"""The names of the description of a forest and of its GLB."""
_VERSION = 1
_HINT = "start bbfit forest again"


@dataclass(frozen=True)
class Forest:
    """A forest in a folder."""

    folder: Path
    """The folder: ``forest.json``, the placements, and a file or a folder for each format."""
    root: ForestTile
    """The root of the quadtree of placements."""
    origin: Origin
    """Where the origin of the local frame is."""
    species: tuple[SpeciesUse, ...]
    """The species of the register with the trees that stand for them. ``Placements.species`` are indices into it."""
    skipped: int
    """Number of rows of the register that were left out, because they have no usable coordinates."""

    def __len__(self) -> int:
        return self.root.count

    def read(self, name: str) -> Placements:
        """The placements of a tile by its name (:func:`~bbfit.forest.tiles.read_tile`)."""
        return read_tile(self.folder, name)


def build_forest(
    placements: str | Path | ScatterConfig,
    library: str | Path,
    out: str | Path,
    config: ForestConfig | None = None,
    *,
    register: RegisterConfig | None = None,
    limits: InputLimits | None = None,
    on_progress: OnProgress | None = None,
) -> Forest:
    """Place the trees of a library as a register says, or at random, and write the files that show them.

    The trees are sorted into a quadtree, and each output is written tile by tile, so that memory holds one tile and about a hundred bytes
    for each tree. An interrupted build continues where it stopped; outputs with the same inputs are skipped.

    Parameters
    ----------
    placements
        A register: a table (.csv, .tsv, .txt) or GeoJSON (.geojson, .json) with a tree in each row. Or where trees are scattered.
    library
        A folder of :func:`~bbfit.build_library`.
    out
        The folder for the forest.
    config
        What is written, and how trees are chosen.
    register
        How the register is read.
    limits
        What the inputs may be.
    on_progress
        Called with the progress of each step.

    Raises
    ------
    MissingFileError, InputError, OSError
        If the register cannot be used (the message has the row and the column), the library is damaged, or a file cannot be written.
    """
    config, limits, on_progress = config or ForestConfig(), limits or InputLimits(), on_progress or silent
    scatter = placements if isinstance(placements, ScatterConfig) else ScatterConfig()
    source = None if isinstance(placements, ScatterConfig) else Path(placements)
    register = register or RegisterConfig()
    check_placements(source, config, register, scatter)
    if "usd" in config.formats:
        check_usd()
    trees = read_library(library, limits)
    _check_trees(trees, limits, config.formats)
    inputs = [path for path in (source, scatter.scatter_area, config.species_table) if path is not None]
    for path in inputs:
        limits.at_most("max_input_bytes", "placements", path, path.stat().st_size, "bytes")
    with claimed_folder("out", out) as folder:
        record = Record(folder, inputs=[*inputs, trees.folder / LIBRARY_FILE])
        stages = _Stages(record, trees, config, limits)
        record.check({name: outputs for name, outputs in _OUTPUTS.items() if name == "placements" or name in config.formats})
        planted = stages.placements(source, register, scatter)
        record.run(planted, on_progress)
        forest = read_forest(folder)
        for name in config.formats:
            record.run(stages.format(name, forest, planted.key), on_progress)
    return forest


def read_forest(folder: str | Path) -> Forest:
    """The forest in a folder. Raises MissingFileError or InputError if it has no usable ``forest.json``."""
    path = Path(folder) / FOREST_FILE
    stored = read_json("forest", path)
    with reading("forest", path, _HINT):
        if stored["version"] != _VERSION:
            fail("forest", f"{path} has version {stored['version']}, expected {_VERSION}", _HINT)
        species = tuple(SpeciesUse(**{**entry, "trees": tuple(entry["trees"])}) for entry in stored["species"])
        forest = Forest(Path(folder), _tile(stored["root"]), Origin(**stored["origin"]), species, stored["skipped"])
        check_record("forest", forest, Forest)
    return forest


_OUTPUTS: dict[str, tuple[str, ...]] = {
    "placements": (FOREST_FILE, f"{TILES}/*.npy"),
    "glb": (GLB_FILE,),
    "page": PAGE_FILES,
    "usd": (f"usd/{STAGE}", *(f"usd/{part}/*" for part in (TREES, TEXTURES, USD_TILES))),
    "tiles": (f"tiles/{TILESET}", f"tiles/{SCHEMA}", "tiles/*.glb", f"tiles/{SHARED}/*"),
}


# The options that the placements depend on.
_PLACING = ("species_table", "origin", "origin_meters", "sizes", "tile_trees", "seed")


class _Stages:
    """The stages of a forest."""

    def __init__(self, record: Record, library: Library, config: ForestConfig, limits: InputLimits) -> None:
        self._folder, self._library, self._config, self._limits = record.folder, library, config, limits
        files = [library.folder / LIBRARY_FILE, *(library.folder / name for name in library.atlas)]
        levels = [library.folder / level.file for tree in library.trees for level in tree.levels]
        self._digest = digest_files([*files, *levels], library.folder)

    def placements(self, source: Path | None, register: RegisterConfig, scatter: ScatterConfig) -> Stage:
        """Read or scatter the trees, and sort them."""
        folder, library, config = self._folder, self._library, self._config
        relevant = {name: getattr(config, name) for name in _PLACING}

        def work(on_progress: OnProgress) -> None:
            with gathered(source, library, folder, config, (register, scatter), on_progress) as trees:
                root = write_tiles(trees, folder, library, config.tile_trees, on_progress)
                document = {
                    "version": _VERSION,
                    "generator": generator(),
                    "library": {"trees": [tree.name for tree in library.trees]},
                    "origin": asdict(trees.origin),
                    "skipped": trees.skipped,
                    "species": [asdict(species) for species in trees.species],
                    "root": asdict(root),
                }
                write_json(folder / FOREST_FILE, document)

        return Stage("placements", (source, register, scatter, relevant, self._digest), _OUTPUTS["placements"], work, algorithm="forest")

    def format(self, name: Format, forest: Forest, key: str) -> Stage:
        """Write a format of a forest whose placements have a ``key``."""
        make: dict[Format, Callable[[Forest, str, OnProgress], None]] = {
            "glb": self._write_glb,
            "tiles": self._write_tiles,
            "page": self._write_page,
            "usd": self._write_usd,
        }
        config = self._config
        relevant = {"glb": (config.level,), "tiles": (config.tile_triangles, config.far_pixels), "page": (config.title,)}.get(name, ())
        temporary = {"tiles": (f"tiles/{JOURNAL}",), "usd": (f"usd/{USD_JOURNAL}",)}.get(name, ())

        def work(on_progress: OnProgress) -> None:
            make[name](forest, stage.key, on_progress)

        stage = Stage(name, (key, name, relevant), _OUTPUTS[name], work, algorithm="forest", temporary=temporary)
        return stage

    def _write_glb(self, forest: Forest, key: str, on_progress: OnProgress) -> None:
        """Write all trees at one level of detail to one GLB, which contains everything."""
        low, high = np.array(forest.root.low), np.array(forest.root.high)
        center = np.round((low + high) / 2 * [1, 0, 1])
        matrix = np.eye(4)
        matrix[:3, 3] = center
        gltf = InstancedGltf(matrix)
        tiles, done = list(leaves(forest.root)), 0
        parts = list[Placements]()
        for tile in tiles:
            parts.append(forest.read(tile.name))
            done += tile.count
            on_progress("glb", done, 2 * forest.root.count)
        for number, tree in enumerate(self._library.trees):
            mine = [part.subset(part.trees == number) for part in parts]
            chosen = [part for part in mine if len(part)]
            if chosen:
                level = min(self._config.level, len(tree.levels) - 1)
                positions = np.concatenate([part.positions for part in chosen]) - center
                scales = np.concatenate([part.scales for part in chosen])[:, None].repeat(3, 1).astype(float)
                instances = Instances(positions, np.concatenate([part.turns for part in chosen]), scales)
                gltf.add(read_prototype(self._library, number, level, self._limits), instances)
                done += len(positions)
                on_progress("glb", done, 2 * forest.root.count)
        write_pieces(self._folder / GLB_FILE, gltf.pieces())

    def _write_tiles(self, forest: Forest, key: str, on_progress: OnProgress) -> None:
        out = output_folder("out", self._folder / "tiles")
        names = [species.name for species in forest.species]
        write_tileset(out, (self._folder, forest.root, forest.origin, names), self._library, self._config, self._limits, key, on_progress)

    def _write_usd(self, forest: Forest, key: str, on_progress: OnProgress) -> None:
        out = output_folder("out", self._folder / "usd")
        write_usd(out, (self._folder, forest.root), self._library, self._limits, key, on_progress)

    def _write_page(self, forest: Forest, key: str, on_progress: OnProgress) -> None:
        done = 0

        def read(name: str) -> Placements:
            nonlocal done
            placements = forest.read(name)
            on_progress("page", done, forest.root.count)
            done += len(placements)
            return placements

        write_page(self._folder, self._library, forest.root, read, PageConfig(self._config.title), self._limits)


def _check_trees(library: Library, limits: InputLimits, formats: Sequence[Format]) -> None:
    """Require that every tree can be used, and shown by each format, before any work."""
    for number, tree in enumerate(library.trees):
        if not tree.levels or tree.height <= 0 or not all(low < high for low, high in zip(tree.low, tree.high, strict=True)):
            fail("library", f"{library.folder}: the tree {tree.name} has no levels or no size", "build the library again")
        for level in range(len(tree.levels)):
            prototype = read_prototype(library, number, level, limits)
            if "usd" in formats:
                check_usd_textures(prototype.document, tree.name)
            if "page" in formats and page_loads(tree, level, (library.folder / tree.levels[level].file).stat().st_size):
                check_page_textures(prototype.document, tree.name)


def _tile(stored: dict[str, Any]) -> ForestTile:
    children = tuple(_tile(child) for child in stored["children"])
    (x, y, z), (right, top, front) = stored["low"], stored["high"]
    return ForestTile(stored["name"], (float(x), float(y), float(z)), (float(right), float(top), float(front)), stored["count"], children)
