"""The main job: grow -> views -> (budget ->) fit -> export -> evaluate -> report, each stage done again only when its inputs change."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Protocol

from bbfit.blender.config import ViewsConfig
from bbfit.blender.meshes import MESH_SUFFIXES, tree_mesh
from bbfit.blender.sources import check_tree
from bbfit.budget.choice import Choice, Trial, choose, within_bytes
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError, check_file, fail
from bbfit.evaluation.report import Report
from bbfit.evaluation.scoring import OriginalTree, evaluate
from bbfit.evaluation.sizes import score_sizes
from bbfit.exporting.cards import Cards
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.drawing import draw_cards
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import overdraw
from bbfit.exporting.model import as_shipped, shipped_cards, shows_from, write_model
from bbfit.files import output_folder, read_json, write_bytes, write_json
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import Step, fit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.records import Record, hash_file, hash_inputs, plain, record_head
from bbfit.rendering.dispatch import render
from bbfit.reporting.html import RunFacts, report_page
from bbfit.reporting.plots import Cost, comparison_picture, loss_plot, pareto_plot
from bbfit.trees.config import GrowConfig
from bbfit.trees.growth import grow
from bbfit.trees.species import Species, load_species
from bbfit.trees.tree_file import write_tree
from bbfit.views import ViewDataset, ViewSet

# The parts of a configuration that are options of stages.
_STAGES = ("grow", "views", "fit", "budget", "export")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Options of every stage."""

    species: str | None = None
    """What to grow when no tree is given: a quaking aspen if left open, or the one species in ``grow.species_file``."""
    tree: Path | None = None
    """The mesh that a given folder of views shows, to place billboards by; left out, they are placed by the views alone."""
    grow: GrowConfig = field(default_factory=lambda: GrowConfig(detail=0.5))
    """Growing a tree, at moderate detail."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """Rendering the tree."""
    fit: FitConfig = field(default_factory=FitConfig)
    """Fitting the billboards."""
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    """What the result may cost; decides over what ``fit`` leaves open."""
    export: ExportConfig = field(default_factory=ExportConfig)
    """Writing the model."""


class Progress(Protocol):
    """What long work tells while it runs."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """``done`` of ``total`` units of ``stage`` are finished; ``note`` is a short text such as the loss."""


@dataclass(frozen=True)
class RunResult:
    """What a run made."""

    folder: Path
    """Where everything lies."""
    cloud: BillboardCloud
    """The fitted billboards."""
    report: Report
    """Their score on the held-out views."""
    skipped: tuple[str, ...]
    """Stages whose results stood."""
    missed: float | None = None
    """The target PSNR, if the trials for the budget did not reach it on validation views."""


def run(
    source: str | Path | None,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    on_progress: Progress | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> RunResult:
    """Turn a tree, or views of one, into a measured billboard cloud with its model files.

    Writes ``tree.glb`` (when none is given), ``views/`` (from a tree), ``cloud.safetensors``, ``model.glb``, ``model.obj/.mtl/.png``,
    ``metrics.json``, ``comparison.png``, ``report.html``, ``loss.png``, ``loss.csv`` and ``run.json`` (resolved configuration, versions,
    seeds, seconds).
    A stage whose results stand unchanged and whose inputs are the same is skipped; a killed run goes on where it stopped.

    Parameters
    ----------
    source : a tree's file, a folder of views, or ``None`` to grow a tree.
    out : the run's folder, made if need be.
    on_progress : told how far each stage is.
    on_step : called after every step of the fit, as by :func:`~bbfit.fitting.loop.fit`.

    Raises
    ------
    InputError, OSError
        if an input cannot be used or the folder cannot be written to; earlier results stay as they were.
    """
    config = config or RunConfig()
    tell = on_progress or (lambda stage, done, total, note="": None)
    record, tree, views = _prepare(source, out, config, tell)
    views.train.check()
    views.test.check()
    asked, missed, exported = config.fit, None, export_config(views, config.export)
    if config.budget.given:
        choice = _choose(views, tree, record, config, exported, tell)
        asked, missed = choice.config, None if choice.met else config.budget.target_psnr
        record.head["config"]["fit"] = plain(asdict(asked))  # what is fitted where that was left to a budget
    cloud = _fit(views, tree, record, asked, (config.budget.most_bytes, exported), tell, on_step)
    cards = cache(lambda: shipped_cards(cloud, exported))
    _export(cards, record, exported, tell)
    shipped = as_shipped(cloud, exported)
    report = _evaluate(shipped, cards, views, tree, record, tell)
    _page(report, shipped, cards, views, exported, record, tell)
    return RunResult(record.folder, cloud, report, tuple(record.skipped), missed)


def prepare(
    source: str | Path | None, out: str | Path, config: RunConfig | None = None, *, on_progress: Progress | None = None
) -> tuple[Path | None, ViewDataset]:
    """The first stages of :func:`run`, with the same arguments and errors: grow a tree if none is given, and render its views.

    Returns
    -------
    the mesh to place billboards by, if there is one that can be read without Blender, and the views.
    """
    tell = on_progress or (lambda stage, done, total, note="": None)
    return _prepare(source, out, config or RunConfig(), tell)[1:]


def _prepare(source: str | Path | None, out: str | Path, config: RunConfig, tell: Progress) -> tuple[Record, Path | None, ViewDataset]:
    tree = config.tree
    if tree is not None and (source is None or not Path(source).is_dir()):
        fail("tree", f"{tree} is given beside {source or 'a tree to grow'}", "a mesh goes with a folder of views")
    if source is None:
        species = load_species(config.species or (None if config.grow.species_file else "quaking_aspen"), config.grow.species_file)
        record = _record(output_folder("out", out), species, config)
        tree = _grow(species, record, config.grow, tell)
        return record, tree, _render(tree, record, config.views, tell)
    source = Path(source)
    if config.species is not None or replace(config.grow, seed=0) != RunConfig().grow:
        fail("run", f"{source} is given, so that no tree is grown", "leave out the species and the options of growing one")
    # What cannot be used is refused before a folder is made for it.
    given = ViewDataset.load(source, seed=config.fit.seed) if source.is_dir() else None
    if mesh := source if given is None else tree:
        check_tree(mesh)
    record = _record(output_folder("out", out), source, config)
    if given is not None:
        return record, tree, given
    views = _render(source, record, config.views, tell)
    readable = source.suffix.lower() in MESH_SUFFIXES  # else only Blender can read it; the views tell enough
    return record, source if readable else None, views


def with_model(
    report: Report, cloud: BillboardCloud, cards: Cards, views: ViewSet, *, on_size: Callable[[int, int], None] | None = None
) -> Report:
    """The report with what a model file has and shows in pictures of 1 to 1/16 of the held-out views' size.

    ``cloud`` and ``cards`` are what ships (:func:`~bbfit.exporting.model.as_shipped`, :func:`~bbfit.exporting.model.shipped_cards`).
    Without mip levels they show the same, and the cloud is drawn faster. ``on_size`` is called after each size with the number of sizes
    done and of all.
    """
    vertices = replace(report.vertices, model=cards.vertex_count)
    sizes = score_sizes(lambda camera: draw_cards(cards, camera) if cards.chain else render(cloud, camera), views, on_size=on_size)
    return replace(report, vertices=vertices, overdraw=overdraw(cards, shows_from(cards)), sizes=sizes)


def original_tree(views: ViewDataset, tree: Path | None = None) -> OriginalTree:
    """Vertices and bytes of the tree that views were rendered from: what the folder's ``views.json`` says, else what its mesh has."""
    known = views.request.get("tree")
    counts = {name: known.get(name) for name in ("vertices", "bytes")} if isinstance(known, dict) else {}
    if not any(counts.values()) and tree is not None:
        counts = {"vertices": len(tree_mesh(tree).vertices), "bytes": tree.stat().st_size}
    return OriginalTree(**{name: value for name, value in counts.items() if isinstance(value, int)})


