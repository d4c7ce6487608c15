"""A run: grow, views, budget, fit, evaluate, export, report. A stage with current results is skipped."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from bbfit.blender.config import RING, ViewsConfig
from bbfit.blender.requirements import check_blender
from bbfit.budget.choice import check_budget
from bbfit.budget.config import BudgetConfig
from bbfit.budget.sizes import finest_within_bytes
from bbfit.checks import fail
from bbfit.evaluation.report import Report
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import ShippedModel, check_material, shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import Step
from bbfit.fitting.requirements import check_device
from bbfit.geometry.cloud import BillboardCloud
from bbfit.inputs import InputLimits
from bbfit.layout import TEST_FILE
from bbfit.outputs import check_room, claimed_folder
from bbfit.stages.billboards import BUDGET_OUTPUTS, FIT_OUTPUTS, budget_stage, fit_stage, read_choice
from bbfit.stages.describing import subject_of
from bbfit.stages.requirements import check_planned_views, check_training
from bbfit.stages.results import (
    EVALUATE_OUTPUTS,
    REPORT_OUTPUTS,
    evaluate_stage,
    export_config,
    export_outputs,
    export_stage,
    original_tree,
    report_stage,
)
from bbfit.stages.stage import OnProgress, Record, Stage, record_head, silent
from bbfit.stages.trees import GROW_OUTPUTS, grow_stage, views_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.config import GrowConfig
from bbfit.trees.species import Species, load_species
from bbfit.views.dataset import ViewDataset

# Bytes that are free on the disk before a run begins. Runs of three trees with views of 256 x 256 pixels take 4 to 12 MB without the views.
_ROOM = 1 << 26


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Options of every stage."""

    species: str | None = None
    """The species to grow if no tree is given. Default: the only species in ``grow.species_file``, or a quaking aspen without that file."""
    tree: Path | None = None
    """The mesh of the tree in a given folder of views, for placing billboards. Without it, the views alone decide the placement."""
    grow: GrowConfig = field(default_factory=lambda: GrowConfig(detail=0.5))
    """Options for growing a tree. The default is moderate detail."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """Options for rendering the tree. For a fit of maps, ``suns`` is at least 1."""
    fit: FitConfig = field(default_factory=FitConfig)
    """Options for fitting the billboards."""
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    """Limits of the result. They determine the options of the fit that ``fit`` does not set."""
    export: ExportConfig = field(default_factory=ExportConfig)
    """Options for writing the model."""
    limits: InputLimits = field(default_factory=InputLimits)
    """What the tree and the views may refer to, and how large they may be."""

    def __post_init__(self) -> None:
        if self.fit.preset == "thesis" and self.views.elevations is None:
            object.__setattr__(self, "views", replace(self.views, elevations=RING))
        if self.fit.light == "maps" and not self.views.suns:
            object.__setattr__(self, "views", replace(self.views, suns=1))

    def check(self, *, mesh: bool, rendered: bool, blender: bool) -> None:
        """Check all options together, before a folder is made or a tree is grown or rendered.

        Parameters
        ----------
        mesh
            Whether the triangles of a mesh place the billboards.
        rendered
            Whether the views are those of ``views``, and not given.
        blender
            Whether Blender has to render them here.

        Raises
        ------
        MissingFileError, InputError
            If options contradict each other, the device of the fit or of Blender is not available, a package is not installed, or the
            views would not suffice for the fit.
        """
        self.export.check()
        check_material(self.export, maps=self.fit.light == "maps")
        if self.fit.translucency and not self.export.program.transmits:
            fail("translucency", "only Babylon.js shows it", "add --profile babylon, or leave out --translucency")
        self.limits.check()
        if rendered:
            self.limits.at_most("max_input_pixels", "size", "a view", self.views.size**2, "pixels")
            self.limits.at_most("max_input_frames", "count", "the tree", self.views.count, "views")
        if self.budget.vertices is not None and self.export.split:
            fail("split", "its pieces have more vertices than a budget of vertices allows", "leave out --split or --vertices")
        if self.budget.given:
            if self.fit.light == "maps":
                fail("budget", "it does not count the bytes of maps", "leave out --budget, or fit with --light baked")
            check_budget(self.fit, self.budget)
        else:
            self.fit.resolve()
        check_device(self.fit)
        if rendered:
            check_planned_views(self.views, self.fit, mesh=mesh, budget=self.budget.given)
        if blender:
            check_blender(self.views)

    @property
    def exports(self) -> tuple[ExportConfig, ...]:
        """The options of the export, with the outline that the results call for unless one is given.

        A budget of bytes has several: the first that fits is exported, and the choice and the fit count with the last. A budget of vertices
        has hulls of 4 corners, which no profile splits. The preset ``thesis`` has rectangles and no mip levels.
        """
        if self.fit.preset == "thesis":
            return (replace(self.outlined, mipmaps=False) if self.export.mipmaps is None else self.outlined,)
        if self.budget.vertices is not None:
            return (replace(self.export.compact(4), split=False),)
        return (self.export,) if self.budget.bytes is None else self.export.outlines()

    @property
    def outlined(self) -> ExportConfig:
        """The options of the export without a budget, with rectangles for the preset ``thesis`` unless an outline is given."""
        return self.export.comparable() if self.fit.preset == "thesis" else self.export


@dataclass(frozen=True)
class RunResult:
    """The results of a run."""

    folder: Path
    """The run's folder."""
    cloud: BillboardCloud
    """The fitted billboards."""
    report: Report
    """Their score on the held-out views."""
    skipped: tuple[str, ...]
    """The names of the stages whose results were current."""
    missed: float | None = None
    """The target PSNR in dB, if the trials of the budget did not reach it on the validation views."""
    bound: int | None = None
    """The largest number of billboards that was allowed, if it keeps the model below half of the bytes of the budget."""


