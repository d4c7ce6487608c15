"""The comparison of all systems on many trees, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bbfit.checks import InputError, fail
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.one_tree import checked_systems, compare
from bbfit.comparison.subject import is_missing
from bbfit.files import write_bytes
from bbfit.inputs import reading
from bbfit.outputs import Written, claimed_folder
from bbfit.pipeline import RunConfig
from bbfit.provenance import VERSIONS, cache_key, identity
from bbfit.reporting.comparison_summary import compare_plot, summaries, summary_csv, summary_markdown
from bbfit.reporting.comparison_tables import CompareRow
from bbfit.stages.stage import OnProgress, Record, silent
from bbfit.stages.trees import grow_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.species import load_species
from bbfit.workers.choice import workers_of
from bbfit.workers.results import Results
from bbfit.workers.sources import Source, seeded_sources, task_inputs
from bbfit.workers.tasks import Facts, Outcome, Task

_TABLES = ("summary.csv", "summary.md", "pareto.png")


@dataclass(frozen=True)
class CompareTreesResult:
    """The results of a comparison on many trees."""

    folder: Path
    """The folder, with a folder for each tree and the tables."""
    rows: Mapping[str, tuple[CompareRow, ...]]
    """The rows of each tree, by its name."""
    failures: Mapping[str, str]
    """Why a tree has no rows, by its name."""


def compare_trees(
    out: str | Path,
    config: CompareConfig | None = None,
    stages: RunConfig | None = None,
    *,
    species: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    trees: Sequence[str | Path] = (),
    on_progress: OnProgress | None = None,
) -> CompareTreesResult:
    """Do what :func:`~bbfit.comparison.one_tree.compare` does for many trees: means, spreads, and who is best at which cost.

    Writes ``trees/NAME/`` with the comparison of each tree, ``summary.csv`` (a row for each system of each tree), ``summary.md`` (means,
    spreads, fronts), and ``pareto.png`` (PSNR and FLIP against each cost). A killed comparison continues where it stopped. A tree that
    fails is recorded with its reason, and the others continue.

    Parameters
    ----------
    out
        The folder for the results.
    config
        The systems and their sizes, and the processes or machines. A tree gets all cores of its machine.
    stages
        The options for growing and rendering trees, and the options that all of bbfit's fits and exports share.
    species, seeds, trees
        Species to grow, each with every seed, and files of trees.
    on_progress
        Called with the number of finished trees.

    Raises
    ------
    InputError, OSError
        If there are no trees, none succeeds, an option is unusable, or the folder cannot be written to. Finished results are kept.
    """
    config, stages, on_progress = config or CompareConfig(), stages or RunConfig(), on_progress or silent
    chosen = seeded_sources(species, seeds, trees, stages.grow.species_file)
    checked_systems(config, stages)
    with claimed_folder("out", out) as folder:
        written = Written(folder)
        written.begin("tables", _TABLES, [*map(Path, trees)])
        outcomes = _compared(folder, chosen, config, stages, on_progress)
        rows = {name: _rows(outcome) for name, outcome in outcomes.items() if outcome.reason is None}
        failures = {name: outcome.reason for name, outcome in outcomes.items() if outcome.reason is not None}
        if not rows:
            name, reason = next(iter(failures.items()))
            fail("compare", f"no tree succeeded; {name}: {reason}")
        write_bytes(folder / "summary.csv", summary_csv(rows))
        write_bytes(folder / "summary.md", summary_markdown(rows, failures).encode(errors="backslashreplace"))
        compare_plot(summaries(rows), folder / "pareto.png")
        written.finish("tables", written.digests(_TABLES))
        return CompareTreesResult(folder, rows, failures)


def _compared(
    folder: Path, chosen: list[tuple[Source, int]], config: CompareConfig, stages: RunConfig, on_progress: OnProgress
) -> dict[str, Outcome]:
    """The outcome of each tree by its name, in their order."""
    results, outcomes, pending = Results(folder / "results"), dict[str, Outcome](), dict[str, str]()
    with workers_of(config) as workers:
        for source, seed in chosen:
            place, grow = folder / "trees" / source.name, replace(stages.grow, seed=seed)
            try:
                tree = None if source.tree is None else TreeFile.open(source.tree, stages.limits)
            except InputError as error:  # a damaged file
                outcomes[source.name] = Outcome(None, str(error), "")
                continue
            kind = tree.digest if tree else (load_species(source.species, grow.species_file), grow)
            key = cache_key("compare", source.name, kind, config.compared, stages.views, stages.fit, stages.export.key, VERSIONS)
            earlier = results.get(key)
            if earlier is not None and _is_complete(earlier) and (place / "compare.json").is_file():
                outcomes[source.name] = earlier
                continue
            pending[source.name] = key
            inputs = task_inputs(source, tree, grow.species_file, stages.views.hdri)
            arguments = (config, replace(stages, grow=grow), source.species)
            workers.submit(Task(source.name, compare_tree, inputs, place, arguments, alone=True))
        on_progress("trees", len(outcomes), len(chosen))
        while pending:
            task, outcome = workers.next()
            key = pending.pop(task.name)
            results.put(key, outcome, identity({"tree": task.name, "config": config.compared, "views": stages.views}))
            outcomes[task.name] = outcome
            on_progress("trees", len(outcomes), len(chosen), outcome.reason or task.name)
    return {source.name: outcomes[source.name] for source, _ in chosen}


def compare_tree(inputs: Mapping[str, Path], folder: Path, config: CompareConfig, stages: RunConfig, species: str | None) -> Facts:
    """Grow a tree, or take the input ``tree``, and compare all systems on it; the rows as JSON.

    The inputs also contain ``species_file`` and ``hdri``, if the options of the stages name such files. The errors of ``compare`` are
    raised.
    """
    tree = inputs.get("tree")
    if species is not None:
        grow = replace(stages.grow, species_file=inputs.get("species_file"))
        with claimed_folder("out", folder / "grown") as grown:
            Record(grown).run(grow_stage(grown, load_species(species, grow.species_file), grow))
            tree = grown / "tree.glb"
    assert tree is not None
    stages = replace(stages, grow=RunConfig().grow, views=replace(stages.views, hdri=inputs.get("hdri")))
    return {"rows": [row.to_json() for row in compare(tree, folder, config, stages).rows]}


def _is_complete(outcome: Outcome) -> bool:
    """Whether a stored outcome has the rows of all systems. One was skipped if a package was missing, which may be installed by now."""
    try:
        with reading("result", outcome.where, "remove it"):
            return outcome.reason is None and not any(is_missing(row.note) for row in _rows(outcome))
    except InputError:  # a damaged file
        return False


def _rows(outcome: Outcome) -> tuple[CompareRow, ...]:
    assert outcome.facts is not None
    return tuple(CompareRow.from_json(row) for row in outcome.facts["rows"])
