"""The NeRF-synthetic layout on disk: what is written is read back, and what others write is understood."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bbfit.checks import InputError, MissingFileError
from bbfit.geometry.camera import Camera, camera_from_nerf
from bbfit.geometry.light import Light
from bbfit.geometry.orbit import Orbit
from bbfit.layout import LitPaths, cameras_of, read_frames, read_lit, split_rings, split_views, write_lit, write_transforms

POSE = [[1.0, 0, 0, 0], [0, 0, -1, -22], [0, 1, 0, 5], [0, 0, 0, 1]]


def orbit(fov: float | None) -> Camera:
    points = np.random.default_rng(0).normal(size=(20, 3))
    return Orbit(6, (0.0, 30.0)).frame(points, target=torch.zeros(3).double(), width=30, height=20, fov_x_degrees=fov)


def write(folder: Path, *, name: str = "transforms_train.json", frames: Any = None, **header: Any) -> None:
    """A transforms file with one frame at ``POSE``, or with the given ones."""
    frames = [{"file_path": "./images/r_0", "transform_matrix": POSE}] if frames is None else frames
    (folder / name).write_text(json.dumps(header | {"frames": frames}))


def intrinsics(folder: Path, width: int, height: int) -> list[list[float]]:
    return cameras_of(read_frames(folder)[0], width, height).intrinsics[0].tolist()


@pytest.mark.parametrize("fov", [40.0, None])
def test_cameras_round_trip(tmp_path: Path, fov: float | None) -> None:
    camera = orbit(fov)
    write_transforms(tmp_path, camera, [f"images/{i:04}.png" for i in range(6)], [0, 2, 3, 5], [1, 4])
    train, test = read_frames(tmp_path)
    assert test is not None
    assert [frame.image for frame in train] == [tmp_path / f"images/{i:04}.png" for i in (0, 2, 3, 5)]
    for frames, indices in ((train, [0, 2, 3, 5]), (test, [1, 4])):
        read = cameras_of(frames, 30, 20)
        assert (read.width, read.height, read.orthographic) == (30, 20, fov is None)
        assert torch.allclose(read.world_to_camera, camera.world_to_camera[indices], atol=1e-12)
        assert torch.allclose(read.intrinsics, camera.intrinsics[indices], atol=1e-12)


def test_what_is_written_is_what_others_read(tmp_path: Path) -> None:
    """``camera_angle_x`` spans pixel edges; nerfstudio's principal point counts from the corner; file names have no ending."""
    write_transforms(tmp_path, orbit(40.0), [f"images/{i}.png" for i in range(6)], [0, 1, 2, 3, 4], [5])
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    assert content["camera_angle_x"] == pytest.approx(math.radians(40))
    assert (content["w"], content["h"], content["cx"], content["cy"]) == (30, 20, 15, 10)
    assert content["fl_x"] == content["fl_y"] == pytest.approx(15 / math.tan(math.radians(20)))
    assert content["frames"][0]["file_path"] == "./images/0"
    # The first camera of an orbit looks from our +Z, which is -Y in a Z-up world; OpenGL axes: right +X, up +Z, backward -Y.
    pose = np.array(content["frames"][0]["transform_matrix"])
    assert np.allclose(pose[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]) and pose[1, 3] < 0 and np.allclose(pose[[0, 2], 3], 0)


def test_nerf_synthetic_and_nerfstudio_intrinsics(tmp_path: Path) -> None:
    angle = 2 * math.atan(0.5)
    write(tmp_path, camera_angle_x=angle)
    assert np.allclose(intrinsics(tmp_path, 30, 20), [[30, 0, 14.5], [0, 30, 9.5], [0, 0, 1]])

    write(tmp_path, fl_x=100, fl_y=90, cx=33, cy=21, w=60, h=40, camera_angle_x=angle)
    assert np.allclose(intrinsics(tmp_path, 60, 40), [[100, 0, 32.5], [0, 90, 20.5], [0, 0, 1]])
    # The same file with pictures of half the size: the optical axis stays at the same share of the picture.
    assert np.allclose(intrinsics(tmp_path, 30, 20), [[50, 0, 16], [0, 45, 10], [0, 0, 1]])

    write(tmp_path, fl_x=100)
    assert np.allclose(intrinsics(tmp_path, 30, 20), [[100, 0, 14.5], [0, 100, 9.5], [0, 0, 1]])

    own = {"file_path": "a", "transform_matrix": POSE, "fl_x": 50}
    write(tmp_path, frames=[own, {"file_path": "b.png", "transform_matrix": POSE}], fl_x=100)
    camera = cameras_of(read_frames(tmp_path)[0], 30, 20)
    assert camera.intrinsics[:, 0, 0].tolist() == [50, 100]
    assert camera.world_to_camera[0].equal(camera_from_nerf(torch.tensor([POSE], dtype=torch.float64))[0])


