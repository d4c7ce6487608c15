"""What a model file says about its tree, its light and its score, from the report of its run."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from bbfit.checks import InputError
from bbfit.evaluation.distances import SCREEN
from bbfit.evaluation.report import Report, Subject
from bbfit.exporting.description import Description
from bbfit.exporting.model import ShippedModel
from bbfit.geometry.light import Light
from bbfit.provenance import digest_file
from bbfit.views.dataset import ViewDataset

# Names of files and folders that say nothing about a tree.
_NO_NAMES = ("", "views", "images", "train", "test", "tree", "cloud", "model", "data", "runs")


def subject_of(views: ViewDataset, cloud: Path, name: str | None = None) -> Subject:
    """What a report on a cloud is about, with the tree's ``name``, by default that of the file that the views show."""
    tree = views.request.tree if views.request else None
    light = views.test.light
    sun = {} if light is None else _sun(light)
    named = name or plain_name(*([Path(tree.name)] if tree and tree.name else []))
    bounds = None if tree is None or tree.bounds is None else tuple(tuple(map(float, corner)) for corner in tree.bounds)
    return Subject(named, bounds, cloud=digest_file(cloud), **sun)


def plain_name(*paths: Path) -> str:
    """The name of a tree: that of the first file or folder whose name says something, or ``tree``. Bytes that are no text become codes."""
    names = [path.stem.encode(errors="backslashreplace").decode() for path in paths]
    return next((name for name in names if name.lower() not in _NO_NAMES), "tree")


def described(model: ShippedModel, report: Report) -> ShippedModel:
    """The model with the names and facts of a report on it in its GLB."""
    subject, mean, cloud = report.subject, report.mean.over.mean, model.cloud
    light = Subject() if cloud.light is None else Subject(**_sun(cloud.light))
    kind, known = ("baked", subject) if cloud.surface is None else ("maps", light)
    distances = None
    if report.distances is not None:
        distances = {name: value for name, value in asdict(report.distances).items() if name != "silhouette_pixels"}
        distances |= {"screen_height": float(SCREEN.screen_height), "screen_fov_degrees": SCREEN.screen_fov_degrees}
    description = Description(
        name=subject.tree or "tree",
        billboards=len(cloud),
        alpha=cloud.alpha,
        light=kind,
        sun_direction=known.sun_direction,
        sun_strength=known.sun_strength,
        ambient=known.ambient,
        tree_bounds=subject.bounds,
        score={"psnr": mean.psnr, "flip": mean.flip, "views": float(len(report.views))},
        distances=distances,
    )
    return model.described(description)


def described_by_run(model: ShippedModel, cloud: Path) -> ShippedModel:
    """The model of a cloud's file with what is known about it: the score too if ``metrics.json`` beside it is that of the same cloud, in
    the same alpha mode."""
    try:
        report = Report.load(cloud.with_name("metrics.json"))
        if report.subject.cloud == digest_file(cloud):
            model = described(model, report)
            assert model.description is not None
            if (report.alpha.kind, report.alpha.cutoff) == (model.cloud.alpha.kind, model.cloud.alpha.cutoff):
                return model
            return model.described(replace(model.description, score=None, distances=None))
    except InputError:  # none, or of an earlier version
        pass
    kind = "baked" if model.cloud.surface is None else "maps"
    sun = {} if model.cloud.light is None else _sun(model.cloud.light)
    return model.described(Description(plain_name(cloud, cloud.resolve().parent), len(model.cloud), model.cloud.alpha, kind, **sun))


def _sun(light: Light) -> dict[str, Any]:
    """The sun and the sky of the first of some lights."""
    direction = tuple(map(float, light.sun_directions[0]))
    return {"sun_direction": direction, "sun_strength": float(light.sun_strengths[0]), "ambient": float(light.ambients[0])}
