"""Levels of detail of a real tree, by the real Blender: small and coarse, but all of the way."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from gltf_arrays import array
from khronos import WARNING, messages
from PIL import Image

import bbfit.lod
from bbfit.blender.config import ViewsConfig
from bbfit.checks import InputError
from bbfit.evaluation.color_error import mean_color_error
from bbfit.evaluation.metrics import silhouette_distance
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.config import ExportConfig, LodConfig
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.model import shipped_model
from bbfit.files import read_json
from bbfit.fitting.config import FitConfig
from bbfit.frames.models import drawn_models
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import split_glb
from bbfit.lod import LodLevel, LodResult, build_lod
from bbfit.pipeline import RunConfig, RunResult
from bbfit.views.dataset import ViewDataset

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"
SMALL = RunConfig(views=ViewsConfig(count=12, size=64, samples=4), fit=FitConfig(steps=20, candidates=1, refinement_rounds=0, restarts=1))
LEVELS = LodConfig(planes=(4, 2), error_pixels=0.5)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> LodResult:
    """Four and two billboards, and the tree."""
    return build_lod(TREE, tmp_path_factory.mktemp("lod") / "oak.glb", LEVELS, SMALL)


def test_the_file_has_the_tree_and_the_clouds(built: LodResult) -> None:
    tree, _ = split_glb(built.path.read_bytes())
    (root,) = tree["scenes"][tree["scene"]]["nodes"]
    numbers = [root, *tree["nodes"][root]["extensions"]["MSFT_lod"]["ids"]]
    names = [tree["nodes"][number]["name"] for number in numbers]
    assert names == [level.name for level in built.levels] == [f"oak_LOD{number}" for number in range(3)]
    assert [level.planes for level in built.levels] == [None, 4, 2]
    assert (built.levels[0].vertices, built.levels[0].triangles) == glb_counts(TREE.read_bytes())
    for level in built.levels[1:]:  # on average up to 8 pieces of 3 to 8 corners a billboard
        assert level.planes is not None and 3 * level.planes <= level.vertices <= 8 * 8 * level.planes
        assert level.planes <= level.triangles <= 8 * 6 * level.planes
    together = sum(level.vertices for level in built.levels), sum(level.triangles for level in built.levels)
    assert glb_counts(built.path.read_bytes()) == together
    extras = tree["nodes"][root]["extras"]
    assert extras["MSFT_screencoverage"] == [level.screen_coverage for level in built.levels]
    assert extras["lod_distances"] == [level.distance_meters for level in built.levels]


def test_levels_take_over_where_their_error_is_within_the_bound(built: LodResult) -> None:
    """By the tree's own geometry: distance times pixels a meter is the screen's focal length, coverage that of the bounding sphere."""
    views = ViewDataset.load(built.folder / "views")
    focal = 1080 / 2 / np.tan(np.radians(25))
    points = trimesh.load(TREE, force="mesh").vertices
    radius, height = np.linalg.norm(np.ptp(points, axis=0)) / 2, np.ptp(points[:, 1])
    # The cameras look at the axis, from as far as they are from it.
    assert views.request and views.request.camera
    axis = views.request.camera["distance"]
    scale = float(views.train.cameras.intrinsics[0, 0, 0]) / axis
    before: LodLevel = built.levels[0]
    assert before.distance_meters == before.error_meters == 0 and before.tree_pixels is None
    for level in built.levels[1:]:
        cloud = BillboardCloud.load(built.folder / str(level.planes) / "cloud.safetensors")
        worst = [
            max(
                silhouette_distance(*(picture.numpy() for picture in held_out(shipped_model(cloud).draw, split, index)))
                for index in range(len(split))
            )
            for split in (views.train, views.test)
        ]
        assert level.error_meters == pytest.approx(worst[0] / scale, rel=1e-3) and worst[0] > 0
        pixels_per_meter = focal / level.distance_meters
        assert level.error_pixels == pytest.approx(level.error_meters * pixels_per_meter)
        assert level.held_out_error_pixels == pytest.approx(worst[1] / scale * pixels_per_meter, rel=1e-3)
        assert level.error_pixels <= LEVELS.error_pixels + 1e-9
        assert level.tree_pixels == pytest.approx(height * pixels_per_meter, rel=1e-3) and level.distance_meters >= before.distance_meters
        # The level before it ends where this one begins.
        assert before.screen_coverage == pytest.approx(np.pi * (radius * pixels_per_meter) ** 2 / (1920 * 1080), rel=1e-3)
        before = level
    assert before.screen_coverage == 0


def test_levels_have_the_outline_of_their_runs(tmp_path: Path) -> None:
    """The preset thesis draws rectangles, and its runs are scored with them."""
    thesis = replace(SMALL, fit=replace(SMALL.fit, preset="thesis", refinement_rounds=None, candidates=None, restarts=None))
    (level,) = build_lod(TREE, tmp_path / "oak.glb", LodConfig(planes=(2,), original=False), thesis).levels
    metrics = read_json("metrics", tmp_path / "oak" / "2" / "metrics.json")
    assert level.vertices == metrics["vertices"]["model"] == 8


def test_colors_count_too(built: LodResult) -> None:
    """The distance is the larger of both, or that of the views' size; from there on, the colors of no training view are further off."""
    views = ViewDataset.load(built.folder / "views")
    assert views.request and views.request.camera
    focal, axis = 1080 / 2 / np.tan(np.radians(25)), views.request.camera["distance"]
    scale = float(views.train.cameras.intrinsics[0, 0, 0]) / axis
    least = focal / scale
    for level in built.levels[1:]:
        draw = shipped_model(BillboardCloud.load(built.folder / str(level.planes) / "cloud.safetensors")).draw
        least = max(least, level.silhouette_distance_meters, level.color_distance_meters)
        assert level.distance_meters == pytest.approx(least, rel=1e-6)
        errors = [mean_color_error(draw, split, focal / level.distance_meters / scale) for split in (views.train, views.test)]
        assert (level.color_error, level.held_out_color_error) == pytest.approx(errors, rel=0.05) and 0 < errors[0] <= LEVELS.color_error


