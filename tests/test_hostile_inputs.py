"""Inputs that nobody made by mistake: each is refused in one line, before it takes memory or time, and reads nothing that it should not."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from bbfit.blender.config import ViewsConfig
from bbfit.blender.request import ViewsRequest
from bbfit.checks import InputError, MissingFileError, one_line
from bbfit.evaluation.report import Report
from bbfit.files import read_json
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import fit
from bbfit.images import encode_png, read_rgba
from bbfit.inputs import InputLimits
from bbfit.layout import REQUEST_FILE, TRAIN_FILE
from bbfit.stages.stage import Record
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.grid import Grid
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.species import load_species
from bbfit.views.dataset import ViewDataset
from bbfit.workers.results import Results


@pytest.fixture(autouse=True)
def in_seconds() -> Any:
    """No test of this file may compute for long, on however busy a machine: what hangs would compute for minutes."""
    started = time.process_time()
    yield
    assert time.process_time() - started < 20


def refused(read: Callable[[], object], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        read()
    assert str(caught.value).isprintable()


# Views.


@pytest.fixture
def folder(views_folder: Path, tmp_path: Path) -> Path:
    """A copy of the views, with a picture outside of it."""
    copy = Path(shutil.copytree(views_folder, tmp_path / "views"))
    shutil.copy(copy / "images" / "0000.png", tmp_path / "secret.png")
    return copy


def change(folder: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads((folder / TRAIN_FILE).read_text())
    edit(content)
    (folder / TRAIN_FILE).write_text(json.dumps(content))


@pytest.mark.parametrize("kind", ["above", "absolute", "link", "link to a folder", "without ending"])
def test_pictures_outside_of_the_folder_are_read_only_if_that_is_allowed(folder: Path, tmp_path: Path, kind: str) -> None:
    (folder / "images" / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "there").symlink_to(tmp_path)
    secret = {"absolute": str(tmp_path / "secret.png"), "link": "images/link.png", "link to a folder": "there/secret"}
    name = ({"above": "../secret.png", "without ending": "images/../../secret"} | secret)[kind]
    change(folder, lambda content: content["frames"][0].update(file_path=name))
    refused(lambda: ViewDataset.load(folder), r"^views: .* refers to .*, outside its own folder; .*--allow-folders")
    views = ViewDataset.load(folder, limits=InputLimits(allow_folders=(tmp_path,)))
    assert views.train.image(0) is not None
    refused(lambda: ViewDataset.load(folder, limits=InputLimits(allow_folders=(folder / "images",))), "outside its own folder")


def test_links_within_the_folder_are_followed(folder: Path) -> None:
    (folder / "images" / "link.png").symlink_to(folder / "images" / "0000.png")
    change(folder, lambda content: content["frames"][0].update(file_path="./images/link"))
    assert ViewDataset.load(folder).train.names[0] == "link"


@pytest.mark.parametrize("name", ["images/pipe.png", "/dev/zero", "images/pipe"])
def test_pipes_and_devices_are_never_opened(folder: Path, name: str) -> None:
    os.mkfifo(folder / "images" / "pipe.png")
    change(folder, lambda content: content["frames"][0].update(file_path=name))
    limits = InputLimits(allow_folders=(Path("/dev"),))
    with pytest.raises(InputError, match=r"is a device or a pipe|does not exist"):
        ViewDataset.load(folder, limits=limits)
    refused(lambda: read_json("run", folder / "images" / "pipe.png"), "is not a file")


@pytest.mark.parametrize(
    "number", ["1e9", "-1e9", "1e308", "9" * 400, "9" * 5000, "NaN", "Infinity", "[" * 100_000, "null", '"\\ud800"', "{}", "1e400"]
)
@pytest.mark.parametrize("name", ["cx", "fl_x", "w", "camera_angle_x"])
def test_numbers_of_cameras(folder: Path, name: str, number: str) -> None:
    content = json.loads((folder / TRAIN_FILE).read_text())
    del content["fl_x"], content["cx"], content["w"]
    content |= {"camera_angle_x": 0.7} | ({"fl_x": 50.0, "w": 48} if name != "camera_angle_x" else {})
    written = json.dumps(content | {name: "here"}).replace('"here"', number)
    (folder / TRAIN_FILE).write_text(written)
    if name == "w" and number == "1e9":  # pictures may have been reduced
        content = content | {"fl_x": 1e9}
    refused(lambda: ViewDataset.load(folder), r"^views: ")


@pytest.mark.parametrize("value", [1e308, 1e20, 10**400, "x", None, [1], float("nan"), float("inf")])
@pytest.mark.parametrize("row", [0, 3])
def test_numbers_of_matrices(folder: Path, value: Any, row: int) -> None:
    change(folder, lambda content: content["frames"][0]["transform_matrix"][row].__setitem__(3, value))
    refused(lambda: ViewDataset.load(folder), r"^views: .*no rigid 4x4 transform_matrix")


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "x" * 5000, "", ".", "a\nb"])
def test_names_of_pictures_that_are_no_names(folder: Path, name: str) -> None:
    change(folder, lambda content: content["frames"][0].update(file_path=name))
    refused(lambda: ViewDataset.load(folder), r"^views: ")


def test_a_million_views(folder: Path) -> None:
    change(folder, lambda content: content.update(frames=content["frames"][:1] * 10_001))
    refused(lambda: ViewDataset.load(folder), r"has 10,001 views, more than the limit of 10,000; --max-input-frames raises it")
    refused(lambda: ViewDataset.load(folder, limits=InputLimits(max_input_frames=3)), "more than the limit of 3")


def test_every_picture_is_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    change(folder, lambda content: content.update(frames=content["frames"][:1] * 5000))
    views, seen = ViewDataset.load(folder, cache_bytes=0).train, list[Path]()
    counted = [*views.paths]
    read = views.read
    object.__setattr__(views, "read", lambda path: (seen.append(path), read(path))[1])
    views.check()
    assert views.fingerprint and len(counted) == 5000 and len(seen) == 2


def test_names_of_held_out_views_are_looked_up_not_searched(folder: Path) -> None:
    content = json.loads((folder / TRAIN_FILE).read_text())
    names = [frame["file_path"] for frame in content["frames"]]
    content |= {"test_filenames": [f"x{number}" for number in range(300_000)] + names[:2], "frames": content["frames"] * 500}
    shutil.rmtree(folder / "transforms_test.json", ignore_errors=True)
    for name in ("transforms_test.json", TRAIN_FILE):
        (folder / name).unlink()
    (folder / "transforms.json").write_text(json.dumps(content))
    views = ViewDataset.load(folder)
    assert len(views.test) == 1000 and len(views.train) == 5000


# Pictures.


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *extra: bytes) -> bytes:
    """A PNG with a header and hardly any pixels."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(extra) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (png(60_000, 60_000), "has 3,600,000,000 pixels, more than the limit of 67,108,864; --max-input-pixels raises it"),
        (png(48, 40, chunk(b"tEXt", b"a\0" + b"x" * 80_000_000)), "cannot be read|cannot be decoded"),
        (png(48, 40, chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(1 << 28)))), "cannot be read"),
        (png(0, 40), "cannot be read|no picture"),
        (png(48, 0xFFFFFFFF), "pixels|cannot be read|no picture"),
    ],
)
def test_pictures_that_would_take_all_memory(folder: Path, data: bytes, said: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = folder / "images" / "0000.png"
    path.write_bytes(data)

    def load() -> None:
        views = ViewDataset.load(folder)
        views.train.check()
        views.test.check()

    refused(load, said)
    refused(lambda: read_rgba(path), said)
    assert not capfd.readouterr().err


def test_larger_pictures_are_read_if_that_is_allowed(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.zeros((20, 20, 4), np.uint8)))
    refused(lambda: read_rgba(tmp_path / "a.png", InputLimits(max_input_pixels=399)), "has 400 pixels, more than the limit of 399")
    assert read_rgba(tmp_path / "a.png", InputLimits(max_input_pixels=400)).shape == (20, 20, 4)


