"""Readers of bbfit with generators of hostile inputs for them. The tests and ``scripts/fuzz`` use these."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import struct
import tempfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from hypothesis import strategies as st
from PIL import Image
from safetensors.torch import save

from bbfit.blender.config import ViewsConfig
from bbfit.blender.request import RenderedTree, ViewsRequest
from bbfit.budget.config import BudgetConfig
from bbfit.checks import InputError
from bbfit.evaluation.measures import Colour, Measures, Over, OverBackground, Rgba, ThesisScale
from bbfit.evaluation.report import Cost, Report, ShimmerScore, SizeMeasures, SizeScore, ViewScore
from bbfit.exporting.config import ExportConfig, ThinConfig
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import Step, fit
from bbfit.forest.building import read_forest
from bbfit.forest.config import ForestConfig, RegisterConfig, ScatterConfig
from bbfit.forest.placements import RECORD
from bbfit.forest.prototypes import read_prototype
from bbfit.forest.registers import Register
from bbfit.forest.scattering import scatter_area
from bbfit.forest.species import read_species_table
from bbfit.forest.tiles import read_tile
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.light import Light
from bbfit.geometry.orbit import Orbit
from bbfit.glb import gltf_parts
from bbfit.images import encode_png, picture_header, read_rgba, to_bytes, unpremultiply
from bbfit.inputs import InputLimits
from bbfit.layout import (
    LIT_TEST_FILE,
    LIT_TRAIN_FILE,
    REQUEST_FILE,
    TEST_FILE,
    TRAIN_FILE,
    TURNED_FILE,
    LitPaths,
    split_views,
    write_lit,
    write_transforms,
    write_turned,
)
from bbfit.library.config import LibraryConfig
from bbfit.library.manifest import Library, LibraryTree, Screen, read_library
from bbfit.operators.drawing.reference import render_reference
from bbfit.stages.billboards import read_choice
from bbfit.stages.stage import Record
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.grid import Grid
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.config import GrowConfig
from bbfit.trees.species import figures_file, known_species, load_species
from bbfit.viewing.viewed import open_results
from bbfit.views.dataset import ViewDataset
from bbfit.workers.results import Results

from .hostile import changed_bytes, changed_words, documents, dumped, hostile

Files = Mapping[str, bytes]
FIT = FitConfig(billboards=2, placement="even", steps=2, checkpoint_every=1, backend="reference")


@dataclass(frozen=True)
class Target:
    """A reader, and inputs for it."""

    inputs: st.SearchStrategy[Files]
    """Files by their paths within the folder of the input."""
    read: Callable[[Path], object]
    """Reads the folder as bbfit does. It may raise ``InputError`` alone."""
    weight: float = 1.0
    """How many inputs to try, compared with others. Some readers are slow."""


def place(files: Files, scratch: Path) -> Path:
    """Write an input to a folder in ``scratch``, with a pipe, a link to a file outside, and that file. Return the folder."""
    folder = scratch / "input"
    (folder / "images").mkdir(parents=True)
    (scratch / "secret.png").write_bytes(encode_png(np.full((12, 12, 4), 200, np.uint8)))
    os.mkfifo(folder / "pipe")
    (folder / "link.png").symlink_to(scratch / "secret.png")
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


# Valid inputs.


@functools.cache
def small_cloud() -> BillboardCloud:
    """Two crossed billboards, one with a back texture."""
    cloud = even_upright(2, axis=torch.tensor([0.0, 1, 0]), half_extents=torch.tensor([0.8, 1.0]), texture_sizes=torch.tensor([6, 5]))
    texels = torch.rand(90, 4, generator=torch.Generator().manual_seed(0))
    return BillboardCloud(**{**vars(cloud), "two_sided": torch.tensor([True, False]), "texels": texels})


@functools.cache
def _camera() -> Camera:
    points = np.array([[x, y, z] for x in (-0.8, 0.8) for y in (0, 2) for z in (-0.8, 0.8)], float)
    return Orbit(5).frame(points, target=torch.tensor([0.0, 1, 0]).double(), width=16, height=16)


TRANSFORMS = [TRAIN_FILE, TEST_FILE, TURNED_FILE, LIT_TRAIN_FILE, LIT_TEST_FILE]


@functools.cache
def views_files() -> Files:
    """A folder of five views, and a second picture of one of them."""
    camera, cloud = _camera(), small_cloud()
    names = [f"images/{index:04}.png" for index in range(len(camera))]
    pictures = [encode_png(to_bytes(unpremultiply(render_reference(cloud, camera[index])))) for index in range(len(camera))]
    with tempfile.TemporaryDirectory() as folder:
        train, test = split_views(len(camera), 0)
        write_transforms(Path(folder), camera, names, train, test)
        write_turned(Path(folder), camera[test[:1]], [names[train[0]]], [names[test[0]]])
        lit = {index: LitPaths(names[index], names[:2], torch.eye(3).double()[:2], names[0], names[1]) for index in range(len(camera))}
        write_lit(Path(folder), camera, lit, train, test)
        texts = {name: (Path(folder) / name).read_bytes() for name in TRANSFORMS}
    return dict(zip(names, pictures, strict=True)) | texts


def _read_views(folder: Path) -> None:
    views = ViewDataset.load(folder)
    views.check()
    assert len(views.fingerprint) == 64
    for lit in (views.lit_train, views.lit_test):
        assert lit is None or len(lit.fingerprint) == 64


def _fit_views(folder: Path) -> None:
    fit(ViewDataset.load(folder), FIT)


def _transforms(draw: st.DrawFn) -> Files:
    files = dict(views_files())
    name = draw(st.sampled_from(TRANSFORMS))
    files[name] = dumped(draw(documents(json.loads(files[name]))))
    if draw(st.integers(0, 9)) == 0:
        files["transforms.json"] = files.pop(TRAIN_FILE)
        del files[TEST_FILE], files[TURNED_FILE]
    return files


@functools.cache
def _request() -> dict[str, Any]:
    tree = RenderedTree("tree.glb", "0" * 64, 1000, "y", 100, 50, ((-1.0, 0.0, -1.0), (1.0, 2.0, 1.0)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / REQUEST_FILE
        ViewsRequest({"count": 5, "sun_strength": 2.5}, tree, camera={"target": [0, 1, 0], "distance": 3.0}, complete=True).save(path)
        content: dict[str, Any] = json.loads(path.read_bytes())
    return content


# Pictures.


@functools.cache
def _pictures() -> dict[str, bytes]:
    image = np.random.default_rng(0).integers(0, 256, (14, 12, 4), dtype=np.uint8)
    made = {"a.png": encode_png(image)}
    for name, mode, options in (("a.webp", "RGBA", {}), ("b.webp", "RGBA", {"lossless": True}), ("p.png", "P", {}), ("la.png", "LA", {})):
        data = io.BytesIO()
        Image.fromarray(image).convert(mode).save(data, name.partition(".")[2], **options)
        made[name] = data.getvalue()
    made["a.hdr"] = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 2\n" + bytes(16)
    window = b"dataWindow\0box2i\0" + struct.pack("<i4i", 16, 0, 0, 3, 3)
    made["a.exr"] = b"\x76\x2f\x31\x01\x02\0\0\0" + window + b"\0" + bytes(64)
    for name, mode in (("a.jpg", "RGB"), ("a.tif", "RGBA"), ("a.tga", "RGBA"), ("a.bmp", "RGB"), ("a.gif", "P"), ("a.jp2", "RGB")):
        data = io.BytesIO()
        with contextlib.suppress(OSError, KeyError):
            Image.fromarray(image).convert(mode).save(data, {"jpg": "jpeg", "tif": "tiff", "jp2": "jpeg2000"}.get(name[2:], name[2:]))
            made[name] = data.getvalue()
    return made


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@functools.cache
def _bomb(size: int) -> bytes:
    return zlib.compress(bytes(size), 9)


@functools.cache
def _long_text() -> bytes:
    return b"a\0" + b"x" * 80_000_000


@st.composite
def _pngs(draw: st.DrawFn, *, large: bool = False) -> bytes:
    """A PNG whose checksums are right."""
    size = st.sampled_from([0, 1, 12, 14, 1000, 60_000, 0x7FFFFFFF, 0xFFFFFFFF])
    depth, color = draw(st.sampled_from([1, 2, 8, 16, 3, 255])), draw(st.sampled_from([0, 2, 3, 4, 6, 7]))
    header = struct.pack(">IIBBBBB", draw(size), draw(size), depth, color, draw(st.integers(0, 1)), 0, draw(st.integers(0, 2)))
    bomb = _bomb(draw(st.sampled_from([0, 100, 700, 1 << 20, 1 << 27])))
    text = _long_text() if large and draw(st.integers(0, 9)) == 0 else b"a\0b"
    extras = st.sampled_from(
        [(b"tEXt", b"a\0" + bytes(1000)), (b"tEXt", text), (b"zTXt", b"a\0\0" + bomb), (b"iCCP", b"a\0\0" + bomb),
         (b"iTXt", b"a\0\1\0\0\0" + bomb), (b"tRNS", bytes(6)), (b"PLTE", bytes(7)), (b"PLTE", bytes(30)),
         (b"acTL", struct.pack(">II", 1 << 31, 0)), (b"fcTL", bytes(26)),
         (b"eXIf", b"II*\0" + b"\xff" * 20), (b"gAMA", b""), (b"IDAT", bomb), (b"IEND", b"")]
    )  # fmt: skip
    chunks = [(b"IHDR", header), *draw(st.lists(extras, max_size=2)), (b"IDAT", bomb), *draw(st.lists(extras, max_size=1)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def _picture(draw: st.DrawFn) -> Files:
    name = draw(st.sampled_from([*_pictures(), "made.png", "made.png"]))
    data = draw(_pngs(large=True)) if name == "made.png" else draw(changed_bytes(_pictures()[name]))
    return {name: data}


def _read_picture(folder: Path) -> None:
    path = next(path for path in folder.iterdir() if path.is_file() and not path.is_symlink())
    refusals = 0
    for read in (lambda: picture_header("picture", path, InputLimits()), lambda: read_rgba(path)):
        try:
            read()
        except InputError:
            refusals += 1
    if refusals == 2:
        read_rgba(path)


# Clouds.


def _cloud(draw: st.DrawFn) -> Files:
    cloud, data = small_cloud(), b""
    tensors = {name: getattr(cloud, name) for name in ("centers", "rights", "ups", "half_extents", "texture_sizes", "two_sided", "texels")}
    has_maps = draw(st.booleans())
    if has_maps:
        light = Light.of(torch.tensor([[0.3, 0.9, 0.3]]), 2.5, 1.0)
        tensors |= {"surface": cloud.texels.clone()} | {f"light.{name}": value for name, value in vars(light).items()}
    version = f"bbfit billboard cloud {1 + has_maps} "
    name = draw(st.sampled_from(list(tensors)))
    tensor = tensors[name]
    kind = draw(st.integers(0, 6))
    metadata = {"format": version + '{"kind": "blend", "cutoff": 0.5}'}
    if kind == 0:
        types = [
            torch.float8_e4m3fn,
            torch.float8_e5m2,
            torch.complex64,
            torch.float16,
            torch.bfloat16,
            torch.int8,
            torch.bool,
            torch.float64,
        ]
        tensors[name] = tensor.to(draw(st.sampled_from([torch.int32, torch.uint8, *types])))
    elif kind == 1:
        tensors[name] = (tensor.double() * draw(st.sampled_from([0, -1, 1000, 1e30, float("nan"), float("inf"), 1.2]))).to(tensor.dtype)
    elif kind == 2:
        shapes = [tensor[:-1], tensor[..., None], tensor.flatten(), torch.cat([tensor, tensor]), tensor[:0], tensor.flatten()[0]]
        tensors[name] = draw(st.sampled_from(shapes)).contiguous()
    elif kind == 3:
        text = draw(st.one_of(hostile.map(lambda value: dumped(value).decode()), st.text(max_size=20)))
        metadata["format"] = version + text
    elif kind == 4:
        tensors["texture_sizes"] = torch.tensor([[1 << 40, 1 << 40], [6, 5]])
    data = save({key: value.clone() for key, value in tensors.items()}, metadata)
    if kind == 5:
        length = struct.unpack("<Q", data[:8])[0]
        header = dumped(draw(documents(json.loads(data[8 : 8 + length]))))
        data = struct.pack("<Q", len(header)) + header + data[8 + length :]
    elif kind == 6:
        data = draw(changed_bytes(data))
    return {"cloud.safetensors": data}


def _read_cloud(folder: Path) -> None:
    cloud = BillboardCloud.load(folder / "cloud.safetensors")
    cloud.check()
    assert len(cloud.textures()) == len(cloud)


@functools.cache
def _checkpoint() -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder, path = place(views_files(), Path(name)), Path(name) / "fit.checkpoint"

        class Stopped(Exception):
            pass

        def stop(step: Step) -> None:
            if step.index == 2:
                raise Stopped

        with contextlib.suppress(Stopped):
            fit(ViewDataset.load(folder), FIT, checkpoint=path, on_step=stop)
        return path.read_bytes()


def _changed_checkpoint(draw: st.DrawFn) -> Files:
    data = _checkpoint()
    if draw(st.booleans()):
        length = struct.unpack("<Q", data[:8])[0]
        header = dumped(draw(documents(json.loads(data[8 : 8 + length]))))
        data = struct.pack("<Q", len(header)) + header + data[8 + length :]
    else:
        data = draw(changed_bytes(data))
    return {**views_files(), "fit.checkpoint": data}


def _resume(folder: Path) -> None:
    fit(ViewDataset.load(folder), FIT, checkpoint=folder / "fit.checkpoint")


# Trees.


def _transmitting(tree: dict[str, Any]) -> None:
    values = {"diffuseTransmissionFactor": 0.5, "diffuseTransmissionTexture": {"index": 0}, "diffuseTransmissionColorFactor": [0.5, 1, 0.1]}
    tree["materials"][0]["extensions"] = {"KHR_materials_diffuse_transmission": values}


@functools.cache
def _trees() -> dict[str, bytes]:
    box = trimesh.creation.box(extents=(1.0, 2.0, 1.0))
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.random.default_rng(0).random((8, 2)), material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGBA", (4, 4)))
    )
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="a")
    scene.add_geometry(box, node_name="b", parent_node_name="a", transform=trimesh.transformations.translation_matrix([1, 0, 0]))
    plain = trimesh.creation.box(extents=(1.0, 2.0, 1.0))
    made: dict[str, bytes] = {"tree.glb": trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=_transmitting)}
    made["tree.ply"] = trimesh.exchange.ply.export_ply(plain)
    made["ascii.ply"] = trimesh.exchange.ply.export_ply(plain, encoding="ascii")
    made["tree.stl"] = trimesh.exchange.stl.export_stl(plain)
    made["ascii.stl"] = trimesh.exchange.stl.export_stl_ascii(plain).encode()
    made["tree.obj"] = b"mtllib tree.mtl\nusemtl bark\nvt 0 0\nvt 1 1\n" + trimesh.exchange.obj.export_obj(plain).encode()
    made["tree.mtl"] = b"newmtl bark\nKd 0.5 0.5 0.5\nmap_Kd -s 1 1 1 images/bark.png\nbump images/bark.png\nd 1\n"
    return made


def _glb(content: bytes, binary: bytes) -> bytes:
    text = content + b" " * (-len(content) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _gltf(draw: st.DrawFn) -> Files:
    content, binary = gltf_parts(_trees()["tree.glb"])
    kind = draw(st.integers(0, 9))
    if kind == 0:
        return {"tree.glb": draw(changed_bytes(_trees()["tree.glb"]))}
    if kind == 1:
        return {"tree.glb": _glb(dumped(content), draw(changed_bytes(binary)))}
    if kind < 6:
        return {"tree.glb": _glb(dumped(draw(documents(content, 4))), binary)}
    content["buffers"][0]["uri"] = "tree.bin"
    content["images"] = [{"uri": "images/bark.png"}]
    picture = draw(st.one_of(st.just(_pictures()["a.png"]), _pngs()))
    return {"tree.gltf": dumped(draw(documents(content))), "tree.bin": binary, "images/bark.png": picture}


def _mesh(draw: st.DrawFn) -> Files:
    name = draw(st.sampled_from(["tree.ply", "ascii.ply", "tree.stl", "ascii.stl", "tree.obj", "tree.mtl"]))
    data = _trees()[name]
    header, end, body = data.partition(b"end_header\n")
    if name == "tree.ply" and draw(st.booleans()):
        changed = draw(changed_words(header)) + end + body
    else:
        changed = draw(changed_bytes(data) if name in ("tree.ply", "tree.stl") else changed_words(data))
    files = {name: changed}
    if name in ("tree.obj", "tree.mtl"):
        files = {"tree.obj": _trees()["tree.obj"], "tree.mtl": _trees()["tree.mtl"], "images/bark.png": draw(_pngs())} | files
    return files


_SCENES = {
    "tree.fbx": b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0RelativeFilenameS\x09\0\0\0bark.png\0FilenameS\x0f\0\0\0/etc/passwd.png",
    "text.fbx": b'; FBX 7.4.0 project file\nTexture: {\n\tFileName: "images/bark.png"\n\tRelativeFilename: "../x.png"\n}\n',
    "tree.blend": b"BLENDER-v405IM\0\0" + struct.pack("<IQII", 40, 1, 0, 1) + b"//images/bark.png\0".ljust(40, b"\0") + b"ENDB" + bytes(20),
}  # fmt: skip


def _scene(draw: st.DrawFn) -> Files:
    name = draw(st.sampled_from(list(_SCENES)))
    return {name: draw(changed_bytes(_SCENES[name])), "images/bark.png": _pictures()["a.png"]}


def _read_tree(folder: Path) -> None:
    names = ("tree.glb", "tree.gltf", "tree.obj", "tree.ply", "ascii.ply", "tree.stl", "ascii.stl", *_SCENES)
    tree = TreeFile.open(next(folder / name for name in names if (folder / name).is_file()))
    assert tree.bytes > 0
    if tree.is_mesh:
        mesh = tree.mesh()
        assert np.isfinite(mesh.vertices).all() and len(mesh.faces)


# Grids, species and records.

_GRID = {
    "fit": {"steps": 100, "loss": "l2", "alpha": "mask", "alpha_cutoff": 0.5},
    "variants": {"base": {"sides": "one"}, "double": {"sides": "two", "max_texels": 1000}},
    "axes": {"billboards": [2, 3, 4], "loss": ["l1", "l2"]},
    "trees": ["quaking_aspen"],
}
_YAML = b"""fit: {steps: 100}
variants:
  base: &a {sides: one}
  double: {<<: *a, sides: two}
