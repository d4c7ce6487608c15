"""Pictures by any cameras: the same as views, cut by clip distances but not in what casts shadows, and resumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bbfit.blender.config import ViewsConfig
from bbfit.blender.pictures import PICTURES_FILE, depth_path, frames, render_pictures, vertical_axis
from bbfit.blender.views_folder import render_views
from bbfit.checks import InputError
from bbfit.files import read_json, write_json
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.orbit import hull_vertices
from bbfit.images import read_rgba
from bbfit.views.dataset import ViewDataset

from .conftest import SMALL, box, run_in_blender

CONFIG = ViewsConfig(**SMALL)


def above(extent: float, height: float, size: int = 32) -> Camera:
    """A parallel camera that looks straight down from a height, on ``extent`` meters about the origin."""
    position = torch.tensor([[0.0, height, 0.0]], dtype=torch.float64)
    intrinsics = orthographic_intrinsics(extent, size, size)[None]
    return Camera(look_at(position, torch.zeros(3, dtype=torch.float64)), intrinsics, size, size, True)


def front(count: int = 1, size: int = 32) -> Camera:
    """Parallel cameras at z = 5, looking along -Z at 3 meters about (0.5, 1)."""
    position = torch.tensor([[0.5, 1.0, 5.0]], dtype=torch.float64).repeat(count, 1)
    target = torch.tensor([0.5, 1.0, 0.0], dtype=torch.float64)
    intrinsics = orthographic_intrinsics(3.0, size, size).repeat(count, 1, 1)
    return Camera(look_at(position, target), intrinsics, size, size, True)


def cameras_of(folder: Path) -> Camera:
    """The cameras of four views, in the order of their pictures."""
    views = ViewDataset.load(folder)
    order = [(*views.train.names, *views.test.names).index(f"{k:04}") for k in range(4)]
    parts = (views.train.cameras, views.test.cameras)
    return replace(parts[0], **{n: torch.cat([getattr(p, n) for p in parts])[order] for n in ("world_to_camera", "intrinsics")})


def test_pictures_by_the_cameras_of_views_are_the_views(thing_glb: Path, unbroken: Path, tmp_path: Path) -> None:
    """Bit by bit, light and noise included (the cameras went through a file)."""
    paths = render_pictures(thing_glb, cameras_of(unbroken), tmp_path / "out", CONFIG)
    assert [path.name for path in paths] == [f"{k:04}.png" for k in range(4)]
    for path in paths:
        np.testing.assert_array_equal(read_rgba(path), read_rgba(unbroken / "images" / path.name))


@pytest.mark.parametrize(("given", "training"), [({}, 4), ({"training_samples": 2}, 2)], ids=str)
def test_training_views_have_half_of_the_samples(given: dict[str, int], training: int, thing_glb: Path, tmp_path: Path) -> None:
    """By default. Each view is, bit by bit, the picture with as many samples, and not the other one."""
    config = ViewsConfig(**SMALL | {"samples": 8, "training_samples": None} | given)
    folder = render_views(thing_glb, tmp_path / "views", config)
    views, cameras = ViewDataset.load(folder), cameras_of(folder)
    of_samples = {
        samples: [
            read_rgba(path) for path in render_pictures(thing_glb, cameras, tmp_path / str(samples), replace(config, samples=samples))
        ]
        for samples in (training, 8)
    }
    for split, own, other in ((views.train, training, 8), (views.test, 8, training)):
        for name in split.names:
            view = read_rgba(folder / "images" / f"{name}.png")
            np.testing.assert_array_equal(view, of_samples[own][int(name)])
            assert (view != of_samples[other][int(name)]).any()


def test_only_the_part_of_a_picture_with_the_tree_is_rendered(thing_glb: Path, tmp_path: Path) -> None:
    """With three pixels around it at most. The rest is empty in the whole picture too, which is the same bit by bit."""
    corners = trimesh.load(str(thing_glb), force="mesh").vertices
    (path,) = render_pictures(thing_glb, front(), tmp_path / "out", CONFIG)
    (request,) = frames(front(), [path], [0], [(4.0, 6.0)], CONFIG, hull_vertices(np.asarray(corners)))
    left, bottom, right, top = np.array(request["border"]) * 32
    assert request["border"] != [0, 0, 1, 1]
    rows, columns = np.nonzero(read_rgba(path)[..., 3])
    assert 0 <= columns.min() - left <= 3 and 1 <= right - columns.max() <= 4
    assert 0 <= rows.min() - (32 - top) <= 3 and 1 <= 32 - bottom - rows.max() <= 4
    clips = [(1.0, 9.0)]
    (whole,) = render_pictures(thing_glb, front(), tmp_path / "whole", CONFIG, clips=clips, depth=True)  # for depth, all is rendered
    np.testing.assert_array_equal(read_rgba(whole), read_rgba(path))
    inside = Camera(look_at(torch.zeros(1, 3).double(), torch.tensor([0.0, 0, 1]).double()), pinhole_intrinsics(40, 32, 32)[None], 32, 32)
    assert frames(inside, [path], [0], clips, CONFIG, np.asarray(corners))[0]["border"] is None


def test_hair_beyond_the_vertices_is_rendered(tmp_path: Path) -> None:
    """The needles of a cube of one meter, which are no vertices."""
    script = """
