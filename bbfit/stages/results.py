"""The stages from fitted billboards to what people take away: the models, the score, and the report."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bbfit.evaluation.report import Report
from bbfit.evaluation.scoring import OriginalTree, evaluate
from bbfit.evaluation.sizes import score_sizes
from bbfit.exporting.cards import Cards
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.drawing import draw_cards
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import overdraw
from bbfit.exporting.model import shows_from, write_model
from bbfit.files import write_bytes
from bbfit.geometry.cloud import BillboardCloud
from bbfit.provenance import digest_file
from bbfit.rendering.dispatch import render
from bbfit.reporting.html import RunFacts, report_page
from bbfit.reporting.plots import comparison_picture
from bbfit.stages.stage import OnProgress, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewDataset, ViewSet


def export_stage(folder: Path, cards: Callable[[], Cards], config: ExportConfig) -> Stage:
    """Write ``model.glb`` and ``model.obj`` with its material and texture."""

    def work(on_progress: OnProgress) -> None:
        for step, suffix in enumerate((".glb", ".obj"), 1):
            write_model(cards(), folder / f"model{suffix}", config)
            on_progress("export", step, 2)

    inputs = (config.resolve(), digest_file(folder / "cloud.safetensors"))
    names = ("model.glb", "model.obj", "model.mtl", "model.png", *(("model_mip*.png",) if config.mip_files else ()))
    return Stage("export", inputs, names, work)


def evaluate_stage(
    folder: Path,
    cloud: BillboardCloud,
    cards: Callable[[], Cards],
    views: ViewDataset,
    tree: TreeFile | None,
    seconds: Mapping[str, float],
) -> Stage:
    """Score what was exported on the held-out views: ``metrics.json`` and ``comparison.png``.

    ``cloud`` has the alpha mode of the exported model. ``seconds`` are those of the earlier stages.
    """

    def work(on_progress: OnProgress) -> None:
        report = evaluate(
            cloud,
            views.test,
            original=original_tree(views, tree),
            model_bytes=(folder / "model.glb").stat().st_size,
            seconds=seconds,
            on_view=lambda done, total: on_progress("evaluate", done, total),
        )
        report = with_model(report, cloud, cards(), views.test, on_size=lambda done, total: on_progress("sizes", done, total))
        report.save(folder / "metrics.json")
        comparison_picture(cloud, views.test, folder / "comparison.png")

    results = [digest_file(folder / name) for name in ("cloud.safetensors", "model.glb")]
    inputs = (results, cloud.alpha, views.fingerprint, None if tree is None else tree.digest)
    return Stage("evaluate", inputs, ("metrics.json", "comparison.png"), work)


def report_stage(
    folder: Path,
    report: Report,
    cloud: BillboardCloud,
    cards: Callable[[], Cards],
    views: ViewDataset,
    export: ExportConfig,
    facts: Mapping[str, Any],
) -> Stage:
    """Write ``report.html``. ``facts`` are the fields of :class:`~bbfit.reporting.html.RunFacts` that the record of the run holds."""
    pareto = folder / "pareto.png" if any(facts["asked"].get("budget", {}).values()) else None

    def work(on_progress: OnProgress) -> None:
        on_progress("report", 0, 1)
        losses = [float(row["loss"]) for row in csv.DictReader((folder / "loss.csv").read_text().splitlines())]
        picture = pareto.read_bytes() if pareto else None
        readable = replace(export, textures="webp", fallback=False, mip_files=False)  # by browsers
        known = RunFacts(**facts, losses=losses, pareto=picture, cut_up=bool(export.resolve().split))
        page = report_page(report, cloud, views.test, known, glb_bytes(cards(), readable))
        write_bytes(folder / "report.html", page.encode())
        on_progress("report", 1, 1)

    shown = [folder / name for name in ("cloud.safetensors", "metrics.json", "loss.csv")] + ([pareto] if pareto else [])
    described = {name: value for name, value in facts.items() if name != "versions"}
    inputs = ([digest_file(file) for file in shown], described, views.fingerprint)
    return Stage("report", inputs, ("report.html",), work)


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


def original_tree(views: ViewDataset, tree: TreeFile | None = None) -> OriginalTree:
    """Vertices and bytes of the tree that views were rendered from: as their request records them, else those of the mesh."""
    known = views.request.tree if views.request else None
    if known and (known.vertices or known.bytes):
        return OriginalTree(known.vertices, known.bytes)
    return OriginalTree() if tree is None else OriginalTree(tree.vertices, tree.bytes)


def export_config(views: ViewDataset, config: ExportConfig) -> ExportConfig:
    """``config`` with the up axis of the file that the views were rendered from, where that is left open and known."""
    z_up = config.up == "auto" and views.request is not None and views.request.tree.up_axis == "z"
    return replace(config, up="z") if z_up else config
