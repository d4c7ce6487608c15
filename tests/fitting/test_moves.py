"""Other placements made from one, on the views and the mesh that come with the project."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bbfit.fitting.clusters import best_planes, moments
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import tree_radius
from bbfit.fitting.levels import Targets
from bbfit.fitting.moves import ADDITIONS, REFINEMENTS, Moves
from bbfit.fitting.points import SeenPoints, mesh_points
from bbfit.geometry.cloud import TENSORS, BillboardCloud
from bbfit.operators.drawing.reference import render_reference
from bbfit.operators.image_loss.reference import pixel_loss_reference
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(scope="module")
def views() -> ViewSet:
    return ViewDataset.load(DATA / "views").train


@pytest.fixture(scope="module")
def targets(views: ViewSet) -> Targets:
    return Targets.at(views, 1)  # 64 x 64


@pytest.fixture(scope="module")
def points(views: ViewSet) -> torch.Tensor:
    return mesh_points(TreeFile.open(DATA / "tree.glb"), views, count=4000)


@pytest.fixture(scope="module")
def moves(views: ViewSet, targets: Targets, points: torch.Tensor) -> Moves:
    pictures, generator = targets.pictures(range(len(views))), torch.Generator().manual_seed(0)
    return Moves(SeenPoints.of(points, targets.cameras, pictures), FitConfig().resolve(), tree_radius(views), generator)


@pytest.fixture(scope="module")
def clustered(moves: Moves) -> BillboardCloud:
    return moves.clustered(1, 3)


def same(a: BillboardCloud, b: BillboardCloud) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in TENSORS)


def on_planes(cloud: BillboardCloud, points: torch.Tensor) -> torch.Tensor:
    """Root mean square distance of points from the nearest of some planes."""
    normals, centers = cloud.normals.double(), cloud.centers.double()
    return ((points[:, None] - centers) * normals).sum(-1).abs().amin(-1).square().mean().sqrt()


def kept(cloud: BillboardCloud, other: BillboardCloud) -> list[int]:
    """Billboards of a cloud that another one has as well, with the same texels."""
    return [k for k in range(len(cloud)) if any(same(cloud.take([k]), other.take([n])) for n in range(len(other)))]


def test_points_belong_to_the_billboard_that_moves_them_least(moves: Moves, clustered: BillboardCloud, points: torch.Tensor) -> None:
    carried = moves.nearest(clustered)
    axes = torch.stack([clustered.rights, clustered.ups, clustered.normals], 1).double()
    local = torch.einsum("nij,pnj->pni", axes, points[:, None] - clustered.centers.double())
    inside = torch.minimum(torch.maximum(local[..., :2], -clustered.half_extents.double()), clustered.half_extents.double())
    moved = torch.cat([local[..., :2] - inside, local[..., 2:]], -1)
    seen = torch.einsum("pni,nij,jk,nlk,pnl->pn", moved[..., 2:], axes[:, 2:], moves.seen.projection, axes[:, 2:], moved[..., 2:])
    assert torch.equal(carried, (seen + moved[..., :2].square().sum(-1)).argmin(-1))
    assert len(carried.unique()) == len(clustered)
    # Beyond a rectangle's border its plane is of no use.
    narrow = clustered.take([0, 0])
    narrow.half_extents[1] *= 0.1
    assert moves.nearest(narrow).bincount(minlength=2)[1] < 0.1 * len(points)


def test_splitting_puts_two_nearer_to_the_points_of_one(moves: Moves, clustered: BillboardCloud, points: torch.Tensor) -> None:
    carried = moves.nearest(clustered)
    for lossy in range(len(clustered)):
        split = moves.split(clustered, torch.where(carried == lossy, 1.0, 1e-12).double())
        assert len(split) == len(clustered) + 1
        assert kept(clustered, split) == [k for k in range(len(clustered)) if k != lossy]
        halves, held = split.take([len(split) - 2, len(split) - 1]), points[carried == lossy]
        assert on_planes(halves, held) < 0.8 * on_planes(clustered.take([lossy]), held)
        assert (halves.texels[:, 3] > 0.2).any()


@pytest.mark.parametrize("turn", range(4))
def test_merging_takes_two_that_lie_almost_on_one_plane(moves: Moves, clustered: BillboardCloud, points: torch.Tensor, turn: int) -> None:
    left, right = clustered.take([0]), clustered.take([0])
    half = left.half_extents[:, :1] / 2
    for part, sign in ((left, -1), (right, 1)):  # the two halves of one
        part.centers.add_(sign * half * part.rights)
        part.half_extents[:, :1].div_(2)
    cloud = BillboardCloud.joined([left, clustered.take([1, 2]), right])
    merged = moves.merged(cloud, turn)
    assert len(merged) == 3
    given_up = [k for k in range(4) if k not in kept(cloud, merged)]
    held = points[torch.isin(moves.nearest(cloud), torch.tensor(given_up))]
    least = best_planes(moments(held, torch.zeros(len(held), dtype=torch.int64), 1), moves.seen.projection, upright=False)[2]
    assert float(on_planes(merged.take([2]), held)) == pytest.approx(float((least / len(held)).sqrt()), rel=1e-3)
    if turn % 3 == 0:
        assert given_up == [0, 3]
        assert (merged.normals[2] * left.normals[0]).sum().abs() > 0.9
    else:
        assert given_up != [0, 3]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_refining_changes_no_number(moves: Moves, clustered: BillboardCloud, targets: Targets, count: int) -> None:
    pictures = targets.pictures(range(len(targets.cameras)))

    def losses(cloud: BillboardCloud) -> torch.Tensor:
        return pixel_loss_reference(render_reference(cloud, targets.cameras), pictures, "backgrounds")

    cloud = clustered.take(range(count))
    for turn in range(4):
        others = moves.refined(cloud, turn, losses)
        assert len(others) == REFINEMENTS and {len(other) for other in others} == {count}
        # All but one stay, two are new where one is split in place of another, and two go where they are merged.
        assert [len(kept(cloud, other)) for other in others] == [count - 1, count - 1, max(0, count - 2), max(0, count - 2)]


def test_extending_adds_one_billboard(moves: Moves, clustered: BillboardCloud, targets: Targets) -> None:
    """By splitting one in the first way, and by placing another in the others."""
    others = moves.extended(clustered, lambda cloud: torch.ones(len(targets.cameras), targets.cameras.height, targets.cameras.width))
    assert len(others) == ADDITIONS and {len(other) for other in others} == {len(clustered) + 1}
    assert [len(kept(clustered, other)) for other in others] == [len(clustered) - 1] + [len(clustered)] * (ADDITIONS - 1)
