"""The files of a library: its atlas, a GLB for each level, the contact sheet, the times, and the manifest."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bbfit.exporting.config import ResolvedExport
from bbfit.exporting.gltf import glb_bytes, texture_files
from bbfit.exporting.lod import LodLevel, glb_counts
from bbfit.exporting.lod_files import level_file
from bbfit.files import write_bytes, write_json
from bbfit.geometry.cards import Cards
from bbfit.images import over_color, to_bytes
from bbfit.library.config import LibraryConfig
from bbfit.library.manifest import LIBRARY_FILE, AtlasPage, LevelScore, Library, LibraryTree, Screen
from bbfit.library.scores import drawing, scored
from bbfit.library.shared_atlas import SharedPage, cell_texels, safe_level, shared_pages
from bbfit.library.stored_cards import read_cards
from bbfit.library.trees import CARDS, card_file
from bbfit.lod import LEVELS, with_textures
from bbfit.outputs import check_room
from bbfit.pipeline import RunConfig
from bbfit.provenance import VERSIONS, digest_file
from bbfit.reporting.contact_sheet import SheetLevel, SheetTree, contact_sheet
from bbfit.reporting.library_tables import times_markdown
from bbfit.stages.stage import OnProgress, Record, Stage
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet
from bbfit.workers.sources import Source
from bbfit.workers.tasks import Facts

TREES, CONTACT_FILE, TIMES_FILE = "trees", "contact.png", "times.md"
WORK = "work"
"""The folder with the views and fits of each tree, from which a build continues."""
STAGE = "library"
"""The name of the stage that writes these files."""
_PARTS = ("packing", "encoding", "models", "scores", "contact sheet")


@dataclass(frozen=True)
class FinishedTree:
    """A tree whose task is done."""

    source: Source
    """Where it comes from."""
    seed: int
    """The seed that it was grown with, if it was grown."""
    facts: Facts
    """The result of :func:`~bbfit.library.trees.library_tree`."""


@dataclass(frozen=True)
class _Level:
    """A level of a tree on its way to the library."""

    level: LodLevel
    source: Path
    """Its cards, or the GLB of the tree itself."""

    @property
    def file(self) -> str:
        return f"{TREES}/{self.level.file}"

    @property
    def is_cards(self) -> bool:
        return self.level.planes is not None


def library_outputs(names: Sequence[str], config: LibraryConfig) -> tuple[str, ...]:
    """The most files of a library of trees with ``names``, relative to its folder; ``*`` stands for the pictures of the atlas.

    Levels that nowhere draw faster are left out.
    """
    count = config.original + len(config.thinned) + len(config.planes)
    models = [f"{TREES}/{level_file(name, number)}" for name in names for number in range(count)]
    return (*models, f"{TREES}/atlas*", CONTACT_FILE, TIMES_FILE, LIBRARY_FILE)


def library_stage(
    record: Record, trees: Sequence[FinishedTree], failures: Mapping[str, str], config: LibraryConfig, stages: RunConfig
) -> Stage:
    """Pack the textures of all levels into one atlas, and write the files of the library, ``library.json`` last.

    ``record`` is that of the library's folder. ``failures`` are the reasons why further trees are missing. The stage raises ``InputError``
    if the atlas would be too large, or the disk is full; the library of an earlier start is then as it was.
    """
    folder, export = record.folder, with_textures(stages.export).resolve()
    levels = {tree.source.name: _levels(folder, tree) for tree in trees}
    earlier = dict(record.stages[STAGE]["outputs"]) if STAGE in record.stages else {}

    def work(on_progress: OnProgress) -> None:
        spent, started = dict[str, float](), time.perf_counter()

        def passed() -> None:
            spent[_PARTS[len(spent)]] = round(time.perf_counter() - started - sum(spent.values()), 3)
            on_progress("atlas", len(spent), len(_PARTS))

        on_progress("atlas", 0, len(_PARTS))
        every = [level for own in levels.values() for level in own]
        cards = {level.file: read_cards(level.source) for level in every if level.is_cards}
        pages = shared_pages(list(cards.values()), export.padding, config.page_size, own_levels=export.has_mips)
        passed()
        pictures = [texture_files(page.cards[0], export) for page in pages]
        textures = {_place(name, number): data for number, page in enumerate(pictures) for name, data in page.items()}
        passed()
        files, shared = list(cards), dict[str, Cards]()
        models = {level.file: level.source.read_bytes() for level in every if not level.is_cards}
        for number, page in enumerate(pages):
            addresses = {name: Path(_place(name, number)).name for name in pictures[number]}
            names = [files[model] for model in page.models]
            models |= {name: glb_bytes(own, export, files=addresses) for name, own in zip(names, page.cards, strict=True)}
            shared |= dict(zip(names, page.cards, strict=True))
        passed()
        names = [tree.source.name for tree in trees]
        views = {name: ViewDataset.load(folder / WORK / name / "views", limits=stages.limits) for name in names}
        entries = [_entry(tree, views[name], levels[name], models, shared, export) for name, tree in zip(names, trees, strict=True)]
        passed()
        check_room(folder, sum(map(len, (*textures.values(), *models.values()))))
        (folder / LIBRARY_FILE).unlink(missing_ok=True)  # until all files are there, the folder is no library
        (folder / TREES).mkdir(exist_ok=True)
        for file, data in {**textures, **models}.items():
            write_bytes(folder / file, data)
        contact_sheet([_sheet_tree(entry, views[entry.name].test, shared) for entry in entries], folder / CONTACT_FILE)
        passed()
        described = tuple(_page(page, number, pictures[number], export) for number, page in enumerate(pages))
        screen = Screen(config.screen_height, config.screen_fov_degrees)
        library = Library(folder, screen, tuple(textures), tuple(entries), described, dict(failures), spent)
        times = times_markdown({tree.name: tree.seconds for tree in entries}, spent)
        write_bytes(folder / TIMES_FILE, times.encode(errors="backslashreplace"))
        _remove(folder, earlier, {*textures, *models, CONTACT_FILE, TIMES_FILE, LIBRARY_FILE})
        write_json(folder / LIBRARY_FILE, library.document())

    known = [(tree.source.name, tree.source.species, tree.seed, tree.facts) for tree in trees]
    inputs = (known, dict(failures), config.page_size, config.levels, export, VERSIONS["export"])
    written = [level.file for own in levels.values() for level in own]
    return Stage(STAGE, inputs, (*written, f"{TREES}/atlas*", CONTACT_FILE, TIMES_FILE, LIBRARY_FILE), work)


def _levels(folder: Path, tree: FinishedTree) -> list[_Level]:
    place, found = folder / WORK / tree.source.name, list[_Level]()
    for entry in tree.facts["levels"]:
        level = LodLevel(**entry)
        found.append(_Level(level, place / LEVELS / level.file if level.planes is None else place / CARDS / card_file(level)))
    return found


def _place(picture: str, page: int) -> str:
    """The file of a picture of :func:`~bbfit.exporting.gltf.texture_files` of a page, relative to the library's folder."""
    name, _, ending = picture.rpartition(".")
    number, kind = "" if page == 0 else f"_{page + 1}", "" if name == "atlas" else f"_{name}"
    return f"{TREES}/atlas{number}{kind}.{ending}"


