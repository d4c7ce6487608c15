"""Trees with fewer triangles or bytes: which leaves and twigs stay, how large they are, and what a file may have."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from bbfit import ThinConfig, thin_tree
from bbfit.blender.conversion import tree_as_glb
from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.exporting.config import LodConfig
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.trees import ATTEMPTS, filled
from bbfit.glb import split_glb
from bbfit.lod import _smaller

from .conftest import load, parts

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"


def twiggy(path: Path) -> Path:
    """A trunk, 2,000 separate twigs and 3,000 leaves of two triangles in eight clusters along a line, without textures."""
    random, meshes = np.random.default_rng(4), dict[str, trimesh.Trimesh]()
    trunk = trimesh.creation.cylinder(0.2, segment=[[0, 0, 0], [8, 0, 0]], sections=32)
    starts = random.uniform([0, 0.2, -1], [8, 2, 1], (2000, 3))
    twigs = [trimesh.creation.cylinder(0.005, segment=[start, start + np.array([0, 0.2, 0])], sections=8) for start in starts]
    middles = np.stack([np.repeat(np.arange(8), 375), *random.uniform(-1, 1, (2, 3000))], -1)
    across, down = (0.05 * np.linalg.qr(random.normal(size=(3000, 3, 3)))[0][:, :2]).transpose(1, 0, 2)
    corners_ = np.stack([middles - across, middles + down, middles + across, middles - down], 1).reshape(-1, 3)
    faces = (4 * np.arange(3000)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    meshes["leaf"] = trimesh.Trimesh(corners_, faces, process=False)
    meshes["bark"] = trimesh.util.concatenate([trunk, *twigs])
    for name, mesh in meshes.items():
        mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=name, baseColorFactor=[90, 90, 50, 255]))
    trimesh.Scene(meshes).export(str(path))
    return path


def test_a_tree_of_many_twigs_keeps_its_leaves_its_trunk_and_whole_twigs(tmp_path: Path) -> None:
    """64,000 triangles of twigs could only collapse to far more than the 2,000 that are requested of all."""
    tree = twiggy(tmp_path / "twiggy.glb")
    before = parts(tree)[1]
    _, after = parts(tree_as_glb(tree, tmp_path / "few.glb", triangles=2000))
    assert 1900 <= sum(len(mesh.faces) for mesh in after.values()) <= 2000
    assert after["leaf"].area == pytest.approx(before["leaf"].area, rel=1e-4)
    np.testing.assert_allclose(after["bark"].bounds[:, 0], [0, 8], atol=0.01)  # the trunk is whole
    assert len(after["bark"].split(only_watertight=False)) > 20
    lengths = [np.ptp(part.vertices, axis=0).max() for part in after["bark"].split(only_watertight=False)]
    assert np.median(lengths) == pytest.approx(0.2, abs=0.02)
    # Each cluster keeps an eighth of the leaves. Chance would vary by 16 % of that.
    shares = np.bincount(after["leaf"].triangles_center[:, 0].round().astype(int), minlength=8) / len(after["leaf"].faces)
    np.testing.assert_allclose(shares, 1 / 8, rtol=0.05)  # measured 0.042


def test_leaves_and_bark_of_different_layers_are_thinned_out_together(tmp_path: Path) -> None:
    """Blender cannot join meshes with colors of vertices to others without losing a material's colors."""
    scene = trimesh.load(twiggy(tmp_path / "twiggy.glb"), process=False)
    leaves = next(mesh for mesh in scene.geometry.values() if mesh.visual.material.name == "leaf")
    leaves.visual = trimesh.visual.ColorVisuals(leaves, vertex_colors=np.tile([[40, 90, 30, 255]], (len(leaves.vertices), 1)))
    scene.export(str(tmp_path / "colored.glb"))
    few = load(tree_as_glb(tmp_path / "colored.glb", tmp_path / "few.glb", triangles=2000))
    assert 1900 <= len(few.faces) <= 2000
    np.testing.assert_allclose(few.bounds, load(tmp_path / "colored.glb").bounds, atol=0.2)


