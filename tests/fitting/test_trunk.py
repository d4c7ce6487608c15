"""The trunk below the crown: where silhouettes show it, its points, and the planes that cross in it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from bbfit.checks import InputError
from bbfit.fitting.config import FitConfig
from bbfit.fitting.search import Effort, find_placement
from bbfit.fitting.trunk import crossed_planes, is_level, trunk_parts, trunk_points, trunk_top
from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit
from bbfit.views.view_set import ViewSet

RADIUS, CROWN_AT = 0.3, 1.5
SIZE = 64


def silhouette(trunk: int, crown: int, *, trunk_rows: int = 30, crown_rows: int = 40) -> torch.Tensor:
    """A crown on a trunk in a picture of 100 x 80 pixels with ten empty rows at the top; widths in pixels."""
    inside = torch.zeros(100, 80, dtype=torch.bool)
    inside[10 : 10 + crown_rows, 40 - crown // 2 : 40 + crown // 2] = True
    inside[10 + crown_rows : 10 + crown_rows + trunk_rows, 40 - trunk // 2 : 40 + trunk // 2] = True
    return inside


def tree_points(count: int, seed: int = 0) -> torch.Tensor:
    """Points in an upright cylinder below a ball: a trunk of 1.5 m with a crown of radius 1.5 m."""
    generator = torch.Generator().manual_seed(seed)
    angle, height, part = torch.rand(3, count, dtype=torch.float64, generator=generator)
    radius = RADIUS * part.sqrt()
    trunk = torch.stack([radius * (2 * math.pi * angle).cos(), CROWN_AT * height, radius * (2 * math.pi * angle).sin()], -1)
    ball = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
    return torch.cat([trunk, ball * 1.5 + torch.tensor([0.0, CROWN_AT + 1.5, 0.0])])


def cameras_of(orbit: Orbit) -> Camera:
    """Cameras that see all of the tree."""
    return orbit.frame(tree_points(2000).numpy(), target=torch.tensor([0.0, 2.2, 0.0], dtype=torch.float64), width=SIZE, height=SIZE)


def tree_views(*, elevation: float = 0.0, hidden: bool = False, views: int = 12) -> ViewSet:
    """Pictures of :func:`tree_points`; ``hidden`` trees have leaves down to the ground."""
    points = tree_points(60_000)
    if hidden:
        points = torch.cat([points, points * torch.tensor([5.0, 1.0, 5.0])])
    cameras = cameras_of(Orbit(views, (elevation,)))
    images = torch.zeros(views, SIZE, SIZE, 4)
    for index in range(views):
        x, y = cameras[index].project(points).round().long().unbind(-1)
        inside = (x >= 0) & (x < SIZE) & (y >= 0) & (y < SIZE)
        images[index, y[inside], x[inside]] = torch.tensor([0.5, 0.4, 0.3, 1.0])
    return ViewSet.from_arrays((images * 255).byte().numpy(), cameras)


def test_the_trunk_reaches_from_the_ground_to_the_crown_less_a_twentieth() -> None:
    assert trunk_top(silhouette(6, 60)) == 52  # of 30 rows, 5 % are about two
    forked = silhouette(6, 60)
    forked[50:60, 37:43], forked[50:60, 30:36], forked[50:60, 44:50] = False, True, True
    assert trunk_top(forked) == 52  # both halves of a fork are as wide as the trunk


@pytest.mark.parametrize(
    "inside",
    [
        torch.zeros(100, 80, dtype=torch.bool),
        silhouette(6, 60, trunk_rows=2),  # a foot below leaves
        silhouette(20, 60),  # not narrow
        silhouette(6, 6),  # a pole has no crown
    ],
)
def test_there_is_no_trunk_below_the_crown(inside: torch.Tensor) -> None:
    assert trunk_top(inside) is None


def test_views_from_near_the_horizon_are_level() -> None:
    cameras = [cameras_of(Orbit(1, (elevation,))) for elevation in (-40.0, -30.0, 0.0, 20.0, 30.0, 31.0, 90.0)]
    assert [is_level(camera).tolist() for camera in cameras] == [[False], [True], [True], [True], [True], [False], [False]]


def test_points_below_the_crown_are_the_trunks() -> None:
    points = tree_points(500)
    found = trunk_points(points, tree_views())
    heights = points[:, 1]
    assert torch.equal(found, found.unique()) and found.max() < 500  # none of the ball's
    assert set(found.tolist()) >= set(torch.nonzero(heights[:500] < 0.8 * CROWN_AT)[:, 0].tolist())
    assert len(trunk_points(points[500:], tree_views())) == 0  # too few
    assert len(trunk_points(points, tree_views(elevation=60.0))) == 0
    assert len(trunk_points(points, tree_views(hidden=True))) == 0


def test_a_branch_beside_the_trunk_hides_it_from_a_quarter_of_the_views_at_most() -> None:
    points, views = tree_points(500), tree_views()

    def beside(hidden: int) -> ViewSet:
        """Views of which some show a branch that hangs down to the middle of the trunk."""
        pictures = views.images(range(len(views))).clone()
        shown = torch.nonzero(pictures[0, ..., 3].any(1))[:, 0]
        middle = trunk_top(pictures[0, ..., 3] >= 128)
        assert middle is not None
        pictures[:hidden, : (middle + int(shown.max())) // 2, 4 : SIZE - 4] = 255
        return ViewSet.from_arrays(pictures.numpy(), views.cameras)

    whole = len(trunk_points(points, views))
    assert len(trunk_points(points, beside(3))) > 0.95 * whole  # of twelve views; those at the rim are in fewer views
    assert 0 < len(trunk_points(points, beside(4))) < 0.7 * whole


@pytest.mark.parametrize(("count", "planes"), [(1, [1]), (2, [2]), (3, [3]), (5, [5]), (6, [3, 3]), (8, [4, 4]), (9, [3, 3, 3])])
def test_a_trunk_has_three_planes_in_each_of_its_parts(count: int, planes: list[int]) -> None:
    points = tree_points(400)[:400]
    parts = trunk_parts(points, count)
    assert [number for _, number in parts] == planes
    assert torch.equal(torch.cat([part for part, _ in parts]).sort().values, torch.arange(400))
    ranges = [(float(points[part, 1].min()), float(points[part, 1].max())) for part, _ in parts]
    assert all(below[1] <= above[0] for below, above in pairwise(ranges))
    assert max(len(part) for part, _ in parts) - min(len(part) for part, _ in parts) <= 1


def test_a_part_of_a_trunk_has_at_least_twelve_points() -> None:
    points = tree_points(400)
    assert [len(part) for part, _ in trunk_parts(points[:30], 9)] == [15, 15]
    assert [number for _, number in trunk_parts(points[:30], 9)] == [5, 4]
    assert [len(part) for part, _ in trunk_parts(points[:12], 9)] == [12]


def test_the_planes_of_a_bent_trunk_follow_it() -> None:
    height = torch.linspace(0, 3, 300, dtype=torch.float64)
    bent = torch.stack([0.5 * (height / 3) ** 2, height, torch.zeros_like(height)], -1)  # towards +X
    off = [max(float((bent[part] - bent[part].mean(0))[:, 0].abs().max()) for part, _ in trunk_parts(bent, count)) for count in (3, 9)]
    assert off[1] < 0.5 * off[0]


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_one_of_the_crossed_planes_faces_every_side(count: int) -> None:
    points = tree_points(400)[:400] + torch.tensor([3.0, 1.0, -2.0])
    planes = crossed_planes(points, count)
    assert planes.normals[:, 1].abs().max() == 0 and torch.allclose(planes.normals.norm(dim=-1), torch.ones(count, dtype=torch.float64))
    middle = points.mean(0)
    assert torch.allclose(planes.normals @ middle, planes.offsets)
    azimuths = torch.arange(360, dtype=torch.float64).deg2rad()
    towards = torch.stack([azimuths.sin(), torch.zeros(360), azimuths.cos()], -1)
    facing = (towards @ planes.normals.mT).abs().amax(-1)
    assert float(facing.min()) >= math.cos(math.pi / (2 * count)) - 1e-9


def test_the_first_plane_contains_the_fork() -> None:
    flat = torch.tensor([[2.0, 0.0, 1.0], [-2.0, 1.0, -1.0], [0.1, 0.5, -0.2], [-0.1, 0.5, 0.2]], dtype=torch.float64)
    planes = crossed_planes(flat, 2)
    assert float((flat[:2] @ planes.normals[0] - planes.offsets[0]).abs().max()) < 0.1


def test_the_trunk_has_billboards_of_its_own_within_the_number_of_billboards() -> None:
    views, points, brief = tree_views(), tree_points(500), Effort(2, 2, 2)
    asked = FitConfig(billboards=5, candidates=2, refinement_rounds=0, restarts=1, trunk_billboards=2).resolve()
    found = find_placement(views, points, asked, effort=brief)
    assert len(found) == 5
    low, high = ((found.centers + sign * found.half_extents[:, 1:] * found.ups)[:, 1] for sign in (-1, 1))
    assert (high[3:] < CROWN_AT + 0.5).all() and (low[3:] < 0.1).all() and (high[:3] > 2).all()
    assert found.normals[3:, 1].abs().max() < 1e-6 and float((found.normals[3] * found.normals[4]).sum().abs()) < 1e-5
    assert len(find_placement(views, points, replace(asked, trunk_billboards=4), effort=brief)) == 5  # more than the crown's
    assert len(find_placement(tree_views(hidden=True), points, asked, effort=brief)) == 5  # without a trunk, all are the crown's


def test_many_billboards_have_some_for_the_trunk_and_few_have_none_and_never_all() -> None:
    counts = (4, 8, 11, 12, 31, 32, 47, 48, 192)
    assert [FitConfig(billboards=count).resolve().trunk_billboards for count in counts] == [0, 0, 0, 3, 3, 6, 6, 9, 9]
    assert FitConfig().resolve().counted(16).trunk_billboards == 3
    assert FitConfig(trunk_billboards=0).resolve().counted(16).trunk_billboards == 0
    assert FitConfig(preset="thesis").resolve().trunk_billboards == 0
    with pytest.raises(InputError, match="trunk_billboards: 3 of 3 billboards leave none for the crown"):
        FitConfig(billboards=3, trunk_billboards=3).resolve()
    with pytest.raises(InputError, match="trunk_billboards: 16 of 16 billboards"):
        FitConfig(trunk_billboards=16).resolve()  # the fit may choose 16
