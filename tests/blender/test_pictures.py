"""What the pictures show: cameras, axes of every format, colors, alpha, light."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.files import read_json
from bbfit.images import read_rgba
from bbfit.tree_files.tree_file import UP_AXES
from bbfit.views.dataset import ViewDataset

from .conftest import FORMATS, SMALL, box, run_in_blender, thing


def pictures(folder: Path) -> np.ndarray:
    """All pictures of a folder, [V, H, W, 4] in 0..255."""
    return np.stack([read_rgba(path) for path in sorted((folder / "images").glob("*.png"))]).astype(float)


def color(picture: np.ndarray) -> np.ndarray:
    """Mean color of the fully covered pixels, [3]."""
    return picture[picture[..., 3] == 255][:, :3].mean(0)


def coverage(triangles: np.ndarray, size: int) -> np.ndarray:
    """Share of each pixel that triangles [T, 3, 2] cover, [size, size], by drawing them eight times as large."""
    large = np.zeros((8 * size, 8 * size), np.uint8)
    for corners in np.rint(((triangles + 0.5) * 8 - 0.5) * 16).astype(np.int32):
        cv2.fillPoly(large, [corners], 1, shift=4)
    return large.reshape(size, 8, size, 8).mean((1, 3))


@pytest.mark.parametrize(
    "setting",
    [{"fov_degrees": 50.0}, {"orthographic": True}, {"fov_degrees": 100.0, "axis": "center"}],
    ids=["pinhole", "orthographic", "wide"],
)
def test_projected_vertices_are_where_the_picture_is(thing_glb: Path, tmp_path: Path, setting: dict) -> None:
    """Pins Blender's camera, the transforms files, our cameras and the axes to each other.

    The picture's bounding box is that of the projected vertices to a pixel, and the picture covers what the projected triangles cover.
    """
    config = ViewsConfig(
        **SMALL | {"count": 8, "size": 96, "samples": 16, "training_samples": 16, "elevations": (0.0, 35.0, -20.0, 90.0)} | setting
    )
    views = ViewDataset.load(render_views(thing_glb, tmp_path / "views", config))
    mesh = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces) for part in thing()])
    assert sorted(views.train.names + views.test.names) == [f"{i:04}" for i in range(8)]
    for part in (views.train, views.test):
        for index, pixels in enumerate(part.cameras.project(torch.from_numpy(mesh.vertices)).numpy()):
            assert pixels.min() >= 1 and pixels.max() <= 94
            alpha = part.image(index)[..., 3].numpy()
            rows, columns = np.nonzero(alpha > 50)
            seen = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
            np.testing.assert_allclose(seen, [*pixels.min(0), *pixels.max(0)], atol=1.0)
            covered = coverage(pixels[mesh.faces], 96)
            assert alpha[covered > 0.8].min() > 127
            assert alpha[covered < 0.2].max() < 127


def test_whole_frame_is_used(unbroken: Path) -> None:
    """The tree fills the frame up to the margin in at least one view, and touches the border in none."""
    alpha = pictures(unbroken)[..., 3]
    border = np.concatenate([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]])
    assert border.max() == 0
    rows, columns = np.nonzero(alpha.max(0))
    assert max(np.ptp(rows), np.ptp(columns)) >= 0.9 * 32 or max(abs(15.5 - rows).max(), abs(15.5 - columns).max()) >= 13.5


@pytest.mark.parametrize("ending", FORMATS)
def test_every_format_gives_the_same_pictures(things: Path, unbroken: Path, tmp_path: Path, ending: str) -> None:
    """Silhouettes agree to 2/255; colors, where the format has them, to 3/255; a .blend's light, world and scripts have no effect."""
    out = render_views(things / f"thing{ending}", tmp_path / "views", ViewsConfig(**SMALL | {"render_workers": 1}))
    got, expected = pictures(out), pictures(unbroken)
    assert abs(got[..., 3] - expected[..., 3]).max() <= 2
    tree = read_json("views", out / "views.json")["tree"]
    assert tree["up_axis"] == UP_AXES[ending]
    assert tree["faces"] == 36
    np.testing.assert_allclose(tree["bounds"], [[-0.2, 0.0, -0.2], [1.3, 2.0, 0.8]], atol=1e-5)
    if ending != ".stl":
        solid = (expected[..., 3] == 255) & (got[..., 3] == 255)
        difference = abs(got[solid][:, :3] - expected[solid][:, :3])
        assert np.median(difference) <= 1 and difference.mean() <= 3, difference.mean()
    assert not (things / "script_ran").exists()


def test_what_stands_in_views_json(unbroken: Path, thing_glb: Path) -> None:
    import hashlib

    request = read_json("views", unbroken / "views.json")
    assert request["complete"] is True
    assert request["config"]["size"] == 32 and request["config"]["elevations"] == [0.0]
    tree = request["tree"]
    assert tree["name"] == "thing.glb" and tree["bytes"] == thing_glb.stat().st_size
    assert tree["sha256"] == hashlib.sha256(thing_glb.read_bytes()).hexdigest()
    assert tree["vertices"] == sum(len(part.vertices) for part in thing())
    assert request["blender"].startswith("4.5") and request["seconds"] > 0 and request["camera"]["distance"] > 2
    assert request["camera"]["target"] == pytest.approx([0.0, 1.0, 0.0])  # the trunk stands on the origin


