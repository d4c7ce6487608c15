"""Compare bbfit with other ways to simplify a tree: their scores on the same held-out views, and their costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path

import torch
from torch import Tensor

from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.pictures import render_pictures
from bbfit.blender.requirements import check_blender
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError, check_record, fail
from bbfit.evaluation.light import LightScore
from bbfit.evaluation.measures import Measures, mean_measures
from bbfit.evaluation.scoring import held_out, score_model_light, score_views
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.model import shipped_model
from bbfit.files import read_json, remove_parts, write_bytes, write_json
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, read_rgba, to_bytes, unpremultiply, write_png
from bbfit.inputs import reading
from bbfit.outputs import claimed_folder, output_folder, used_folder
from bbfit.pipeline import RunConfig, needs_blender, run
from bbfit.provenance import VERSIONS
from bbfit.reporting.comparison_tables import CompareRow, compare_csv, compare_markdown, compare_picture, compare_plot
from bbfit.rivals.baking import BakeConfig
from bbfit.rivals.billboard_clouds import billboard_cloud
from bbfit.rivals.config import LIT, SYSTEMS, CompareConfig
from bbfit.rivals.crossed import crossed_planes
from bbfit.rivals.decimation import decimate
from bbfit.rivals.draco import draco_size
from bbfit.rivals.fluffed import fluffed
from bbfit.rivals.learned_mesh import learn_mesh, mesh_glb
from bbfit.rivals.slicing import slicing
from bbfit.stages.results import original_tree
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage, views_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

# The results of every system also depend on the versions of these algorithms.
_VERSIONS = {name: VERSIONS[name] for name in ("fit", "export", "evaluate")}
# The formats that all systems read without a conversion: Y up, with materials.
_READABLE = (".glb", ".gltf", ".obj")
# Blender decimates a tree to a number of triangles. It takes a few attempts to find the number that fits a size in bytes.
_DECIMATION_ATTEMPTS = 5
_TABLES = ("compare.csv", "compare.md", "compare.json", "quality.png", "systems.png")


@dataclass(frozen=True)
class CompareResult:
    """The results of a comparison."""

    folder: Path
    """The folder of the comparison, with ``views``, a folder for each system, and the tables and pictures."""
    rows: tuple[CompareRow, ...]
    """One row for each system."""


@dataclass(frozen=True)
class _SystemResult:
    """The simplified tree of a system."""

    model: bytes | None
    """The GLB file. ``None`` if the system is not drawn."""
    vertices: int
    seconds: float
    draw: Callable[[int], Tensor] | None
    """Draws a held-out view as premultiplied RGBA. ``None`` if the result looks like the tree itself."""
    planes: int | None = None
    note: str = ""
    size: int | None = None
    """Size in bytes if there is no GLB file."""
    lit: Callable[[Callable[[int, int], None]], LightScore | None] | None = None
    """Scores it under the suns of held-out views, and reports finished views and their total. ``None`` if that is not done."""


def compare(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: CompareConfig | None = None,
    stages: RunConfig | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> CompareResult:
    """Simplify a tree with bbfit and with alternative systems, and score all results on the same held-out views.

    Each result is drawn as its authors intended. Billboards, slices and learned meshes are unlit and blended (bbfit's default uses an alpha
    test). Billboards with maps take the light of the views, and Blender renders decimated meshes in it. Billboards are also scored under
    the suns of held-out views; there is at least one other sun, unless a panorama lights the views. Writes ``views/``, a folder for
    each system with its model and its pictures of the held-out views, ``compare.csv``, ``compare.md``, ``compare.json``, ``systems.png``
    and ``quality.png``. A killed comparison continues where it stopped.

    Parameters
    ----------
    tree
        A tree in any format. Blender converts formats other than .glb, .gltf and .obj for the systems that read triangles.
    out
        The folder for the results.
    config
        The systems and their sizes.
    stages
        The options for rendering views, and the options that all of bbfit's fits and exports share.
    on_progress
        Called with the progress of each system.

    Raises
    ------
    InputError, OSError
        If the tree cannot be used or a file cannot be written. If a package is missing, the row of the system has no scores but a note.
    """
    config, stages, on_progress = config or CompareConfig(), stages or RunConfig(), on_progress or silent
    tree = TreeFile.open(tree, stages.limits)
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "the comparison sets their numbers", "omit billboards and budgets")
    chosen = config.systems or (SYSTEMS if stages.views.hdri is None else tuple(system for system in SYSTEMS if system not in LIT))
    systems = [system for system in SYSTEMS if system in chosen]
    if set(systems) & set(LIT) or stages.views.hdri is None:
        stages = replace(stages, views=replace(stages.views, suns=max(stages.views.suns, 1)))
    for system, (fit, budget) in _fits(config, stages.fit).items():
        if system == "bbfit" or system in systems:  # others take its size
            replace(stages, fit=fit, budget=budget).check(mesh=False, rendered=True, blender=False)
    if needs_blender(Path(out)):
        check_blender(stages.views)
    with claimed_folder("out", out) as folder:
        record = Record(folder, inputs=[*tree.files, *([stages.views.hdri] if stages.views.hdri else [])])
        record.check({"tables": _TABLES} | ({} if tree.suffix in _READABLE else {"convert": ("tree.glb",)}))
        return CompareResult(folder, _compared(tree, record, systems, config, stages, on_progress))


def _compared(
    tree: TreeFile, record: Record, systems: list[str], config: CompareConfig, stages: RunConfig, on_progress: OnProgress
) -> tuple[CompareRow, ...]:
    """Compare the systems in a claimed folder. The options were checked."""
    folder = record.folder
    record.run(views_stage(folder, tree, stages.views), on_progress)
    views = ViewDataset.load(folder / "views", limits=stages.limits)
    views.check()
    if tree.suffix not in _READABLE:
        record.run(convert_stage(folder, tree, "tree.glb"), on_progress)
        tree = TreeFile.open(folder / "tree.glb")
    comparison = _Comparison(tree, views, record, config, stages, on_progress)
    rows = []
    on_progress("systems", 0, len(systems))
    for number, system in enumerate(systems, 1):
        rows.append(comparison.row(system))
        on_progress("systems", number, len(systems), system)

    def write_tables(on_progress: OnProgress) -> None:
        write_bytes(folder / "compare.csv", compare_csv(rows))
        write_bytes(folder / "compare.md", compare_markdown(rows, original_tree(views)).encode(errors="backslashreplace"))
        write_json(folder / "compare.json", [row.to_json() for row in rows])
        compare_plot(rows, folder / "quality.png")
        compare_picture(rows, views.test, folder)

    record.run(Stage("tables", ([row.to_json() for row in rows], views.fingerprint), _TABLES, write_tables, algorithm="compare"))
    return tuple(rows)


def _fits(config: CompareConfig, shared: FitConfig) -> dict[str, tuple[FitConfig, BudgetConfig]]:
    """The options of the systems that are fits of bbfit. Fields that a system does not set come from the shared options."""
    default, count = FitConfig(), config.billboards
    own = {
        "bbfit": FitConfig(billboards=count),
        "bbfit-blend": FitConfig(alpha="blend", billboards=count),
        "bbfit-many": FitConfig(alpha="blend", billboards=config.many),
        "thesis": FitConfig(preset="thesis", billboards=4, sides="pair"),
        "bbfit-maps": FitConfig(billboards=count, light="maps"),
        "baked-maps": FitConfig(billboards=count, light="maps", map_steps=0),
    }
    open_fields = {
        system: [entry.name for entry in fields(FitConfig) if getattr(fit, entry.name) == getattr(default, entry.name)]
        for system, fit in own.items()
    }
    fits = {
        system: (replace(fit, **{name: getattr(shared, name) for name in open_fields[system]}), BudgetConfig())
        for system, fit in own.items()
    }
    return fits | {"bbfit-bytes": (replace(shared, alpha="blend", max_texels=None), BudgetConfig(bytes=1))}  # the size is known later


class _Comparison:
    """A tree with its views, and the systems that simplify it."""

    def __init__(
        self, tree: TreeFile, views: ViewDataset, record: Record, config: CompareConfig, stages: RunConfig, on_progress: OnProgress
    ) -> None:
        self._tree, self._views, self._record, self._config, self._stages = tree, views, record, config, stages
        self._folder, self._on_progress = record.folder, on_progress
        self._bake = BakeConfig(float(pixels_per_meter(views.train.cameras)), views=stages.views)
        count, many, crossed, self._fits = config.billboards, config.many, config.crossed, _fits(config, stages.fit)
        self._systems: dict[str, tuple[str, Callable[[Path], _SystemResult]]] = {
            "bbfit": (f"bbfit, {count} billboards, mask", partial(self._fitted, "bbfit")),
            "bbfit-blend": (f"bbfit, {count} billboards, blend", partial(self._fitted, "bbfit-blend")),
            "bbfit-many": (f"bbfit, {many} billboards, blend", partial(self._fitted, "bbfit-many")),
            "bbfit-bytes": ("bbfit, blend, in bbfit's bytes", self._budgeted),
            "thesis": ("the thesis, 4 double billboards, L2", partial(self._fitted, "thesis")),
            "crossed": (f"{crossed} crossed planes, baked", partial(self._baked, partial(crossed_planes, count=crossed))),
            "slicing": (f"slicing and blending, {config.directions} x {config.slices} slices", self._sliced),
            "cloud": (f"billboard cloud, {count} planes, baked", partial(self._baked, partial(billboard_cloud, count=count))),
            "cloud-many": (f"billboard cloud, {many} planes, baked", partial(self._baked, partial(billboard_cloud, count=many))),
            "decimated-vertices": (f"decimated to {4 * count} vertices", partial(self._decimated, vertices=4 * count)),
            "decimated-bytes": ("decimated to bbfit's bytes", self._decimated_to_size),
            "thinned": ("thinned out to bbfit's bytes", self._thinned),
            "draco": ("the tree, with Draco", self._draco),
            "learned": (f"learned mesh, {config.mesh_vertices} vertices", partial(self._learned, config.mesh_vertices)),
            "learned-many": (f"learned mesh, {config.mesh_vertices_many} vertices", partial(self._learned, config.mesh_vertices_many)),
            "bbfit-maps": (f"bbfit, {count} billboards, mask, fitted maps", partial(self._fitted, "bbfit-maps")),
            "baked-maps": (f"bbfit, {count} billboards, mask, baked maps", partial(self._fitted, "baked-maps")),
            "fluffed": (f"bbfit, {count} billboards, mask, baked maps, spherical normals", self._fluffed),
        }

    def row(self, system: str) -> CompareRow:
        """The score and the costs of a system."""
        title, simplify = self._systems[system]
        folder = self._folder / system

        def work(on_progress: OnProgress) -> None:
            result = simplify(folder)
            if result.model is not None:
                write_bytes(folder / "model.glb", result.model)
            measures = None if result.draw is None else self._score(system, result.draw, output_folder("out", folder / "held_out"))
            score = None if result.lit is None else result.lit(partial(self._on_progress, f"{system} light"))
            light = None if score is None else score.figures
            size = result.size if result.model is None else len(result.model)
            row = CompareRow(system, title, result.planes, result.vertices, size, round(result.seconds, 1), measures, result.note, light)
            write_json(folder / "result.json", row.to_json())

        settings = replace(self._config, systems=())
        inputs = (system, self._tree.digest, self._views.fingerprint, settings, self._stages.fit, self._stages.export, _VERSIONS)
        outputs = (f"{system}/result.json", f"{system}/model*.glb", f"{system}/held_out/*.png")
        try:
            with used_folder("out", folder):
                remove_parts(folder)
                self._record.run(Stage(system, inputs, outputs, work, algorithm="compare"))
        except InputError as error:
            if "is not installed" not in str(error) and "LLVM" not in str(error):
                raise
            return CompareRow(system, title, None, None, None, None, None, str(error), None)
        content = read_json("result", folder / "result.json")
        with reading("result", folder / "result.json", "remove it, then start bbfit compare again"):
            row = replace(CompareRow.from_json(content), title=title)
            check_record("row", row, CompareRow)
            return row

    def _score(self, system: str, draw: Callable[[int], Tensor], folder: Path) -> Measures:
        """Compute the mean measures over the held-out views, and save the pictures."""

        def draw_and_save(index: int) -> Tensor:
            image = draw(index).double().cpu().clamp(0, 1)
            write_png(folder / f"{self._views.test.names[index]}.png", to_bytes(unpremultiply(image)))
            return image

        on_view = partial(self._on_progress, f"{system} score")
        return mean_measures([view.measures for view in score_views(draw_and_save, self._views.test, on_view=on_view)])

    def _fitted(self, system: str, folder: Path) -> _SystemResult:
        """Run bbfit with the options of a system."""
        return self._run(RunConfig(fit=self._fits[system][0], export=self._stages.export.comparable()), folder)

    def _budgeted(self, folder: Path) -> _SystemResult:
        """Run bbfit with a budget of as many bytes as the model of the ``bbfit`` system has."""
        fit, _ = self._fits["bbfit-bytes"]
        return self._run(RunConfig(fit=fit, budget=BudgetConfig(bytes=self._bytes), export=self._stages.export.comparable()), folder)

    def _run(self, stages: RunConfig, folder: Path) -> _SystemResult:
        def report(stage: str, done: int, total: int, note: str = "") -> None:
            self._on_progress(f"{folder.name} {stage}", done, total, note)

        result = run(self._folder / "views", folder / "run", replace(stages, tree=self._tree.path), on_progress=report)
        seconds = sum(result.report.seconds.get(stage, 0.0) for stage in ("budget", "fit", "export"))
        return replace(self._of(result.cloud, self._stages.export.comparable(), seconds), lit=lambda _: result.report.light)

    def _of(self, cloud: BillboardCloud, export: ExportConfig, seconds: float) -> _SystemResult:
        """The result of a system that makes billboards."""
        model = shipped_model(cloud, export)

        def lit(on_view: Callable[[int, int], None]) -> LightScore | None:
            views, baked = self._views.lit_test, self._views.test.light
            return None if views is None or baked is None else score_model_light(model, views, baked[[0]], on_view)

        return _SystemResult(
            model.glb,
            model.cards.vertex_count,
            seconds,
            lambda index: held_out(model.draw, self._views.test, index)[1],
            len(cloud),
            lit=lit,
        )

    def _fluffed(self, folder: Path) -> _SystemResult:
        """Spherical normals in place of the baked ones of the system ``baked-maps``."""
        baked = self.row("baked-maps")
        started = time.perf_counter()
        cloud = fluffed(BillboardCloud.load(self._folder / "baked-maps" / "run" / "cloud.safetensors"))
        result = self._of(cloud, self._stages.export.comparable(), 0.0)
        return replace(result, seconds=(baked.seconds or 0.0) + time.perf_counter() - started)

    def _baked(self, bake: Callable[..., BillboardCloud], folder: Path) -> _SystemResult:
        started = time.perf_counter()
        cloud = bake(self._tree, config=self._bake, folder=folder / "baked", on_progress=self._on(folder, "bake"))
        result = self._of(cloud, ExportConfig(outline="rectangle"), 0.0)
        return replace(result, seconds=time.perf_counter() - started)

    def _sliced(self, folder: Path) -> _SystemResult:
        started = time.perf_counter()
        slices = slicing(
            self._tree,
            self._bake,
            directions=self._config.directions,
            slices=self._config.slices,
            folder=folder / "baked",
            on_progress=self._on(folder, "bake"),
        )
        model = shipped_model(BillboardCloud.joined(slices.clouds), ExportConfig(outline="rectangle")).glb
        cameras, planes = self._views.test.cameras, sum(map(len, slices.clouds))
        note = "two of the slicings are drawn at a time, and their pictures are mixed, which requires a shader"
        return _SystemResult(
            model, glb_counts(model)[0], time.perf_counter() - started, lambda index: slices.draw(cameras[index]), planes, note
        )

    def _decimated(self, folder: Path, *, vertices: int | None = None, size: int | None = None) -> _SystemResult:
        started = time.perf_counter()
        mesh = decimate(self._tree, vertices=vertices, size=size)
        note = "edge collapses, then vertex clustering" if mesh.clustered else "edge collapses"
        return _SystemResult(mesh.glb, mesh.vertices, time.perf_counter() - started, self._rendered(mesh.glb, folder), None, note)

    def _decimated_to_size(self, folder: Path) -> _SystemResult:
        return self._decimated(folder, size=self._bytes)

    def _thinned(self, folder: Path) -> _SystemResult:
        """Decimate the tree with enlarged leaves (Cook et al. 2007) to at most the size of the ``bbfit`` system's model."""
        started, path, limit = time.perf_counter(), folder / "thinned.glb", self._bytes
        assert self._views.request and self._views.request.tree.faces
        triangles = max(1, self._views.request.tree.faces * limit // self._tree.bytes)
        for _ in range(_DECIMATION_ATTEMPTS):
            tree_as_glb(self._tree, path, triangles=triangles)
            if path.stat().st_size <= limit:
                break
            triangles = max(1, int(0.97 * triangles * limit / path.stat().st_size))
        model = path.read_bytes()
        path.unlink()
        note = "Blender; enlarged leaves" if len(model) <= limit else "Blender; enlarged leaves; no smaller size is possible"
        return _SystemResult(model, glb_counts(model)[0], time.perf_counter() - started, self._rendered(model, folder), None, note)

    def _draco(self, folder: Path) -> _SystemResult:
        started = time.perf_counter()
        compressed = draco_size(self._tree)
        note = "the tree itself, with 14 bits for each coordinate; not drawn"
        return _SystemResult(None, compressed.vertices, time.perf_counter() - started, None, None, note, compressed.bytes)

    def _learned(self, vertices: int, folder: Path) -> _SystemResult:
        started, on_progress = time.perf_counter(), self._on(folder, "learn")
        steps = self._config.mesh_steps
        mesh = learn_mesh(
            self._views.train,
            vertices=vertices,
            steps=steps,
            seed=self._stages.fit.seed,
            on_step=lambda step, loss: on_progress(step, steps),
        )
        model, cameras = mesh_glb(mesh), self._views.test.cameras
        note = "blended, so its triangles must be sorted"
        return _SystemResult(model, len(mesh.vertices), time.perf_counter() - started, lambda index: mesh.draw(cameras[index]), None, note)

    def _rendered(self, model: bytes, folder: Path) -> Callable[[int], Tensor]:
        """Render the held-out views of a model with Blender, in the light of the views."""
        path = folder / "model.glb"
        write_bytes(path, model)
        pictures = output_folder("out", folder / "blender")
        for earlier in [*pictures.glob("*.png"), *pictures.glob("*.json")]:
            earlier.unlink()  # pictures of another model
        paths = render_pictures(path, self._views.test.cameras, pictures, self._stages.views, on_progress=self._on(folder, "render"))
        return lambda index: premultiply(torch.from_numpy(read_rgba(paths[index])).double() / 255)

    @cached_property
    def _bytes(self) -> int:
        """The size of the ``bbfit`` system's model."""
        size = self.row("bbfit").bytes
        assert size is not None
        return size

    def _on(self, folder: Path, activity: str) -> Callable[[int, int], None]:
        return partial(self._on_progress, f"{folder.name} {activity}")
