"""A library of trees: levels of detail of many trees, on this machine or on a Ray cluster, with one atlas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from bbfit.blender.requirements import check_blender
from bbfit.checks import InputError, fail
from bbfit.exporting.encoders import WEBP_SIDE
from bbfit.layout import TEST_FILE
from bbfit.library.config import LibraryConfig
from bbfit.library.files import STAGE, WORK, FinishedTree, library_outputs, library_stage
from bbfit.library.manifest import Library, read_library
from bbfit.library.shared_atlas import check_padding
from bbfit.library.trees import library_tree
from bbfit.lod import check_levels, check_unset, with_measured_speed, with_textures
from bbfit.outputs import claimed_folder
from bbfit.pipeline import RunConfig, needs_blender
from bbfit.provenance import VERSIONS, cache_key, digest_file, identity
from bbfit.stages.stage import OnProgress, Record, silent
from bbfit.tree_files.tree_file import MESH_SUFFIXES, TreeFile
from bbfit.trees.species import load_species
from bbfit.workers.choice import workers_of
from bbfit.workers.results import Results
from bbfit.workers.sources import Source, seeded_sources, task_inputs
from bbfit.workers.tasks import Facts, Outcome, Task, Workers


def build_library(
    trees: Sequence[str | Path],
    out: str | Path,
    config: LibraryConfig | None = None,
    stages: RunConfig | None = None,
    *,
    species: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    on_progress: OnProgress | None = None,
) -> Library:
    """Make levels of detail of many trees, as :func:`~bbfit.lod.build_lod` does, and a folder in which all of them share one atlas.

    Writes ``trees/NAME_LOD0.glb`` and so on, one file for each level of each tree; ``trees/atlas.png``, with ``trees/atlas.ktx2`` beside it
    if the encoder is installed; ``contact.png``, a picture of all trees and levels; ``times.md``, the seconds of each stage; and last
    ``library.json``, which lists all of it. The textures are those of the single models, texel for texel. ``work/NAME/`` has the views and
    fits of each tree. A killed build continues where it stopped. A tree that fails is listed in ``failures`` with its reason, and the
    others continue; it is tried again at the next start.

    Parameters
    ----------
    trees
        Files of trees, in any format of :func:`~bbfit.lod.build_lod`.
    out
        The library's folder. It is created if it does not exist.
    config
        The levels, the atlas, and the processes or machines.
    stages
        The options for growing and rendering trees, and for fitting and exporting billboards.
    species, seeds
        Species to grow, each with every seed.
    on_progress
        Called with the number of finished trees, and with the progress of the atlas.

    Raises
    ------
    InputError, OSError
        If there are no trees, an option is unusable, no tree succeeds, the atlas would be too large, or the folder cannot be written to.
        Finished trees are kept.
    """
    stages, on_progress = stages or RunConfig(), on_progress or silent
    config = with_measured_speed(config or LibraryConfig(), stages.export.profile)
    if not trees and not species:
        fail("library", "there are no trees", "give files, or species to grow, as in --species acer")
    chosen = seeded_sources(species, seeds, trees, stages.grow.species_file)
    _check(Path(out), chosen, config, stages)
    with claimed_folder("out", out) as folder:
        record = Record(folder, inputs=[*map(Path, trees)])
        record.check({STAGE: library_outputs([source.name for source, _ in chosen], config)})
        outcomes = _built(folder, chosen, config, stages, on_progress)
        failures = {name: outcome.reason for name, outcome in outcomes.items() if outcome.reason is not None}
        done = {name: outcome.facts for name, outcome in outcomes.items() if outcome.facts is not None}
        if not done:
            name, reason = next(iter(failures.items()))
            fail("library", f"no tree succeeded; {name}: {reason}")
        finished = [FinishedTree(source, seed, done[source.name]) for source, seed in chosen if source.name in done]
        record.run(library_stage(record, finished, failures, config, stages), on_progress)
        return read_library(folder, stages.limits)


def _check(folder: Path, chosen: list[tuple[Source, int]], config: LibraryConfig, stages: RunConfig) -> None:
    """Check the options of all trees before the first one. Devices and packages of a cluster are not known here."""
    check_unset(config, stages)
    check_padding(stages.export.padding)
    if stages.export.textures == "webp" and config.page_size > WEBP_SIDE:
        fail("page_size", f"WebP has at most {WEBP_SIDE} texels a side, got {config.page_size}", "give less, or --textures png")
    mesh = all(source.tree is None or source.tree.suffix.lower() in MESH_SUFFIXES for source, _ in chosen)
    here = config.ray is None
    check_levels(config, stages if here else replace(stages, fit=replace(stages.fit, device="cpu")), mesh=mesh)
    for source, _ in chosen:
        if source.species is not None:
            load_species(source.species, stages.grow.species_file)
    if here and any(needs_blender(folder / WORK / source.name) for source, _ in chosen):
        check_blender(stages.views)


def _built(
    folder: Path, chosen: list[tuple[Source, int]], config: LibraryConfig, stages: RunConfig, on_progress: OnProgress
) -> dict[str, Outcome]:
    """The outcome of each tree by its name, in their order."""
    results, outcomes, pending = Results(folder / "results"), dict[str, Outcome](), dict[str, str]()
    with workers_of(config) as workers:
        for source, seed in chosen:
            try:
                key = _submitted(folder, source, seed, config, stages, results, workers)
            except InputError as error:  # a damaged file
                outcomes[source.name] = Outcome(None, str(error), "")
                continue
            if isinstance(key, Outcome):
                outcomes[source.name] = key
            else:
                pending[source.name] = key
        on_progress("trees", len(outcomes), len(chosen))
        while pending:
            task, outcome = workers.next()
            results.put(pending.pop(task.name), outcome, identity({"tree": task.name, "levels": config.levels, "views": stages.views}))
            outcomes[task.name] = outcome
            on_progress("trees", len(outcomes), len(chosen), outcome.reason or task.name)
    return {source.name: outcomes[source.name] for source, _ in chosen}


def _submitted(
    folder: Path, source: Source, seed: int, config: LibraryConfig, stages: RunConfig, results: Results, workers: Workers
) -> str | Outcome:
    """Submit the task of a tree and return the key of its result, or return the result that exists. Raises the errors of ``TreeFile``."""
    place, grow = folder / WORK / source.name, replace(stages.grow, seed=seed)
    tree = None if source.tree is None else TreeFile.open(source.tree, stages.limits)
    kind = tree.digest if tree else (load_species(source.species, grow.species_file), grow)
    key = cache_key("library", source.name, kind, config.levels, stages.views, stages.fit, with_textures(stages.export).key, VERSIONS)
    earlier = results.get(key)
    if earlier is not None and _is_current(earlier.facts, place):
        return earlier
    inputs = task_inputs(source, tree, grow.species_file, stages.views.hdri)
    arguments = (source.name, source.species, config, replace(stages, grow=grow))
    workers.submit(Task(source.name, library_tree, inputs, place, arguments))
    return key


def _is_current(facts: Facts | None, place: Path) -> bool:
    """Whether a tree's task succeeded, and the files that it wrote for the library are as they were."""
    files = (facts or {}).get("files")
    if not isinstance(files, Mapping) or not files or not (place / "views" / TEST_FILE).is_file():
        return False
    return all((file := place / name).is_file() and digest_file(file) == digest for name, digest in files.items())
