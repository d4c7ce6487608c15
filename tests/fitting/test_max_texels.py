"""A limit on texels: kept from the first step to the result, made use of, and without effect where it is not reached."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from bbfit.checks import InputError
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import bounded, sized, start_cloud
from bbfit.fitting.loop import fit, resolution_levels
from bbfit.geometry.cloud import TENSORS, BillboardCloud, even_upright
from bbfit.views.dataset import ViewDataset

EVEN = [
    {"placement": "even", "bounds": bounds, "sides": sides}
    for bounds in ("viewport", "thesis", "silhouette")
    for sides in ("one", "two", "pair")
]
KINDS = [*(kind for kind in EVEN if kind["sides"] == "one"), {"placement": "even", "sides": "two"}, {"placement": "clusters"}]
KINDS += [
    {"placement": "clusters", "sides": "two"},
    {"placement": "even", "placement_learning_rate": 0},
    {"placement": "clusters", "levels": 1},
]


@pytest.fixture(scope="module")
def views(views_folder: Path) -> ViewDataset:
    return ViewDataset.load(views_folder)


def config(**fields: object) -> FitConfig:
    return FitConfig(**{"billboards": 2, "texel_density": 1.5, "candidates": 1, "refinement_rounds": 0, "steps": 8} | fields)  # type: ignore[arg-type]


def rectangles(seed: int) -> BillboardCloud:
    """Five billboards of very different sizes, some two-sided."""
    generator = torch.Generator().manual_seed(seed)
    cloud = even_upright(
        5,
        axis=torch.zeros(3),
        half_extents=torch.rand(5, 2, generator=generator).square() * 3 + 0.01,
        texture_sizes=torch.ones(5, 2, dtype=torch.int64),
    )
    two_sided = torch.rand(5, generator=generator) < 0.5
    return dataclasses.replace(cloud, two_sided=two_sided, texels=torch.zeros(5 + int(two_sided.sum()), 4))


def counted(cloud: BillboardCloud) -> int:
    """Texels by the sizes of the textures."""
    return int((cloud.texture_sizes.prod(-1) * (1 + cloud.two_sided.long())).sum())


def density(cloud: BillboardCloud) -> float:
    """Texels to the meter, which are the same both ways and for all."""
    each = cloud.texture_sizes.flip(-1) / (2 * cloud.half_extents)
    torch.testing.assert_close(each, each[:1, :1].expand_as(each))
    return float(each[0, 0])


@pytest.mark.parametrize("seed", range(8))
def test_no_more_texels_than_allowed_and_hardly_fewer(seed: int) -> None:
    cloud = rectangles(seed)
    free = sized(cloud, 40.0)
    least = 5 + int(cloud.two_sided.sum())
    assert density(free) == pytest.approx(40)
    for most in sorted({least, least + 1, 2 * least, 100, 1000, counted(free) // 2, counted(free) - 1}):
        if most >= counted(free):
            continue
        tight = sized(cloud, 40.0, most)
        assert len(tight.texels) == counted(tight) <= most and density(tight) < 40
        assert most < 200 or counted(tight) > 0.85 * most
        assert (tight.half_extents >= cloud.half_extents * (1 - 1e-6)).all()  # rounded up to whole texels
        assert torch.equal(tight.centers, cloud.centers) and torch.equal(tight.two_sided, cloud.two_sided)


@pytest.mark.parametrize("seed", range(3))
def test_a_limit_that_is_not_reached_changes_nothing(seed: int) -> None:
    cloud = rectangles(seed)
    free = sized(cloud, 40.0)
    for most in (counted(free), counted(free) + 1, 10**9, None):
        same = sized(cloud, 40.0, most)
        assert torch.equal(same.texture_sizes, free.texture_sizes) and torch.equal(same.half_extents, free.half_extents)
        assert same.texels.shape == free.texels.shape


def test_every_texture_has_a_texel(views: ViewDataset) -> None:
    cloud = dataclasses.replace(rectangles(0), two_sided=torch.tensor([True, False, True, False, False]), texels=torch.zeros(7, 4))
    assert sized(cloud, 40.0, 7).texture_sizes.tolist() == [[1, 1]] * 5
    with pytest.raises(InputError, match=r"^max_texels: 6 are too few for 7 textures; allow more$"):
        sized(cloud, 40.0, 6)


def test_bounds_are_cut_first_and_counted_then() -> None:
    """Half as wide and half as high, and moved: what is cut off costs nothing."""
    cloud = rectangles(1)
    half = cloud.half_extents
    bounds = torch.stack([torch.zeros(5), half[:, 0], -half[:, 1], torch.zeros(5)], -1)
    free = bounded(cloud, bounds, 40.0)
    most = counted(free) // 2
    tight = bounded(cloud, bounds, 40.0, most)
    assert 0.8 * most < counted(tight) <= most and density(tight) < density(free)
    torch.testing.assert_close(tight.centers, cloud.centers + half[:, :1] / 2 * cloud.rights - half[:, 1:] / 2 * cloud.ups)
    same = bounded(cloud, bounds, 40.0, counted(free))
    assert torch.equal(same.texture_sizes, free.texture_sizes) and torch.equal(same.half_extents, free.half_extents)


@pytest.mark.parametrize("kind", EVEN, ids=str)
def test_an_even_start_keeps_the_limit(views: ViewDataset, kind: dict[str, object]) -> None:
    free = start_cloud(views.train, config(**kind))
    for most in (50, 700, counted(free) - 1):
        tight = start_cloud(views.train, config(**kind, max_texels=most))
        assert 0.7 * most < len(tight.texels) == counted(tight) <= most and density(tight) < density(free)
        assert (tight.half_extents >= free.half_extents * (1 - 1.5 / free.texture_sizes.flip(-1))).all()  # by what was rounded up
    same = start_cloud(views.train, config(**kind, max_texels=counted(free)))
    for name in TENSORS:
        assert torch.equal(getattr(same, name), getattr(free, name))


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_a_fit_keeps_the_limit_at_every_level_and_in_its_result(views: ViewDataset, kind: dict[str, object]) -> None:
    most, seen = 800, list[int]()
    asked = config(**kind, max_texels=most)
    result = fit(views, asked, on_step=lambda step: seen.append(len(step.snapshot().texels)))
    for level in resolution_levels(asked.resolve(), views.train.cameras):
        for count in seen[level.begin : level.end]:  # halved sides are rounded up
            assert 0.7 * most < count * 4**level.halvings and count <= most
    assert len(seen) == 8 and seen[-1] > 0.7 * most
    assert 0 < len(result.cloud.texels) == counted(result.cloud) <= most and result.config.max_texels == most


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_a_fit_that_does_not_reach_its_limit_is_the_fit_without(views: ViewDataset, kind: dict[str, object]) -> None:
    free, limited = (fit(views, config(**kind, max_texels=most)) for most in (None, 10**6))
    assert len(free.cloud.texels) > 1000 and free.losses == limited.losses
    for name in TENSORS:
        assert torch.equal(getattr(free.cloud, name), getattr(limited.cloud, name))


@pytest.mark.parametrize(
    ("kind", "textures"),
    [
        ({"placement": "even"}, 3),
        ({"placement": "even", "bounds": "viewport", "sides": "two"}, 6),
        ({"placement": "even", "bounds": "thesis", "sides": "pair"}, 6),
        ({"placement": "clusters"}, 3),
        ({"placement": "clusters", "sides": "two"}, 6),
    ],
    ids=str,
)
def test_fewer_texels_than_textures_are_refused(views: ViewDataset, kind: dict[str, object], textures: int) -> None:
    with pytest.raises(InputError, match=f"^max_texels: {textures - 1} are too few for {textures} textures"):
        fit(views, config(**kind, billboards=3, max_texels=textures - 1))
