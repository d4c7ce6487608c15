"""The stages before the fit: grow a tree, convert it, and render its views."""

from __future__ import annotations

from pathlib import Path

from bbfit.blender.config import ViewsConfig
from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.request import ViewsRequest
from bbfit.blender.views_folder import render_views
from bbfit.layout import REQUEST_FILE
from bbfit.stages.stage import OnProgress, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.config import GrowConfig
from bbfit.trees.growth import grow
from bbfit.trees.species import Species
from bbfit.trees.tree_writer import write_tree

GROW_OUTPUTS = ("tree.glb",)


def grow_stage(folder: Path, species: Species, config: GrowConfig) -> Stage:
    """Grow a tree and write ``tree.glb``."""

    def work(on_progress: OnProgress) -> None:
        on_progress("grow", 0, 1)
        scene = grow(species, seed=config.seed, detail=config.detail, leaves=config.leaves, max_vertices=config.max_vertices)
        write_tree(scene, folder / "tree.glb")
        on_progress("grow", 1, 1)

    return Stage("grow", (species, config), GROW_OUTPUTS, work)


def views_stage(folder: Path, tree: TreeFile, config: ViewsConfig) -> Stage:
    """Render the views of a tree into ``views/``. The seconds of interrupted attempts count too."""

    def work(on_progress: OnProgress) -> float:
        path = render_views(tree, folder / "views", config, on_progress=lambda done, total: on_progress("views", done, total))
        request = ViewsRequest.load(path / REQUEST_FILE)
        return request.seconds if request else 0.0

    files = (f"views/{REQUEST_FILE}", "views/transforms_*.json", "views/images/*.png")
    return Stage("views", (tree.digest, ViewsRequest.of(tree, config).config), files, work, claims=False)


def convert_stage(folder: Path, tree: TreeFile, name: str, *, triangles: int | None = None) -> Stage:
    """Convert a tree to the GLB file ``name``, decimated to at most ``triangles`` triangles unless that is ``None``."""

    def work(on_progress: OnProgress) -> None:
        on_progress("convert", 0, 1)
        tree_as_glb(tree, folder / name, triangles=triangles)
        on_progress("convert", 1, 1)

    return Stage("convert", (tree.digest, triangles), (name,), work)
