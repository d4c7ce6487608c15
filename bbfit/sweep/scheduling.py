"""Sweeps: every configuration of a grid for every tree, each computed once however often the sweep is killed."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bbfit.checks import InputError, check_file, check_folder, fail
from bbfit.files import output_folder, write_bytes
from bbfit.fitting.loop import fit_inputs
from bbfit.layout import TEST_FILE
from bbfit.pipeline import RunConfig
from bbfit.provenance import VERSIONS, cache_key, identity
from bbfit.reporting.sweep_plots import sweep_plot
from bbfit.reporting.sweep_tables import SweepRow, table_csv, table_markdown
from bbfit.stages.stage import OnProgress, silent
from bbfit.sweep.cluster import RayWorkers
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.grid import Cell, Grid
from bbfit.sweep.local import LocalWorkers
from bbfit.sweep.results import Results
from bbfit.sweep.tasks import Outcome, Task, Workers, fit_tree, prepare_tree
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.species import load_species
from bbfit.views import ViewDataset

# Characters of a hash that name results and folders: two of a million would be alike once in 10^12 sweeps.
_DIGITS = 20
# Seconds from one writing of the table to the next while runs are made.
_EVERY = 10.0


@dataclass(frozen=True)
class Source:
    """A tree of a sweep."""

    name: str
    """Of its folder and its rows."""
    species: str | None = None
    """What to grow."""
    tree: Path | None = None
    """The tree's file, to be rendered."""
    views: Path | None = None
    """Folder of its views."""


@dataclass(frozen=True)
class SweepResult:
    """What a sweep made."""

    folder: Path
    """Where everything lies: ``trees``, ``runs``, ``results`` and the tables."""
    rows: tuple[SweepRow, ...]
    """One for each configuration of each tree, in the order of the trees and of the grid."""
    kept: int
    """How many of their results stood from an earlier start."""


def run_sweep(
    out: str | Path,
    config: SweepConfig | None = None,
    stages: RunConfig | None = None,
    *,
    species: Sequence[str] = (),
    trees: Sequence[str | Path] = (),
    views: Sequence[str | Path] = (),
    on_progress: OnProgress | None = None,
) -> SweepResult:
    """Fit every configuration of a grid to every tree and compare them, on this machine or on a Ray cluster.

    Writes ``trees/NAME/`` (the grown tree and its views, rendered once), ``runs/KEY/`` (what :func:`bbfit.run` makes of them),
    ``results/KEY.json``, ``table.csv`` (a row a run, kept up to date), ``table.md`` and ``table.png``. A key is the hash of the resolved
    configuration, of the views and, where it has a say, of the mesh: a killed sweep goes on where it was, and sweeps of other grids into
    the same folder share the runs that they have in common. What fails is recorded with its reason, and the rest goes on.

    Parameters
    ----------
    out : the sweep's folder, made if need be.
    stages : how trees are grown, rendered and exported, and what of the fit the grid leaves open.
    species, trees, views : species to grow, tree files, folders of views; with none of them, the species that the grid names.
    on_progress : told how many trees are ready and how many runs are done.

    Raises
    ------
    InputError, OSError
        if the grid is bad, an input does not exist, or the folder cannot be written to. Results so far are kept.
    """
    config, stages = config or SweepConfig(), stages or RunConfig()
    if stages.budget.given:
        fail("budget", "a sweep tries what its grid says", "leave the budget out")
    grid = Grid.load(config.grid).narrowed(config)
    cells = grid.cells(stages.fit)
    found = sources(species if species or trees or views else grid.trees, trees, views, stages.grow.species_file)
    sweep = _Sweep(output_folder("out", out), found, cells, config, stages)
    workers: Workers = LocalWorkers(config.workers, config.retries) if config.ray is None else RayWorkers(config)
    with workers:
        sweep.carry_out(workers, on_progress or silent)
    return sweep.result()


def sources(
    species: Sequence[str], trees: Sequence[str | Path], views: Sequence[str | Path], species_file: Path | None = None
) -> list[Source]:
    """The trees of a sweep, each with a name of its own: the species, of one's own file if there is one, or that of the file or folder.

    Raises
    ------
    MissingFileError, InputError
        if there are none, one does not exist, or two have the same name.
    """
    found = [Source(load_species(name, species_file).name, species=name) for name in species]
    given = [(path, Source(path.stem, tree=check_file("tree", path))) for path in map(Path, trees)]
    for folder in views:
        path = check_folder("views", folder).resolve()
        path = path.parent if path.name == "views" else path  # as runs call the folder beside their tree
        given.append((path, Source(path.name, views=Path(folder))))
    names = [source.name for source in found] + [source.name for _, source in given]
    for path, source in given:  # libraries often have a folder for each tree, and the same file name in all
        found.append(source if names.count(source.name) == 1 else replace(source, name=f"{path.resolve().parent.name}_{source.name}"))
    if not found:
        fail("sweep", "there are no trees", "give species, trees or views")
    for source in found:
        if sum(other.name == source.name for other in found) > 1:
            fail("sweep", f"two trees are called {source.name}", "rename one, or leave one out")
    return found


@dataclass(frozen=True)
class _Job:
    """Something that is being made."""

    key: str
    request: dict[str, Any]


@dataclass(frozen=True)
class _Tree:
    """A tree that can be fitted to."""

    views: ViewDataset
    mesh: TreeFile | None