def export_config(views: ViewDataset, config: ExportConfig) -> ExportConfig:
    """``config`` with the up axis of the file that the views were rendered from, where that is left open and known."""
    tree = views.request.get("tree")
    known = config.up == "auto" and isinstance(tree, dict) and tree.get("up_axis") == "z"
    return replace(config, up="z") if known else config


def _record(folder: Path, source: Path | Species, config: RunConfig) -> Record:
    """The record of a run in a folder, with its resolved configuration, seeds, versions and machine."""
    grown = asdict(source) if isinstance(source, Species) else None
    resolved = {
        "species": grown,
        "grow": asdict(config.grow) if grown else None,
        "tree": str(config.tree.resolve()) if config.tree else None,
        "views": None if isinstance(source, Path) and source.is_dir() else asdict(config.views),
        "fit": asdict(config.fit.resolve()),
        "budget": asdict(config.budget),
        "export": asdict(config.export),
    }
    seeds = ({"grow": config.grow.seed} if grown else {}) | {"views": config.views.seed, "fit": config.fit.seed}
    head = record_head(source.name if isinstance(source, Species) else str(source.resolve()), resolved, seeds)
    return Record(folder, head)


def _grow(species: Species, record: Record, config: GrowConfig, tell: Progress) -> Path:
    path = record.folder / "tree.glb"
    inputs = hash_inputs("grow", asdict(species), config.seed, config.detail, config.leaves)
    if not record.stands("grow", inputs):
        earlier = record.stages.get("grow")
        if (record.folder / "views").exists() and (earlier["inputs"] != inputs if earlier else not path.exists()):
            fail("out", f"{record.folder} holds the views of another tree", "choose another folder for this one")
        tell("grow", 0, 1)
        begun = time.perf_counter()
        scene = grow(species, seed=config.seed, detail=config.detail, leaves=config.leaves, max_vertices=config.max_vertices)
        write_tree(scene, path)
        record.done("grow", inputs, [path.name], time.perf_counter() - begun)
        tell("grow", 1, 1)
    return path