import bpy, os, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 1))
bpy.context.object.modifiers.new("needles", "PARTICLE_SYSTEM")
needles = bpy.context.object.particle_systems[0].settings
needles.type, needles.count, needles.hair_length, needles.render_type = "HAIR", 500, 2.0, "PATH"
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush()
os._exit(0)
"""
    run_in_blender(script, str(tmp_path / "tree.blend"))
    (path,) = render_pictures(tmp_path / "tree.blend", front(), tmp_path / "out", replace(CONFIG, samples=32))
    rows, columns = np.nonzero(read_rgba(path)[..., 3])
    assert columns.max() > 19 and rows.min() < 6, "the cube itself ends in column 16, and begins in row 10"


def test_clip_distances_show_a_slab(thing_glb: Path, tmp_path: Path) -> None:
    """Of the thing seen from +Z: the foot alone, the arm alone between the post's front and back, and nothing, a picture too."""
    clips = [(4.1, 4.7), (4.85, 5.15), (7.0, 8.0)]
    foot, arm, nothing = (read_rgba(path) for path in render_pictures(thing_glb, front(3), tmp_path, CONFIG, clips=clips))

    def bounds(picture: np.ndarray) -> list[float]:
        """Of what is half opaque: left, right, bottom and top in meters."""
        rows, columns = np.nonzero(picture[..., 3] > 127)
        meters = 3.0 / 32
        return [
            0.5 + (columns.min() - 16) * meters,
            0.5 + (columns.max() - 15) * meters,
            1.0 + (15 - rows.max()) * meters,
            1.0 + (16 - rows.min()) * meters,
        ]

    np.testing.assert_allclose(bounds(foot), [-0.1, 0.1, 0.0, 0.3], atol=3 / 32)
    np.testing.assert_allclose(bounds(arm), [0.2, 1.3, 1.5, 1.8], atol=3 / 32)
    assert nothing.shape == (32, 32, 4) and not nothing[..., 3].any()


def test_depth_lies_beside_pictures_and_leaves_them_as_they_are(thing_glb: Path, tmp_path: Path) -> None:
    """The fronts of the post, the arm and the foot, z = 0.2, 0.1 and 0.8, from z = 5; a folder without depth is completed."""
    clips, folder = [(4.0, 6.0)], tmp_path / "out"
    (path,) = render_pictures(thing_glb, front(), folder, CONFIG, clips=clips)
    before = path.read_bytes()
    assert render_pictures(thing_glb, front(), folder, CONFIG, clips=clips, depth=True) == [path]
    assert path.read_bytes() == before
    depth = 4 + 2 * (read_rgba(depth_path(path))[..., 0] / 255)
    places = front()[0].project(torch.tensor([[0.0, 1.0, 0.2], [1.0, 1.65, 0.1], [0.0, 0.15, 0.8], [1.0, 0.5, 0.0]], dtype=torch.float64))
    found = [depth[row, column] for column, row in places.round().int().tolist()]
    np.testing.assert_allclose(found, [4.8, 4.9, 4.2, 6.0], atol=2 / 255)
    told: list[tuple[int, int]] = []
    render_pictures(thing_glb, front(), folder, CONFIG, clips=clips, depth=True, on_progress=lambda *at: told.append(at))
    assert told == [(1, 1)]
    with pytest.raises(InputError, match="give clips"):
        render_pictures(thing_glb, front(), folder, CONFIG, depth=True)


