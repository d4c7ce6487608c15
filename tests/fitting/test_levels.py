"""Views and textures at a fraction of their resolution: means of premultiplied colors, in the same places as before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import bbfit
from bbfit.fitting.bounds import opaque_bounds
from bbfit.fitting.initialize import bounded
from bbfit.fitting.levels import Targets, resampled, resize_textures, shrunk_sizes
from bbfit.geometry.camera import Camera, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.images import premultiply
from bbfit.operators.drawing.reference import render_reference
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet


def viewset(pictures: Tensor, cameras: Camera | None = None) -> ViewSet:
    """Views that lie in memory, uint8 [V, H, W, 4], straight alpha."""
    views, height, width = pictures.shape[:3]
    if cameras is None:
        pose, intrinsics = torch.eye(4, dtype=torch.float64), pinhole_intrinsics(40, width, height)
        cameras = Camera(pose.repeat(views, 1, 1), intrinsics.repeat(views, 1, 1), width, height)
    return ViewSet.from_arrays(pictures, cameras)


def noise(views: int, height: int, width: int) -> Tensor:
    """Random straight-alpha pictures, a quarter of the pixels each exactly transparent and opaque."""
    generator = torch.Generator().manual_seed(height * width)
    pictures = torch.randint(0, 256, (views, height, width, 4), generator=generator)
    pictures[..., 3] = (2 * pictures[..., 3] - 128).clamp(0, 255)
    return pictures.to(torch.uint8)


def flat_cloud(*sizes: tuple[int, int], sides: str = "one") -> BillboardCloud:
    """Upright billboards with transparent textures, float32."""
    return even_upright(
        len(sizes), axis=torch.zeros(3), half_extents=torch.tensor([1.0, 1.5]), texture_sizes=torch.tensor(sizes), sides=sides
    )


def random_cloud(*sizes: tuple[int, int], sides: str = "one") -> BillboardCloud:
    """The same with random textures."""
    cloud = flat_cloud(*sizes, sides=sides)
    texels = torch.rand(cloud.texels.shape, generator=torch.Generator().manual_seed(0))
    texels[:, 3] = (2 * texels[:, 3] - 0.5).clamp(0, 1)
    return cloud.with_texels(texels)


@pytest.mark.parametrize("halvings", [1, 2, 3])
def test_shrunk_views_are_means_of_premultiplied_pixels(halvings: int) -> None:
    """Rounded to 8 bits once, at the end; a hundredth of a level is float32's."""
    pictures, cell = noise(3, 16, 40), 2**halvings
    targets = Targets.at(viewset(pictures), halvings)
    assert targets.shrunk is not None and targets.shrunk.dtype == torch.uint8 and targets.shrunk.is_contiguous()
    exact = premultiply(pictures.double() / 255).view(3, 16 // cell, cell, 40 // cell, cell, 4).mean((2, 4)) * 255
    assert targets.shrunk.shape == exact.shape
    assert (targets.shrunk - exact).abs().max() <= 0.51
    assert (targets.shrunk[..., :3] <= targets.shrunk[..., 3:]).all()  # still a premultiplied color
    assert torch.equal(targets.packed([2, 0]), targets.shrunk[[2, 0]])
    assert torch.equal(targets.pictures([2, 0]), targets.shrunk[[2, 0]].float() / 255)


def test_views_at_full_resolution_are_the_views() -> None:
    pictures = noise(3, 12, 14)
    views = viewset(pictures)
    targets = Targets.at(views, 0)
    assert targets.shrunk is None and targets.cameras is views.cameras
    assert torch.equal(targets.packed([2, 0]), pictures[[2, 0]])
    assert torch.equal(targets.pictures([2, 0]), premultiply(pictures[[2, 0]].float() / 255))


def test_the_color_of_transparent_pixels_does_not_bleed() -> None:
    pictures = torch.tensor([0, 255, 0, 0], dtype=torch.uint8).repeat(1, 16, 16, 1)
    pictures[:, ::2, 1::2] = torch.tensor([200, 0, 100, 255], dtype=torch.uint8)
    shrunk = Targets.at(viewset(pictures), 1).shrunk
    assert shrunk is not None
    assert (shrunk == torch.tensor([50, 0, 25, 64])).all()


@pytest.mark.parametrize(("height", "width"), [(33, 47), (40, 26), (21, 35)])
@pytest.mark.parametrize("halvings", [1, 2])
def test_odd_sizes(height: int, width: int, halvings: int) -> None:
    """Sizes are rounded; what is even stays even, and a ramp stays where it was to half a pixel of the full resolution."""
    ramp = torch.zeros(2, height, width, 4, dtype=torch.uint8)
    ramp[..., 3], ramp[0, ..., 0], ramp[1, ..., 1] = 255, torch.arange(width) * 5, torch.arange(height)[:, None] * 5
    ramp[..., 2] = 77
    targets = Targets.at(viewset(ramp), halvings)
    small = targets.pictures([0, 1]) * 255
    rows, columns = small.shape[1:3]
    assert (columns, rows) == (targets.cameras.width, targets.cameras.height)
    assert abs(columns - width / 2**halvings) <= 0.5 and abs(rows - height / 2**halvings) <= 0.5
    assert torch.allclose(small[..., 2:], torch.tensor([77.0, 255.0]))
    x, y = ((torch.arange(n) + 0.5) * full / n - 0.5 for n, full in ((columns, width), (rows, height)))
    assert ((small[0, ..., 0] / 5 - x).abs() <= 0.5 + 0.1).all() and ((small[1, ..., 1] / 5 - y[:, None]).abs() <= 0.5 + 0.1).all()
    middle = small.mean((1, 2)) / 5  # to half a level of 8 bits
    assert abs(middle[0, 0] - (width - 1) / 2) < 0.11 and abs(middle[1, 1] - (height - 1) / 2) < 0.11


@pytest.mark.parametrize("halvings", [1, 2, 3])
@pytest.mark.parametrize(("height", "width"), [(16, 40), (33, 47), (16, 16)])
def test_a_point_keeps_its_place_in_the_field_of_view(height: int, width: int, halvings: int) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + torch.tensor([-0.5, -0.5, 2.0])
    views = viewset(noise(2, height, width))
    places = []
    for cameras in (views.cameras, Targets.at(views, halvings).cameras):
        places.append((cameras.project(points) + 0.5) / torch.tensor([cameras.width, cameras.height]))  # of pixel edges
    torch.testing.assert_close(*places, atol=1e-12, rtol=0)


def test_a_shrunk_view_is_what_a_shrunk_camera_sees(known_cloud: BillboardCloud, ring: Camera, views_folder: Path) -> None:
    """Of smooth textures, but for the means' own blur: an offset by half a pixel would be far more than what is allowed."""
    views = ViewDataset.load(views_folder).train
    for halvings, allowed in ((1, 0.006), (2, 0.02)):  # root mean square; measured 0.0041 and 0.0124, with an offset 0.039 and 0.070
        targets = Targets.at(views, halvings)
        seen = render_reference(known_cloud, targets.cameras)
        rms = [
            float((render_reference(known_cloud, camera) - targets.pictures(range(len(views)))).square().mean().sqrt())
            for camera in (targets.cameras, shifted(targets.cameras))
        ]
        assert seen.max() > 0.9 and rms[0] < allowed < rms[1] / 2, rms


def shifted(camera: Camera) -> Camera:
    """Half a pixel to the side."""
    return replace(camera, intrinsics=camera.intrinsics + torch.tensor([[0, 0, 0.5], [0, 0, 0], [0, 0, 0]]).double())


RESIZES = [((8, 6), (4, 3)), ((8, 6), (16, 12)), ((7, 5), (4, 3)), ((4, 3), (7, 5)), ((5, 5), (5, 5)), ((1, 1), (2, 2)), ((3, 1), (1, 1))]


@pytest.mark.parametrize(("old", "new"), RESIZES)
@pytest.mark.parametrize("alpha", [0.0, 0.004, 0.3, 1.0])
def test_even_textures_stay_even(old: tuple[int, int], new: tuple[int, int], alpha: float) -> None:
    """On both sides, up and down; of fully transparent ones the color, too."""
    cloud = flat_cloud(old, old, sides="two")
    colors = torch.tensor([[0.2, 0.4, 0.9, alpha], [0.7, 0.1, 0.3, alpha], [0.5, 0.6, 0.0, alpha], [1.0, 0.8, 0.35, alpha]])
    cloud = cloud.with_texels(colors.repeat_interleave(old[0] * old[1], 0))
    sizes = torch.tensor([new, old])
    resized = resize_textures(cloud, sizes)
    assert torch.equal(resized.texture_sizes, sizes)
    for name in ("centers", "rights", "ups", "half_extents", "two_sided"):
        assert torch.equal(getattr(resized, name), getattr(cloud, name))
    for texture, pair, size in zip(resized.textures(), colors.view(2, 2, 4), (new, old), strict=True):
        assert texture.shape == (2, *size, 4)
        torch.testing.assert_close(texture, pair[:, None, None].expand(texture.shape), atol=1e-6, rtol=0)


@pytest.mark.parametrize("cell", [2, 4])
def test_shrinking_keeps_the_mean_of_premultiplied_colors(cell: int) -> None:
    cloud = random_cloud((16, 24), (8, 40), sides="two")
    resized = resize_textures(cloud, shrunk_sizes(cloud, cell // 2))
    for old, new in zip(cloud.textures(), resized.textures(), strict=True):
        sides, height, width, _ = new.shape
        expected = premultiply(old).view(sides, height, cell, width, cell, 4).mean((2, 4))
        torch.testing.assert_close(premultiply(new), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [(3, 4), (12, 16)])
def test_color_comes_from_what_is_visible_and_else_from_what_is_there(size: tuple[int, int]) -> None:
    """Green where transparent must not show in red that is visible, and stays where nothing is."""
    cloud = flat_cloud((6, 8))
    texels = torch.tensor([0.0, 1.0, 0.0, 0.0]).repeat(6, 8, 1)
    texels[:, :4] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    resized = resize_textures(cloud.with_texels(texels.reshape(-1, 4)), torch.tensor([size])).textures()[0][0]
    visible = resized[..., 3] > 0
    assert visible.any() and not visible.all()
    assert torch.equal(resized[..., :3][visible], torch.tensor([1.0, 0.0, 0.0]).expand(int(visible.sum()), 3))
    assert torch.equal(resized[..., :3][~visible], torch.tensor([0.0, 1.0, 0.0]).expand(int((~visible).sum()), 3))


@pytest.mark.parametrize("height", [1, 2, 5])
def test_enlarging_a_ramp_gives_the_ramp(height: int) -> None:
    """Texels lie at their centers: four times as many halve their distance twice, and none is moved."""
    cloud = flat_cloud((height, 6))
    ramp = torch.full((height, 6, 4), 1.0)
    ramp[..., 0] = 0.1 + 0.1 * torch.arange(6)
    fine = resize_textures(cloud.with_texels(ramp.view(-1, 4)), torch.tensor([[height * (1 if height == 1 else 4), 24]]))
    expected = 0.1 + 0.1 * ((torch.arange(24) + 0.5) / 4 - 0.5)
    torch.testing.assert_close(fine.textures()[0][0, :, 2:-2, 0], expected[2:-2].expand(len(fine.textures()[0][0]), 20), atol=1e-6, rtol=0)


def test_shrunk_sizes_are_rounded_up() -> None:
    cloud = flat_cloud((8, 5), (1, 9), (17, 16))
    assert shrunk_sizes(cloud, 0).tolist() == [[8, 5], [1, 9], [17, 16]]
    assert shrunk_sizes(cloud, 1).tolist() == [[4, 3], [1, 5], [9, 8]]
    assert shrunk_sizes(cloud, 3).tolist() == [[1, 1], [1, 2], [3, 2]]


@pytest.mark.parametrize("factor", [0.5, 2])
def test_a_smooth_texture_looks_the_same_at_another_resolution(known_cloud: BillboardCloud, ring: Camera, factor: float) -> None:
    """Root mean square over the pictures; measured 0.0007 refined, 0.0046 shrunk; moved by half a texel 0.006 and 0.023."""
    sizes = (known_cloud.texture_sizes * factor).long()
    resized = resize_textures(known_cloud, sizes)
    before, after = render_reference(known_cloud, ring), render_reference(resized, ring)
    rms = float((before - after).square().mean().sqrt())
    assert before.max() > 0.9 and rms < (0.001 if factor > 1 else 0.007), rms
    moved = replace(resized, centers=resized.centers + resized.half_extents[:, :1] / sizes[:, 1:] * resized.rights)
    assert float((before - render_reference(moved, ring)).square().mean().sqrt()) > 4 * rms


@pytest.mark.parametrize("sides", ["one", "two"])
@pytest.mark.parametrize("factor", [0.5, 1, 2])
def test_onto_equal_rectangles_textures_are_resized(sides: str, factor: float) -> None:
    cloud = random_cloud((8, 6), (4, 10), sides=sides)
    sizes = (cloud.texture_sizes * factor).long()
    again, expected = resampled(cloud, replace(cloud, texels=torch.zeros_like(cloud.texels)), sizes), resize_textures(cloud, sizes)
    assert torch.equal(again.texels, expected.texels) and torch.equal(again.texture_sizes, sizes)
    assert torch.equal(again.centers, cloud.centers) and torch.equal(again.half_extents, cloud.half_extents)


def cut(cloud: BillboardCloud, left: int, right: int, bottom: int, top: int) -> BillboardCloud:
    """The cloud with so many texels less on each side of all its rectangles, or more, and transparent textures."""
    texel = 2 * cloud.half_extents / cloud.texture_sizes.flip(-1)
    sizes = cloud.texture_sizes - torch.tensor([bottom + top, left + right])
    middle = torch.tensor([left - right, bottom - top]) / 2 * texel
    return replace(
        cloud,
        centers=cloud.centers + middle[:, :1] * cloud.rights + middle[:, 1:] * cloud.ups,
        half_extents=sizes.flip(-1) * texel / 2,
        texture_sizes=sizes,
        texels=torch.zeros(int((sizes.prod(-1) * (1 + cloud.two_sided.long())).sum()), 4),
    )


@pytest.mark.parametrize("sides", ["one", "two"])
def test_by_whole_texels_smaller_or_larger_every_texel_keeps_its_place(sides: str) -> None:
    """Left, right, bottom and top by different numbers, cut and grown at once; beyond the border nothing, in the border's color."""
    cloud = random_cloud((9, 12), (7, 8), sides=sides)
    onto = cut(cloud, 2, -3, 1, -2)
    for old, new in zip(cloud.textures(), resampled(cloud, onto, onto.texture_sizes).textures(), strict=True):
        height, width = old.shape[1:3]
        assert new.shape[1:3] == (height + 1, width + 1)
        kept, expected = new[:, 2:, : width - 2], old[:, : height - 1, 2:]
        torch.testing.assert_close(kept[..., 3], expected[..., 3], atol=1e-5, rtol=0)
        visible = expected[..., 3] > 1e-2
        torch.testing.assert_close(kept[visible], expected[visible], atol=1e-3, rtol=0)  # of little alpha, colors are quotients
        assert new[:, :2, :, 3].max() < 1e-5 and new[:, :, width - 2 :, 3].max() < 1e-5
        torch.testing.assert_close(new[:, :2, : width - 2, :3], old[:, :1, 2:, :3].expand(-1, 2, -1, -1), atol=1e-4, rtol=0)
        torch.testing.assert_close(new[:, 2:, width - 2 :, :3], old[:, : height - 1, -1:, :3].expand(-1, -1, 3, -1), atol=1e-4, rtol=0)


def test_a_cut_down_rectangle_shows_the_same_picture(known_cloud: BillboardCloud, ring: Camera) -> None:
    """At the same density, if what is cut off is nothing, as without the haze that bounds ignore. Moved by half a texel it does not."""
    colors, alpha = known_cloud.texels.split((3, 1), -1)
    known_cloud = known_cloud.with_texels(torch.cat([colors, torch.where(alpha > 0.3, alpha, 0)], -1))
    texel = 2 * known_cloud.half_extents / known_cloud.texture_sizes.flip(-1)
    bounds = opaque_bounds(known_cloud)
    assert (bounds.abs() < known_cloud.half_extents.repeat_interleave(2, -1)).all()  # there is something to be cut off
    onto = bounded(known_cloud, bounds, 1 / texel[0, 0])
    assert torch.equal(onto.texture_sizes, (2 * onto.half_extents * (1 / texel[0])).round().long().flip(-1))
    cloud = resampled(known_cloud, onto, onto.texture_sizes)
    assert len(cloud.texels) < len(known_cloud.texels)
    before, after = bbfit.render(known_cloud, ring), bbfit.render(cloud, ring)
    moved = replace(cloud, centers=cloud.centers + texel[:, :1] / 2 * cloud.rights)
    assert before.max() > 0.9
    assert float((before - after).abs().max()) < 0.02 < 0.1 < float((before - bbfit.render(moved, ring)).abs().max())


@pytest.mark.parametrize("factor", [1, 2])
def test_a_grown_rectangle_shows_the_same_picture_and_is_transparent_beyond(known_cloud: BillboardCloud, ring: Camera, factor: int) -> None:
    opaque = known_cloud.with_texels(torch.cat([known_cloud.texels[:, :3], torch.ones(len(known_cloud.texels), 1)], -1))
    onto = cut(opaque, -4, -6, -5, -3)
    cloud = resampled(opaque, onto, onto.texture_sizes * factor)
    for texture in cloud.textures():
        beyond = torch.ones(texture.shape[1:3], dtype=torch.bool)
        # The border's own texels fade over one texel, at a finer resolution over two.
        spare = factor // 2
        beyond[3 * factor - spare : -5 * factor + spare, 4 * factor - spare : -6 * factor + spare] = False
        assert texture[0, beyond][:, 3].max() < 1e-4 and texture[0, ~beyond][:, 3].min() > 0.06  # a quarter in a quarter at corners
        assert texture[0, beyond][:, :3].any(-1).all()  # in the color of the border, not in black
    before, after = bbfit.render(opaque, ring), bbfit.render(cloud, ring)
    assert float((before - after).square().mean().sqrt()) < (1e-4 if factor == 1 else 0.01)


@pytest.mark.parametrize("factor", [1, 2])
def test_colors_are_filtered_premultiplied_when_rectangles_change(factor: int) -> None:
    """Green where transparent must not show in red that is visible, and stays where nothing is."""
    cloud = flat_cloud((6, 8))
    texels = torch.tensor([0.0, 1.0, 0.0, 0.0]).repeat(6, 8, 1)
    texels[:, :4] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    onto = cut(cloud, 1, 1, 0, 1)
    onto = replace(onto, centers=onto.centers + 0.03 * onto.rights)  # off the grid, so that colors mix
    texture = resampled(cloud.with_texels(texels.reshape(-1, 4)), onto, onto.texture_sizes * factor).textures()[0][0]
    visible = texture[..., 3] > 0
    assert visible.any() and not visible.all() and (texture[..., 3][visible] < 0.9).any()
    torch.testing.assert_close(texture[..., :3][visible], torch.tensor([1.0, 0.0, 0.0]).expand(int(visible.sum()), 3))
    assert (texture[..., 1][~visible] > 0).all()


@pytest.mark.parametrize("moved", [0, 1])
def test_a_texture_that_shrinks_onto_another_rectangle_keeps_its_mean(moved: int) -> None:
    """Every other pair of columns is white: a quarter as many texels are gray, however the rectangle has moved."""
    cloud = flat_cloud((32, 32))
    stripes = torch.ones(32, 32, 4)
    stripes[:, torch.arange(32) % 4 > 1, :3] = 0
    onto = cut(cloud, moved, -moved, 0, 0)
    small = resampled(cloud.with_texels(stripes.view(-1, 4)), onto, torch.tensor([[8, 8]])).textures()[0]
    torch.testing.assert_close(small[0, :, 1:-1, :3], torch.full((8, 6, 3), 0.5), atol=0.05, rtol=0)
