"""Adam over blocks of texels against torch's, on texels that get gradients now and then or never."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bbfit.operators.adam.fused import AdamFused, rest_after
from bbfit.operators.adam.reference import EPSILON, alpha_loss
from bbfit.operators.drawing.fused import occupancy
from bbfit.operators.drawing.tile_forward import BLOCK

STEPS = 420
BETAS = (0.9, 0.999)
REST_AFTER = rest_after(BETAS[0])


def start(count: int) -> Tensor:
    """Random texels, a quarter each exactly transparent and opaque, in runs longer than a block."""
    generator = torch.Generator().manual_seed(count)
    texels = torch.rand(count, 4, generator=generator)
    runs = (2 * torch.rand(-(-count // 11), generator=generator) - 0.5).clamp(0, 1)
    texels[:, 3] = runs.repeat_interleave(11)[:count]
    return texels


def gradient_of(step: int, count: int) -> Tensor:
    """Gradients over six decades: half of all runs of texels has them in most steps, a quarter with long pauses, a quarter never."""
    generator = torch.Generator().manual_seed(step)
    gradient = torch.randn(count, 4, generator=generator)
    run = torch.arange(count) // 7
    gradient *= 10.0 ** -(run % 7)[:, None]
    awake = torch.rand(count, generator=generator) < 0.7
    pause = ((step // (REST_AFTER + 60) + run) % 2 == 0) | (step % (REST_AFTER + 60) == 5)  # and once in the middle of a pause
    return gradient * (awake & ((run % 4 < 2) | ((run % 4 == 2) & pause)))[:, None]


def rate_of(step: int) -> float:
    return 0.05 * (1 + math.cos(math.pi * step / STEPS))


def advance(state: AdamFused, count: int, steps: range) -> None:
    for step in steps:
        state.gradient[:count] += gradient_of(step, count)
        state.update(step, rate_of(step), BETAS)


@pytest.mark.parametrize("betas", [BETAS, (0.8, 0.95), (0.0, 0.0)])
def test_hundreds_of_steps_are_torchs_adam_and_a_clamp(betas: tuple[float, float]) -> None:
    """Measured against float64: at most 7e-6 apart in any step; a step is up to 0.1. What rests misses 1e-5 of a step."""
    count, rest = 1003, rest_after(betas[0])
    texels = start(count)
    state, leaf = AdamFused.start(AdamFused.padded(texels)), texels.double().requires_grad_()
    reference = torch.optim.Adam([leaf], betas=betas, eps=EPSILON)
    largest, rested, woken = 0.0, 0, 0
    for step in range(1, STEPS + 1):
        gradient = gradient_of(step, count)
        idle = step - state.last
        moved = torch.nn.functional.pad(gradient, (0, 0, 0, -count % BLOCK)).view(-1, 4 * BLOCK).any(-1)
        rested += int(((idle > rest) & (idle < 1 << 20) & ~moved).sum())
        woken += int(((idle > rest) & (idle < 1 << 20) & moved).sum())
        state.gradient[:count] += gradient
        state.update(step, rate_of(step), betas)
        reference.param_groups[0]["lr"] = rate_of(step)
        leaf.grad = gradient.double()
        reference.step()
        with torch.no_grad():
            leaf.clamp_(0, 1)
        largest = max(largest, float((state.texels[:count] - leaf.detach()).abs().max()))
        assert not state.gradient.any()
        assert torch.equal(state.occupied, occupancy(state.texels))
    assert rested > 3000 and woken > 50
    assert largest < 2e-5
    assert state.texels.min() == 0 and state.texels.max() == 1
    never = torch.arange(count) // 7 % 4 == 3
    assert torch.equal(state.texels[:count][never], texels[never])


@pytest.mark.parametrize("count", [1, 3, 4, 5, 7])
def test_sizes_that_are_not_whole_blocks(count: int) -> None:
    texels = start(count)
    state = AdamFused.start(AdamFused.padded(texels))
    assert len(state.texels) == -(-count // BLOCK) * BLOCK and torch.equal(state.texels[:count], texels)
    state.gradient[:count] += 1
    state.update(1, 0.1, BETAS)
    assert torch.allclose(state.texels[:count], (texels - 0.1).clamp_min(0), atol=1e-6)
    assert not state.texels[count:].any() and not state.gradient.any()
    assert texels.max() == start(count).max() and torch.equal(texels, start(count))  # what it started from is untouched


def test_no_texels_at_all() -> None:
    state = AdamFused.start(AdamFused.padded(torch.zeros(0, 4)))
    state.update(1, 0.1, BETAS)
    assert state.texels.shape == (0, 4)


def test_an_update_without_gradients_moves_nothing_at_first() -> None:
    state = AdamFused.start(AdamFused.padded(start(100)))
    for step in range(1, 5):
        state.update(step, 0.1, BETAS)
    assert torch.equal(state.texels, AdamFused.start(AdamFused.padded(start(100))).texels)


@pytest.mark.parametrize("until", [40, 300])
def test_going_on_from_what_was_kept_is_going_on(until: int) -> None:
    count = 203
    whole, first = AdamFused.start(AdamFused.padded(start(count))), AdamFused.start(AdamFused.padded(start(count)))
    advance(whole, count, range(1, STEPS))
    advance(first, count, range(1, until))
    kept = {name: tensor.clone() for name, tensor in first.tensors().items()}
    advance(first, count, range(until, until + 3))  # what was kept must not follow
    resumed = AdamFused.start(AdamFused.padded(torch.rand(count, 4))).restored(kept)
    assert torch.equal(resumed.occupied, occupancy(resumed.texels)) and not resumed.gradient.any()
    advance(resumed, count, range(until, STEPS))
    for name in ("texels", "gradient", "first_moment", "second_moment", "last", "occupied"):
        assert torch.equal(getattr(resumed, name), getattr(whole, name)), name


@pytest.mark.usefixtures("threads")
def test_same_bytes_with_any_number_of_threads() -> None:
    """Large enough to be cut into three pieces."""
    count = 50_001
    states = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        states.append(AdamFused.start(AdamFused.padded(start(count))))
        advance(states[-1], count, range(1, 8))
    for other in states[1:]:
        assert all(torch.equal(a, b) for a, b in zip(states[0].tensors().values(), other.tensors().values(), strict=True))
        assert torch.equal(states[0].occupied, other.occupied)


def test_the_loss_of_alpha_has_no_derivative_where_there_is_nothing() -> None:
    texels = torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, 0.25], [0, 0, 0, 1]], requires_grad=True)
    value = alpha_loss(texels, 2.0, 0.5)
    value.backward()
    assert value.item() == pytest.approx(2 * 0.25 * 0.75 + 0.5 * 1.25)
    assert texels.grad is not None and texels.grad[:, 3].tolist() == pytest.approx([0, 1.5, -1.5]) and not texels.grad[:, :3].any()


def test_the_loss_of_alpha_adds_to_the_gradient() -> None:
    texels = start(40)
    plain, crisp = AdamFused.start(AdamFused.padded(texels)), AdamFused.start(AdamFused.padded(texels))
    for step in range(1, 4):
        gradient = gradient_of(step, 40)
        crisp.gradient[:40] = gradient
        alpha = plain.texels[:40, 3]
        plain.gradient[:40] = gradient
        woken = (gradient.view(-1, BLOCK, 4) != 0).flatten(1).any(-1) | (step - plain.last <= REST_AFTER)
        plain.gradient[:40, 3] += torch.where((alpha > 0) & woken.repeat_interleave(BLOCK), 0.3 * (1 - 2 * alpha) + 0.2, 0)
        plain.update(step, 0.05, BETAS)
        crisp.update(step, 0.05, BETAS, binarization=0.3, sparsity=0.2)
    torch.testing.assert_close(crisp.texels, plain.texels, atol=1e-6, rtol=0)
    untouched = AdamFused.start(AdamFused.padded(texels))
    for step in range(1, 4):
        untouched.gradient[:40] = gradient_of(step, 40)
        untouched.update(step, 0.05, BETAS)
    assert (untouched.texels[:, 3] - crisp.texels[:, 3]).abs().max() > 0.01


def test_how_soon_blocks_rest() -> None:
    assert [rest_after(beta1) for beta1 in (0.0, 0.8, 0.9)] == [1, 61, 128]
    assert 0.99 ** rest_after(0.99) < 1.5e-6
