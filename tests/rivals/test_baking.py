"""Baked textures are the pictures, where the pictures were taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bbfit.checks import InputError
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, orthographic_intrinsics
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, read_rgba
from bbfit.operators.drawing.reference import render_reference
from bbfit.rivals.baking import BakeConfig, Slabs, bake, tree_triangles

WHOLE = (-5.0, 5.0)


def slabs(*rows: tuple[list[float], list[float], list[float], tuple[float, float]]) -> Slabs:
    """Rectangles by center, right, up and depths, with sides that leave out nothing of the thing."""
    columns = [torch.tensor([row[i] for row in rows], dtype=torch.float64) for i in range(4)]
    return Slabs(*columns[:3], torch.tensor([[2.1, 2.3]], dtype=torch.float64).repeat(len(rows), 1), columns[3])


FRONT = ([0.13, 1.07, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
# About a tilted normal.
TILTED = ([0.3, 0.9, 0.1], [0.6, 0.0, -0.8], [0.48, 0.8, 0.36])


def picture_camera(slab: Slabs, n: int, size: int, density: float, side: float) -> Camera:
    """A parallel camera in front of a rectangle (side 1) or behind it (-1), with pixels where the rectangle's picture has them."""
    right, up = slab.rights[n] * side, slab.ups[n]
    normal = torch.linalg.cross(right, up)
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = torch.stack([right, -up, -normal])
    transform[:3, 3] = -(transform[:3, :3] @ (slab.centers[n] + 20 * normal))
    return Camera(transform, orthographic_intrinsics(size / density, size, size), size, size, True)


@pytest.mark.parametrize("two_sided", [False, True])
def test_baked_cloud_seen_from_where_it_was_baked_is_the_picture(
    thing_glb: Path, tmp_path: Path, coarse: BakeConfig, two_sided: bool
) -> None:
    """Every pixel, alone in front of each side, up to float32 (measured 2e-6); a one-sided back is the front's mirror image."""
    asked = slabs((*FRONT, WHOLE), (*TILTED, WHOLE))
    cloud = bake(thing_glb, asked, replace(coarse, two_sided=two_sided), folder=tmp_path)
    assert len(cloud) == 2 and cloud.two_sided.tolist() == [two_sided] * 2
    assert len(list(tmp_path.glob("*.png"))) == (4 if two_sided else 2)
    for n in range(2):
        front = read_rgba(tmp_path / f"{n:04}.png")
        back = read_rgba(tmp_path / f"{n + 2:04}.png") if two_sided else front[:, ::-1]
        size = len(front)
        for side, picture in ((1, front), (-1, back)):
            drawn = render_reference(cloud.take([n]).to(torch.float64), picture_camera(asked, n, size, coarse.texels_per_meter, side))
            expected = premultiply(torch.from_numpy(np.ascontiguousarray(picture)).double() / 255)
            torch.testing.assert_close(drawn, expected, atol=1e-5, rtol=0)
        assert (front != read_rgba(tmp_path / f"{n:04}.png")[:, ::-1]).any()


