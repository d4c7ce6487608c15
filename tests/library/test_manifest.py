"""``library.json``: what was written is read again, and anything else is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.lod import LodLevel
from bbfit.files import write_json
from bbfit.library.manifest import LIBRARY_FILE, AtlasPage, LevelScore, Library, LibraryTree, Screen, read_library


def level(name: str, number: int) -> LodLevel:
    values = (8, 40, 20, 1000, 0.1, 0.9, 1.0, 30.0, None, 0.0, 0.01, f"trees/{name}_LOD{number}.glb", 10.0, 20.0, 0.1, 0.1, number)
    return LodLevel(f"{name}_LOD{number}", *values)  # type: ignore[arg-type]


def small_library(folder: Path) -> Library:
    """A library of two trees, whose files have a byte each."""
    trees = tuple(
        LibraryTree(
            name,
            species,
            None if species is None else 3,
            (-1.0, 0.0, -1.0),
            (1.0, 4.5, 1.0),
            (level(name, 0), level(name, 1)),
            (None, LevelScore(20.0, 25.5, 0.2, 640)),
            {"fit": 1.5},
        )
        for name, species in (("acer_3", "acer"), ("mine", None))
    )
    page = AtlasPage(("trees/atlas.png", "trees/atlas.ktx2"), 64, 32, 0.5, 3, 2)
    library = Library(folder, Screen(1080, 50.0), page.files, trees, (page,), {"bad": "tree: it is damaged"}, {"packing": 0.5})
    for file in (*library.atlas, *(each.file for tree in trees for each in tree.levels)):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_bytes(b".")
    write_json(folder / LIBRARY_FILE, library.document())
    return library


def test_what_is_written_is_read(tmp_path: Path) -> None:
    library = small_library(tmp_path)
    again = read_library(tmp_path)
    assert again == library and again.tree("mine").height == 4.5
    with pytest.raises(InputError, match="has no tree oak; it has acer_3, mine"):
        again.tree("oak")


def test_a_cut_picture_of_the_atlas_is_named(tmp_path: Path) -> None:
    small_library(tmp_path)
    (tmp_path / "trees" / "atlas.png").write_bytes(b"..")
    with pytest.raises(InputError, match=r"atlas\.png and .* has not the size that library\.json lists"):
        read_library(tmp_path)


def test_a_list_without_newer_fields_is_read(tmp_path: Path) -> None:
    small_library(tmp_path)
    content = json.loads((tmp_path / LIBRARY_FILE).read_text())
    for name in ("pages", "failures", "seconds"):
        del content[name]
    for tree in content["trees"]:
        del tree["scores"], tree["seconds"]
        for entry in tree["levels"]:
            del entry["halvings"]
    (tmp_path / LIBRARY_FILE).write_text(json.dumps(content))
    library = read_library(tmp_path)
    assert library.pages == () and library.trees[0].scores == () and library.trees[0].levels[1].halvings == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.clear(),
        lambda content: content.update(version=2),
        lambda content: content.update(trees=[]),
        lambda content: content.update(trees=[content["trees"][0]] * 2),
        lambda content: content.update(atlas=["../secret.png"]),
        lambda content: content.update(atlas=["trees/none.png"]),
        lambda content: content.update(pages=[{}]),
        lambda content: content.update(failures={"oak": 3}),
        lambda content: content["screen"].update(height="tall"),
        lambda content: content["trees"][0].update(low=[0, 0, "x"]),
        lambda content: content["trees"][0].update(levels=3),
        lambda content: content["trees"][0].update(scores=[{"psnr": 1}]),
        lambda content: content["trees"][0]["scores"][1].update(psnr=float("inf")),
        lambda content: content["trees"][0]["levels"][0].update(file="/etc/passwd"),
        lambda content: content["trees"][0]["levels"][0].update(planes="8"),
    ],
)
def test_damage_is_one_line(change: Callable[[dict[str, Any]], None], tmp_path: Path) -> None:
    small_library(tmp_path)
    content = json.loads((tmp_path / LIBRARY_FILE).read_text())
    change(content)
    (tmp_path / LIBRARY_FILE).write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"^library: [^\n]+$"):
        read_library(tmp_path)


def test_a_folder_without_the_list_is_no_library(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^library: .*library\.json"):
        read_library(tmp_path)
    with pytest.raises(MissingFileError, match="does not exist"):
        read_library(tmp_path / "none")