def test_file_names(tmp_path: Path) -> None:
    names = {"./images/r_0": "images/r_0.png", "r_0.5": "r_0.5.png", "a.png": "a.png", "b.WEBP": "b.WEBP", "c.jpg": "c.jpg"}
    write(tmp_path, frames=[{"file_path": name, "transform_matrix": POSE} for name in names], fl_x=9)
    assert [frame.image for frame in read_frames(tmp_path)[0]] == [tmp_path / expected for expected in names.values()]


def test_which_files_are_read(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"^views: .*has no transforms_train\.json"):
        read_frames(tmp_path)
    write(tmp_path, name="transforms.json", fl_x=1)
    train, test = read_frames(tmp_path)
    assert len(train) == 1 and test is None
    two = [{"file_path": n, "transform_matrix": POSE} for n in "ab"]
    write(tmp_path, name="transforms_train.json", frames=two, fl_x=1)
    write(tmp_path, name="transforms_test.json", fl_x=1)
    train, test = read_frames(tmp_path)
    assert len(train) == 2 and test is not None and len(test) == 1


SCALED = [[2.0, 0, 0, 0], [0, 0, -2, -22], [0, 2, 0, 5], [0, 0, 0, 1]]
MIRRORED = [[-1.0, 0, 0, 0], [0, 0, -1, -22], [0, 1, 0, 5], [0, 0, 0, 1]]
PROJECTIVE = [[1.0, 0, 0, 0], [0, 0, -1, -22], [0, 1, 0, 5], [0, 0, 0.5, 1]]
NAN = [[1.0, 0, 0, 0], [0, 0, -1, float("nan")], [0, 1, 0, 5], [0, 0, 0, 1]]
BAD_POSES = [None, "pose", [], POSE[:3], [[1, 2], [3]], np.zeros((4, 4)).tolist(), SCALED, MIRRORED, PROJECTIVE, NAN]


@pytest.mark.parametrize("pose", BAD_POSES)
def test_poses_that_are_no_camera_are_refused(tmp_path: Path, pose: Any) -> None:
    write(tmp_path, frames=[{"file_path": "a", "transform_matrix": POSE}, {"file_path": "b", "transform_matrix": pose}])
    with pytest.raises(InputError, match=r"^views: frame 1 of .*transforms_train\.json has no rigid 4x4"):
        read_frames(tmp_path)


def test_a_pose_with_four_decimals_is_accepted(tmp_path: Path) -> None:
    rounded = [[0.9976, 0, 0.0698, 1], [0.0698, 0, -0.9976, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    write(tmp_path, frames=[{"file_path": "a", "transform_matrix": rounded}], fl_x=9)
    assert len(read_frames(tmp_path)[0]) == 1


@pytest.mark.parametrize("content", ["[]", "{}", '{"frames": {}}', '{"frames": [1]}', '{"frames": [{"file_path": 3}]}', "{", ""])
def test_other_json_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "transforms_train.json").write_text(content)
    with pytest.raises(InputError, match=r"^views: .*transforms_train\.json"):
        read_frames(tmp_path)


@pytest.mark.parametrize(
    "header",
    [
        {},
        {"fl_x": 0},
        {"fl_x": -5},
        {"fl_x": "wide"},
        {"fl_x": None},
        {"fl_x": 10, "w": 0},
        {"fl_x": 10, "cx": float("nan")},
        {"camera_angle_x": 0},
        {"camera_angle_x": -1},
        {"camera_angle_x": float("inf")},
        {"camera_angle_x": []},
    ],
)
def test_unusable_intrinsics_are_refused(tmp_path: Path, header: dict[str, Any]) -> None:
    write(tmp_path, **header)
    with pytest.raises(InputError, match="neither a usable fl_x nor camera_angle_x"):
        cameras_of(read_frames(tmp_path)[0], 30, 20)


@pytest.mark.parametrize(("count", "tests"), [(1, 0), (2, 1), (3, 1), (4, 1), (6, 2), (90, 22), (100, 25)])
def test_a_seeded_quarter_is_held_out(count: int, tests: int) -> None:
    train, test = split_views(count, 7)
    assert len(test) == tests and sorted(train + test) == list(range(count))
    assert train == sorted(train) and test == sorted(test)
    assert split_views(count, 7) == (train, test)
    if count > 50:
        assert split_views(count, 8) != (train, test)


@pytest.mark.parametrize("counts", [(2,), (90,), (44, 15, 13, 11, 7), (3, 1, 9), (1, 5)])
def test_the_test_views_of_a_ring_are_spread_around_the_tree(counts: tuple[int, ...]) -> None:
    train, test = split_rings(counts, 7)
    assert sorted(train + test) == list(range(sum(counts))) and train == sorted(train) and test == sorted(test)
    assert split_rings(counts, 7) == (train, test)
    begin = 0
    for count in counts:
        held = [index - begin for index in test if begin <= index < begin + count]
        assert len(held) == (len(split_views(count, 0)[1]) if count > 1 else 0)
        assert all(count * part // len(held) <= index < count * (part + 1) // len(held) for part, index in enumerate(held))
        begin += count
    if len(test) > 5:
        assert split_rings(counts, 8) != (train, test)


def test_rings_of_one_view_share_the_test_views() -> None:
    train, test = split_rings((1, 1, 1, 1), 0)
    assert len(test) == 1 and sorted(train + test) == [0, 1, 2, 3]


def test_shared_views(shared: Path) -> None:
    for folder in sorted((shared / "views").iterdir()):
        train, test = read_frames(folder)
        assert test is not None and (len(train), len(test)) == (68, 22)
        assert all(frame.image.is_file() for frame in train + test)
        camera = cameras_of(train, 512, 512)
        assert camera.intrinsics[0, 0, 0].item() == pytest.approx(256 / math.tan(math.radians(20)))


def lit_paths(index: int, directions: torch.Tensor) -> LitPaths:
    suns = [f"images/{index}_sun{number}.png" for number in range(len(directions))]
    return LitPaths(f"images/{index}_ambient.png", suns, directions, f"images/{index}_albedo.png", f"images/{index}_normal.png")


def test_lights_round_trip(tmp_path: Path) -> None:
    """Directions are in the file's Z-up axes, the sky and each sun have frames of their own, and passes belong to the sky."""
    camera, directions = orbit(40.0), torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]).double()
    write_lit(tmp_path, camera, {index: lit_paths(index, directions) for index in (0, 2, 5)}, [0, 2], [5])
    first = json.loads((tmp_path / "transforms_lights_train.json").read_text())["frames"]
    assert first[0]["light"] == {"sun_strength": 0.0, "ambient": 1.0} and first[0]["albedo_path"] == "./images/0_albedo"
    light = first[1]["light"]
    assert light.pop("sun_direction") == pytest.approx([0.0, -0.8, 0.6])
    assert light == {"sun_strength": math.pi, "sun_color": [1.0, 1.0, 1.0], "ambient": 0.0}
    read = read_lit(tmp_path)
    assert read is not None and [len(frames) for frames in read] == [6, 3]
    assert read[0][3].passes == {"albedo": tmp_path / "images/2_albedo.png", "normal": tmp_path / "images/2_normal.png"}
    for frame, sun in zip(read[0][4:], directions, strict=True):
        assert frame.light is not None and not frame.passes
        torch.testing.assert_close(frame.light.sun_directions[0], sun)
    torch.testing.assert_close(cameras_of(read[1], 30, 20).world_to_camera, camera.world_to_camera[[5, 5, 5]])


