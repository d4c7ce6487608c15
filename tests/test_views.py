"""Views folders: bbfit's own, NeRF-synthetic scenes, nerfstudio's intrinsics, and broken ones."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from bbfit.checks import InputError, MissingFileError
from bbfit.evaluation.scoring import evaluate
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import fit
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, write_png
from bbfit.layout import TURNED_FILE, write_turned
from bbfit.operators.drawing.reference import render_reference
from bbfit.views.dataset import ViewDataset


@pytest.fixture
def folder(views_folder: Path, tmp_path: Path) -> Path:
    """A copy of the views that a test may spoil."""
    return Path(shutil.copytree(views_folder, tmp_path / "views"))


def edit(folder: Path, change: Callable[[dict], None], names: tuple[str, ...] = ("train", "test")) -> None:
    for name in names:
        path = folder / f"transforms_{name}.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))


def test_cameras_and_pictures_survive_the_disk(views_folder: Path, known_cloud: BillboardCloud, ring: Camera) -> None:
    views = ViewDataset.load(views_folder)
    assert (len(views.train), len(views.test)) == (12, 4)
    assert not set(views.train.paths) & set(views.test.paths)
    for split in (views.train, views.test):
        numbers = [int(name) for name in split.names]
        torch.testing.assert_close(split.cameras.world_to_camera, ring.world_to_camera[numbers], atol=1e-12, rtol=0)
        torch.testing.assert_close(split.cameras.intrinsics, ring.intrinsics[numbers], atol=1e-9, rtol=0)
        assert split.images([0]).dtype == torch.uint8
        image = render_reference(known_cloud, split.cameras)
        # Straight color and alpha are rounded to bytes: each is off by half a step, and so their product by at most one.
        assert (split.targets(range(len(split))) - image).abs().max() < 1 / 255


def test_nerf_synthetic_scene_without_intrinsics(folder: Path) -> None:
    """`camera_angle_x` alone, other sizes than square: the same cameras, to rounding."""
    expected = ViewDataset.load(folder).train.cameras

    def strip(content: dict) -> None:
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model"):
            del content[key]

    edit(folder, strip)
    torch.testing.assert_close(ViewDataset.load(folder).train.cameras.intrinsics, expected.intrinsics, atol=1e-9, rtol=0)


def test_nerfstudio_intrinsics_per_frame_and_for_another_size(folder: Path) -> None:
    def change(content: dict) -> None:
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x"):
            content.pop(key, None)
        for index, frame in enumerate(content["frames"]):
            frame |= {"w": 96, "h": 80, "fl_x": 100.0 + index, "fl_y": 120.0, "cx": 48.0, "cy": 41.0}

    edit(folder, change)
    camera = ViewDataset.load(folder).train.cameras
    assert (camera.width, camera.height) == (48, 40)
    expected = torch.tensor([[50.5, 0, 23.5], [0, 60, 20.0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(camera.intrinsics[1], expected)


def test_one_file_without_split_gives_a_seeded_quarter(folder: Path) -> None:
    train, test = (json.loads((folder / f"transforms_{name}.json").read_text()) for name in ("train", "test"))
    (folder / "transforms_train.json").unlink()
    (folder / "transforms_test.json").unlink()
    (folder / "transforms.json").write_text(json.dumps(train | {"frames": train["frames"] + test["frames"]}))
    first, again, other = (ViewDataset.load(folder, seed=seed) for seed in (0, 0, 5))
    assert (len(first.train), len(first.test)) == (12, 4)
    assert first.test.paths == again.test.paths != other.test.paths


def test_nerfstudio_split_is_kept(folder: Path) -> None:
    train, test = (json.loads((folder / f"transforms_{name}.json").read_text()) for name in ("train", "test"))
    (folder / "transforms_train.json").unlink()
    (folder / "transforms_test.json").unlink()
    names = {"test_filenames": [frame["file_path"] for frame in train["frames"][:2]]}
    (folder / "transforms.json").write_text(json.dumps(train | names | {"frames": train["frames"] + test["frames"]}))
    views = ViewDataset.load(folder)
    assert [f"./images/{name}" for name in views.test.names] == names["test_filenames"] and len(views.train) == 14


@pytest.fixture
def turned(folder: Path) -> Path:
    """The folder with second pictures of the test views 2 and 0, in this order."""
    test = ViewDataset.load(folder).test
    cameras = test.cameras[[2, 0]].turned(1, torch.tensor([0.1, 0.0, 0.2]))
    paths = [f"images/turned_{test.names[index]}.png" for index in (2, 0)]
    for path, index in zip(paths, (1, 3), strict=True):
        shutil.copy(test.paths[index], folder / path)
    write_turned(folder, cameras, paths, [f"images/{test.names[index]}.png" for index in (2, 0)])
    return folder


def test_turned_views_go_with_their_views(turned: Path, views_folder: Path) -> None:
    views, plain = ViewDataset.load(turned), ViewDataset.load(views_folder)
    assert views.turned is not None and plain.turned is None
    pairs, test = views.turned, views.test
    assert pairs.views.names == [test.names[2], test.names[0]]
    assert pairs.turned.names == [f"turned_{name}" for name in pairs.views.names]
    assert torch.equal(pairs.views.cameras.world_to_camera, test.cameras.world_to_camera[[2, 0]])
    expected = test.cameras[[2, 0]].turned(1, torch.tensor([0.1, 0.0, 0.2]))
    torch.testing.assert_close(pairs.turned.cameras.world_to_camera, expected.world_to_camera, rtol=0, atol=1e-12)
    torch.testing.assert_close(pairs.turned.cameras.intrinsics, expected.intrinsics, rtol=0, atol=1e-9)
    assert all(torch.equal(pairs.turned.image(number), test.image(index)) for number, index in enumerate((1, 3)))
    assert views.fingerprint == plain.fingerprint  # so fits stay current
    assert views.full_fingerprint != plain.full_fingerprint  # but scores do not
    views.check()


def test_scores_depend_on_the_light_of_the_views(folder: Path) -> None:
    def lit(color: list[float]) -> ViewDataset:
        light = {"sun_direction": [0, 1, 0], "sun_strength": 3.0, "sun_color": color, "ambient": 0.4}
        edit(folder, lambda content: content.update(frames=[frame | {"light": light} for frame in content["frames"]]), ("train", "test"))
        return ViewDataset.load(folder)

    white, warm = lit([1, 1, 1]), lit([1, 0.8, 0.6])
    assert white.fingerprint == warm.fingerprint and white.full_fingerprint != warm.full_fingerprint


@pytest.mark.parametrize("of", ["./images/0000_none", None, 3, ["a"]])
def test_turned_from_no_held_out_view_is_refused(turned: Path, of: object) -> None:
    edit(turned, lambda content: content["frames"][1].update(turned_from=of), ("turned",))
    with pytest.raises(InputError, match=rf"frame 1 of .*{TURNED_FILE} is turned from no held-out view; render the views anew"):
        ViewDataset.load(turned)


def test_damaged_turned_pictures_are_named(turned: Path) -> None:
    path = next((turned / "images").glob("turned_*"))
    write_png(path, np.zeros((40, 30, 4), np.uint8))
    with pytest.raises(InputError, match=f"{path.name} is 30x40"):
        ViewDataset.load(turned)
    path.unlink()
    with pytest.raises(MissingFileError, match=path.name):
        ViewDataset.load(turned)


def test_pictures_in_memory_stay_within_the_bound(views_folder: Path) -> None:
    one = 48 * 40 * 4
    views = ViewDataset.load(views_folder, cache_bytes=3 * one)
    pictures = [views.train.image(index) for index in range(len(views.train))]
    kept = [views.train.image(index) is pictures[index] for index in reversed(range(len(views.train)))]
    assert kept == [True] * 3 + [False] * 9, "as many as the bound allows, the last ones"
    assert all(torch.equal(views.train.image(index), picture) for index, picture in enumerate(pictures))


@pytest.mark.parametrize("indices", [[0, 5, 3], [7], [2, 2], [], range(4), [-1]])
def test_some_of_the_views(views_folder: Path, indices: Sequence[int]) -> None:
    """In the order asked for, each picture with its own camera, and decoded once for both."""
    views = ViewDataset.load(views_folder).train
    some, rows = views.take(indices), [int(index) for index in torch.arange(len(views))[list(indices)]]
    assert len(some) == len(some.cameras) == len(rows) and some.names == [views.names[row] for row in rows]
    assert torch.equal(some.cameras.world_to_camera, views.cameras.world_to_camera[rows])
    assert torch.equal(some.cameras.intrinsics, views.cameras.intrinsics[rows])
    assert (some.cameras.width, some.cameras.height) == (views.cameras.width, views.cameras.height)
    assert all(some.image(number) is views.image(row) for number, row in enumerate(rows))
    assert len(views) == 12


def test_all_of_the_views_are_the_views(views_folder: Path) -> None:
    views = ViewDataset.load(views_folder).train
    assert views.take(range(len(views))).fingerprint == views.fingerprint != views.take(range(len(views) - 1)).fingerprint
    assert views.take([1, 0]).take([1, 0]).fingerprint == views.take([0, 1]).fingerprint != views.take([1, 0]).fingerprint


def test_fingerprint_follows_content_not_place(views_folder: Path, folder: Path) -> None:
    before = ViewDataset.load(views_folder).fingerprint
    assert ViewDataset.load(folder).fingerprint == before
    for path in (folder / "images").iterdir():  # the same pixels in another file
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert ViewDataset.load(folder).fingerprint == before
    edit(folder, lambda content: content["frames"][0]["transform_matrix"][0].__setitem__(3, 9.0), ("train",))
    assert ViewDataset.load(folder).fingerprint != before


def first_picture(folder: Path) -> Path:
    return next(iter(ViewDataset.load(folder).train.paths))


def cut_short(folder: Path) -> None:
    path = first_picture(folder)
    path.write_bytes(path.read_bytes()[:-30])


def drop_alpha(folder: Path) -> None:
    path = first_picture(folder)
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., :3])


def make_transparent(folder: Path) -> None:
    write_png(first_picture(folder), np.zeros((40, 48, 4), np.uint8))


def make_smaller(folder: Path) -> None:
    write_png(first_picture(folder), np.full((40, 40, 4), 255, np.uint8))


def remove(folder: Path) -> None:
    first_picture(folder).unlink()


def scribble(folder: Path) -> None:
    first_picture(folder).write_text("no picture")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (cut_short, "cut short"),
        (drop_alpha, "no alpha"),
        (make_transparent, "transparent"),
        (make_smaller, "40x40"),
        (remove, "does not exist"),
        (scribble, "damaged"),
    ],
)
def test_bad_pictures_are_named(folder: Path, spoil: Callable[[Path], None], says: str) -> None:
    name = first_picture(folder).name
    spoil(folder)
    with pytest.raises(InputError, match=says) as caught:
        ViewDataset.load(folder).train.check()
    assert name in str(caught.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda content: content.pop("frames"), "no list of frames"),
        (lambda content: content["frames"][0].pop("file_path"), "no file_path"),
        (lambda content: content["frames"][0].update(transform_matrix=[[1, 2], [3, 4]]), "4x4"),
        (lambda content: content["frames"][0]["transform_matrix"][0].__setitem__(0, math.nan), "4x4"),
        (lambda content: [content.pop(key) for key in ("fl_x", "camera_angle_x")], "camera_angle_x"),
        (lambda content: content.update(fl_x="wide"), "fl_x"),
        (lambda content: content.update(frames=[]), "0 training"),
        (lambda content: content.update(k1=0.1), "distorted"),
        (lambda content: content["frames"][3].update(camera_model="OPENCV_FISHEYE"), "distorted"),
    ],
)
def test_bad_transforms_are_named(folder: Path, change: Callable[[dict], None], says: str) -> None:
    edit(folder, change, ("train",))
    with pytest.raises(InputError, match=says):
        ViewDataset.load(folder)


def test_folders_that_are_no_views(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="does not exist"):
        ViewDataset.load(tmp_path / "nowhere")
    with pytest.raises(InputError, match="not a folder"):
        ViewDataset.load(folder / "transforms_train.json")
    with pytest.raises(MissingFileError, match=r"no transforms_train\.json"):
        ViewDataset.load(tmp_path)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:8])
    with pytest.raises(InputError, match="at least 11x11"):
        ViewDataset.load(folder)
    (folder / "transforms_train.json").write_text('{"frames": [')
    with pytest.raises(InputError, match="not valid JSON"):
        ViewDataset.load(folder)


@pytest.mark.parametrize("tree", ["acer", "quaking_aspen", "weeping_willow"])
def test_shared_views(shared: Path, tree: str) -> None:
    views = ViewDataset.load(shared / "views" / tree)
    assert (len(views.train), len(views.test)) == (68, 22)
    assert (views.train.cameras.width, views.train.cameras.height) == (512, 512)
    camera = views.train.cameras[0]
    # View 0 stands on +Z of the Y-up world, level, and looks at the axis.
    x, y, z = camera.position.tolist()
    assert abs(x) < 1e-9 and y > 0 and z > 10
    torch.testing.assert_close(camera.forward, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))
    # The trunk's base at the origin is where the picture is opaque at the bottom.
    column, row = camera.project(torch.tensor([[0.0, 0.05, 0.0]], dtype=torch.float64))[0].round().int().tolist()
    picture = premultiply(views.train.image(0).float() / 255)
    assert picture[row, column, 3] == 1
    assert picture[row + 20 :, :, 3].max() == 0


@pytest.fixture
def arrays(views_folder: Path, ring: Camera) -> tuple[np.ndarray, Camera]:
    """The pictures of all views in order, uint8 [V, H, W, 4], and their cameras."""
    return np.stack(
        [cv2.cvtColor(cv2.imread(str(path), -1), cv2.COLOR_BGRA2RGBA) for path in sorted((views_folder / "images").iterdir())]
    ), ring


@pytest.mark.parametrize("form", ["uint8", "float", "tensor"])
def test_views_from_arrays_are_those_of_the_folder(form: str, arrays: tuple[np.ndarray, Camera], views_folder: Path) -> None:
    images, cameras = arrays
    given = {"uint8": images, "float": images / np.float32(255), "tensor": torch.from_numpy(images) / 255}[form]
    views = ViewDataset.from_arrays(given, cameras)
    assert views.folder is None and views.test.names == ViewDataset.load(views_folder).test.names
    for split in (views.train, views.test):
        assert torch.equal(split.images(range(len(split))), torch.from_numpy(images[[int(name) for name in split.names]]))
        assert split.cameras.world_to_camera.dtype == torch.float64
    again = ViewDataset.from_arrays(images, cameras)
    assert views.fingerprint == again.fingerprint != ViewDataset.from_arrays(images, cameras, seed=5).fingerprint


def test_held_out_views_of_arrays_are_chosen_by_index(arrays: tuple[np.ndarray, Camera]) -> None:
    views = ViewDataset.from_arrays(*arrays, test=[7, 2])
    assert views.test.names == ["0002", "0007"] and len(views.train) == 14


def test_a_fit_to_arrays_is_that_to_files(arrays: tuple[np.ndarray, Camera], views_folder: Path) -> None:
    """The cameras of files have been through their text."""
    loaded, config = ViewDataset.load(views_folder), FitConfig(billboards=2, placement="even", steps=4)
    cameras = Camera(arrays[1].world_to_camera.clone(), arrays[1].intrinsics.clone(), arrays[1].width, arrays[1].height)
    for split in (loaded.train, loaded.test):
        numbers = [int(name) for name in split.names]
        cameras.world_to_camera[numbers], cameras.intrinsics[numbers] = split.cameras.world_to_camera, split.cameras.intrinsics
    views = ViewDataset.from_arrays(arrays[0], cameras)
    assert views.fingerprint == loaded.fingerprint
    ours, theirs = (fit(each, config).cloud for each in (views, loaded))
    assert torch.equal(ours.texels, theirs.texels)
    assert evaluate(ours, views.test).mean == evaluate(theirs, loaded.test).mean


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda images, cameras: (images[:4], cameras), r"images: expected shape \[16, 40, 48, 4\], got \[4, 40, 48, 4\]"),
        (lambda images, cameras: (images[..., :3], cameras), "images: expected shape"),
        (lambda images, cameras: (images.astype(np.int16), cameras), "images: expected uint8 or floats, got torch.int16"),
        (lambda images, cameras: (images.astype(np.float64), cameras), r"images: floats are not all in \[0, 1\]"),
        (lambda images, cameras: (images * np.float32("nan"), cameras), "images: floats are not all in"),
        (lambda images, cameras: (images * (np.arange(16) != 3)[:, None, None, None].astype(np.uint8), cameras), "images: view 3 is fully"),
        (lambda images, cameras: (images[:1], cameras[:1]), "images: expected at least two views"),
        (lambda images, cameras: (images[:, :9], cameras.resized(48, 9)), "images: they have 48x9 pixels; give at least 11x11"),
    ],
)
def test_arrays_that_are_no_views_are_refused(change: Callable, message: str, arrays: tuple[np.ndarray, Camera]) -> None:
    with pytest.raises(InputError, match=message):
        ViewDataset.from_arrays(*change(*arrays))


@pytest.mark.parametrize("test", [[], [16], [-1], range(16)])
def test_bad_indices_of_held_out_views_are_refused(test: Sequence[int], arrays: tuple[np.ndarray, Camera]) -> None:
    with pytest.raises(InputError, match="test: expected some of the indices 0 to 15"):
        ViewDataset.from_arrays(*arrays, test=test)
