"""Billboards that move: what the eight numbers mean, their gradient, and Adam over them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bbfit.fitting.movement import BETAS, EPSILON, Movement
from bbfit.geometry.cloud import BillboardCloud

REACH = 2.5
PLACEMENT = ("centers", "rights", "ups", "half_extents")


def uniform(*shape: int, seed: int = 0) -> Tensor:
    """Random numbers in [-1, 1], float64."""
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1


def leaning_cloud(count: int = 3) -> BillboardCloud:
    """Billboards of all orientations and sizes, float32, one of them two-sided."""
    axes = torch.linalg.qr(uniform(count, 3, 3)).Q.float()
    two_sided = torch.arange(count) == 1
    sizes = torch.tensor([[3, 2]]).repeat(count, 1)
    texels = torch.rand(6 * (count + int(two_sided.sum())), 4, generator=torch.Generator().manual_seed(0))
    return BillboardCloud(
        uniform(count, 3).float(), axes[..., 0], axes[..., 1], uniform(count, 2).abs().float() + 0.3, sizes, two_sided, texels
    )


def moved(cloud: BillboardCloud, *numbers: float) -> BillboardCloud:
    """The cloud after every billboard has moved by the same numbers."""
    parameters = torch.tensor([numbers], dtype=torch.float64).repeat(len(cloud), 1)
    return Movement(cloud, REACH).placed(parameters, cloud.texels)


def test_extents_move_as_far_in_many_steps_as_in_800() -> None:
    """A parameter of 1 in 800 steps is one of 4 in 3,200; positions and angles do not depend on the number of steps."""
    cloud, parameters = leaning_cloud(), uniform(3, 8)
    movements = Movement(cloud, REACH), Movement(cloud, REACH, steps=800), Movement(cloud, REACH, steps=3200)
    usual, same, long = (movement.placed(parameters, cloud.texels) for movement in movements)
    for name in PLACEMENT:
        assert torch.equal(getattr(usual, name), getattr(same, name))
        assert torch.equal(getattr(usual, name), getattr(long, name)) == (name != "half_extents")
    growth, slow = ((placed.half_extents / cloud.half_extents).log() for placed in (usual, long))
    torch.testing.assert_close(growth, 4 * slow)


def test_no_movement_is_the_cloud() -> None:
    cloud = leaning_cloud()
    movement = Movement(cloud, REACH)
    assert movement.parameters.shape == (3, 8) and movement.parameters.dtype == torch.float64 and not movement.parameters.any()
    now = movement.now(cloud.texels)
    for name in (*PLACEMENT, "texture_sizes", "two_sided", "texels"):
        assert torch.equal(getattr(now, name), getattr(cloud, name)), name
        assert getattr(now, name).dtype == getattr(cloud, name).dtype


def test_a_placed_cloud_has_the_given_texels_and_is_exact_to_float64() -> None:
    cloud = leaning_cloud()
    texels = torch.rand(cloud.texels.shape)
    placed = Movement(cloud, REACH).placed(uniform(3, 8), texels)
    assert placed.texels is texels
    assert all(getattr(placed, name).dtype == torch.float64 for name in PLACEMENT)
    assert torch.equal(placed.texture_sizes, cloud.texture_sizes) and torch.equal(placed.two_sided, cloud.two_sided)


def test_the_first_three_numbers_are_a_translation_in_multiples_of_reach() -> None:
    cloud = leaning_cloud()
    after = moved(cloud, 0.2, -0.4, 1.0, 0, 0, 0, 0, 0)
    torch.testing.assert_close(after.centers, cloud.centers.double() + torch.tensor([0.5, -1.0, 2.5], dtype=torch.float64))
    for name in ("rights", "ups", "half_extents"):
        torch.testing.assert_close(getattr(after, name), getattr(cloud, name).double(), atol=1e-15, rtol=0)


@pytest.mark.parametrize("vector", [(0.0, math.pi / 2, 0.0), (0.3, -0.2, 0.9), (-1.5, 2.0, 0.1), (1e-9, 0.0, 0.0)])
def test_the_next_three_numbers_turn_the_billboard_about_its_center(vector: tuple[float, float, float]) -> None:
    """By a rotation vector: about its direction, counter-clockwise seen against it, by as many radians as it is long."""
    cloud = leaning_cloud()
    after = moved(cloud, 0, 0, 0, *vector, 0, 0)
    turn = torch.tensor(Rotation.from_rotvec(np.array(vector)).as_matrix())
    assert torch.equal(after.centers, cloud.centers.double()) and torch.equal(after.half_extents, cloud.half_extents.double())
    torch.testing.assert_close(after.rights, cloud.rights.double() @ turn.mT, atol=1e-12, rtol=0)
    torch.testing.assert_close(after.ups, cloud.ups.double() @ turn.mT, atol=1e-12, rtol=0)


def test_a_quarter_turn_about_the_vertical_takes_z_to_x() -> None:
    cloud = leaning_cloud(1)
    x, y, z = torch.eye(3, dtype=torch.float32)[:, None]
    cloud = BillboardCloud(cloud.centers, z, y, cloud.half_extents, cloud.texture_sizes, cloud.two_sided, cloud.texels)
    torch.testing.assert_close(moved(cloud, 0, 0, 0, 0, math.pi / 2, 0, 0, 0).rights, x.double(), atol=1e-12, rtol=0)


def test_the_last_two_numbers_are_logarithms_of_growth_at_a_rate_of_their_own() -> None:
    cloud = leaning_cloud()
    growth = moved(cloud, 0, 0, 0, 0, 0, 0, 1.0, 0).half_extents / cloud.half_extents.double()
    share = float(growth[0, 0].log())
    assert 0 < share <= 1
    expected = torch.tensor([share, 0.0], dtype=torch.float64).exp().expand(3, 2)
    torch.testing.assert_close(growth, expected)
    after = moved(cloud, 0, 0, 0, 0, 0, 0, -0.7, 2.0)
    expected = torch.tensor([-0.7 * share, 2 * share], dtype=torch.float64).exp()
    torch.testing.assert_close(after.half_extents, cloud.half_extents.double() * expected)
    for name in ("centers", "rights", "ups"):
        torch.testing.assert_close(getattr(after, name), getattr(cloud, name).double(), atol=1e-15, rtol=0)


def test_every_billboard_moves_by_its_own_numbers() -> None:
    cloud, parameters = leaning_cloud(), uniform(3, 8)
    together = Movement(cloud, REACH).placed(parameters, cloud.texels)
    for n in range(3):
        alone = moved(cloud, *parameters[n].tolist())
        for name in PLACEMENT:
            torch.testing.assert_close(getattr(together, name)[n], getattr(alone, name)[n], atol=1e-14, rtol=0)


def test_billboards_stay_rectangles() -> None:
    cloud = leaning_cloud()
    placed = Movement(cloud, REACH).placed(5 * uniform(3, 8, seed=2), cloud.texels)
    ones = torch.ones(3, dtype=torch.float64)
    for axis in (placed.rights, placed.ups):
        torch.testing.assert_close(axis.norm(dim=-1), ones, atol=1e-6, rtol=0)  # the cloud's own are float32
    torch.testing.assert_close((placed.rights * placed.ups).sum(-1), 0 * ones, atol=1e-6, rtol=0)
    assert (placed.half_extents > 0).all()


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.5, 3.0])
def test_gradients_are_finite_differences(size: float) -> None:
    """Also without any movement, where the angle of the rotation is zero."""
    cloud = leaning_cloud(2)
    movement = Movement(cloud, REACH)

    def placement(parameters: Tensor) -> tuple[Tensor, ...]:
        placed = movement.placed(parameters, cloud.texels)
        return tuple(getattr(placed, name) for name in PLACEMENT)

    assert torch.autograd.gradcheck(placement, ((size * uniform(2, 8, seed=1)).requires_grad_(),), eps=1e-6, atol=1e-8, rtol=1e-6)


def rotations() -> dict[str, Tensor]:
    """Rotation vectors, [N, 3]: none, minute ones, on either side of where a formula gives way to its limit, and beyond half a turn."""
    directions = torch.nn.functional.normalize(uniform(24, 3, seed=4), dim=-1)
    sizes = {f"{size:g}": size for size in (0.0, 1e-160, 1e-9, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 3.0, 3.3, 5.0, 7.0)}
    sizes |= {"half a turn": math.pi, "a whole turn": 2 * math.pi}
    mixed = torch.tensor([[0.0], [1e-6], [0.3], [4.0]], dtype=torch.float64).repeat(6, 1)
    return {name: size * directions for name, size in sizes.items()} | {"of all sizes": mixed * directions}


def turned_by(vectors: Tensor) -> tuple[BillboardCloud, Movement]:
    """A cloud and its movement by rotations and anything else."""
    cloud = leaning_cloud(len(vectors))
    movement, numbers = Movement(cloud, REACH), uniform(len(vectors), 8, seed=5)
    numbers[:, 3:6] = vectors
    movement.restore({"movement": torch.stack([numbers, 0 * numbers, 0 * numbers]), "movement_steps": torch.tensor([0])})
    assert torch.equal(movement.parameters, numbers)
    return cloud, movement


def side_by_side(cloud: BillboardCloud) -> Tensor:
    return torch.cat([getattr(cloud, name) for name in PLACEMENT], -1)


@pytest.mark.parametrize("vectors", rotations().values(), ids=rotations())
def test_the_placement_is_that_of_the_placed_cloud(vectors: Tensor) -> None:
    cloud, movement = turned_by(vectors)
    found = movement.placement()
    assert found.shape == (24, 11) and found.dtype == torch.float64
    torch.testing.assert_close(found, side_by_side(movement.placed(movement.parameters, cloud.texels)), atol=1e-14, rtol=0)


@pytest.mark.parametrize("vectors", rotations().values(), ids=rotations())
def test_the_placements_gradient_is_autograds(vectors: Tensor) -> None:
    cloud, movement = turned_by(vectors)
    gradient = uniform(24, 11, seed=6)
    leaf = movement.parameters.clone().requires_grad_()
    (expected,) = torch.autograd.grad(side_by_side(movement.placed(leaf, cloud.texels)), leaf, gradient)
    placement = movement.placement()
    before, given = movement.parameters.clone(), (placement.clone(), gradient.clone())
    found = movement.pull_back(placement, gradient)
    assert found.shape == (24, 8) and found.dtype == torch.float64
    torch.testing.assert_close(found, expected, atol=2e-14, rtol=0)  # measured 5e-15
    assert torch.equal(movement.parameters, before) and torch.equal(placement, given[0]) and torch.equal(gradient, given[1])


def test_the_placement_and_its_gradient_of_no_billboards() -> None:
    movement = Movement(leaning_cloud(0), REACH)
    assert movement.placement().shape == (0, 11)
    assert movement.pull_back(movement.placement(), torch.zeros(0, 11, dtype=torch.float64)).shape == (0, 8)


def gradient_of(step: int, count: int = 4) -> Tensor:
    """Gradients of all magnitudes from 1e-6 to 10, some of them zero for a while."""
    gradient = uniform(count, 8, seed=step) * 10.0 ** torch.arange(-6, 2, dtype=torch.float64)
    return gradient * (torch.arange(count) + step % 5 > 2)[:, None]


def rate_of(step: int) -> float:
    return 0.02 * (1 + math.cos(step / 20))


def test_updates_are_torchs_adam() -> None:
    assert BETAS == (0.8, 0.95) and EPSILON == 1e-12
    movement, leaf = Movement(leaning_cloud(4), REACH), torch.zeros(4, 8, dtype=torch.float64, requires_grad=True)
    reference = torch.optim.Adam([leaf], betas=(0.8, 0.95), eps=1e-12)
    for step in range(60):
        movement.update(gradient_of(step), rate_of(step))
        reference.param_groups[0]["lr"] = rate_of(step)
        leaf.grad = gradient_of(step)
        reference.step()
        torch.testing.assert_close(movement.parameters, leaf.detach(), atol=1e-12, rtol=1e-9)
    assert movement.parameters.abs().max() > 0.1


def test_the_first_step_is_the_rate_against_the_gradient_whatever_its_size() -> None:
    movement = Movement(leaning_cloud(4), REACH)
    gradient = uniform(4, 8) * 10.0 ** torch.arange(-6, 2, dtype=torch.float64)
    movement.update(gradient, 0.01)
    torch.testing.assert_close(movement.parameters, -0.01 * gradient.sign(), atol=1e-6, rtol=0)


def test_what_gets_no_gradient_stays() -> None:
    movement = Movement(leaning_cloud(4), REACH)
    movement.update(torch.zeros(4, 8, dtype=torch.float64), 0.01)
    assert not movement.parameters.any()


def test_billboards_that_may_not_grow_move_and_shrink() -> None:
    cloud, gradient = leaning_cloud(4), torch.ones(4, 8, dtype=torch.float64)
    gradient[:2, 6:] = -1  # these would grow
    limited, free = Movement(cloud, REACH, grow=False), Movement(cloud, REACH)
    for _ in range(5):
        limited.update(gradient, 0.1)
        free.update(gradient, 0.1)
    now, other = limited.now(cloud.texels), free.now(cloud.texels)
    assert torch.equal(now.half_extents[:2], cloud.half_extents[:2].float()) and (other.half_extents[:2] > now.half_extents[:2]).all()
    assert torch.equal(now.half_extents[2:], other.half_extents[2:]) and (now.half_extents[2:] < cloud.half_extents[2:]).all()
    assert torch.equal(now.centers, other.centers) and torch.equal(now.rights, other.rights)
    gradient[:2, 6:] = 1
    for _ in range(5):
        limited.update(gradient, 0.1)
    assert (limited.now(cloud.texels).half_extents[:2] < now.half_extents[:2]).all()


def test_moving_changes_neither_the_cloud_nor_the_gradient() -> None:
    cloud, gradient = leaning_cloud(4), uniform(4, 8)
    before, given = {name: getattr(cloud, name).clone() for name in PLACEMENT}, gradient.clone()
    movement = Movement(cloud, REACH)
    movement.update(gradient, 0.1)
    now = movement.now(cloud.texels)
    assert torch.equal(gradient, given)
    for name in PLACEMENT:
        assert torch.equal(getattr(cloud, name), before[name]) and not torch.equal(getattr(now, name), before[name])
        assert getattr(now, name).dtype == torch.float32
        placed = movement.placed(movement.parameters, cloud.texels)
        assert torch.equal(getattr(now, name), getattr(placed, name).float())


def test_going_on_from_what_was_kept_is_going_on() -> None:
    cloud = leaning_cloud(4)
    whole, first = Movement(cloud, REACH), Movement(cloud, REACH)
    for step in range(30):
        whole.update(gradient_of(step), rate_of(step))
    for step in range(11):
        first.update(gradient_of(step), rate_of(step))
    kept = {name: tensor.clone() for name, tensor in first.tensors().items()}
    resumed = Movement(cloud, REACH)
    resumed.restore(kept)
    given = {name: tensor.clone() for name, tensor in kept.items()}
    for step in range(11, 30):
        resumed.update(gradient_of(step), rate_of(step))
    assert torch.equal(resumed.parameters, whole.parameters)
    for name, tensor in whole.tensors().items():
        assert torch.equal(resumed.tensors()[name], tensor), name
        assert torch.equal(kept[name], given[name])  # what was kept does not follow
    wrong = Movement(cloud, REACH)
    wrong.restore(kept | {"movement_steps": torch.tensor([0])})
    for step in range(11, 30):
        wrong.update(gradient_of(step), rate_of(step))
    assert not torch.equal(wrong.parameters, whole.parameters)  # the number of steps matters
