"""bbfit beside its rivals on one small tree: who is compared, what is written, and that nothing is done twice."""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from khronos import WARNING, messages
from PIL import Image
from trimesh.visual.material import PBRMaterial

from bbfit.blender.config import ViewsConfig
from bbfit.blender.request import ViewsRequest
from bbfit.checks import InputError
from bbfit.comparison.config import LIT, SYSTEMS, CompareConfig
from bbfit.comparison.many_trees import _is_complete, compare_trees
from bbfit.comparison.one_tree import CompareResult, compare
from bbfit.comparison.subject import baking
from bbfit.evaluation.afar import score_afar
from bbfit.evaluation.scoring import evaluate_model
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.model import shipped_model
from bbfit.files import write_json
from bbfit.fitting.config import FitConfig
from bbfit.geometry.cloud import BillboardCloud
from bbfit.inputs import InputLimits
from bbfit.layout import REQUEST_FILE
from bbfit.pipeline import RunConfig
from bbfit.rendering.cards import CardRenderer
from bbfit.reporting.comparison_summary import COSTS, front, summaries
from bbfit.reporting.comparison_tables import CompareCosts
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.config import GrowConfig
from bbfit.views.dataset import ViewDataset
from bbfit.workers.tasks import Outcome

TREE = Path(__file__).resolve().parents[1] / "data" / "tree.glb"
STAGES = RunConfig(
    views=ViewsConfig(count=8, size=64, samples=2, training_samples=2, denoise=False), fit=FitConfig(steps=40, placement="even")
)
SMALL = CompareConfig(
    billboards=3,
    few=2,
    many=5,
    medium=6,
    most=7,
    crossed=2,
    directions=2,
    slices=2,
    frames=3,
    large_bytes=100_000,
    mesh_vertices=80,
    mesh_vertices_many=120,
    mesh_steps=6,
    field_steps=6,
    tree_height=30,
    fragments_per_triangle=2.5,
)
CODED = ("height-fields", "draco", "radiance-field")  # they ship no model that programs draw
OCTAHEDRAL = [system for system in SYSTEMS if system.startswith("octahedral")]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> CompareResult:
    return compare(TREE, tmp_path_factory.mktemp("compare") / "out", SMALL, STAGES)


def test_every_system_is_scored_on_the_same_views(done: CompareResult) -> None:
    assert tuple(row.system for row in done.rows) == SYSTEMS
    names = ViewDataset.load(done.folder / "views").test.names
    for row in done.rows:
        assert row.costs.bytes and row.costs.seconds is not None
        assert (row.costs.vertices is None) == (row.system in ("height-fields", "radiance-field"))
        if row.system == "draco":
            assert row.measures is None
            continue
        assert row.measures is not None and 5 < row.measures.over.mean.psnr < 40
        assert sorted(path.stem for path in (done.folder / row.system / "held_out").iterdir()) == sorted(names)


def test_costs_are_those_of_the_models(done: CompareResult) -> None:
    costs = {row.system: row.costs for row in done.rows}
    for system, cost in costs.items():
        if system not in CODED:
            model = (done.folder / system / "model.glb").read_bytes()
            assert cost.bytes == len(model) and cost.vertices == glb_counts(model)[0], system
            # Ten vertices cover a part of the tree, and each of many planes up to three times its pixels.
            assert cost.shaded is not None and 0.1 < cost.shaded < max(60, 3 * (cost.planes or 0)), system
    assert {system for system, cost in costs.items() if cost.shader} == {"slicing", "height-fields", "radiance-field", *OCTAHEDRAL}
    assert {costs[system].planes for system in OCTAHEDRAL} == {1} and {costs[system].vertices for system in OCTAHEDRAL} == {4}
    assert (costs["octahedral-flat"].bytes or 0) < (costs["octahedral"].bytes or 0)
    bake = json.loads(next((done.folder / "octahedral").glob("baked_*/seconds.json")).read_text())["seconds"]
    assert bake > 0.1 and all((costs[system].seconds or 0) >= round(bake, 1) for system in OCTAHEDRAL)
    assert all((done.folder / system / "impostor_three.js").is_file() for system in OCTAHEDRAL)
    assert [system for system in OCTAHEDRAL if any((done.folder / system).glob("baked_*"))] == ["octahedral"]
    assert costs["bbfit"].vertices == 12 and costs["thesis"].vertices == 32 and costs["crossed"].vertices == 8
    assert costs["slicing"].planes is not None and costs["slicing"].planes <= 4
    assert costs["slicing"].vertices == 4 * costs["slicing"].planes
    assert costs["cloud-many"].planes == costs["bbfit-many"].planes == 5 and costs["bbfit-most"].planes == 7
    assert (costs["bbfit-default"].planes or 0) > 7
    assert costs["decimated-vertices"].vertices is not None and costs["decimated-vertices"].vertices <= 12
    assert costs["decimated-bytes"].bytes is not None and costs["decimated-bytes"].bytes <= (costs["bbfit"].bytes or 0)
    assert (costs["thinned"].bytes or 0) <= (costs["bbfit"].bytes or 0) < 60_000 < (costs["thinned-large"].bytes or 0) <= 100_000
    assert costs["learned"].vertices is not None and costs["learned"].vertices <= 80
    assert costs["radiance-field"].bytes == (done.folder / "radiance-field" / "field.bin").stat().st_size


