"""Species' figures: those in the package are the published ones, and what is wrong in a file is named by its key."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import pytest

from bbfit.checks import InputError, InputTypeError, MissingFileError
from bbfit.trees.species import Species, figure_keys, figures_file, known_species, load_species

NAMES = ("quaking_aspen", "weeping_willow", "acer", "silver_birch", "black_oak", "lombardy_poplar", "douglas_fir", "apple")
OURS = {"Lobes", "LobeDepth", "BarkColor", "LeafColors"}


def packaged() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(figures_file().read_text(encoding="utf-8"))
    return content


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def in_file(species: Species, key: str) -> Any:
    """The value of a key as a file would have it."""
    return json.loads(json.dumps(getattr(species, figure_keys()[key].name)))


def test_keys_are_spelled_as_in_the_paper() -> None:
    by_field = {field.name: key for key, field in figure_keys().items()}
    assert len(by_field) == len(figure_keys()) == 43
    expected = {
        "shape": "Shape",
        "scale_v": "ScaleV",
        "ratio_power": "RatioPower",
        "base_size": "nBaseSize",
        "down_angle_v": "nDownAngleV",
        "curve_res": "nCurveRes",
        "branches": "nBranches",
        "leaves": "Leaves",
        "leaf_scale_x": "LeafScaleX",
        "tropism": "Tropism",
        "prune_width_peak": "PruneWidthPeak",
        "lobe_depth": "LobeDepth",
        "bark_color": "BarkColor",
        "leaf_colors": "LeafColors",
        "leaf_transmission": "LeafTransmission",
    }
    assert {name: by_field[name] for name in expected} == expected


@pytest.mark.parametrize("name", NAMES)
def test_packaged_figures_reach_their_fields(name: str) -> None:
    species, figures = load_species(name), packaged()[name]
    assert species.name == name
    assert figures.keys() | OURS | {"LeafTransmission"} == figure_keys().keys()
    assert {key: in_file(species, key) for key in figures} == figures
    assert len(species.leaf_colors) == 3 and len({*species.leaf_colors, species.bark_color}) == 4
    assert all(green == max(red, green, blue) for red, green, blue in species.leaf_colors)
    assert hash(species) == hash(load_species(name))


def test_known_species_are_those_in_the_file() -> None:
    assert known_species() == NAMES == tuple(name for name in packaged() if name != "_about")


def test_packaged_figures_are_the_published_ones(shared: Path) -> None:
    published = json.loads((shared / "reference/species.json").read_text(encoding="utf-8"))
    own = {name: {key: value for key, value in packaged()[name].items() if key not in OURS} for name in NAMES}
    assert own == {name: figures for name, figures in published.items() if not name.startswith("_")}


def test_lobes_are_the_paper_s_and_else_none() -> None:
    lobed = {name: (load_species(name).lobes, load_species(name).lobe_depth) for name in NAMES if load_species(name).lobes}
    assert lobed == {"quaking_aspen": (5, 0.07), "weeping_willow": (9, 0.03), "black_oak": (5, 0.1)}


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    figures = packaged()["acer"]
    for key in OURS & figures.keys():
        del figures[key]
    changed = figures | {"_note": "mine", "nBranches": [1.0, 7.0, 20, 5], "Scale": 12, "Leaves": -30, "nCurveBack": [0, 0.5, -10, 0]}
    path = write(tmp_path / "own.json", {"_about": ["any text"], "my acer": changed})
    species = load_species(None, path)
    assert species == load_species("my acer", str(path))
    assert known_species(path) == ("my acer",)
    assert species.name == "my acer"
    assert species.branches == (1, 7, 20, 5) and all(type(number) is int for number in species.branches)
    assert species.scale == 12 and type(species.scale) is float
    assert (species.leaves, species.curve_back, species.lobes, species.lobe_depth) == (-30, (0, 0.5, -10, 0), 0, 0)
    plain = replace(load_species("acer"), name="my acer", bark_color=species.bark_color, leaf_colors=species.leaf_colors)
    assert species == replace(plain, branches=(1, 7, 20, 5), scale=12, leaves=-30, curve_back=(0, 0.5, -10, 0))
    with pytest.raises(FrozenInstanceError):
        species.scale = 3  # type: ignore[misc]


def refused(species: Species, key: str, value: Any) -> str:
    """The message with which a value for a key is refused."""
    with pytest.raises(InputError) as error:
        replace(species, **{figure_keys()[key].name: value})
    return str(error.value)


@pytest.mark.parametrize("key", figure_keys())
@pytest.mark.parametrize(
    "wrong", [float("nan"), float("inf"), -float("inf"), 1e6, -1e6, 10**400, True, "1", None, {}], ids=lambda w: str(w)[:9]
)
def test_every_figure_refuses_what_is_no_fitting_number_and_names_its_key(key: str, wrong: Any) -> None:
    """As the value itself, and as each of a list's."""
    species = load_species("quaking_aspen")
    assert refused(species, key, wrong).startswith(f"{key}: expected ")
    value = in_file(species, key)
    if isinstance(value, list):
        for index, item in enumerate(value):
            path = f"{key}[{index}]" if not isinstance(item, list) else f"{key}[{index}][1]"
            broken = wrong if not isinstance(item, list) else [item[0], wrong, item[2]]
            assert refused(species, key, [*value[:index], broken, *value[index + 1 :]]).startswith(f"{path}: expected ")


