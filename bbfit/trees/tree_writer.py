"""A grown tree as a trimesh scene, written as GLB or OBJ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail
from bbfit.files import write_bytes, write_pieces
from bbfit.model_files import check_model_path, generator, glb_of_scene
from bbfit.trees.parts import Material, Part

if TYPE_CHECKING:
    import trimesh

_COLOR = "base_color"
"""Key of the unrounded linear color in a geometry's metadata; trimesh's material keeps 8 bits."""
_TRANSMISSION = "KHR_materials_diffuse_transmission"
"""Extension of glTF, and key of its values in a geometry's metadata."""
_GLB_LIMIT = 2**32 - 2**20
"""Limit on bytes of vertices and triangles in a GLB, whose header has a 32-bit length (glTF 2.0 specification, section 4.4)."""
_VERTEX_BYTES, _TRIANGLE_BYTES = 32, 12
_ROWS = 1 << 16
"""Lines of an OBJ that are formatted at a time."""


def scene_of(parts: Sequence[Part], *, name: str) -> trimesh.Scene:
    """One geometry, named after its material, for each part that has triangles; ``name`` is the name of the scene.

    Vertices, triangles and their order are unchanged; trimesh stores them in 64 bits. trimesh's material keeps 8 bits of the color, the
    geometry's ``metadata["base_color"]`` all of it. ``metadata["KHR_materials_diffuse_transmission"]`` has the values of this extension of
    glTF for the parts that transmit light.
    """
    import trimesh

    scene = trimesh.Scene(metadata={"name": name})
    for part in parts:
        if len(part.faces) == 0:
            continue
        material = part.material
        assert material.name not in scene.geometry, f"two parts are called {material.name}"
        surface = trimesh.visual.material.PBRMaterial(
            name=material.name,
            baseColorFactor=np.array([*material.color, 1.0]),
            metallicFactor=0.0,
            roughnessFactor=material.roughness,
            doubleSided=material.double_sided,
        )
        mesh = trimesh.Trimesh(
            part.vertices,
            part.faces,
            vertex_normals=part.normals,
            visual=trimesh.visual.TextureVisuals(uv=part.uvs, material=surface),
            metadata={_COLOR: [float(value) for value in material.color]} | _transmission(material),
            process=False,
        )
        scene.add_geometry(mesh, node_name=material.name, geom_name=material.name)
    return scene


def _transmission(material: Material) -> dict[str, dict[str, Any]]:
    if not material.transmission:
        return {}
    color = [float(value) for value in material.transmission_color]
    return {_TRANSMISSION: {"diffuseTransmissionFactor": float(material.transmission), "diffuseTransmissionColorFactor": color}}


def write_tree(scene: trimesh.Scene, path: str | Path) -> list[Path]:
    """Write a tree as GLB (one file) or as OBJ with an MTL of the same stem, by the ending of ``path``; Y up, meters.

    A GLB stores the arrays bit for bit, except v: glTF counts it downwards, and 1 - v is rounded to float32. An OBJ has nine digits, enough
    to restore every float32. The same scene gives the same bytes.

    An MTL holds the linear color as Kd: neither Wavefront's description nor Blender converts it. Its other values make Blender's
    importer create the same surface as from the GLB, but an opaque one: MTL has no diffuse transmission.

    Returns
    -------
    list[Path]
        The files written, the model first.

    Raises
    ------
    InputError
        If the path has another ending; if the scene has no triangles, a geometry without texture coordinates or PBR material, or is too
        large for a GLB; if the disk is full or the folder cannot be written to. No partial file is left.
    MissingFileError
        If the folder does not exist.
    """
    path = check_model_path("tree", path)
    _check(scene)
    if path.suffix.lower() == ".glb":
        size = sum(_VERTEX_BYTES * len(mesh.vertices) + _TRIANGLE_BYTES * len(mesh.faces) for mesh in scene.geometry.values())
        if size > _GLB_LIMIT:
            fail("tree", f"{path} would have {size:,} bytes, more than a GLB can have", "grow less detail or write an .obj")
        write_bytes(path, glb_of_scene(scene, lambda tree: _complete(tree, scene)))
        return [path]
    library = path.with_suffix(".mtl")
    write_bytes(library, _mtl(scene).encode())  # what is referred to before what refers to it
    write_pieces(path, _obj(scene, library.name))
    return [path, library]


