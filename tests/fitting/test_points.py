"""Points where a tree is: on the triangles of its mesh, and in the visual hull of its views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from bbfit.blender.request import RenderedTree
from bbfit.checks import InputError, MissingFileError
from bbfit.fitting.points import hull_points, mesh_points, point_colors
from bbfit.fitting.visibility import pixels_of
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.orbit import Orbit
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

PLY_OF_POINTS = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
end_header
0 0 0
1 0 0
"""
DATA = Path(__file__).resolve().parents[2] / "data"


def viewset(pictures: Tensor, cameras: Camera) -> ViewSet:
    """Views that lie in memory, uint8 [V, H, W, 4], straight alpha."""
    return ViewSet.from_arrays(pictures, cameras)


def ring_around_origin(count: int, width: int, height: int, *, elevation: float = 0.0) -> Camera:
    """Cameras whose pictures hold a cube of two meters around the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return Orbit(count, (elevation,)).frame(corners, target=torch.zeros(3, dtype=torch.float64), width=width, height=height)


@pytest.fixture(scope="module")
def views() -> ViewSet:
    """The training views of the small tree."""
    return ViewDataset.load(DATA / "views").train


@pytest.fixture(scope="module")
def tree() -> trimesh.Trimesh:
    """The mesh of the small tree. Do not change it."""
    return trimesh.load(DATA / "tree.glb", force="mesh", process=False)


@pytest.fixture(scope="module")
def on_mesh(views: ViewSet) -> Tensor:
    return mesh_points(TreeFile.open(DATA / "tree.glb"), views)


@pytest.fixture(scope="module")
def hull(views: ViewSet) -> Tensor:
    return hull_points(views)


@pytest.fixture(scope="module")
def anywhere() -> ViewSet:
    """Views that show something in every pixel, so that any mesh within a meter of the origin agrees with them."""
    return viewset(torch.full((4, 16, 16, 4), 255, dtype=torch.uint8), ring_around_origin(4, 16, 16))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


# Mesh


def test_points_lie_on_triangles_of_the_mesh(on_mesh: Tensor, tree: trimesh.Trimesh) -> None:
    assert on_mesh.shape == (20_000, 3) and on_mesh.dtype == torch.float64
    triangles = np.asarray(tree.triangles)
    for point in on_mesh[::500].numpy():
        nearest = trimesh.triangles.closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
        assert np.linalg.norm(nearest - point, axis=-1).min() < 1e-6  # meters; a triangle's side is about a hundredth


def test_points_are_even_by_area(on_mesh: Tensor, tree: trimesh.Trimesh) -> None:
    """Their mean and their shares in the eight octants about it are the area's, within four deviations of chance.

    Evenly by triangle instead of by area, the mean would be 7 deviations away.
    """
    areas, centroids = tree.area_faces, tree.triangles_center
    deviation = on_mesh.std(0) / len(on_mesh) ** 0.5
    mean = torch.tensor(np.average(centroids, axis=0, weights=areas))
    assert ((on_mesh.mean(0) - mean).abs() < 4 * deviation).all()
    assert ((on_mesh.mean(0) - torch.tensor(centroids.mean(0))).abs() > 6 * deviation).any()

    def octants(points: NDArray[np.float64]) -> NDArray[np.int64]:
        return (points > mean.numpy()) @ np.array([1, 2, 4])

    share = np.bincount(octants(centroids), areas, minlength=8) / areas.sum()
    found = np.bincount(octants(on_mesh.numpy()), minlength=8) / len(on_mesh)
    assert (np.abs(found - share) < 4 * np.sqrt(share / len(on_mesh)) + 2e-3).all()  # and what triangles across a border may add


def test_every_face_of_a_box_gets_its_share(anywhere: ViewSet, tmp_path: Path) -> None:
    low, high = np.array([-0.1, 0.0, -0.6]), np.array([0.2, 0.5, 0.5])
    box(tuple(low), tuple(high)).export(tmp_path / "box.glb")
    count = 6000
    points = mesh_points(TreeFile.open(tmp_path / "box.glb"), anywhere, count=count).numpy()
    assert points.shape == (count, 3)
    faces = np.abs(np.concatenate([points - low, points - high], -1)) < 1e-6
    assert (faces.sum(-1) == 1).all() and (points > low - 1e-6).all() and (points < high + 1e-6).all()
    sides = high - low
    share = np.tile(sides.prod() / sides, 2) / (2 * sides.prod() * (1 / sides).sum())
    assert (np.abs(faces.mean(0) - share) < 4 * np.sqrt(share / count)).all()


def test_points_of_a_mesh_are_seeded(on_mesh: Tensor, views: ViewSet) -> None:
    assert torch.equal(mesh_points(TreeFile.open(DATA / "tree.glb"), views, seed=0), on_mesh)
    other = mesh_points(TreeFile.open(DATA / "tree.glb"), views, seed=1)
    assert not (other[:, None] == on_mesh[None, :100]).all(-1).any()


@pytest.mark.parametrize("name", ["tree.glb", "tree.gltf", "tree.obj", "tree.ply", "tree.stl", "TREE.STL"])
def test_z_up_files_are_turned_and_others_are_not(anywhere: ViewSet, tmp_path: Path, name: str) -> None:
    """Up in PLY and STL files is z: (x, y, z) there is (x, z, -y) in the world."""
    mesh, ending = box((0.0, 0.2, 0.6), (0.1, 0.5, 0.9)), name[-4:].lower().lstrip(".")
    if ending == "gltf":  # several files
        for part, data in trimesh.exchange.gltf.export_gltf(mesh.scene()).items():
            (tmp_path / part.replace("model", "tree")).write_bytes(data)
    else:
        mesh.export(tmp_path / name, file_type=ending)
    points = mesh_points(TreeFile.open(tmp_path / name), anywhere, count=500)
    low, high = ((0.0, 0.6, -0.5), (0.1, 0.9, -0.2)) if ending in ("ply", "stl") else ((0.0, 0.2, 0.6), (0.1, 0.5, 0.9))
    torch.testing.assert_close(points.amin(0), torch.tensor(low, dtype=torch.float64), atol=0.01, rtol=0)
    torch.testing.assert_close(points.amax(0), torch.tensor(high, dtype=torch.float64), atol=0.01, rtol=0)


def test_all_meshes_of_a_scene_count_where_the_scene_puts_them(anywhere: ViewSet, tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for name, shift in (("trunk", [0.0, -0.5, 0.0]), ("crown", [0.0, 0.5, 0.25])):
        cube = box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))
        scene.add_geometry(cube, geom_name=name, transform=trimesh.transformations.translation_matrix(shift))
    scene.export(tmp_path / "tree.glb")
    points = mesh_points(TreeFile.open(tmp_path / "tree.glb"), anywhere, count=500)
    crown = points[:, 1] > 0
    assert 150 < int(crown.sum()) < 350
    assert ((points[crown] - torch.tensor([0.0, 0.5, 0.25])).abs() < 0.1 + 1e-6).all()
    assert ((points[~crown] - torch.tensor([0.0, -0.5, 0.0])).abs() < 0.1 + 1e-6).all()


def test_a_missing_mesh_is_said_to_be_missing(views: ViewSet, tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"^tree: .*tree\.glb does not exist"):
        mesh_points(TreeFile.open(tmp_path / "tree.glb"), views)


@pytest.mark.parametrize(
    ("ending", "start"), [("fbx", b"Kaydara FBX Binary"), ("blend", b"BLENDER-v405ENDB" + bytes(20)), ("usda", b"#usda 1.0\n")]
)
def test_what_only_blender_reads_is_refused(views: ViewSet, tmp_path: Path, ending: str, start: bytes) -> None:
    path = tmp_path / f"tree.{ending}"
    path.write_bytes(start)
    with pytest.raises(InputError, match=rf"^tree: only Blender .*tree\.{ending}; .*\.glb \.gltf \.obj \.ply \.stl"):
        mesh_points(TreeFile.open(path), views)


@pytest.mark.parametrize("spoil", ["cut short", "no glTF at all", "empty"])
def test_a_damaged_mesh_is_refused(views: ViewSet, tmp_path: Path, spoil: str) -> None:
    path, data = tmp_path / "tree.glb", (DATA / "tree.glb").read_bytes()
    path.write_bytes({"cut short": data[: len(data) // 2], "no glTF at all": bytes(range(256)), "empty": b""}[spoil])
    with pytest.raises(
        InputError,
        match=r"^tree: .*tree\.glb " + {"cut short": "is cut short", "no glTF at all": "is not a glTF", "empty": "is empty"}[spoil],
    ):
        mesh_points(TreeFile.open(path), views)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),  # a triangle without an area
        ("points.ply", PLY_OF_POINTS),
    ],
)
def test_a_mesh_without_triangles_is_refused(views: ViewSet, tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="ascii")
    with pytest.raises(InputError, match=rf"^tree: .*{name} has no triangles"):
        mesh_points(TreeFile.open(tmp_path / name), views)


@pytest.mark.parametrize(
    "change",
    [
        lambda mesh: mesh.apply_translation([1.0, 0.0, 0.0]),
        lambda mesh: mesh.apply_translation([0.0, 1.0, 0.0]),
        lambda mesh: mesh.apply_scale(2.0),
        lambda mesh: mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi, [0, 1, 0])),
        lambda mesh: mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])),
    ],
    ids=["beside", "above", "twice as large", "turned round", "lying down"],
)
def test_a_mesh_that_the_views_do_not_show_is_refused(
    views: ViewSet, tree: trimesh.Trimesh, tmp_path: Path, change: Callable[[trimesh.Trimesh], object]
) -> None:
    other = tree.copy()
    change(other)
    other.export(tmp_path / "other.glb")
    with pytest.raises(InputError, match=r"^tree: .*other\.glb is not where the views show a tree"):
        mesh_points(TreeFile.open(tmp_path / "other.glb"), views)


def test_a_mesh_of_another_tree_is_refused(views: ViewSet, tree: trimesh.Trimesh, tmp_path: Path) -> None:
    """A dense crown of the same width and height, since its outline is fuller than the tree's."""
    box(*(tuple(corner) for corner in tree.bounds)).export(tmp_path / "other.glb")
    with pytest.raises(InputError, match="is not where the views show a tree"):
        mesh_points(TreeFile.open(tmp_path / "other.glb"), views)


