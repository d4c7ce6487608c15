"""Trees of any format as one GLB: where things are, what they look like, how many triangles are left, what is refused.

``test_thinning.py`` has more about trees that are thinned out.
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from khronos import WARNING, messages
from PIL import Image
from trimesh.visual.material import PBRMaterial

from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.processes import BlenderError
from bbfit.checks import InputError, InputTypeError, MissingFileError
from bbfit.glb import split_glb

from .conftest import box, load, parts, run_in_blender, thing

CARDS, RINGS = 400, 8000


def corners(mesh: trimesh.Trimesh) -> np.ndarray:
    """The corners of all triangles in an order that does not depend on that of the file, [3 T, 3]."""
    points = np.asarray(mesh.triangles).reshape(-1, 3)
    return points[np.lexsort(points.round(3).T)]


def complaints(*files: Path) -> set[str]:
    """Codes of what the Khronos validator calls errors and warnings."""
    return {message["code"] for message in messages(*files) if message["severity"] <= WARNING}


def leaf_picture() -> Image.Image:
    """A green disc with noise in it, of alpha 255, 100 and 0."""
    y, x = np.mgrid[:32, :32] - 15.5
    radius = np.hypot(x, y)
    pixels = np.random.default_rng(0).integers(0, 255, (32, 32, 4), np.uint8)
    pixels[..., 3] = np.select([radius < 10, radius < 14], [255, 100], 0)
    return Image.fromarray(pixels)


@pytest.fixture(scope="module")
def leafy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trunk with far too many triangles and a crown of textured cards, two meshes in a .glb."""
    random = np.random.default_rng(1)
    middles = random.normal(size=(CARDS, 3))
    middles = np.array([0.3, 3, 0]) + 1.5 * middles / np.linalg.norm(middles, axis=-1, keepdims=True)
    across, down = (0.1 * np.linalg.qr(random.normal(size=(CARDS, 3, 3)))[0][:, :2]).transpose(1, 0, 2)
    vertices = np.stack([middles - across - down, middles + across - down, middles + across + down, middles - across + down], 1)
    faces = (4 * np.arange(CARDS)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    leaves = trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)
    leaf = PBRMaterial(
        name="leaf",
        baseColorTexture=leaf_picture(),
        alphaMode="MASK",
        alphaCutoff=0.25,
        doubleSided=True,
        metallicFactor=0,
        roughnessFactor=1,
    )
    leaves.visual = trimesh.visual.TextureVisuals(np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (CARDS, 1)), material=leaf)
    bark = trimesh.creation.cylinder(0.2, segment=[[0, 0, 0], [0.3, 3, 0]], sections=RINGS // 4)
    bark.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name="bark", baseColorFactor=[120, 80, 50, 255]))
    path = tmp_path_factory.mktemp("leafy") / "leafy.glb"
    trimesh.Scene({"bark": bark, "leaves": leaves}).export(str(path))
    return path


@pytest.fixture(scope="module")
def whole(leafy: Path) -> Path:
    """``leafy`` converted, undecimated."""
    return tree_as_glb(leafy, leafy.with_name("whole.glb"))


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".obj", ".ply", ".fbx", ".usdz", ".blend"])
def test_everything_stays_where_and_how_large_it_is(things: Path, tmp_path: Path, ending: str) -> None:
    """Z-up formats are turned; the .blend's hidden sphere of 20 m, its sun and its second scene are not written."""
    out = tree_as_glb(things / f"thing{ending}", tmp_path / "thing.glb")
    expected = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces) for part in thing()])
    got = load(out)
    assert len(got.faces) == len(expected.faces) == 36
    np.testing.assert_allclose(corners(got), corners(expected), rtol=0, atol=1e-6)  # measured 5e-8, float32's rounding
    assert got.volume == pytest.approx(expected.volume, rel=1e-5)  # positive: faces look outwards
    tree, _ = split_glb(out.read_bytes())
    assert not {"cameras", "animations", "skins", "extensionsRequired"} & tree.keys() and len(tree["scenes"]) == 1
    assert all("uri" not in entry for entry in tree["buffers"])
    assert complaints(out) == set()


def test_colors_of_materials_are_kept(thing_glb: Path, tmp_path: Path) -> None:
    tree, _ = parts(tree_as_glb(thing_glb, tmp_path / "thing.glb"))
    factors = sorted(material["pbrMetallicRoughness"]["baseColorFactor"] for material in tree["materials"])
    expected = sorted([*(np.array(part.visual.material.baseColorFactor) / 255)] for part in thing())
    np.testing.assert_allclose(factors, expected, atol=1e-6)


