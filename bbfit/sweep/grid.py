"""Grids of configurations: what is varied, in which combinations."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from bbfit.checks import InputError, check_file, fail
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.sweep.config import SweepConfig

VARIANT = "variant"
"""The label that tells which of a grid's variants a cell is of."""
_BUILT_IN = Path(__file__).with_name("grids")
_FIELDS = {entry.name for entry in fields(FitConfig)}


@dataclass(frozen=True)
class Cell:
    """One configuration of a grid."""

    labels: Mapping[str, str]
    """What sets it apart from the others: the variant, if the grid has any, and a value for each axis."""
    config: ResolvedFit
    """What to fit."""


@dataclass(frozen=True)
class Grid:
    """Every variant with every combination of the axes' values."""

    fit: Mapping[str, Any] = field(default_factory=dict)
    """Fields of :class:`~bbfit.fitting.config.FitConfig` that all cells share."""
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Named settings of several fields at once."""
    axes: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    """Fields and the values that each takes."""
    trees: tuple[str, ...] = ()
    """Species to grow if no trees are given."""

    def __post_init__(self) -> None:
        for name, values in self.axes.items():
            if not values:
                fail("grid", f"axis {name} has no values", "give at least one, or leave it out")
            if len(set(values)) < len(values):
                fail("grid", f"axis {name} has a value twice", "give each once")
        for settings in (self.fit, self.axes, *self.variants.values()):
            for name in settings:
                if name not in _FIELDS:
                    fail("grid", f"{name!r} is no option of a fit", f"there are {', '.join(sorted(_FIELDS))}")

    @staticmethod
    def load(name: str) -> Grid:
        """A built-in grid by its name, or one from a YAML file with the keys ``fit``, ``variants``, ``axes`` and ``trees``, each optional.

        Raises
        ------
        MissingFileError, InputError
            if there is no such grid, or the file is no grid.
        """
        known = sorted(path.stem for path in _BUILT_IN.glob("*.yaml"))
        if name not in known and not name.endswith((".yaml", ".yml")):
            fail("grid", f"{name!r} is neither built in nor a .yaml file", f"built in are {', '.join(known)}")
        path = _BUILT_IN / f"{name}.yaml" if name in known else check_file("grid", name)
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            fail("grid", f"{path} is not valid YAML ({' '.join(str(error).split())})", "see bbfit/sweep/grids/thesis.yaml for one that is")
        return _grid(content, path)

    def narrowed(self, config: SweepConfig) -> Grid:
        """The same grid with the axes and variants that a sweep was asked for.

        Raises
        ------
        InputError
            if a variant is asked for that there is not.
        """
        axes = dict(self.axes)
        for name in ("loss", "billboards"):
            if values := getattr(config, name):
                axes[name] = tuple(values)
        for name in config.variants:
            if name not in self.variants:
                fail("variants", f"there is no {name!r} in this grid", f"there are {', '.join(self.variants) or 'none'}")
        variants = {name: self.variants[name] for name in config.variants} or self.variants
        return replace(self, axes=axes, variants=variants)

    def cells(self, base: FitConfig | None = None) -> list[Cell]:
        """All cells, the last axis varying fastest.

        What ``base`` sets differently from the default counts for all cells, unless it is varied.

        Raises
        ------
        InputError
            if a value is bad or values do not go together.
        """
        asked = {name: value for name in _FIELDS if (value := getattr(base or FitConfig(), name)) != getattr(FitConfig(), name)}
        cells = []
        for variant, settings in (self.variants or {"": {}}).items():
            for values in itertools.product(*self.axes.values()):
                chosen = dict(zip(self.axes, values, strict=True))
                labels = ({VARIANT: variant} if variant else {}) | {name: str(value) for name, value in chosen.items()}
                try:
                    config = FitConfig(**{**self.fit, **asked, **settings, **chosen}).resolve()
                except InputError as error:
                    fail("grid", f"{' '.join(labels.values()) or 'its one cell'}: {error}")
                cells.append(Cell(labels, config))
        return cells


def _grid(content: Any, path: Path) -> Grid:
    """A grid from what a YAML file holds."""
    content = {} if content is None else content
    shapes = {"fit": dict, "variants": dict, "axes": dict, "trees": list}
    if not isinstance(content, dict):
        fail("grid", f"{path} holds no mapping", f"expected some of the keys {', '.join(shapes)}")
    for name, value in content.items():
        if name not in shapes:
            fail("grid", f"{path} has the key {name!r}", f"expected some of {', '.join(shapes)}")
        if not isinstance(value, shapes[name]):
            fail("grid", f"{name} in {path} is no {'list' if shapes[name] is list else 'mapping'}")
    for name, value in content.get("axes", {}).items():
        if not isinstance(value, list):
            fail("grid", f"axis {name} in {path} is no list", "write the values in brackets, as in [2, 3, 4]")
    for name, value in content.get("variants", {}).items():
        if not isinstance(value, dict):
            fail("grid", f"variant {name} in {path} is no mapping", "write options in braces, as in {sides: two}")
    axes = {name: tuple(map(_hashable, value)) for name, value in content.get("axes", {}).items()}
    trees = tuple(map(str, content.get("trees", [])))
    return Grid(content.get("fit", {}), {str(name): value for name, value in content.get("variants", {}).items()}, axes, trees)


def _hashable(value: Any) -> Any:
    if isinstance(value, dict | list):
        fail("grid", f"{value!r} is no value of an option", "use variants for several options at once")
    return value