def test_the_file_that_was_rendered_needs_no_silhouette(views: ViewSet, tree: trimesh.Trimesh) -> None:
    """A tree so thin that its pictures miss most of it is where Blender measured it. Another digest or other bounds prove nothing."""
    file = TreeFile.open(DATA / "tree.glb")
    low, high = (tuple(corner) for corner in tree.bounds.tolist())
    alpha = views.images(range(len(views))).clone()
    alpha[:, : alpha.shape[1] // 2] = 0  # nothing is seen of the crown
    half = viewset(alpha, views.cameras)
    rendered = RenderedTree(sha256=file.digest, bounds=(low, high))
    assert torch.equal(mesh_points(file, half, rendered=rendered), mesh_points(file, views))
    moved = (low, tuple(value + 0.1 for value in high))
    for other, said in (
        (replace(rendered, sha256="0"), "is not where the views show a tree"),
        (None, "is not where the views show a tree"),
        (replace(rendered, bounds=moved), r"bbfit finds the triangles of .* elsewhere than Blender; export it from Blender as \.glb"),
        (replace(rendered, bounds=None), "elsewhere than Blender"),
    ):
        with pytest.raises(InputError, match=said):
            mesh_points(file, half, rendered=other)


@pytest.mark.parametrize(("shift", "same"), [(0.0, True), (3.0, False)])
def test_a_twig_that_samples_miss_is_where_the_views_show_its_trunk(shift: float, same: bool, tmp_path: Path) -> None:
    """Of twigs of a hundredth of a pixel no sample sees anything; near the trunk that is no contradiction, far from it it is."""
    cameras = ring_around_origin(8, 16, 16)
    pixel = 0.15  # meters
    trunk = box((-pixel, -1.0, -pixel), (pixel, 1.0, pixel))
    pictures = torch.zeros(8, 16, 16, 4, dtype=torch.uint8)
    for index in range(8):
        x, y = cameras[index].project(torch.from_numpy(trunk.vertices)).round().long().unbind(-1)
        pictures[index, int(y.amin()) : int(y.amax()) + 1, int(x.amin()) : int(x.amax()) + 1] = 255
    twigs = [box((0.0, y, 0.0), (0.6, y + 1e-3, 1e-3)) for y in np.linspace(-0.9, 0.9, 40)]
    mesh = trimesh.util.concatenate([box((-0.01, -1.0, -0.01), (0.01, 1.0, 0.01)), *twigs])
    mesh.apply_translation([shift, 0, 0]).export(tmp_path / "tree.glb")
    if same:
        assert len(mesh_points(TreeFile.open(tmp_path / "tree.glb"), viewset(pictures, cameras))) == 20_000
    else:
        with pytest.raises(InputError, match="is not where the views show a tree"):
            mesh_points(TreeFile.open(tmp_path / "tree.glb"), viewset(pictures, cameras))


# Hull


def test_a_pole_with_gaps_has_a_hull_and_empty_views_do_not_carve() -> None:
    """Every view of a thin pole shows other rows of it, as few samples do; without the gaps it would be the same pole."""
    cameras = ring_around_origin(6, 33, 33)
    pictures = torch.zeros(6, 33, 33, 4, dtype=torch.uint8)
    for index in range(5):
        pictures[index, 4 + index % 2 : 29 : 2, 16] = 255
    views = viewset(pictures, cameras)
    points = hull_points(views, count=500)
    assert len(points) == 500 and points[:, ::2].norm(dim=-1).max() < 0.3 and points[:, 1].abs().max() < 1.25
    pictures = torch.zeros(6, 33, 33, 4, dtype=torch.uint8)
    for index in range(5):
        pictures[index, 4 + 5 * index, 16] = 255
    with pytest.raises(InputError, match="the silhouettes have no point in common"):
        hull_points(viewset(pictures, cameras), count=10, batch=1 << 14)
    assert len(hull_points(viewset(pictures, cameras), count=10, batch=1 << 14, own=True)) == 10


def on_background(points: Tensor, views: ViewSet, index: int) -> Tensor:
    """Which points lie in a pixel of one view that is fully transparent."""
    pixels = views.cameras[index].project(points)
    assert pixels.isfinite().all()
    x, y = (pixels + 0.5).floor().long().unbind(-1)
    alpha = torch.nn.functional.pad(views.image(index)[..., 3], (1, 1, 1, 1), value=255)  # beyond a picture nobody knows
    return alpha[(y + 1).clamp(0, alpha.shape[0] - 1), (x + 1).clamp(0, alpha.shape[1] - 1)] == 0


def test_no_view_shows_background_where_the_hull_is(hull: Tensor, on_mesh: Tensor, views: ViewSet) -> None:
    assert hull.shape == (20_000, 3) and hull.dtype == torch.float64
    assert not any(on_background(hull, views, index).any() for index in range(len(views)))
    assert any(on_background(hull + torch.tensor([0.05, 0.0, 0.0]), views, index).any() for index in range(len(views)))


def test_the_hull_holds_the_tree(hull: Tensor, on_mesh: Tensor) -> None:
    """19 of 20 points of the mesh have one of the hull's within 7 cm (measured: 5.7), of a tree of 4.3 m; moved by 30 cm they have not."""
    reach = [float(np.quantile(cKDTree(points.numpy()).query(on_mesh.numpy())[0], 0.95)) for points in (hull, hull + 0.3)]
    assert reach[0] < 0.07 < 0.14 < reach[1], reach
    low, high = on_mesh.amin(0), on_mesh.amax(0)
    assert (hull.amin(0) < low + 0.1).all() and (hull.amax(0) > high - 0.1).all()


def test_points_of_the_hull_are_seeded(hull: Tensor, views: ViewSet) -> None:
    assert torch.equal(hull_points(views, seed=0), hull)
    other = hull_points(views, seed=1, count=500)
    assert other.shape == (500, 3)
    assert not (other[:, None] == hull[None, :1000]).all(-1).any()


def ball_views(count: int, width: int, height: int, radius: float, *, elevation: float = 0.0) -> ViewSet:
    """Exact silhouettes of a ball about the origin."""
    cameras = ring_around_origin(count, width, height, elevation=elevation)
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(cameras.intrinsics[0]).mT
    distance = float(cameras.position[0].norm())
    sine = rays[..., :2].norm(dim=-1) / rays.norm(dim=-1)  # every camera looks straight at the ball
    mask = (sine <= radius / distance).to(torch.uint8) * 255
    return viewset(mask[None, ..., None].expand(count, -1, -1, 4), cameras)


@pytest.mark.parametrize(
    ("width", "height"),
    [
        (64, 64),
        (48, 64),
        pytest.param(64, 48),
        (512, 600),
    ],
)
def test_the_hull_of_a_ball_is_little_more_than_the_ball(width: int, height: int) -> None:
    """Also where pictures are so large that they are carved from shrunk ones, and where they are not square.

    What twelve cameras at its height leave of the ball is a round-edged prism of at most 24 sides around it.
    """
    radius = 0.7
    points = hull_points(ball_views(12, width, height, radius), count=4000)
    assert len(points) == 4000
    pixel = 2 / min(min(width, height), 256)  # meters, of the pictures that are carved from
    across, up = points[:, ::2].norm(dim=-1), points[:, 1].abs()
    assert radius - 0.05 < across.max() < radius / math.cos(math.pi / 12) + pixel
    assert radius - 0.1 < up.max() < radius * 1.03 + pixel  # a cone around the ball is a little higher above its middle
    # Even: half of the ball's volume lies within radius / 2 ** (1 / 3) of its middle, and on either side of each plane through it.
    inner = points[points.norm(dim=-1) < radius]
    allowed = 4 * 0.5 / len(inner) ** 0.5
    assert len(inner) > 2000
    assert abs(float((inner.norm(dim=-1) < radius * 0.5 ** (1 / 3)).double().mean()) - 0.5) < allowed
    assert ((inner > 0).double().mean(0) - 0.5).abs().max() < allowed


def test_nothing_is_lost_of_silhouettes_that_are_shrunk() -> None:
    """Pictures are carved at half their size; one pixel in every block of four is as good as all of them."""
    small = ball_views(4, 256, 256, 0.5)
    mask = small.images(range(4))
    full = mask.repeat_interleave(2, 1).repeat_interleave(2, 2)
    dots = full.clone()
    dots[:, ::2] = 0
    dots[:, :, ::2] = 0
    cameras = small.cameras.resized(512, 512)
    whole, dotted, expected = (hull_points(views, count=500) for views in (viewset(full, cameras), viewset(dots, cameras), small))
    assert torch.equal(whole, dotted)
    torch.testing.assert_close(whole, expected, atol=1e-9, rtol=0)


def test_a_hull_that_few_points_hit_is_found_in_several_rounds() -> None:
    """One in a hundred of the first round lies in this ball; later rounds look around where these were, and as evenly."""
    radius = 0.3
    points = hull_points(ball_views(12, 64, 64, radius), count=4000, batch=1 << 14)
    assert len(points) == 4000
    low, high = points.amin(0), points.amax(0)
    assert (low < -radius + 0.03).all() and (high > radius - 0.03).all()
    assert points.mean(0).abs().max() < 4 * float(points.std(0).max()) / 4000**0.5
    inner = points[points.norm(dim=-1) < radius]
    assert abs(float((inner.norm(dim=-1) < radius * 0.5 ** (1 / 3)).double().mean()) - 0.5) < 4 * 0.5 / len(inner) ** 0.5


@pytest.mark.parametrize("elevation", [pytest.param(-30.0), pytest.param(20.0)])
def test_seen_from_above_or_below_the_hull_of_a_ball_is_not_much_more_either(elevation: float) -> None:
    """The cones of one ring of cameras meet in a tip above and below the ball, at its radius divided by the elevation's cosine."""
    radius = 0.9
    points = hull_points(ball_views(12, 64, 64, radius, elevation=elevation), count=4000)
    assert radius < points.norm(dim=-1).max() < 1.1 * radius / math.cos(math.radians(elevation))


def test_silhouettes_that_contradict_each_other_are_refused() -> None:
    """Nothing can be on the left from all sides."""
    pictures = torch.zeros(4, 32, 32, 4, dtype=torch.uint8)
    pictures[:, 8:24, 2:10] = 255
    with pytest.raises(InputError, match=r"^views: .*no point in common"):
        hull_points(viewset(pictures, ring_around_origin(4, 32, 32)), batch=1 << 14)  # dozens of vain rounds take a while


# Colors


def square_on(width: int, height: int) -> Camera:
    """A parallel projection from above that shows the point (x, y, z) at column x and row z, exactly."""
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).double()
    return Camera(pose, torch.eye(3).double(), width, height, orthographic=True)