def test_vertex_colors_take_the_place_of_materials(things: Path, tmp_path: Path) -> None:
    tree, contents = split_glb(tree_as_glb(things / "thing.ply", tmp_path / "thing.glb").read_bytes())
    (material,) = tree["materials"]
    assert material["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1, 1]) == [1, 1, 1, 1]
    assert material["pbrMetallicRoughness"].get("roughnessFactor", 1) == 1 and material["pbrMetallicRoughness"]["metallicFactor"] == 0
    (primitive,) = tree["meshes"][0]["primitives"]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert accessor["componentType"] == 5126
    colors = np.frombuffer(contents[accessor["bufferView"]], "<f4").reshape(accessor["count"], -1)
    expected = np.array([part.visual.material.baseColorFactor for part in thing()])[:, :3] / 255
    errors = np.abs(colors[:, None, :3] - expected).max(-1).min(1)
    assert errors.max() < 0.003  # measured 0.0008: the PLY has 8 bits of sRGB


def test_without_materials_and_colors_a_tree_is_matt_gray(things: Path, tmp_path: Path) -> None:
    tree, _ = parts(tree_as_glb(things / "thing.stl", tmp_path / "thing.glb"))
    (material,) = tree["materials"]
    np.testing.assert_allclose(material["pbrMetallicRoughness"]["baseColorFactor"], [0.5, 0.5, 0.5, 1])
    assert material["pbrMetallicRoughness"].get("roughnessFactor", 1) == 1 and material["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_a_texture_with_alpha_and_its_coordinates_survive(leafy: Path, whole: Path) -> None:
    tree, found = parts(whole)
    leaf = next(material for material in tree["materials"] if material["name"] == "leaf")
    assert leaf["alphaMode"] == "MASK" and leaf["doubleSided"]
    assert leaf["alphaCutoff"] == pytest.approx(0.25)
    (image,) = tree["images"]
    contents = split_glb(whole.read_bytes())[1]
    shown = np.asarray(Image.open(io.BytesIO(contents[image["bufferView"]])))
    np.testing.assert_array_equal(shown, np.asarray(leaf_picture()))
    original = parts(leafy)[1]["leaf"]

    def table(mesh: trimesh.Trimesh) -> np.ndarray:
        rows = np.concatenate([mesh.vertices, mesh.visual.uv], -1)[mesh.faces.ravel()]
        return rows[np.lexsort(rows.round(3).T)]

    np.testing.assert_allclose(table(found["leaf"]), table(original), rtol=0, atol=1e-6)  # measured 0


def test_the_number_of_triangles_is_kept_and_the_leaves_keep_their_area(leafy: Path, whole: Path, tmp_path: Path) -> None:
    """A straight trunk of 8,000 triangles can spare nearly all before a leaf changes; 400 leaves of 800 cannot all stay among 500."""
    before = parts(whole)[1]
    total = len(load(whole).faces)
    for wanted in (total // 4, 500):
        out = tree_as_glb(leafy, tmp_path / f"{wanted}.glb", triangles=wanted)
        tree, found = parts(out)
        got = sum(len(mesh.faces) for mesh in found.values())
        assert 0.98 * wanted <= got <= wanted  # measured 1 both times; an edge takes two triangles with it
        assert {material["name"] for material in tree["materials"]} == {"bark", "leaf"}
        assert found["leaf"].area == pytest.approx(before["leaf"].area, rel=1e-4)
        assert found["bark"].area == pytest.approx(before["bark"].area, rel=0.1)  # measured 0.02
        np.testing.assert_allclose(found["leaf"].bounds, before["leaf"].bounds, atol=0.15)  # measured 0.04; a leaf's diagonal is 0.28
        assert complaints(out) == set()
        if wanted > 2 * CARDS:
            assert len(found["leaf"].faces) == 2 * CARDS


SLOTS = """
import bpy, os, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=1)
first = bpy.context.object
painted = {name: bpy.data.materials.new(name) for name in ("red", "green", "blue")}
for name in ("red", "green"):
    first.data.materials.append(painted[name])
first.data.polygons[0].material_index = 1
second = bpy.data.objects.new("second", first.data)
bpy.context.scene.collection.objects.link(second)
for index, item in enumerate((first, second)):
    item.material_slots[index].link = "OBJECT"
    item.material_slots[index].material = painted["blue"]
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush()
os._exit(0)
"""


def test_objects_of_one_mesh_keep_materials_of_their_own_in_different_slots(tmp_path: Path) -> None:
    run_in_blender(SLOTS, str(tmp_path / "slots.blend"))
    tree, _ = split_glb(tree_as_glb(tmp_path / "slots.blend", tmp_path / "out.glb").read_bytes())
    shown = {
        node["name"]: {tree["materials"][primitive["material"]]["name"] for primitive in tree["meshes"][node["mesh"]]["primitives"]}
        for node in tree["nodes"]
    }
    assert shown == {"Cube": {"blue", "green"}, "second": {"red", "blue"}}


def test_normals_stay_and_split_no_vertices(tmp_path: Path) -> None:
    """Flat leaves of three triangles: Blender keeps their normals face by face, each rounded in its own way."""
    random = np.random.default_rng(2)
    angles = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    pentagon = 0.1 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    turns = np.linalg.qr(random.normal(size=(60, 3, 3)))[0]
    turns[:, :, 2] *= np.linalg.det(turns)[:, None]
    vertices = pentagon @ turns.transpose(0, 2, 1) + random.normal(size=(60, 1, 3))
    normals = np.repeat(turns @ [0.0, 0.0, 1.0], 5, 0)
    faces = (5 * np.arange(60)[:, None, None] + [[0, 1, 2], [0, 2, 3], [0, 3, 4]]).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices.reshape(-1, 3), faces, vertex_normals=normals, process=False)
    trimesh.Scene(mesh).export(str(tmp_path / "leaves.glb"), include_normals=True)
    (got,) = trimesh.load(tree_as_glb(tmp_path / "leaves.glb", tmp_path / "out.glb"), process=False).geometry.values()
    assert len(got.vertices) == len(mesh.vertices)
    np.testing.assert_allclose(got.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(got.vertex_normals, normals, atol=1e-3)  # measured 1.5e-4: 16 bits an angle, then four digits


def test_more_triangles_than_there_are_change_nothing_and_the_bytes_are_always_the_same(leafy: Path, whole: Path, tmp_path: Path) -> None:
    total = len(load(whole).faces)
    assert tree_as_glb(leafy, tmp_path / "all.glb", triangles=total).read_bytes() == whole.read_bytes()
    first, second = (tree_as_glb(leafy, tmp_path / f"{name}.glb", triangles=700).read_bytes() for name in "ab")
    assert first == second != whole.read_bytes()


INSTANCES = """
import bpy, os, sys
from mathutils import Matrix
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0))
cube = bpy.context.object
def another(name, matrix):
    made = bpy.data.objects.new(name, cube.data)
    bpy.context.scene.collection.objects.link(made)
    made.matrix_world = matrix
    return made
def painted(name):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    return made
cube.data.materials.append(painted("gray"))
other = another("red", Matrix.Translation((0, 0, 9)))
other.material_slots[0].link = "OBJECT"
other.material_slots[0].material = painted("red")
another("moved", Matrix.Translation((3, 0, 1)))
another("mirrored", Matrix.Translation((0, 4, 0)) @ Matrix.Diagonal((-1, 2, 1, 1)))
parent = bpy.data.objects.new("parent", None)
bpy.context.scene.collection.objects.link(parent)
parent.scale = (1, 1, 3)
child = another("sheared", Matrix())
child.parent = parent
child.rotation_euler, child.location = (0.6, 0, 0), (0, -5, 0)
lifted = another("modified", Matrix.Translation((6, 0, 0)))
lifted.data = cube.data.copy()
lifted.modifiers.new("more", "ARRAY").count = 2
curve = bpy.data.curves.new("curve", "CURVE")
curve.dimensions, curve.bevel_depth = "3D", 0.1
curve.splines.new("POLY").points.add(1)
curve.splines[0].points[0].co, curve.splines[0].points[1].co = (9, 0, 0, 1), (9, 0, 2, 1)
bpy.context.scene.collection.objects.link(bpy.data.objects.new("curve", curve))
bpy.ops.object.camera_add()
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush()
os._exit(0)
"""


def test_instances_are_shared_and_modifiers_curves_mirrors_and_shears_applied(tmp_path: Path) -> None:
    run_in_blender(INSTANCES, str(tmp_path / "instances.blend"))
    out = tree_as_glb(tmp_path / "instances.blend", tmp_path / "out.glb")
    tree, _ = split_glb(out.read_bytes())
    nodes = {node["name"]: node for node in tree["nodes"]}
    assert set(nodes) == {"Cube", "red", "moved", "mirrored", "sheared", "modified", "curve"}
    assert nodes["Cube"]["mesh"] == nodes["moved"]["mesh"] == nodes["mirrored"]["mesh"] != nodes["sheared"]["mesh"]
    red, gray = (tree["meshes"][nodes[name]["mesh"]]["primitives"][0]["material"] for name in ("red", "Cube"))
    assert (tree["materials"][red]["name"], tree["materials"][gray]["name"]) == ("red", "gray")
    scene = trimesh.load(out, process=False)
    bounds = {}
    for name in nodes:
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry].copy()
        mesh.apply_transform(matrix)  # turns the faces of what it mirrors
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
        bounds[name] = mesh.bounds.tolist()
        if name != "curve":  # which is open at its ends
            assert mesh.volume == pytest.approx({"mirrored": 2, "sheared": 3, "modified": 2}.get(name, 1), rel=1e-5)
    turned = 0.5 * (np.cos(0.6) + np.sin(0.6))
    expected = {  # Y up: Blender's (x, y, z) is (x, z, -y)
        "Cube": [[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]],
        "red": [[-0.5, 8.5, -0.5], [0.5, 9.5, 0.5]],
        "moved": [[2.5, 0.5, -0.5], [3.5, 1.5, 0.5]],
        "mirrored": [[-0.5, -0.5, -5], [0.5, 0.5, -3]],
        "sheared": [[-0.5, -3 * turned, 5 - turned], [0.5, 3 * turned, 5 + turned]],
        "modified": [[5.5, -0.5, -0.5], [7.5, 0.5, 0.5]],
        "curve": [[8.9, 0, -0.1], [9.1, 2, 0.1]],
    }
    for name, box_ in expected.items():
        np.testing.assert_allclose(bounds[name], box_, atol=1e-5)
    assert complaints(out) == set()
    few = load(tree_as_glb(tmp_path / "instances.blend", tmp_path / "few.glb", triangles=100))
    np.testing.assert_allclose(few.bounds, load(out).bounds, atol=0.01)
    assert len(few.faces) <= 100 < len(load(out).faces)
    assert few.volume == pytest.approx(load(out).volume, abs=0.1)  # joined, mirrored ones look outwards as well


def test_what_cannot_be_used_is_refused_and_leaves_the_earlier_file(thing_glb: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.glb"
    out.write_bytes(b"earlier")
    for value, said in ((0, "triangles: expected at least 1, got 0"), (-5, "triangles: expected at least 1")):
        with pytest.raises(InputError, match=said):
            tree_as_glb(thing_glb, out, triangles=value)
    for odd in (2.5, True, "10"):
        with pytest.raises(InputTypeError, match="triangles: expected a whole number"):
            tree_as_glb(thing_glb, out, triangles=odd)  # type: ignore[arg-type]
    with pytest.raises(MissingFileError, match=r"none\.glb does not exist"):
        tree_as_glb(tmp_path / "none.glb", out)
    (tmp_path / "garbage.ply").write_bytes(b"this is no tree\n" * 20)
    with pytest.raises(InputError, match=r"garbage\.ply (cannot be read as|has no faces)"):
        tree_as_glb(tmp_path / "garbage.ply", out)
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(InputError, match="has no faces to render"):
        tree_as_glb(tmp_path / "points.obj", out)
    assert out.read_bytes() == b"earlier"
    assert {path.name for path in tmp_path.iterdir()} == {"out.glb", "garbage.ply", "points.obj"}


def test_bad_places_for_the_file_are_refused(thing_glb: Path, tmp_path: Path) -> None:
    copy = tmp_path / "tree.glb"
    shutil.copy(thing_glb, copy)
    (tmp_path / "folder.glb").mkdir()
    for out, said in (
        ("out.gltf", r"out: .*out\.gltf ends in \.gltf; choose a name that ends in \.glb"),
        ("out", "ends in nothing"),
        ("none/out.glb", "out's folder: .*none does not exist"),
        ("folder.glb", "is a folder"),
        ("tree.glb", "is the tree itself"),
    ):
        with pytest.raises(InputError, match=said):
            tree_as_glb(copy, tmp_path / out)
    assert copy.read_bytes() == thing_glb.read_bytes()


@pytest.mark.usefixtures("broken_blender")
def test_a_crash_is_told(thing_glb: Path, tmp_path: Path) -> None:
    with pytest.raises(BlenderError, match=r"crashed while converting .*thing\.glb \(signal 6; its last output: out of luck\)"):
        tree_as_glb(thing_glb, tmp_path / "out.glb")
    assert not (tmp_path / "out.glb").exists()


def test_without_blender(thing_glb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bpy", None)  # by which Python says that a module cannot be imported
    with pytest.raises(InputError, match="bpy is not installed"):
        tree_as_glb(thing_glb, tmp_path / "out.glb")


def test_a_material_of_long_parts_is_no_foliage(tmp_path: Path) -> None:
    """Posts that lose area are not enlarged, though they are many: they would come off the ground."""
    posts = [box((x, 0.0, 0.0), (x + 0.1, 2.0, 0.1), (100, 80, 60)).subdivide().subdivide() for x in np.arange(0.0, 3.0, 0.5)]
    for index, post in enumerate(posts):
        post.visual = thing()[0].visual
        posts[index] = post
    trimesh.Scene(posts).export(str(tmp_path / "posts.glb"))
    few = load(tree_as_glb(tmp_path / "posts.glb", tmp_path / "few.glb", triangles=30))
    assert len(few.faces) <= 30
    assert few.area < 0.9 * sum(post.area for post in posts)  # measured 0.58
    assert few.bounds[0, 1] > -0.001 and few.bounds[1, 1] < 2.001
