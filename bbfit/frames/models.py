"""The models whose frame times are measured, read from the folders of other commands."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from bbfit.checks import check_file, check_folder, fail
from bbfit.exporting.lod import LodLevel
from bbfit.exporting.lod_files import LOD_FILE, read_levels
from bbfit.files import read_json
from bbfit.glb import gltf_parts
from bbfit.inputs import InputLimits, reading
from bbfit.lod import thinned_file
from bbfit.provenance import digest_file
from bbfit.reporting.comparison_tables import CompareRow
from bbfit.reporting.frame_tables import ModelKind
from bbfit.rivals.octahedral_files import THREE_PROGRAM
from bbfit.stages.trees import pictures_folder, pictures_in
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

_FOLDERS = "give folders of bbfit run, compare and lod, and GLB files"


@dataclass(frozen=True)
class DrawnModel:
    """A model as it is drawn."""

    name: str
    """Its short name, unique in a measurement."""
    title: str
    """What it is, for the reader."""
    kind: ModelKind
    """What it consists of."""
    files: tuple[Path, ...]
    """Its GLB files: one, or one for each level of detail, finest first."""
    distances: tuple[float, ...] = (0.0,)
    """The distance from which each is shown, over the focal length in pixels: meters for each pixel of a meter's length."""
    pictures: tuple[tuple[Path, ...], ...] = ()
    """What Blender drew of each file in the held-out views and in their light, for the files of which it did; or empty."""

    @cached_property
    def bytes(self) -> int:
        """Size of its files."""
        return sum(file.stat().st_size for file in self.files)

    @cached_property
    def lit(self) -> tuple[bool, ...]:
        """Whether a program lights each file, so that its colors are not those of the views."""
        if self.kind == "impostor":
            return (False,)
        trees = [gltf_parts(file.read_bytes(), "model", file)[0] for file in self.files]
        return tuple(not all("KHR_materials_unlit" in each.get("extensions", {}) for each in tree.get("materials", [{}])) for tree in trees)


def drawn_models(sources: Sequence[str | Path], limits: InputLimits | None = None) -> tuple[list[DrawnModel], ViewDataset | None]:
    """The models in folders of ``bbfit run``, ``compare`` and ``lod`` and in GLB files, and the first views in those folders.

    Of a comparison these are the models that programs draw as they are, and octahedral impostors. Models of one name get numbers. Raises
    MissingFileError or InputError if there is none in a folder, or if one cannot be read.
    """
    limits, models, views = limits or InputLimits(), list[DrawnModel](), None
    if not sources:
        fail("sources", "there is nothing to draw", _FOLDERS)
    for source in map(Path, sources):
        if source.suffix.lower() == ".glb" and not source.is_dir():
            models.append(_single(check_file("sources", source), source.stem))
            continue
        folder = check_folder("sources", source)
        own = ViewDataset.load(folder / "views", limits=limits) if (folder / "views").is_dir() else None
        views = views or own
        with reading("sources", folder, "start bbfit again for this folder"):
            models += _in_folder(folder, own.test if own and views and own.fingerprint == views.fingerprint else None)
    for model in models:
        with reading("model", model.files[0], "export it again"):
            _ = model.lit
    return _with_different_names(models), views


def _with_different_names(models: Sequence[DrawnModel]) -> list[DrawnModel]:
    """The models; of those with one name, all but the first get a number."""
    named = dict[str, DrawnModel]()
    for model in models:
        numbers = (f"{model.name}-{number}" for number in itertools.count(2))
        name = next(name for name in itertools.chain([model.name], numbers) if name not in named)
        named[name] = replace(model, name=name)
    return list(named.values())


def _in_folder(folder: Path, views: ViewSet | None) -> list[DrawnModel]:
    """The models of a folder. ``views`` are its held-out views, if they are those of the measurement."""
    if (folder / "levels" / LOD_FILE).is_file():
        return [_levels(folder, views)]
    if (folder / "compare.json").is_file():
        rows = [CompareRow.from_json(row) for row in read_json("comparison", folder / "compare.json")]
        models = [model for row in rows if (model := _compared(folder / row.system, row, views)) is not None]
    else:
        models = [_single(folder / "model.glb", folder.resolve().name)] if (folder / "model.glb").is_file() else []
    if not models:
        fail("sources", f"{folder} contains no model", _FOLDERS)
    return models


def _single(path: Path, name: str) -> DrawnModel:
    return DrawnModel(name, name, "mesh", (path,))


def _compared(folder: Path, row: CompareRow, views: ViewSet | None) -> DrawnModel | None:
    """A system of a comparison; ``None`` if it has no model, or one that needs a shader that bbfit does not write."""
    path, program = folder / "model.glb", folder / THREE_PROGRAM
    if not path.is_file() or (row.costs.shader and not program.is_file()):
        return None
    pictures = () if views is None else tuple(folder / "held_out" / f"{name}.png" for name in views.names)
    drawn = all(picture.is_file() for picture in pictures)
    kind: ModelKind = "impostor" if row.costs.shader else "mesh"
    return DrawnModel(row.system, row.title, kind, (path,), pictures=(pictures,) if pictures and drawn else ())


def _levels(folder: Path, views: ViewSet | None) -> DrawnModel:
    stored = read_levels(folder / "levels")
    levels = stored.levels
    names = ", ".join(level.content for level in levels)
    files = tuple(check_file("levels of detail", folder / "levels" / level.file) for level in levels)
    distances = tuple(level.distance_meters / stored.focal for level in levels)
    whole = stored.triangles is None
    pictures = () if views is None else tuple(_level_pictures(folder, level, views, whole=whole) for level in levels)
    return DrawnModel(f"{folder.resolve().name}-levels", f"levels of detail: {names}", "levels", files, distances, pictures)


def _level_pictures(folder: Path, level: LodLevel, views: ViewSet, *, whole: bool) -> tuple[Path, ...]:
    """What Blender drew of a level that takes a program's light: of the whole tree the views themselves."""
    if level.content == "tree":
        return views.paths if whole else ()
    digest = digest_file(folder / "levels" / level.file)
    thinned = [file for file in sorted(folder.glob(thinned_file("*"))) if level.planes is None and digest_file(file) == digest]
    return pictures_in(folder / pictures_folder(thinned[0], "test"), views) if thinned else ()
