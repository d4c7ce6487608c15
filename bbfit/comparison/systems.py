"""The score and the costs of each system of a comparison on one tree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from torch import Tensor

from bbfit.checks import InputError
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.own_systems import own_systems
from bbfit.comparison.rival_systems import rival_systems
from bbfit.comparison.subject import Subject, is_missing
from bbfit.evaluation.afar import drawing_cost, score_afar
from bbfit.evaluation.measures import Measures, mean_measures
from bbfit.evaluation.scoring import drawn_view, score_views
from bbfit.evaluation.shading import score_shading
from bbfit.exporting.lod import glb_counts
from bbfit.files import read_json, remove_parts, write_bytes, write_json
from bbfit.geometry.camera import Camera
from bbfit.images import to_bytes, unpremultiply, write_png
from bbfit.inputs import reading
from bbfit.outputs import output_folder, used_folder
from bbfit.pipeline import RunConfig
from bbfit.provenance import VERSIONS
from bbfit.reporting.comparison_tables import CompareCosts, CompareRow
from bbfit.stages.stage import OnProgress, Record, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

# The results of every system also depend on the versions of these algorithms.
_VERSIONS = {name: VERSIONS[name] for name in ("convert", "budget", "fit", "export", "evaluate")}


class Systems:
    """A tree with its views, and the systems that simplify it."""

    def __init__(
        self, tree: TreeFile, views: ViewDataset, record: Record, config: CompareConfig, stages: RunConfig, on_progress: OnProgress
    ) -> None:
        self._subject = Subject(tree, views, record.folder, config, stages, on_progress, self.row)
        self._record = record
        self._systems = own_systems(config, stages.fit) | rival_systems(config, stages.fit)

    def row(self, system: str) -> CompareRow:
        """The score and the costs of a system."""
        subject, chosen = self._subject, self._systems[system]
        folder = subject.folder / system

        def work(on_progress: OnProgress) -> None:
            result = chosen.simplify(subject, folder)
            if result.model is not None:
                write_bytes(folder / "model.glb", result.model)
            measures = far = None
            if result.draw is not None:
                measures = self._score(system, result.draw, output_folder("out", folder / "held_out"))
                far = score_afar(result.draw, subject.views.test, subject.config.tree_height, result.fragments, system)
            score = None if result.lit is None else result.lit(partial(subject.on_progress, f"{system} light"))
            light = None if score is None else score.figures
            size = result.size if result.model is None else len(result.model)
            shaded = None if result.fragments is None else score_shading(result.fragments, subject.views.test)
            triangles = result.triangles
            if triangles is None and result.model is not None:
                triangles = glb_counts(result.model)[1]
            costs = CompareCosts(result.planes, result.vertices, size, round(result.seconds, 1), shaded, result.shader, triangles)
            write_json(folder / "result.json", CompareRow(system, chosen.title, costs, measures, result.note, light, far).to_json())

        shared = (subject.stages.fit, subject.stages.export.key, _VERSIONS)
        inputs = (system, subject.tree.digest, subject.views.full_fingerprint, chosen.inputs, subject.config.tree_height, *shared)
        outputs = (
            f"{system}/result.json",
            f"{system}/model*.glb",
            f"{system}/impostor*.js",
            f"{system}/field*.bin",
            f"{system}/held_out/*.png",
        )
        try:
            with used_folder("out", folder):
                remove_parts(folder)
                self._record.run(Stage(system, inputs, outputs, work, algorithm="compare"))
        except InputError as error:
            if not is_missing(str(error)):
                raise
            return CompareRow(system, chosen.title, CompareCosts(), None, str(error), None, None)
        content = read_json("result", folder / "result.json")
        with reading("result", folder / "result.json", "remove it, then start bbfit compare again"):
            row = CompareRow.from_json(content)
            drawing = drawing_cost(row.far, row.costs.triangles, subject.config.fragments_per_triangle)
            return replace(row, title=chosen.title, costs=replace(row.costs, drawing=drawing))

    def _score(self, system: str, draw: Callable[[Camera], Tensor], folder: Path) -> Measures:
        """Compute the mean measures over the held-out views, and save the pictures."""
        views = self._subject.views.test

        def draw_and_save(index: int) -> Tensor:
            image = drawn_view(draw, views.cameras[index], views.names[index], system)
            write_png(folder / f"{views.names[index]}.png", to_bytes(unpremultiply(image)))
            return image

        on_view = partial(self._subject.on_progress, f"{system} score")
        return mean_measures([view.measures for view in score_views(draw_and_save, views, on_view=on_view)])