def test_drawing_from_afar_costs_fragments_and_triangles(done: CompareResult) -> None:
    """Pictures of half of the views' size, in which the tree is 30 pixels high."""
    sizes = [row.far.tree_pixels for row in done.rows if row.far]
    assert len(sizes) == len(SYSTEMS) - 1 and min(sizes) == max(sizes) == pytest.approx(30, abs=0.5)
    for row in done.rows:
        if row.system == "draco":
            assert row.far is row.costs.triangles is row.costs.drawing is None
            continue
        assert row.far and 5 < row.far.psnr < 40 and 0 < row.far.flip < 1, row.system
        if row.system in CODED:
            assert row.far.fragments is row.costs.triangles is row.costs.drawing is None
            continue
        triangles = glb_counts((done.folder / row.system / "model.glb").read_bytes())[1]
        assert row.costs.triangles == triangles and row.far.fragments is not None  # both slicings are drawn at a time
        assert row.costs.drawing == row.far.fragments + 2.5 * triangles and 10 < row.far.fragments < 30_000, row.system


def test_bbfits_row_is_its_run(done: CompareResult) -> None:
    cloud = BillboardCloud.load(done.folder / "bbfit" / "run" / "cloud.safetensors")
    views, model = ViewDataset.load(done.folder / "views").test, shipped_model(cloud, ExportConfig(outline="rectangle"))
    report = evaluate_model(model, views)
    row = next(row for row in done.rows if row.system == "bbfit")
    assert row.measures == report.antialiased and cloud.alpha.kind == "mask" and row.costs.shaded == report.shaded
    assert row.far == score_afar(model.antialiased().draw, views, 30, CardRenderer(model.cards).fragments)
    assert BillboardCloud.load(done.folder / "bbfit-blend" / "run" / "cloud.safetensors").alpha.kind == "blend"


def test_maps_take_the_light_of_other_suns(done: CompareResult) -> None:
    """Each on the planes of bbfit. Baked colors reproduce nothing of the change; decimated meshes are not scored."""
    rows = {row.system: row for row in done.rows}
    lit = {name: row.light["r2"] for name, row in rows.items() if row.light is not None}
    assert set(lit) == {
        name for name in SYSTEMS if not name.startswith(("decimated", "thinned", *CODED, "learned", "slicing", "octahedral"))
    }
    assert all(lit[name] == pytest.approx(0, abs=1e-9) for name in lit if name not in LIT)
    assert all(abs(lit[name] or 0) > 1e-3 for name in LIT)
    maps, baked = rows["bbfit-maps"].light, rows["bbfit"].light
    assert maps and baked and (maps["low"] or 0) > (baked["low"] or 0) + 1
    clouds = {name: BillboardCloud.load(done.folder / name / "run" / "cloud.safetensors") for name in ("bbfit", "bbfit-maps", "baked-maps")}
    for name in ("bbfit-maps", "baked-maps"):
        torch.testing.assert_close(clouds[name].centers, clouds["bbfit"].centers)
        assert rows[name].light != rows["bbfit"].light
    assert rows["fluffed"].costs.vertices == rows["baked-maps"].costs.vertices and rows["fluffed"].light != rows["baked-maps"].light
    assert "## Under other suns" in (done.folder / "compare.md").read_text()


def test_panoramas_leave_out_what_needs_suns(tmp_path: Path) -> None:
    views = replace(STAGES.views, hdri=tmp_path / "sky.hdr")
    with pytest.raises(InputError, match="suns: they need an even sky"):
        compare(TREE, tmp_path / "out", CompareConfig(systems=("fluffed",)), RunConfig(views=views, fit=STAGES.fit))


