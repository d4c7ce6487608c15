"""Fields of trees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.checks import InputError
from bbfit.viewing.field import MAX_TREES, plant

# A tree that is 2 m wide, 3 m high, 4 m deep, and does not stand on its origin.
BOUNDS = np.array([[4.0, 1.0, -7.0], [6.0, 4.0, -3.0]])
FOOT = np.array([5.0, 1.0, -5.0])
UP, ACROSS = np.array([0.0, 3.0, 0.0]), np.array([1.0, 0.0, 0.0])


def moved(field: NDArray[np.float32], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a point of the model is in each tree, [N, 3]: scaled, turned about +Y, shifted."""
    x, y, z, yaw, scale = field.astype(np.float64).T
    turned = [np.cos(yaw) * point[0] + np.sin(yaw) * point[2], np.full(len(yaw), point[1]), np.cos(yaw) * point[2] - np.sin(yaw) * point[0]]
    return np.stack([x, y, z], -1) + scale[:, None] * np.stack(turned, -1)


def test_every_tree_stands_on_the_ground_upright_and_apart() -> None:
    field = plant(400, BOUNDS)
    feet, tops = moved(field, FOOT), moved(field, FOOT + UP)
    np.testing.assert_allclose(feet[:, 1], 1.0, atol=1e-4)
    np.testing.assert_allclose(tops - feet, field[:, 4:] * UP, atol=1e-4)
    away = np.linalg.norm(feet[:, None] - feet[None], axis=-1) + 1e9 * np.eye(400)
    assert away.min() > 1.05 * 4.0 * (1 - 2 * 0.35) - 1e-3  # neighbors on the grid that are both shaken towards each other
    assert np.ptp(feet[:, 0]) <= 20 * 1.05 * 4.0


def test_the_first_tree_is_the_tree_itself() -> None:
    field = plant(9, BOUNDS)
    np.testing.assert_allclose(moved(field, FOOT)[0], FOOT, atol=1e-5)
    np.testing.assert_allclose(moved(field, FOOT + ACROSS)[0], FOOT + ACROSS, atol=1e-5)


def test_a_seed_gives_the_same_field_and_another_seed_another() -> None:
    one, same, other = plant(50, BOUNDS, seed=3), plant(50, BOUNDS, seed=3), plant(50, BOUNDS, seed=4)
    np.testing.assert_array_equal(one, same)
    assert (one[1:] != other[1:]).all()
    assert len(np.unique(one[:, 4])) == 50


@pytest.mark.parametrize("count", [1, 2, 7, MAX_TREES])
def test_there_are_as_many_trees_as_requested(count: int) -> None:
    assert plant(count, BOUNDS).shape == (count, 5)


@pytest.mark.parametrize("count", [0, MAX_TREES + 1])
def test_other_numbers_are_refused(count: int) -> None:
    with pytest.raises(InputError, match="trees"):
        plant(count, BOUNDS)
