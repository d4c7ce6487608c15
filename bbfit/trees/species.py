"""The parameters of a species, read from JSON and named after the parameters of Weber and Penn.

Names and meanings are those of J. Weber and J. Penn, "Creation and Rendering of Realistic Trees", SIGGRAPH 1995; numbers such as 4.3
below are the paper's sections. Parameters that the paper lacks come from the Blender add-on tree-gen (github.com/friggog/tree-gen),
described in its README.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, Field, dataclass, fields
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from bbfit.checks import InputError, InputTypeError, check_count, check_file, check_range, fail
from bbfit.files import read_json

LEVELS = 4
"""Largest number of levels of stems, and the length of every list by level."""
LEAF_TRANSMISSION, LEAF_TINT = 0.58, (1.29, 1.0, 1.0)
"""The part of a leaf's green light below the gloss that is transmitted, and the transmitted color over the reflected one, linear RGB.

They are those of a leaf of walnut, sample 0091 of LOPEX93 (Hosgood et al. 1994, "Leaf Optical Properties EXperiment 93", EUR 16095 EN), as
PROSPECT-D (Féret et al. 2017) reproduces it with the parameters that Helios (Bailey 2019) contains for it; their RMSE is 0.008. As linear
sRGB under D65, the leaf reflects (0.053, 0.085, 0.036) and transmits (0.033, 0.065, 0.0). PROSPECT's surface reflects 0.035 to 0.041 of
the light, which is the gloss that the material has besides. Without it, the transmitted light over the reflected is 1.81 in red and 1.41 in
green. In blue both are below that error, so green's ratio serves."""