def _render(tree: Path, record: Record, config: ViewsConfig, tell: Progress) -> ViewDataset:
    from bbfit.blender.views_folder import render_views

    standing: list[int] = []

    def on_progress(done: int, total: int) -> None:
        standing.append(done)
        tell("views", done, total)

    folder = render_views(tree, record.folder / "views", config, on_progress=on_progress)
    if standing[0] == config.count:
        record.skipped.append("views")
    views = ViewDataset.load(folder)
    seconds = views.request.get("seconds")
    record.done("views", views.fingerprint, [], float(seconds) if isinstance(seconds, int | float) else 0.0)
    return views


def _choose(views: ViewDataset, tree: Path | None, record: Record, config: RunConfig, export: ExportConfig, tell: Progress) -> Choice:
    """What the budget's trials speak for; ``pareto.json`` holds those done, so that none is done twice."""
    path, budget = record.folder / "pareto.json", config.budget
    mesh = None if tree is None else hash_file(check_file("tree", tree))
    asked = {**asdict(config.fit), "checkpoint_every": None}
    inputs = hash_inputs("budget", asked, asdict(budget), asdict(export), views.train.fingerprint, mesh)
    stands = record.stands("budget", inputs)
    try:
        earlier = read_json("budget", path) if path.is_file() else {}
    except InputError:
        earlier = {}  # a damaged file only costs its trials
    earlier = earlier if isinstance(earlier, dict) else {}
    known = (
        [Trial(**{f.name: trial[f.name] for f in fields(Trial)}) for trial in earlier["trials"]] if earlier.get("inputs") == inputs else []
    )
    begun = time.perf_counter()

    def on_trial(trials: list[Trial], total: int) -> None:
        write_json(path, {"inputs": inputs, "trials": [asdict(trial) for trial in trials]})
        last = trials[-1]
        tell("budget", len(trials), max(total, len(trials)), f"{last.vertices} vertices {last.psnr:.2f} dB")

    if not stands:
        tell("budget", 0, 1)
    choice = choose(views, config.fit, budget, tree=tree, export=export, known=known, on_trial=None if stands else on_trial)
    if not stands:
        limits = {name: value for name, value in asdict(budget).items() if value}
        write_json(path, {"inputs": inputs, "budget": limits, **choice.to_json()})
        cost: Cost = "bytes" if budget.bytes else "texels" if budget.texels else "vertices"
        pareto_plot(choice, path.with_suffix(".png"), cost=cost)
        record.done("budget", inputs, [path.name, "pareto.png"], time.perf_counter() - begun)
    return choice


def _fit(
    views: ViewDataset,
    tree: Path | None,
    record: Record,
    config: FitConfig,
    limit: tuple[int | None, ExportConfig],
    tell: Progress,
    watch: Callable[[Step], None] | None,
) -> BillboardCloud:
    """``limit`` is the most bytes that the model may have, and how it will be exported."""
    config, path = config.resolve(), record.folder / "cloud.safetensors"
    if config.placement == "even":
        tree = None  # it has no say
    mesh = None if tree is None else hash_file(check_file("tree", tree))
    inputs = hash_inputs("fit", {**asdict(config), "checkpoint_every": None}, views.train.fingerprint, mesh, limit if limit[0] else None)
    if record.stands("fit", inputs):
        return BillboardCloud.load(path)

    def on_step(step: Step) -> None:
        tell("fit", step.index, step.total, f"loss {step.loss:.5f}")
        if watch is not None:
            watch(step)

    checkpoint = record.folder / "fit.checkpoint"
    result = fit(views, config, tree=tree, checkpoint=checkpoint, on_step=on_step, on_place=lambda done, total: tell("place", done, total))
    cloud = within_bytes(result.cloud, *limit)
    cloud.save(path)
    write_bytes(record.folder / "loss.csv", _loss_table(result.losses))
    loss_plot(result.losses, record.folder / "loss.png")
    record.done("fit", inputs, [path.name, "loss.csv", "loss.png"], result.seconds)
    checkpoint.unlink(missing_ok=True)
    return cloud


