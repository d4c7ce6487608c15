"""A tree on disk as a value: all of its files, one digest over them, and its triangles on demand."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from bbfit.checks import check_file, fail
from bbfit.inputs import InputLimits, reading
from bbfit.provenance import digest_files
from bbfit.tree_files.blend import blend_files
from bbfit.tree_files.extent import check_box, check_finite
from bbfit.tree_files.fbx import fbx_files
from bbfit.tree_files.gltf import read_gltf
from bbfit.tree_files.mesh_checks import check_obj, check_stl
from bbfit.tree_files.obj import obj_files
from bbfit.tree_files.pictures import check_pictures
from bbfit.tree_files.ply import check_ply
from bbfit.tree_files.usd import usd_files

if TYPE_CHECKING:
    import trimesh

logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what trimesh says of damaged files is in the errors that it raises
_LIMITS = InputLimits()
UpAxis = Literal["y", "z"]
UP_AXES: dict[str, UpAxis] = {
    **dict.fromkeys((".glb", ".gltf", ".obj", ".fbx", ".usd", ".usda", ".usdc", ".usdz"), "y"),
    **dict.fromkeys((".ply", ".stl", ".blend"), "z"),
}
"""The formats of trees, and the axis that points up in each. An FBX or a USD file can declare another axis, which its importer uses."""
_REFERENCES = {".obj": obj_files, ".fbx": fbx_files, ".blend": blend_files}
_REFERENCES |= dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), usd_files)
_CHECKS = {".obj": check_obj, ".ply": check_ply, ".stl": check_stl}
# Files that trees refer to and that are not pictures.
_NO_PICTURES = (*UP_AXES, ".mtl", ".bin")
GLTF_SUFFIXES = (".glb", ".gltf")
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
"""The formats whose triangles can be read without Blender."""
Y_UP_MESHES = (".glb", ".gltf", ".obj")
"""Those whose triangles are drawn as they are: they have Y up, and materials."""


@dataclass(frozen=True)
class TreeFile:
    """A tree on disk, opened and checked once by :meth:`open`. Trees with the same digest have the same contents."""

    files: tuple[Path, ...]
    """All files of the tree: the main file first, then the files that it refers to."""
    digest: str
    """SHA-256 over the contents of all files (:func:`bbfit.provenance.digest_files`)."""
    bytes: int
    """Total size of the files."""

    @staticmethod
    def open(tree: str | Path | TreeFile, limits: InputLimits = _LIMITS) -> TreeFile:
        """Find the files of a tree, check them, and compute the digest. This loads no geometry.

        Parameters
        ----------
        tree
            The path of a .glb, .gltf, .obj, .fbx, .usd, .usda, .usdc, .usdz, .ply, .stl or .blend file. A ``TreeFile`` is returned
            unchanged.
        limits
            What the tree may refer to, and how large it may be.

        Raises
        ------
        MissingFileError
            If the file is missing, or a file that a glTF refers to.
        InputError
            If the file is empty, of an unknown format, or damaged. If it exceeds ``limits``, or refers to a file outside its folder that
            they do not allow. If a glTF, PLY or STL has vertices that are NaN, infinite, or in other ways not those of a tree in meters.
            Blender's importers would silently replace some of them by 0.
        """
        if isinstance(tree, TreeFile):
            return tree
        path = check_file("tree", tree)
        suffix = path.suffix.lower()
        if suffix not in UP_AXES:
            fail("tree", f"{path} has an unknown format", f"expected one of {' '.join(UP_AXES)}")
        limits.at_most("max_input_bytes", "tree", path, path.stat().st_size, "bytes")
        others = list[Path]()
        if suffix in (".glb", ".gltf"):
            others = read_gltf(path, limits)
        elif suffix in _REFERENCES:
            with reading("tree", path, "export the tree again"):
                others = _REFERENCES[suffix](path, limits)
                check_pictures(path, [other for other in others if other.suffix.lower() not in _NO_PICTURES], limits)
        if suffix in _CHECKS:
            _CHECKS[suffix](path, limits)
        files = (path, *others)
        size = sum(file.stat().st_size for file in files)
        limits.at_most("max_input_bytes", "tree", path, size, "bytes")
        return TreeFile(files, digest_files(files, path.parent), size)

    @property
    def path(self) -> Path:
        """The main file."""
        return self.files[0]

    @property
    def suffix(self) -> str:
        """The suffix of the main file in lower case, such as ``.glb``."""
        return self.path.suffix.lower()

    @property
    def up_axis(self) -> UpAxis:
        """The axis that points up in the file."""
        return UP_AXES[self.suffix]

    @property
    def is_mesh(self) -> bool:
        """Whether the triangles can be read without Blender."""
        return self.suffix in MESH_SUFFIXES

    @cached_property
    def vertices(self) -> int:
        """The number of vertices of :meth:`mesh`, whose errors are raised."""
        return len(self.mesh().vertices)

    def check_is_mesh(self) -> None:
        """Require that the triangles can be read without Blender."""
        if not self.is_mesh:
            fail("tree", f"only Blender can read the triangles of {self.path}", f"give one of {' '.join(MESH_SUFFIXES)}, or no tree")

    def scene(self) -> trimesh.Scene:
        """The meshes of the tree with their materials, in the axes and the order of the file. Vertices are not merged.

        Raises
        ------
        InputError
            If only Blender can read the format, if the file cannot be read, or if it has no triangles.
        """
        scene = self._scene()
        with reading("tree", self.path, "expected a mesh"):
            for mesh in scene.geometry.values():
                material = getattr(mesh.visual, "material", None)
                for texture in (*vars(material).values(), *getattr(material, "_data", {}).values()) if material is not None else ():
                    if hasattr(texture, "load"):
                        texture.load()  # trimesh reads no more than the header
        return scene

    def _scene(self) -> trimesh.Scene:
        """:meth:`scene` without its textures, which are not decoded."""
        import trimesh

        self.check_is_mesh()
        with reading("tree", self.path, "expected a mesh"), np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", "string or file could not be read to its end")  # from which trimesh would make half a mesh
            scene = trimesh.load_scene(self.path, process=False)
            for name in [name for name, mesh in scene.geometry.items() if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces)]:
                scene.delete_geometry(name)  # points, lines, and empty meshes
            for mesh in scene.geometry.values():
                if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
                    raise ValueError("a face refers to a vertex that it does not have")
                check_finite(self.path, mesh.vertices)
            if not scene.geometry or not scene.area > 0:
                fail("tree", f"{self.path} has no triangles", "expected a mesh")
            check_box(self.path, *scene.bounds)
            return scene

    def mesh(self) -> trimesh.Trimesh:
        """All triangles of the tree as one mesh in the axes of the file, without materials. Raises the errors of :meth:`scene`."""
        import trimesh

        scene = self._scene()
        with reading("tree", self.path, "expected a mesh"):
            for mesh in scene.geometry.values():
                mesh.visual = trimesh.visual.ColorVisuals()
            return scene.to_mesh()