def test_a_points_pixel_is_the_nearest_counted_row_by_row() -> None:
    camera = square_on(5, 3)
    y, x = torch.meshgrid(torch.arange(3).double(), torch.arange(5).double(), indexing="ij")
    for off_x, off_y in ((0, 0), (0.45, 0), (0, -0.45), (-0.49, 0.49)):
        points = torch.stack([x + off_x, torch.full_like(x, 7.0), y + off_y], -1).view(-1, 3)
        index, inside = pixels_of(points, camera)
        assert index.dtype == torch.int32 and inside.dtype == torch.bool
        assert index.tolist() == list(range(15)) and inside.all()


@pytest.mark.parametrize(("width", "height"), [(5, 3), (3, 5), (1, 1)])
def test_points_beyond_a_pictures_edges_are_not_in_it(width: int, height: int) -> None:
    """Pixels reach half a pixel beyond their centers; far away is outside as well."""
    right, bottom = width - 1, height - 1
    at = {
        (0, 0): True,
        (right, bottom): True,
        (-0.49, 0): True,
        (0, -0.49): True,
        (right + 0.49, bottom): True,
        (right, bottom + 0.49): True,
        (-0.51, 0): False,
        (0, -0.51): False,
        (right + 0.51, bottom): False,
        (right, bottom + 0.51): False,
        (-1, bottom): False,
        (right, -1): False,
        (right + 1, 0): False,
        (0, bottom + 1): False,
    }
    for far in (10.0, 1e4, 1e10, 1e300):
        at |= {(far, 0): False, (-far, 0): False, (0, far): False, (0, -far): False}
    points = torch.tensor([[x, 0.0, y] for x, y in at], dtype=torch.float64)
    index, inside = pixels_of(points, square_on(width, height))
    assert inside.tolist() == list(at.values())
    assert ((index[inside] >= 0) & (index[inside] < width * height)).all()
    assert index[:2].tolist() == [0, width * height - 1]