PerLevel = tuple[float, float, float, float]
PerLevelWhole = tuple[int, int, int, int]
Vector = tuple[float, float, float]
Rgb = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Species:
    """Parameters of a species. Angles are in degrees; a field that ends in ``_v`` is the greatest random deviation of the field before it.

    A file's key is the field's name in capitalised words, with an ``n`` before it for lists by level (``curve_res`` is ``nCurveRes``,
    ``leaf_scale_x`` is ``LeafScaleX``). Lists by level are for trunk, branches, twigs, and stems on twigs.

    Raises
    ------
    InputError
        For a value out of its range, or of the wrong type; the message starts with the file's key.
    """

    name: str
    """Name in the file, such as ``quaking_aspen``."""

    shape: int
    """How the branches' length changes up the tree, 0 to 8 (4.3): 0 conical, 1 spherical, 2 hemispherical, 3 cylindrical, 4 tapered
    cylindrical, 5 flame, 6 inverse conical, 7 tend flame, 8 as the pruning envelope."""
    scale: float
    """Size of the tree in meters, in [0.1, 1000]: the length of a trunk of length 1 (4.3)."""
    scale_v: float
    """Meters, in [0, scale)."""
    levels: int
    """Levels of stems, 1 to 4; leaves grow on the last (section 3)."""
    ratio: float
    """The trunk's radius over its length, in (0, 1] (4.4)."""
    ratio_power: float
    """How much thinner a stem is than its parent, in [0, 10]: their ratio of lengths to this power (4.4)."""
    flare: float
    """How far the trunk widens at its foot, in [0, 10]: 1 doubles the radius (4.4)."""
    base_splits: int
    """Clones into which the trunk splits at the end of its first segment, -10 to 10 (4.2); negative: random, up to the absolute value."""
    lobes: int = 0
    """Bulges around the trunk's cross-section, 0 to 100 (4.4)."""
    lobe_depth: float = 0.0
    """Height of the bulges over the trunk's radius, in [0, 1) (4.4)."""

    base_size: PerLevel
    """Share of a stem, from its foot, without children, in [0, 1) (4.3; by level as in tree-gen)."""
    down_angle: PerLevel
    """Angle between a stem and its parent, in [-180, 180] (4.3). The entry after the last level is for leaves, also below."""
    down_angle_v: PerLevel
    """In [-180, 180]; negative: the angle changes evenly along the parent instead of at random (4.3)."""
    rotate: PerLevel
    """Turn about the parent from one stem to the next, in [-360, 360]; negative: they alternate between its left and right, at
    this angle from the side to which a positive ``curve`` bends it (4.3)."""
    rotate_v: PerLevel
    """In [-360, 360]."""
    branches: PerLevelWhole
    """Largest number of stems of a level on one parent, 0 to 10000 (4.3). The first entry, for the trunk, must be 0 or 1."""
    length: PerLevel
    """Length over that of the parent, for the trunk over the scale, in [0, 100], above 0 in the levels that grow (4.3)."""
    length_v: PerLevel
    """In [0, 100], at most the length itself in the levels that grow."""
    taper: PerLevel
    """How the radius falls off, in [0, 3]: 0 not at all, 1 to a point, 2 to a round end, 3 as a row of spheres (4.4)."""
    seg_splits: PerLevel
    """Clones into which a stem splits at the end of each segment, on average, in [0, 10] (4.2)."""
    split_angle: PerLevel
    """Angle between clones, in [0, 180] (4.2)."""
    split_angle_v: PerLevel
    """In [0, 180]."""
    curve_res: PerLevelWhole
    """Segments of a stem, 0 to 100, at least 1 in the levels that grow (4.1)."""
    curve: PerLevel
    """Turn from a stem's foot to its tip, in [-360, 360] (4.1)."""
    curve_back: PerLevel
    """Where not 0, the turn of the stem's upper half, and ``curve`` that of the lower, in [-360, 360] (4.1)."""
    curve_v: PerLevel
    """In [-720, 720], divided among the segments; negative: the stem is a helix of this angle (4.1)."""
    bend_v: PerLevel
    """Largest random sideways turn from foot to tip, in [-360, 360], divided among the segments (tree-gen)."""
    branch_dist: PerLevel
    """Arrangement of stems on their parent, in [0, 20]: 0 singly, 1 in pairs, n in whorls of n + 1 (tree-gen)."""
    radius_mod: PerLevel
    """Factor on a level's radii, in (0, 100] (tree-gen)."""

    leaves: int
    """Largest number of leaves on a stem of the last level, -10000 to 10000; negative: a fan of leaves at its tip (4.5)."""
    leaf_shape: int
    """0 default, 1 ovate, 2 linear, 3 cordate, 4 maple, 5 palmate, 6 spiky oak, 7 rounded oak, 8 elliptic, 9 rectangle, 10 triangle
    (tree-gen)."""
    leaf_scale: float
    """Length of a leaf in meters, in [0.01, 10] (4.5)."""
    leaf_scale_x: float
    """Width of a leaf over its length, in [0.05, 10] (4.5)."""
    leaf_bend: float
    """How far leaves turn toward the light, in [0, 1]: up and away from the trunk (4.9)."""

    tropism: Vector
    """Pull on the stems along x, y and z, each in [-20, 20], with z up in the figures; the z part acts from the third level on; the
    paper has only this part (4.8)."""
    prune_ratio: float
    """How fully branches are cut to the envelope, in [0, 1] (4.6)."""
    prune_width: float
    """Radius of the envelope over the tree's height, in [0, 10] (4.6)."""
    prune_width_peak: float
    """Where the envelope is widest, as a share of its height from its foot, in (0, 1) (4.6)."""
    prune_power_low: float
    """Curvature of the envelope below its widest place, in [0, 100]: below 1 convex, above 1 concave (4.6)."""
    prune_power_high: float
    """The same above it."""

    bark_color: Rgb = (0.12, 0.09, 0.065)
    """Linear RGB reflectance, each in [0, 1]."""
    leaf_colors: tuple[Rgb, ...] = ((0.09, 0.2, 0.03), (0.13, 0.25, 0.035), (0.17, 0.29, 0.045))
    """One to 16 tones of the leaves, each linear RGB in [0, 1]: the light that a leaf reflects and transmits."""
    leaf_transmission: float = LEAF_TRANSMISSION
    """Share of that light that leaves transmit, in [0, 1]; they reflect the rest. 0 is an opaque leaf."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InputTypeError(f"name: expected a text, got {self.name!r}")
        for key, field in figure_keys().items():
            object.__setattr__(self, field.name, _read(key, field, getattr(self, field.name)))
        if self.scale_v >= self.scale:
            fail("ScaleV", f"expected less than Scale, which is {self.scale:g}, got {self.scale_v:g}")
        if self.branches[0] > 1:
            fail("nBranches[0]", f"expected 0 or 1, got {self.branches[0]}", "a tree has one trunk")
        if self.base_splits and self.curve_res[0] < 2:
            fail("nCurveRes[0]", "expected at least 2 for a trunk with BaseSplits, which are at the end of its first segment, got 1")
        for level in range(self.levels):
            check_count(f"nCurveRes[{level}]", self.curve_res[level])
            check_range(f"nLength[{level}]", self.length[level], 0, _BOUNDS["length"][1], open_low=True)
            if self.length_v[level] > self.length[level]:
                wanted = f"at most nLength[{level}], which is {self.length[level]:g}"
                fail(f"nLengthV[{level}]", f"expected {wanted}, got {self.length_v[level]:g}")


# Fields by their lowest and highest value; by level the same for all.
_RANGES: dict[tuple[float, float], str] = {
    (0, 1): "ratio lobe_depth base_size leaf_bend prune_ratio prune_width_peak bark_color leaf_colors leaf_transmission",
    (0, 3): "taper",
    (0, 8): "shape",
    (0, 10): "ratio_power flare seg_splits leaf_shape prune_width",
    (0, 20): "branch_dist",
    (0, 100): "lobes length length_v curve_res radius_mod prune_power_low prune_power_high",
    (0, 180): "split_angle split_angle_v",
    (0, 1000): "scale_v",
    (0, 10_000): "branches",
    (0.01, 10): "leaf_scale",
    (0.05, 10): "leaf_scale_x",
    (0.1, 1000): "scale",
    (1, LEVELS): "levels",
    (-10, 10): "base_splits",
    (-20, 20): "tropism",
    (-180, 180): "down_angle down_angle_v",
    (-360, 360): "rotate rotate_v curve curve_back bend_v",
    (-720, 720): "curve_v",
    (-10_000, 10_000): "leaves",
}
_BOUNDS = {name: bounds for bounds, names in _RANGES.items() for name in names.split()}
_MORE_THAN_LOW = {"ratio", "radius_mod", "prune_width_peak"}
_LESS_THAN_HIGH = {"lobe_depth", "base_size", "prune_width_peak"}
_MOST_COLORS = 16
# How many unknown keys a message names.
_MOST_NAMED = 10


def figure_keys() -> dict[str, Field[Any]]:
    """Map each key of a species file to its field of ``Species``, in the order of the fields."""
    keys = {}
    for field in fields(Species):
        if field.name != "name":
            words = "".join(word.capitalize() for word in field.name.split("_"))
            keys["n" * (field.type in ("PerLevel", "PerLevelWhole")) + words] = field
    return keys


def _read(key: str, field: Field[Any], value: Any) -> Any:
    """Convert ``value`` to the type of ``field``; check every number against the field's bounds."""
    if field.type in ("int", "float"):
        return _number(key, field, value)
    if field.name == "leaf_colors":
        colors = _items(key, value, range(1, _MOST_COLORS + 1), "colors")
        return tuple(tuple(_numbers(f"{key}[{index}]", field, color, 3)) for index, color in enumerate(colors))
    return tuple(_numbers(key, field, value, LEVELS if key[0] == "n" else 3))


