"""Reading folders, and finding the original."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.lod import LodLevel
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import joined_glb, split_glb
from bbfit.viewing.originals import find_original
from bbfit.viewing.viewed import open_results

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture
def copied(small_run: Path, tmp_path: Path) -> Path:
    """A copy of the small run to spoil."""
    return Path(shutil.copytree(small_run, tmp_path / "run"))


def test_a_run_has_its_tree_and_its_billboards(small_run: Path) -> None:
    tree = open_results(small_run)
    assert tree.original.glb == (DATA / "tree.glb").read_bytes()
    assert [level.name for level in tree.levels] == ["original", "4 billboards"]
    assert [level.scale for level in tree.levels] == [math.inf, None]
    assert tree.views == (DATA / "views").resolve()
    assert tree.export.textures == "png"
    # What the billboards show is where the tree is.
    known = np.array(json.loads((DATA / "views" / "views.json").read_text())["tree"]["bounds"])
    np.testing.assert_allclose(tree.bounds[:, 1], known[:, 1], atol=0.1)
    np.testing.assert_allclose(tree.bounds, known, atol=0.6)


def test_views_beside_a_run_of_other_views_are_not_its_views(copied: Path) -> None:
    (copied.parent / "views").mkdir()
    assert open_results(copied).views == (DATA / "views").resolve()


def edited(folder: Path, change: dict[str, Any]) -> Path:
    """The folder, with changes to its run.json; those of ``config`` are merged into it."""
    record = json.loads((folder / "run.json").read_text())
    record["config"] |= change.pop("config", {})
    (folder / "run.json").write_text(json.dumps(record | change))
    return folder


def test_a_run_of_views_alone_shows_no_tree_and_says_so(copied: Path) -> None:
    tree = open_results(edited(copied, {"config": {"tree": None}}))
    assert [level.name for level in tree.levels] == ["4 billboards"]
    assert "views alone" in tree.original.note


@pytest.mark.parametrize(("source", "message"), [("gone.glb", "no longer exists"), ("tree.fbx", "only Blender reads tree.fbx")])
def test_a_tree_that_is_gone_or_takes_blender_is_a_note(copied: Path, tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "tree.fbx").write_bytes(b"fbx")
    tree = open_results(edited(copied, {"source": str(tmp_path / source)}))
    assert tree.original.glb is None
    assert message in tree.original.note
    assert len(tree.levels) == 1


def test_a_run_without_its_record_is_shown_alone(copied: Path) -> None:
    (copied / "run.json").unlink()
    tree = open_results(copied)
    assert len(tree.levels) == 1
    assert "no run.json" in tree.notes[0]


@pytest.mark.parametrize("text", ["{", "[]", '{"source": 1, "config": {}}'])
def test_a_damaged_record_is_an_error(copied: Path, text: str) -> None:
    (copied / "run.json").write_text(text)
    with pytest.raises(InputError, match=r"run\.json"):
        open_results(copied)


def test_a_record_that_names_no_possible_file_is_an_error(copied: Path) -> None:
    with pytest.raises(InputError, match=r"^run: .* cannot be read \(File name too long\); start bbfit again"):
        open_results(edited(copied, {"source": "9" * 5000}))


def test_a_damaged_cloud_is_an_error(copied: Path) -> None:
    (copied / "cloud.safetensors").write_bytes(b"no tensors")
    with pytest.raises(InputError, match="damaged"):
        open_results(copied)


def test_folders_of_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="does not exist"):
        open_results(tmp_path / "nothing")
    with pytest.raises(InputError, match="not a folder"):
        open_results(DATA / "tree.glb")
    with pytest.raises(InputError, match=r"holds no cloud\.safetensors; give the folder that"):
        open_results(DATA / "views")


def lod_level(**known: object) -> LodLevel:
    """A level with some values, and zeros or nothing for the others."""
    kinds = {field.name: field.type for field in fields(LodLevel) if field.default is MISSING}
    values = {name: {"str": "", "int": 0, "float": 0.0}.get(str(kind)) for name, kind in kinds.items()}
    return LodLevel(**(values | known))  # type: ignore[arg-type]


def lod_folder(folder: Path, cloud: BillboardCloud, *, original: bool = True, thinned: bool = False) -> Path:
    """A folder as bbfit lod leaves it: two billboards from 10 m, one from 40 m, for a screen whose focal length is 1000 pixels.

    Three billboards were requested for the first of them, of which the fit removed one.
    """
    levels = [lod_level()] if original else []
    levels += [lod_level(psnr=30.0, triangles=1234, distance_meters=5.0 if original else 0.0)] if thinned else []
    for requested, planes, distance in ((3, 2, 10.0 if levels else 0.0), (1, 1, 40.0)):
        (folder / str(requested)).mkdir(parents=True)
        cloud.take(range(planes)).save(folder / str(requested) / "cloud.safetensors")
        record = {"source": str(folder / "views"), "config": {"tree": str(DATA / "tree.glb"), "export": {"profile": "three"}}}
        (folder / str(requested) / "run.json").write_text(json.dumps(record))
        levels.append(lod_level(planes=planes, requested=requested, distance_meters=distance, halvings=int(distance > 0)))
    config = {"screen_height": 2000, "screen_fov_degrees": 90.0}
    (folder / "levels").mkdir()
    (folder / "levels" / "lod.json").write_text(json.dumps({"config": config, "levels": [asdict(level) for level in levels]}))
    return folder


def test_levels_of_detail_come_from_their_folder(tmp_path: Path, known_cloud: BillboardCloud) -> None:
    tree = open_results(lod_folder(tmp_path / "lod", known_cloud))
    assert [level.name for level in tree.levels] == ["original", "2 billboards", "1 billboard"]
    assert [level.scale for level in tree.levels] == [math.inf, pytest.approx(100.0), pytest.approx(25.0)]
    assert tree.export.profile == "three"


def test_levels_of_detail_without_the_tree_begin_with_billboards(tmp_path: Path, known_cloud: BillboardCloud) -> None:
    tree = open_results(lod_folder(tmp_path / "lod", known_cloud, original=False))
    assert [(level.name, level.scale) for level in tree.levels] == [("2 billboards", math.inf), ("1 billboard", pytest.approx(25.0))]
    assert tree.original.glb is not None  # to compare with


def test_levels_of_a_thinned_out_tree_are_a_note(tmp_path: Path, known_cloud: BillboardCloud) -> None:
    tree = open_results(lod_folder(tmp_path / "lod", known_cloud, original=False, thinned=True))
    assert [(level.name, level.scale) for level in tree.levels] == [("2 billboards", math.inf), ("1 billboard", pytest.approx(25.0))]
    assert tree.levels[0].halvings == 0
    assert tree.notes == ("not shown here: the tree thinned out to 1,234 triangles",)


@pytest.mark.parametrize("text", ["{", "{}", '{"config": {"screen_height": 1, "screen_fov_degrees": 50}, "levels": []}'])
def test_damaged_levels_of_detail_are_an_error(tmp_path: Path, known_cloud: BillboardCloud, text: str) -> None:
    folder = lod_folder(tmp_path / "lod", known_cloud)
    (folder / "levels" / "lod.json").write_text(text)
    with pytest.raises(InputError, match=r"lod\.json"):
        open_results(folder)


def test_a_glb_is_sent_as_it_is_up_to_a_size() -> None:
    size = (DATA / "tree.glb").stat().st_size
    assert find_original([DATA / "tree.glb"], size).glb == (DATA / "tree.glb").read_bytes()
    refused = find_original([DATA / "tree.glb"], size - 1)
    assert refused.glb is None
    assert "--original-bytes" in refused.note


def test_other_meshes_are_converted_and_stand_upright(tmp_path: Path) -> None:
    """A PLY is Z up: what is high there is high in the GLB."""
    trimesh.creation.box((1.0, 2.0, 6.0)).export(tmp_path / "tree.ply")
    found = find_original([tmp_path / "tree.ply"])
    assert found.glb is not None
    assert found.note == "converted from tree.ply"
    (tmp_path / "again.glb").write_bytes(found.glb)
    np.testing.assert_allclose(trimesh.load_scene(tmp_path / "again.glb").extents, [1.0, 6.0, 2.0], atol=1e-6)


def test_what_the_page_cannot_unpack_is_refused(tmp_path: Path) -> None:
    glb = (DATA / "tree.glb").read_bytes()
    tree, views = split_glb(glb)
    tree |= {"extensionsUsed": ["KHR_draco_mesh_compression"], "extensionsRequired": ["KHR_draco_mesh_compression"]}
    (tmp_path / "packed.glb").write_bytes(joined_glb(tree, views))
    assert "KHR_draco_mesh_compression" in find_original([tmp_path / "packed.glb"]).note


def test_a_broken_mesh_is_a_note(tmp_path: Path) -> None:
    (tmp_path / "tree.glb").write_bytes(b"glTF and nothing more")
    assert "cannot be shown" in find_original([tmp_path / "tree.glb"]).note