def test_what_is_clipped_still_casts_its_shadow(tmp_path: Path) -> None:
    """A red lid over a white floor, lit by the sun alone from straight above: the floor is seen, white, but for where the lid is above it.

    There it has only the red light that the lid throws back on it.
    """
    floor, lid = box((-2, 0, -2), (2, 0.1, 2), (255, 255, 255)), box((-1, 2, -1), (1, 2.1, 1), (255, 0, 0))
    config = replace(CONFIG, samples=16, sun_strength=3.0, sun_elevation=90.0, ambient_strength=0.0)
    seen = {}
    for name, parts in (("open", [floor]), ("covered", [floor, lid])):
        trimesh.Scene(parts).export(str(tmp_path / f"{name}.glb"))
        paths = render_pictures(tmp_path / f"{name}.glb", above(3.0, 6.0), tmp_path / name, config, clips=[(5.0, 6.5)])
        seen[name] = read_rgba(paths[0]).astype(int)
        assert (seen[name][..., 3] == 255).all()
    lit, shaded = np.zeros((32, 32), bool), np.zeros((32, 32), bool)
    shaded[7:25, 7:25] = True  # [-0.84, 0.84] of the lid's [-1, 1]
    lit[:3] = lit[-3:] = lit[:, :3] = lit[:, -3:] = True
    assert seen["open"][..., :3].min() > 200
    assert seen["covered"][lit][:, :3].min() > 200
    assert seen["covered"][shaded][:, 1:3].max() < 40
    # Without clip distances the camera sees the lid, and that it is red.
    whole = read_rgba(render_pictures(tmp_path / "covered.glb", above(3.0, 6.0), tmp_path / "whole", config)[0])
    assert whole[shaded][:, 0].min() > 200 and whole[shaded][:, 1:3].max() < 80