@pytest.mark.parametrize(
    "key", [key for key, field in figure_keys().items() if field.type in ("PerLevel", "PerLevelWhole", "Vector", "Rgb")]
)
def test_lists_of_another_length_are_refused(key: str) -> None:
    species = load_species("quaking_aspen")
    value = in_file(species, key)
    assert refused(species, key, value[:-1]) == f"{key}: expected {len(value)} numbers, got {len(value) - 1}"
    assert refused(species, key, [*value, 0]) == f"{key}: expected {len(value)} numbers, got {len(value) + 1}"
    assert refused(species, key, []).startswith(f"{key}: expected ")


@pytest.mark.parametrize(
    ("key", "good", "bad", "message"),
    [
        ("Shape", 8, 9, "Shape: expected a value in [0, 8], got 9"),
        ("Shape", 7.0, 7.5, "Shape: expected a whole number, got 7.5"),
        ("Scale", 1000, 0, "Scale: expected a value in [0.1, 1000], got 0"),
        ("ScaleV", 12.9, 13, "ScaleV: expected less than Scale, which is 13, got 13"),
        ("Levels", 1, 0, "Levels: expected a value in [1, 4], got 0"),
        ("Levels", 2, 4, "nCurveRes[3]: expected at least 1, got 0"),
        ("Ratio", 1, 0, "Ratio: expected a value in (0, 1], got 0"),
        ("BaseSplits", -10, -11, "BaseSplits: expected a value in [-10, 10], got -11"),
        ("LobeDepth", 0.99, 1, "LobeDepth: expected less than 1, got 1"),
        ("nBaseSize", [0.99, 0, 0, 0], [0, 1.0, 0, 0], "nBaseSize[1]: expected less than 1, got 1.0"),
        ("nDownAngle", [0, -180, 180, 0], [0, 181, 0, 0], "nDownAngle[1]: expected a value in [-180, 180], got 181"),
        ("nBranches", [0, 10000, 0, 0], [1, 3.5, 0, 0], "nBranches[1]: expected a whole number, got 3.5"),
        ("nBranches", [1, 0, 0, 0], [2, 0, 0, 0], "nBranches[0]: expected 0 or 1, got 2; a tree has one trunk"),
        ("nLength", [0.1, 2, 0.1, 0], [1, 0.3, 0, 0], "nLength[2]: expected a value in (0, 100], got 0.0"),
        ("nLengthV", [0, 0.3, 0, 9], [0, 0.4, 0, 0], "nLengthV[1]: expected at most nLength[1], which is 0.3, got 0.4"),
        ("nSplitAngle", [180, 0, 0, 0], [-1, 0, 0, 0], "nSplitAngle[0]: expected a value in [0, 180], got -1"),
        ("nCurveRes", [1, 1, 1, 0], [1, 0, 1, 0], "nCurveRes[1]: expected at least 1, got 0"),
        ("nCurveV", [-720, 720, 0, 0], [721, 0, 0, 0], "nCurveV[0]: expected a value in [-720, 720], got 721"),
        ("nRadiusMod", [0.01, 100, 1, 1], [0, 1, 1, 1], "nRadiusMod[0]: expected a value in (0, 100], got 0"),
        ("LeafBend", 0, 1.5, "LeafBend: expected a value in [0, 1], got 1.5"),
        ("PruneWidthPeak", 0.01, 0, "PruneWidthPeak: expected a value in (0, 1], got 0"),
        ("PruneWidthPeak", 0.99, 1, "PruneWidthPeak: expected less than 1, got 1"),
        ("BarkColor", [0, 1, 0.5], [0, 1.5, 0], "BarkColor[1]: expected a value in [0, 1], got 1.5"),
        ("LeafColors", [[0, 0, 0]] * 16, [], "LeafColors: expected 1 to 16 colors, got 0"),
        ("LeafColors", [[0, 0, 0]], [[0, 0, 0]] * 17, "LeafColors: expected 1 to 16 colors, got 17"),
        ("LeafColors", [(1, 1, 1)], [[0, 0]], "LeafColors[0]: expected 3 numbers, got 2"),
    ],
)
def test_ranges(key: str, good: Any, bad: Any, message: str) -> None:
    species = load_species("quaking_aspen")
    assert in_file(replace(species, **{figure_keys()[key].name: good}), key) == json.loads(json.dumps(good))
    assert refused(species, key, bad) == message