def _export(cards: Callable[[], Cards], record: Record, config: ExportConfig, tell: Progress) -> None:
    inputs = hash_inputs("export", asdict(config.resolve()), hash_file(record.folder / "cloud.safetensors"))
    if record.stands("export", inputs):
        return
    begun, written = time.perf_counter(), list[Path]()
    for step, suffix in enumerate((".glb", ".obj"), 1):
        written += write_model(cards(), record.folder / f"model{suffix}", config)
        tell("export", step, 2)
    record.done("export", inputs, [path.name for path in written], time.perf_counter() - begun)


def _evaluate(
    cloud: BillboardCloud, cards: Callable[[], Cards], views: ViewDataset, tree: Path | None, record: Record, tell: Progress
) -> Report:
    """The score of the cloud in the alpha mode that its model has."""
    path = record.folder / "metrics.json"
    results = [hash_file(record.folder / name) for name in ("cloud.safetensors", "model.glb")]
    inputs = hash_inputs("evaluate", results, asdict(cloud.alpha), views.fingerprint, None if tree is None else hash_file(tree))
    if record.stands("evaluate", inputs):
        return Report.load(path)
    begun = time.perf_counter()
    report = evaluate(
        cloud,
        views.test,
        original=original_tree(views, tree),
        model_bytes=(record.folder / "model.glb").stat().st_size,
        seconds={name: seconds for name, seconds in record.seconds.items() if name not in ("evaluate", "report")},
        on_view=lambda done, total: tell("evaluate", done, total),
    )
    report = with_model(report, cloud, cards(), views.test, on_size=lambda done, total: tell("sizes", done, total))
    report.save(path)
    comparison_picture(cloud, views.test, record.folder / "comparison.png")
    record.done("evaluate", inputs, [path.name, "comparison.png"], time.perf_counter() - begun)
    return report


def _page(
    report: Report,
    cloud: BillboardCloud,
    cards: Callable[[], Cards],
    views: ViewDataset,
    export: ExportConfig,
    record: Record,
    tell: Progress,
) -> None:
    """``report.html``, made anew when what it shows has changed."""
    path, head = record.folder / "report.html", record.head
    pareto = record.folder / "pareto.png" if "budget" in record.stages and any(head["config"]["budget"].values()) else None
    sources = [record.folder / name for name in ("cloud.safetensors", "metrics.json", "loss.csv")] + ([pareto] if pareto else [])
    told = {name: head[name] for name in ("source", "config", "seeds")}
    inputs = hash_inputs("report", [hash_file(source) for source in sources], told, views.fingerprint)
    if record.stands("report", inputs):
        return
    begun = time.perf_counter()
    tell("report", 0, 1)
    usual = RunConfig(fit=FitConfig(preset=head["config"]["fit"]["preset"]))
    facts = RunFacts(
        source=Path(head["source"]).name,
        asked={stage: options for stage in _STAGES if (options := head["config"][stage]) is not None},
        usual=plain(asdict(replace(usual, fit=usual.fit.resolve()))),
        seeds=head["seeds"],
        versions=head["versions"],
        losses=[float(row["loss"]) for row in csv.DictReader((record.folder / "loss.csv").read_text().splitlines())],
        pareto=pareto.read_bytes() if pareto else None,
        cut_up=bool(export.resolve().split),
    )
    readable = replace(export, textures="webp", fallback=False, mip_files=False)  # by browsers
    page = report_page(report, cloud, views.test, facts, glb_bytes(cards(), readable))
    write_bytes(path, page.encode())
    record.done("report", inputs, [path.name], time.perf_counter() - begun)
    tell("report", 1, 1)


def _loss_table(losses: list[float]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["step", "loss"])
    writer.writerows(enumerate(losses, 1))
    return text.getvalue().encode()
