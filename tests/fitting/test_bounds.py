"""Bounded billboards hold what the views show."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bbfit.fitting.bounds import facing_cosines, facing_view_bounds, opaque_bounds, smallest_rectangle, trimmed
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import start_cloud
from bbfit.geometry.camera import Camera, convergence_point
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.homography import texel_to_pixel
from bbfit.operators.drawing.reference import render_reference
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet


@pytest.fixture(scope="module")
def views(views_folder: Path) -> ViewDataset:
    return ViewDataset.load(views_folder)


def unit_planes(views: ViewDataset, count: int):
    return even_upright(
        count,
        axis=convergence_point(views.train.cameras),
        half_extents=torch.ones(2, dtype=torch.float64),
        texture_sizes=torch.tensor([1, 1]),
    )


def test_thesis_bounds_are_the_alpha_box_of_the_facing_view(views: ViewDataset) -> None:
    planes = unit_planes(views, 2)
    bounds = facing_view_bounds(planes, views.train, pairs=False)
    for n in range(2):
        view = int(facing_cosines(views.train.cameras, planes.normals, planes.centers[0])[:, n].argmax())
        rows, columns = torch.nonzero(views.train.image(view)[..., 3] > 0).double().unbind(-1)
        left, right, bottom, top = bounds[n]
        corners = torch.stack([planes.centers[n] + x * planes.rights[n] + y * planes.ups[n] for x in (left, right) for y in (bottom, top)])
        pixels = views.train.cameras[view].project(corners)
        # The plane's box, seen from that view, holds the pixel box; a view that is not quite perpendicular sees it as a trapezoid.
        assert pixels[:, 0].amin() <= columns.min() - 0.5 + 1e-5 and pixels[:, 0].amax() >= columns.max() + 0.5 - 1e-5
        assert pixels[:, 1].amin() <= rows.min() - 0.5 + 1e-5 and pixels[:, 1].amax() >= rows.max() + 0.5 - 1e-5
        if facing_cosines(views.train.cameras, planes.normals, planes.centers[0])[view, n] > 1 - 1e-12:  # perpendicular: exactly the box
            expected = torch.stack([columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5]).double()
            found = torch.stack([pixels[:, 0].amin(), pixels[:, 0].amax(), pixels[:, 1].amin(), pixels[:, 1].amax()])
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("sides", ["one", "two", "pair"])
def test_silhouette_bounds_cut_nothing_off(views: ViewDataset, count: int, sides: str) -> None:
    """Every opaque pixel of every training view within 60 degrees of a billboard's normal lies on that billboard."""
    cloud = start_cloud(views.train, FitConfig(billboards=count, placement="even", sides=sides, bounds="silhouette", texel_density=1))
    camera = views.train.cameras.to(torch.float32)
    cosines = facing_cosines(camera, cloud.normals, convergence_point(views.train.cameras).float()).abs()
    matrices = torch.linalg.inv(texel_to_pixel(cloud, camera))
    checked = 0
    for view in range(len(views.train)):
        n = int(cosines[view].argmax())
        if cosines[view, n] <= math.cos(math.radians(60)):
            continue
        rows, columns = torch.nonzero(views.train.image(view)[..., 3] > 0).double().unbind(-1)
        pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).float()
        texels = pixels @ matrices[view, n].mT
        texels = texels[:, :2] / texels[:, 2:]
        height, width = cloud.texture_sizes[n].tolist()
        assert (texels > -0.5 - 1e-3).all() and (texels < torch.tensor([width, height]) - 0.5 + 1e-3).all()
        checked += 1
    assert checked >= (len(views.train) // 2 if count == 1 else len(views.train))


def test_silhouette_bounds_are_tight(views: ViewDataset) -> None:
    """Each of a billboard's four edges is touched, to a texel, by the silhouette of some view that the billboard faces best."""
    cloud = start_cloud(views.train, FitConfig(billboards=2, bounds="silhouette", texel_density=1))
    camera = views.train.cameras.to(torch.float32)
    cosines = facing_cosines(camera, cloud.normals, convergence_point(views.train.cameras).float()).abs()
    matrices = torch.linalg.inv(texel_to_pixel(cloud, camera))
    for n in range(2):
        reached = []
        for view in torch.nonzero(cosines[:, n] > cosines.amax(1) - 1e-3)[:, 0].tolist():
            rows, columns = torch.nonzero(views.train.image(view)[..., 3] > 0).float().unbind(-1)
            corners = [torch.stack([columns + x, rows + y, torch.ones_like(rows)], -1) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
            texels = torch.cat(corners) @ matrices[view, n].mT
            reached.append(texels[:, :2] / texels[:, 2:])
        low, high = torch.cat(reached).amin(0), torch.cat(reached).amax(0)
        size = cloud.texture_sizes[n].flip(0)
        assert ((low > -0.5 - 1e-3) & (low < 0.5 + 1e-3)).all()
        assert ((high < size - 0.5 + 1e-3) & (high > size - 1.5 - 1e-3)).all()


def test_bounds_save_texels_and_keep_their_density(views: ViewDataset) -> None:
    whole = start_cloud(views.train, FitConfig(bounds="viewport", texel_density=1.25))
    part = start_cloud(views.train, FitConfig(bounds="silhouette", texel_density=1.25))
    assert len(part.texels) < len(whole.texels)
    for cloud in (whole, part):
        density = cloud.texture_sizes.flip(-1) / (2 * cloud.half_extents)
        torch.testing.assert_close(density, density[:1, :1].expand_as(density))
    torch.testing.assert_close(part.texture_sizes[0, 0] / part.half_extents[0, 1], whole.texture_sizes[0, 0] / whole.half_extents[0, 1])


def test_unbounded_billboards_fill_the_viewport_of_a_facing_camera(views: ViewDataset) -> None:
    cloud = start_cloud(views.train, FitConfig(billboards=4, bounds="viewport", texel_density=1))
    camera = views.train.cameras.to(torch.float32)
    size = torch.tensor([camera.width, camera.height])
    assert cloud.texture_sizes.tolist() == [[camera.height, camera.width]] * 4
    cosines = facing_cosines(camera, cloud.normals, convergence_point(views.train.cameras).float())
    view, n = divmod(int(cosines.argmax()), 4)
    assert cosines[view, n] > 1 - 1e-6
    corners = torch.tensor([[-0.5, -0.5, 1], [size[0] - 0.5, size[1] - 0.5, 1]])
    pixels = corners @ texel_to_pixel(cloud, camera)[view, n].mT
    torch.testing.assert_close(pixels[:, :2] / pixels[:, 2:], corners[:, :2], atol=1e-2, rtol=0)


def test_pairs_stand_a_hair_apart_along_the_normal(views: ViewDataset) -> None:
    cloud = start_cloud(views.train, FitConfig(billboards=2, placement="even", sides="pair", bounds="viewport"))
    between = ((cloud.centers[0::2] - cloud.centers[1::2]) * cloud.normals[0::2]).sum(-1)
    assert len(cloud) == 4 and cloud.vertex_count == 16
    assert (between > 0).all() and (between < 5e-3 * cloud.half_extents[0, 0]).all()


def painted(height: int, width: int, *opaque: tuple[int, int], sides: str = "one", alpha: float = 0.35) -> BillboardCloud:
    """A billboard with texels of a tenth of a meter, transparent but for some at (column, row); of two sides they take turns."""
    half = torch.tensor([width, height]) * 0.05
    cloud = even_upright(1, axis=torch.tensor([0.3, 1.0, 2.0]), half_extents=half, texture_sizes=torch.tensor([height, width]), sides=sides)
    cloud = cloud.with_texels(torch.full(cloud.texels.shape, 0.25))  # as faint as what counts as nothing
    for index, (column, row) in enumerate(opaque):
        cloud.textures()[0][index % (1 + (sides == "two")), row, column, 3] = alpha
    return cloud


def texels_of(cloud: BillboardCloud, bounds: Tensor) -> list[float]:
    """Bounds in texels from the texture's left and top edge: left, right, top, bottom."""
    left, right, bottom, top = (10 * bounds).tolist()
    height, width = cloud.texture_sizes[0].tolist()
    return pytest.approx([left + width / 2, right + width / 2, height / 2 - top, height / 2 - bottom], abs=1e-4)


def test_opaque_bounds_leave_a_margin_of_two_texels() -> None:
    cloud = painted(20, 30, (10, 6), (14, 9))
    assert opaque_bounds(cloud).shape == (1, 4)
    assert texels_of(cloud, opaque_bounds(cloud)[0]) == [8, 17, 4, 12]


def test_opaque_bounds_do_not_leave_the_texture_for_their_margin() -> None:
    cloud = painted(20, 30, (1, 1), (28, 18))
    assert texels_of(cloud, opaque_bounds(cloud)[0]) == [0, 30, 0, 20]


@pytest.mark.parametrize(
    ("height", "width", "spot", "expected"),
    [
        (20, 30, (0, 10), [-3, 3, 8, 13]),
        (20, 30, (29, 10), [27, 33, 8, 13]),
        (20, 30, (10, 0), [8, 13, -2, 3]),
        (20, 30, (10, 19), [8, 13, 17, 22]),
        (42, 30, (10, 0), [8, 13, -5, 3]),  # rounded up to whole texels
        (4, 4, (0, 3), [-2, 3, 1, 6]),  # and never less than the margin
    ],
)
def test_opaque_bounds_grow_by_a_tenth_where_the_border_is_reached(
    height: int, width: int, spot: tuple[int, int], expected: list[int]
) -> None:
    cloud = painted(height, width, spot)
    assert texels_of(cloud, opaque_bounds(cloud)[0]) == expected


def test_opaque_bounds_of_what_is_full_grow_on_all_sides_or_not_at_all() -> None:
    cloud = painted(20, 30, *((x, y) for x in range(30) for y in range(20)))
    assert texels_of(cloud, opaque_bounds(cloud)[0]) == [-3, 33, -2, 22]
    assert texels_of(cloud, opaque_bounds(cloud, grow=False)[0]) == [0, 30, 0, 20]


@pytest.mark.parametrize("alpha", [0.0, 0.3])
def test_a_billboard_with_nothing_on_it_keeps_its_bounds(alpha: float) -> None:
    cloud = painted(20, 30, (0, 0), (10, 6), alpha=alpha)
    torch.testing.assert_close(opaque_bounds(cloud), torch.tensor([[-1.5, 1.5, -1.0, 1.0]]))


def test_opaque_bounds_are_around_both_sides() -> None:
    front, back = painted(20, 30, (10, 6), sides="two"), painted(20, 30, (10, 6), (14, 9), sides="two")
    assert texels_of(front, opaque_bounds(front)[0]) == [8, 13, 4, 9]
    assert texels_of(back, opaque_bounds(back)[0]) == [8, 17, 4, 12]


def test_opaque_bounds_are_of_each_billboard() -> None:
    clouds = [painted(20, 30, (10, 6)), painted(20, 30, (3, 3), (20, 15)), painted(20, 30)]
    together = even_upright(3, axis=torch.zeros(3), half_extents=torch.tensor([1.5, 1.0]), texture_sizes=torch.tensor([20, 30]))
    together = together.with_texels(torch.cat([cloud.texels for cloud in clouds]))
    assert torch.equal(opaque_bounds(together), torch.cat([opaque_bounds(cloud) for cloud in clouds]))


def area_at(points: Tensor, degrees: float) -> float:
    """Area of the rectangle around points that is turned by an angle."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turned = points @ torch.tensor([[c, -s], [s, c]], dtype=points.dtype)
    return float((turned.amax(0) - turned.amin(0)).prod())


@pytest.mark.parametrize("stretch", [1.0, 1.6, 8.0])
def test_the_smallest_rectangle_holds_all_points_and_is_turned_if_that_makes_it_a_fifth_smaller(stretch: float) -> None:
    turned = 0
    for seed in range(30):
        generator = torch.Generator().manual_seed(seed)
        points = (2 * torch.rand(12, 2, generator=generator, dtype=torch.float64) - 1) * torch.tensor([stretch, 1.0], dtype=torch.float64)
        angle = 2 * math.pi * seed / 30
        c, s = math.cos(angle), math.sin(angle)
        points = points @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64) + torch.tensor([3.0, -2.0])
        center, axis, half = smallest_rectangle(points)
        assert center.dtype == axis.dtype == half.dtype == torch.float64
        assert float(axis.norm()) == pytest.approx(1) and axis[0] > axis[1].abs() - 1e-6  # by 45 degrees at most
        reach = (points - center) @ torch.stack([axis, torch.stack([-axis[1], axis[0]])]).mT
        assert (reach.abs() < half + 1e-5).all()
        torch.testing.assert_close(reach.amax(0), half, atol=1e-5, rtol=0)
        torch.testing.assert_close(reach.amin(0), -half, atol=1e-5, rtol=0)
        least, upright = min(area_at(points, 0.25 * step) for step in range(360)), area_at(points, 0)
        if least < 0.79 * upright:
            assert axis[1] != 0 and float(4 * half.prod()) < 1.001 * least
            turned += 1
        elif least > 0.82 * upright:  # a finer search may find a little less
            assert axis.tolist() == [1, 0]
    assert 3 < turned < 30


@pytest.mark.parametrize(
    "points",
    [
        [[0.3, 0.7]],
        pytest.param([[0.0, 0.0], [2.0, 0.0], [1.0, 0.0]]),
        pytest.param([[0.0, 0.0], [0.0, 2.0]]),
        pytest.param([[0.0, 0.0], [1.0, 1.0]]),
        [[0.0, 0.0], [1.0, -1.0]],
    ],
    ids=["one", "along x", "along y", "rising", "falling"],
)
def test_the_smallest_rectangle_of_points_in_a_row_is_turned_by_45_degrees_at_most(points: list[list[float]]) -> None:
    row = torch.tensor(points, dtype=torch.float64)
    center, axis, half = smallest_rectangle(row)
    reach = (row - center) @ torch.stack([axis, torch.stack([-axis[1], axis[0]])]).mT
    assert (reach.abs() < half + 1e-6).all() and float(half.prod()) < 1e-6
    assert axis[0] > axis[1].abs() - 1e-6
    upright = float((row.amax(0) - row.amin(0)).prod()) == 0
    assert not upright or axis.tolist() == [1, 0]


def test_trimming_leaves_the_picture(known_cloud: BillboardCloud, ring: Camera) -> None:
    texels = known_cloud.texels.clone()
    textures = known_cloud.with_texels(texels).textures()
    textures[0][:, :5, :, 3] = 0
    textures[0][:, :, -9:, 3] = 0.001  # rounds to 0 in eight bits
    textures[1][..., 3] = 0
    cloud = known_cloud.with_texels(texels)
    cut = trimmed(cloud)
    seen = torch.nonzero(textures[0][0, ..., 3] >= 0.5 / 255)
    assert cut.texture_sizes.tolist() == [(seen.amax(0) - seen.amin(0) + 3).tolist()]  # the other one shows nothing
    density = (cloud.texture_sizes.flip(-1) / cloud.half_extents)[:1]
    torch.testing.assert_close(cut.texture_sizes.flip(-1) / cut.half_extents, density, rtol=1e-5, atol=0)
    difference = render_reference(cut, ring) - render_reference(cloud, ring)
    assert difference.abs().max() < 2e-3 and render_reference(cut, ring)[..., 3].max() > 0.5


def test_trimming_leaves_a_billboard_where_none_shows_anything(known_cloud: BillboardCloud) -> None:
    texels = known_cloud.texels.clone()
    texels[:, 3] = 0.001
    cut = trimmed(known_cloud.with_texels(texels))
    assert len(cut) == 1 and cut.texture_sizes.tolist() == [[1, 1]]


@pytest.mark.parametrize("bounds", ["thesis", "silhouette"])
def test_empty_views_bound_nothing(views: ViewDataset, bounds: str) -> None:
    """A cloud gets the bounds of the views that show something, wherever the empty ones stand."""
    config = FitConfig(billboards=2, placement="even", bounds=bounds, texel_density=1)
    pictures = views.train.images(range(len(views.train))).clone()
    pictures[:2] = 0
    cloud = start_cloud(ViewSet.from_arrays(pictures, views.train.cameras), config)
    expected = start_cloud(views.train, config)
    assert cloud.half_extents.isfinite().all() and (cloud.half_extents > 0).all()
    torch.testing.assert_close(cloud.half_extents, expected.half_extents, rtol=0.2, atol=0)
