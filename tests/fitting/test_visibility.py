"""What cameras see of points that hide each other."""

from __future__ import annotations

import math

import torch

from bbfit.fitting.visibility import seen_indices, visibility
from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit


def ring(side: int = 64) -> Camera:
    """Cameras on a ring around a ball of radius 1."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double().numpy()
    return Orbit(12).frame(corners, target=torch.zeros(3, dtype=torch.float64), width=side, height=side)


def ball(count: int) -> torch.Tensor:
    """Points that fill a ball of radius 1 evenly."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return points * torch.rand(count, 1, generator=generator, dtype=torch.float64) ** (1 / 3)


def test_a_thin_tree_is_seen_whole_and_a_dense_one_from_outside() -> None:
    points, cameras = ball(20_000), ring()
    radius = points.norm(dim=-1)
    thin, dense = (visibility(points, area, cameras) for area in (0.01, 60.0))
    assert 0.98 < float(thin.min()) <= float(thin.max()) <= 1
    inner, outer = (float(dense[where].mean()) for where in (radius < 0.4, radius > 0.9))
    assert outer > 5 * inner and 0 <= float(dense.min()) and float(dense.max()) <= 1


def test_one_leaf_before_another_hides_as_much_as_the_law_says() -> None:
    """The farther of two points in a pixel is dimmed by what the nearer one hides of the pixel: half of its area."""
    camera = ring()[0]
    towards = torch.nn.functional.normalize(camera.position, dim=0)
    near, far = 0.5 * towards, -0.5 * towards
    area = 0.02  # square meters, of both together
    small = camera.resized(96, 96)
    share = float(small.intrinsics[0, 0] / (camera.position - near).norm()) ** 2 * area / 2 / 2
    both = visibility(torch.stack([far, near]), area, camera.batch())
    assert both[1] == 1 and abs(float(both[0]) - math.exp(-share)) < 1e-9


def test_points_are_chosen_where_they_are_seen() -> None:
    points, cameras = ball(20_000), ring()
    seen = visibility(points, 60.0, cameras)
    chosen = seen_indices(seen, 4_000, seed=3)
    assert chosen.shape == (4_000,) and len(chosen.unique()) == 4_000
    outside = points.norm(dim=-1) > 0.8
    assert float(outside[chosen].double().mean()) > 1.4 * float(outside.double().mean())
    assert torch.equal(chosen, seen_indices(seen, 4_000, seed=3))
    assert not torch.equal(chosen, seen_indices(seen, 4_000, seed=4))