def test_textures_are_as_fine_as_the_screen_shows(built: LodResult) -> None:
    """One to two texels a pixel where the level takes over, by the file alone, as textures are halved."""
    tree, views = split_glb(built.path.read_bytes())
    for level in built.levels[1:]:
        (primitive,) = next(mesh for mesh in tree["meshes"] if mesh["name"] == f"{level.name}_billboards")["primitives"]
        surface = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
        image = tree["images"][tree["textures"][surface["baseColorTexture"]["index"]]["source"]]
        extent = Image.open(io.BytesIO(views[image["bufferView"]])).size
        triangles = array(tree, views, primitive["indices"]).astype(int).reshape(-1, 3)
        points, uvs = (array(tree, views, primitive["attributes"][name])[triangles] for name in ("POSITION", "TEXCOORD_0"))
        sides = [np.linalg.norm(values - np.roll(values, 1, axis=1), axis=-1) for values in (points, uvs * extent)]
        seen = 1080 / 2 / np.tan(np.radians(25)) / level.distance_meters
        texels_a_pixel = sides[1] / sides[0] / seen
        assert 0.95 < texels_a_pixel.min() and texels_a_pixel.max() < 2.05


def test_what_was_measured_is_written_down_beside_a_file_for_each_level(built: LodResult) -> None:
    folder = built.folder / "levels"
    told = json.loads((folder / "lod.json").read_text())
    assert [LodLevel(**level) for level in told["levels"]] == list(built.levels) and told["config"]["error_pixels"] == 0.5
    points = trimesh.load(TREE, force="mesh").vertices
    np.testing.assert_allclose([told["extent"]["low"], told["extent"]["high"]], [points.min(0), points.max(0)], atol=1e-3)
    assert sorted(path.name for path in folder.iterdir()) == ["lod.json", *(level.file for level in built.levels)]
    assert (folder / "oak_LOD0.glb").read_bytes() == TREE.read_bytes()
    for level in built.levels:
        data = (folder / level.file).read_bytes()
        assert glb_counts(data) == (level.vertices, level.triangles) and len(data) == level.bytes
    picture = np.asarray(Image.open(built.folder / "lod.png"))
    assert picture.shape[1] > picture.shape[0] * 0.8 and np.ptp(picture) > 100


def test_started_again_nothing_is_done_twice(built: LodResult) -> None:
    before = {path: path.stat().st_mtime_ns for path in [built.path, *built.folder.rglob("*")] if path.is_file()}
    data, stages = built.path.read_bytes(), set[str]()
    again = build_lod(TREE, built.path, LEVELS, SMALL, on_progress=lambda stage, done, total, note="": stages.add(stage))
    assert again == built and built.path.read_bytes() == data
    assert {path: path.stat().st_mtime_ns for path in before} == before and not stages


def test_another_place_with_the_same_name_gets_its_file(built: LodResult, tmp_path: Path) -> None:
    again = build_lod(TREE, tmp_path / "oak.glb", LEVELS, SMALL, work=built.folder)
    assert again.path.read_bytes() == built.path.read_bytes()