axes:
  billboards: [2, 3, 4]
  loss: [l1, l2]
"""


def _laughs(depth: int, width: int) -> bytes:
    """Names for lists of names for lists (\"billion laughs\")."""
    lines = [f"a{0}: &a0 [1]"] + [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * width)}]" for level in range(1, depth)]
    return "\n".join(lines).encode() + b"\naxes: {billboards: *a" + str(depth - 1).encode() + b"}\n"


def _grid(draw: st.DrawFn) -> Files:
    kind = draw(st.integers(0, 9))
    if kind < 4:
        data = dumped(draw(documents(_GRID)))
    elif kind < 7:
        data = draw(changed_words(_YAML))
    elif kind == 7:
        data = _laughs(draw(st.integers(2, 12)), draw(st.integers(1, 12)))
    elif kind == 8:
        values = ", ".join(map(str, range(1, draw(st.sampled_from([3, 300, 3000])))))
        data = f"axes: {{billboards: [{values}], steps: [{values}], seed: [{values}]}}\n".encode()
    else:
        values = ["&a [*a]", "!!python/object/apply:os.system [id]", "!!binary AAAA", "!!set {a, b}", "!!timestamp 2001-01-01", "~"]
        values += ["1e400", ".nan", "0x" + "F" * 5000, "1:" * 3000 + "1", "[" * 2000, "{? " * 300]
        data = f"axes: {{steps: [{draw(st.sampled_from(values))}]}}\n".encode()
    return {"grid.yaml": data}


