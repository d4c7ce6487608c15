"""Libraries of small trees: what they contain, that nothing is done twice, and what happens to damaged trees."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from khronos import WARNING, messages
from library_of_two import LEVELS, SMALL, TREE
from PIL import Image

from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.evaluation.backgrounds import mean_psnr
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import glb_counts
from bbfit.files import write_bytes
from bbfit.glb import split_glb
from bbfit.library import building, files
from bbfit.library.building import build_library
from bbfit.library.config import LibraryConfig
from bbfit.library.manifest import Library, read_library
from bbfit.library.shared_atlas import shared_pages
from bbfit.library.stored_cards import read_cards
from bbfit.pipeline import RunConfig
from bbfit.rendering.cards import CardRenderer
from bbfit.views.dataset import ViewDataset
from bbfit.workers.results import Results
from bbfit.workers.sources import sources
from bbfit.workers.tasks import Task


def copied(built: Library, folder: Path) -> Path:
    return Path(shutil.copytree(built.folder, folder / "out"))


def times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*")) if path.is_file()}


def again(folder: Path, config: LibraryConfig = LEVELS, stages: RunConfig = SMALL, trees: tuple[Path, ...] = (TREE,)) -> Library:
    return build_library(trees, folder, config, stages, species=["acer"], seeds=[1])


def test_the_library_lists_what_is_there(built: Library) -> None:
    assert [(tree.name, tree.species, tree.seed) for tree in built.trees] == [("acer", "acer", 1), ("tree", None, None)]
    assert read_library(built.folder) == built and built.screen.height == 1080 and not built.failures
    (page,) = built.pages
    assert (
        page.files == built.atlas
        and page.safe_mip_level == 3
        and page.bytes == sum((built.folder / file).stat().st_size for file in page.files)
    )
    picture = np.asarray(Image.open(built.folder / "trees" / "atlas.png").convert("RGBA"))
    assert picture.shape == (page.height, page.width, 4)
    for tree in built.trees:
        assert [level.planes for level in tree.levels] == [3, 2] and tree.height > 1
        assert tree.levels[0].distance_meters == 0 < tree.levels[1].distance_meters
        assert {"views", "fit", "evaluate", "join", "cards"} <= set(tree.seconds) and ("grow" in tree.seconds) == (tree.seed is not None)
        for level, score in zip(tree.levels, tree.scores, strict=True):
            data = (built.folder / level.file).read_bytes()
            assert (level.bytes, (level.vertices, level.triangles)) == (len(data), glb_counts(data))
            assert score is not None and level.psnr and score.texels % 64 == 0 and 0 < score.color_error < 1
            uris = [image["uri"] for image in split_glb(data)[0]["images"]]
            assert [f"trees/{uri}" for uri in uris] == list(page.files)
    assert sum(score.texels for tree in built.trees for score in tree.scores if score) <= page.width * page.height
    codes = {found["code"] for found in messages(*(built.folder / "trees").glob("*.glb")) if found["severity"] <= WARNING}
    assert codes <= {"VALUE_NOT_IN_LIST", "IMAGE_UNRECOGNIZED_FORMAT"}  # of KTX2, which the validator does not know
    assert "| all trees |" in (built.folder / "times.md").read_text()


def test_scores_are_those_of_the_shared_atlas(built: Library) -> None:
    """The atlas on the disk is that of the cards, and from it each level is drawn and scored again."""
    own = [(tree, level) for tree in built.trees for level in tree.levels]
    cards = [read_cards(built.folder / "work" / tree.name / "cards" / f"{level.requested}.safetensors") for tree, level in own]
    (page,) = shared_pages(cards, 8, 8192, own_levels=cards[0].chain is not None)
    np.testing.assert_array_equal(np.asarray(Image.open(built.folder / "trees" / "atlas.png").convert("RGBA")), page.image)
    for (tree, level), shared in zip(own, page.cards, strict=True):
        views = ViewDataset.load(built.folder / "work" / tree.name / "views").test
        draw = CardRenderer(shared).draw
        scores = [mean_psnr(*held_out(draw, views, index)) for index in range(len(views))]
        assert level.psnr == pytest.approx(np.mean(scores), abs=1e-6)


def test_the_contact_sheet_has_a_row_for_each_tree(built: Library) -> None:
    sheet = np.asarray(Image.open(built.folder / "contact.png").convert("RGB"))
    assert 2 * 256 < sheet.shape[0] and 3 * 256 < sheet.shape[1] < 4 * 256
    green = (sheet[..., 1].astype(int) > sheet[..., 0] + 15) & (sheet[..., 1].astype(int) > sheet[..., 2] + 15)
    for row in np.array_split(green, 2):
        assert all(cell.sum() > 100 for cell in np.array_split(row, 3, axis=1))


def test_nothing_is_done_twice(built: Library, tmp_path: Path) -> None:
    folder, told = copied(built, tmp_path), list[tuple[str, int, int]]()
    before = times(folder)
    same = build_library(
        [TREE],
        folder,
        LEVELS,
        SMALL,
        species=["acer"],
        seeds=[1],
        on_progress=lambda stage, now, total, note="": told.append((stage, now, total)),
    )
    assert replace(same, folder=built.folder) == built and times(folder) == before and told == [("trees", 2, 2)]


def test_an_encoder_that_is_installed_later_makes_trees_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With KTX2, cards have mip levels of their own."""
    source, tasks = sources([], [TREE], [])[0], list[Task]()
    workers = SimpleNamespace(submit=tasks.append)

    def key() -> object:
        return building._submitted(tmp_path, source, 0, LEVELS, SMALL, Results(tmp_path), workers)  # type: ignore[arg-type]

    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: "install it")
    without = key()
    assert without == key() and len(tasks) == 2
    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: None)
    assert key() != without