class _Sweep:
    def __init__(self, folder: Path, found: list[Source], cells: list[Cell], config: SweepConfig, stages: RunConfig) -> None:
        self._folder, self._sources, self._cells, self._config, self._stages = folder, found, cells, config, stages
        self._results = Results(folder / "results")
        self._jobs = dict[str, _Job]()  # by the name of the task
        self._wanted_by = defaultdict[str, list[tuple[Source, int]]](list)  # by key: the trees and cells that wait for a run
        self._outcomes = dict[tuple[Source, int], tuple[str | None, Outcome]]()  # key and what came of it
        self._ready = self._kept = 0
        self._written = -math.inf

    def carry_out(self, workers: Workers, on_progress: OnProgress) -> None:
        """Prepare all trees and make all runs that no result stands for."""
        preparing = {f"views of {source.name}": source for source in self._sources}
        for name, source in preparing.items():
            self._prepare(name, source, workers)
        self._report(on_progress)
        while self._jobs:
            task, outcome = workers.next()
            job = self._jobs.pop(task.name)
            self._results.put(job.key, outcome, job.request)
            if task.name in preparing:
                self._prepared(preparing[task.name], outcome, workers)
            for source, cell in self._wanted_by.pop(job.key, ()):
                self._outcomes[source, cell] = job.key, outcome
            self._report(on_progress, outcome.reason or "")

    def result(self) -> SweepResult:
        """The rows, and the tables of them on disk."""
        rows = self._rows()
        write_bytes(self._folder / "table.csv", table_csv(rows))
        write_bytes(self._folder / "table.md", table_markdown(rows).encode())
        sweep_plot(rows, self._folder / "table.png")
        return SweepResult(self._folder, tuple(rows), self._kept)

    def _report(self, on_progress: OnProgress, note: str = "") -> None:
        on_progress("trees", self._ready, len(self._sources))
        on_progress("runs", len(self._outcomes), len(self._sources) * len(self._cells), note)
        if time.monotonic() - self._written >= _EVERY:
            write_bytes(self._folder / "table.csv", table_csv(self._rows()))
            self._written = time.monotonic()

    def _prepare(self, name: str, source: Source, workers: Workers) -> None:
        """See to it that a tree's views are rendered."""
        if source.views is not None:
            self._prepared(source, Outcome({}, None, ""), workers)
            return
        grow, views = self._stages.grow, self._stages.views
        try:
            tree = None if source.tree is None else TreeFile.open(source.tree)
        except InputError as error:
            self._prepared(source, Outcome(None, str(error), ""), workers)
            return
        made_of = tree.digest if tree else cache_key("grow", load_species(source.species, grow.species_file), grow)
        key = cache_key("views", made_of, views)[:_DIGITS]
        earlier = self._results.get(key)
        if earlier and self._is_final(earlier) and (earlier.reason or (self._folder_of(source) / "views" / TEST_FILE).is_file()):
            self._prepared(source, earlier, workers)
            return
        self._jobs[name] = _Job(key, identity({"tree": source.species or str(source.tree), "views": views}))
        named = {"tree": tree and tree.files, "species_file": source.species and grow.species_file, "hdri": views.hdri}
        inputs = {what: paths if isinstance(paths, tuple) else (paths,) for what, paths in named.items() if paths}
        workers.submit(Task(name, prepare_tree, inputs, self._folder_of(source), (self._stages, source.species), alone=True))

    def _prepared(self, source: Source, outcome: Outcome, workers: Workers) -> None:
        """Hand in the runs of a tree whose views are there, or note that they are not."""
        self._ready += 1
        folder = source.views or self._folder_of(source) / "views"
        reason = outcome.reason
        if reason is None:
            try:
                views = ViewDataset.load(folder)
                views.train.check()
                views.test.check()
            except InputError as error:
                reason = str(error)
        if reason is not None:
            failed = Outcome(None, reason, outcome.where)
            self._outcomes |= {(source, cell): (None, failed) for cell in range(len(self._cells))}
            return
        mesh = self._folder_of(source) / "tree.glb" if source.species else source.tree
        tree = _Tree(views, TreeFile.open(mesh) if mesh and (outcome.facts or {}).get("mesh") else None)
        for number in range(len(self._cells)):
            self._run(source, number, tree, workers)

    def _run(self, source: Source, number: int, tree: _Tree, workers: Workers) -> None:
        """See to it that a run is made, unless its result stands or it is being made already."""
        fit, export = self._cells[number].config, self._stages.export
        versions = {name: VERSIONS[name] for name in ("export", "evaluate")}
        request = {"fit": fit_inputs(tree.views, fit, tree.mesh), "export": export, "views": tree.views.fingerprint, "versions": versions}
        key = cache_key("fit", request)[:_DIGITS]
        earlier = self._results.get(key)
        if earlier and self._is_final(earlier):
            self._outcomes[source, number] = key, earlier
            self._kept += 1
            return
        self._wanted_by[key].append((source, number))
        if len(self._wanted_by[key]) > 1:
            return
        folder = source.views or self._folder_of(source) / "views"
        inputs = {"views": (folder,)} | ({"tree": tree.mesh.files} if fit.placement == "clusters" and tree.mesh else {})
        self._jobs[key] = _Job(key, identity(request))
        workers.submit(Task(key, fit_tree, inputs, self._folder / "runs" / key, (RunConfig(fit=fit, export=export),)))

    def _is_final(self, outcome: Outcome) -> bool:
        return outcome.reason is None or not self._config.retry_failed

    def _folder_of(self, source: Source) -> Path:
        return self._folder / "trees" / source.name

    def _rows(self) -> list[SweepRow]:
        return [
            SweepRow(
                tree=source.name,
                labels=cell.labels,
                steps=cell.config.steps,
                facts=outcome.facts,
                reason=outcome.reason,
                seconds=outcome.seconds,
                folder="" if key is None else f"runs/{key}",
            )
            for source in self._sources
            for number, cell in enumerate(self._cells)
            if (known := self._outcomes.get((source, number)))
            for key, outcome in [known]
        ]