def _read_grid(folder: Path) -> None:
    grid = Grid.load(str(folder / "grid.yaml"))
    assert len(grid.cells()) <= 10_000


@functools.cache
def _all_species() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(figures_file().read_bytes())
    return {name: content[name] for name in ("quaking_aspen", "weeping_willow") if name in content}


def _species(draw: st.DrawFn) -> Files:
    return {"species.json": dumped(draw(documents(_all_species())))}


def _read_species(folder: Path) -> None:
    for name in known_species(folder / "species.json"):
        load_species(name, folder / "species.json")


@functools.cache
def _report() -> dict[str, Any]:
    over = OverBackground(30.0, 0.9, 0.1)
    colour = Colour((1.0, 2.0, 0.5, 4.0), (1.0, 1.5, 0.5, 4.0), (0.5, 1.0, 0.2, 2.0), (0.4, 0.9, 0.2, 2.0))
    measures = Measures(Over(over, over, over, over), Rgba(0.1, 20.0, 0.9), ThesisScale(0.1, 0.9, 90.0, 10.0), colour, 0.9, None)
    scores = tuple(ViewScore(name, 90.0, 0.0, measures) for name in ("0001", "0002"))
    report = Report(
        scores, Cost(8, 1000), Cost(1000, 10_000), {"fit": 1.0}, small_cloud().alpha, 1.5, (SizeScore(8, 8, SizeMeasures(30.0, None, 0.1)),)
    )
    report = replace(report, shimmer=(ShimmerScore(8, 8, 0.1, 1.2, None),))
    return report.to_json()


