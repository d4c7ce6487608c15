"""Grids of configurations: the options that a sweep varies, and their combinations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import yaml

from bbfit.checks import InputError, check_file, fail
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.inputs import reading
from bbfit.sweep.config import SweepConfig

VARIANT = "variant"
"""The label of a cell that contains the name of its variant."""
_BUILT_IN = Path(__file__).with_name("grids")
_EXAMPLE = "see bbfit/sweep/grids/thesis.yaml for an example"
_LARGEST_FILE, _MOST_VALUES = 1 << 18, 100_000
_FIELDS = {entry.name for entry in fields(FitConfig)}


@dataclass(frozen=True)
class Cell:
    """One configuration of a grid."""

    labels: Mapping[str, str]
    """The variant, if the grid has any, and a value for each axis. No two cells have the same labels."""
    config: ResolvedFit
    """The configuration."""


@dataclass(frozen=True)
class Grid:
    """Every variant with every combination of the values of the axes."""

    fit: Mapping[str, Any] = field(default_factory=dict)
    """Values of :class:`~bbfit.fitting.config.FitConfig` fields that all cells share."""
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Named settings of several fields."""
    axes: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    """Fields, each with its values."""
    trees: tuple[str, ...] = ()
    """Species to grow if the sweep names no trees."""

    def __post_init__(self) -> None:
        for name, values in self.axes.items():
            if not values:
                fail("grid", f"axis {name} has no values", "give at least one, or remove the axis")
            if len(set(values)) < len(values):
                fail("grid", f"axis {name} has a value twice", "give each value once")
        for settings in (self.fit, self.axes, *self.variants.values()):
            for name in settings:
                if name not in _FIELDS:
                    fail("grid", f"{name!r} is not an option of a fit", f"the options are {', '.join(sorted(_FIELDS))}")

    @staticmethod
    def load(name: str) -> Grid:
        """Load a built-in grid, or a .yaml or .yml file with the optional keys ``fit``, ``variants``, ``axes`` and ``trees``.

        Raises ``MissingFileError`` or ``InputError`` if the grid does not exist or the file does not describe one.
        """
        built_in = sorted(path.stem for path in _BUILT_IN.glob("*.yaml"))
        if name not in built_in and not name.endswith((".yaml", ".yml")):
            fail("grid", f"{name!r} is neither built in nor a .yaml file", f"the built-in grids are {', '.join(built_in)}")
        path = _BUILT_IN / f"{name}.yaml" if name in built_in else check_file("grid", name)
        if path.stat().st_size > _LARGEST_FILE:
            fail("grid", f"{path} has {path.stat().st_size:,} bytes, more than {_LARGEST_FILE:,}", _EXAMPLE)
        with reading("grid", path, _EXAMPLE):
            try:
                return _grid(_parsed(path.read_text(encoding="utf-8")), path)
            except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
                fail("grid", f"{path} is not valid YAML ({error})", _EXAMPLE)

    def narrowed(self, config: SweepConfig) -> Grid:
        """The grid with the variants (``InputError`` if it lacks one) and the axis values that the options of a sweep select."""
        axes = dict(self.axes)
        for name in ("loss", "billboards"):
            if values := getattr(config, name):
                axes[name] = tuple(values)
        for name in config.variants:
            if name not in self.variants:
                fail("variants", f"this grid has no variant {name!r}", f"its variants are {', '.join(self.variants) or 'none'}")
        variants = {name: self.variants[name] for name in config.variants} or self.variants
        return replace(self, axes=axes, variants=variants)

    @property
    def size(self) -> int:
        """The number of cells."""
        return max(len(self.variants), 1) * math.prod(map(len, self.axes.values()))

    def cells(self, base: FitConfig | None = None, *, max_cells: int = SweepConfig.max_cells) -> list[Cell]:
        """All cells. The last axis varies fastest.

        Fields of ``base`` that differ from their defaults apply to all cells, unless the grid varies them. Raises ``InputError`` if there
        are more than ``max_cells`` cells, a value is invalid, or values contradict each other.
        """
        if self.size > max_cells:
            fail("grid", f"it has {self.size:,} cells, more than the limit of {max_cells:,}", "--max-cells raises it")
        shared = {name: value for name in _FIELDS if (value := getattr(base or FitConfig(), name)) != getattr(FitConfig(), name)}
        cells = []
        with reading("grid", "a value", _EXAMPLE):
            for variant, settings in (self.variants or {"": {}}).items():
                for values in product(*self.axes.values()):
                    chosen = dict(zip(self.axes, values, strict=True))
                    labels = ({VARIANT: variant} if variant else {}) | {
                        name: "default" if value is None else str(value) for name, value in chosen.items()
                    }
                    try:
                        config = FitConfig(**{**self.fit, **shared, **settings, **chosen}).resolve()
                    except InputError as error:
                        fail("grid", f"{' '.join(labels.values()) or 'its one cell'}: {error}")
                    cells.append(Cell(labels, config))
        return cells


def _parsed(text: str) -> Any:
    """The value of a YAML text. Names for other parts of the text must not expand to more than the file could hold itself."""
    loader = yaml.SafeLoader(text)
    node = loader.get_single_node()
    if node is None:
        return None
    if _expanded(node, {}) > _MOST_VALUES:
        raise ValueError(f"it has more than {_MOST_VALUES:,} values")
    return loader.construct_document(node)


def _expanded(node: yaml.Node, known: dict[int, float]) -> float:
    """The number of values in a node, each counted as often as it is named; infinite if it contains itself."""
    if id(node) not in known:
        known[id(node)] = math.inf
        children = node.value if isinstance(node, yaml.CollectionNode) else []
        pairs = chain.from_iterable(children) if isinstance(node, yaml.MappingNode) else children
        known[id(node)] = 1 + sum(_expanded(child, known) for child in pairs)
    return known[id(node)]


def _grid(content: Any, path: Path) -> Grid:
    """The grid that the content of a YAML file describes."""
    content = {} if content is None else content
    shapes = {"fit": dict, "variants": dict, "axes": dict, "trees": list}
    if not isinstance(content, dict):
        fail("grid", f"{path} is not a mapping", f"expected some of the keys {', '.join(shapes)}")
    for name, value in content.items():
        if name not in shapes:
            fail("grid", f"{path} has the key {name!r}", f"expected some of {', '.join(shapes)}")
        if not isinstance(value, shapes[name]):
            fail("grid", f"{name} in {path} is not a {'list' if shapes[name] is list else 'mapping'}")
    for name, value in content.get("axes", {}).items():
        if not isinstance(value, list):
            fail("grid", f"axis {name} in {path} is not a list", "write the values in brackets, as in [2, 3, 4]")
    for name, value in content.get("variants", {}).items():
        if not isinstance(value, dict):
            fail("grid", f"variant {name} in {path} is not a mapping", "write options in braces, as in {sides: two}")
    axes = {name: tuple(map(_hashable, value)) for name, value in content.get("axes", {}).items()}
    trees = tuple(map(str, content.get("trees", [])))
    return Grid(content.get("fit", {}), {str(name): value for name, value in content.get("variants", {}).items()}, axes, trees)


def _hashable(value: Any) -> Any:
    if isinstance(value, dict | list):
        fail("grid", f"{value!r} is not the value of an option", "use variants to set several options together")
    return value
