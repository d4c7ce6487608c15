"""What holds for every operator: one stem and one signature for both implementations, equal values and gradients."""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path

import pytest
import torch

import bbfit
from bbfit.images import premultiply
from bbfit.operators.adam.fused import AdamFused
from bbfit.operators.adam.reference import AdamReference
from bbfit.operators.image_loss.fused import image_loss_fused
from bbfit.operators.image_loss.reference import image_loss_reference
from bbfit.operators.sharpness.fused import sharpness_fused
from bbfit.operators.sharpness.reference import sharpness_reference
from bbfit.operators.ssim.fused import ssim_fused
from bbfit.operators.ssim.reference import ssim_reference

STEMS = {
    "adam": "Adam",
    "cards": "draw_cards_",
    "drawing": "render_",
    "image_loss": "image_loss_",
    "shading": "shade_",
    "sharpness": "sharpness_",
    "ssim": "ssim_",
}


def test_every_operator_has_a_folder_with_both_implementations_and_kernels() -> None:
    folders = sorted(path.parent.name for path in (Path(bbfit.__file__).parent / "operators").glob("*/__init__.py"))
    assert folders == sorted(STEMS)
    for folder, stem in STEMS.items():
        import_module(f"bbfit.operators.{folder}.kernels")
        end = str.capitalize if stem == "Adam" else str
        reference, fused = (getattr(import_module(f"bbfit.operators.{folder}.{name}"), stem + end(name)) for name in ("reference", "fused"))
        pairs = [(reference, fused)]
        if inspect.isclass(reference):
            methods = [name for name, value in vars(reference).items() if not name.startswith("_") and callable(getattr(reference, name))]
            assert {"start", "update", "tensors", "restored"} <= set(methods)
            pairs = [(getattr(reference, name), getattr(fused, name)) for name in methods]
        for one, other in pairs:
            parameters = [[(p.name, p.kind, p.default) for p in inspect.signature(f).parameters.values()] for f in (one, other)]
            assert parameters[0] == parameters[1], one


@pytest.mark.parametrize("kind", ["l1", "l2", "backgrounds"])
@pytest.mark.parametrize("weights", [(0.0, 0.0), (0.3, 0.0), (0.0, 20.0), (0.3, 20.0)], ids=str)
def test_image_losses(kind: str, weights: tuple[float, float]) -> None:
    """Sums in float32: measured 2.6e-8 in the value and 1.9e-7 of the gradient's norm; allowed twice and three times that."""
    generator = torch.Generator().manual_seed(0)
    render, target = (premultiply(torch.rand(2, 23, 30, 4, generator=generator)) for _ in range(2))
    pairs = [(image_loss_reference, image_loss_fused, (kind, *weights))]
    if kind == "l1":
        pairs += [(ssim_reference, ssim_fused, ()), (sharpness_reference, sharpness_fused, ())]
    for reference, fused, options in pairs:
        exact, ours = render.double().requires_grad_(), render.clone().requires_grad_()
        expected, value = reference(exact, target.double(), *options), fused(ours, target, *options)
        (3 * expected).backward()
        (3 * value).backward()
        assert value.item() == pytest.approx(expected.item(), abs=5e-8)
        assert exact.grad is not None and ours.grad is not None
        assert float((ours.grad - exact.grad).norm() / exact.grad.norm()) < 6e-7


def test_adam() -> None:
    """Ten steps, with every option; rounding of float32 moves texels by at most 1e-6."""
    generator = torch.Generator().manual_seed(0)
    texels = torch.rand(50, 4, generator=generator)
    states = [adam.start(adam.padded(texels)) for adam in (AdamReference, AdamFused)]
    for step in range(1, 11):
        gradient = torch.randn(50, 4, generator=generator)
        for state in states:
            state.gradient[:50] += gradient
            state.update(step, 0.02, (0.8, 0.95), binarization=0.5, sparsity=0.2, alpha_rate=0.4)
            assert not state.gradient.any()
    torch.testing.assert_close(states[0].texels, states[1].texels[:50], atol=1e-6, rtol=0)
    assert float((states[0].texels - texels).abs().max()) > 0.05
    assert states[0].texels.min() == 0 and states[0].texels.max() == 1
