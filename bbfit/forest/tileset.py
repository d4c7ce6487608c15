"""3D Tiles 1.1 of a forest: a GLB with instances for each tile, which share the files of the trees, and ``tileset.json``.

https://docs.ogc.org/cs/22-025r4/22-025r4.html

The tiles are the quadtree of the placements. A tile with more trees than a leaf shows a part of them at their coarsest level, wider, so
that they cover as much ground. A leaf shows all at their coarsest level. Below it, each finer level of detail replaces the coarser one, in
smaller tiles if its triangles are many.

A program refines a tile where its geometric error, seen from the nearest point of its box, covers more than 16 pixels (the default of
CesiumJS). So the error of a level is 16 times what a pixel of the library's screen shows at the distance where the next finer level takes
over. The library has measured these distances from the levels' errors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.files import write_bytes, write_json, write_pieces
from bbfit.forest.config import ForestConfig
from bbfit.forest.georeference import TO_TILES, Origin, earth_matrix, on_globe
from bbfit.forest.instances import InstancedGltf, Instances
from bbfit.forest.journal import Journal
from bbfit.forest.placements import Placements
from bbfit.forest.prototypes import Prototype, read_prototype
from bbfit.forest.tiles import ForestTile, read_tile
from bbfit.geometry.camera import focal_pixels
from bbfit.inputs import InputLimits
from bbfit.library.manifest import Library
from bbfit.model_files import generator, relative_uri
from bbfit.outputs import output_folder, remove_results
from bbfit.stages.stage import OnProgress

TILESET = "tileset.json"
SCHEMA, SHARED, JOURNAL = "schema.json", "trees", "journal.jsonl"
# Cesium3DTileset.maximumScreenSpaceError
_PIXELS = 16
_Tile = dict[str, Any]


def write_tileset(
    out: Path,
    forest: tuple[Path, ForestTile, Origin, Sequence[str]],
    library: Library,
    config: ForestConfig,
    limits: InputLimits,
    key: str,
    on_progress: OnProgress,
) -> None:
    """Write the tileset of a ``forest`` (its folder, its root tile, its origin, and its names of species) to the folder ``out``.

    ``key`` identifies all inputs. Tiles that an interrupted call with the same key has written are kept.
    """
    folder, root, origin, species = forest
    output_folder("out", out / SHARED)
    with Journal(out / JOURNAL, key) as journal:
        if not journal.known:
            (out / TILESET).unlink(missing_ok=True)  # until all tiles are there, the folder is no tileset
            remove_results(out, "*.glb", f"{SHARED}/*")
        writer = _Writer(out, folder, origin, _names(species, library), library, config, limits, journal)
        writer.write_shared()
        total, done = _size(root), 0

        def report() -> None:
            nonlocal done
            done += 1
            on_progress("tiles", done, total)

        tile = writer.tile(root, report)
    low, high = _corners(tile)
    error = max(tile["geometricError"], _PIXELS * float(np.linalg.norm(high - low)))  # where the forest is a pixel
    if origin.on_earth:
        tile["transform"] = earth_matrix(origin).T.ravel().tolist()
    asset = {"version": "1.1", "generator": generator()}
    write_bytes(out / TILESET, json.dumps({"asset": asset, "geometricError": error, "root": tile}, separators=(",", ":")).encode())


@dataclass(frozen=True)
class _Frame:
    """Trees of a tile on the globe: where they are in the frame of the tileset (east, north, up)."""

    places: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    matrix: NDArray[np.float64]  # of the tile in glTF's axes
    positions: NDArray[np.float64]  # in the tile, in glTF's axes


class _Writer:
    """Writes the contents of tiles."""

    def __init__(
        self,
        out: Path,
        folder: Path,
        origin: Origin,
        names: tuple[dict[str, int], NDArray[np.int64], NDArray[np.int64]],
        library: Library,
        config: ForestConfig,
        limits: InputLimits,
        journal: Journal,
    ) -> None:
        self._out, self._folder, self._origin, self._library, self._config, self._journal = out, folder, origin, library, config, journal
        self._limits = limits
        self._names, self._of_species, self._of_tree = names
        self._prototypes = dict[tuple[int, int], Prototype]()
        self._uris = dict[Path | str, str]()
        trees, screen = library.trees, library.screen
        corners = np.array([[tree.low, tree.high] for tree in trees])
        self._heights, self._depths = corners[:, 1, 1], np.minimum(corners[:, 0, 1], 0.0)
        self._radii = np.hypot(np.abs(corners[:, :, 0]).max(1), np.abs(corners[:, :, 2]).max(1))
        pixel = 1 / focal_pixels(screen.height, screen.fov_degrees)  # in meters at a distance of a meter
        self._counts = np.array([len(tree.levels) for tree in trees])
        steps = int(self._counts.max())
        # For each step from the coarsest level on: the level of each tree, its triangles and its error.
        self._levels = np.maximum(self._counts - 1 - np.arange(steps)[:, None], 0)
        chosen = [[tree.levels[level] for tree, level in zip(trees, levels, strict=True)] for levels in self._levels]
        self._triangles = np.array([[level.triangles for level in step] for step in chosen])
        distances = np.array([[level.distance_meters for level in step] for step in chosen]) * (self._levels > 0)
        self._errors = np.maximum.accumulate((_PIXELS * pixel * distances)[::-1])[::-1]

    def write_shared(self) -> None:
        """Write the files that tiles share: the geometry and the pictures of the trees, and the schema of their properties."""
        for tree, described in enumerate(self._library.trees):
            for level in range(len(described.levels)):
                prototype = read_prototype(self._library, tree, level, self._limits)
                binary = f"{SHARED}/{prototype.name}.bin"
                self._uris[prototype.name] = relative_uri(binary)
                write_bytes(self._out / binary, prototype.binary)
                for image in filter(None, prototype.images):
                    if image not in self._uris:
                        same = [known for key, known in self._uris.items() if isinstance(key, Path) and key.samefile(image)]
                        picture = f"{SHARED}/{len(self._uris)}_{image.name}"
                        self._uris[image] = same[0] if same else relative_uri(picture)
                        if not same:
                            write_bytes(self._out / picture, image.read_bytes())
                self._prototypes[tree, level] = replace(prototype, binary=b"")
        names = [{"name": name, "value": value} for name, value in self._names.items()]
        properties = {
            "height": {"type": "SCALAR", "componentType": "FLOAT32", "description": "Height of the tree in meters"},
            "row": {"type": "SCALAR", "componentType": "UINT32", "description": "Row of the tree in the register"},
            "species": {"type": "ENUM", "enumType": "species", "description": "Species of the tree"},
        }
        enum = {"valueType": self._enum_type, "values": names}
        schema = {"id": "forest", "classes": {"tree": {"properties": properties}}, "enums": {"species": enum}}
        write_json(self._out / SCHEMA, schema)

    @property
    def _enum_type(self) -> str:
        return "UINT16" if len(self._names) <= 1 << 16 else "UINT32"

    def tile(self, forest_tile: ForestTile, report: Any) -> _Tile:
        """The tile of a square with everything below it, after its contents were written."""
        children = [self.tile(child, report) for child in forest_tile.children]
        tile = self._journal.known.get(forest_tile.name)
        if tile is None or not all((self._out / uri).is_file() for uri in _uris(tile)):
            placements = read_tile(self._folder, forest_tile.name)
            name = forest_tile.name.replace("/", "-")
            tile = self._part(name, placements, forest_tile) if children else self._leaf(name, placements)
            self._journal.add(forest_tile.name, tile)
        report()
        if children:
            corners = [_corners(each) for each in (tile, *children)]
            low, high = np.min([low for low, _ in corners], 0), np.max([high for _, high in corners], 0)
            error = max([tile["geometricError"], *(child["geometricError"] for child in children)])
            tile = tile | {"boundingVolume": _box(low, high), "geometricError": error, "children": children}
        return tile

    def _part(self, name: str, placements: Placements, forest_tile: ForestTile) -> _Tile:
        """The tile that shows a part of its trees."""
        wider = math.sqrt(forest_tile.count / len(placements))
        tallest = float((self._heights[placements.trees] * placements.scales).max())
        error = _PIXELS / self._config.far_pixels * tallest * wider
        return self._content(name, placements, 0, wider=wider) | {"geometricError": error}

    def _leaf(self, name: str, placements: Placements, step: int = 0) -> _Tile:
        """The tile that shows all its trees at the level of a step from the coarsest, with tiles of finer levels below it."""
        errors = self._errors[step][placements.trees] * placements.scales
        error = float(errors.max())
        tile = self._content(f"{name}_{step}", placements, step) | {"geometricError": error}
        if error > 0 and step + 1 < len(self._levels):
            cells = list(self._cells(placements, step + 1))
            children = [self._leaf(f"{name}.{number}" if len(cells) > 1 else name, cell, step + 1) for number, cell in enumerate(cells)]
            corners = [_corners(each) for each in (tile, *children)]
            low, high = np.min([low for low, _ in corners], 0), np.max([high for _, high in corners], 0)
            tile |= {"boundingVolume": _box(low, high), "children": children}
        return tile

    def _cells(self, placements: Placements, step: int) -> Iterator[Placements]:
        """Quarters of quarters of the trees, until each has few enough triangles at the level of a step."""
        ground = placements.positions[:, [0, 2]]
        low, high = ground.min(0), ground.max(0)
        if self._triangles[step][placements.trees].sum() <= self._config.tile_triangles or (low == high).all():
            yield placements
            return
        quarters = (ground > (low + high) / 2) @ [1, 2]
        for quarter in np.unique(quarters):
            yield from self._cells(placements.subset(quarters == quarter), step)

    def _content(self, name: str, placements: Placements, step: int, wider: float = 1.0) -> _Tile:
        """Write the GLB of a tile, and return the tile without its error."""
        placements = placements.subset(np.argsort(placements.trees, kind="stable"))
        frame = self._frame(placements, wider)
        gltf = InstancedGltf(frame.matrix)
        numbers = np.arange(len(placements), dtype=np.float32)
        sizes = placements.scales[:, None] * np.array([wider, 1, wider])
        for tree in np.unique(placements.trees):
            chosen = placements.trees == tree
            instances = Instances(frame.positions[chosen], placements.turns[chosen], sizes[chosen], numbers[chosen])
            gltf.add(self._prototypes[tree, self._levels[step][tree]], instances, self._uris)
        self._add_properties(gltf, placements)
        uri = f"{name}.glb"
        write_pieces(self._out / uri, gltf.pieces())
        return {"boundingVolume": _box(frame.low, frame.high), "refine": "REPLACE", "content": {"uri": uri}}

    def _add_properties(self, gltf: InstancedGltf, placements: Placements) -> None:
        """Add the table of the trees' properties."""
        heights = self._heights[placements.trees] * placements.scales
        rows = np.zeros(len(placements), np.int64) if placements.rows is None else placements.rows
        species = self._of_tree[placements.trees]
        if placements.species is not None and len(self._of_species):
            species = np.where(placements.species < 0, species, self._of_species[placements.species])
        kinds = {"height": "<f4", "row": "<u4", "species": "<u2" if self._enum_type == "UINT16" else "<u4"}
        values = {"height": heights, "row": rows, "species": species}
        properties = {name: {"values": gltf.view(values[name].astype(kind).tobytes())} for name, kind in kinds.items()}
        table = {"class": "tree", "count": len(placements), "properties": properties}
        gltf.tree["extensions"] = {"EXT_structural_metadata": {"schemaUri": SCHEMA, "propertyTables": [table]}}
        gltf.use("EXT_structural_metadata")

    def _frame(self, placements: Placements, wider: float) -> _Frame:
        """Where the trees are on the globe, and a frame in their middle whose up is that of the ground there."""
        places, _ = on_globe(self._origin, placements.positions)
        scales = placements.scales.astype(float)
        around = self._radii[placements.trees] * scales * wider
        below, above = self._depths[placements.trees] * scales, self._heights[placements.trees] * scales
        low, high = places - around[:, None], places + around[:, None]
        # Far from the origin, trees lean in the frame of the tileset: by a thousandth at 6 km.
        lean = around * np.linalg.norm(places[:, :2], axis=-1) / 6.3e6
        low[:, 2], high[:, 2] = places[:, 2] + below - lean, places[:, 2] + above + lean
        ground = (placements.positions.min(0) + placements.positions.max(0)) / 2
        center, up = on_globe(self._origin, ground[None])
        east = np.array([1.0, 0, 0]) - up[0, 0] * up[0]
        east /= np.linalg.norm(east)
        axes = np.stack([east, np.cross(up[0], east), up[0]], -1)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = TO_TILES.T @ axes @ TO_TILES, TO_TILES.T @ center[0]
        positions = (places - center) @ axes @ TO_TILES
        return _Frame(places, low.min(0), high.max(0), matrix, positions)


def _names(species: Sequence[str], library: Library) -> tuple[dict[str, int], NDArray[np.int64], NDArray[np.int64]]:
    """The numbers of all names of species, those of the register's species, and those of the library's trees."""
    numbers = dict[str, int]()
    of_species = [numbers.setdefault(name, len(numbers)) for name in species if name]
    of_tree = [numbers.setdefault(tree.species or tree.name, len(numbers)) for tree in library.trees]
    return numbers, np.array(of_species, np.int64), np.array(of_tree, np.int64)


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> Mapping[str, list[float]]:
    half = np.maximum((high - low) / 2, 1e-3)
    return {"box": [*((low + high) / 2).tolist(), half[0], 0.0, 0.0, 0.0, half[1], 0.0, 0.0, 0.0, half[2]]}


def _corners(tile: _Tile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    box = np.array(tile["boundingVolume"]["box"])
    half = box[[3, 7, 11]]
    return box[:3] - half, box[:3] + half


def _uris(tile: _Tile) -> Iterator[str]:
    """The contents of a tile and of those below it."""
    yield tile["content"]["uri"]
    for child in tile.get("children", []):
        yield from _uris(child)


def _size(tile: ForestTile) -> int:
    return 1 + sum(map(_size, tile.children))