def test_panoramas_that_would_take_all_memory(tmp_path: Path) -> None:
    tree = tmp_path / "tree.ply"
    trimesh.creation.box().export(tree)
    for name, start in (
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 60000\n"),
        ("a.exr", b"\x76\x2f\x31\x01\x02\0\0\0dataWindow\0box2i\0" + struct.pack("<i4i", 16, 0, 0, 59_999, 29_999)),
        ("a.png", png(60_000, 30_000)),
    ):
        (tmp_path / name).write_bytes(start + bytes(100))
        config = ViewsConfig(hdri=tmp_path / name)
        refused(
            lambda config=config: ViewsRequest.of(TreeFile.open(tree), config), r"^hdri: .* has 60000 x 30000 pixels, more than 268,435,456"
        )


# Trees.

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + struct.pack("<3H", 0, 1, 2)


def triangle(**changes: Any) -> dict[str, Any]:
    """The JSON of a glTF with one triangle, whose data is CORNERS."""
    buffer = {"byteLength": 42, "uri": "data:application/octet-stream;base64," + base64.b64encode(CORNERS).decode()}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
        "buffers": [buffer],
    } | changes


def opened(folder: Path, content: Any, limits: InputLimits = InputLimits()) -> TreeFile:  # noqa: B008
    (folder / "tree.gltf").write_text(content if isinstance(content, str) else json.dumps(content))
    return TreeFile.open(folder / "tree.gltf", limits)


