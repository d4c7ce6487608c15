"""Fields of trees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.checks import InputError
from bbfit.viewing.field import MOST, Field, plant

# A tree that is 2 m wide, 3 m high, 4 m deep, and does not stand on its origin.
BOUNDS = np.array([[4.0, 1.0, -7.0], [6.0, 4.0, -3.0]])
FOOT = np.array([5.0, 1.0, -5.0])
UP, ACROSS = np.array([0.0, 3.0, 0.0]), np.array([1.0, 0.0, 0.0])


def moved(field: Field, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a point of the model is in each tree, [N, 3]: scaled, turned by the quaternion, shifted."""
    w, x, y, z = field.wxyzs.astype(np.float64).T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
    return field.positions + field.scales[:, None] * (rotation @ point)


def test_every_tree_stands_on_the_ground_upright_and_apart() -> None:
    field = plant(400, BOUNDS)
    feet, tops = moved(field, FOOT), moved(field, FOOT + UP)
    np.testing.assert_allclose(feet[:, 1], 1.0, atol=1e-4)
    np.testing.assert_allclose(tops - feet, field.scales[:, None] * UP, atol=1e-4)
    away = np.linalg.norm(feet[:, None] - feet[None], axis=-1) + 1e9 * np.eye(400)
    assert away.min() > 1.05 * 4.0 * (1 - 2 * 0.35) - 1e-3  # neighbors on the grid that are both shaken towards each other
    assert np.ptp(feet[:, 0]) <= field.side


def test_the_first_tree_is_the_tree_itself() -> None:
    field = plant(9, BOUNDS)
    np.testing.assert_allclose(moved(field, FOOT)[0], FOOT, atol=1e-5)
    np.testing.assert_allclose(moved(field, FOOT + ACROSS)[0], FOOT + ACROSS, atol=1e-5)


def test_a_seed_gives_the_same_field_and_another_seed_another() -> None:
    one, same, other = plant(50, BOUNDS, seed=3), plant(50, BOUNDS, seed=3), plant(50, BOUNDS, seed=4)
    np.testing.assert_array_equal(one.positions, same.positions)
    assert (one.positions[1:] != other.positions[1:]).any()
    assert len(np.unique(one.scales)) == 50


@pytest.mark.parametrize("count", [1, 2, 7, MOST])
def test_there_are_as_many_trees_as_asked_for(count: int) -> None:
    field = plant(count, BOUNDS)
    assert len(field) == len(field.positions) == len(field.wxyzs) == count


@pytest.mark.parametrize("count", [0, MOST + 1])
def test_other_numbers_are_refused(count: int) -> None:
    with pytest.raises(InputError, match="trees"):
        plant(count, BOUNDS)
