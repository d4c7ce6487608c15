"""The two kinds of tasks of a sweep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bbfit.fitting.config import FitConfig
from bbfit.pipeline import RunConfig
from bbfit.workers.tasks import Facts


def prepare_tree(inputs: Mapping[str, Path], folder: Path, stages: RunConfig, species: str | None) -> Facts:
    """Grow a tree, or take the input ``tree``, and render its views into ``folder``.

    The inputs also contain ``species_file`` and ``hdri``, if the options of the stages name such files. Raises ``InputError`` or
    ``OSError`` if the tree or an option cannot be used, or a file cannot be written.
    """
    from bbfit.pipeline import prepare

    grow = RunConfig().grow if species is None else replace(stages.grow, species_file=inputs.get("species_file"))
    views = replace(stages.views, hdri=inputs.get("hdri"))
    # Without the options of the runs.
    stages = RunConfig(species=species, grow=grow, views=views, fit=FitConfig(seed=stages.fit.seed), limits=stages.limits)
    with prepare(inputs.get("tree"), folder, stages) as prepared:
        tree = prepared.tree
        return {"mesh": None if tree is None else tree.path.name, "views": len(prepared.views.train) + len(prepared.views.test)}


def fit_tree(inputs: Mapping[str, Path], folder: Path, stages: RunConfig) -> Facts:
    """Run the fit and all later stages for the input ``views``. The input ``tree``, if there is one, is the mesh that places billboards.

    Raises ``InputError`` or ``OSError`` if the views, the mesh or an option cannot be used, or a file cannot be written.
    """
    from bbfit.pipeline import run

    result = run(inputs["views"], folder, replace(stages, tree=inputs.get("tree")))
    report = result.report.to_json()
    del report["views"], report["rings"]
    return {"report": report, "billboards": len(result.cloud), "texels": len(result.cloud.texels)}
