"""Sweeps: run every configuration of a grid for every tree. A killed sweep continues and repeats no finished run."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bbfit.blender.config import RING
from bbfit.blender.requirements import check_blender
from bbfit.checks import InputError, fail
from bbfit.files import write_bytes
from bbfit.fitting.loop import fit_inputs
from bbfit.layout import TEST_FILE
from bbfit.outputs import Written, claimed_folder
from bbfit.pipeline import RunConfig, needs_blender
from bbfit.provenance import VERSIONS, cache_key, identity
from bbfit.reporting.sweep_plots import sweep_plot
from bbfit.reporting.sweep_tables import SweepRow, table_csv, table_markdown
from bbfit.stages.stage import OnProgress, silent
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.grid import Cell, Grid
from bbfit.sweep.tasks import fit_tree, prepare_tree
from bbfit.tree_files.tree_file import MESH_SUFFIXES, TreeFile
from bbfit.trees.species import load_species
from bbfit.views.dataset import ViewDataset
from bbfit.workers.choice import workers_of
from bbfit.workers.results import Results
from bbfit.workers.sources import Source, sources, task_inputs
from bbfit.workers.tasks import Outcome, Task, Workers

TABLES = ("table.csv", "table.md", "table.png")
"""The files that compare the runs of a sweep."""
# Digits of a key in the names of results and folders. Among a million keys, two agree in one of 10^12 sweeps.
_DIGITS = 20
# Seconds between two writes of the table during a sweep.
_TABLE_INTERVAL = 10.0


@dataclass(frozen=True)
class SweepResult:
    """The results of a sweep."""

    folder: Path
    """The sweep's folder, with ``trees``, ``runs``, ``results`` and the tables."""
    rows: tuple[SweepRow, ...]
    """One row for each configuration of each tree, in the order of the trees and of the grid."""
    kept: int
    """The number of results that an earlier sweep had computed."""


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

    Writes ``trees/NAME/`` (the grown tree and its views, rendered once), ``runs/KEY/`` (the outputs of :func:`bbfit.run`),
    ``results/KEY.json``, ``table.csv`` (a row for each run, updated during the sweep), ``table.md`` and ``table.png``. A key is the hash
    of the resolved configuration, the views and, if it places the billboards, the mesh. So a killed sweep continues where it stopped, and
    sweeps of different grids in the same folder share their common runs. A failed run is recorded with its reason, and the others
    continue.

    Parameters
    ----------
    out
        The sweep's folder. It is created if it does not exist.
    config
        The grid, and the processes or machines.
    stages
        The options for growing, rendering and exporting trees, and the options of the fit that the grid does not set.
    species, trees, views
        Species to grow, files of trees, and folders of views. Without any of them, the species of the grid.
    on_progress
        Called with the number of prepared trees and the number of finished runs.

    Raises
    ------
    InputError, OSError
        If the grid is invalid, an input does not exist, or the folder cannot be written to. Finished results are kept.
    """
    config, stages = config or SweepConfig(), stages or RunConfig()
    if stages.budget.given:
        fail("budget", "a sweep runs the configurations of its grid", "omit the budget")
    grid = Grid.load(config.grid).narrowed(config)
    cells = grid.cells(stages.fit, max_cells=config.max_cells)
    if stages.views.elevations is None and all(cell.config.preset == "thesis" for cell in cells):
        stages = replace(stages, views=replace(stages.views, elevations=RING))
    all_sources = sources(species if species or trees or views else grid.trees, trees, views, stages.grow.species_file)
    _check(Path(out), all_sources, cells, config, stages)
    with claimed_folder("out", out) as folder:
        written = Written(folder)
        written.begin("tables", TABLES, [*map(Path, trees)])
        sweep = _Sweep(folder, all_sources, cells, config, stages)
        with workers_of(config) as workers:
            sweep.run(workers, on_progress or silent)
        result = sweep.result()
        written.finish("tables", written.digests(TABLES))
        return result


def _check(folder: Path, sources: list[Source], cells: list[Cell], config: SweepConfig, stages: RunConfig) -> None:
    """Check the options of all runs before the first one. Devices and packages of a cluster are not known here."""
    to_render = [source for source in sources if source.views is None]
    mesh = all(source.tree is None or source.tree.suffix.lower() in MESH_SUFFIXES for source in to_render)
    for cell in cells:
        fit, export = cell.config, stages.export
        if config.ray is not None:
            fit, export = replace(fit, device="cpu"), replace(export, textures=None)
        replace(stages, fit=fit, export=export).check(mesh=mesh, rendered=bool(to_render), blender=False)
    if config.ray is None and any(needs_blender(_tree_folder(folder, source)) for source in to_render):
        check_blender(stages.views)


def _tree_folder(folder: Path, source: Source) -> Path:
    return folder / "trees" / source.name


class _Sweep:
    def __init__(self, folder: Path, sources: list[Source], cells: list[Cell], config: SweepConfig, stages: RunConfig) -> None:
        self._folder, self._sources, self._cells, self._config, self._stages = folder, sources, cells, config, stages
        self._results = Results(folder / "results")
        self._pending = dict[str, tuple[str, Any]]()  # by the name of a task: the key and the description of its result
        self._waiting = defaultdict[str, list[tuple[Source, int]]](list)  # by key: the trees and cells that wait for a run
        self._outcomes = dict[tuple[Source, int], tuple[str | None, Outcome]]()  # key and outcome
        self._ready = self._kept = 0
        self._written = -math.inf

    def run(self, workers: Workers, on_progress: OnProgress) -> None:
        """Prepare all trees, and run all configurations that have no result."""
        preparing = {f"views of {source.name}": source for source in self._sources}
        for name, source in preparing.items():
            self._prepare(name, source, workers)
        self._report(on_progress)
        while self._pending:
            task, outcome = workers.next()
            key, request = self._pending.pop(task.name)
            self._results.put(key, outcome, request)
            if task.name in preparing:
                self._submit_runs(preparing[task.name], outcome, workers)
            for source, cell in self._waiting.pop(key, ()):
                self._outcomes[source, cell] = key, outcome
            self._report(on_progress, outcome.reason or "")

    def result(self) -> SweepResult:
        """Write the tables and return the rows."""
        rows = self._rows()
        write_bytes(self._folder / "table.csv", table_csv(rows))
        write_bytes(self._folder / "table.md", table_markdown(rows).encode(errors="backslashreplace"))
        sweep_plot(rows, self._folder / "table.png")
        return SweepResult(self._folder, tuple(rows), self._kept)

    def _report(self, on_progress: OnProgress, note: str = "") -> None:
        on_progress("trees", self._ready, len(self._sources))
        on_progress("runs", len(self._outcomes), len(self._sources) * len(self._cells), note)
        if time.monotonic() - self._written >= _TABLE_INTERVAL:
            write_bytes(self._folder / "table.csv", table_csv(self._rows()))
            self._written = time.monotonic()

    def _prepare(self, name: str, source: Source, workers: Workers) -> None:
        """Submit a task that renders the views of a tree, unless they exist."""
        if source.views is not None:
            self._submit_runs(source, Outcome({}, None, ""), workers)
            return
        grow, views = self._stages.grow, self._stages.views
        try:
            tree = None if source.tree is None else TreeFile.open(source.tree, self._stages.limits)
        except InputError as error:
            self._submit_runs(source, Outcome(None, str(error), ""), workers)
            return
        tree_key = tree.digest if tree else cache_key("grow", load_species(source.species, grow.species_file), grow)
        key = cache_key("views", tree_key, views)[:_DIGITS]
        earlier = self._results.get(key)
        if earlier and self._is_final(earlier) and (earlier.reason or (self._folder_of(source) / "views" / TEST_FILE).is_file()):
            self._submit_runs(source, earlier, workers)
            return
        self._pending[name] = key, identity({"tree": source.species or str(source.tree), "views": views})
        inputs = task_inputs(source, tree, grow.species_file, views.hdri)
        workers.submit(Task(name, prepare_tree, inputs, self._folder_of(source), (self._stages, source.species), alone=True))

    def _submit_runs(self, source: Source, outcome: Outcome, workers: Workers) -> None:
        """Submit the runs of a tree after its preparation, or record why it failed."""
        self._ready += 1
        folder = source.views or self._folder_of(source) / "views"
        reason = outcome.reason
        if reason is None:
            try:
                views = ViewDataset.load(folder, limits=self._stages.limits)
                views.check()
            except InputError as error:
                reason = str(error)
        if reason is not None:
            failed = Outcome(None, reason, outcome.where)
            self._outcomes |= {(source, cell): (None, failed) for cell in range(len(self._cells))}
            return
        path = self._folder_of(source) / "tree.glb" if source.species else source.tree
        mesh = TreeFile.open(path, self._stages.limits) if path and (outcome.facts or {}).get("mesh") else None
        for number in range(len(self._cells)):
            self._submit_run(source, number, views, mesh, workers)

    def _submit_run(self, source: Source, number: int, views: ViewDataset, mesh: TreeFile | None, workers: Workers) -> None:
        """Submit the run of a cell, unless its result exists or the same run is already submitted."""
        fit, export = self._cells[number].config, self._stages.export
        versions = {name: VERSIONS[name] for name in ("export", "evaluate")}
        request = {"fit": fit_inputs(views, fit, mesh), "export": export.key, "views": views.full_fingerprint, "versions": versions}
        key = cache_key("fit", request)[:_DIGITS]
        earlier = self._results.get(key)
        if earlier and self._is_final(earlier):
            self._outcomes[source, number] = key, earlier
            self._kept += 1
            return
        self._waiting[key].append((source, number))
        if len(self._waiting[key]) > 1:
            return
        folder = source.views or self._folder_of(source) / "views"
        inputs = {"views": (folder,)} | ({"tree": mesh.files} if fit.placement == "clusters" and mesh else {})
        self._pending[key] = key, identity(request)
        workers.submit(
            Task(key, fit_tree, inputs, self._folder / "runs" / key, (RunConfig(fit=fit, export=export, limits=self._stages.limits),))
        )

    def _is_final(self, outcome: Outcome) -> bool:
        return outcome.reason is None or not self._config.retry_failed

    def _folder_of(self, source: Source) -> Path:
        return _tree_folder(self._folder, source)

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
            if (entry := self._outcomes.get((source, number)))
            for key, outcome in [entry]
        ]
