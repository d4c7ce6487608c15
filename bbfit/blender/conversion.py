"""Convert a tree of any format to one GLB file with Blender, thinned out on request."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bbfit.blender.pictures import tree_settings
from bbfit.blender.processes import BlenderPool, require_bpy
from bbfit.checks import check_count, check_folder, check_output_file, fail
from bbfit.files import write_bytes, write_pieces
from bbfit.tree_files.gltf_materials import transmits, with_transmission
from bbfit.tree_files.tree_file import TreeFile

_PIECE = 1 << 20


def tree_as_glb(tree: str | Path | TreeFile, out: str | Path, *, triangles: int | None = None) -> Path:
    """Write a tree as one self-contained GLB file, Y up in meters, at the place and size of :func:`~bbfit.blender.render_views`.

    The file has everything that Blender's glTF exporter supports: materials, texture coordinates, textures with their alpha, and the vertex
    colors that a material uses. Leaves of a glTF also keep their diffuse transmission. Modifiers, shape keys and poses are applied.
    Collections and curves become meshes. Objects that share a mesh still share it. The file contains only what renders, without cameras,
    lights and animations. Surfaces without a material get the renderer's plain material, gray or in their vertex colors. The same input
    gives the same bytes.

    ``triangles`` thins the tree out, as one joined mesh. Bark and foliage share the triangles by the areas that one sees. Where they have
    too many parts, whole leaves and twigs go. The leaves that stay are evenly spread, and large parts of the bark, such as the trunk, are
    more likely to stay than small ones. Then edges collapse (Blender's Decimate modifier), and leaves are enlarged until they have their
    former area (Cook et al., "Stochastic Simplification of Aggregate Detail", SIGGRAPH 2007). A material counts as foliage if none of its
    connected components is longer than a quarter of the tree. If leaves and bark share a material, the tree loses leaves and its crown
    gets sparser. Enlarged leaves can extend slightly beyond the bounds of the tree.

    Parameters
    ----------
    tree
        A .glb, .gltf, .obj, .fbx, .usd, .usda, .usdc or .usdz file (Y up unless the file says otherwise), or a .ply, .stl or .blend file
        (Z up).
    out
        The .glb file to write, in an existing folder. It is replaced atomically. If anything fails, it stays as it was.
    triangles
        The largest number of triangles, at least 1. A shared mesh counts once for each of its objects. ``None`` keeps all triangles.
        Closed surfaces keep a few triangles each, so the result can exceed very small numbers.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    MissingFileError, InputError
        If the tree cannot be used. If ``out`` is not a .glb, is the tree itself or cannot be written. If no triangle would remain. If
        Blender is not installed.
    BlenderError
        If Blender crashes.
    """
    if triangles is not None:
        check_count("triangles", triangles)
    tree, out = TreeFile.open(tree), Path(out)
    check_converted(tree, out)
    require_bpy()
    with BlenderPool(tree_settings(tree)) as pool:
        path = pool.convert(triangles)
        if transmits(tree):
            write_bytes(out, with_transmission(path.read_bytes(), tree))
        else:
            with path.open("rb") as file:
                write_pieces(out, iter(partial(file.read, _PIECE), b""))
    return out


def check_converted(tree: TreeFile, out: Path) -> None:
    """Require that a tree can be written to ``out``. Raises ``MissingFileError`` or ``InputError``."""
    if out.suffix.lower() != ".glb":
        fail("out", f"{out} ends in {out.suffix or 'nothing'}", "choose a name that ends in .glb")
    check_folder("out's folder", out.parent)
    check_output_file("out", out)
    if out.exists() and any(out.samefile(file) for file in tree.files):
        fail("out", f"{out} is the tree itself", "choose another name")