def test_tables_and_pictures(done: CompareResult) -> None:
    with (done.folder / "compare.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [line["system"] for line in table] == list(SYSTEMS)
    assert [float(line["psnr"]) for line in table if line["psnr"]] == [row.measures.over.mean.psnr for row in done.rows if row.measures]
    text = (done.folder / "compare.md").read_text()
    assert all(f"| {row.title}{'*' * row.costs.shader} |" in text for row in done.rows) and "| the tree |" in text
    assert len(json.loads((done.folder / "compare.json").read_text())) == len(SYSTEMS)
    for name in ("systems.png", "quality.png"):
        with Image.open(done.folder / name) as picture:
            assert min(picture.size) > 400 and len(set(picture.convert("L").tobytes())) > 50


def test_nothing_is_done_twice_and_a_missing_package_leaves_one_out(done: CompareResult, monkeypatch: pytest.MonkeyPatch) -> None:
    times = {path: path.stat().st_mtime_ns for path in done.folder.glob("*/result.json")}
    told = list[str]()
    again = compare(TREE, done.folder, SMALL, STAGES, on_progress=lambda stage, now, total, note="": told.append(stage))
    assert again.rows == done.rows and set(told) == {"systems"}
    slower = compare(TREE, done.folder, replace(SMALL, fragments_per_triangle=100), STAGES).rows
    assert [(row.costs.drawing or 0) - (before.costs.drawing or 0) for row, before in zip(slower, done.rows, strict=True)] == pytest.approx(
        [0 if before.costs.drawing is None else 97.5 * (before.costs.triangles or 0) for before in done.rows]
    )
    assert times == {path: path.stat().st_mtime_ns for path in done.folder.glob("*/result.json")}
    (done.folder / "draco" / "result.json").unlink()
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    (row,) = compare(TREE, done.folder, CompareConfig(**{**vars(SMALL), "systems": ("draco",)}), STAGES).rows
    assert row.costs.vertices is None and "DracoPy is not installed" in row.note


def test_baked_pictures_of_other_sizes_are_other_pictures(tmp_path: Path) -> None:
    """Another number of planes, slices or frames in the same folder."""
    config = replace(SMALL, systems=("bbfit", "crossed", "slicing", "octahedral"))
    compare(TREE, tmp_path / "out", config, STAGES)
    again = compare(TREE, tmp_path / "out", replace(config, crossed=3, slices=3, frames=4), STAGES)
    assert next(row.costs.vertices for row in again.rows if row.system == "crossed") == 12


def test_a_result_with_a_damaged_cost_is_refused(done: CompareResult) -> None:
    path = done.folder / "crossed" / "result.json"
    before = path.read_text()
    path.write_text(before.replace('"vertices": 8', '"vertices": "8"'))
    record = json.loads((done.folder / "run.json").read_text())
    assert record["stages"]["crossed"]["outputs"]["crossed/result.json"]
    compare(TREE, done.folder, CompareConfig(**{**vars(SMALL), "systems": ("crossed",)}), STAGES)
    again, earlier = (json.loads(text) for text in (path.read_text(), before))
    for row in (again, earlier):
        row["costs"].pop("seconds")
    assert again == earlier  # it had changed, so the system was run again


def test_seconds_of_a_bake_outlive_it(tmp_path: Path) -> None:
    """An interrupted bake counts. One that finds its pictures adds nothing."""

    def bake(seconds: float, error: bool = False) -> str:
        (tmp_path / "baked").mkdir(exist_ok=True)
        time.sleep(seconds)
        if error:
            raise KeyboardInterrupt
        return "cloud"

    with pytest.raises(KeyboardInterrupt):
        baking(tmp_path / "baked", lambda: bake(0.2, error=True))
    cloud, first = baking(tmp_path / "baked", lambda: bake(0.1))
    assert cloud == "cloud" and first >= 0.3
    assert baking(tmp_path / "baked", lambda: bake(0.05)) == ("cloud", first)
    (tmp_path / "baked" / "seconds.json").write_text('{"seconds": "long"}')
    with pytest.raises(InputError, match=r"seconds\.json"):
        baking(tmp_path / "baked", lambda: bake(0))


def test_trees_are_compared_by_means_and_spreads(tmp_path: Path) -> None:
    """Two seeds of a species, a file, one without triangles, and a damaged one: means of three, and reasons for the others."""
    config = replace(SMALL, systems=("bbfit", "crossed", "slicing", "draco"), workers=1)
    trimesh.PointCloud([[0, 0, 0], [0, 1, 0], [1, 0, 0]]).export(tmp_path / "points.ply")
    (tmp_path / "bad.glb").write_bytes(TREE.read_bytes()[:3000])
    trees = (tmp_path / "bad.glb", TREE, tmp_path / "points.ply")
    stages = replace(STAGES, grow=GrowConfig(detail=0.1))
    done = compare_trees(tmp_path / "out", config, stages, species=("apple",), seeds=(0, 1), trees=trees)
    assert list(done.rows) == ["apple_0", "apple_1", "tree"]
    assert list(done.failures) == ["bad", "points"]
    assert all(f"{name}." in reason for name, reason in done.failures.items())
    every = [{row.system: row for row in rows} for rows in done.rows.values()]
    assert every[0]["crossed"].measures != every[1]["crossed"].measures
    systems = {each.system: each for each in summaries(done.rows)}
    assert list(systems) == ["bbfit", "crossed", "slicing"]
    found = [rows["crossed"].measures.over.mean.psnr for rows in every if rows["crossed"].measures]
    assert systems["crossed"].psnr.mean == pytest.approx(np.mean(found))
    assert systems["crossed"].psnr.deviation == pytest.approx(np.std(found, ddof=1))
    sizes = [rows["crossed"].costs.bytes or 0 for rows in every]
    size = systems["crossed"].costs["bytes"]
    assert size is not None and size.mean == pytest.approx(np.exp(np.mean(np.log(sizes))))
    afar = [rows["crossed"].far for rows in every]
    far = systems["crossed"].far
    assert far is not None and far.flip.mean == pytest.approx(np.mean([each.flip for each in afar if each]))
    assert systems["crossed"].quality("psnr", "drawing") == far.psnr != systems["crossed"].quality("psnr", "bytes")
    for cost in COSTS:
        assert {each.system for each in front(list(systems.values()), cost, "psnr")} <= {"bbfit", "crossed"}
    with (done.folder / "summary.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["tree"], line["system"]) for line in lines] == [(name, row.system) for name, rows in done.rows.items() for row in rows]
    text = (done.folder / "summary.md").read_text()
    assert "## From afar: 30 pixels high" in text and "- FLIP and drawing: " in text
    assert "Means over 3 trees" in text and "| slicing and blending, 2 x 2 slices* |" in text
    with Image.open(done.folder / "pareto.png") as picture:
        assert min(picture.size) > 400
    shutil.rmtree(done.folder / "trees" / "tree")  # and is made again
    done = compare_trees(tmp_path / "out", config, stages, species=("apple",), seeds=(0, 1), trees=trees)
    assert (done.folder / "trees" / "tree" / "compare.json").is_file()
    times = {path: path.stat().st_mtime_ns for path in done.folder.glob("trees/*/*/result.json")}
    again = compare_trees(tmp_path / "out", config, stages, species=("apple",), seeds=(0, 1), trees=trees)
    assert again.rows == done.rows and times == {path: path.stat().st_mtime_ns for path in times}
    assert again.failures == done.failures


def test_a_package_that_was_missing_is_used_once_it_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of many trees too. Draco is not scored, so the picture is empty."""
    config = replace(SMALL, systems=("draco",), workers=1)

    def missing(*_: object, **__: object) -> None:
        raise InputError("draco: the package DracoPy is not installed")

    with monkeypatch.context() as patch:
        patch.setattr("bbfit.comparison.rival_systems.draco_size", missing)
        (row,) = compare(TREE, tmp_path / "one", config, STAGES).rows
        assert row.costs.bytes is None and "not installed" in row.note
    (row,) = compare(TREE, tmp_path / "one", config, STAGES).rows
    assert row.costs.bytes is not None and (tmp_path / "one" / "quality.png").is_file()
    finished = Outcome({"rows": [row.to_json()]}, None, "here")
    skipped = replace(row, costs=CompareCosts(), note="draco: the package DracoPy is not installed")
    assert _is_complete(finished) and not _is_complete(replace(finished, facts={"rows": [skipped.to_json()]}))
    for damaged in (None, {}, {"rows": 3}, {"rows": [{}]}, {"rows": [row.to_json() | {"costs": {"vertices": "many"}}]}):
        assert not _is_complete(replace(finished, facts=damaged))


def test_a_tree_whose_textures_alone_are_too_large_gets_a_note(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(2)
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8))
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=mesh.vertices[:, :2] / 2 + 0.5, material=PBRMaterial(name="bark", baseColorTexture=picture)
    )
    mesh.export(tmp_path / "tree.glb")
    bbfit, decimated = compare(tmp_path / "tree.glb", tmp_path / "out", replace(SMALL, systems=("bbfit", "decimated-bytes")), STAGES).rows
    assert bbfit.measures is not None and decimated.measures is None and decimated.costs.bytes is None
    assert re.search(r"^decimate: no triangles are left .* materials and textures take [\d,]+$", decimated.note)


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="systems: expected one of bbfit-default, bbfit-default-blend, bbfit-default-coverage"):
        CompareConfig(systems=("octree",))
    with pytest.raises(InputError, match="slices: expected at least 1"):
        CompareConfig(slices=0)
    with pytest.raises(InputError, match="billboards: the comparison sets their numbers"):
        compare(TREE, tmp_path, SMALL, RunConfig(fit=FitConfig(billboards=3)))
    for name, value, bound in (
        ("mesh_vertices", 10, "at least 20"),
        ("mesh_vertices_many", 10**6, "a value in"),
        ("field_steps", 2, "at least 3"),
    ):
        with pytest.raises(InputError, match=f"^{name}: expected {bound}"):
            CompareConfig(**{name: value})
    for stages in (replace(STAGES, fit=FitConfig(alpha="blend")), replace(STAGES, export=ExportConfig(alpha="mask"))):
        with pytest.raises(InputError, match="alpha: each system has its own alpha mode; leave out --alpha"):
            compare(TREE, tmp_path, SMALL, stages)
    with pytest.raises(InputError, match="mip_files: only bbfit run, fit, sweep and export"):
        compare(TREE, tmp_path, SMALL, replace(STAGES, export=ExportConfig(mip_files=True)))
    (tmp_path / "bad.glb").write_bytes(TREE.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"no tree succeeded; bad: .*bad\.glb"):
        compare_trees(tmp_path / "out", SMALL, STAGES, trees=(tmp_path / "bad.glb",))
    with pytest.raises(InputError, match="seeds: expected different ones"):
        compare_trees(tmp_path / "out", SMALL, STAGES, species=("apple",), seeds=(1, 1))
    with pytest.raises(InputError, match="there are no trees"):
        compare_trees(tmp_path / "out", SMALL, STAGES)


def test_systems_that_need_suns_cannot_join_views_without_them(tmp_path: Path) -> None:
    (tmp_path / "views").mkdir()
    write_json(tmp_path / "views" / REQUEST_FILE, asdict(ViewsRequest.of(TreeFile.open(TREE), STAGES.views)))
    with pytest.raises(InputError, match=r"^systems: baked-maps: .*views has no views under other suns"):
        compare(TREE, tmp_path, replace(SMALL, systems=("bbfit", "baked-maps")), STAGES)


def test_fits_have_the_limits_of_the_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tree that was opened with other folders or larger limits is opened again by each fit."""

    class Reached(Exception):
        pass

    def reached(source: Path, out: Path, config: RunConfig, **_: object) -> None:
        assert config.limits.allow_folders == (tmp_path,)
        raise Reached

    monkeypatch.setattr("bbfit.comparison.own_systems.prepare", reached)
    stages = replace(STAGES, limits=InputLimits(allow_folders=(tmp_path,)))
    with pytest.raises(Reached):
        compare(TREE, tmp_path / "out", replace(SMALL, systems=("bbfit",)), stages)


def test_trees_that_only_blender_reads_as_they_stand_are_converted(tmp_path: Path) -> None:
    """A .ply, Z up: decimated it stands as it did."""
    mesh = trimesh.load(TREE, force="mesh")
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "tree.ply")
    config = replace(SMALL, systems=("decimated-vertices", "draco"))
    decimated, draco = compare(tmp_path / "tree.ply", tmp_path / "out", config, STAGES).rows
    assert decimated.costs.vertices is not None and decimated.costs.vertices <= 12 and draco.costs.vertices
    low, high = trimesh.load(tmp_path / "out" / "decimated-vertices" / "model.glb").bounds
    original = trimesh.load(TREE).bounds
    assert (low >= original[0] - 1e-3).all() and (high <= original[1] + 1e-3).all()


def test_the_khronos_validator_finds_nothing_wrong_with_the_models(done: CompareResult) -> None:
    """Decimated meshes keep no normals and may keep texture coordinates without a texture, which is information."""
    models = [done.folder / system / "model.glb" for system in SYSTEMS if system not in ("draco", "radiance-field")]
    assert not [(message["code"], message["pointer"]) for message in messages(*models) if message["severity"] <= WARNING]