def test_leaves_that_cannot_collapse_to_a_triangle_are_fewer(tmp_path: Path) -> None:
    """Blender leaves a few triangles of each closed surface, such as a needle."""
    places = np.random.default_rng(5).uniform(-1, 1, (1500, 3))
    needle = trimesh.creation.icosphere(1).apply_scale([0.005, 0.05, 0.005])
    meshes = {
        "leaf": trimesh.util.concatenate([needle.copy().apply_translation(place) for place in places]),
        "bark": trimesh.creation.cylinder(0.05, segment=[[0, -2, 0], [0, 1, 0]], sections=64),
    }
    for name, mesh in meshes.items():
        mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=name, baseColorFactor=[90, 90, 50, 255]))
    trimesh.Scene(meshes).export(str(tmp_path / "tree.glb"))
    found = parts(tree_as_glb(tmp_path / "tree.glb", tmp_path / "few.glb", triangles=1000))[1]
    assert 500 <= sum(len(mesh.faces) for mesh in found.values()) <= 1000  # measured 561


def test_few_triangles_of_many_are_evenly_spread_leaves_of_the_finer_tree(tmp_path: Path) -> None:
    """A coarser tree has no leaf at a place where a finer one has none, so that levels of detail change as little as possible."""
    tree = twiggy(tmp_path / "twiggy.glb")
    places = list[np.ndarray]()
    for count in (9000, 7000):
        leaf = parts(tree_as_glb(tree, tmp_path / f"{count}.glb", triangles=count))[1]["leaf"]
        places.append(np.array([part.vertices.mean(0) for part in leaf.split(only_watertight=False)]))
    assert 1000 < len(places[1]) < len(places[0])
    distances = np.linalg.norm(places[1][:, None] - places[0][None], axis=-1).min(1)
    assert np.median(distances) < 0.01


def leaves(count: int, *, double: bool = False) -> trimesh.Trimesh:
    """Square leaves of 12 cm around (0, 3.5, 0); with ``double``, each has a front and a back that share no vertices."""
    random = np.random.default_rng(7)
    middles = random.uniform([-1.5, 2, -1.5], [1.5, 5, 1.5], (count, 1, 3))
    across, down = (0.06 * np.linalg.qr(random.normal(size=(count, 3, 3)))[0][:, :2]).transpose(1, 0, 2)[..., None, :]
    squares = middles + np.concatenate([-across - down, across - down, across + down, down - across], 1)
    faces = (4 * np.arange(count)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    front = trimesh.Trimesh(squares.reshape(-1, 3), faces, process=False)
    back = trimesh.Trimesh(front.vertices, faces[:, ::-1], process=False)
    return trimesh.util.concatenate([front, back]) if double else front


def trunk(*, flat: bool = False) -> trimesh.Trimesh:
    """A cylinder of 5 m and 1,536 triangles; the triangles of a ``flat`` one share no vertices, because their normals differ."""
    round_one = trimesh.creation.cylinder(0.2, segment=[[0, 0, 0], [0, 5, 0]], sections=24).subdivide().subdivide()
    if not flat:
        return round_one
    points, normals = round_one.vertices[round_one.faces].reshape(-1, 3), np.repeat(round_one.face_normals, 3, 0)
    return trimesh.Trimesh(points, np.arange(len(points)).reshape(-1, 3), vertex_normals=normals, process=False)


def stars(count: int) -> tuple[trimesh.Trimesh, np.ndarray, np.ndarray]:
    """Leaves with eight points, of 16 triangles each, small and large ones, around (0, 3.5, 0); their centers, and their areas."""
    random, turn = np.random.default_rng(3), np.arange(16) * np.pi / 8
    reach = np.where(np.arange(16) % 2, 0.03, 0.06) * random.uniform(0.7, 1.3, (count, 16)) * np.where(np.arange(count) % 2, 1, 2)[:, None]
    frames = np.linalg.qr(random.normal(size=(count, 3, 3)))[0][:, :2]
    rims = (reach[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)) @ frames
    lattice = np.stack(np.meshgrid(*[np.arange(-2, 3) * 0.4] * 3), -1).reshape(-1, 1, 3)
    middles = lattice[:count] + np.array([0, 3.5, 0])
    corners = np.concatenate([middles, middles + rims], 1)
    fan = np.stack([np.zeros(16, int), 1 + np.arange(16), 1 + np.roll(np.arange(16), -1)], -1)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), (17 * np.arange(count)[:, None, None] + fan).reshape(-1, 3), process=False)
    areas = mesh.area_faces.reshape(count, 16)
    return mesh, (areas[..., None] * mesh.triangles_center.reshape(count, 16, 3)).sum(1) / areas.sum(1)[:, None], areas.sum(1)