_CHOICE = {
    "inputs": "0" * 64,
    "trials": [],
    "config": vars(FitConfig().resolve()),
    "met": True,
}
_STAGES = {"source": "tree.glb", "config": {"grow": None, "export": {}}, "seeds": {}}
_STAGES |= {"stages": {"fit": {"inputs": "0" * 64, "outputs": {"cloud.safetensors": "0" * 64, "../secret.png": "1"}, "seconds": 1.5}}}
_OUTCOME = {
    "outcome": {"facts": {"report": {"over": {"mean": {"psnr": 30.0}}}}, "reason": None, "where": "here", "seconds": 1.0, "trace": None}
}
_LEVEL = {"name": "oak_LOD0", "planes": 8, "vertices": 40, "triangles": 20, "bytes": 100, "error_meters": 0.1, "error_pixels": 0.9}
_LEVEL |= {"held_out_error_pixels": 1.0, "psnr": 25.0, "tree_pixels": None, "distance_meters": 0.0, "screen_coverage": 0.0}
_LEVEL |= {"file": "trees/oak_LOD0.glb", "silhouette_distance_meters": 10.0, "color_distance_meters": 20.0, "color_error": 0.1}
_LEVEL |= {"held_out_color_error": 0.1, "halvings": 0}
_LOD = {
    "config": {"screen_height": 1080, "screen_width": 1920, "screen_fov_degrees": 40.0},
    "levels": [_LEVEL | {"planes": None, "psnr": None}, _LEVEL | {"planes": 2, "requested": 2, "distance_meters": 10.0}],
}
_RECORDS: dict[str, Any] = {
    "metrics.json": _report,
    "pareto.json": _CHOICE,
    "run.json": _STAGES,
    "key.json": {"outcome": _OUTCOME},
    "levels/lod.json": _LOD,
}
_RECORDS |= {".bbfit.json": {"written": {"a": {"by": "fit", "sha256": "0"}}, "begun": {"fit": ["b*"]}}, REQUEST_FILE: _request}


