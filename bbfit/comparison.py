"""bbfit beside its rivals: many ways to make a tree cheap, scored on the same held-out views, with what each costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.pictures import render_pictures
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError, fail
from bbfit.evaluation.report import Measures, mean_measures
from bbfit.evaluation.scoring import held_out, score_views
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.files import output_folder, read_json, write_bytes, write_json
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import pixels_a_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, read_rgba, to_bytes, unpremultiply, write_png
from bbfit.pipeline import RunConfig, run
from bbfit.provenance import VERSIONS
from bbfit.reporting.comparison_tables import CompareRow, compare_csv, compare_markdown, compare_picture, compare_plot
from bbfit.rivals.baking import BakeConfig
from bbfit.rivals.billboard_clouds import billboard_cloud
from bbfit.rivals.config import SYSTEMS, CompareConfig
from bbfit.rivals.crossed import crossed_planes
from bbfit.rivals.decimation import decimate
from bbfit.rivals.draco import draco_size
from bbfit.rivals.learned_mesh import learn_mesh, mesh_glb
from bbfit.rivals.slicing import slicing
from bbfit.stages.results import original_tree
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage, views_stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewDataset

# Besides the comparison itself, these algorithms decide the results of every system.
_VERSIONS = {name: VERSIONS[name] for name in ("fit", "export", "evaluate")}
# Files that all rivals read as they are: Y up, with materials.
_READABLE = (".glb", ".gltf", ".obj")
# Blender thins a tree to about as many triangles as it is told; a few tries find how many fit into so many bytes.
_TRIES = 5


@dataclass(frozen=True)
class CompareResult:
    """What a comparison made."""

    folder: Path
    """Where everything lies: ``views``, a folder for each system, and the tables and pictures."""
    rows: tuple[CompareRow, ...]
    """A system each."""


@dataclass(frozen=True)
class _Made:
    """What a system made of the tree."""

    model: bytes | None
    """As GLB; ``None`` where nothing is drawn."""
    vertices: int
    seconds: float
    draw: Callable[[int], Tensor] | None
    """Premultiplied RGBA of a held-out view; ``None`` where the tree itself is drawn."""
    planes: int | None = None
    note: str = ""
    size: int | None = None
    """Bytes where there is no model."""


def compare(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: CompareConfig | None = None,
    stages: RunConfig | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> CompareResult:
    """Give a tree to bbfit and to the systems that it is an alternative to, and score all on the same held-out views.

    Everything is drawn as its authors mean it to be: billboards, slices and learned meshes unlit and blended (bbfit's default by alpha
    test), decimated meshes by Blender in the views' light. Writes ``views/``, a folder for each system with its model and its pictures of
    the held-out views, ``compare.csv``, ``compare.md``, ``compare.json``, ``systems.png`` and ``quality.png``. Started again, it goes on
    where it stopped.

    Parameters
    ----------
    tree : a tree's file of any kind; rivals that read triangles take a conversion by Blender of those that are not .glb, .gltf or .obj.
    out : folder for the results.
    config : which systems, and how large.
    stages : how views are rendered, and what bbfit's fits and exports have in common.
    on_progress : told how far each system is.

    Raises
    ------
    InputError, OSError
        if the tree cannot be used or something cannot be written. A system that lacks a package is left out, and the row says so.
    """
    config, stages, on_progress = config or CompareConfig(), stages or RunConfig(), on_progress or silent
    tree = TreeFile.open(tree)
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "the comparison sets their numbers", "leave out billboards and budgets of the fit")
    folder = output_folder("out", out)
    record = Record(folder)
    record.run(views_stage(folder, tree, stages.views), on_progress)
    views = ViewDataset.load(folder / "views")
    chosen = [system for system in SYSTEMS if system in config.systems or not config.systems]
    if tree.suffix not in _READABLE:
        record.run(convert_stage(folder, tree, "tree.glb"), on_progress)
        tree = TreeFile.open(folder / "tree.glb")
    comparison = _Comparison(tree, views, record, config, stages, on_progress)
    rows = []
    on_progress("systems", 0, len(chosen))
    for number, system in enumerate(chosen, 1):
        rows.append(comparison.row(system))
        on_progress("systems", number, len(chosen), system)
    write_bytes(folder / "compare.csv", compare_csv(rows))
    write_bytes(folder / "compare.md", compare_markdown(rows, original_tree(views)).encode())
    write_json(folder / "compare.json", [row.to_json() for row in rows])
    compare_plot(rows, folder / "quality.png")
    compare_picture(rows, views.test, folder)
    return CompareResult(folder, tuple(rows))


class _Comparison:
    """One tree and the systems that it is given to."""

    def __init__(
        self, tree: TreeFile, views: ViewDataset, record: Record, config: CompareConfig, stages: RunConfig, on_progress: OnProgress
    ) -> None:
        self._tree, self._views, self._record, self._config, self._stages = tree, views, record, config, stages
        self._folder, self._on_progress = record.folder, on_progress
        self._bake = BakeConfig(float(pixels_a_meter(views.train.cameras)), views=stages.views)
        self._size: int | None = None
        count, many, crossed = config.billboards, config.many, config.crossed
        self._systems: dict[str, tuple[str, Callable[[Path], _Made]]] = {
            "bbfit": (f"bbfit, {count} billboards, mask", self._bbfit),
            "bbfit-blend": (f"bbfit, {count} billboards, blend", partial(self._fitted, FitConfig(alpha="blend", billboards=count))),
            "bbfit-many": (f"bbfit, {many} billboards, blend", partial(self._fitted, FitConfig(alpha="blend", billboards=many))),
            "bbfit-bytes": ("bbfit, blend, in bbfit's bytes", self._budgeted),
            "thesis": (
                "the thesis, 4 double billboards, L2",
                partial(self._fitted, FitConfig(preset="thesis", billboards=4, sides="pair")),
            ),
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
        }

    def row(self, system: str) -> CompareRow:
        """The score and the costs of a system."""
        title, make = self._systems[system]
        folder = output_folder("out", self._folder / system)

        def work(on_progress: OnProgress) -> None:
            made = make(folder)
            if made.model is not None:
                write_bytes(folder / "model.glb", made.model)
            measures = None if made.draw is None else self._scored(system, made.draw, output_folder("out", folder / "held_out"))
            size = made.size if made.model is None else len(made.model)
            row = CompareRow(system, title, made.planes, made.vertices, size, round(made.seconds, 1), measures, made.note)
            write_json(folder / "result.json", row.to_json())

        settings = replace(self._config, systems=())
        inputs = (system, self._tree.digest, self._views.fingerprint, settings, self._stages.fit, self._stages.export, _VERSIONS)
        outputs = (f"{system}/result.json", f"{system}/model*.glb", f"{system}/held_out/*.png")
        try:
            self._record.run(Stage(system, inputs, outputs, work, algorithm="compare"))
        except InputError as error:
            if "is not installed" not in str(error) and "LLVM" not in str(error):
                raise
            return CompareRow(system, title, None, None, None, None, None, str(error))
        return replace(CompareRow.from_json(read_json("result", folder / "result.json")), title=title)

    def _scored(self, system: str, draw: Callable[[int], Tensor], folder: Path) -> Measures:
        """Means over the held-out views, of which the pictures are kept."""

        def drawn(index: int) -> Tensor:
            image = draw(index).double().cpu().clamp(0, 1)
            write_png(folder / f"{self._views.test.names[index]}.png", to_bytes(unpremultiply(image)))
            return image

        on_view = partial(self._on_progress, f"{system} score")
        return mean_measures(score_views(drawn, self._views.test, on_view=on_view))

    def _bbfit(self, folder: Path) -> _Made:
        return self._fitted(FitConfig(billboards=self._config.billboards), folder)

    def _fitted(self, fit: FitConfig, folder: Path) -> _Made:
        """A run of bbfit by a preset; what the stages ask for on top is kept where the preset leaves it open."""
        asked = {entry.name: getattr(self._stages.fit, entry.name) for entry in fields(FitConfig)}
        default, own = asdict(FitConfig()), {name: value for name, value in asdict(fit).items() if value != asdict(FitConfig())[name]}
        fit = replace(fit, **{name: value for name, value in asked.items() if value != default[name] and name not in own})
        return self._run(RunConfig(fit=fit, export=self._stages.export), folder)

    def _budgeted(self, folder: Path) -> _Made:
        """As many billboards as a budget of bytes pays for, by trials on validation views."""
        fit = replace(self._stages.fit, alpha="blend")
        return self._run(RunConfig(fit=fit, budget=BudgetConfig(bytes=self._bytes()), export=self._stages.export), folder)

    def _run(self, stages: RunConfig, folder: Path) -> _Made:
        def report(stage: str, done: int, total: int, note: str = "") -> None:
            self._on_progress(f"{folder.name} {stage}", done, total, note)

        result = run(self._folder / "views", folder / "run", replace(stages, tree=self._tree.path), on_progress=report)
        shipped = shipped_model(result.cloud, self._stages.export)
        seconds = sum(result.report.seconds.get(stage, 0.0) for stage in ("budget", "fit", "export"))
        model = (folder / "run" / "model.glb").read_bytes()
        return _Made(model, result.report.vertices.model or 0, seconds, lambda index: self._drawn(shipped, index), len(result.cloud))

    def _drawn(self, model: ShippedModel, index: int) -> Tensor:
        return held_out(model.draw, self._views.test, index)[1]

    def _baked(self, bake: Callable[..., BillboardCloud], folder: Path) -> _Made:
        begun = time.perf_counter()
        cloud = bake(self._tree, config=self._bake, folder=folder / "baked", on_progress=self._on(folder, "bake"))
        model = shipped_model(cloud)
        vertices = glb_counts(model.glb)[0]
        return _Made(model.glb, vertices, time.perf_counter() - begun, lambda index: self._drawn(model, index), len(cloud))

    def _sliced(self, folder: Path) -> _Made:
        begun = time.perf_counter()
        made = slicing(
            self._tree,
            self._bake,
            directions=self._config.directions,
            slices=self._config.slices,
            folder=folder / "baked",
            on_progress=self._on(folder, "bake"),
        )
        model = shipped_model(BillboardCloud.joined(made.clouds)).glb
        cameras, planes = self._views.test.cameras, sum(map(len, made.clouds))
        note = "two slicings of the six are drawn at a time and their pictures mixed, which takes a shader"
        return _Made(model, made.vertex_count, time.perf_counter() - begun, lambda index: made.draw(cameras[index]), planes, note)

    def _decimated(self, folder: Path, *, vertices: int | None = None, size: int | None = None) -> _Made:
        begun = time.perf_counter()
        made = decimate(self._tree, vertices=vertices, size=size)
        note = "by collapsing edges, and beyond that by clustering vertices" if made.clustered else "by collapsing edges"
        return _Made(made.glb, made.vertices, time.perf_counter() - begun, self._rendered(made.glb, folder), None, note)

    def _decimated_to_size(self, folder: Path) -> _Made:
        return self._decimated(folder, size=self._bytes())

    def _thinned(self, folder: Path) -> _Made:
        """Blender's decimation that enlarges the leaves it keeps (Cook et al. 2007), to at most as many bytes as bbfit's model has."""
        begun, path, limit = time.perf_counter(), folder / "thinned.glb", self._bytes()
        assert self._views.request and self._views.request.tree.faces
        triangles = max(1, self._views.request.tree.faces * limit // self._tree.bytes)
        for _ in range(_TRIES):
            tree_as_glb(self._tree, path, triangles=triangles)
            if path.stat().st_size <= limit:
                break
            triangles = max(1, int(0.97 * triangles * limit / path.stat().st_size))
        model = path.read_bytes()
        path.unlink()
        note = "Blender; enlarged leaves" if len(model) <= limit else "Blender; enlarged leaves; it goes no lower"
        return _Made(model, glb_counts(model)[0], time.perf_counter() - begun, self._rendered(model, folder), None, note)

    def _draco(self, folder: Path) -> _Made:
        begun = time.perf_counter()
        found = draco_size(self._tree)
        note = "looks like the tree, up to 14 bits a coordinate; not drawn"
        return _Made(None, found.vertices, time.perf_counter() - begun, None, None, note, found.bytes)

    def _learned(self, vertices: int, folder: Path) -> _Made:
        begun, on_progress = time.perf_counter(), self._on(folder, "learn")
        steps = self._config.mesh_steps
        made = learn_mesh(
            self._views.train,
            vertices=vertices,
            steps=steps,
            seed=self._stages.fit.seed,
            on_step=lambda step, loss: on_progress(step, steps),
        )
        model, cameras = mesh_glb(made), self._views.test.cameras
        note = "blended, so its triangles have to be sorted"
        return _Made(model, len(made.vertices), time.perf_counter() - begun, lambda index: made.draw(cameras[index]), None, note)

    def _rendered(self, model: bytes, folder: Path) -> Callable[[int], Tensor]:
        """A model in the views' light, by Blender."""
        path = folder / "model.glb"
        write_bytes(path, model)
        pictures = output_folder("out", folder / "blender")
        for earlier in [*pictures.glob("*.png"), *pictures.glob("*.json")]:
            earlier.unlink()  # of another model
        paths = render_pictures(path, self._views.test.cameras, pictures, self._stages.views, on_progress=self._on(folder, "render"))
        return lambda index: premultiply(torch.from_numpy(read_rgba(paths[index])).double() / 255)

    def _bytes(self) -> int:
        """Those of bbfit's model by default."""
        if self._size is None:
            size = self.row("bbfit").bytes
            assert size is not None
            self._size = size
        return self._size

    def _on(self, folder: Path, what: str) -> Callable[[int, int], None]:
        return lambda done, total: self._on_progress(f"{folder.name} {what}", done, total)
