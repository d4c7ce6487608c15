"""comparison.png, loss.png and pareto.png: what is in them, pixel for pixel where that can be said."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards, framed_billboards, write_views

from bbfit.budget.choice import Choice
from bbfit.budget.trials import Trial
from bbfit.checks import InputError
from bbfit.evaluation.backgrounds import over_background
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig, Placement, Sides
from bbfit.images import to_bytes
from bbfit.reporting.plots import Cost, comparison_picture, loss_plot, pareto_plot, running_mean, spread_views


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[..., ::-1]


def find(sheet: np.ndarray, picture: np.ndarray) -> tuple[int, int] | None:
    """Row and column at which a picture lies in a sheet, exactly."""
    score = cv2.matchTemplate(np.ascontiguousarray(sheet), np.ascontiguousarray(picture), cv2.TM_SQDIFF)
    row, column = np.unravel_index(score.argmin(), score.shape)
    there = sheet[row : row + len(picture), column : column + picture.shape[1]]
    return (int(row), int(column)) if (there == picture).all() else None


@pytest.mark.parametrize("width", [40, 300])
def test_comparison_holds_the_pictures_unchanged(tmp_path: Path, width: int) -> None:
    """Targets in one column, results in the next, each view a row over another background; all pixel for pixel, at any width."""
    cloud = crossing_billboards()
    views = write_views(tmp_path, cloud, width=width).test
    worse = cloud.with_texels(cloud.texels**2)
    comparison_picture(shipped_model(worse), views, tmp_path / "out.png", count=3, title="two crossing")
    sheet = read(tmp_path / "out.png")
    places = []
    for index, name in zip(spread_views(np.array([[0, 0], [90, 0], [180, 0], [270, 0]]), 3), ("white", "grass", "sky"), strict=True):
        pair = [to_bytes(torch.from_numpy(one)) for one in over_background(*held_out(shipped_model(worse).draw, views, index), name)]
        places.append([find(sheet, picture) for picture in pair])
    assert all(place is not None for row in places for place in row)
    array = np.array(places)  # [view, target or result, row or column]
    assert (array[:, 0, 0] == array[:, 1, 0]).all() and (np.diff(array[:, 0, 0]) > 32).all()
    assert (array[:, 0, 1] == array[0, 0, 1]).all() and (array[:, 1, 1] - array[:, 0, 1] > width).all()


def test_comparison_of_equal_pictures_has_a_black_difference(tmp_path: Path) -> None:
    """Rounding to bytes stays within a FLIP of 0.03 (measured 0.024): magma's first shades, (0, 0, 4) to (3, 3, 16)."""
    cloud = framed_billboards()
    views = write_views(tmp_path, cloud, width=240, height=200).test
    comparison_picture(shipped_model(cloud, ExportConfig(mipmaps=False)), views, tmp_path / "out.png", count=1)
    sheet = read(tmp_path / "out.png").astype(int)
    dark = (sheet <= (3, 3, 16)).all(-1)
    assert dark.sum() >= 240 * 200
    assert dark[:, -300:].sum() >= 240 * 200


def test_comparison_keeps_the_old_file_when_it_fails(tmp_path: Path) -> None:
    cloud = crossing_billboards()
    views = write_views(tmp_path, cloud).test
    path = tmp_path / "out.png"
    path.write_bytes(b"old")
    views.paths[0].write_bytes(views.paths[0].read_bytes()[:100])
    with pytest.raises(InputError, match="cut short"):
        comparison_picture(shipped_model(cloud), views, path)
    assert path.read_bytes() == b"old"
    with pytest.raises(InputError, match="count: expected at least 1"):
        comparison_picture(shipped_model(cloud), views, path, count=0)


def test_spread_views() -> None:
    ring = np.stack([np.arange(0, 360, 10.0), np.zeros(36)], -1)
    assert spread_views(ring, 4) == [0, 9, 18, 27]
    assert spread_views(ring[::-1], 4) == [27, 18, 9, 0]  # from the first view, at 350 degrees; in order of azimuth: 80, 170, 260, 350
    assert spread_views(ring[:3], 5) == [0, 1, 2]
    # Views that crowd on one side: each is taken once.
    assert spread_views(np.array([[0.0, 0], [1, 0], [2, 0], [200, 0]]), 3) == [0, 1, 3]
    # Of two views at one azimuth the one nearer to the horizon.
    assert spread_views(np.array([[0.0, 30], [180, 30], [180, 0]]), 2) == [0, 2]


def test_running_mean() -> None:
    values = np.array([1.0, 2, 3, np.nan, 5, 6])
    np.testing.assert_allclose(running_mean(values, 3), [1.5, 2, 2.5, 4, 5.5, 5.5])
    np.testing.assert_allclose(running_mean(values, 1), values)
    assert running_mean(np.arange(10.0), 4)[5] == (4 + 5 + 6 + 7) / 4


@pytest.mark.parametrize("losses", [[0.5], [0.5, float("nan"), 0.25], [0.0, 0.0], list(np.geomspace(1, 1e-3, 500))])
def test_loss_plot(tmp_path: Path, losses: list[float]) -> None:
    path = tmp_path / "loss.png"
    loss_plot(losses, path)
    first = path.read_bytes()
    assert read(path).shape == (600, 1080, 3)
    loss_plot(losses, path)
    assert path.read_bytes() == first
    assert [file.name for file in tmp_path.iterdir()] == ["loss.png"]