@functools.cache
def _cloud_file() -> bytes:
    with tempfile.TemporaryDirectory() as name:
        small_cloud().save(Path(name) / "cloud.safetensors")
        return (Path(name) / "cloud.safetensors").read_bytes()


def _record(draw: st.DrawFn) -> Files:
    name = draw(st.sampled_from(list(_RECORDS)))
    valid = _RECORDS[name]() if callable(_RECORDS[name]) else _RECORDS[name]
    data = dumped(draw(documents(json.loads(json.dumps(valid)))))
    clouds = {"levels/lod.json": "2/cloud.safetensors", "run.json": "cloud.safetensors"}
    more = {clouds[name]: _cloud_file()} if name in clouds else {}
    return {
        **(views_files() if name == REQUEST_FILE else {}),
        name: draw(changed_bytes(data)) if draw(st.integers(0, 9)) == 0 else data,
    } | more


def _read_record(folder: Path) -> None:
    if (folder / "metrics.json").is_file():
        report = Report.load(folder / "metrics.json")
        assert report.mean and json.dumps(report.to_json(), allow_nan=False)
    elif (folder / "pareto.json").is_file():
        read_choice(folder, FitConfig())
    elif (folder / "key.json").is_file():
        Results(folder).get("key")
    elif (folder / REQUEST_FILE).is_file():
        ViewDataset.load(folder)
    elif (folder / "levels/lod.json").is_file():
        open_results(folder)
    else:
        record = Record(folder)
        json.dumps(record.stages, allow_nan=False)
        if (folder / "run.json").is_file():
            open_results(folder)


