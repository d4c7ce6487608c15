"""A small tree-like thing without any symmetry, in every format, and views of it that several tests look at."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual.material import PBRMaterial

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.glb import split_glb

FORMATS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".blend")
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # (x, y, z) -> (x, -z, y)

_EXPORT = """
import bpy, os, sys
source, folder = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
bpy.ops.export_scene.fbx(filepath=folder + "/thing.fbx")
for ending in ("usd", "usda", "usdc", "usdz"):
    bpy.ops.wm.usd_export(filepath=folder + "/thing." + ending)
# What a .blend may bring along must not show: a sun, a world, an exposure, things hidden from renders, scripts.
bpy.ops.object.light_add(type="SUN")
bpy.context.object.data.energy = 100
scene = bpy.context.scene
scene.world = bpy.data.worlds.new("red")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 0, 0, 1)
scene.view_settings.exposure = 3
scene.render.use_border = True
scene.render.border_max_x = 0.5
bpy.ops.mesh.primitive_uv_sphere_add(radius=20)
bpy.context.object.hide_render = True
hidden = bpy.data.collections.new("excluded")
scene.collection.children.link(hidden)
hidden.objects.link(bpy.data.objects.new("excluded", bpy.context.object.data))
bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
mark = f"open({folder + '/script_ran'!r}, 'w')"
text = bpy.data.texts.new("start.py")
text.write(mark)
text.use_module = True
driven = next(thing for thing in scene.objects if thing.type == "MESH").driver_add("pass_index")
driven.driver.expression = mark + ".close() or 1"
other = bpy.data.scenes.new("AAA first by name, not the active one")
bpy.ops.wm.save_as_mainfile(filepath=folder + "/thing.blend")
sys.stdout.flush()
os._exit(0)
"""


def run_in_blender(script: str, *arguments: str) -> None:
    """Run a script that uses bpy in a process of its own."""
    with tempfile.TemporaryDirectory() as scratch:  # os._exit, which the scripts end with, leaves Blender's own behind
        environment = os.environ | {"TMPDIR": scratch}
        done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def box(low: tuple[float, float, float], high: tuple[float, float, float], color: tuple[int, int, int]) -> trimesh.Trimesh:
    """A box between two corners in one matt color."""
    mesh = trimesh.creation.box(bounds=[low, high])
    material = PBRMaterial(name=str(color), baseColorFactor=[*color, 255], metallicFactor=0.0, roughnessFactor=1.0)
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def thing() -> list[trimesh.Trimesh]:
    """A red post off the origin, a green arm along +X at the top and a short blue foot along +Z, Y up."""
    return [
        box((-0.2, 0.0, -0.2), (0.2, 2.0, 0.2), (200, 30, 30)),
        box((0.2, 1.5, -0.1), (1.3, 1.8, 0.1), (30, 200, 30)),
        box((-0.1, 0.0, 0.2), (0.1, 0.3, 0.8), (30, 30, 200)),
    ]


def srgb(linear: np.ndarray) -> np.ndarray:
    """Vertex colors of a PLY, which are sRGB, for a glTF's factors, which are linear; both 0..255."""
    value = np.asarray(linear) / 255
    return np.rint(255 * np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)).astype(np.uint8)


@pytest.fixture(scope="session")
def things(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``thing`` in every format, each in its own convention."""
    folder = tmp_path_factory.mktemp("things")
    scene = trimesh.Scene(thing())
    scene.export(str(folder / "thing.glb"))
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        (folder / ("thing.gltf" if name.endswith(".gltf") else name)).write_bytes(data)
    scene.export(str(folder / "thing.obj"))
    joined = trimesh.util.concatenate(
        [trimesh.Trimesh(part.vertices, part.faces, vertex_colors=srgb(part.visual.material.baseColorFactor)) for part in thing()]
    )
    joined.apply_transform(Z_UP)
    joined.export(str(folder / "thing.ply"))
    joined.export(str(folder / "thing.stl"))
    run_in_blender(_EXPORT, str(folder / "thing.glb"), str(folder))
    return folder


@pytest.fixture(scope="session")
def thing_glb(things: Path) -> Path:
    """``thing`` as a .glb."""
    return things / "thing.glb"


SMALL = {"count": 4, "size": 32, "samples": 4, "training_samples": 4, "denoise": False, "elevations": (0.0,), "turned": 0}


@pytest.fixture(scope="session")
def unbroken(thing_glb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four views of ``thing``, rendered at one go; not to be written to."""
    return render_views(thing_glb, tmp_path_factory.mktemp("unbroken") / "views", ViewsConfig(**SMALL))


@pytest.fixture
def broken_blender(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Blender that crashes when its processes import it."""
    folder = tmp_path_factory.mktemp("broken")
    (folder / "bpy.py").write_text("import os, sys; sys.stderr.write('Fra: 1\\nout of luck\\n'); sys.stderr.flush(); os.abort()")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))))


def load(path: Path) -> trimesh.Trimesh:
    """All triangles of a file in its own world."""
    return trimesh.load(path, process=False).to_geometry()


def parts(path: Path) -> tuple[dict[str, Any], dict[str, trimesh.Trimesh]]:
    """The JSON of a GLB and its meshes by the name of their material."""
    scene = trimesh.load(path, process=False)
    return split_glb(path.read_bytes())[0], {mesh.visual.material.name: mesh for mesh in scene.geometry.values()}
