"""Where the copies of a tree stand."""

from __future__ import annotations

import numpy as np
import pytest

from bbfit.frames.config import FramesConfig
from bbfit.frames.fields import planted

BOUNDS = ((-1.0, 0.5, -2.0), (2.0, 4.5, 1.0))
CONFIG = FramesConfig(width=320, height=180, elevation_degrees=20.0)


@pytest.mark.parametrize(("count", "pixels"), [(1, 30), (7, 100), (500, 30), (500, 400)])
def test_the_middle_of_every_copy_is_in_the_picture(count: int, pixels: int) -> None:
    field = planted(BOUNDS, pixels, count, CONFIG)
    matrices = field.matrices.reshape(count, 4, 4).transpose(0, 2, 1).astype(np.float64)
    middles = matrices @ [0.5, 2.5, -0.5, 1.0]
    np.testing.assert_allclose(middles[:, 1], 0, atol=1e-5)
    assert field.meters_high == pytest.approx(180 * 4 / pixels)
    assert np.abs(middles[:, 0]).max() <= field.meters_high * 320 / 180 / 2
    assert np.abs(middles[:, 2]).max() * np.sin(np.radians(20)) <= field.meters_high / 2
    turns = matrices[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-6)
    np.testing.assert_allclose(turns[:, 1], np.broadcast_to([0.0, 1.0, 0.0], (count, 3)), atol=1e-6)
    assert np.linalg.norm(middles[:, :3], axis=1).max() < field.reach


def test_a_field_covers_the_picture_evenly_and_depends_on_the_seed_alone() -> None:
    field = planted(BOUNDS, 30, 2000, CONFIG)
    places = field.matrices[:, [12, 14]]
    counts = np.histogram2d(*places.T, bins=4)[0]
    assert counts.min() > 0.7 * 2000 / 16
    np.testing.assert_array_equal(planted(BOUNDS, 30, 2000, CONFIG).matrices, field.matrices)
    assert not np.array_equal(planted(BOUNDS, 30, 2000, FramesConfig(width=320, height=180, seed=1)).matrices, field.matrices)