def test_the_triangle_is_fine(tmp_path: Path) -> None:
    assert len(opened(tmp_path, triangle()).mesh().faces) == 1


def put(content: dict[str, Any], place: str, value: Any) -> dict[str, Any]:
    """The content with another value at a place such as ``accessors.0.count``."""
    holder: Any = content
    *path, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    for part in path:
        holder = holder[part]
    holder[last] = value
    return content


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("accessors.0.count", 0),
        ("accessors.0.count", -1),
        ("accessors.0.count", 4),
        ("accessors.0.count", 10**18),
        ("accessors.0.count", 10**400),
        ("accessors.0.count", 3.0),
        ("accessors.0.count", True),
        ("accessors.0.byteOffset", 10**12),
        ("accessors.0.byteOffset", -4),
        ("accessors.0.componentType", 5131),
        ("accessors.0.type", "VEC9"),
        ("accessors.0.type", "VEC2"),
        ("accessors.0.type", ["VEC3"]),
        ("accessors.0.bufferView", 7),
        ("accessors.0.bufferView", "0"),
        ("accessors.1.count", 2**40),
        ("accessors.1.componentType", 5126),
        ("bufferViews.0.byteLength", 10**15),
        ("bufferViews.0.byteOffset", 10**15),
        ("bufferViews.0.byteStride", 0),
        ("bufferViews.0.byteStride", -12),
        ("bufferViews.0.byteStride", 10**9),
        ("bufferViews.0.byteStride", 4),
        ("bufferViews.0.buffer", 3),
        ("buffers.0.uri", 5),
        ("buffers.0.uri", "data:;base64,A"),
        ("buffers.0.uri", "a\0b"),
        ("buffers.0.uri", "\ud800"),
        ("buffers.0.uri", "x" * 5000),
        ("meshes.0.primitives.0.attributes.POSITION", 1),
        ("meshes.0.primitives.0.attributes.POSITION", 9),
        ("meshes.0.primitives.0.attributes", []),
        ("meshes.0.primitives.0.indices", 0),
        ("meshes.0.primitives.0.indices", -1),
        ("meshes.0.primitives.0.material", 4),
        ("meshes.0.primitives", None),
        ("meshes.0", 3),
        ("nodes.0.mesh", 2),
        ("nodes.0.children", [0]),
        ("nodes.0.children", [5]),
        ("nodes.0.children", 7),
        ("nodes.0.scale", [1, float("nan"), 1]),
        ("nodes.0.scale", [1e20, 1e20, 1e20]),
        ("nodes.0.scale", [1e-9, 1e-9, 1e-9]),
        ("nodes.0.scale", [10**400, 1, 1]),
        ("nodes.0.scale", "111"),
        ("nodes.0.translation", [1e20, 0, 0]),
        ("nodes.0.translation", [0, float("inf"), 0]),
        ("nodes.0.rotation", [float("nan")] * 4),
        ("nodes.0.matrix", [float("nan")] * 16),
        ("nodes.0.matrix", [1e308] * 16),
        ("nodes.0.matrix", [1, 2]),
        ("nodes.0.skin", 0),
        ("scenes.0.nodes", [3]),
        ("scene", 8),
        ("nodes", {"a": 1}),
        *(
            ("materials", [{"extensions": {"KHR_materials_diffuse_transmission": value}}])
            for value in (
                7,
                {"diffuseTransmissionFactor": 1.5},
                {"diffuseTransmissionFactor": float("nan")},
                {"diffuseTransmissionFactor": "1"},
                {"diffuseTransmissionColorFactor": [1, 1]},
                {"diffuseTransmissionColorFactor": [1, -1, 1]},
                {"diffuseTransmissionColorFactor": 1},
                {"diffuseTransmissionTexture": {"index": 0}},
                {"diffuseTransmissionColorTexture": 3},
            )
        ),
        ("accessors", "none"),
    ],
)
def test_damaged_gltf(tmp_path: Path, place: str, value: Any) -> None:
    refused(
        lambda: opened(tmp_path, put(triangle(), place, value)),
        r"^tree: .*tree\.gltf (cannot be read|refers to|reaches|has zero size|has vertices)",
    )


