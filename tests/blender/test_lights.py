"""Pictures of views under one light at a time (``ViewsConfig.suns``)."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from bbfit.blender.config import ViewsConfig
from bbfit.blender.lit_pictures import HELD_OUT_SUNS
from bbfit.blender.pictures import render_pictures
from bbfit.blender.views_folder import render_views
from bbfit.checks import InputError
from bbfit.images import read_rgba, srgb_to_linear, sum_of_lights
from bbfit.views.dataset import ViewDataset
from tests.blender.conftest import SMALL, box, thing

CONFIG = ViewsConfig(**SMALL | {"count": 8, "samples": 16, "training_samples": 16, "suns": 2, "turned": 1})


@pytest.fixture(scope="module")
def folder(thing_glb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of ``thing`` under many lights."""
    return render_views(thing_glb, tmp_path_factory.mktemp("lit") / "views", CONFIG)


def picture(folder: Path, name: str) -> NDArray[np.uint8]:
    return read_rgba(folder / "images" / f"{name}.png")


def premultiplied(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    return image[..., :3] * (image[..., 3:] / 255)


def test_split_covers_cameras_and_suns(folder: Path) -> None:
    """Training cameras have different suns, held-out ones the same four others; the first sun of all is the baked one."""
    views = ViewDataset.load(folder)
    train, test = views.lit_train, views.lit_test
    assert train is not None and test is not None and (len(views.train), len(views.test)) == (6, 2)
    assert (len(train.skies), len(train)) == (6, 6 * 3) and (len(test.skies), len(test)) == (2, 2 * (1 + HELD_OUT_SUNS))
    baked = torch.tensor([math.cos(math.pi / 4) * 0.5, math.sin(math.pi / 4), math.cos(math.pi / 4) * math.cos(math.pi / 6)]).double()
    for lit in (train, test):
        torch.testing.assert_close(lit.directions.unflatten(0, (len(lit.skies), -1))[:, 0], baked.expand(len(lit.skies), 3))
    seen, held = train.directions.unflatten(0, (6, 3))[:, 1:].flatten(0, 1), test.directions.unflatten(0, (2, 5))[:, 1:]
    assert torch.equal(held[0], held[1])
    angles = torch.rad2deg(torch.acos((seen @ seen.T).clamp(-1, 1))) + 180 * torch.eye(12)
    assert angles.min() > 15 and torch.rad2deg(torch.acos(seen @ held[0].T)).min() > 1
    assert torch.cat([seen, held[0]])[:, 1].min() >= math.sin(math.radians(10))
    for cameras, lit in ((views.train.cameras, train), (views.test.cameras, test)):
        assert torch.equal(lit.skies.cameras.world_to_camera, cameras.world_to_camera)
        assert torch.equal(lit.suns.cameras.world_to_camera, cameras.world_to_camera[list(lit.cameras)])
    assert views.train.light is not None and views.train.light.sun_strengths.tolist() == [2.5] * 6
    torch.testing.assert_close(views.train.light.sun_directions, baked.expand(6, 3))


def test_own_picture_is_the_sum_of_its_lights(folder: Path) -> None:
    """To the rounding of each part: at most two bytes."""
    for name in ViewDataset.load(folder).train.names:
        total = sum_of_lights([picture(folder, f"{name}_{kind}") for kind in ("ambient", "sun0")], [1.0, 2.5 / math.pi])
        own = picture(folder, name)
        np.testing.assert_array_equal(total[..., 3], own[..., 3])
        assert abs(premultiplied(total) - premultiplied(own)).max() <= 2


def test_a_picture_under_a_sun_is_that_of_a_render_with_that_sun(folder: Path, thing_glb: Path, tmp_path: Path) -> None:
    """Against a render of its own with 256 samples. Measured with 16: at most 4.7 bytes of noise (RMS), brightness to 1.4 %."""
    lit = ViewDataset.load(folder).lit_test
    assert lit is not None
    sunny = lit.under(4.0, 0.3)
    for index in (1, 3, len(lit) - 1):
        x, y, z = lit.directions[index].tolist()
        light = {"sun_azimuth": math.degrees(math.atan2(x, z)), "sun_elevation": math.degrees(math.asin(y))}
        config = replace(CONFIG, samples=256, suns=0, sun_strength=4.0, ambient_strength=0.3, **light)
        alone = read_rgba(render_pictures(thing_glb, lit.suns.cameras[index], tmp_path / f"{index}", config)[0])
        got, expected = premultiplied(sunny.image(index).numpy()), premultiplied(alone)
        assert np.sqrt(np.mean((got - expected) ** 2)) < 8
        assert got.mean() == pytest.approx(expected.mean(), rel=0.02)


@pytest.mark.parametrize("size", [47, 48])
def test_denoised_lights_stay_in_their_places(size: int, thing_glb: Path, tmp_path: Path) -> None:
    """Only the part of a picture that is rendered is denoised. Moved by a pixel, it would differ much more from one with many samples."""
    folders = []
    for denoise, samples in ((True, 16), (False, 256)):
        few = {"count": 4, "size": size, "suns": 1, "turned": 0, "denoise": denoise, "samples": samples, "training_samples": samples}
        folders.append(render_views(thing_glb, tmp_path / f"{samples}", ViewsConfig(**SMALL | few)))
    for kind in ("", "_ambient", "_sun0", "_sun1"):
        got, expected = (np.stack([premultiplied(picture(folder, f"{n:04}{kind}")) for n in range(4)]) for folder in folders)
        error = np.sqrt(np.mean((got - expected) ** 2))
        moved = [np.sqrt(np.mean((np.roll(got, step, axis) - expected) ** 2)) for step in (-1, 1) for axis in (1, 2)]
        assert error < 6 and error < min(moved) / 2, (kind, error, moved)


def test_unit_lights_show_white_as_white_and_passes_show_what_surfaces_are(tmp_path: Path) -> None:
    """A white box under the sky is white. Its front is as bright under a sun as the cosine says. Normals are those of its sides, Z up."""
    trimesh.Scene([box((-1, 0, -1), (1, 2, 1), (255, 255, 255))]).export(str(tmp_path / "white.glb"))
    config = ViewsConfig(
        **SMALL
        | {"count": 4, "samples": 64, "training_samples": 64, "suns": 1, "orthographic": True, "sun_azimuth": 0.0, "sun_elevation": 60.0}
    )
    views = ViewDataset.load(render_views(tmp_path / "white.glb", tmp_path / "views", config))
    lit = views.lit_train
    assert lit is not None and lit.albedo is not None and lit.normal is not None
    for index, name in enumerate(lit.skies.names):
        inside = lit.skies.image(index)[..., 3] == 255
        towards = -views.train.cameras.forward[index]
        assert lit.skies.image(index)[inside][:, :3].float().mean() > 252
        assert lit.albedo.image(index)[inside][:, :3].float().mean() > 252
        normal = lit.normal.image(index)[inside][:, :3].double().mean(0) / 127.5 - 1
        torch.testing.assert_close(torch.stack([normal[0], normal[2], -normal[1]]), towards, atol=0.01, rtol=0)
        for exposure in [place for place, camera in enumerate(lit.cameras) if camera == index]:
            seen = srgb_to_linear(lit.suns.image(exposure)[inside][:, :3].double().mean().numpy() / 255)
            assert seen == pytest.approx(max(float(lit.directions[exposure] @ towards), 0), abs=0.03), name


def test_unfinished_lit_pictures_are_rendered_again(folder: Path, thing_glb: Path, tmp_path: Path) -> None:
    """A view whose picture under one sun is missing is not finished; all others are kept."""
    import shutil

    copy = Path(shutil.copytree(folder, tmp_path / "views"))
    lost, kept = copy / "images/0000_sun1.png", copy / "images/0001_sun1.png"
    before, times = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    done = list[tuple[int, int]]()
    render_views(thing_glb, copy, CONFIG, on_progress=lambda *progress: done.append(progress))
    assert done == [(8, 9), (9, 9)]
    assert lost.read_bytes() == before and kept.stat().st_mtime_ns == times
    assert not list(copy.glob("images/.*"))


def test_without_suns_there_are_no_lit_views_and_old_folders_load(unbroken: Path, tmp_path: Path) -> None:
    import shutil

    views = ViewDataset.load(unbroken)
    assert views.lit_train is None and views.lit_test is None
    assert views.train.light is not None and views.train.light.ambients.tolist() == [1.0] * len(views.train)
    old = Path(shutil.copytree(unbroken, tmp_path / "views"))
    for name in ("train", "test"):
        path = old / f"transforms_{name}.json"
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            del frame["light"]
        path.write_text(json.dumps(content))
    assert ViewDataset.load(old).train.light is None
    assert ViewDataset.load(old).fingerprint == views.fingerprint


def test_suns_need_an_even_sky(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^suns: they need an even sky"):
        ViewsConfig(suns=1, hdri=tmp_path / "sky.hdr")


def test_thing_has_no_light_of_its_own(folder: Path) -> None:
    """Albedo is the color of the material, in every light: red post, green arm, blue foot."""
    views = ViewDataset.load(folder).lit_train
    assert views is not None and views.albedo is not None
    colors = np.array([part.visual.material.baseColorFactor[:3] for part in thing()]) / 255
    for index in range(len(views.albedo)):
        image = views.albedo.image(index).numpy()
        solid = srgb_to_linear(image[image[..., 3] == 255][:, :3] / 255)
        nearest = abs(solid[:, None] - colors).max(-1).min(-1)
        assert np.quantile(nearest, 0.8) < 0.02
