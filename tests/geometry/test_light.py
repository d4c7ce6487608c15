"""Suns and skies."""

from __future__ import annotations

import math

import pytest
import torch

from bbfit.checks import InputError
from bbfit.geometry.light import LEAST_ELEVATION, Light, direction, sky
from bbfit.geometry.orbit import Orbit


def test_direction_has_the_azimuth_of_cameras() -> None:
    torch.testing.assert_close(direction(0, 0), torch.tensor([0.0, 0, 1]).double())
    torch.testing.assert_close(direction(90, 0), torch.tensor([1.0, 0, 0]).double())
    torch.testing.assert_close(direction(20, 90), torch.tensor([0.0, 1, 0]).double())
    orbit = Orbit(8, (30.0,))
    for (azimuth, elevation), towards in zip(orbit.angles_degrees.tolist(), orbit.directions, strict=True):
        torch.testing.assert_close(direction(azimuth, elevation), towards)


@pytest.mark.parametrize("count", [1, 4, 68, 500])
def test_sky_is_even(count: int) -> None:
    """Unit vectors above the least elevation, each cap of equal area with as many, and none much nearer to another than if packed."""
    directions = sky(count, 30.0)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(count).double())
    low = math.sin(math.radians(LEAST_ELEVATION))
    assert directions[:, 1].min() > low
    torch.testing.assert_close(directions[:, 1].mean().item(), (1 + low) / 2)
    if count > 1:
        angles = torch.acos((directions @ directions.T).clamp(-1, 1)).fill_diagonal_(math.pi)
        assert angles.min() > 0.7 * math.sqrt(2 * math.pi * (1 - low) / count)
    assert directions.mean(0)[[0, 2]].norm() < 1 / count**0.5


def test_lights_are_taken_and_joined() -> None:
    lights = Light.of(torch.tensor([[0.0, 2, 0], [3, 0, 0]]), 2.5, 1.0, (1.0, 0.5, 0.25))
    torch.testing.assert_close(lights.sun_directions, torch.tensor([[0.0, 1, 0], [1, 0, 0]]).double())
    joined = Light.joined([lights[[1]], lights])
    assert len(joined) == 3 and joined.sun_directions[:, 0].tolist() == [1, 0, 1]
    assert joined.sun_colors[2].tolist() == [1.0, 0.5, 0.25] and joined.ambients.tolist() == [1, 1, 1]


def test_what_is_no_light_is_refused() -> None:
    up, one = torch.tensor([[0.0, 1, 0]]).double(), torch.ones(1).double()
    with pytest.raises(InputError, match="sun_directions: expected unit vectors"):
        Light(2 * up, one, torch.ones(1, 3).double(), one)
    with pytest.raises(InputError, match="sun_strengths: expected values of at least 0"):
        Light(up, -one, torch.ones(1, 3).double(), one)
    with pytest.raises(InputError, match="ambients: expected finite float64 values"):
        Light(up, one, torch.ones(1, 3).double(), one * math.nan)
    with pytest.raises(InputError, match="sun_colors: expected shape"):
        Light(up, one, torch.ones(2, 3).double(), one)
