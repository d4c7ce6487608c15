"""Bounded billboards hold what the views show."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from bbfit.fitting.bounds import facing, facing_view_bounds
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import start_cloud
from bbfit.geometry.camera import convergence_point
from bbfit.geometry.cloud import even_upright
from bbfit.geometry.homography import texel_to_pixel
from bbfit.views import ViewDataset


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
        view = int(facing(views.train.cameras, planes.normals, planes.centers[0])[:, n].argmax())
        rows, columns = torch.nonzero(views.train.image(view)[..., 3] > 0).double().unbind(-1)
        left, right, bottom, top = bounds[n]
        corners = torch.stack([planes.centers[n] + x * planes.rights[n] + y * planes.ups[n] for x in (left, right) for y in (bottom, top)])
        pixels = views.train.cameras[view].project(corners)
        # The plane's box, seen from that view, holds the pixel box; a view that is not quite perpendicular sees it as a trapezoid.
        assert pixels[:, 0].amin() <= columns.min() - 0.5 + 1e-5 and pixels[:, 0].amax() >= columns.max() + 0.5 - 1e-5
        assert pixels[:, 1].amin() <= rows.min() - 0.5 + 1e-5 and pixels[:, 1].amax() >= rows.max() + 0.5 - 1e-5
        if facing(views.train.cameras, planes.normals, planes.centers[0])[view, n] > 1 - 1e-12:  # perpendicular: exactly the box
            expected = torch.stack([columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5]).double()
            found = torch.stack([pixels[:, 0].amin(), pixels[:, 0].amax(), pixels[:, 1].amin(), pixels[:, 1].amax()])
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("sides", ["one", "two", "pair"])
def test_silhouette_bounds_cut_nothing_off(views: ViewDataset, count: int, sides: str) -> None:
    """Every opaque pixel of every training view within 60 degrees of a billboard's normal lies on that billboard."""
    cloud = start_cloud(views.train, FitConfig(billboards=count, sides=sides, bounds="silhouette"))
    camera = views.train.cameras.to(torch.float32)
    cosines = facing(camera, cloud.normals, convergence_point(views.train.cameras).float()).abs()
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
    cloud = start_cloud(views.train, FitConfig(billboards=2, bounds="silhouette"))
    camera = views.train.cameras.to(torch.float32)
    cosines = facing(camera, cloud.normals, convergence_point(views.train.cameras).float()).abs()
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
    whole = start_cloud(views.train, FitConfig(bounds="viewport"))
    part = start_cloud(views.train, FitConfig(bounds="silhouette"))
    assert len(part.texels) < len(whole.texels)
    for cloud in (whole, part):
        density = cloud.texture_sizes.flip(-1) / (2 * cloud.half_extents)
        torch.testing.assert_close(density, density[:1, :1].expand_as(density))
    torch.testing.assert_close(part.texture_sizes[0, 0] / part.half_extents[0, 1], whole.texture_sizes[0, 0] / whole.half_extents[0, 1])


def test_unbounded_billboards_fill_the_viewport_of_a_facing_camera(views: ViewDataset) -> None:
    cloud = start_cloud(views.train, FitConfig(billboards=4, bounds="viewport"))
    camera = views.train.cameras.to(torch.float32)
    size = torch.tensor([camera.width, camera.height])
    assert cloud.texture_sizes.tolist() == [[camera.height, camera.width]] * 4
    cosines = facing(camera, cloud.normals, convergence_point(views.train.cameras).float())
    view, n = divmod(int(cosines.argmax()), 4)
    assert cosines[view, n] > 1 - 1e-6
    corners = torch.tensor([[-0.5, -0.5, 1], [size[0] - 0.5, size[1] - 0.5, 1]])
    pixels = corners @ texel_to_pixel(cloud, camera)[view, n].mT
    torch.testing.assert_close(pixels[:, :2] / pixels[:, 2:], corners[:, :2], atol=1e-2, rtol=0)


def test_pairs_stand_a_hair_apart_along_the_normal(views: ViewDataset) -> None:
    cloud = start_cloud(views.train, FitConfig(billboards=2, sides="pair", bounds="viewport"))
    between = ((cloud.centers[0::2] - cloud.centers[1::2]) * cloud.normals[0::2]).sum(-1)
    assert len(cloud) == 4 and cloud.vertex_count == 16
    assert (between > 0).all() and (between < 5e-3 * cloud.half_extents[0, 0]).all()
