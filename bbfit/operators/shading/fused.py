"""Shading of texels by Warp kernels."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from bbfit.operators.launching import launch, warp_array
from bbfit.operators.shading.kernels import differentiate, shade
from bbfit.operators.shading.reference import TextureLight

# Texels in a run on a CPU, and the least runs for a thread.
_RUN, _LEAST_RUNS = 256, 32


def shade_fused(texels: Tensor, surface: Tensor, light: TextureLight) -> Tensor:
    """:func:`~bbfit.operators.shading.reference.shade_reference` in float32."""
    return _Shading.apply(texels.to(torch.float32).contiguous(), surface.to(torch.float32).contiguous(), light)


class _Shading(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texels: Tensor, surface: Tensor, light: TextureLight) -> Tensor:
        ctx.save_for_backward(texels, surface)
        ctx.light = light
        return shaded(texels, surface, light)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        texels, surface = ctx.saved_tensors
        of_texels, of_surface = torch.zeros_like(texels), torch.zeros_like(surface)
        pull_back(texels, surface, ctx.light, gradients[0].contiguous(), of_texels, of_surface)
        return of_texels, of_surface, None


def shaded(texels: Tensor, surface: Tensor, light: TextureLight, out: Tensor | None = None) -> Tensor:
    """Shade float32 texels [P, 4], contiguous, into ``out``, if given."""
    out = torch.empty_like(texels) if out is None else out
    _launch(shade, _arguments(texels, surface, light), [out])
    return out


def pull_back(texels: Tensor, surface: Tensor, light: TextureLight, gradient: Tensor, of_texels: Tensor, of_surface: Tensor) -> None:
    """Add to ``of_texels`` and ``of_surface`` the derivative, given that in the shaded texels; all float32 [P, 4], contiguous."""
    _launch(differentiate, [*_arguments(texels, surface, light), warp_array(gradient, wp.vec4)], [of_texels, of_surface])


def _arguments(texels: Tensor, surface: Tensor, light: TextureLight) -> list[Any]:
    return [
        wp.vec4(*light.strengths.tolist()),
        warp_array(texels, wp.vec4),
        warp_array(surface, wp.vec4),
        warp_array(light.texture, wp.int32),
        warp_array(light.suns.to(torch.float32).contiguous(), wp.vec3),
    ]


def _launch(kernel: Any, arguments: list[Any], outputs: list[Tensor]) -> None:
    on = wp.device_from_torch(outputs[0].device)
    run = 1 if on.is_cuda else _RUN
    written = [warp_array(output, wp.vec4) for output in outputs]
    launch(kernel, -(-len(outputs[0]) // run), _LEAST_RUNS, [run, *arguments], written, on=on)