def test_leaves_keep_their_centers_and_areas(tmp_path: Path) -> None:
    """Of leaves that collapse to a few triangles, large ones stay large, and none moves. They grow for the leaves that are gone."""
    leaf, centers, areas = stars(125)
    tree = written(tmp_path / "tree.glb", leaf=leaf, bark=trunk())
    for triangles in (1200, 400):
        found = parts(tree_as_glb(tree, tmp_path / f"{triangles}.glb", triangles=triangles))[1]["leaf"]
        found = trimesh.Trimesh(found.vertices, found.faces)  # merged
        own = [part.area_faces @ part.triangles_center / part.area for part in found.split(only_watertight=False)]
        nearest = np.linalg.norm(np.array(own)[:, None] - centers[None], axis=-1)
        np.testing.assert_allclose(nearest.min(1), 0, atol=2e-4)
        ratios = np.array([part.area for part in found.split(only_watertight=False)]) / areas[nearest.argmin(1)]
        np.testing.assert_allclose(ratios, areas.sum() / areas[nearest.argmin(1)].sum(), rtol=2e-3)


@pytest.mark.parametrize("sides", [1, 2])
def test_leaves_are_whole_or_a_triangle_a_side(sides: int, tmp_path: Path) -> None:
    """Leaves of two or three triangles look worse than a mixture of both."""
    leaf, centers, _ = stars(125)
    normals = leaf.face_normals.reshape(125, 16, 3)[:, 0]
    back = trimesh.Trimesh(leaf.vertices, leaf.faces[:, ::-1], process=False)
    tree = written(tmp_path / "tree.glb", leaf=trimesh.util.concatenate([leaf, back][:sides]), bark=trunk())
    found = parts(tree_as_glb(tree, tmp_path / "few.glb", triangles=1200 * sides))[1]["leaf"]
    nearest = np.linalg.norm(found.triangles_center[:, None] - centers[None], axis=-1).argmin(1)
    same = (found.face_normals * normals[nearest]).sum(-1)
    np.testing.assert_allclose(np.abs(same), 1, atol=1e-3)
    for front in (True, False)[:sides]:
        sizes = Counter(np.bincount(nearest[(same > 0) == front], minlength=125).tolist())
        assert sizes.keys() == {1, 16} and sizes[16] >= 15


def written(path: Path, **meshes: trimesh.Trimesh) -> Path:
    """A GLB of meshes with materials of their names."""
    for name, mesh in meshes.items():
        mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=name, baseColorFactor=[90, 90, 50, 255]))
    trimesh.Scene(meshes).export(str(path), include_normals=True)
    return path