def test_points_behind_a_camera_are_not_in_its_picture() -> None:
    """Even those that would be in its middle; and those right beside it, whose projection is infinitely far away."""
    camera = ring_around_origin(1, 9, 7)[0]
    before = camera.position + torch.tensor([[1.0], [0.1], [1e-3]], dtype=torch.float64) * camera.forward
    behind = camera.position - torch.tensor([[0.0], [1e-3], [1.0]], dtype=torch.float64) * camera.forward
    beside = camera.position + camera.world_to_camera[:2, :3]
    index, inside = pixels_of(torch.cat([before, behind, beside, beside + 1e-12 * camera.forward]), camera)
    assert inside.tolist() == [True] * 3 + [False] * 7
    assert index[:3].tolist() == [3 * 9 + 4] * 3


def test_pixels_are_where_the_camera_projects_to() -> None:
    """Of a picture wider than it is high, by a pinhole."""
    camera = ring_around_origin(3, 40, 22, elevation=25.0)[1]
    points = 6 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 3
    x, y = (camera.project(points) + 0.5).floor().long().unbind(-1)
    inside = (x >= 0) & (x < 40) & (y >= 0) & (y < 22)
    found, shown = pixels_of(points, camera)
    assert torch.equal(shown, inside) and 500 < int(inside.sum()) < 1800
    assert torch.equal(found[inside].long(), (40 * y + x)[inside])


