"""The files of a forest, by other programs and by what their specifications require."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from billboard_scene import crossing_billboards
from khronos import messages
from numpy.typing import NDArray
from small_library import small_library

from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export
from bbfit.forest import tileset, usd_stage
from bbfit.forest.building import Forest, build_forest, read_forest
from bbfit.forest.config import ForestConfig, RegisterConfig, ScatterConfig
from bbfit.forest.gathering import _Extent
from bbfit.forest.placements import Placements, matrices, quaternions
from bbfit.forest.registers import ROW
from bbfit.forest.tiles import ForestTile, leaves
from bbfit.glb import gltf_parts, joined_glb, split_glb
from bbfit.inputs import InputLimits
from bbfit.library.manifest import read_library

SCATTER = ScatterConfig(scatter=(220, 160), spacing=7, mix=("oak=2", "birch=1"))
CONFIG = ForestConfig(formats=("glb", "tiles", "usd"), tile_trees=100, tile_triangles=300, origin=(13.4, 52.5))
# What the validator remarks on files that use extensions which it does not know.
REMARKS = {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT", "URI_GLB"}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("library")
    small_library(folder)
    return folder


@pytest.fixture(scope="module")
def forest(library: Path, tmp_path_factory: pytest.TempPathFactory) -> Forest:
    return build_forest(SCATTER, library, tmp_path_factory.mktemp("forest"), CONFIG)


def every(forest: Forest) -> Placements:
    """All trees of a forest in the order of their rows."""
    parts = [forest.read(tile.name) for tile in leaves(forest.root)]
    rows = np.concatenate([part.rows for part in parts if part.rows is not None])
    order = np.argsort(rows)
    joined = (np.concatenate([getattr(part, name) for part in parts])[order] for name in ("positions", "turns", "scales", "trees"))
    return Placements(*joined, rows=rows[order])


def tiles_of(tile: ForestTile) -> Iterator[ForestTile]:
    yield tile
    for child in tile.children:
        yield from tiles_of(child)


def test_leaves_have_every_tree_once_and_parents_a_part(forest: Forest) -> None:
    trees = every(forest)
    assert trees.rows is not None and trees.rows.tolist() == list(range(1, len(forest) + 1))
    assert len(forest) > 300 and forest.species[0].count + forest.species[1].count == len(forest)
    for tile in tiles_of(forest.root):
        placements = forest.read(tile.name)
        assert len(placements) == min(tile.count, 100)
        assert tile.count == sum(child.count for child in tile.children) or not tile.children
        places = placements.positions
        assert (places >= tile.low).all() and (places <= tile.high).all()
        heights = np.array([12.0, 8.0, 20.0])[placements.trees] * placements.scales
        assert tile.high[1] >= heights.max() - 1e-4 and (tile.children or tile.high[1] == pytest.approx(heights.max()))
    assert read_forest(forest.folder) == forest


def test_the_same_register_gives_the_same_files(forest: Forest, library: Path, tmp_path: Path) -> None:
    again = build_forest(SCATTER, library, tmp_path / "again", CONFIG)
    names = sorted(path.relative_to(forest.folder) for path in forest.folder.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(again.folder) for path in again.folder.rglob("*") if path.is_file())
    for name in names:
        if name.name not in ("run.json", ".bbfit.json"):
            assert (forest.folder / name).read_bytes() == (again.folder / name).read_bytes(), name


@pytest.mark.node
def test_khronos_validator_finds_no_errors(forest: Forest) -> None:
    found = messages(forest.folder / "forest.glb", *sorted((forest.folder / "tiles").glob("*.glb")))
    assert not [message for message in found if message["code"] not in REMARKS]


@pytest.mark.node
def test_the_validator_of_3d_tiles_finds_no_errors(forest: Forest, tmp_path: Path) -> None:
    """Where it is installed. The registry of npm did not have the package 3d-tiles-validator in November 2026; its source is on GitHub."""
    package = Path(__file__).parents[1] / "node" / "node_modules" / "3d-tiles-validator"
    if not (package / "package.json").is_file():
        pytest.skip("3d-tiles-validator is not installed: npm answers 404 for it")
    program = package / json.loads((package / "package.json").read_text())["bin"]["3d-tiles-validator"]
    report = tmp_path / "report.json"
    command = ["node", str(program), "--tilesetFile", str(forest.folder / "tiles" / "tileset.json"), "--reportFile", str(report)]
    subprocess.run(command, check=True, capture_output=True)
    found = json.loads(report.read_text())
    assert found["numErrors"] == 0 and found["numWarnings"] == 0, found


def accessor(tree: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float32]:
    item = tree["accessors"][index]
    view = tree["bufferViews"][item["bufferView"]]
    assert view["buffer"] == 0 and item["componentType"] == 5126
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[item["type"]]
    return np.frombuffer(binary, "<f4", width * item["count"], view["byteOffset"]).reshape(-1, width)


def instance_matrices(path: Path) -> tuple[dict[str, Any], bytes, NDArray[np.float64]]:
    """The matrices of all instances of a GLB of which each tree has one mesh, sorted, [P, 16]."""
    tree, binary = gltf_parts(path.read_bytes())
    root = np.reshape(tree["nodes"][0].get("matrix", np.eye(4)), (4, 4)).T
    found = []
    for node in (tree["nodes"][child] for child in tree["nodes"][0]["children"]):
        attributes = node["extensions"]["EXT_mesh_gpu_instancing"]["attributes"]
        places, turns, sizes = (accessor(tree, binary, attributes[name]) for name in ("TRANSLATION", "ROTATION", "SCALE"))
        np.testing.assert_allclose(np.linalg.norm(turns, axis=-1), 1, atol=1e-6)
        cos, sin = 1 - 2 * turns[:, 1] ** 2, 2 * turns[:, 1] * turns[:, 3]
        each = np.zeros((len(places), 4, 4))
        each[:, 0, 0], each[:, 0, 2], each[:, 2, 0], each[:, 2, 2], each[:, 1, 1] = cos, sin, -sin, cos, 1
        each[:, :3, :3] *= sizes[:, None]
        each[:, :3, 3], each[:, 3, 3] = places, 1
        found.append(root @ each)
    return tree, binary, np.concatenate(found).transpose(0, 2, 1).reshape(-1, 16)


def sorted_rows(values: NDArray[Any]) -> NDArray[Any]:
    return values[np.lexsort(np.round(values[:, 12:15], 2).T)]


def test_the_glb_has_an_instance_for_each_placement(forest: Forest) -> None:
    tree, _, found = instance_matrices(forest.folder / "forest.glb")
    np.testing.assert_allclose(sorted_rows(found), sorted_rows(matrices(every(forest))), atol=1e-4)
    assert not [item for kind in ("buffers", "images") for item in tree[kind] if "uri" in item]
    assert len(tree["images"]) == 1 and tree["extensionsRequired"] == ["EXT_mesh_gpu_instancing"]


def all_tiles(tile: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield tile
    for child in tile.get("children", []):
        yield from all_tiles(child)


def box(tile: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    values = np.array(tile["boundingVolume"]["box"])
    half = values[3:].reshape(3, 3).sum(0)
    assert len(values) == 12 and (half > 0).all()
    return values[:3] - half, values[:3] + half


def test_the_tileset_is_what_the_specification_requires(forest: Forest) -> None:
    folder = forest.folder / "tiles"
    content = json.loads((folder / "tileset.json").read_text())
    assert content["asset"]["version"] == "1.1" and content["geometricError"] >= content["root"]["geometricError"]
    assert len(content["root"]["transform"]) == 16
    used = set()
    for tile in all_tiles(content["root"]):
        assert tile["refine"] == "REPLACE" and tile["geometricError"] >= 0
        assert bool(tile.get("children")) == (tile["geometricError"] > 0)
        used.add(tile["content"]["uri"])
        low, high = box(tile)
        for child in tile.get("children", []):
            assert child["geometricError"] < tile["geometricError"]
            inner_low, inner_high = box(child)
            assert (inner_low >= low - 1e-6).all() and (inner_high <= high + 1e-6).all()
    assert used == {path.name for path in folder.glob("*.glb")}
    assert len(used) > 20


def test_each_level_of_the_tiles_has_every_tree_once_inside_its_box(forest: Forest, library: Path) -> None:
    content = json.loads((forest.folder / "tiles" / "tileset.json").read_text())
    levels = read_library(library).trees[0].levels
    corners = np.array([[x, y, z, 1] for x in (-2.4, 2.4) for y in (0.0, 12.0) for z in (-2.4, 2.4)])
    rows: dict[int, list[int]] = {0: [], 1: [], 2: []}
    schema = json.loads((forest.folder / "tiles" / "schema.json").read_text())
    species = [value["name"] for value in schema["enums"]["species"]["values"]]
    for tile in all_tiles(content["root"]):
        path = forest.folder / "tiles" / tile["content"]["uri"]
        tree, binary, found = instance_matrices(path)
        table = tree["extensions"]["EXT_structural_metadata"]["propertyTables"][0]
        assert table["count"] == len(found) and tree["extensions"]["EXT_structural_metadata"]["schemaUri"] == "schema.json"
        columns = {
            name: np.frombuffer(binary, kind, len(found), tree["bufferViews"][table["properties"][name]["values"]]["byteOffset"])
            for name, kind in (("height", "<f4"), ("row", "<u4"), ("species", "<u2"))
        }
        for index, child in enumerate(tree["nodes"][0]["children"]):
            node = tree["nodes"][child]["extensions"]
            identifiers = accessor(tree, binary, node["EXT_mesh_gpu_instancing"]["attributes"]["_FEATURE_ID_0"])[:, 0].astype(int)
            assert node["EXT_instance_features"]["featureIds"] == [{"featureCount": len(identifiers), "attribute": 0, "propertyTable": 0}]
            name = {0: "oak", 1: "birch", 2: "fir"}[int(tree["nodes"][child]["name"].split("_")[1])]
            assert {species[number] for number in columns["species"][identifiers]} == {name}
            assert index or identifiers[0] == 0
        heights = np.linalg.norm(found.reshape(-1, 4, 4)[:, 1, :3], axis=-1)
        np.testing.assert_allclose(columns["height"], heights * np.where(columns["species"] == 0, 12, 8), rtol=1e-5)
        points = np.einsum("pij,ci->pcj", found.reshape(-1, 4, 4), corners)[..., :3] * 0.66 + found.reshape(-1, 4, 4)[:, None, 3, :3] * 0.34
        low, high = box(tile)
        turned = points[..., [0, 2, 1]] * [1, -1, 1]
        assert (turned >= low - 1e-3).all() and (turned[..., :2] <= high[:2] + 1e-3).all()
        if "_" in path.stem:
            rows[int(path.stem[-1])] += columns["row"].tolist()
    for step, numbers in rows.items():
        assert sorted(numbers) == list(range(1, len(forest) + 1)), step
    assert len(levels) == 3


def test_tiles_with_many_triangles_are_smaller(forest: Forest) -> None:
    for path in (forest.folder / "tiles").glob("*_[12].glb"):
        triangles = {"1": 6, "2": 8}[path.stem[-1]]
        assert triangles * len(instance_matrices(path)[2]) <= 300, path


def test_usd_has_an_instance_for_each_placement_and_opens_without_complaints(forest: Forest) -> None:
    usd, geom, validation = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdValidation"))
    stage = usd.Stage.Open(str(forest.folder / "usd" / "forest.usda"))
    assert geom.GetStageUpAxis(stage) == "Y" and geom.GetStageMetersPerUnit(stage) == 1
    found, rows = [], []
    for prim in stage.Traverse():
        if prim.IsA(geom.PointInstancer):
            instancer = geom.PointInstancer(prim)
            place = np.array(geom.Xformable(prim).ComputeLocalToWorldTransform(usd.TimeCode.Default()))
            each = instancer.ComputeInstanceTransformsAtTime(usd.TimeCode.Default(), usd.TimeCode.Default())
            found += [np.array(matrix) @ place for matrix in each]
            rows += list(instancer.GetIdsAttr().Get())
    order = np.argsort(rows)
    np.testing.assert_allclose(np.reshape(found, (-1, 16))[order], matrices(every(forest)), atol=2e-3)
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert not [error.GetMessage() for error in context.Validate(stage)]


def test_usd_trees_have_their_levels_and_sizes(forest: Forest) -> None:
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    stage = usd.Stage.Open(str(forest.folder / "usd" / "trees" / "tree_0.usdc"))
    variants = stage.GetDefaultPrim().GetVariantSet("lod")
    assert variants.GetVariantNames() == ["lod0", "lod1", "lod2"]
    for name, planes in (("lod0", 4), ("lod1", 3), ("lod2", 2)):
        variants.SetVariantSelection(name)
        mesh = next(geom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(geom.Mesh))
        points, uvs = np.array(mesh.GetPointsAttr().Get()), np.array(geom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
        assert len(points) == 4 * planes and points[:, 1].max() == 12 and points[:, 1].min() == 0
        np.testing.assert_array_equal(uvs[:, 1], points[:, 1] / 12)  # the picture's top is at the tree's
        assert len(mesh.GetFaceVertexCountsAttr().Get()) == 2 * planes


@pytest.mark.parametrize(
    ("sampler", "wraps"),
    [(b'{"wrapS":33071,"wrapT":33648}', ("clamp", "mirror")), (b"{}", ("repeat", "repeat"))],
)
def test_usd_textures_wrap_as_those_of_gltf(sampler: bytes, wraps: tuple[str, str], tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")

    def change(folder: Path) -> None:
        for path in (folder / "trees").glob("*.glb"):
            content, views = split_glb(path.read_bytes())
            content["samplers"] = [json.loads(sampler)]
            content["textures"][0]["sampler"] = 0
            path.write_bytes(joined_glb(content, views))

    library = damaged(tmp_path / "library", change)
    build_forest(register(tmp_path), library, tmp_path / "out", ForestConfig(formats=("usd",)))
    stage = usd.Stage.Open(str(tmp_path / "out" / "usd" / "trees" / "tree_0.usdc"))
    textures = [prim for prim in stage.Traverse() if prim.GetAttribute("info:id").Get() == "UsdUVTexture"]
    assert textures
    for prim in textures:
        assert tuple(prim.GetAttribute(f"inputs:{side}").Get() for side in ("wrapS", "wrapT")) == wraps


def test_usd_trees_look_as_those_of_gltf(tmp_path: Path) -> None:
    """Of one whose picture is scaled, turned and moved, and which is mirrored, and one with colors of vertices."""
    usd, geom, shade = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdShade"))
    colors = np.random.default_rng(0).uniform(size=(16, 3)).astype("<f4")

    def change(folder: Path) -> None:
        path = folder / "trees" / "oak_LOD0.glb"
        content, views = split_glb(path.read_bytes())
        place = {"scale": [2, 3], "rotation": np.pi / 2, "offset": [0.25, 0.5], "texCoord": 0}
        picture = content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        picture |= {"texCoord": 7, "extensions": {"KHR_texture_transform": place}}
        content["nodes"][0]["scale"] = [-1, 1, 1]
        path.write_bytes(joined_glb(content, views))
        path = folder / "trees" / "oak_LOD1.glb"
        content, views = split_glb(path.read_bytes())
        content["materials"][0] = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1, 1, 1]}}
        content["bufferViews"].append({})
        content["accessors"].append({"bufferView": len(views), "componentType": 5126, "type": "VEC3", "count": 12})
        content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = len(content["accessors"]) - 1
        path.write_bytes(joined_glb(content, [*views, colors[:12].tobytes()]))

    library = damaged(tmp_path / "library", change)
    build_forest(register(tmp_path), library, tmp_path / "out", ForestConfig(formats=("usd",)))
    stage = usd.Stage.Open(str(tmp_path / "out" / "usd" / "trees" / "tree_0.usdc"))
    variants = stage.GetDefaultPrim().GetVariantSet("lod")

    def the(kind: Any) -> Any:
        return next(kind(prim) for prim in stage.Traverse() if prim.IsA(kind))

    mesh = the(geom.Mesh)
    points, uvs = np.array(mesh.GetPointsAttr().Get()), np.array(geom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    assert mesh.GetOrientationAttr().Get() == "leftHanded"
    # The corners' coordinates are u along the plane and v = 1 - height / 12 from the top; a quarter turn takes (u, v) to (v, -u).
    np.testing.assert_allclose(uvs[:, 0], 3 * (1 - points[:, 1] / 12) + 0.25, atol=1e-6)
    np.testing.assert_allclose(sorted(set(np.round(1 - uvs[:, 1], 5))), [0.5 - 2 / 3, 0.5], atol=1e-4)
    variants.SetVariantSelection("lod1")
    mesh = the(geom.Mesh)
    np.testing.assert_allclose(np.array(mesh.GetDisplayColorAttr().Get()), colors[:12] * [0.5, 1, 1], atol=1e-6)
    surface = the(shade.Material).ComputeSurfaceSource()[0]
    (source,) = surface.GetInput("diffuseColor").GetConnectedSources()[0]
    assert source.source.GetPrim().GetAttribute("inputs:varname").Get() == "displayColor"
    assert mesh.GetOrientationAttr().Get() == "rightHanded"


@pytest.mark.node
def test_trees_of_integers_have_the_vertices_of_those_of_floats(tmp_path: Path) -> None:
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    vertices = list[NDArray[np.float64]]()
    for quantized in (True, False):
        folder = tmp_path / str(quantized)
        small_library(library := folder / "library")
        export(crossing_billboards(), library / "trees/oak_LOD0.glb", ExportConfig(quantized=quantized))
        forest = build_forest(register(folder), library, folder / "out", ForestConfig(formats=("glb", "usd"))).folder
        required = split_glb((forest / "forest.glb").read_bytes())[0]["extensionsRequired"]
        assert ("KHR_mesh_quantization" in required) == quantized
        assert not [message for message in messages(forest / "forest.glb") if message["code"] not in REMARKS]
        stage = usd.Stage.Open(str(forest / "usd" / "trees" / "tree_0.usdc"))
        meshes = [geom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(geom.Mesh)]
        sides = [(mesh.GetPointsAttr().Get(), geom.PrimvarsAPI(mesh).GetPrimvar("st").Get()) for mesh in meshes]
        vertices.append(np.concatenate([np.concatenate([np.array(points), np.array(uvs)], -1) for points, uvs in sides]))
    np.testing.assert_allclose(*vertices, atol=1e-4)  # units of 0.05 mm, and corners that move with their textures


def test_an_interrupted_build_continues(library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forest: Forest) -> None:
    """Of tiles and of USD; what was written is not written again, and the result is that of one go."""
    written: list[str] = []

    def stopping(module: Any, name: str, after: int) -> None:
        original = getattr(module, name)
        calls = 0

        def write(path: Path, data: Any) -> None:
            nonlocal calls
            calls += 1
            if calls > after:
                raise KeyboardInterrupt
            written.append(path.name)
            original(path, data)

        monkeypatch.setattr(module, name, write)

    for module, name, after in ((tileset, "write_pieces", 20), (usd_stage, "write_bytes", 2), (usd_stage, "write_bytes", 5)):
        with monkeypatch.context():
            stopping(module, name, after)
            with pytest.raises(KeyboardInterrupt):
                build_forest(SCATTER, library, tmp_path, CONFIG)
            monkeypatch.undo()
    first = list(written)
    stopping(tileset, "write_pieces", 1000)
    stopping(usd_stage, "write_bytes", 1000)
    result = build_forest(SCATTER, library, tmp_path, CONFIG)
    again = [name for name in written[len(first) :] if name in first]
    assert len(again) < 10 and not [name for name in again if re.fullmatch(r"tree_0\.usdc", name)]
    assert result.root == forest.root
    for part in ("tiles", "usd"):
        for path in (forest.folder / part).rglob("*"):
            if path.is_file():
                assert path.read_bytes() == (tmp_path / path.relative_to(forest.folder)).read_bytes()
    assert not list(tmp_path.rglob("journal.jsonl"))
    written.clear()
    build_forest(SCATTER, library, tmp_path, CONFIG)
    assert not written


def test_a_smaller_forest_leaves_no_files_of_the_larger_one(library: Path, tmp_path: Path) -> None:
    config = ForestConfig(formats=("tiles",), tile_trees=20)
    build_forest(ScatterConfig(scatter=(80, 80)), library, tmp_path, config)
    small = build_forest(ScatterConfig(scatter=(20, 20)), library, tmp_path, config)
    assert {path.name for path in (tmp_path / "placements").iterdir()} == {tile.file for tile in tiles_of(small.root)}
    content = json.loads((tmp_path / "tiles" / "tileset.json").read_text())
    assert {tile["content"]["uri"] for tile in all_tiles(content["root"])} == {path.name for path in (tmp_path / "tiles").glob("*.glb")}


def register(folder: Path, text: str = "x,y,species\n1,2,oak\n3,4,birch\n") -> Path:
    path = folder / "trees.csv"
    path.write_text(text)
    return path


def damaged(folder: Path, change: Any) -> Path:
    small_library(folder)
    change(folder)
    return folder


def replaced(old: bytes, new: bytes) -> Callable[[Path], object]:
    """A change of a file."""
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new))


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut short": (lambda path: path.write_bytes(path.read_bytes()[:-60]), "oak_LOD1.glb is cut short"),
    "no GLB": (lambda path: path.write_bytes(b"glTF?"), "oak_LOD1.glb is cut short"),
    "empty": (lambda path: path.write_bytes(b""), "oak_LOD1.glb, which .* lists, is missing or empty"),
    "no mesh": (replaced(b'"nodes":[{"mesh":0}]', b'"nodes":[{        }]'), "oak_LOD1.glb shows no mesh"),
    "outside": (replaced(b"../atlas.png", b"../../as.png"), "outside its own folder"),
    "no picture": (replaced(b"../atlas.png", b"../atlas.pnx"), "atlas.pnx, to which .* missing"),
    "no accessor": (replaced(b'"POSITION":0', b'"POSITION":9'), "oak_LOD1.glb cannot be read"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_library_with_a_damaged_tree_is_refused_before_anything_is_written(damage: str, tmp_path: Path) -> None:
    change, message = DAMAGES[damage]
    library = damaged(tmp_path / "library", lambda folder: change(folder / "trees" / "oak_LOD1.glb"))
    with pytest.raises(InputError, match="^library: .*" + message) as caught:
        build_forest(register(tmp_path), library, tmp_path / "out")
    assert len(str(caught.value).splitlines()) == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "message"), [("usd", "the tree oak .* has no PNG or JPEG"), ("page", "the tree oak .* KTX2 textures alone")]
)
def test_textures_that_a_format_cannot_show_are_refused_before_any_work(name: Any, message: str, tmp_path: Path) -> None:
    without = replaced(b'"source":0', b'"sourcx":0')
    library = damaged(tmp_path / "library", lambda folder: without(folder / "trees" / "oak_LOD1.glb"))
    with pytest.raises(InputError, match=f"^{name}: {message}"):
        build_forest(register(tmp_path), library, tmp_path / "out", ForestConfig(formats=("glb", name)))
    assert not (tmp_path / "out").exists()


def test_every_format_reads_pictures_in_allowed_folders(tmp_path: Path) -> None:
    small_library(tmp_path / "library")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "library" / "atlas.png").rename(tmp_path / "elsewhere" / "atlas.png")
    (tmp_path / "library" / "atlas.png").symlink_to(tmp_path / "elsewhere" / "atlas.png")
    limits, formats = InputLimits(allow_folders=(tmp_path / "elsewhere",)), ("glb", "tiles", "usd", "page")
    forest = build_forest(register(tmp_path), tmp_path / "library", tmp_path / "out", ForestConfig(formats=formats), limits=limits)
    assert (forest.folder / "page" / "index.html").is_file() and (forest.folder / "tiles" / "tileset.json").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2\nx,2\n", "row 3, column x"),
        ("lon,lat\n13,52\n13,-52\n", "row 3 is .* km away from the first tree"),
        ("x,y\n" + "".join(f"13.{row},52.5\n" for row in range(10, 40)), "30 trees on 0.29 by 0 meters; give --coordinates degrees"),
        ("x,y\n0,0\n" + "".join(f"13.{row},52.5\n" for row in range(10, 40)), "31 trees on 0.29 by 0 meters; give --coordinates degrees"),
        ("x,y\n" + "".join(f"{row % 7 / 3.5},{row // 7 / 3.5}\n" for row in range(49)), "49 trees on 1.71 by 1.71 meters"),
        ("x,y\n" + "1,2\n" * 101, "101 trees are at one place, such as that of row 2; .*--tile-trees 101"),
    ],
)
def test_a_bad_register_leaves_nothing_behind(text: str, message: str, library: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="^placements: .*" + message):
        build_forest(register(tmp_path, text), library, tmp_path / "out", ForestConfig(tile_trees=100))
    assert not (tmp_path / "out").exists() or not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("text", "message"), [("x,y\nnan,1\n", "row 2"), ("x,y\n50,60\n" + "1,2\n" * 101, "101 trees are at one place, such as that of row 3")]
)
def test_a_bad_register_leaves_an_earlier_forest_as_it_was(text: str, message: str, library: Path, tmp_path: Path) -> None:
    config = ForestConfig(tile_trees=100)
    build_forest(register(tmp_path), library, tmp_path / "out", config)
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=message):
        build_forest(register(tmp_path, text), library, tmp_path / "out", config)
    after = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert {path: data for path, data in after.items() if path.name != ".bbfit.json"} == {
        path: data for path, data in before.items() if path.name != ".bbfit.json"
    }


@pytest.mark.parametrize("name", ["forest.glb", "tiles/tileset.json", "tiles/0-0-0_0.glb", "usd/trees/tree_0.usdc", "placements/a.npy"])
def test_no_file_of_the_user_is_replaced(name: str, library: Path, tmp_path: Path) -> None:
    place = tmp_path / "out" / name
    place.parent.mkdir(parents=True)
    place.write_text("mine")
    with pytest.raises(InputError, match="is a file that bbfit did not write"):
        build_forest(register(tmp_path), library, tmp_path / "out", CONFIG)
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == [place] and place.read_text() == "mine"


@pytest.mark.parametrize("pattern", ["usd/trees/*.usdc", "tiles/trees/*.bin", "tiles/*.glb"])
def test_what_a_user_changed_is_kept_beside_the_new_file(pattern: str, library: Path, tmp_path: Path) -> None:
    """And is not taken for a file of bbfit the next time."""
    config, out = ForestConfig(formats=("tiles", "usd")), tmp_path / "out"
    build_forest(register(tmp_path, "x,y\n1,2\n"), library, out, config)
    (changed := min(out.glob(pattern))).write_text("mine")
    for text in ("x,y\n3,4\n", "x,y\n5,6\n"):
        build_forest(register(tmp_path, text), library, out, config)
        assert changed.with_name(f"{changed.name}.changed").read_text() == "mine" and changed.read_bytes() != b"mine"
        assert ".changed" not in (out / "run.json").read_text()


def test_projected_coordinates_are_moved_to_the_origin(library: Path, tmp_path: Path) -> None:
    path = register(tmp_path, "x,y\n391000,5820000\n391100,5820040\n")
    forest = build_forest(path, library, tmp_path / "out", ForestConfig(formats=("tiles",), origin=(13.4, 52.5)))
    assert (forest.origin.east, forest.origin.north, forest.origin.longitude) == (391050, 5820020, 13.4)
    assert every(forest).positions.tolist() == [[-50, 0, 20], [50, 0, -20]]
    given = ForestConfig(formats=("tiles",), origin_meters=(391000.0, 5820000.0))
    assert every(build_forest(path, library, tmp_path / "out", given)).positions.tolist() == [[0, 0, 0], [100, 0, -40]]


def test_an_origin_far_from_the_trees_is_refused(library: Path, tmp_path: Path) -> None:
    path = register(tmp_path, "lon,lat\n13.38,52.51\n")
    with pytest.raises(InputError, match=r"origin: is 5,\d\d\d km away from the trees, .*; give the longitude first"):
        build_forest(path, library, tmp_path / "out", ForestConfig(origin=(52.51, 13.38)))
    assert build_forest(path, library, tmp_path / "out", ForestConfig(origin=(13.4, 52.5))).origin.longitude == 13.4
    wide = register(tmp_path, "lon,lat\n10,50\n12.7,50\n7.3,50\n10,51.7\n10,48.3\n")
    assert build_forest(wide, library, tmp_path / "wide").origin.longitude == 10


def test_a_tree_that_is_far_away_is_named_where_it_is_the_first_of_a_batch(tmp_path: Path) -> None:
    extent = _Extent(tmp_path / "trees.csv")
    berlin, nowhere = np.zeros(2, ROW), np.zeros(2, ROW)
    berlin["x"], berlin["y"] = nowhere["x"], nowhere["y"] = 13.4, 52.5
    nowhere["x"][0], nowhere["y"][0], nowhere["row"] = 1.0, 1.0, [65_538, 65_539]
    extent.widened(berlin, "degrees")
    with pytest.raises(InputError, match=r"row 65538 is .* km away from the first tree"):
        extent.widened(nowhere, "degrees")


def test_a_forest_on_both_sides_of_180_degrees_is_one(library: Path, tmp_path: Path) -> None:
    forest = build_forest(register(tmp_path, "lon,lat\n179.9999,-17\n-179.9999,-17\n"), library, tmp_path / "out")
    assert np.ptp(every(forest).positions[:, 0]) == pytest.approx(21.3, abs=0.2)


def test_the_command_says_how_species_were_found(library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = register(tmp_path, "x,y,species\n1,2,Quercus robur\n3,4,silver birch\n5,,oak\n7,8,\n")
    options = ["--library", str(library), "--out", str(tmp_path / "out"), "--formats", "glb", "--incomplete", "skip"]
    assert main(["forest", str(path), *options]) == 0
    shown = capsys.readouterr().out
    assert "3 trees (1 by genus, 1 by species, 1 by any)" in shown and "1 rows without usable coordinates were left out" in shown
    for arguments, message in (
        (["forest", *options], "expected a register, or an area"),
        (["forest", str(path), *options, "--scatter", "9", "9"], "scatter: the trees are in a register"),
        (["forest", str(path), *options, "--mix", "oak=1"], "mix: the register has the species"),
        (["forest", "--scatter", "90", "90", "--mix", "palm=1", *options], "mix: the library has no tree and no species palm"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err


def test_quaternions_turn_as_matrices(library: Path) -> None:
    turns = np.array([0, 90, 200], np.float32)
    found = quaternions(turns)
    cos, sin = 1 - 2 * found[:, 1] ** 2, 2 * found[:, 1] * found[:, 3]
    np.testing.assert_allclose(cos, np.cos(np.radians(turns)), atol=1e-7)
    np.testing.assert_allclose(sin, np.sin(np.radians(turns)), atol=1e-7)
    assert RegisterConfig().incomplete == "refuse"