def _page(page: SharedPage, number: int, pictures: Mapping[str, bytes], export: ResolvedExport) -> AtlasPage:
    height, width = page.image.shape[:2]
    files, size = tuple(_place(name, number) for name in pictures), sum(map(len, pictures.values()))
    return AtlasPage(files, width, height, round(page.used, 4), safe_level(export.padding), size)


def _entry(
    tree: FinishedTree,
    views: ViewDataset,
    levels: Sequence[_Level],
    models: Mapping[str, bytes],
    shared: Mapping[str, Cards],
    export: ResolvedExport,
) -> LibraryTree:
    """A tree of the manifest, with the counts and the scores of its files."""
    shipped, scores = list[LodLevel](), list[LevelScore | None]()
    for own in levels:
        (vertices, triangles), size = glb_counts(models[own.file]), len(models[own.file])
        near, score = own.level.psnr, None
        if own.is_cards:
            cards = shared[own.file]
            near, score = scored(cards, own.level, views, cell_texels(cards, export.padding))
        shipped.append(replace(own.level, vertices=vertices, triangles=triangles, bytes=size, psnr=near, file=own.file))
        scores.append(score)
    low, high = (tuple(map(float, tree.facts[corner])) for corner in ("low", "high"))
    source, seed = tree.source, None if tree.source.species is None else tree.seed
    return LibraryTree(source.name, source.species, seed, low, high, tuple(shipped), tuple(scores), tree.facts["seconds"])  # type: ignore[arg-type]


def _sheet_tree(tree: LibraryTree, views: ViewSet, cards: Mapping[str, Cards]) -> SheetTree:
    """One of the held-out views of a tree, and its levels as their files show them in that view."""
    index = next(filter(views.shows, range(len(views))), 0)
    shown = list[SheetLevel]()
    for level, score in zip(tree.levels, tree.scores, strict=True):
        if score is None or level.psnr is None:
            continue
        picture = to_bytes(over_color(drawing(cards[level.file], views)(views.cameras[index])))
        far = (
            "from the start" if level.distance_meters == 0 else f"from {level.distance_meters:,.0f} m, {score.tree_pixels:.0f} pixels high"
        )
        costs = f"{level.bytes:,} bytes, {score.texels:,} texels"
        shown.append(
            SheetLevel(f"{level.planes} billboards", (costs, f"PSNR {level.psnr:.1f} dB near, {score.psnr:.1f} dB far", far), picture)
        )
    notes = [f"{tree.height:.1f} m high"] + ([] if tree.species is None else [f"{tree.species}, seed {tree.seed}"])
    return SheetTree(tree.name, tuple(notes), to_bytes(over_color(views.targets([index])[0])), tuple(shown))


def _remove(folder: Path, earlier: Mapping[str, str], kept: set[str]) -> None:
    """Remove files of an earlier library that this one does not have, unless they have changed since."""
    for file, digest in earlier.items():
        place = folder / file
        if file not in kept and place.is_file() and digest_file(place) == digest:
            place.unlink()
