"""The octahedral grid: directions and places of the square, and the three frames around a direction."""

from __future__ import annotations

import pytest
import torch

from bbfit.checks import InputError
from bbfit.rivals.octahedral_grid import OctahedralGrid

GRIDS = [OctahedralGrid(frames, hemisphere) for frames in (2, 5, 8) for hemisphere in (True, False)]


def directions(hemisphere: bool, count: int = 500) -> torch.Tensor:
    """Random unit vectors, [P, 3] float64."""
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    vectors = torch.nn.functional.normalize(vectors, dim=-1)
    return torch.cat([vectors[:, :1], vectors[:, 1:2].abs() if hemisphere else vectors[:, 1:2], vectors[:, 2:]], -1)


@pytest.mark.parametrize("hemisphere", [True, False])
def test_directions_and_places_are_inverses(hemisphere: bool) -> None:
    grid, vectors = OctahedralGrid(8, hemisphere), directions(hemisphere)
    places = grid.places(vectors)
    assert (places.abs() <= 1 + 1e-12).all()
    torch.testing.assert_close(grid.towards(places), vectors)


def test_the_middle_is_up_and_the_border_the_horizon_or_down() -> None:
    half, full = OctahedralGrid(3).directions, OctahedralGrid(3, hemisphere=False).directions
    up, down = torch.tensor([0.0, 1.0, 0.0]).double(), torch.tensor([0.0, -1.0, 0.0]).double()
    torch.testing.assert_close(half[4], up)
    assert half[[0, 1, 2, 3, 5, 6, 7, 8], 1].abs().max() < 1e-12
    torch.testing.assert_close(full[4], up)
    torch.testing.assert_close(full[[0, 2, 6, 8]], down.expand(4, 3))


@pytest.mark.parametrize("grid", GRIDS)
def test_a_frames_own_direction_has_it_alone(grid: OctahedralGrid) -> None:
    """Up to frames of the same direction, which the border of a full grid has twice."""
    frames, weights = grid.nearest(grid.directions)
    most = weights.argmax(-1, keepdim=True)
    torch.testing.assert_close(weights.gather(-1, most), torch.ones_like(most, dtype=torch.float64))
    torch.testing.assert_close(grid.directions[frames.gather(-1, most)[:, 0]], grid.directions)


@pytest.mark.parametrize("grid", GRIDS)
def test_three_different_frames_with_weights_that_sum_to_one(grid: OctahedralGrid) -> None:
    """Whose places have the direction's place as their weighted mean."""
    vectors = directions(grid.hemisphere)
    frames, weights = grid.nearest(vectors)
    assert (weights >= 0).all() and (frames >= 0).all() and (frames < grid.frames**2).all()
    assert (frames.sort(-1).values.diff(dim=-1) > 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(vectors), dtype=torch.float64))
    line = torch.linspace(-1, 1, grid.frames, dtype=torch.float64)
    corners = torch.stack([line[frames % grid.frames], line[frames // grid.frames]], -1)
    torch.testing.assert_close((weights[..., None] * corners).sum(-2), grid.places(vectors))


@pytest.mark.parametrize("grid", GRIDS)
def test_weights_are_continuous_across_the_edges_of_triangles(grid: OctahedralGrid) -> None:
    """To either side of an edge, 1e-6 apart, each frame has the same weight. On the border of a full grid, where two frames have one
    direction, their weights count together."""
    generator = torch.Generator().manual_seed(1)
    first = torch.randint(grid.frames - 1, (300, 2), generator=generator)
    along = torch.rand(300, 1, generator=generator, dtype=torch.float64)
    edges = torch.cat([first + along * torch.tensor(edge, dtype=torch.float64) for edge in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))])
    vectors = grid.towards(2 * edges / (grid.frames - 1) - 1)
    step = 1e-6 * torch.randn(vectors.shape, generator=generator, dtype=torch.float64)
    same = (grid.directions @ grid.directions.mT > 1 - 1e-9).double()

    def sides(sign: int) -> tuple[torch.Tensor, torch.Tensor]:
        frames, weights = grid.nearest(torch.nn.functional.normalize(vectors + sign * step, dim=-1))
        return frames, torch.zeros(len(frames), grid.frames**2, dtype=torch.float64).scatter_add(1, frames, weights) @ same

    (one, here), (other, there) = sides(1), sides(-1)
    assert (one != other).any(-1).double().mean() > 0.3
    assert (here - there).abs().max() < 5e-5 * grid.frames


def test_directions_below_a_hemisphere_move_up_to_its_horizon() -> None:
    grid = OctahedralGrid(6)
    vectors = directions(hemisphere=False)
    level = torch.nn.functional.normalize(vectors * torch.tensor([1.0, 0.0, 1.0]), dim=-1)
    below = vectors[:, 1] < 0
    for found, expected in zip(grid.nearest(vectors[below]), grid.nearest(level[below]), strict=True):
        torch.testing.assert_close(found, expected)


def test_a_grid_has_at_least_two_frames_a_side() -> None:
    with pytest.raises(InputError, match="frames"):
        OctahedralGrid(1)