@pytest.mark.parametrize("triangles", [1500, 600])
def test_a_trunk_of_flat_faces_stays_whole(triangles: int, tmp_path: Path) -> None:
    """Its triangles share no vertices. As pieces for themselves they would be taken for leaves."""
    tree = written(tmp_path / "flat.glb", leaf=leaves(1500), bark=trunk(flat=True))
    found = parts(tree_as_glb(tree, tmp_path / "few.glb", triangles=triangles))[1]
    assert sum(len(mesh.faces) for mesh in found.values()) <= triangles
    np.testing.assert_allclose(found["bark"].bounds, [[-0.2, 0, -0.2], [0.2, 5, 0.2]], atol=0.03)  # measured 0.017
    np.testing.assert_allclose(found["bark"].bounds[:, 1], [0, 5], atol=1e-3)
    assert found["bark"].area == pytest.approx(trunk().area, rel=0.1)
    assert found["leaf"].area == pytest.approx(leaves(1500).area, rel=1e-3)


@pytest.mark.parametrize("triangles", [4000, 2500, 1200])
def test_leaves_keep_fronts_and_backs(triangles: int, tmp_path: Path) -> None:
    """A program that culls back faces would show a leaf from one side only."""
    tree = written(tmp_path / "double.glb", leaf=leaves(1000, double=True), bark=trunk())
    found = parts(tree_as_glb(tree, tmp_path / "few.glb", triangles=triangles))[1]
    assert sum(len(mesh.faces) for mesh in found.values()) <= triangles
    normals, areas = found["leaf"].face_normals, found["leaf"].area_faces
    sides = Counter[tuple[float, ...]]()
    for normal, area in zip(normals, areas, strict=True):
        sides[tuple(np.round(normal * np.sign(normal @ [1, 2, 3]), 3))] += area * np.sign(normal @ [1, 2, 3])
    assert len(sides) > 100
    assert np.abs(list(sides.values())).sum() < 0.02 * areas.sum()


@pytest.mark.parametrize(("picture", "each"), [(0, 40), (30_000, 36), (0, 700)])
def test_a_size_is_filled(picture: int, each: int) -> None:
    """Of files whose bytes are those of pictures and of triangles, which are not quite proportional to the triangles that are wanted."""
    tried = list[int]()

    def convert(triangles: int) -> bytes:
        tried.append(triangles)
        return bytes(picture + int(each * triangles**0.98))

    assert 0.95 * 100_000 <= len(filled(convert, 100_000, None, lambda done, total: None)) <= 100_000
    assert len(tried) <= ATTEMPTS
    assert len(filled(convert, 100_000, 50, lambda done, total: None)) == len(convert(50))


def test_a_size_that_is_out_of_reach_gives_the_smallest_file() -> None:
    assert len(filled(lambda triangles: bytes(5000 + triangles), 4000, None, lambda done, total: None)) <= 5010
    assert len(filled(lambda triangles: bytes(min(900, triangles)), 4000, None, lambda done, total: None)) == 900


def test_the_command_fills_a_limit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "thin.glb"
    assert main(["thin", str(TREE), "--out", str(out), "--bytes", "50k", "--profile", "three"]) == 0
    assert 47_500 <= out.stat().st_size <= 50_000
    tree, _ = split_glb(out.read_bytes())
    assert "KHR_mesh_quantization" in tree["extensionsRequired"]
    vertices, triangles = glb_counts(out.read_bytes())
    assert f"{vertices:,} vertices, {triangles:,} triangles" in capsys.readouterr().out
    np.testing.assert_allclose(load(out).bounds, load(TREE).bounds, atol=0.2)
    assert main(["thin", str(TREE), "--out", str(out), "--triangles", "500"]) == 0  # a file of its own is replaced
    assert "extensionsRequired" not in split_glb(out.read_bytes())[0] and glb_counts(out.read_bytes())[1] <= 500