def test_without_the_tree_the_finest_cloud_is_shown_from_the_start(built: LodResult, tmp_path: Path) -> None:
    config = replace(LEVELS, original=False)
    result = build_lod(TREE, tmp_path / "oak.glb", config, replace(SMALL, export=ExportConfig(textures="png")), work=built.folder)
    assert [level.planes for level in result.levels] == [4, 2] and result.levels[0].distance_meters == 0
    assert result.levels[1].distance_meters == built.levels[2].distance_meters
    assert result.path.stat().st_size < built.path.stat().st_size - TREE.stat().st_size / 2


def test_with_costly_triangles_levels_are_rectangles_and_with_cheap_ones_none_is_slower(built: LodResult) -> None:
    """By the files alone: their triangles, and the fragments that lod.json states for each level."""
    work = {"work": built.folder}
    costly = build_lod(TREE, built.path.with_name("costly.glb"), replace(LEVELS, fragments_per_triangle=1e6), SMALL, **work)
    assert [level.planes for level in costly.levels] == [None, 4, 2]
    assert [level.distance_meters for level in costly.levels] == [level.distance_meters for level in built.levels]
    for level, trimmed in zip(costly.levels[1:], built.levels[1:], strict=True):
        assert level.planes and level.triangles == 2 * level.planes < trimmed.triangles
    even = build_lod(TREE, built.path.with_name("costly.glb"), replace(LEVELS, fragments_per_triangle=4.0), SMALL, **work)
    assert [level.file for level in even.levels] == sorted(path.name for path in (built.folder / "levels").glob("costly_LOD*"))
    for finer, level in zip(even.levels, even.levels[1:], strict=False):
        assert level.distance_meters >= level.speed_distance_meters and level.triangles < finer.triangles
        # Both, where the level takes over. The tree itself is measured at the size of the views, and shown larger.
        assert level.fragments and finer.fragments
        scales = [(level.tree_pixels or 64) / (finer.tree_pixels or _pixels_of_views(built))]
        assert 4 * level.triangles + level.fragments <= (4 * finer.triangles + finer.fragments * scales[0] ** 2) * (1 + 1e-6)