# Libraries.

_SCORE = {"tree_pixels": 40.0, "psnr": 25.0, "color_error": 0.2, "texels": 640}
_LIBRARY: dict[str, Any] = {
    "version": 1,
    "generator": "bbfit",
    "screen": {"height": 1080, "fov_degrees": 50.0},
    "atlas": ["trees/atlas.png"],
}
_LIBRARY |= {"failures": {"elm": "it is damaged"}, "seconds": {"packing": 1.0}}
_LIBRARY["pages"] = [{"files": ["trees/atlas.png"], "width": 64, "height": 64, "used": 0.5, "safe_mip_level": 3, "bytes": 1}]
_LIBRARY["trees"] = [
    {"name": "oak", "species": None, "seed": None, "low": [-1.0, 0.0, -1.0], "high": [1.0, 4.0, 1.0], "levels": [_LEVEL]}
    | {"scores": [_SCORE], "seconds": {"fit": 1.0}}
]


def _library(draw: st.DrawFn) -> Files:
    data = dumped(draw(documents(json.loads(json.dumps(_LIBRARY)), 3)))
    changed = draw(changed_bytes(data)) if draw(st.integers(0, 9)) == 0 else data
    return {"library.json": changed, "trees/atlas.png": b".", "trees/oak_LOD0.glb": b"."}