def _check(scene: trimesh.Scene) -> None:
    if not any(len(getattr(mesh, "faces", ())) for mesh in scene.geometry.values()):
        fail("scene", "it has no triangles")
    for name, mesh in scene.geometry.items():
        visual = getattr(mesh, "visual", None)
        if getattr(visual, "uv", None) is None or not hasattr(getattr(visual, "material", None), "roughnessFactor"):
            fail("scene", f"{name} has no texture coordinates or no PBR material", "use trimesh's own export for scenes of other kinds")


def _base_color(mesh: Any) -> list[float]:
    """Linear RGBA: unrounded if the material still has the color that the tree was grown with, otherwise the material's."""
    factor = mesh.visual.material.baseColorFactor
    shown = [1.0] * 4 if factor is None else (np.asarray(factor) / 255).tolist()
    full = mesh.metadata.get(_COLOR, shown[:3])
    close = max(abs(a - b) for a, b in zip(full, shown[:3], strict=True)) < 0.501 / 255
    return [*(full if close else shown[:3]), shown[3]]


def _complete(tree: dict[str, Any], scene: trimesh.Scene) -> None:
    """Add the scene's name, the unrounded colors and the transmitted light to the glTF."""
    (stage,) = tree["scenes"]
    extras = stage.pop("extras", {})
    if "name" in extras:
        stage["name"] = extras["name"]
    for mesh in tree["meshes"]:
        (primitive,) = mesh["primitives"]
        material, geometry = tree["materials"][primitive["material"]], scene.geometry[mesh["name"]]
        material.setdefault("pbrMetallicRoughness", {})["baseColorFactor"] = _base_color(geometry)
        if _TRANSMISSION in geometry.metadata:
            material["extensions"] = {_TRANSMISSION: geometry.metadata[_TRANSMISSION]}
            tree["extensionsUsed"] = [_TRANSMISSION]


def _mtl(scene: trimesh.Scene) -> str:
    """One material for each geometry, with the geometry's name.

    Blender reads the roughness from Pr; for other programs, Ns is the same roughness in Blender's mapping. In Blender, a Ks of 0.5 is
    the 4% reflectance of a dielectric with Ni 1.5.
    """
    lines = [f"# {generator()}"]
    for name, mesh in scene.geometry.items():
        red, green, blue, alpha = _base_color(mesh)
        roughness = mesh.visual.material.roughnessFactor
        roughness = 1.0 if roughness is None else roughness
        lines += [
            f"newmtl {name}",
            f"Kd {red:.9g} {green:.9g} {blue:.9g}",
            "Ks 0.5 0.5 0.5",
            f"Ns {1000 * (1 - roughness) ** 2:.9g}",
            "Ni 1.5",
            f"Pr {roughness:.9g}",
            "Pm 0",
            f"d {alpha:.9g}",
            "illum 2",
        ]
    return "\n".join(lines) + "\n"


def _obj(scene: trimesh.Scene, library: str) -> Iterator[bytes]:
    """The OBJ in pieces: one object for each node, at its place in the scene."""
    yield f"# {generator()}, meters, Y up\nmtllib {library}\n".encode(errors="surrogateescape")
    first = 1
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not np.array_equal(transform, np.eye(4)):
            mesh = mesh.copy(include_cache=True)  # the normals
            mesh.apply_transform(transform)
        yield f"o {node}\n".encode()
        yield from _lines("v %.9g %.9g %.9g\n", mesh.vertices)
        yield from _lines("vt %.9g %.9g\n", mesh.visual.uv)
        yield from _lines("vn %.9g %.9g %.9g\n", mesh.vertex_normals)
        yield f"usemtl {name}\n".encode()
        yield from _lines("f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.repeat(mesh.faces + first, 3, axis=1))
        first += len(mesh.vertices)


def _lines(form: str, values: NDArray[Any]) -> Iterator[bytes]:
    """Rows of numbers as lines of text."""
    for start in range(0, len(values), _ROWS):
        rows = np.asarray(values[start : start + _ROWS]) + 0  # turns -0 into 0
        yield (form * len(rows) % tuple(rows.ravel().tolist())).encode()
