"""Fields of trees in a real browser: how much is drawn, how far it is from the tree, and what is drawn again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards, write_views
from PIL import Image

import bbfit.frames.measurement as measurement
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export, shipped_model
from bbfit.files import write_json
from bbfit.frames.browser import open_pages
from bbfit.frames.config import FramesConfig
from bbfit.frames.errors import size_error
from bbfit.frames.measurement import measure_frames
from bbfit.frames.models import DrawnModel
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import read_rgba

NODE = Path(__file__).parents[1] / "node" / "node_modules"
QUICK = FramesConfig((40, 20), (1, 6), width=200, height=120, frames=2, seconds=0.0, elevation_degrees=5.0, node_modules=NODE)


def opaque() -> BillboardCloud:
    """Two upright opaque rectangles of 2 x 3 meters that cross."""
    cloud = crossing_billboards()
    return cloud.with_texels(torch.tensor([0.8, 0.4, 0.2, 1.0]).expand_as(cloud.texels))


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model."""
    folder = tmp_path_factory.mktemp("oak")
    export(opaque(), folder / "model.glb", ExportConfig(alpha="mask", outline="rectangle"))
    return folder


def test_both_programs_draw_all_copies_and_only_once(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = measure_frames([run_folder], tmp_path, QUICK)
    assert [(row.program.split()[0], row.tree_pixels, row.count) for row in result.rows] == [
        (program, pixels, count) for program in ("three.js", "Babylon.js") for pixels in (40, 20) for count in (1, 6)
    ]
    for row in result.rows:
        assert (row.calls, row.triangles, row.frames) == (1, 4 * row.count, 2)
        assert row.ms > 0 and row.flip is None
        assert row.file_bytes == (run_folder / "model.glb").stat().st_size
    for row in result.rows[:4]:  # of three.js: each copy has two rectangles at a right angle, of 2 x 3 meters with a fading rim of a texel
        assert row.fragments is not None
        meters = row.fragments / row.count / (row.tree_pixels / 3) ** 2 / np.cos(np.radians(5))
        assert 0.95 * 6 < meters < 1.6 * 6 * 2**0.5, (row, meters)
        assert row.card_bytes is not None and row.card_bytes > 0
    # Copies of half the height have a quarter of the fragments.
    assert result.rows[1].fragments == pytest.approx(4 * (result.rows[3].fragments or 0), rel=0.1)

    colors = np.asarray(Image.open(tmp_path / "fields" / f"three_{run_folder.name}_40.png").convert("RGB")).reshape(-1, 3)
    orange = (np.abs(colors.astype(int) - [204, 102, 51]) < 30).all(-1).sum()  # of one copy, of 2 to 2.8 meters by 3
    assert 0.75 * 2 / 3 * 40**2 < orange < 1.1 * 2 / 3 * 2**0.5 * 40**2

    assert {path.name for path in tmp_path.glob("frames.*")} == {"frames.csv", "frames.json", "frames.md", "frames.png"}
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 9
    stored = json.loads((tmp_path / "frames.json").read_text())
    assert "SwiftShader" in stored["machine"]["renderer"] and len(stored["rows"]) == 8
    assert "three.js" in (tmp_path / "frames.md").read_text()

    monkeypatch.setattr(measurement, "planted", lambda *_: pytest.fail("a field was drawn again"))
    assert measure_frames([run_folder], tmp_path, QUICK).rows == result.rows


def test_a_field_that_takes_too_long_is_the_last(run_folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, longest_ms=1e-6, programs=("three",), tree_heights=(20,))
    (row,) = measure_frames([run_folder], tmp_path, config).rows
    assert (row.count, row.frames, row.fragments) == (1, 1, None)


def test_the_error_is_that_of_the_pictures_in_the_program(tmp_path: Path) -> None:
    """Of the very billboards that the views show it is small, and of gray ones it is not."""
    cloud = opaque()
    (tmp_path / "views").mkdir()
    views = write_views(tmp_path / "views", cloud, width=96, height=96).test
    paths = {"same": tmp_path / "same.glb", "gray": tmp_path / "gray.glb"}
    export(cloud, paths["same"], ExportConfig(alpha="blend"))
    export(cloud.with_texels(torch.tensor([0.5, 0.5, 0.5, 1.0]).expand_as(cloud.texels)), paths["gray"], ExportConfig(alpha="blend"))
    with open_pages(replace(QUICK, programs=("three",))) as pages:
        errors = {}
        for name, path in paths.items():
            pages["three"].answers["model.glb"] = path
            files = [{"url": f"/model.glb?{name}", "distance": 0}]
            pages["three"].call("load", {"kind": "mesh", "files": files, "extent": {"low": [-1, 0, -1], "high": [1, 3, 1]}})
            for pixels in (60, 30):
                errors[name, pixels] = size_error(DrawnModel(name, name, "mesh", (path,)), pages["three"], views, pixels, 4)
    for pixels in (60, 30):
        same, gray = errors["same", pixels], errors["gray", pixels]
        assert same is not None and gray is not None
        assert same.tree_pixels == pytest.approx(pixels, rel=0.05)
        assert same.psnr > 28 and same.flip < 0.03
        assert gray.flip > 5 * same.flip


def test_the_error_of_a_lit_level_is_that_of_blenders_pictures_of_it(tmp_path: Path) -> None:
    """Of the level that is shown: the finer one has the views themselves as pictures, and the coarser one has none."""
    cloud, names = opaque(), ("finer.glb", "coarser.glb")
    (tmp_path / "views").mkdir()
    views = write_views(tmp_path / "views", cloud, width=96, height=96).test
    for name in names:
        export(cloud, tmp_path / name, ExportConfig(material="pbr"))
    distances = (0.0, 3 / 45)  # a tree of 3 meters is 45 pixels high there
    files = [{"url": f"/{name}?lit", "distance": distance} for name, distance in zip(names, distances, strict=True)]
    model = DrawnModel("oak", "oak", "levels", tuple(tmp_path / name for name in names), distances, (views.paths, ()))
    with open_pages(replace(QUICK, programs=("three",))) as pages:
        page = pages["three"]
        page.answers.update({name: tmp_path / name for name in names})
        page.call("load", {"kind": "levels", "files": files, "extent": {"low": [-1, 0, -1], "high": [1, 3, 1]}})
        near, far = (size_error(model, page, views, pixels, 4) for pixels in (60, 30))
        assert near is not None and (near.flip, near.psnr) == (0.0, None)
        assert far is None
        assert size_error(replace(model, pictures=()), page, views, 60, 4) is None
        Image.new("RGBA", (96, 96), (128, 128, 128, 255)).save(tmp_path / "gray.png")
        gray = size_error(replace(model, pictures=((), (tmp_path / "gray.png",) * len(views))), page, views, 30, 4)
        assert gray is not None and gray.flip > 0.1


def test_the_coarser_level_is_drawn_at_the_smaller_size(tmp_path: Path) -> None:
    """Levels of one and of two billboards; the switch lies between the heights."""
    levels = tmp_path / "oak" / "levels"
    levels.mkdir(parents=True)
    clouds = [opaque(), BillboardCloud.joined([opaque(), opaque()])]
    entries = []
    for number, (cloud, pixels) in enumerate(zip(clouds[::-1], (1000.0, 30.0), strict=True)):
        model = shipped_model(cloud, ExportConfig(alpha="mask", outline="rectangle"))
        (levels / f"oak_LOD{number}.glb").write_bytes(model.glb)
        distance = 0.0 if number == 0 else 3 / pixels * 100 / 2 / np.tan(np.radians(20))
        entry = {"name": f"oak_LOD{number}", "planes": len(cloud), "file": f"oak_LOD{number}.glb", "distance_meters": distance}
        zeros = ("error_meters", "error_pixels", "held_out_error_pixels", "screen_coverage", "silhouette_distance_meters")
        entry |= dict.fromkeys((*zeros, "color_distance_meters", "color_error", "held_out_color_error"), 0.0)
        entries.append(entry | {"vertices": 8, "triangles": 4, "bytes": 1, "psnr": None, "tree_pixels": None})
    write_json(levels / "lod.json", {"levels": entries, "config": {"screen_height": 100, "screen_fov_degrees": 40.0}})
    config = replace(QUICK, programs=("three", "babylon"), counts=(5,))
    large, small = measure_frames([tmp_path / "oak"], tmp_path / "out", config).rows
    assert (large.triangles, small.triangles) == (5 * 8, 5 * 4)
    assert (large.calls, small.calls) == (1, 1)


def test_cycles_renders_all_copies_of_a_model_that_is_in_memory_once(run_folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, programs=("cycles",), cycles_counts=(1, 40), samples=1, tree_heights=(40,))
    one, many = measure_frames([run_folder], tmp_path, config).rows
    assert (one.triangles, many.triangles) == (4, 160)
    assert 0 < one.ms and one.card_bytes is not None and many.card_bytes is not None
    assert 50e6 < one.card_bytes < many.card_bytes + 50e6 < one.card_bytes + 150e6
    picture = read_rgba(tmp_path / "fields" / f"cycles_{run_folder.name}_40.png")
    rows, columns = np.nonzero(picture[..., 3] > 128)
    assert picture.shape == (120, 120, 4)
    assert np.ptp(rows) + 1 == pytest.approx(40, abs=4) and 2 / 3 * 40 - 4 < np.ptp(columns) + 1 < 2 / 3 * 40 * 2**0.5 + 4
