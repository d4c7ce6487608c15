"""The bark of thick wood: which points of a mesh are on it, and the facets that stand for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bbfit.fitting.bark import Bark, bark_of, facets
from bbfit.fitting.clusters import best_planes, moments
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.fitting.moves import Moves
from bbfit.fitting.points import mesh_samples, placement_points
from bbfit.fitting.search import Effort, find_placement
from bbfit.geometry.cloud import BillboardCloud
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

DATA = Path(__file__).resolve().parents[2] / "data"
BRIEF = Effort(2, 2, 2)


def small_tree() -> tuple[trimesh.Trimesh, list[int]]:
    """A trunk of 0.4 m, a branch of 0.1 m, a twig of 0.02 m, a flat card and many large leaves; the number of triangles of each."""
    trunk = trimesh.creation.cylinder(0.2, segment=np.array([[0, 0, 0], [0, 3, 0]]), sections=12)
    branch = trimesh.creation.cylinder(0.05, segment=np.array([[0, 2, 0], [1.5, 3, 0]]), sections=8)
    twig = trimesh.creation.cylinder(0.01, segment=np.array([[1, 2.6, 0], [1.4, 2.6, 1]]), sections=6)
    two = np.array([[0, 1, 2], [0, 2, 3]])
    card = trimesh.Trimesh(np.array([[-2.0, 1, 0], [-1, 1, 0], [-1, 2, 0], [-2, 2, 0]]), two)
    leaf = trimesh.Trimesh(np.array([[0, 0, 0], [0.3, 0, 0], [0.3, 0.2, 0.05], [0, 0.2, 0]]), two)
    generator = np.random.default_rng(0)
    leaves = [leaf.copy().apply_translation(generator.uniform([-1, 2, -1], [1, 4, 1])) for _ in range(500)]
    parts = [trunk, branch, twig, card, *leaves]
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh, [len(part.faces) for part in parts[:4]] + [2 * 500]


def test_bark_is_the_surface_of_thick_wood_and_no_leaf_or_card() -> None:
    mesh, counts = small_tree()
    points, faces = mesh_samples(mesh, 100_000, 0)
    part = np.repeat(np.arange(5), counts)[faces]
    thick, thin = (bark_of(mesh, points, faces, thickness) for thickness in (0.2, 0.05))
    assert set(part[thick]) == {0} and set(part[thin]) <= {0, 1}
    # Most of it: balls that touch near an edge of the prisms, or one of their ends, are smaller.
    assert (part[thick] == 0).sum() > 0.8 * (part == 0).sum() and (part[thin] == 1).sum() > 0.6 * (part == 1).sum()
    assert len(bark_of(mesh, points[part >= 3], faces[part >= 3], 0.02)) == 0


def cylinder(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points on an upright cylinder of radius 0.2 and height 2, and their normals."""
    generator = torch.Generator().manual_seed(0)
    angle, height = torch.rand(2, count, dtype=torch.float64, generator=generator)
    normals = torch.stack([(6.2831853 * angle).cos(), torch.zeros_like(angle), (6.2831853 * angle).sin()], -1)
    return 0.2 * normals + height[:, None] * torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64), normals


def test_facets_lie_on_the_surface_and_face_where_it_does() -> None:
    points, normals = cylinder(3_000)
    planes = facets(points, normals, 16, torch.Generator().manual_seed(0))
    assert 12 <= len(planes.normals) <= 16 and torch.equal(planes.labels.unique(), torch.arange(len(planes.normals)))
    assert torch.allclose(planes.normals.norm(dim=-1), torch.ones(len(planes.normals), dtype=torch.float64))
    facing = (normals * planes.normals[planes.labels]).sum(-1)
    away = ((points * planes.normals[planes.labels]).sum(-1) - planes.offsets[planes.labels]).abs()
    assert float(facing.mean()) > 0.85 and float(away.mean()) < 0.03
    # Planes of as many clusters that do not know of the normals cut through the wood.
    labels = torch.arange(len(points)) % 16
    cut = best_planes(moments(points, labels, 16), torch.eye(3, dtype=torch.float64), upright=False)[0]
    assert float((normals * cut[labels]).sum(-1).abs().mean()) < float(facing.mean()) - 0.1