@dataclass(frozen=True)
class Fitted:
    """The billboards of a run and their model."""

    cloud: BillboardCloud
    """The fitted billboards."""
    model: ShippedModel
    """What is exported of them."""
    missed: float | None
    """As in :class:`RunResult`."""
    bound: int | None
    """As in :class:`RunResult`."""
    seconds: float
    """Seconds that the choice of the model's outline took."""


@dataclass(frozen=True)
class Prepared:
    """A run's folder with the tree and its views, whose pictures were checked."""

    record: Record
    """The record of the folder."""
    tree: TreeFile | None
    """The mesh that places billboards. ``None`` if there is none, or if only Blender can read it."""
    views: ViewDataset
    """The views."""


def run(
    source: str | Path | TreeFile | None,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    on_progress: OnProgress | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> RunResult:
    """Convert a tree, or views of one, to a billboard cloud with model files, scores and a report.

    Writes ``tree.glb`` (if it grows the tree), ``views/`` (from a tree), ``cloud.safetensors``, ``model.glb``, ``model.obj/.mtl/.png``,
    ``metrics.json``, ``comparison.png``, ``report.html``, ``loss.png``, ``loss.csv`` and ``run.json`` (resolved configuration, versions,
    seeds, seconds). A stage is skipped if its inputs and its outputs have not changed. A killed run continues where it stopped.

    Parameters
    ----------
    source
        The file of a tree, a folder of views, or ``None`` to grow a tree.
    out
        The run's folder. It is created if it does not exist.
    config
        The options of all stages.
    on_progress
        Called with the progress of each stage.
    on_step
        Called after every step of the fit, as by :func:`~bbfit.fitting.loop.fit`.

    Raises
    ------
    InputError, OSError
        If an input cannot be used or the folder cannot be written to. Earlier results stay as they were.
    """
    config, on_progress = config or RunConfig(), on_progress or silent
    with prepare(source, out, config, on_progress=on_progress) as prepared:
        return _finished(prepared, config, on_progress, on_step)


def _finished(prepared: Prepared, config: RunConfig, on_progress: OnProgress, on_step: Callable[[Step], None] | None) -> RunResult:
    """The stages of a run after its views."""
    record, views = prepared.record, prepared.views
    made = fitted(prepared, config, on_progress=on_progress, on_step=on_step)
    model, max_bytes = made.model, config.budget.most_bytes
    later = ("export", "evaluate", "report", *(() if config.budget.given else ("budget",)))
    seconds = {name: spent for name, spent in record.seconds.items() if name not in later}
    seconds["export"] = made.seconds
    grown = record.head["config"]["species"]
    subject, original = subject_of(views, record.folder / "cloud.safetensors", grown and grown["name"]), original_tree(views, prepared.tree)
    record.run(evaluate_stage(record.folder, model, views, original, subject, seconds, max_bytes), on_progress)
    report = Report.load(record.folder / "metrics.json")
    record.run(export_stage(record.folder, model, report, max_bytes), on_progress)
    record.run(report_stage(record.folder, report, model, views, _facts(record)), on_progress)
    record.finish()
    return RunResult(record.folder, made.cloud, report, tuple(record.skipped), made.missed, made.bound)


def fitted(
    prepared: Prepared, config: RunConfig, *, on_progress: OnProgress | None = None, on_step: Callable[[Step], None] | None = None
) -> Fitted:
    """Run the stages of :func:`run` that make billboards of prepared views."""
    record, tree, views, on_progress = prepared.record, prepared.tree, prepared.views, on_progress or silent
    folder, fit_config, missed = record.folder, config.fit, None
    exports = [export_config(views, export) for export in config.exports]
    record.head["config"]["export"]["up"] = exports[-1].up
    if config.budget.given:
        record.run(budget_stage(folder, views, tree, fit_config, config.budget, exports[-1]), on_progress)
        fit_config, met = read_choice(folder, config.fit)
        missed = None if met else config.budget.target_psnr
        record.head["config"]["fit"] = _plain(asdict(fit_config))  # the fit uses the chosen configuration
    max_bytes = config.budget.most_bytes
    limit = None if max_bytes is None else (max_bytes, exports[-1])
    record.run(fit_stage(folder, views, tree, fit_config, limit, on_step), on_progress)
    cloud = BillboardCloud.load(folder / "cloud.safetensors")
    started = time.perf_counter()
    if max_bytes is None:
        model = shipped_model(cloud, exports[-1], on_progress=on_progress)
    else:
        model = finest_within_bytes(cloud, exports, max_bytes, on_progress)
        record.head["config"]["export"] |= {"outline": model.config.outline, "corners": model.config.corners}
    spare = max_bytes is not None and 2 * len(model.glb) < max_bytes
    bound = fit_config.most_billboards if spare and fit_config.billboards == fit_config.most_billboards else None
    return Fitted(cloud, model, missed, bound, time.perf_counter() - started)


@contextlib.contextmanager
def prepare(
    source: str | Path | TreeFile | None, out: str | Path, config: RunConfig | None = None, *, on_progress: OnProgress | None = None
) -> Iterator[Prepared]:
    """Run the first stages of :func:`run`, with the same arguments and errors: grow a tree if none is given, and render its views.

    No other process can write to the folder until the context ends.
    """
    config, on_progress = config or RunConfig(), on_progress or silent
    config.export.check()  # before a large tree is read
    path = source.path if isinstance(source, TreeFile) else source
    views_folder = Path(path) if path is not None and Path(path).is_dir() else None
    if config.tree is not None and views_folder is None:
        fail("tree", f"{config.tree} is given together with {path or 'a tree to grow'}", "give a mesh only with a folder of views")
    if source is None:
        species = load_species(config.species or (None if config.grow.species_file else "quaking_aspen"), config.grow.species_file)
        head = _head(species.name, config, grown=species, rendered=True)
        config.check(mesh=True, rendered=True, blender=needs_blender(Path(out)))
        with _record(out, head, config, [config.grow.species_file, config.views.hdri]) as record:
            tree = _grown(record, grow_stage(record.folder, species, config.grow), config.limits, on_progress)
            yield _rendered(record, tree, config, on_progress)
    elif config.species is not None or replace(config.grow, seed=0) != RunConfig().grow:
        fail("run", f"{path} is given, so no tree is grown", "omit the species and the options for growing")
    elif views_folder is not None:
        views = ViewDataset.load(views_folder, limits=config.limits)  # every fit and every score have one split
        mesh = None if config.tree is None else TreeFile.open(config.tree, config.limits)
        if mesh is not None:
            mesh.check_is_mesh()
        config.check(mesh=mesh is not None, rendered=False, blender=False)
        check_training(views.train.cameras, config.fit, mesh=mesh is not None, budget=config.budget.given)
        views.check()
        head = _head(str(views_folder.resolve()), config, rendered=False)
        with _record(out, head, config, [*views.train.paths, *views.test.paths, *(mesh.files if mesh else ())]) as record:
            yield Prepared(record, mesh, views)
    else:
        tree = TreeFile.open(source, config.limits)
        config.check(mesh=tree.is_mesh, rendered=True, blender=needs_blender(Path(out)))
        head = _head(str(tree.path.resolve()), config, rendered=True)
        with _record(out, head, config, [*tree.files, config.views.hdri]) as record:
            yield _rendered(record, tree, config, on_progress)


@contextlib.contextmanager
def _record(out: str | Path, head: dict[str, Any], config: RunConfig, inputs: Iterable[Path | None]) -> Iterator[Record]:
    """The record of a run's folder, which no other process can write to until the context ends, and which has room for the results."""
    outputs: dict[str, tuple[str, ...]] = {"grow": GROW_OUTPUTS} if head["config"]["grow"] else {}
    outputs |= {
        "fit": FIT_OUTPUTS,
        "export": export_outputs(config.export, normals=config.fit.light == "maps"),
        "evaluate": EVALUATE_OUTPUTS,
        "report": REPORT_OUTPUTS,
    }
    outputs |= {"budget": BUDGET_OUTPUTS} if config.budget.given else {}
    with claimed_folder("out", out) as folder:
        record = Record(folder, head, [path for path in inputs if path is not None])
        record.check(outputs)
        check_room(folder, _ROOM)
        yield record


def _rendered(record: Record, tree: TreeFile, config: RunConfig, on_progress: OnProgress) -> Prepared:
    """Render the views of a run's tree."""
    record.run(views_stage(record.folder, tree, config.views), on_progress)
    views = ViewDataset.load(record.folder / "views", limits=config.limits)
    views.check()
    return Prepared(record, tree if tree.is_mesh else None, views)


def needs_blender(folder: Path) -> bool:
    """Whether Blender has to render views for a folder: the transforms, which are written last, are not there."""
    return not (folder / "views" / TEST_FILE).is_file()


def _grown(record: Record, stage: Stage, limits: InputLimits, on_progress: OnProgress) -> TreeFile:
    """Grow the tree of a run in its folder, which must not contain views of another tree."""
    path, earlier = record.folder / "tree.glb", record.stages.get(stage.name)
    is_other = earlier["inputs"] != stage.key if earlier else not path.exists()
    if is_other and (record.folder / "views").exists():
        fail("out", f"{record.folder} contains the views of another tree", "choose another folder for this one")
    record.run(stage, on_progress)
    return TreeFile.open(path, limits)


def _head(source: str, config: RunConfig, *, grown: Species | None = None, rendered: bool) -> dict[str, Any]:
    """The fields of a run's record besides its stages."""
    resolved = {
        "species": None if grown is None else asdict(grown),
        "grow": None if grown is None else asdict(config.grow),
        "tree": config.tree and str(config.tree.resolve()),
        "views": asdict(config.views) if rendered else None,
        "fit": asdict(config.fit.resolve()),
        "budget": asdict(config.budget),
        "export": asdict(config.exports[-1]),
    }
    seeds = ({} if grown is None else {"grow": config.grow.seed}) | {"views": config.views.seed, "fit": config.fit.seed}
    return record_head(source, _plain(resolved), seeds)


def _facts(record: Record) -> dict[str, Any]:
    """The parts of the record that the report shows: options and their defaults, seeds and versions."""
    head = record.head
    defaults = RunConfig(fit=FitConfig(preset=head["config"]["fit"]["preset"]).resolve())
    stages = ("grow", "views", "fit", "budget", "export")
    return {
        "source": Path(head["source"]).name,
        "options": {stage: options for stage in stages if (options := head["config"][stage]) is not None},
        "defaults": _plain(asdict(defaults)),
        "seeds": head["seeds"],
        "versions": head["versions"],
    }


def _plain(value: Any) -> Any:
    """A configuration as JSON, paths as text."""
    return json.loads(json.dumps(value, default=str))
