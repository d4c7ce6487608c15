"""The stages after the fit: export, evaluation, and report."""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bbfit.evaluation.report import Report, Subject
from bbfit.evaluation.scoring import OriginalTree, evaluate_model
from bbfit.exporting.config import Encoding, ExportConfig
from bbfit.exporting.encoders import WEBP_SIDE
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.model import ShippedModel
from bbfit.files import write_bytes
from bbfit.outputs import remove_results
from bbfit.provenance import VERSIONS, digest_file
from bbfit.reporting.html import RunFacts, report_page
from bbfit.reporting.plots import comparison_picture
from bbfit.stages.describing import described
from bbfit.stages.stage import OnProgress, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

EVALUATE_OUTPUTS = ("metrics.json", "comparison.png")
REPORT_OUTPUTS = ("report.html",)


def export_outputs(config: ExportConfig, *, normals: bool = False) -> tuple[str, ...]:
    """The files that :func:`export_stage` writes, with ``normals`` for a cloud with maps."""
    optional = [*(["model_normals.png"] if normals else []), *(["model_mip[0-9]*.png"] if config.mip_files else [])]
    return ("model.glb", "model.obj", "model.mtl", "model.png", *optional)


def export_stage(folder: Path, model: ShippedModel, report: Report, most_bytes: int | None = None) -> Stage:
    """Write ``model.glb`` and ``model.obj`` with its material and texture.

    The GLB contains names and facts of the ``report`` on the model, unless it would have more than ``most_bytes`` bytes with them.
    """
    model = shipped_with_facts(model, report, most_bytes)
    outputs = export_outputs(model.config, normals=model.cloud.surface is not None)

    def work(on_progress: OnProgress) -> None:
        written = list[Path]()
        for step, suffix in enumerate((".glb", ".obj"), 1):
            written += model.save(folder / f"model{suffix}")
            on_progress("export", step, 2)
        remove_results(folder, *(name for name in outputs if "*" in name), but=written)  # mip levels of an earlier, larger atlas

    return Stage("export", (model.config, digest_file(folder / "cloud.safetensors"), model.description), outputs, work)


def shipped_with_facts(model: ShippedModel, report: Report, most_bytes: int | None) -> ShippedModel:
    """The model with the facts of a report, or without if they would make it larger than ``most_bytes``."""
    with_facts = described(model, report)
    return model if most_bytes is not None and len(with_facts.glb) > most_bytes else with_facts


def completed(report: Report, model: ShippedModel, subject: Subject, most_bytes: int | None = None) -> Report:
    """The report with its subject, and the size of the model's file with its facts. ``most_bytes`` is as in :func:`export_stage`."""
    report = replace(report, subject=subject)
    return replace(report, bytes=replace(report.bytes, model=len(shipped_with_facts(model, report, most_bytes).glb)))


def evaluate_stage(
    folder: Path,
    model: ShippedModel,
    views: ViewDataset,
    original: OriginalTree,
    subject: Subject,
    seconds: Mapping[str, float],
    most_bytes: int | None = None,
) -> Stage:
    """Make the model, score it on the held-out views, and write ``metrics.json`` and ``comparison.png``.

    ``folder`` contains the outputs of the fit. ``original`` is the tree, as far as it is known. ``seconds`` are those of the earlier
    stages, which the report contains; under ``export`` those that making the model has taken so far. ``most_bytes`` is as in
    :func:`export_stage`.
    """

    def work(on_progress: OnProgress) -> None:
        started, progress = time.perf_counter(), partial(on_progress, "evaluate")
        assert model.glb  # makes it
        spent = {**seconds, "export": seconds.get("export", 0.0) + time.perf_counter() - started}
        report = evaluate_model(model, views.test, original=original, turned=views.turned, lit=views.lit_test, on_progress=progress)
        report = replace(report, seconds={**spent, **report.seconds})
        completed(report, model, subject, most_bytes).save(folder / "metrics.json")
        comparison_picture(model, views.test, folder / "comparison.png")

    inputs = (subject, model.config, VERSIONS["export"], model.cloud.alpha, views.full_fingerprint, original, most_bytes)
    return Stage("evaluate", inputs, EVALUATE_OUTPUTS, work)


def report_stage(
    folder: Path,
    report: Report,
    model: ShippedModel,
    views: ViewDataset,
    facts: Mapping[str, Any],
) -> Stage:
    """Write ``report.html`` with the score of ``model`` and its pictures beside the held-out views.

    ``folder`` contains the outputs of the fit and of the evaluation. ``facts`` are the fields of
    :class:`~bbfit.reporting.html.RunFacts` that come from the record of the run.
    """
    pareto = folder / "pareto.png" if any(facts["options"].get("budget", {}).values()) else None

    def work(on_progress: OnProgress) -> None:
        on_progress("report", 0, 1)
        losses = [float(row["loss"]) for row in csv.DictReader((folder / "loss.csv").read_text().splitlines())]
        picture = pareto.read_bytes() if pareto else None
        textures: Encoding = "webp" if max(model.cards.atlas.image.shape) <= WEBP_SIDE else "png"
        readable = replace(model.config, textures=textures, fallback=False, mip_files=False, quantized=True)  # browsers read these
        known = RunFacts(**facts, losses=losses, pareto=picture)
        page = report_page(report, model, views.test, known, glb_bytes(model.cards, readable), views.lit_test)
        write_bytes(folder / "report.html", page.encode(errors="backslashreplace"))
        on_progress("report", 1, 1)

    shown = [folder / name for name in ("cloud.safetensors", "metrics.json", "loss.csv")] + ([pareto] if pareto else [])
    described = {name: value for name, value in facts.items() if name != "versions"}
    inputs = ([digest_file(file) for file in shown], described, views.full_fingerprint)
    return Stage("report", inputs, REPORT_OUTPUTS, work)


def original_tree(views: ViewDataset, tree: TreeFile | None = None) -> OriginalTree:
    """Vertices and bytes of the tree in the views: as recorded in their request, or else those of the mesh ``tree``."""
    known = views.request.tree if views.request else None
    if known and (known.vertices or known.bytes):
        return OriginalTree(known.vertices, known.bytes)
    return OriginalTree() if tree is None else OriginalTree(tree.vertices, tree.bytes)


def export_config(views: ViewDataset, config: ExportConfig) -> ExportConfig:
    """``config`` with the up axis of the tree's file instead of ``"auto"``, if the views record it."""
    z_up = config.up == "auto" and views.request is not None and views.request.tree.up_axis == "z"
    return replace(config, up="z") if z_up else config
