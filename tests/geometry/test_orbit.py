"""Where an orbit's cameras stand, and that its pictures hold the whole tree."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from bbfit.checks import InputError
from bbfit.geometry.orbit import Orbit


def tree_like(count: int = 300) -> NDArray[np.float64]:
    """A lopsided cloud of vertices standing on the ground."""
    points = np.random.default_rng(0).normal(size=(count, 3)) * (1.0, 3.0, 0.4)
    return points - (0, points[:, 1].min(), 2)


def test_azimuth_zero_looks_from_z_and_ninety_from_x() -> None:
    expected = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]], dtype=torch.float64)
    assert torch.allclose(Orbit(4).directions, expected, atol=1e-15)


def test_elevation_lifts_the_camera() -> None:
    directions = Orbit(2, (30.0, -90.0)).directions
    expected = torch.tensor([[0, 0.5, 0.75**0.5], [0, -1.0, 0]], dtype=torch.float64)
    assert torch.allclose(directions, expected, atol=1e-15)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(2, dtype=torch.float64))


def test_rings_share_an_uneven_count_and_are_turned_by_half_a_step() -> None:
    angles = Orbit(8, (0.0, 20.0, 40.0)).angles_degrees
    assert angles[:, 1].tolist() == [0] * 4 + [20] * 2 + [40] * 2
    assert np.allclose(angles[:, 0], [0, 90, 180, 270, 90, 270, 0, 180])


def test_the_ring_nearest_to_the_horizon_has_three_times_its_share() -> None:
    below, level, above = (count - 1 for count in Orbit(1000, (-30.0, 0.0, 30.0)).ring_counts)  # one view of each ring is not shared out
    assert below + level + above == 997 and below == above
    assert level == pytest.approx(3 * below / math.cos(math.pi / 6) ** 0.5, abs=2)
    assert Orbit(30, (20.0,)).ring_counts == (30,)
    assert Orbit(30, (-20.0, 20.0)).ring_counts == (15, 15)


@pytest.mark.parametrize(("count", "elevations"), [(0, (0.0,)), (1, (0.0, 20.0)), (4, ()), (4, (91.0,)), (4, (float("nan"),))])
def test_bad_orbits_are_refused(count: int, elevations: tuple[float, ...]) -> None:
    with pytest.raises(InputError):
        Orbit(count, elevations)


@pytest.mark.parametrize("fov", [40.0, 120.0, None])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (80, 33), (33, 80)])
@pytest.mark.parametrize("elevations", [(0.0,), (-20.0, 10.0, 90.0)])
@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_every_vertex_is_framed_and_one_touches(
    fov: float | None, width: int, height: int, elevations: tuple[float, ...], margin: float
) -> None:
    points, target = tree_like(), torch.tensor([0.0, 4, -2], dtype=torch.float64)
    camera = Orbit(7, elevations).frame(points, target=target, width=width, height=height, fov_x_degrees=fov, margin=margin)
    assert len(camera) == 7 and camera.orthographic == (fov is None)
    pixels = camera.project(torch.from_numpy(points))
    depths = (camera.world_to_camera[:, 2, None, :3] * torch.from_numpy(points)).sum(-1) + camera.world_to_camera[:, 2, 3:]
    assert (depths > 0).all()
    size = torch.tensor([width, height], dtype=torch.float64)
    # The share of the picture between a vertex and the nearest border.
    free = torch.minimum(pixels + 0.5, size - 0.5 - pixels) / size
    assert free.min() == pytest.approx(margin, abs=1e-9)
    # All cameras look at the target from one distance.
    middle = camera.project(target[None])
    assert torch.allclose(middle, ((size - 1) / 2).expand(7, 1, 2))
    distances = (camera.position - target).norm(dim=-1)
    assert torch.allclose(distances, distances[:1].expand(7))


@pytest.mark.parametrize("fov", [40.0, None])
def test_a_line_seen_end_on_stays_in_front_of_the_camera(fov: float | None) -> None:
    line = np.array([[0.0, 0, 0], [0, 3, 0]])
    camera = Orbit(1, (90.0,)).frame(line, target=torch.tensor([0.0, 1, 0], dtype=torch.float64), width=8, height=8, fov_x_degrees=fov)
    assert torch.allclose(camera.project(torch.from_numpy(line)), torch.tensor(3.5, dtype=torch.float64))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((5, 3)), np.array([[0.0, 0, np.nan], [1, 1, 1]])])
def test_points_that_cannot_be_framed_are_refused(points: NDArray[np.float64]) -> None:
    with pytest.raises(InputError, match="check the mesh"):
        Orbit(3).frame(points, target=torch.ones(3, dtype=torch.float64), width=8, height=8)


@pytest.mark.parametrize(("fov", "margin"), [(0.0, 0.02), (171.0, 0.02), (40.0, 0.5)])
def test_bad_framing_is_refused(fov: float, margin: float) -> None:
    target = torch.zeros(3, dtype=torch.float64)
    with pytest.raises(InputError, match="expected a value in"):
        Orbit(3).frame(tree_like(), target=target, width=8, height=8, fov_x_degrees=fov, margin=margin)