def seen_by(points: Tensor, cameras: Camera) -> list[tuple[Tensor, Tensor]]:
    """The pixels of points in every view."""
    return [pixels_of(points, cameras[view]) for view in range(len(cameras))]


def color_scene() -> tuple[Tensor, Camera, Tensor]:
    """Points one above another on the ring's axis, so that each keeps its row in all four views, the cameras, and pictures with nothing."""
    points = torch.tensor([[0.0, y, 0.0] for y in (-0.6, 0.0, 0.6)], dtype=torch.float64)
    return points, ring_around_origin(4, 32, 24), torch.zeros(4, 24, 32, 4)


def paint(pictures: Tensor, camera: Camera, view: int, point: Tensor, straight: tuple[float, float, float], alpha: float) -> None:
    """Give the pixel of a point a premultiplied color in one view."""
    x, y = (camera[view].project(point[None])[0] + 0.5).floor().long().tolist()
    pictures[view, y, x] = torch.tensor([*(alpha * c for c in straight), alpha])


def test_a_points_color_is_the_mean_of_what_the_views_show_weighted_by_alpha() -> None:
    points, cameras, pictures = color_scene()
    red, blue = (0.8, 0.1, 0.0), (0.0, 0.3, 0.9)
    for view, alpha in enumerate((1.0, 0.5, 0.25, 0.01)):
        paint(pictures, cameras, view, points[0], red, alpha)
    for view, color, alpha in ((0, red, 0.25), (2, blue, 0.75)):  # and background in the other two, which has no say
        paint(pictures, cameras, view, points[1], color, alpha)
    colors = point_colors(seen_by(points, cameras), pictures)
    assert colors.dtype == torch.float32
    expected = torch.tensor([red, tuple(0.25 * r + 0.75 * b for r, b in zip(red, blue, strict=True)), (0.0, 0.0, 0.0)])
    torch.testing.assert_close(colors, expected, atol=1e-5, rtol=0)


def test_views_that_do_not_see_a_point_have_no_say() -> None:
    """Beyond a picture's edge, and behind a camera."""
    pose = look_at(torch.tensor([[0.0, 0, 1], [0, 0, -3], [0, 0, 3]]).double(), torch.zeros(3).double())
    pose[1, 0, 3] += 3.0  # its picture lies to the side of everything
    cameras = Camera(pose, pinhole_intrinsics(40, 16, 16).repeat(3, 1, 1), 16, 16)
    pictures = torch.ones(3, 16, 16, 4) * torch.tensor([[1.0, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])[:, None, None]
    points = torch.tensor([[0.0, 0, 0], [0, 0, 2], [0, 50, 0]], dtype=torch.float64)  # the second is behind the first camera
    colors = point_colors(seen_by(points, cameras), pictures)
    torch.testing.assert_close(colors, torch.tensor([[0.5, 0, 0.5], [0, 0, 1], [0, 0, 0]]), atol=1e-6, rtol=0)


def test_every_view_has_its_own_pixels() -> None:
    with pytest.raises(ValueError, match="zip"):
        point_colors(seen_by(torch.zeros(1, 3).double(), ring_around_origin(3, 8, 8)), torch.zeros(4, 8, 8, 4))