@pytest.mark.parametrize(
    "content", ["[" * 200_000, '{"asset": ' + "9" * 5000 + "}", '{"a": "\\ud800"}{', "[1]", '{"nodes": ' + "[" * 900 + "]" * 900 + "}"]
)
def test_texts_that_are_no_gltf(tmp_path: Path, content: str) -> None:
    refused(lambda: opened(tmp_path, content), r"^tree: .*tree\.gltf (is not a glTF|cannot be read)")


def test_indices_of_faces_beyond_the_vertices(tmp_path: Path) -> None:
    data = base64.b64encode(CORNERS[:36] + struct.pack("<3H", 0, 1, 3)).decode()
    refused(lambda: opened(tmp_path, put(triangle(), "buffers.0.uri", f"data:,;base64,{data}")), "cannot be read|a face refers to vertex")
    content = put(triangle(), "buffers.0.uri", f"data:application/octet-stream;base64,{data}")
    refused(lambda: opened(tmp_path, content), r"a face refers to vertex 3 of 3")


def test_accessors_that_announce_more_than_there_is(tmp_path: Path) -> None:
    """Without a buffer view, an accessor is zeros, which a program would allocate."""
    content = put(triangle(), "accessors.0", {"componentType": 5126, "count": 10**9, "type": "VEC3"})
    refused(lambda: opened(tmp_path, content), "has 1,000,000,000 vertices in an accessor without data, more than the limit of 30,000,000")


def nested(count: int) -> dict[str, Any]:
    return triangle(nodes=[{"children": [number + 1]} for number in range(count - 1)] + [{"mesh": 0}])


def test_nodes_are_limited_in_number_and_depth(tmp_path: Path) -> None:
    refused(lambda: opened(tmp_path, nested(100_000)), "its nodes are nested more than 200 deep")
    refused(lambda: opened(tmp_path, nested(100_001)), "has 100,001 nodes, more than the limit of 100,000; --max-input-nodes raises it")
    refused(lambda: opened(tmp_path, nested(20), InputLimits(max_input_nodes=19)), "has 20 nodes, more than the limit of 19")
    assert opened(tmp_path, nested(200)).vertices == 3


def test_nodes_in_a_circle_or_with_two_parents(tmp_path: Path) -> None:
    circle = [{"mesh": 0}, {"children": [2]}, {"children": [1]}]
    refused(lambda: opened(tmp_path, triangle(nodes=circle)), "in a circle")
    shared = [{"mesh": 0, "children": [2]}, {"children": [2]}, {}]
    refused(lambda: opened(tmp_path, triangle(nodes=shared)), "node 2 has two parents")


def test_vertices_of_all_instances_are_counted(tmp_path: Path) -> None:
    nodes = [{"children": list(range(1, 50))}] + [{"mesh": 0}] * 49
    refused(
        lambda: opened(tmp_path, triangle(nodes=nodes), InputLimits(max_input_vertices=146)), "has 147 vertices, more than the limit of 146"
    )
    assert opened(tmp_path, triangle(nodes=nodes), InputLimits(max_input_vertices=147)).bytes > 0