def test_errors_are_type_errors_where_the_type_is_wrong() -> None:
    species = load_species("acer")
    with pytest.raises(InputTypeError, match=r"^nCurve: expected a list of 4 numbers, got 'x'$"):
        replace(species, curve="x")
    with pytest.raises(InputTypeError, match=r"^name: expected a text, got 3$"):
        replace(species, name=3)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("quaking_aspn", "; did you mean quaking_aspen?"),
        ("Quaking Aspen", "; did you mean quaking_aspen?"),
        ("ACER", "; did you mean acer?"),
        ("_about", ""),
        ("", ""),
    ],
)
def test_unknown_species_lists_the_known_and_the_closest(name: str, hint: str) -> None:
    with pytest.raises(InputError) as error:
        load_species(name)
    assert str(error.value) == f"species: expected one of {', '.join(NAMES)}, got {name!r}{hint}"


def test_a_name_is_needed_where_there_are_several() -> None:
    with pytest.raises(InputError, match=r"^species: .*species\.json holds 8 species; name one of quaking_aspen, weeping_willow, "):
        load_species(None)
    with pytest.raises(InputTypeError, match=r"^species: expected a name, got \['acer'\]$"):
        load_species(["acer"])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nCurveRes": None}, "keys: missing nCurveRes"),
        ({"Leaves": None, "Scale": None}, "keys: missing Scale, Leaves"),
        ({"nCurvRes": [1, 1, 1, 1]}, "keys: unknown nCurvRes (did you mean nCurveRes?)"),
        ({"leaves": 3, "Leaves": None}, "keys: unknown leaves (did you mean Leaves?); missing Leaves"),
        ({"CurveRes": 1, "qqqq": 1}, "keys: unknown CurveRes (did you mean nCurveRes?), qqqq"),
        ({"name": "x"}, "keys: unknown name"),
        ({"nCurveRes": [5, 0, 5, 0]}, "nCurveRes[1]: expected at least 1, got 0"),
        ({"Ratio": "wide"}, "Ratio: expected a number, got 'wide'"),
        ({"Ratio": float("nan")}, "Ratio: expected a value in (0, 1], got nan"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_species_and_file(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    figures = {key: value for key, value in (packaged()["apple"] | change).items() if value is not None}
    path = write(tmp_path / "own.json", {"good": packaged()["apple"], "pear": figures})
    with pytest.raises(InputError) as error:
        load_species("pear", path)
    assert str(error.value) == f"species_file: {path}: pear: {message}"
    assert load_species("good", path).levels == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("{", "is not valid JSON"),
        ("Shape = 7", "is not valid JSON"),
        ("[]", "is not an object of species"),
        ("3", "is not an object of species"),
        ("{}", "holds no species"),
        ({"_about": {}}, "holds no species"),
        ({"Shape": 7, "Scale": 3}, "is not a species but int"),
    ],
)
def test_files_of_another_layout_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    path = write(tmp_path / "own.json", content)
    for read in (lambda: load_species("acer", path), lambda: known_species(path)):
        with pytest.raises(InputError, match=rf"^species_file: .*own\.json.*{message}"):
            read()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"^species_file: .*absent\.json does not exist"):
        load_species("acer", tmp_path / "absent.json")
    with pytest.raises(InputError, match=r"^species_file: .* is not a file"):
        load_species("acer", tmp_path)