@pytest.mark.parametrize(
    ("original", "thinned", "left"),
    [
        (True, (9000, 4808, 4000, 500), [4000, 500]),  # the tree has 4,808 triangles
        (False, (9000, 4808, 4000, 500), [4808, 4000, 500]),
        (True, (4000, 500), [4000, 500]),
        (False, (9000,), [9000]),
        (True, (9000,), []),
    ],
)
def test_no_level_is_the_tree_again(original: bool, thinned: tuple[int, ...], left: list[int], caplog: pytest.LogCaptureFixture) -> None:
    views = SimpleNamespace(request=SimpleNamespace(tree=SimpleNamespace(faces=4808)))
    assert _smaller(LodConfig(original=original, thinned=thinned), views) == left  # type: ignore[arg-type]
    assert bool(caplog.text) == (len(left) < len(thinned))


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of 5 MB whose leaves have a picture of noise."""
    crown, noise = leaves(4000), np.random.default_rng(8).integers(0, 255, (1024, 1024, 4), np.uint8)
    tree = tmp_path_factory.mktemp("pictured") / "tree.glb"
    leaf = PBRMaterial(name="leaf", baseColorTexture=Image.fromarray(noise), alphaMode="MASK")
    corners = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (4000, 1))
    crown.visual = trimesh.visual.TextureVisuals(uv=corners, material=leaf)
    bark = trunk()
    bark.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name="bark"))
    trimesh.Scene({"leaf": crown, "bark": bark}).export(str(tree))
    assert tree.stat().st_size > 4_000_000
    return tree


def picture(path: Path) -> tuple[int, tuple[int, int]]:
    """The bytes and the size of the picture of a GLB."""
    tree, views = split_glb(path.read_bytes())
    (image,) = tree["images"]
    data = views[image["bufferView"]]
    return len(data), Image.open(io.BytesIO(data)).size


def test_pictures_leave_half_of_a_size_to_triangles(pictured: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = thin_tree(pictured, tmp_path / "thin.glb", ThinConfig(bytes="300k", profile="three"))
    size, sides = picture(out)
    assert 285_000 <= out.stat().st_size <= 300_000 and size <= 150_000 and sides == (128, 128)
    assert "pictures have at most 128 texels a side" in caplog.text
    caplog.clear()
    out = thin_tree(pictured, tmp_path / "fine.glb", ThinConfig(bytes="400k", texture_size=256))
    assert 380_000 <= out.stat().st_size <= 400_000 and picture(out)[1] == (256, 256) and not caplog.text
    out = thin_tree(pictured, tmp_path / "whole.glb", ThinConfig(triangles=500))
    assert picture(out)[1] == (1024, 1024)
    with pytest.raises(InputError, match="allow more, or a smaller texture_size"):
        thin_tree(pictured, tmp_path / "none.glb", ThinConfig(bytes="100k", texture_size=512))


@pytest.mark.parametrize(
    ("config", "out", "message"),
    [
        (lambda: ThinConfig(), "a.glb", "thin: a limit is missing"),
        (lambda: ThinConfig(bytes="2G"), "a.glb", "bytes: '2G' is no number"),
        (lambda: ThinConfig(bytes=0), "a.glb", "bytes: expected at least 1"),
        (lambda: ThinConfig(triangles=5), "a.obj", "a.obj ends in .obj"),
        (lambda: ThinConfig(triangles=5), "none/a.glb", "out's folder"),
        (lambda: ThinConfig(bytes=900), "a.glb", "bytes: 900 are too few for .*tree.glb, which has at least"),
    ],
)
def test_bad_limits(config: Callable[[], ThinConfig], out: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        thin_tree(TREE, tmp_path / out, config())
    assert not (tmp_path / out).exists()


def test_the_tree_and_files_of_others_are_not_replaced(tmp_path: Path) -> None:
    tree, other = tmp_path / "tree.glb", tmp_path / "other.glb"
    for file in (tree, other):
        file.write_bytes(TREE.read_bytes())
        assert main(["thin", str(tree), "--out", str(file), "--triangles", "500"]) == 2
        assert file.read_bytes() == TREE.read_bytes()
    with pytest.raises(InputError, match="is the tree itself"):
        thin_tree(tree, tree, ThinConfig(triangles=500))