def _numbers(key: str, field: Field[Any], value: Any, count: int) -> Iterable[float]:
    items = _items(key, value, range(count, count + 1), "numbers")
    return (_number(f"{key}[{index}]", field, item) for index, item in enumerate(items))


def _items(key: str, value: Any, counts: range, what: str) -> list[Any] | tuple[Any, ...]:
    wanted = f"{counts[0]} {what}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} {what}"
    if not isinstance(value, list | tuple):
        raise InputTypeError(f"{key}: expected a list of {wanted}, got {value!r}")
    if len(value) not in counts:
        fail(key, f"expected {wanted}, got {len(value)}")
    return value


def _number(key: str, field: Field[Any], value: Any) -> float:
    """``value`` within the field's bounds, as an ``int`` where the field takes whole numbers and else as a ``float``."""
    low, high = _BOUNDS[field.name]
    check_range(key, value, low, high, open_low=field.name in _MORE_THAN_LOW)
    if field.name in _LESS_THAN_HIGH and value == high:
        fail(key, f"expected less than {high:g}, got {value!r}")
    if field.type not in ("int", "PerLevelWhole"):
        return float(value)
    if value != int(value):
        fail(key, f"expected a whole number, got {value!r}")
    return int(value)


def figures_file() -> Path:
    """Path of the packaged species file, a template for your own."""
    return Path(str(files("bbfit.trees") / "species.json"))