def test_what_is_lost_is_made_again_and_the_rest_is_kept(built: Library, tmp_path: Path) -> None:
    """A model, then the cards of a tree."""
    folder = copied(built, tmp_path)
    kept = times(folder / "work")
    (folder / "trees" / "tree_LOD1.glb").unlink()
    again(folder)
    assert (folder / "trees" / "tree_LOD1.glb").read_bytes() == (built.folder / "trees" / "tree_LOD1.glb").read_bytes()
    assert times(folder / "work") == kept
    (lost := folder / "work" / "tree" / "cards" / "2.safetensors").unlink()
    again(folder)
    now = times(folder / "work")
    assert lost.read_bytes() == (built.folder / "work" / "tree" / "cards" / "2.safetensors").read_bytes()
    changed = [path for path in kept if now[path] != kept[path] and path.parent.name != "cards" and not path.name.startswith(".bbfit")]
    assert {path.name for path in changed} <= {"run.json"}  # which names the views in the place of the copy


def test_a_small_page_makes_several(built: Library, tmp_path: Path) -> None:
    folder = copied(built, tmp_path)
    size = max(built.pages[0].width, built.pages[0].height) - 8
    several = again(folder, replace(LEVELS, page_size=size))
    assert len(several.pages) > 1 and all(max(page.width, page.height) <= size for page in several.pages)
    assert "trees/atlas_2.png" in several.atlas
    addresses = {
        image["uri"]
        for tree in several.trees
        for level in tree.levels
        for image in split_glb((folder / level.file).read_bytes())[0]["images"]
    }
    assert {f"trees/{uri}" for uri in addresses} == set(several.atlas)
    # Only mip levels above the safe one depend on the neighbors; cards that are seen at a grazing angle show them.
    psnrs = [[level.psnr for tree in library.trees for level in tree.levels] for library in (several, built)]
    assert psnrs[0] == pytest.approx(psnrs[1], abs=0.01)
    before = {path: path.read_bytes() for path in (folder / "trees").iterdir()}
    with pytest.raises(InputError, match="page_size: the textures of one level need"):
        again(folder, replace(LEVELS, page_size=64))
    assert {path: path.read_bytes() for path in (folder / "trees").iterdir()} == before and read_library(folder) == several
    one = again(folder)
    assert one.atlas == built.atlas and not list((folder / "trees").glob("atlas_2*"))


