"""The search for a placement on the views and the mesh that come with the project."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.losses import pixel_losses
from bbfit.fitting.points import mesh_points
from bbfit.fitting.search import SIDE, find_placement, joined, part
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.reference import render_reference
from bbfit.views import ViewDataset

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(scope="module")
def views() -> ViewDataset:
    return ViewDataset.load(DATA / "views")


@pytest.fixture(scope="module")
def points(views: ViewDataset) -> torch.Tensor:
    return mesh_points(DATA / "tree.glb", views.train, count=4000)


def config(**fields: object) -> FitConfig:
    return FitConfig(**{"billboards": 3, "candidates": 3, "relocations": 2} | fields).resolve()  # type: ignore[arg-type]


def loss(cloud: BillboardCloud, views: ViewDataset) -> float:
    targets = Targets.at(views.train, 1)  # 64 x 64
    chosen = range(len(views.train))
    return float(pixel_losses(render_reference(cloud, targets.cameras), targets.pictures(chosen), "backgrounds").mean())


def same(a: BillboardCloud, b: BillboardCloud) -> bool:
    return torch.equal(a.centers, b.centers) and torch.equal(a.rights, b.rights) and torch.equal(a.texels, b.texels)


def test_it_finds_as_many_billboards_as_asked_near_the_tree(views: ViewDataset, points: torch.Tensor) -> None:
    told = []
    found = find_placement(views.train, points, config(), lambda done, total: told.append((done, total)))
    assert len(found) == 3 and not found.two_sided.any() and found.texels.dtype == found.centers.dtype == torch.float32
    assert (found.centers - points.float().mean(0)).norm(dim=-1).max() < 2 * tree_radius(views.train)
    assert found.texture_sizes.max() < 3 * SIDE
    assert (found.rights * found.ups).sum(-1).abs().max() < 1e-5
    assert told == [(done, told[-1][1]) for done in range(1, len(told) + 1)] and told[-1][0] == told[-1][1]


def test_same_seed_same_placement_whatever_the_number_of_threads(views: ViewDataset, points: torch.Tensor) -> None:
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(find_placement(views.train, points, config()))
    finally:
        torch.set_num_threads(before)
    assert same(*found)
    assert not same(found[0], find_placement(views.train, points, config(seed=1)))


def test_more_work_is_never_worse(views: ViewDataset, points: torch.Tensor) -> None:
    """Relocations are kept only if they lower the loss on the training views."""
    fields = {"billboards": 6, "candidates": 1}
    losses = [loss(find_placement(views.train, points, config(relocations=count, **fields)), views) for count in (0, 2, 12)]
    assert losses[0] >= losses[1] >= losses[2] and losses[2] < losses[0]


def test_moving_billboards_explain_the_views_better_than_standing_ones(views: ViewDataset, points: torch.Tensor) -> None:
    standing, moving = (
        loss(find_placement(views.train, points, config(relocations=0, placement_rate=rate)), views) for rate in (0.0, 0.015)
    )
    assert moving < 0.99 * standing


@pytest.mark.parametrize("orientation", ["upright", "free"])
def test_orientation_is_where_planes_start(views: ViewDataset, points: torch.Tensor, orientation: str) -> None:
    found = find_placement(views.train, points, config(orientation=orientation, placement_rate=0.0, relocations=0))
    leaning = found.normals[:, 1].abs()
    assert leaning.max() < 1e-5 if orientation == "upright" else leaning.max() > 0.05


@pytest.mark.parametrize("fields", [{"billboards": 1}, {"sides": "two"}, {"candidates": 1, "relocations": 1}])
def test_corner_cases(views: ViewDataset, points: torch.Tensor, fields: dict[str, object]) -> None:
    asked = config(**fields)
    found = find_placement(views.train, points, asked)
    assert len(found) == asked.billboards
    assert bool(found.two_sided.all()) == (asked.sides == "two")


def test_parts_joined_are_the_whole(known_cloud: BillboardCloud) -> None:
    first, second = part(known_cloud, [0]), part(known_cloud, [1])
    assert same(joined(first, second), known_cloud)
    assert len(part(known_cloud, [])) == 0 and len(joined(part(known_cloud, []), second)) == 1
