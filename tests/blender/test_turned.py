"""Second pictures of held-out views, from cameras turned by one degree."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from bbfit.blender.config import ViewsConfig
from bbfit.blender.pictures import render_pictures
from bbfit.blender.views_folder import render_views
from bbfit.checks import InputError
from bbfit.evaluation.scoring import view_angles
from bbfit.evaluation.shimmer import score_shimmer
from bbfit.images import read_rgba
from bbfit.layout import TURNED_FILE
from bbfit.views.dataset import ViewDataset

from .conftest import SMALL

CONFIG = ViewsConfig(**SMALL | {"count": 7, "elevations": (0.0, 50.0), "turned": 2})


@pytest.fixture(scope="module")
def folder(thing_glb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_views(thing_glb, tmp_path_factory.mktemp("turned") / "views", CONFIG)


def test_second_pictures_are_those_of_the_turned_cameras(thing_glb: Path, folder: Path, tmp_path: Path) -> None:
    """They are what the views' own renderer shows to these cameras, a degree farther around the tree."""
    views = ViewDataset.load(folder)
    assert views.turned is not None and len(views.test) == 2 and views.turned.views.names == views.test.names
    assert [path.name for path in sorted((folder / "images").glob("turned_*"))] == [f"turned_{name}.png" for name in views.test.names]
    pairs = views.turned
    before, after = view_angles(pairs.views.cameras), view_angles(pairs.turned.cameras)
    torch.testing.assert_close(after - before, torch.tensor([[1.0, 0.0]] * 2).double(), rtol=0, atol=1e-5)
    target = torch.tensor(views.request.camera["target"]).double()  # type: ignore[union-attr, index]
    distances = [(camera.position - target).norm(dim=-1) for camera in (pairs.views.cameras, pairs.turned.cameras)]
    torch.testing.assert_close(*distances, rtol=1e-9, atol=0)
    seeds = [CONFIG.seed + int(name) for name in pairs.views.names]
    for index, seed in enumerate(seeds):
        config = ViewsConfig(**SMALL | {"seed": seed})
        (path,) = render_pictures(thing_glb, pairs.turned.cameras[[index]], tmp_path / str(index), config)
        np.testing.assert_array_equal(pairs.turned.image(index).numpy(), read_rgba(path))
    blank = lambda camera: torch.zeros(len(camera), camera.height, camera.width, 4)  # noqa: E731
    (score,) = score_shimmer(blank, pairs)
    assert score.ratio == 0 and 0 < score.tree < math.radians(1)  # the box moves by less than that share of a picture


def test_a_lost_second_picture_is_rendered_again_and_nothing_else(thing_glb: Path, folder: Path) -> None:
    lost = sorted((folder / "images").glob("turned_*"))[1]
    before, times = read_rgba(lost), {path: path.stat().st_mtime_ns for path in (folder / "images").iterdir() if path != lost}
    lost.unlink()
    progress: list[tuple[int, int]] = []
    render_views(thing_glb, folder, CONFIG, on_progress=lambda done, total: progress.append((done, total)))
    assert progress == [(8, 9), (9, 9)]
    np.testing.assert_array_equal(read_rgba(lost), before)
    assert {path: path.stat().st_mtime_ns for path in times} == times


def test_without_second_pictures_the_folder_is_as_before(unbroken: Path, thing_glb: Path) -> None:
    assert not (unbroken / TURNED_FILE).exists() and not list((unbroken / "images").glob("turned_*"))
    assert ViewDataset.load(unbroken).turned is None
    assert json.loads((unbroken / "views.json").read_text())["config"]["turned"] == 0
    with pytest.raises(InputError, match="turned 0, not 3; choose another output folder"):
        render_views(thing_glb, unbroken, ViewsConfig(**SMALL | {"turned": 3}))
