"""Loss and gradients of a step by the reference operators and autograd."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.adam.reference import AdamReference
from bbfit.operators.drawing.reference import joined_layers, render_layers_reference, render_reference
from bbfit.operators.image_loss.reference import (
    color_loss_reference,
    image_loss_reference,
    pixel_loss_reference,
    structure_loss_reference,
)


class ReferencePass:
    """The specification of :class:`~bbfit.fitting.fused_pass.FusedPass`; parameters as of :class:`~bbfit.fitting.steps.Stepper`."""

    adam = AdamReference
    cores = staticmethod(nullcontext)

    def __init__(self, cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None, groups: int) -> None:
        self._cloud, self._targets, self._config, self._movement, self._groups = cloud, targets, config, movement, groups

    def differentiate(self, state: AdamReference, chosen: Sequence[int], alpha: AlphaMode, moves: bool) -> tuple[Tensor, Tensor | None]:
        """See :meth:`bbfit.fitting.fused_pass.FusedPass.differentiate`."""
        config, device, parameters = self._config, state.texels.device, None
        texels = state.texels.detach().requires_grad_()
        cloud = replace(self._cloud, texels=texels, alpha=alpha)
        if self._movement:
            parameters = self._movement.parameters.clone().requires_grad_(moves)
            cloud = replace(self._movement.placed(parameters, texels).to(torch.float32).to(device), alpha=alpha)
        cameras, target = self._targets.cameras[list(chosen)].to(device), self._targets.pictures(chosen).to(device)
        loss = torch.zeros((), device=device)
        for group in cloud.parts(self._groups):
            if config.colors == "views":  # the loss of a pixel is for alpha alone, and colors have a loss that is not part of the total
                colors, weights = render_layers_reference(group, cameras)
                still, image = joined_layers([color.detach() for color in colors], weights), joined_layers(colors, weights)
                loss = loss + pixel_loss_reference(still, target, config.loss).mean()
                loss = loss + structure_loss_reference(image, target, config.ssim_weight, config.sharpness_weight)
                color_loss_reference(colors, weights, target).backward(retain_graph=True)
            else:
                image = render_reference(group, cameras)
                loss = loss + image_loss_reference(image, target, config.loss, config.ssim_weight, config.sharpness_weight)
        loss.backward()
        assert texels.grad is not None
        state.gradient.add_(texels.grad)
        return loss.detach(), parameters.grad if parameters is not None else None