def test_thinned_trees_are_levels_between_the_tree_and_the_billboards(built: LodResult) -> None:
    """Their errors are those of Blender's pictures, which smaller trees of the same shape have too."""
    counts = (built.levels[0].triangles // 2, built.levels[0].triangles // 8)
    out = built.path.with_name("thinned.glb")
    result = build_lod(TREE, out, replace(LEVELS, thinned=counts), SMALL, work=built.folder)
    assert [level.planes for level in result.levels] == [None, None, None, 4, 2]
    fine, coarse = result.levels[1:3]
    for level, count in zip((fine, coarse), counts, strict=True):
        assert 0.5 * count < level.triangles <= count and level.psnr
        assert (level.vertices, level.triangles) == glb_counts((built.folder / "levels" / level.file).read_bytes())
    assert fine.error_meters <= coarse.error_meters and fine.psnr > coarse.psnr  # type: ignore[operator]
    assert (fine.psnr or 0) > max(level.psnr or 0 for level in built.levels[1:])
    (drawn,), views = drawn_models([built.folder])
    assert views and drawn.pictures[0] == views.test.paths and drawn.pictures[3:] == ((), ())
    assert {len(pictures) for pictures in drawn.pictures[:3]} == {len(views.test)} and len(set(drawn.pictures[:3])) == 3
    assert all(picture.is_file() for pictures in drawn.pictures for picture in pictures)
    distances = [level.distance_meters for level in result.levels]
    assert distances == sorted(distances) and distances[3:] == [level.distance_meters for level in built.levels[1:]]
    before = {path: path.stat().st_mtime_ns for path in built.folder.rglob("*.png")}
    assert build_lod(TREE, out, replace(LEVELS, thinned=counts), SMALL, work=built.folder) == result
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_thinned_levels_have_integers_where_the_program_reads_them(built: LodResult) -> None:
    count = built.levels[0].triangles // 4
    stages = replace(SMALL, export=ExportConfig(profile="three"))
    (floats, expected), (integers, got) = (
        (result.folder / "levels" / result.levels[1].file, result.levels[1])
        for result in (
            build_lod(TREE, built.path.with_name("thinned.glb"), replace(LEVELS, thinned=(count,)), own, work=built.folder)
            for own in (SMALL, stages)
        )
    )
    assert floats == integers and (got.vertices, got.triangles) == (expected.vertices, expected.triangles)
    assert got.bytes < 0.7 * expected.bytes and got.psnr == pytest.approx(expected.psnr, abs=0.1)
    tree, _ = split_glb(integers.read_bytes())
    assert tree["extensionsRequired"] == ["KHR_mesh_quantization"]
    found = messages(integers)
    assert [message for message in found if message["severity"] <= WARNING] == []


def _pixels_of_views(built: LodResult) -> float:
    """Height of the tree in its views, in pixels at the axis."""
    views = ViewDataset.load(built.folder / "views")
    assert views.request and views.request.tree.bounds and views.request.camera
    low, high = views.request.tree.bounds
    return (high[1] - low[1]) * float(views.train.cameras.intrinsics[0, 0, 0]) / views.request.camera["distance"]


def test_a_level_names_its_run_although_the_fit_removed_billboards(built: LodResult, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = bbfit.lod.run
    monkeypatch.setattr(bbfit.lod, "run", lambda *args, **kwargs: fewer(fitted(*args, **kwargs)))

    def fewer(result: RunResult) -> RunResult:
        return replace(result, cloud=result.cloud.take(range(1, len(result.cloud))))

    strict = replace(LEVELS, color_error=0.15)
    result = build_lod(TREE, built.path.with_name("fewer.glb"), strict, SMALL, work=built.folder)
    assert [(level.planes, level.requested) for level in result.levels] == [(None, None), (3, 4), (1, 2)]
    for level in result.levels[1:]:
        assert (built.folder / str(level.requested) / "cloud.safetensors").is_file()


def test_a_profile_adds_what_its_program_needs(built: LodResult, tmp_path: Path) -> None:
    """Beside other levels in the same folder, and without replacing a file of the user."""
    config = replace(SMALL, export=ExportConfig(profile="babylon", textures="png"))
    (script := built.folder / "levels" / "lod_babylon.js").write_text("mine")
    with pytest.raises(InputError, match=r"lod_babylon\.js exists, and is a file that bbfit did not write"):
        build_lod(TREE, tmp_path / "oak.glb", LEVELS, config, work=built.folder)
    script.unlink()
    strict = replace(LEVELS, color_error=0.02)
    result = build_lod(TREE, tmp_path / "oak.glb", strict, config, work=built.folder)
    finer, level = built.levels[1], result.levels[1]
    assert level.distance_meters == level.color_distance_meters > level.silhouette_distance_meters == finer.silhouette_distance_meters
    assert "addLODLevel" in script.read_text()
    tree, _ = split_glb(result.path.read_bytes())  # Babylon.js shows several levels of one GLB at once
    assert "MSFT_lod" not in tree.get("extensionsUsed", []) and glb_counts(result.path.read_bytes()) == glb_counts(TREE.read_bytes())


def test_a_thinned_tree_goes_through_blender(built: LodResult) -> None:
    count = built.levels[0].triangles // 3
    result = build_lod(TREE, built.path.with_name("thin.glb"), replace(LEVELS, triangles=count), SMALL, work=built.folder)
    assert 0.5 * count < result.levels[0].triangles <= count
    assert "original.glb" in read_json("run", built.folder / "run.json")["stages"]["convert"]["outputs"]


def test_bad_wishes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="billboards: planes sets the number"):
        build_lod(TREE, tmp_path / "oak.glb", LEVELS, replace(SMALL, fit=FitConfig(billboards=8)))
    with pytest.raises(InputError, match=r"out: .* ends in \.obj"):
        build_lod(TREE, tmp_path / "oak.obj", LEVELS, SMALL)
    with pytest.raises(InputError, match="does not exist"):
        build_lod(tmp_path / "none.glb", tmp_path / "oak.glb", LEVELS, SMALL)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"planes": ()}, "planes: expected one or more"),
        ({"planes": (4, 4)}, "planes: expected falling numbers, got 4 4"),
        ({"planes": (2, 4)}, "planes: expected falling"),
        ({"planes": (4, 0)}, "planes: expected at least 1"),
        ({"error_pixels": 0.0}, "error_pixels"),
        ({"triangles": 0}, "triangles"),
        ({"thinned": (50, 100)}, "thinned: expected falling numbers, got 50 100"),
        ({"triangles": 100, "thinned": (100,)}, "thinned: expected falling numbers, got 100 100"),
        ({"screen_width": 0}, "screen_width"),
        ({"fragments_per_triangle": -1.0}, "fragments_per_triangle"),
        ({"screen_fov_degrees": 180.0}, "screen_fov_degrees"),
    ],
)
def test_bad_numbers(bad: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        LodConfig(**bad)  # type: ignore[arg-type]
