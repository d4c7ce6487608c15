"""Trees of any format as one GLB file, thinned out if asked, by Blender."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bbfit.blender.processes import BlenderPool, require_bpy
from bbfit.checks import check_count, check_folder, fail
from bbfit.files import write_pieces
from bbfit.tree_files.tree_file import TreeFile

_PIECE = 1 << 20


def tree_as_glb(tree: str | Path | TreeFile, out: str | Path, *, triangles: int | None = None) -> Path:
    """Write a tree as one self-contained GLB file, Y up in meters, where and how large :func:`~bbfit.blender.render_views` sees it.

    What Blender's glTF exporter keeps is kept: materials, texture coordinates, textures with their alpha, and vertex colors that a
    material uses. Modifiers, shape keys and poses are applied, collections and curves turned into meshes; objects that share a mesh
    go on to share it. Only what renders is written, without cameras, lights or animations. Surfaces without a material get the
    renderer's plain one, gray or of their vertex colors. The same input gives the same bytes.

    With ``triangles`` edges are collapsed (Blender's Decimate modifier) over the whole tree at once, in one joint mesh; what is left
    of the leaves is enlarged until they cover what they did before (Cook et al., "Stochastic Simplification of Aggregate Detail",
    SIGGRAPH 2007). Leaves are told from stems by their material: none of its connected parts may be longer than a quarter of the
    tree. So where leaves and bark share a material, leaves get fewer and the crown thinner. Enlarged leaves may stick out of the
    tree's bounds a little.

    Parameters
    ----------
    tree : .glb .gltf .obj .fbx .usd .usda .usdc .usdz (Y up, or as the file says), .ply .stl .blend (Z up).
    out : the .glb file to write, in an existing folder; replaced at one go, or left as it was when anything fails.
    triangles : at most so many triangles in all, at least 1; a mesh that several objects share counts for each. None, or more than
        the tree has: all of them. Closed surfaces keep a few triangles each, so very small numbers are exceeded.

    Returns
    -------
    ``out`` as a path.

    Raises
    ------
    MissingFileError, InputError
        if the tree cannot be used, if ``out`` is no .glb, is the tree itself or cannot be written, if no triangle would be left, or
        if there is no Blender.
    BlenderError
        if Blender crashes.
    """
    if triangles is not None:
        check_count("triangles", triangles)
    tree, out = TreeFile.open(tree), Path(out)
    if out.suffix.lower() != ".glb":
        fail("out", f"{out} ends in {out.suffix or 'nothing'}", "choose a name that ends in .glb")
    check_folder("out's folder", out.parent)
    if out.is_dir():
        fail("out", f"{out} is a folder", "choose another name")
    if out.exists() and any(out.samefile(file) for file in tree.files):
        fail("out", f"{out} is the tree itself", "choose another name")
    require_bpy()
    with BlenderPool({"tree": str(tree.path.resolve())}) as pool:
        write_pieces(out, _pieces(pool.convert(triangles)))
    return out


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            yield piece
