"""The error of colors at a size on the screen, and the size from which it is invisible."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.color import lab2rgb
from torch import Tensor

from bbfit.evaluation.color_error import color_error, mean_color_error, share_within
from bbfit.evaluation.metrics import silhouette_distance
from bbfit.geometry.camera import Camera
from bbfit.geometry.orbit import Orbit
from bbfit.images import premultiply
from bbfit.views.view_set import ViewSet

SIDE = 32


def disc(seed: int, *, noise: float = 0.3, side: int = SIDE) -> Tensor:
    """A disc of green noise, straight alpha, [side, side, 4]."""
    across = torch.arange(side, dtype=torch.float64) - (side - 1) / 2
    alpha = (across[:, None].square() + across.square() < (0.4 * side) ** 2).double()[..., None]
    generator = torch.Generator().manual_seed(seed)
    color = torch.tensor([0.3, 0.4, 0.2]) + noise * (torch.rand(side, side, 3, generator=generator, dtype=torch.float64) - 0.5)
    return torch.cat([color, alpha], -1)


def drawn(pictures: list[Tensor], views: ViewSet) -> Callable[[Camera], Tensor]:
    """What draws one of the pictures for each camera of the views."""
    places = [camera.tolist() for camera in views.cameras.world_to_camera]
    return lambda camera: premultiply(pictures[places.index(camera.world_to_camera.tolist())])


@pytest.fixture(scope="module")
def views() -> ViewSet:
    """Three discs of noise."""
    corners = torch.tensor([[-1.0, -1, -1], [1, 1, 1]]).double()
    cameras = Orbit(3, (10.0,)).frame(corners.numpy(), target=torch.zeros(3).double(), width=SIDE, height=SIDE)
    return ViewSet.from_arrays(torch.stack([disc(seed) for seed in range(3)]), cameras)


def test_what_one_just_sees_is_a_tenth() -> None:
    """Even colors of leaves and bark 2.3 dE apart, "just noticeable" (Mahy et al. 1994).

    Measured: a mean of 0.09, over all backgrounds alike, and 0.05 at 1 dE.
    """
    generator = np.random.default_rng(0)
    errors = []
    for _ in range(12):
        lab, step = generator.uniform((20, -25, 0), (80, 10, 40)), generator.normal(size=3)
        colors = [torch.from_numpy(lab2rgb(values)) for values in (lab, lab + 2.3 * step / np.linalg.norm(step))]
        errors.append(color_error(*(torch.cat([color.expand(40, 40, 3), torch.ones(40, 40, 1)], -1) for color in colors)))
    assert np.mean(errors) == pytest.approx(0.1, abs=0.02)


def test_colors_count_although_the_silhouette_is_the_same() -> None:
    target, other = premultiply(disc(0)), premultiply(disc(0) * torch.tensor([1.0, 0.7, 1.0, 1.0]))
    assert silhouette_distance(target.numpy(), other.numpy()) == 0
    assert color_error(target, target) == 0 == color_error(torch.zeros_like(target), torch.zeros_like(target))
    assert color_error(target, other) > 0.1
    # What lies beside the tree does not change it.
    wider = [torch.nn.functional.pad(picture, (0, 0, 20, 20, 20, 20)) for picture in (target, other)]
    assert color_error(*wider) == pytest.approx(color_error(target, other), abs=0.01)


def test_the_share_is_the_largest_at_which_no_view_differs_visibly(views: ViewSet) -> None:
    draw = drawn([disc(seed) for seed in (0, 7, 8)], views)  # the first is as it should be
    errors = [mean_color_error(draw, views, share) for share in (1.0, 0.5, 0.25)]
    assert errors[0] > errors[1] > errors[2] > 0
    most = errors[1]
    share = share_within(draw, views, most)
    assert 0.4 < share < 1 and mean_color_error(draw, views, share) <= most < mean_color_error(draw, views, share * 2**0.25)
    assert share_within(draw, views, most, share=0.3) == 0.3 and share_within(draw, views, 1.0) == 1
    assert share_within(draw, views.take([0]), 0.02) == 1  # but for rounding


def test_a_share_stays_above_nothing(views: ViewSet) -> None:
    """Where even a pixel differs, the share is that of a pixel."""
    draw = drawn([disc(seed) * torch.tensor([0.0, 0, 0, 1]) for seed in range(3)], views)
    assert 0.5 / SIDE < share_within(draw, views, 1e-9) <= 1 / SIDE
