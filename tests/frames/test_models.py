"""What is drawn: models of runs, comparisons and levels of detail."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from billboard_scene import crossing_billboards, write_views

from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export
from bbfit.frames.browser import find_browser, find_modules
from bbfit.frames.config import FramesConfig
from bbfit.frames.models import drawn_models
from bbfit.reporting.comparison_tables import CompareCosts, CompareRow
from bbfit.rivals.octahedral_files import THREE_PROGRAM


def model(path: Path, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    export(crossing_billboards(), path, ExportConfig(**options))  # type: ignore[arg-type]
    return path


def test_models_come_from_files_and_folders_and_have_different_names(tmp_path: Path) -> None:
    lit, unlit = model(tmp_path / "oak.glb", material="pbr"), model(tmp_path / "oak" / "model.glb")
    models, views = drawn_models([lit, unlit.parent])
    assert [(each.name, each.kind, each.lit, each.bytes) for each in models] == [
        ("oak", "mesh", (True,), lit.stat().st_size),
        ("oak-2", "mesh", (False,), unlit.stat().st_size),
    ]
    assert views is None


def test_of_a_comparison_programs_draw_models_and_impostors(tmp_path: Path) -> None:
    """Systems with another shader and without a model are left out."""
    rows = [
        CompareRow(name, f"the {name}", CompareCosts(shader=name != "plain"), None, "", None, None)
        for name in ("plain", "octahedral", "slices")
    ]
    rows.append(CompareRow("draco", "the draco", CompareCosts(), None, "", None, None))
    for name in ("plain", "octahedral", "slices"):
        model(tmp_path / name / "model.glb")
    (tmp_path / "octahedral" / THREE_PROGRAM).write_text("")
    (tmp_path / "views").mkdir()
    held_out = write_views(tmp_path / "views", crossing_billboards(), width=32, height=32).test
    (tmp_path / "plain" / "held_out").mkdir()
    pictures = tuple(tmp_path / "plain" / "held_out" / f"{name}.png" for name in held_out.names)
    for picture in pictures:
        picture.write_bytes(b"")
    (tmp_path / "compare.json").write_text(json.dumps([row.to_json() for row in rows]))
    models, views = drawn_models([tmp_path])
    assert [(each.name, each.title, each.kind) for each in models] == [
        ("plain", "the plain", "mesh"),
        ("octahedral", "the octahedral", "impostor"),
    ]
    assert models[0].pictures == (pictures,) and models[1].pictures == ()
    assert views and views.test.names == held_out.names


@pytest.mark.parametrize("content", ["", "{}", '{"levels": [{}]}', '{"levels": 3, "config": {}}', "[1"])
def test_damaged_levels_are_one_line(content: str, tmp_path: Path) -> None:
    (tmp_path / "levels").mkdir()
    (tmp_path / "levels" / "lod.json").write_text(content)
    with pytest.raises(InputError, match=r"^[^\n]+$"):
        drawn_models([tmp_path])


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to draw"):
        drawn_models([])
    with pytest.raises(MissingFileError, match=r"gone\.glb"):
        drawn_models([tmp_path / "gone.glb"])
    with pytest.raises(InputError, match="contains no model"):
        drawn_models([tmp_path])
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    with pytest.raises(InputError, match=r"broken\.glb"):
        drawn_models([tmp_path / "broken.glb"])
    with pytest.raises(InputError, match="npm install three @babylonjs/core"):
        find_modules(FramesConfig(node_modules=tmp_path))
    with pytest.raises(MissingFileError, match="browser"):
        find_browser(tmp_path / "chromium")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"counts": (10, 5)}, "rising"),
        ({"counts": ()}, "one or more"),
        ({"tree_heights": (30, 30)}, "different"),
        ({"programs": ("unity",)}, "programs"),
        ({"elevation_degrees": 0.0}, "elevation_degrees"),
    ],
)
def test_bad_options_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        FramesConfig(**options)  # type: ignore[arg-type]
