"""The stages before the fit: grow a tree, convert it, and render its views."""

from __future__ import annotations

from pathlib import Path

from bbfit.blender.config import ViewsConfig
from bbfit.blender.pictures import PICTURES_FILE, render_pictures
from bbfit.blender.request import ViewsRequest
from bbfit.blender.views_folder import render_views
from bbfit.exporting.trees import convert_tree
from bbfit.layout import REQUEST_FILE
from bbfit.outputs import output_folder
from bbfit.provenance import digest_file
from bbfit.stages.stage import OnProgress, Stage
from bbfit.tree_files.tree_file import TreeFile
from bbfit.trees.config import GrowConfig
from bbfit.trees.growth import grow
from bbfit.trees.species import Species
from bbfit.trees.tree_writer import write_tree
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

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


def convert_stage(
    folder: Path, tree: TreeFile, name: str, *, triangles: int | None = None, quantized: bool = False, stage: str = "convert"
) -> Stage:
    """Convert a tree to the GLB file ``name``: thinned out to at most ``triangles``, and with ``quantized`` vertices, on request."""

    def work(on_progress: OnProgress) -> None:
        on_progress("convert", 0, 1)
        convert_tree(tree, folder / name, triangles=triangles, quantized=quantized)
        on_progress("convert", 1, 1)

    return Stage(stage, (tree.digest, triangles, quantized), (name,), work, algorithm="convert")


def pictures_stage(folder: Path, model: Path, views: ViewDataset, config: ViewsConfig, *, stage: str) -> tuple[Stage, ViewSet, ViewSet]:
    """Render a model with the cameras of views, in their light; with its pictures of the training views and of the held-out ones.

    ``config`` has the options with which the views were rendered.
    """
    splits = (views.train, views.test)
    folders = [pictures_folder(model, name) for name in ("train", "test")]
    paths = [pictures_in(folder / out, split) for out, split in zip(folders, splits, strict=True)]

    def work(on_progress: OnProgress) -> None:
        done, total = 0, sum(map(len, splits))
        for out, split in zip(folders, splits, strict=True):

            def report(count: int, _: int, before: int = done) -> None:
                on_progress(stage, before + count, total)

            render_pictures(model, split.cameras, output_folder("out", folder / out), config, on_progress=report)
            done += len(split)

    outputs = tuple(f"{out}/{files}" for out in folders for files in ("*.png", PICTURES_FILE))
    made = Stage(stage, (digest_file(model), views.fingerprint, config), outputs, work, algorithm="views", claims=False)
    train, test = (ViewSet.of_files(own, split.cameras) for own, split in zip(paths, splits, strict=True))
    return made, train, test


def pictures_folder(model: Path, split: str) -> str:
    """The folder of a model's pictures with the cameras of a split, ``train`` or ``test``. Another model has another folder."""
    return f"{model.stem}_{digest_file(model)[:8]}/{split}"


def pictures_in(folder: Path, views: ViewSet) -> tuple[Path, ...]:
    """The pictures of all views in a folder of :func:`~bbfit.blender.pictures.render_pictures`."""
    return tuple(folder / f"{index:04}.png" for index in range(len(views)))