def _read_library(folder: Path) -> None:
    library = read_library(folder)
    assert json.dumps(library.document(), allow_nan=False)


# Forests.

_REGISTER = b"""species;hoehe;lon;lat;turn
Tilia cordata;12,5;13.4;52.5;90
"Acer, rot";6-10 m;13.401;52.501;
;;13.402;52.502;-5
"""
_FEATURES = {
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
    "features": [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [13.4, 52.5, 30]}, "properties": {"art": "Eiche", "height": 7}},
        {"type": "Feature", "geometry": {"type": "MultiPoint", "coordinates": [[13.4, 52.51]]}, "properties": {"height": "3 m"}},
    ],
}
_AREA = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [[[13.4, 52.5], [13.401, 52.5], [13.4, 52.501]]]}}
_FOREST = {
    "version": 1,
    "generator": "bbfit",
    "library": {"trees": ["oak"]},
    "origin": {"longitude": 13.4, "latitude": 52.5, "east": 0.0, "north": 0.0},
    "skipped": 0,
    "species": [{"name": "Tilia", "count": 3, "likeness": "any", "trees": ["oak"]}],
    "root": {"name": "0/0/0", "low": [0, 0, 0], "high": [1, 2, 3], "count": 3, "children": []},
}


@functools.cache
def _tile_file() -> bytes:
    content = io.BytesIO()
    np.save(content, np.zeros(3, RECORD), allow_pickle=False)
    return content.getvalue()


@functools.cache
def _tree_glb() -> bytes:
    return shipped_model(small_cloud(), ExportConfig()).glb


def _forest(draw: st.DrawFn) -> Files:
    kinds = ["trees.csv", "trees.geojson", "area.geojson", "species.csv", "forest.json", "placements/0-0-0.npy", "tree.glb"]
    kind = draw(st.sampled_from(kinds))
    documented = {"trees.geojson": _FEATURES, "area.geojson": _AREA, "forest.json": _FOREST}
    if kind in documented:
        data = dumped(draw(documents(documented[kind])))
        return {kind: draw(changed_bytes(data)) if draw(st.integers(0, 4)) == 0 else data}
    if kind.endswith(".csv"):
        valid = _REGISTER if kind == "trees.csv" else b"Linde;oak\nAhorn;oak\n"
        return {kind: draw(changed_words(valid) if draw(st.booleans()) else changed_bytes(valid))}
    return {kind: draw(changed_bytes(_tree_glb() if kind == "tree.glb" else _tile_file()))}


