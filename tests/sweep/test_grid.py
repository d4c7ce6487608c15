"""Grids: which configurations there are, and what of a file is refused."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from bbfit.checks import InputError, MissingFileError
from bbfit.evaluation.published import Experiment, published_figures
from bbfit.fitting.config import FitConfig
from bbfit.sweep.config import SweepConfig
from bbfit.sweep.grid import Grid


def test_the_thesis_grid_is_that_of_its_figure_11() -> None:
    """For each of its trees the same 24 configurations that the figure has, by the thesis's preset."""
    grid = Grid.load("thesis")
    cells = grid.cells()
    made = {
        Experiment(tree, int(cell.labels["billboards"]), cell.labels["variant"], cell.labels["loss"])
        for tree in grid.trees
        for cell in cells
    }
    assert len(cells) == 24 and made == published_figures().keys()
    for cell in cells:
        config, double, bounded = cell.config, "double" in cell.labels["variant"], "bounded" in cell.labels["variant"]
        assert (config.preset, config.steps, config.placement) == ("thesis", 10_000, "even")
        assert (config.sides, config.bounds) == ("pair" if double else "one", "thesis" if bounded else "viewport")
        assert (config.billboards, config.loss) == (int(cell.labels["billboards"]), cell.labels["loss"])


def test_the_default_grid_is_one_default_fit() -> None:
    (cell,) = Grid.load("default").cells()
    assert cell.labels == {} and cell.config == FitConfig().resolve()


def test_a_file_may_vary_any_option(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("fit: {preset: default, steps: 7}\naxes:\n  alpha: [mask, blend]\n  seed: [0, 1, 2]\n  steps: [5, 6]\n")
    cells = Grid.load(str(path)).cells()
    assert Counter(cell.labels["alpha"] for cell in cells) == {"mask": 6, "blend": 6}
    assert [(cell.config.alpha, cell.config.seed, cell.config.steps) for cell in cells[:3]] == [
        ("mask", 0, 5),
        ("mask", 0, 6),
        ("mask", 1, 5),
    ]
    assert cells[0].labels == {"alpha": "mask", "seed": "0", "steps": "5"}
    assert cells[0].config.alpha_cutoff != cells[6].config.alpha_cutoff, "presets are resolved for each cell"


def test_what_is_asked_for_on_top_counts_unless_it_is_varied() -> None:
    cells = Grid.load("thesis").cells(FitConfig(steps=40, billboards=9, seed=5))
    assert {cell.config.steps for cell in cells} == {40} and {cell.config.seed for cell in cells} == {5}
    assert {cell.config.billboards for cell in cells} == {2, 3, 4}


def test_axes_and_variants_can_be_narrowed() -> None:
    cells = Grid.load("thesis").narrowed(SweepConfig(billboards=(6,), loss=("l1",), variants=("double", "base"))).cells()
    assert [(cell.labels["variant"], cell.config.billboards, cell.config.loss) for cell in cells] == [
        ("double", 6, "l1"),
        ("base", 6, "l1"),
    ]
    with pytest.raises(InputError, match="this grid has no variant 'triple'; its variants are base, bounded, double, double bounded"):
        Grid.load("thesis").narrowed(SweepConfig(variants=("triple",)))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("axes: {bilboards: [2]}", "'bilboards' is not an option of a fit"),
        ("fit: {nonsense: 2}", "'nonsense' is not an option of a fit"),
        ("variants: {a: {nonsense: 2}}", "'nonsense' is not an option of a fit"),
        ("axes: {billboards: 2}", "axis billboards in .* is not a list"),
        ("axes: {billboards: []}", "axis billboards has no values"),
        ("axes: {billboards: [2, 2]}", "axis billboards has a value twice"),
        ("axes: {billboards: [[2]]}", r"\[2\] is not the value of an option"),
        ("axes: [2]", "axes in .* is not a mapping"),
        ("trees: acer", "trees in .* is not a list"),
        ("variants: {a: 3}", "variant a in .* is not a mapping"),
        ("axis: {}", "has the key 'axis'"),
        ("- 1", "is not a mapping"),
        ("fit: {", "is not valid YAML"),
        ("fit: !!python/object/apply:os.getcwd []", "is not valid YAML"),
        ("axes: {billboards: [2, -1]}", "grid: -1: billboards: expected at least 1, got -1"),
        ("axes: {loss: [l3]}", "grid: l3: loss: expected one of"),
    ],
)
def test_bad_grids_are_refused(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint):
        Grid.load(str(path)).cells()


def test_unknown_grids_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'thesiss' is neither built in nor a .yaml file; the built-in grids are default, thesis"):
        Grid.load("thesiss")
    with pytest.raises(MissingFileError, match="does not exist"):
        Grid.load(str(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"billboards": (0,)}, "billboards: expected at least 1"),
        ({"workers": 0}, "workers: expected at least 1"),
        ({"retries": -1}, "retries: expected at least 0"),
        ({"gpus": 1.0}, "gpus: only Ray reserves it"),
        ({"memory": "4000M"}, "memory: only Ray reserves it"),
        ({"ray": "auto", "memory": "4G"}, "memory: '4G' is no number"),
        ({"ray": "auto", "workers": 2}, "workers: on Ray the cores decide"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        SweepConfig(**options)  # type: ignore[arg-type]


def test_memory_is_read_as_budgets_are() -> None:
    assert SweepConfig(ray="auto", memory="4000M").memory_bytes == 4_000_000_000
    assert SweepConfig().memory_bytes is None
