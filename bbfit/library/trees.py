"""One tree of a library: its stages, and the cards of its levels. It is a task, which any process on any machine can run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.model import shipped_model
from bbfit.geometry.cloud import BillboardCloud
from bbfit.library.config import LibraryConfig
from bbfit.library.shared_atlas import safe_level
from bbfit.library.stored_cards import write_cards
from bbfit.lod import LEVELS, LodResult, build_lod, with_textures
from bbfit.outputs import claimed_folder
from bbfit.pipeline import RunConfig
from bbfit.provenance import VERSIONS, digest_file
from bbfit.stages.results import export_config
from bbfit.stages.stage import OnProgress, Record, Stage
from bbfit.stages.trees import grow_stage
from bbfit.trees.species import load_species
from bbfit.views.dataset import ViewDataset
from bbfit.workers.tasks import Facts

CARDS = "cards"
"""The folder with the cards of a tree's levels, in the folder of the tree."""


def library_tree(
    inputs: Mapping[str, Path], folder: Path, name: str, species: str | None, config: LibraryConfig, stages: RunConfig
) -> Facts:
    """Grow a tree, or take the input ``tree``, make its levels of detail, and write the cards of each level to the folder ``cards``.

    The inputs also contain ``species_file`` and ``hdri``, if the options of the stages name such files. Returns as JSON the tree's
    corners, its levels, the digests of the files, and the seconds of each stage. The errors of ``build_lod`` are
    raised.
    """
    tree, records = inputs.get("tree"), [folder]
    if species is not None:
        grow = replace(stages.grow, species_file=inputs.get("species_file"))
        with claimed_folder("out", folder / "grown") as grown:
            Record(grown).run(grow_stage(grown, load_species(species, grow.species_file), grow))
            tree, records = grown / "tree.glb", [grown, *records]
    assert tree is not None
    views = replace(stages.views, hdri=inputs.get("hdri"))
    # The files of single levels have PNG textures, which take the least time; the library's come later.
    plain = replace(stages, grow=RunConfig().grow, views=views, export=replace(stages.export, textures="png", fallback=True))
    built = build_lod(tree, folder / f"{name}.glb", config.levels, plain, work=folder)
    dataset = ViewDataset.load(folder / "views", limits=stages.limits)
    export = with_textures(export_config(dataset, stages.outlined))
    with claimed_folder("out", folder / CARDS) as place:
        Record(place).run(_cards_stage(place, built, export))
    assert dataset.request and dataset.request.tree.bounds
    low, high = dataset.request.tree.bounds
    fitted = [folder / str(level.requested) for level in built.levels if level.planes is not None]
    files = [
        *(f"{CARDS}/{file}" for file in _card_files(built)),
        *(f"{LEVELS}/{level.file}" for level in built.levels if level.planes is None),
    ]
    return {
        "low": low,
        "high": high,
        "levels": [asdict(level) for level in built.levels],
        "files": {file: digest_file(folder / file) for file in files},
        "seconds": _seconds([*records, *fitted, folder / CARDS]),
    }


def card_file(level: LodLevel) -> str:
    """The name of the file with the cards of a level."""
    return f"{level.requested}.safetensors"


def _card_files(built: LodResult) -> list[str]:
    return [card_file(level) for level in built.levels if level.planes is not None]


def _cards_stage(folder: Path, built: LodResult, export: ExportConfig) -> Stage:
    """Write the cards of each level, with mip levels of their own if the encoder of KTX2 is installed."""
    clouds = [built.folder / str(level.requested) / "cloud.safetensors" for level in built.levels if level.planes is not None]
    levels = [level for level in built.levels if level.planes is not None]

    def work(on_progress: OnProgress) -> None:
        for number, (level, path) in enumerate(zip(levels, clouds, strict=True)):
            on_progress(CARDS, number, len(levels))
            own = export if level.outline is None else replace(export, outline=level.outline)
            cards = shipped_model(BillboardCloud.load(path), own, level.halvings).cards
            write_cards(folder / card_file(level), cards, safe_level(export.padding))
        on_progress(CARDS, len(levels), len(levels))

    inputs = (
        [digest_file(path) for path in clouds],
        [asdict(level) for level in levels],
        export.key,
        VERSIONS["export"],
    )
    return Stage(CARDS, inputs, tuple(card_file(level) for level in levels), work, algorithm="library")


def _seconds(folders: list[Path]) -> dict[str, float]:
    """Seconds of each stage, summed over the records of folders."""
    total = dict[str, float]()
    for folder in folders:
        for stage, seconds in Record(folder).seconds.items():
            total[stage] = round(total.get(stage, 0.0) + seconds, 3)
    return total