def _read_forest(folder: Path) -> None:
    level = LodLevel("a", 2, 8, 4, 1, 0.0, 0.0, 0.0, None, None, 0.0, 0.0, "tree.glb", 0.0, 0.0, 0.0, 0.0)
    oak = LibraryTree("oak", None, None, (-1.0, 0.0, -1.0), (1.0, 2.0, 1.0), (level,))
    library = Library(folder, Screen(100, 50.0), (), (oak,))
    for name in ("trees.csv", "trees.geojson"):
        if (folder / name).is_file():
            for rows in Register(folder / name, RegisterConfig()).batches():
                assert np.isfinite(rows["x"]).all() and np.isfinite(rows["y"]).all()
    if (folder / "area.geojson").is_file():
        scatter_area(ScatterConfig(scatter_area=folder / "area.geojson"), ForestConfig())
    if (folder / "species.csv").is_file():
        read_species_table(folder / "species.csv", library)
    if (folder / "forest.json").is_file():
        read_forest(folder)
    if (folder / "placements").is_dir():
        assert read_tile(folder, "0/0/0").positions.shape[1] == 3
    if (folder / "tree.glb").is_file():
        assert read_prototype(library, 0, 0, InputLimits()).parts


# Options.

_KINDS: dict[str, Any] = {"fit": FitConfig, "views": ViewsConfig, "export": ExportConfig, "grow": GrowConfig, "sweep": SweepConfig}
_KINDS |= {"budget": BudgetConfig, "limits": InputLimits, "library": LibraryConfig, "thin": ThinConfig}
_COMMANDS = ("run", "fit", "views", "evaluate", "export", "thin", "lod", "sweep", "compare", "library", "forest")


def _options(draw: st.DrawFn) -> Files:
    """A command line for inputs that do not exist, so that no work begins."""
    command = draw(st.sampled_from(_COMMANDS))
    names = [name for kind in _KINDS.values() for name in kind.__dataclass_fields__] + ["out", "tree", "seed", "unknown"]
    least = int(command == "run")  # which would grow a tree
    words = [command, "--grid", "nowhere.yaml"] if command == "sweep" else [command, *(["nowhere"] * draw(st.integers(least, 3)))]
    for _ in range(draw(st.integers(1, 3))):
        value = draw(hostile)
        text = dumped(value).decode()[:50_000] if not isinstance(value, str) else value
        words += ["--" + draw(st.sampled_from(names)).replace("_", "-"), text.replace("\0", "")]
    return {"command.json": json.dumps(words).encode()}


def _run_command(folder: Path) -> None:
    """Run the command line. A refusal is one line; a wrong use of the options is shown by the parser."""
    from bbfit.cli import main

    words, before = json.loads((folder / "command.json").read_text()), sorted(folder.rglob("*"))
    shown, here = io.StringIO(), Path.cwd()
    try:
        os.chdir(folder)
        with contextlib.redirect_stderr(shown), contextlib.redirect_stdout(io.StringIO()):
            code = main(words)
    except SystemExit as ending:
        code = ending.code
    finally:
        os.chdir(here)
    assert code == 2, f"exit code {code}: {shown.getvalue()}"
    lines = shown.getvalue().splitlines()
    assert "Traceback" not in shown.getvalue() and (len(lines) == 1 or not lines[0].startswith("bbfit:")), shown.getvalue()
    assert sorted(folder.rglob("*")) == before


def _strategy(make: Callable[[st.DrawFn], Files]) -> st.SearchStrategy[Files]:
    return st.composite(make)()


TARGETS: Mapping[str, Target] = {
    "transforms": Target(_strategy(_transforms), _read_views),
    "fits": Target(_strategy(_transforms), _fit_views, 0.2),
    "pictures": Target(_strategy(_picture), _read_picture),
    "clouds": Target(_strategy(_cloud), _read_cloud),
    "checkpoints": Target(_strategy(_changed_checkpoint), _resume, 0.2),
    "gltf": Target(_strategy(_gltf), _read_tree, 2.0),
    "meshes": Target(_strategy(_mesh), _read_tree, 2.0),
    "scenes": Target(_strategy(_scene), _read_tree, 0.5),
    "grids": Target(_strategy(_grid), _read_grid),
    "species": Target(_strategy(_species), _read_species),
    "records": Target(_strategy(_record), _read_record, 2.0),
    "libraries": Target(_strategy(_library), _read_library),
    "forests": Target(_strategy(_forest), _read_forest, 3.0),
    "options": Target(_strategy(_options), _run_command, 0.5),
}
"""All readers by name."""