def test_rectangle_lies_about_what_it_shows(thing_glb: Path, coarse: BakeConfig) -> None:
    """To a texel and the filter's reach, 2 texels of 5 cm: from the front the thing spans [-0.2, 1.3] x [0, 2]."""
    cloud = bake(thing_glb, slabs((*FRONT, WHOLE)), coarse)
    low, high = (cloud.centers[0] + sign * torch.cat([cloud.half_extents[0], torch.zeros(1)]) for sign in (-1, 1))
    np.testing.assert_allclose(low, [-0.2, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(high, [1.3, 2.0, 0.0], atol=0.1)
    assert (2 * cloud.half_extents * coarse.texels_per_meter).flip(-1).round().long().tolist() == cloud.texture_sizes.tolist()
    texture = cloud.textures()[0][0]
    assert all((texture[edge][..., 3] > 0).any() for edge in (0, -1)) and all((texture[:, edge, 3] > 0).any() for edge in (0, -1))


def test_slab_shows_what_lies_within_it(thing_glb: Path, coarse: BakeConfig) -> None:
    """In front of z = 0.25 there is only the blue foot; behind z = -0.5 nothing, which gives no billboard."""
    asked = slabs(([0.0, 1.0, 0.5], *FRONT[1:], (-0.25, 0.5)), (*FRONT, (-3.0, -0.5)), (*FRONT, (-0.5, 0.15)))
    cloud = bake(thing_glb, asked, coarse)
    assert len(cloud) == 2
    foot, rest = (texture[0] for texture in cloud.textures())
    visible = foot[foot[..., 3] == 1]
    assert (visible[:, 2] > 2 * visible[:, 0]).all()
    np.testing.assert_allclose(cloud.half_extents[0], [0.1, 0.15], atol=0.1)
    np.testing.assert_allclose(cloud.half_extents[1], [0.75, 1.0], atol=0.1)
    assert not rest[rest[..., 3] == 1].amin(0)[:3].any()  # the post is cut open, and dark inside


def test_cut_stems_take_the_color_of_what_is_lit(thing_glb: Path, coarse: BakeConfig) -> None:
    """The post cut at z = 0.15 is black inside; filled, every texel is one of the lit ones, and as opaque as before."""
    asked = slabs((*FRONT, (-0.5, 0.15)))
    black, filled = (bake(thing_glb, asked, coarse, fill_cuts=fill).textures()[0][0] for fill in (False, True))
    torch.testing.assert_close(filled[..., 3], black[..., 3], atol=0, rtol=0)
    inside = (black[..., :3].amax(-1) < 0.1) & (black[..., 3] > 0)
    assert inside.sum() > 100
    assert filled[..., :3].amax(-1).min() >= 0.19
    lit = (black[..., :3].amax(-1) >= 0.2) & (black[..., 3] > 0)
    torch.testing.assert_close(filled[lit], black[lit], atol=0, rtol=0)


def test_without_any_light_nothing_is_filled(thing_glb: Path, coarse: BakeConfig) -> None:
    night = replace(coarse, views=replace(coarse.views, sun_strength=0.0, ambient_strength=0.0))
    texture = bake(thing_glb, slabs((*FRONT, WHOLE)), night, fill_cuts=True).textures()[0][0]
    assert (texture[..., 3] == 1).sum() > 300 and not texture[..., :3].any()


def test_nothing_at_all_is_an_empty_cloud(thing_glb: Path, coarse: BakeConfig) -> None:
    cloud = bake(thing_glb, slabs((*FRONT, (3.0, 4.0))), coarse)
    assert len(cloud) == 0 and isinstance(cloud, BillboardCloud)
    assert not render_reference(cloud, picture_camera(slabs((*FRONT, WHOLE)), 0, 16, 4.0, 1)).any()


def test_no_transparent_texel_is_black(thing_glb: Path, coarse: BakeConfig) -> None:
    """Each has a visible texel's color, which for the front of the thing is red, green or blue."""
    texture = bake(thing_glb, slabs((*TILTED, WHOLE)), coarse).textures()[0][0]
    hidden = texture[..., 3] == 0
    assert hidden.float().mean() > 0.3
    shown = {tuple(color) for color in texture[~hidden][:, :3].tolist()}
    assert all(tuple(color) in shown for color in texture[hidden][:, :3].tolist())


def test_rectangle_cuts_off_what_is_beyond_it(thing_glb: Path, coarse: BakeConfig) -> None:
    """A rectangle of the post's lower half ends there, but for the filter's 2 texels."""
    whole = slabs((*FRONT, WHOLE))
    low = Slabs(torch.tensor([[0.0, 0.5, 0.0]]).double(), whole.rights, whole.ups, torch.tensor([[0.2, 0.5]]).double(), whole.depths)
    cloud = bake(thing_glb, low, coarse)
    top = float(cloud.centers[0, 1] + cloud.half_extents[0, 1])
    assert top == pytest.approx(1.0 + 2 / coarse.texels_per_meter, abs=1e-6)


def test_settings_arrive(thing_glb: Path, tmp_path: Path, coarse: BakeConfig) -> None:
    """Alpha mode, light, and the folder, from which the same request is served again without rendering."""
    asked = slabs((*FRONT, WHOLE))
    dark = replace(coarse, alpha=AlphaMode("mask", 0.3), views=replace(coarse.views, sun_strength=0.0, ambient_strength=0.1))
    cloud = bake(thing_glb, asked, dark, folder=tmp_path)
    assert cloud.alpha == AlphaMode("mask", 0.3)
    assert cloud.texels[:, :3].mean() < 0.6 * bake(thing_glb, asked, coarse).texels[:, :3].mean()
    before = (tmp_path / "0000.png").stat().st_mtime_ns
    torch.testing.assert_close(bake(thing_glb, asked, dark, folder=tmp_path).texels, cloud.texels, atol=0, rtol=0)
    assert (tmp_path / "0000.png").stat().st_mtime_ns == before


def test_triangles_of_every_kind_of_file_are_in_the_world_of_the_views(thing_glb: Path, tmp_path: Path) -> None:
    import trimesh

    expected = [[-0.2, 0.0, -0.2], [1.3, 2.0, 0.8]]
    mesh = trimesh.load(thing_glb, force="mesh")
    mesh.apply_transform(np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    trimesh.Trimesh(mesh.vertices, mesh.faces).export(str(tmp_path / "z_up.ply"))
    for path in (thing_glb, tmp_path / "z_up.ply"):
        triangles = tree_triangles(path)
        assert triangles.shape == (36, 3, 3)
        np.testing.assert_allclose([triangles.min((0, 1)), triangles.max((0, 1))], expected, atol=1e-5)


def test_bad_input_is_refused(thing_glb: Path, coarse: BakeConfig) -> None:
    with pytest.raises(InputError, match="texels_per_meter"):
        BakeConfig(0.0)
    with pytest.raises(InputError, match="least before the greatest"):
        slabs((*FRONT, (1.0, 1.0)))
    asked = slabs((*FRONT, WHOLE))
    with pytest.raises(InputError, match="none to bake"):
        bake(thing_glb, Slabs(*(getattr(asked, name)[:0] for name in ("centers", "rights", "ups", "half_extents", "depths"))), coarse)
    with pytest.raises(InputError, match="16384"):
        bake(thing_glb, asked, replace(coarse, texels_per_meter=1e5))