def test_more_facets_than_points_and_opposite_normals_are_no_trouble() -> None:
    points, normals = cylinder(5)
    assert len(facets(points, normals, 9, torch.Generator().manual_seed(0)).normals) <= 5
    flat = torch.zeros(4, 3, dtype=torch.float64)  # both sides of one place
    planes = facets(flat, torch.tensor([[0.0, 0, 1], [0, 0, -1]] * 2, dtype=torch.float64), 1, torch.Generator().manual_seed(0))
    assert planes.normals.isfinite().all() and float(planes.normals.norm(dim=-1)) == pytest.approx(1)


@pytest.fixture(scope="module")
def views() -> ViewDataset:
    return ViewDataset.load(DATA / "views")


@pytest.fixture(scope="module")
def shape(views: ViewDataset) -> tuple[torch.Tensor, Bark | None]:
    return placement_points(views, FitConfig(trunk="mesh"), TreeFile.open(DATA / "tree.glb"))


def asked(count: int, **fields: object) -> ResolvedFit:
    return FitConfig(billboards=count, candidates=2, refinement_rounds=0, restarts=1, trunk="mesh", **fields).resolve()  # type: ignore[arg-type]


def test_the_trunk_of_the_sample_tree_has_facets(views: ViewDataset, shape: tuple[torch.Tensor, Bark | None]) -> None:
    points, bark = shape
    assert bark is not None and 0.02 < len(bark.members) / len(points) < 0.5
    assert float((bark.normals.norm(dim=-1) - 1).abs().max()) < 1e-6
    low = points[:, 1] < 0.1 * float(points[:, 1].max())  # no leaves hang as low
    on_bark = torch.isin(torch.arange(len(points)), bark.members)
    assert float(on_bark[low].double().mean()) > 0.6
    found = find_placement(views.train, points, asked(20, trunk_billboards=6), effort=BRIEF, bark=bark)
    assert 18 <= len(found) <= 20
    crossed = find_placement(views.train, points, asked(20, trunk_billboards=6), effort=BRIEF)
    assert len(crossed) == 20
    lowest = found.centers[:, 1] - found.half_extents.amax(-1)
    assert int((lowest < 0.1 * float(points[:, 1].max())).sum()) >= 2
    none = find_placement(views.train, points, asked(20, trunk_billboards=0), effort=BRIEF, bark=bark)
    assert len(none) == 20 and not torch.equal(none.centers[-6:], found.centers[-6:])


def test_the_number_of_facets_is_the_share_of_bark(
    views: ViewDataset, shape: tuple[torch.Tensor, Bark | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    points, bark = shape
    assert bark is not None
    share = len(bark.members) / len(points)
    counts, expected = [], []

    def faceted(self: object, normals: torch.Tensor, count: int) -> BillboardCloud:
        counts.append(count)
        return original(self, normals, count)  # type: ignore[arg-type]

    original = Moves.faceted
    monkeypatch.setattr(Moves, "faceted", faceted)
    for count in (16, 80, 160):
        assert len(find_placement(views.train, points, asked(count), effort=BRIEF, bark=bark)) <= count
        expected += [round(count * share)] if round(count * share) >= 3 else []  # fewer cross
    assert counts == expected and len(counts) == 2


def test_a_bare_tree_has_facets_and_other_billboards(views: ViewDataset, shape: tuple[torch.Tensor, Bark | None]) -> None:
    points = shape[0][:2_000]
    bare = Bark(torch.arange(len(points)), torch.nn.functional.normalize(points - points.mean(0), dim=-1))
    assert 8 <= len(find_placement(views.train, points, asked(16, trunk_billboards=8), effort=BRIEF, bark=bare)) <= 16


def test_without_a_mesh_the_trunk_is_crossed(views: ViewDataset, shape: tuple[torch.Tensor, Bark | None]) -> None:
    assert placement_points(views, FitConfig(trunk="mesh"), None)[1] is None
    points, bark = placement_points(views, FitConfig(), TreeFile.open(DATA / "tree.glb"))
    assert bark is None and torch.equal(points, shape[0])  # the same points, whether bark is sought or not
    assert asked(48).trunk_billboards is None and FitConfig(billboards=48).resolve().trunk_billboards == 9