def test_light_of_all_pictures_is_in_every_frame(tmp_path: Path) -> None:
    write_transforms(
        tmp_path, orbit(40.0), [f"images/{i}.png" for i in range(6)], [0, 1, 2], [3, 4, 5], Light.of(torch.eye(3)[:1], 2.5, 1.0)
    )
    for frames in read_frames(tmp_path):
        assert frames is not None
        assert [(frame.light and frame.light.sun_directions.tolist()) for frame in frames] == [[[1.0, 0.0, 0.0]]] * 3


@pytest.mark.parametrize(
    "light",
    [
        5,
        {"sun_strength": 1.0, "ambient": 0.0},
        {"sun_direction": [0, 0], "sun_strength": 1.0},
        {"sun_direction": [0, 0, 0], "sun_strength": 1.0},
        {"sun_direction": [0, 0, 1e300], "sun_strength": 1.0},
        {"sun_direction": [0, 0, 1], "sun_strength": -1.0},
        {"sun_direction": [0, 0, 1], "sun_strength": math.nan},
        {"sun_direction": [0, 0, 1], "sun_strength": "1e"},
        {"sun_direction": [0, 0, 1], "sun_strength": 1.0, "sun_color": [1, 1]},
        {"sun_direction": [0, 0, 1], "sun_strength": 1.0, "sun_color": [1, 1, -1]},
    ],
)
def test_light_that_is_none_is_refused(tmp_path: Path, light: Any) -> None:
    write(tmp_path, frames=[{"file_path": "r_0", "transform_matrix": POSE, "light": light}])
    with pytest.raises(InputError, match=r"frame 0 of .* has no usable light; give a direction, strengths and a color"):
        read_frames(tmp_path)


def test_lit_frames_have_one_light_each(tmp_path: Path) -> None:
    """A frame without a light, with a sun and a sky, or with neither is refused, and so is one file without the other."""
    frame = {"file_path": "r_0", "transform_matrix": POSE}
    sun = {"sun_direction": [0, 0, 1], "sun_strength": 1.0}
    for light in ({}, {"light": sun | {"ambient": 1.0}}, {"light": {"ambient": 0.0}}):
        for name in ("train", "test"):
            write(tmp_path, name=f"transforms_lights_{name}.json", frames=[frame | light])
        with pytest.raises(InputError, match=r"frame 0 of .*transforms_lights_train.json has not exactly one light"):
            read_lit(tmp_path)
    (tmp_path / "transforms_lights_test.json").unlink()
    with pytest.raises(MissingFileError, match=r"transforms_lights_test.json does not exist"):
        read_lit(tmp_path)
