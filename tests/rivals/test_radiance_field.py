"""A radiance field: what its grid and its rays do, how it looks like what it has learned, and that its file holds all of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from impostor_scene import CENTER, RADIUS, seen

from bbfit.checks import InputError
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics
from bbfit.geometry.orbit import Orbit
from bbfit.images import unpremultiply
from bbfit.rivals.radiance_field import RadianceField, learn_radiance_field
from bbfit.rivals.voxel_grid import VoxelGrid
from bbfit.views.view_set import ViewSet


def some_grid() -> VoxelGrid:
    """About a third of 5 x 6 x 7 cells of 0.5 m."""
    return VoxelGrid(np.random.default_rng(2).random((5, 6, 7)) < 0.35, np.array([1.0, -2.0, 0.5]), 0.5)


def linear(grid: VoxelGrid) -> torch.Tensor:
    """Values at the corners that are linear in their places in meters, [P, 2]."""
    places = torch.from_numpy(grid.start + grid.side * grid.vertices).float()
    return torch.stack([places @ torch.tensor([1.0, 2.0, 3.0]), places @ torch.tensor([-2.0, 0.5, 1.0])], -1)


def test_samples_of_rays_lie_evenly_in_the_cells_that_are_there() -> None:
    grid, random = some_grid(), torch.Generator().manual_seed(0)
    rays = torch.nn.functional.normalize(torch.randn(3000, 3, generator=random), dim=-1)
    middle = torch.tensor([2.25, -0.5, 2.25])
    starts = middle + torch.rand(3000, 3, generator=random) - 0.5 - 5 * rays
    samples = grid.samples(starts, rays, 0.25, torch.rand(3000, generator=random))
    points = torch.from_numpy(grid.start + grid.side * (grid.indices[samples.cells] + samples.places.numpy())).float()
    assert (samples.rays.diff() >= 0).all() and samples.places.min() > -1e-5 and samples.places.max() < 1 + 1e-5
    away = points - starts[samples.rays]
    along = (away * rays[samples.rays]).sum(-1)
    assert (away - along[:, None] * rays[samples.rays]).norm(dim=-1).max() < 1e-5  # they lie on their rays
    steps = along.diff()[samples.rays.diff() == 0] / (0.25 * grid.side)
    assert steps.min() > 0.999 and (steps - steps.round()).abs().max() < 1e-3
    # Rays through the middle of a box meet each cell in proportion to its share; all of those that are there are met.
    assert len(samples.cells.unique()) == len(grid.indices)
    dense = torch.linspace(0, 10, 4001)[None, :, None] * rays[:50, None] + starts[:50, None]
    cells = ((dense.double() - torch.from_numpy(grid.start)) / grid.side).floor().long().numpy()
    inside = ((cells >= 0) & (cells < grid.cells.shape)).all(-1)
    length = np.where(inside, grid.cells[tuple(np.where(inside[..., None], cells, 0).transpose(2, 0, 1))], False).sum() * 10 / 4000
    assert (samples.rays < 50).sum() * 0.25 * grid.side == pytest.approx(length, rel=0.1)


def test_values_are_interpolated_linearly_and_kept_when_the_grid_is_cut_or_halved() -> None:
    grid = some_grid()
    rays = torch.tensor([[0.0, 0.6, 0.8]]).repeat(200, 1)
    starts = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([1.0, -3.0, -1.0])
    for part in (grid, VoxelGrid(grid.cells & some_grid().cells[::-1], grid.start, grid.side), grid.halved()):
        values = grid.carried(linear(grid), part)
        torch.testing.assert_close(values, linear(part), atol=1e-5, rtol=0)
        samples = part.samples(starts, rays, 1.0, torch.zeros(200))
        points = torch.from_numpy(part.start + part.side * (part.indices[samples.cells] + samples.places.numpy())).float()
        expected = torch.stack([points @ torch.tensor([1.0, 2.0, 3.0]), points @ torch.tensor([-2.0, 0.5, 1.0])], -1)
        assert len(samples.rays) > 20
        torch.testing.assert_close(torch.from_numpy(part.interpolation(samples) @ values.numpy()), expected, atol=1e-4, rtol=0)


def test_a_ray_through_fog_collects_what_the_integral_says() -> None:
    """A block of 8 x 4 x 4 cells of one color and density, from +Z through four cells, and from +X through eight."""
    grid = VoxelGrid(np.ones((8, 4, 4), bool), np.array([-2.0, -1.0, -1.0]), 0.5)
    field = RadianceField(grid, torch.tensor([255, 102, 0, 100], dtype=torch.uint8).repeat(len(grid.vertices), 1))
    density = math.log1p(math.exp(16 * 100 / 255 - 8))  # softplus, for each cell
    for towards, cells, pixels in (((0.0, 0.0, 5.0), 4, 16 * 8), ((5.0, 0.0, 0.0), 8, 8 * 8)):
        view = look_at(torch.tensor([towards], dtype=torch.float64), torch.zeros(3, dtype=torch.float64))[0]
        drawn = field.draw(Camera(view, orthographic_intrinsics(8.0, 32, 32), 32, 32, orthographic=True))
        alpha = 1 - math.exp(-density * cells)
        assert drawn[16, 16].tolist() == pytest.approx([alpha, 0.4 * alpha, 0, alpha], abs=1e-5)
        assert drawn[0, 0].tolist() == [0, 0, 0, 0]
        assert (drawn[..., 3] > 0).sum() == pixels


def ball_views(count: int, elevations: tuple[float, ...]) -> ViewSet:
    """The balls of the impostors' tests, 48 x 48 pixels."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * RADIUS * 0.7 + CENTER.numpy()
    cameras = Orbit(count, elevations).frame(corners, target=CENTER, width=48, height=48)
    return ViewSet.from_arrays(torch.stack([unpremultiply(seen(cameras[index])[0]) for index in range(len(cameras))]), cameras)