@pytest.mark.parametrize("kind", ["data URI", "file", "buffer view", "obj"])
def test_textures_that_would_take_all_memory(tmp_path: Path, kind: str) -> None:
    picture = png(30_000, 30_000)
    (tmp_path / "bark.png").write_bytes(picture)
    said = "has 900,000,000 pixels, more than the limit of 67,108,864; --max-input-pixels raises it"
    if kind == "obj":
        (tmp_path / "tree.mtl").write_text("newmtl bark\nmap_Kd bark.png\n")
        (tmp_path / "tree.obj").write_text("mtllib tree.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        refused(lambda: TreeFile.open(tmp_path / "tree.obj"), said)
        assert TreeFile.open(tmp_path / "tree.obj", InputLimits(max_input_pixels=900_000_000)).bytes
        return
    content = triangle()
    if kind == "buffer view":
        data = base64.b64encode(CORNERS + picture).decode()
        put(content, "buffers.0.uri", f"data:application/octet-stream;base64,{data}")
        content["bufferViews"].append({"buffer": 0, "byteOffset": 42, "byteLength": len(picture)})
        image: dict[str, Any] = {"bufferView": 2, "mimeType": "image/png"}
    else:
        image = {"uri": "bark.png" if kind == "file" else "data:image/png;base64," + base64.b64encode(picture).decode()}
    refused(lambda: opened(tmp_path, content | {"images": [image]}), said)
    refused(lambda: opened(tmp_path, content | {"images": [image]}, InputLimits(max_input_pixels=899_999_999)), "899,999,999")


PLY = "ply\nformat ascii 1.0\nelement vertex {0}\nproperty float x\nproperty float y\nproperty float z\nelement face {1}\n"
PLY += "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 {2}\n3 0 1 {3}\n"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((10**9, 1, 0, 2), "fewer bytes than the 1000000000 entries of vertex"),
        ((3, 4 * 10**9, 0, 2), "fewer bytes than the 4000000000 entries of face"),
        (("9" * 5000, 1, 0, 2), "cannot be read"),
        (("-3", 1, 0, 2), "its header is damaged"),
        ((3, 1, "nan", 2), "NaN or infinite"),
        ((3, 1, "1e20", 2), r"reaches 1e\+20 meters"),
        ((3, 1, "9" * 400, 2), "NaN or infinite|cannot be read"),
        ((3, 1, 0, 99_999_999), "a face refers to a vertex that it does not have"),
        ((3, 1, 0, -7), "a face refers to a vertex that it does not have"),
        ((3, 1, 0, "9" * 400), "cannot be read"),
    ],
)
def test_damaged_ply(tmp_path: Path, values: tuple[Any, ...], said: str) -> None:
    path = tmp_path / "tree.ply"
    path.write_text(PLY.format(3, 1, 0, 2))
    assert len(TreeFile.open(path).mesh().faces) == 1
    path.write_text(PLY.format(*values))
    refused(lambda: TreeFile.open(path).mesh(), rf"^tree: .*tree\.ply .*({said})")


def test_meshes_with_too_many_vertices(tmp_path: Path) -> None:
    for suffix in (".ply", ".stl", ".obj", ".glb"):
        trimesh.creation.box().export(tmp_path / f"tree{suffix}")
        assert TreeFile.open(tmp_path / f"tree{suffix}", InputLimits(max_input_vertices=36)).bytes
        refused(
            lambda suffix=suffix: TreeFile.open(tmp_path / f"tree{suffix}", InputLimits(max_input_vertices=7)), "more than the limit of 7"
        )
        refused(
            lambda suffix=suffix: TreeFile.open(tmp_path / f"tree{suffix}", InputLimits(max_input_bytes=80)),
            "bytes, more than the limit of 80",
        )


# Grids.


def test_grids_of_too_many_cells(tmp_path: Path) -> None:
    path, values = tmp_path / "grid.yaml", list(range(1, 301))
    path.write_text(yaml.safe_dump({"axes": {"billboards": values, "steps": values, "seed": values}}))
    grid = Grid.load(str(path))
    refused(grid.cells, r"^grid: it has 27,000,000 cells, more than the limit of 10,000; --max-cells raises it$")
    path.write_text(yaml.safe_dump({"axes": {"billboards": [1, 2, 3]}}))
    refused(lambda: Grid.load(str(path)).cells(max_cells=2), "it has 3 cells, more than the limit of 2")
    assert len(Grid.load(str(path)).cells(max_cells=3)) == 3 and SweepConfig().max_cells == 10_000