def known_species(path: str | Path | None = None) -> tuple[str, ...]:
    """Names of the species in the packaged file, or in the file ``path`` of the same format."""
    return tuple(_entries(path)[1])


def load_species(name: str | None, path: str | Path | None = None) -> Species:
    """Load the species ``name`` from the packaged file, or from a file of the same format.

    ``name`` may be ``None`` if the file holds a single species.

    Raises
    ------
    InputError
        If the name is unknown; if the file is missing, empty, not JSON or of another format; if parameters are missing, unknown or invalid,
        which the message names.
    """
    if name is not None and not isinstance(name, str):
        raise InputTypeError(f"species: expected a name, got {name!r}")
    path, entries = _entries(path)
    if name is None and len(entries) == 1:
        name = next(iter(entries))
    if name is None:
        fail("species", f"{path} holds {len(entries)} species", f"name one of {', '.join(entries)}")
    if name not in entries:
        fail("species", f"expected one of {', '.join(entries)}, got {name!r}", _suggestion(name, entries))
    try:
        return _species(name, entries[name])
    except InputError as error:
        raise type(error)(f"species_file: {path}: {name}: {error}") from error


def _entries(path: str | Path | None) -> tuple[Path, dict[str, dict[str, Any]]]:
    """Path of the file, and its species before they are checked."""
    path = check_file("species_file", figures_file() if path is None else path)
    content = read_json("species_file", path)
    layout = 'expected {"name": {"Shape": 7, ...}, ...}'
    if not isinstance(content, dict):
        fail("species_file", f"{path} is not an object of species", layout)
    entries = {name: entry for name, entry in content.items() if not name.startswith("_")}
    if not entries:
        fail("species_file", f"{path} holds no species", layout)
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            fail("species_file", f"{name} in {path} is not a species but {type(entry).__name__}", layout)
    return path, entries


def _species(name: str, entry: dict[str, Any]) -> Species:
    expected = figure_keys()
    figures = {key: value for key, value in entry.items() if not key.startswith("_")}
    suggestions = {key: _suggestion(key, expected) for key in [key for key in figures if key not in expected][:_MOST_NAMED]}
    unknown = [f"{key} ({suggestion})" if suggestion else key for key, suggestion in suggestions.items()]
    missing = [key for key, field in expected.items() if key not in figures and field.default is MISSING]
    problems = [f"{what} {', '.join(keys)}" for what, keys in (("unknown", unknown), ("missing", missing)) if keys]
    if problems:
        fail("keys", "; ".join(problems))
    return Species(name=name, **{expected[key].name: value for key, value in figures.items()})


def _suggestion(word: str, known: Iterable[str]) -> str:
    """``did you mean X?``, or an empty text if no known word is similar."""
    by_spelling = {"".join(filter(str.isalnum, name.lower())): name for name in known}
    close = get_close_matches("".join(filter(str.isalnum, word.lower())), by_spelling, 1, 0.7)
    return f"did you mean {by_spelling[close[0]]}?" if close else ""