def test_a_damaged_tree_is_one_line_and_the_others_go_on(built: Library, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, bad = copied(built, tmp_path), tmp_path / "bad.glb"
    bad.write_bytes(b"no tree")
    found = again(folder, trees=(TREE, bad))
    assert [tree.name for tree in found.trees] == ["acer", "tree"]
    assert list(found.failures) == ["bad"] and "bad.glb is not a glTF" in found.failures["bad"]
    assert again(folder).failures == {}
    alone = tmp_path / "alone"
    assert main(["library", str(bad), "--out", str(alone), "--workers", "1"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "no tree succeeded; bad: " in lines[-1] and lines[-1].startswith("bbfit: library: ")
    assert not (alone / "library.json").exists()


def test_files_of_trees_that_are_gone_are_removed(built: Library, tmp_path: Path) -> None:
    folder = copied(built, tmp_path)
    (folder / "trees" / "mine.glb").write_bytes(b"mine")
    one = build_library([TREE], folder, LEVELS, SMALL)
    assert [tree.name for tree in one.trees] == ["tree"]
    assert {path.name for path in (folder / "trees").glob("*.glb")} == {"tree_LOD0.glb", "tree_LOD1.glb", "mine.glb"}


def test_a_library_that_was_not_finished_is_none(built: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after two files; the next start writes the same library."""
    folder, written = copied(built, tmp_path), list[Path]()
    config = replace(LEVELS, page_size=4096)

    def write(path: Path, data: bytes) -> None:
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written.append(path)
        write_bytes(path, data)

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(files, "write_bytes", write)
        again(folder, config)
    with pytest.raises(InputError, match=r"library\.json"):
        read_library(folder)
    finished = again(folder, config)
    assert [tree.levels for tree in finished.trees] == [tree.levels for tree in built.trees]
    for path in (built.folder / "trees").iterdir():
        assert (folder / "trees" / path.name).read_bytes() == path.read_bytes()


def test_a_file_of_the_user_stays(tmp_path: Path) -> None:
    """It is noticed before any work."""
    (tmp_path / "trees").mkdir()
    (mine := tmp_path / "trees" / "tree_LOD0.glb").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"tree_LOD0\.glb exists, and is a file that bbfit did not write"):
        build_library([TREE], tmp_path, LEVELS, SMALL)
    assert mine.read_bytes() == b"mine" and not (tmp_path / "work").exists()


def test_a_library_has_as_many_files_as_levels(built: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a level is left out, because it nowhere draws faster."""
    folder, made = copied(built, tmp_path), building._built

    def fewer(*args: Any) -> dict[str, Any]:
        outcomes = made(*args)
        facts = outcomes["acer"].facts
        return outcomes | {"acer": replace(outcomes["acer"], facts=facts | {"levels": facts["levels"][:-1]})}

    monkeypatch.setattr(building, "_built", fewer)
    found = again(folder)
    assert [len(tree.levels) for tree in found.trees] == [1, 2] and not (folder / "trees" / "acer_LOD1.glb").exists()
    before = times(folder)
    assert again(folder) == found and times(folder) == before


def test_the_trees_themselves_can_be_the_finest_levels(built: Library, tmp_path: Path) -> None:
    folder = copied(built, tmp_path)
    config = replace(LEVELS, original=True, thinned=(800,))
    found = build_library([TREE], folder, config, replace(SMALL, export=ExportConfig(textures="png")))
    (tree,) = found.trees
    assert [level.planes for level in tree.levels] == [None, None, 3, 2] and tree.scores[:2] == (None, None)
    assert tree.levels[0].psnr is None and tree.levels[1].psnr and tree.levels[1].triangles <= 800
    assert (folder / tree.levels[0].file).read_bytes() == TREE.read_bytes()
    outputs = json.loads((folder / "run.json").read_text())["stages"]["library"]["outputs"]
    assert {level.file for level in tree.levels} <= set(outputs)
    assert found.atlas == ("trees/atlas.png",) and json.loads((folder / "library.json").read_text())["trees"][0]["scores"][0] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"trees": []}, "library: there are no trees; give files"),
        ({"trees": [TREE, TREE]}, "two trees"),
        ({"trees": [TREE.with_name("none.glb")]}, "none.glb does not exist"),
        ({"trees": [], "species": ["oak"]}, "species: "),
        ({"trees": [TREE], "seeds": [1, 1]}, "seeds: expected different ones"),
        ({"trees": [TREE], "stages": replace(SMALL, export=ExportConfig(padding=2))}, "padding: expected at least 4"),
        ({"trees": [TREE], "stages": RunConfig(fit=replace(SMALL.fit, billboards=3))}, "billboards: planes sets"),
        ({"trees": [TREE], "stages": replace(SMALL, export=ExportConfig(mip_files=True))}, "mip_files: only bbfit run, fit, sweep and"),
        (
            {"trees": [TREE], "stages": replace(SMALL, export=ExportConfig(textures="webp")), "config": LibraryConfig(page_size=16384)},
            "page_size: WebP has at most 16383 texels",
        ),
    ],
)
def test_bad_wishes_are_refused_before_any_work(options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        build_library(options.pop("trees"), tmp_path / "out", options.pop("config", LEVELS), **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("bad", [{"planes": ()}, {"page_size": 32}, {"workers": 0}, {"error_pixels": 0.0}])
def test_bad_numbers(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        LibraryConfig(**bad)  # type: ignore[arg-type]