def test_loss_plot_is_logarithmic(tmp_path: Path) -> None:
    """An exponential decay is a straight line: the curve's dark pixels lie on one, to within its width."""
    loss_plot(list(np.geomspace(1, 1e-4, 1000)), tmp_path / "loss.png")
    image = read(tmp_path / "loss.png").astype(int)
    rows, columns = np.nonzero(np.abs(image - (31, 95, 139)).max(-1) < 12)
    inside = (columns > 150) & (columns < 800)  # clear of the ends of the running mean and of the legend
    slope, offset = np.polyfit(columns[inside], rows[inside], 1)
    assert slope > 0.2 and inside.sum() > 600
    assert np.abs(rows[inside] - slope * columns[inside] - offset).max() < 4


def test_loss_plot_needs_losses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="losses: expected a list of at least one number"):
        loss_plot([], tmp_path / "loss.png")
    assert not list(tmp_path.iterdir())


def trial(count: int, psnr: float, sides: Sides = "one", placement: Placement = "clusters") -> Trial:
    textures = count * (1 if sides == "one" else 2)
    return Trial(count, sides, placement, None, 4 * textures, 10_000 * count, 1.0, 30_000 * count, 20_000 * count, psnr, 1.0)


def chosen(trials: list[Trial], number: int) -> Choice:
    return Choice(FitConfig(billboards=trials[number].billboards).resolve(), tuple(trials), number, True, ("0002",))


def ring(picture: np.ndarray, panel: int, panels: int) -> tuple[float, float]:
    """Row and column of the middle of the mark around the chosen trial, in one of the panels."""
    marked = np.abs(picture.astype(int) - (200, 80, 30)).max(-1) < 12
    height, width = marked.shape[0], marked.shape[1] // panels
    marked = marked[:, panel * width : (panel + 1) * width]
    marked[height // 2 :, width // 2 :] = False  # the legend shows the mark as well
    rows, columns = np.nonzero(marked)
    assert len(rows) > 50, "the mark is covered"
    return float(rows.min() + rows.max()) / 2, float(columns.min() + columns.max()) / 2


@pytest.mark.parametrize("cost", ["vertices", "texels", "bytes"])
def test_the_front_is_drawn_once_and_the_same_each_time(tmp_path: Path, cost: Cost) -> None:
    """With a second panel for what the budget limits, if that is not vertices."""
    kinds = [trial(2, 23.0, sides, placement) for sides in ("one", "two", "pair") for placement in ("clusters", "even")]
    choice, path = chosen([trial(1, 20.0), trial(4, 25.0), trial(6, 24.0), *kinds], 1), tmp_path / "pareto.png"
    pareto_plot(choice, path, cost=cost)
    first = path.read_bytes()
    assert read(path).shape == (600, 1080 if cost == "vertices" else 1680, 3)
    pareto_plot(choice, path, cost=cost)
    assert path.read_bytes() == first and [file.name for file in tmp_path.iterdir()] == ["pareto.png"]


@pytest.mark.parametrize("cost", ["vertices", "texels", "bytes"])
def test_the_chosen_trial_is_marked_where_it_stands(tmp_path: Path, cost: Cost) -> None:
    """In every panel: three decibels up are as far from two to four as from one to two, and so is twice the cost to the right."""
    trials = [trial(1, 20.0), trial(2, 23.0), trial(4, 26.0), trial(8, 27.0)]
    panels, pictures = 1 if cost == "vertices" else 2, []
    for number in range(3):
        pareto_plot(chosen(trials, number), tmp_path / "pareto.png", cost=cost)
        pictures.append(read(tmp_path / "pareto.png"))
    for panel in range(panels):
        places = [ring(picture, panel, panels) for picture in pictures]
        (down, across), (down_again, across_again) = np.diff(np.array(places), axis=0)
        assert down < -50 and across > 50
        assert abs(down - down_again) < 2 and abs(across - across_again) < 2


@pytest.mark.parametrize("cost", ["vertices", "texels", "bytes"])
def test_each_cost_has_an_axis_of_its_own(tmp_path: Path, cost: Cost) -> None:
    """The last panel changes with the cost that it is of, and with no other."""
    trials, pictures = [trial(1, 20.0), trial(2, 23.0), trial(8, 25.0)], []
    for name in ("vertices", "texels", "bytes"):
        other = [trials[0], dataclasses.replace(trials[1], **{name: 2 * getattr(trials[1], name)}), trials[2]]
        pareto_plot(chosen(other, 0), tmp_path / "other.png", cost=cost)
        pictures.append((tmp_path / "other.png").read_bytes())
    pareto_plot(chosen(trials, 0), tmp_path / "plain.png", cost=cost)
    changed = [picture != (tmp_path / "plain.png").read_bytes() for picture in pictures]
    assert changed == [True, cost == "texels", cost == "bytes"]  # vertices are always shown


def test_a_single_trial_can_be_drawn(tmp_path: Path) -> None:
    for cost in ("vertices", "texels", "bytes"):
        pareto_plot(chosen([trial(1, 20.0)], 0), tmp_path / "pareto.png", cost=cost)
        assert read(tmp_path / "pareto.png").shape[0] == 600


def test_a_front_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "pareto.png").mkdir()
    with pytest.raises(InputError, match=r"pareto\.png cannot be written"):
        pareto_plot(chosen([trial(1, 20.0)], 0), tmp_path / "pareto.png")
    assert [path.name for path in tmp_path.iterdir()] == ["pareto.png"]