@pytest.fixture(scope="module")
def learned() -> tuple[RadianceField, list[float]]:
    losses = list[float]()
    field = learn_radiance_field(ball_views(18, (0.0, 30.0, 60.0)), steps=120, cells=64, on_step=lambda step, loss: losses.append(loss))
    return field, losses


def test_it_looks_like_the_balls_from_cameras_that_it_has_not_seen(learned: tuple[RadianceField, list[float]]) -> None:
    """PSNR of premultiplied RGBA. Measured 32.3 dB."""
    field, losses = learned
    others = ball_views(5, (15.0, 45.0))
    squares = [(field.draw(others.cameras[index]) - others.targets([index])[0]).square().mean() for index in range(len(others))]
    assert -10 * float(torch.stack(squares).mean().log10()) > 31
    assert len(losses) == 120 and np.mean(losses[-10:]) < losses[0] / 10
    assert 1 < field.samples(others.cameras[0]) < 64


def test_the_same_seed_gives_the_same_field_and_the_same_picture(learned: tuple[RadianceField, list[float]]) -> None:
    views = ball_views(6, (0.0, 40.0))
    first, again, other = (learn_radiance_field(views, steps=12, cells=32, seed=seed) for seed in (3, 3, 4))
    assert first.to_bytes() == again.to_bytes() != other.to_bytes()
    field, _ = learned
    assert torch.equal(field.draw(views.cameras[1]), field.draw(views.cameras[1]))


def test_its_file_holds_all_of_it(learned: tuple[RadianceField, list[float]]) -> None:
    field, _ = learned
    data, camera = field.to_bytes(), ball_views(4, (20.0,)).cameras[0]
    assert field.bytes == len(data)
    read = RadianceField.from_bytes(data)
    assert read.to_bytes() == data and torch.equal(read.draw(camera), field.draw(camera))
    for damaged in (b"", data[:100], b"x" * 200):
        with pytest.raises(InputError, match="damaged"):
            RadianceField.from_bytes(damaged)


def test_what_cannot_be_learned_or_drawn_is_refused(learned: tuple[RadianceField, list[float]]) -> None:
    views = ball_views(4, (20.0,))
    for options in ({"steps": 2}, {"cells": 8}, {"seed": -1}):
        with pytest.raises(InputError, match=next(iter(options))):
            learn_radiance_field(views, **options)
    with pytest.raises(InputError, match="one camera"):
        learned[0].draw(views.cameras)