def test_finished_pictures_are_kept_and_missing_or_damaged_ones_rendered(
    thing_glb: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    told: list[tuple[int, int]] = []
    paths = render_pictures(thing_glb, front(3), tmp_path, CONFIG, on_progress=lambda *at: told.append(at))
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    before = [(path.stat().st_mtime_ns, read_rgba(path)) for path in paths]
    paths[0].unlink()
    paths[2].write_bytes(paths[2].read_bytes()[:-20])
    told.clear()
    again = replace(CONFIG, render_workers=2)  # and those settings that pictures do not depend on
    assert render_pictures(thing_glb, front(3), tmp_path, again, on_progress=lambda *at: told.append(at)) == paths
    assert told == [(1, 3), (2, 3), (3, 3)]
    for path, (_, picture) in zip(paths, before, strict=True):
        np.testing.assert_array_equal(read_rgba(path), picture)
    assert paths[1].stat().st_mtime_ns == before[1][0]
    assert not list(tmp_path.glob(".*"))

    request.getfixturevalue("broken_blender")  # which is not needed
    other = replace(CONFIG, count=50, size=64, elevations=(10.0,), fov_degrees=20.0, orthographic=True, axis="center")
    assert render_pictures(thing_glb, front(3), tmp_path, other) == paths


@pytest.fixture(scope="module")
def one(thing_glb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one picture; not to be changed."""
    folder = tmp_path_factory.mktemp("one")
    render_pictures(thing_glb, front(), folder, CONFIG, clips=[(4.0, 6.0)])
    return folder


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"cameras": front(2), "clips": [(4.0, 6.0)] * 2}, "other cameras"),
        ({"cameras": front(1, 33)}, "other cameras"),
        ({"clips": [(4.0, 6.5)]}, "other clips"),
        ({"clips": None}, "other clips"),
        ({"config": replace(CONFIG, samples=5)}, "samples 4, not 5"),
        ({"config": replace(CONFIG, sun_azimuth=31.0)}, "sun_azimuth 30, not 31"),
    ],
)
def test_a_folder_of_another_request_is_refused_and_left_alone(thing_glb: Path, one: Path, changed: dict, says: str) -> None:
    before = {path.name: path.read_bytes() for path in one.iterdir()}
    asked = {"cameras": front(), "config": CONFIG, "clips": [(4.0, 6.0)]} | changed
    with pytest.raises(InputError, match=says):
        render_pictures(thing_glb, asked["cameras"], one, asked["config"], clips=asked["clips"])
    assert {path.name: path.read_bytes() for path in one.iterdir()} == before


def test_a_folder_of_another_tree_or_from_elsewhere_is_refused(thing_glb: Path, one: Path, tmp_path: Path) -> None:
    trimesh.Scene([box((0, 0, 0), (1, 1, 1), (9, 9, 9))]).export(str(tmp_path / "other.glb"))
    with pytest.raises(InputError, match="another tree"):
        render_pictures(tmp_path / "other.glb", front(), one, CONFIG, clips=[(4.0, 6.0)])
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "0000.png").write_bytes((one / "0000.png").read_bytes())
    with pytest.raises(InputError, match="from elsewhere"):
        render_pictures(thing_glb, front(), strange, CONFIG)
    write_json(strange / PICTURES_FILE, [])
    with pytest.raises(InputError, match="not written by bbfit"):
        render_pictures(thing_glb, front(), strange, CONFIG)


def test_what_stands_in_the_record(one: Path, thing_glb: Path) -> None:
    record = read_json("record", one / PICTURES_FILE)
    assert record["tree"]["name"] == "thing.glb" and record["clips"] == [[4.0, 6.0]]
    assert record["config"]["samples"] == 4 and "count" not in record["config"]
    assert record["cameras"]["size"] == 32 and record["cameras"]["orthographic"] is True


@pytest.mark.parametrize(
    ("cameras", "clips", "says"),
    [
        (replace(front(), height=16), None, "square pictures"),
        (replace(front(), intrinsics=front().intrinsics + torch.tensor([[0, 0, 0.5], [0, 0, 0], [0, 0, 0]])), None, "principal point"),
        (replace(front(), intrinsics=front().intrinsics * torch.tensor([[1, 1, 1], [1, 1.1, 1], [1, 1, 1]])), None, "square pixels"),
        (front(2), [(1.0, 2.0)], "one pair for each of 2"),
        (front(), [(0.0, 2.0)], "0 < nearest < farthest"),
        (front(), [(2.0, 2.0)], "0 < nearest < farthest"),
        (front(), [(1.0, float("inf"))], "0 < nearest < farthest"),
    ],
)
def test_cameras_that_blender_cannot_be_are_refused(thing_glb: Path, tmp_path: Path, cameras: Camera, clips: list, says: str) -> None:
    with pytest.raises(InputError, match=says):
        render_pictures(thing_glb, cameras, tmp_path / "out", CONFIG, clips=clips)
    assert not (tmp_path / "out").exists()


def test_a_single_pinhole_camera_of_any_field_of_view(thing_glb: Path, tmp_path: Path) -> None:
    """The post's top edge, 2 m up, is where the camera projects it."""
    position = torch.tensor([[0.0, 1.0, 4.2]], dtype=torch.float64)
    camera = Camera(look_at(position, torch.tensor([0.0, 1.0, 0.0]).double()), pinhole_intrinsics(57.0, 64, 64)[None], 64, 64)
    (path,) = render_pictures(thing_glb, camera[0], tmp_path, CONFIG)
    rows = np.nonzero(read_rgba(path)[:, 31, 3] > 127)[0]
    edge = camera[0].project(torch.tensor([[0.0, 2.0, 0.2]], dtype=torch.float64))[0, 1]
    assert rows.min() == pytest.approx(float(edge) + 0.5, abs=0.75)


@pytest.mark.parametrize(
    ("low", "axis", "expected"),
    [
        ([-1.0, 0.0, -2.0], "auto", [0.0, 2.0, 0.0]),
        ([-1.0, 0.0, -2.0], "center", [0.5, 2.0, 1.0]),
        ([1.0, 0.0, -2.0], "auto", [1.5, 2.0, 1.0]),
        ([1.0, 0.0, -2.0], "origin", [0.0, 2.0, 0.0]),
    ],
)
def test_vertical_axis(low: list[float], axis: str, expected: list[float]) -> None:
    assert vertical_axis(np.array(low), np.array([2.0, 4.0, 4.0]), axis).tolist() == expected