@pytest.mark.parametrize(
    "text",
    [
        "\n".join(["a0: &a0 [1]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)), "axes: {steps: *a11}"]),
        "\n".join(["a0: &a0 {x: 1}", *(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, 12))]),
        "axes: {steps: &a [1, *a]}",
        "axes: " + "[" * 5000,
        "axes: {steps: [" + "0x" + "F" * 6000 + "]}",
        "axes: {steps: [" + "9" * 6000 + "]}",
        "axes: {steps: [!!set {a, b}]}",
        "axes: {steps: [!!python/object/apply:os.system [id]]}",
        "# " + "x" * 300_000,
    ],
)
def test_grids_that_expand(tmp_path: Path, text: str) -> None:
    (tmp_path / "grid.yaml").write_text(text)
    refused(lambda: Grid.load(str(tmp_path / "grid.yaml")).cells(), r"^grid: ")


# Records and other JSON.

HOSTILE = ["[" * 100_000, "9" * 5000, '{"a": ' * 500 + "1" + "}" * 500, '"\\ud800"', "[" + "0," * 10_000_001 + "0]", "\x00", "NaN"]


@pytest.mark.parametrize("content", HOSTILE)
def test_hostile_json(tmp_path: Path, views_folder: Path, content: str) -> None:
    for name in ("metrics.json", "species.json", "run.json", "key.json", REQUEST_FILE):
        (tmp_path / name).write_text(content)
    refused(lambda: Report.load(tmp_path / "metrics.json"), r"^metrics: ")
    refused(lambda: load_species(None, tmp_path / "species.json"), r"species_file: ")
    assert not Record(tmp_path).stages and Results(tmp_path).get("key") is None
    try:
        assert ViewsRequest.load(tmp_path / REQUEST_FILE) is None
    except InputError as error:
        assert str(error).isprintable()


@pytest.mark.parametrize("value", [10**400, float("nan"), -1, "x" * 10_000, [[]], None, 1e308])
def test_facts_of_other_views_that_are_no_facts(folder: Path, value: Any) -> None:
    tree = dict.fromkeys(("name", "sha256", "bytes", "up_axis", "vertices", "faces", "bounds"), value)
    deep: Any = 1
    for _ in range(600):
        deep = [deep]
    (folder / REQUEST_FILE).write_text(json.dumps({"tree": tree, "config": {"a": 1}, "seconds": value}))
    request = ViewDataset.load(folder).request
    assert request is not None and request.tree.bounds is None and (request.seconds == 0 or value == 1e308)
    (folder / REQUEST_FILE).write_text(json.dumps({"tree": tree, "config": deep and {"a": deep}}))
    refused(lambda: ViewDataset.load(folder), r"^views: ") if value is None else None


@pytest.mark.parametrize("seconds", ["NaN", "Infinity", "1e400", "9" * 400, '"1"', "true"])
def test_stages_with_seconds_that_are_no_seconds_are_not_recorded(tmp_path: Path, seconds: str) -> None:
    (tmp_path / "run.json").write_text('{"stages": {"fit": {"inputs": "", "outputs": {}, "seconds": ' + seconds + "}}}")
    assert not Record(tmp_path).stages


# Messages.


def test_messages_are_one_line_whatever_they_name(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError) as caught:
        read_rgba(tmp_path / "a\nb\x1b[31m\udc80.png")
    assert str(caught.value).isprintable() and "a\\nb\\x1b[31m\\x80.png does not exist" in str(caught.value)
    assert len(one_line("x" * 1_000_000)) < 5000


# Fits.


def together(content: dict[str, Any]) -> None:
    """Put all cameras into one place."""
    for frame in content["frames"]:
        for row in range(3):
            frame["transform_matrix"][row][3] = 0.0


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (together, "^views: "),
        (lambda content: content.update(fl_x=1e-4, fl_y=1e7), "^views: .*neither a usable fl_x"),
        (lambda content: content.update(fl_x=5e-5, fl_y=5e-5), "^(views|fit): "),
        (lambda content: content["frames"][0]["transform_matrix"][0].__setitem__(3, 9e5), "^(views|fit): "),
    ],
)
@pytest.mark.parametrize("options", [{"placement": "even"}, {"preset": "thesis"}, {"candidates": 1, "refinement_rounds": 0}])
def test_fits_to_cameras_that_make_no_sense(
    folder: Path, edit: Callable[[dict[str, Any]], Any], said: str, options: dict[str, Any]
) -> None:
    """They are refused, or else end with a cloud that can be read."""
    for name in (TRAIN_FILE, "transforms_test.json"):
        content = json.loads((folder / name).read_text())
        edit(content)
        (folder / name).write_text(json.dumps(content))
    try:
        cloud = fit(ViewDataset.load(folder), FitConfig(billboards=2, steps=2, **options)).cloud
    except InputError as error:
        assert re.search(said, str(error)) and str(error).isprintable()
    else:
        cloud.check()