def test_matt_white_in_even_light_is_white_and_grey_keeps_its_value(tmp_path: Path) -> None:
    """Linear 0.5 is 188 in sRGB under view transform Standard; allowed 3/255 for noise and the dielectric's sheen."""
    for name, value, expected in (("white", 255, 255), ("gray", 128, 188)):
        trimesh.Scene([box((-1, 0, -1), (1, 2, 1), (value, value, value))]).export(str(tmp_path / f"{name}.glb"))
        config = ViewsConfig(**SMALL | {"count": 2, "samples": 16, "training_samples": 16, "sun_strength": 0.0})
        seen = color(pictures(render_views(tmp_path / f"{name}.glb", tmp_path / name, config)))
        np.testing.assert_allclose(seen, expected, atol=3)


def test_alpha_is_straight(tmp_path: Path) -> None:
    """Half-covered pixels at the edge keep the surface's color: a white ball is white there too (premultiplied would be gray)."""
    ball = trimesh.creation.icosphere(2)
    ball.visual = box((0, 0, 0), (1, 1, 1), (255, 255, 255)).visual
    ball.export(str(tmp_path / "white.glb"))
    config = ViewsConfig(**SMALL | {"count": 2, "samples": 64, "training_samples": 64, "sun_strength": 0.0})
    picture = pictures(render_views(tmp_path / "white.glb", tmp_path / "views", config))
    edge = (picture[..., 3] > 60) & (picture[..., 3] < 200)
    assert edge.sum() > 50
    assert picture[edge][:, :3].min() >= 245
    assert picture[..., 3].min() == 0 and picture[..., 3].max() == 255


def test_sun_stands_where_it_was_put(thing_glb: Path, tmp_path: Path) -> None:
    """The view from the sun's side is the brighter one by far."""
    for azimuth in (90.0, 180.0):
        config = ViewsConfig(**SMALL | {"ambient_strength": 0.05, "sun_azimuth": azimuth, "sun_elevation": 20.0})
        seen = pictures(render_views(thing_glb, tmp_path / f"{azimuth}", config))
        brightness = [color(picture).mean() for picture in seen]
        assert np.argmax(brightness) == azimuth / 90
        assert max(brightness) > 2 * brightness[(int(azimuth / 90) + 2) % 4]


def test_panorama_lights_the_tree(tmp_path: Path) -> None:
    """A panorama of pure blue makes a white box blue."""
    trimesh.Scene([box((-1, 0, -1), (1, 2, 1), (255, 255, 255))]).export(str(tmp_path / "white.glb"))
    cv2.imwrite(str(tmp_path / "sky.hdr"), np.full((8, 16, 3), (1.0, 0.0, 0.0), np.float32))
    config = ViewsConfig(**SMALL | {"count": 2, "samples": 16, "training_samples": 16, "sun_strength": 0.0, "hdri": tmp_path / "sky.hdr"})
    seen = color(pictures(render_views(tmp_path / "white.glb", tmp_path / "views", config)))
    np.testing.assert_allclose(seen, [0, 0, 255], atol=3)


def test_surface_without_material_is_gray(tmp_path: Path) -> None:
    trimesh.creation.box(bounds=[(-1, -1, 0), (1, 1, 2)]).export(str(tmp_path / "plain.stl"))
    config = ViewsConfig(**SMALL | {"count": 2, "sun_strength": 0.0})
    np.testing.assert_allclose(color(pictures(render_views(tmp_path / "plain.stl", tmp_path / "views", config))), 188, atol=3)


def test_what_a_blend_makes_at_render_time_is_measured(tmp_path: Path) -> None:
    """Modifiers as they are when rendering, instances of collections, curves; out of a folder with an awkward name."""
    folder = tmp_path / "a#b %04d {x} \u00fc"
    folder.mkdir()
    run_in_blender(
        """
import bpy, os, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=1, location=(0.5, 0.5, 0.5))
array = bpy.context.object.modifiers.new("array", "ARRAY")
array.count, array.show_viewport = 3, False
bpy.context.object.hide_viewport = True
leaves = bpy.data.collections.new("leaves")
bpy.ops.mesh.primitive_plane_add(size=1, location=(0, 0, 0))
leaf = bpy.context.object
bpy.context.scene.collection.objects.unlink(leaf)
leaves.objects.link(leaf)
for height in (4, 6):
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", leaves, (0, -2, height)
    bpy.context.scene.collection.objects.link(empty)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush()
os._exit(0)
""",
        str(folder / "tree.blend"),
    )
    out = render_views(folder / "tree.blend", folder / "views", ViewsConfig(**SMALL))
    tree = read_json("views", out / "views.json")["tree"]
    assert tree["faces"] == 3 * 12 + 2 * 2 and tree["vertices"] == 3 * 8 + 2 * 4
    np.testing.assert_allclose(tree["bounds"], [[-0.5, 0.0, -1.0], [3.0, 6.0, 2.5]], atol=1e-5)
    alpha = pictures(out)[..., 3]
    assert alpha[:, 1:-1, 1:-1].any((1, 2)).all()
    assert not any(side.any() for side in (alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]))
