"""Loss and gradients of a step by the fused operators: one pass over the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.adam.fused import AdamFused
from bbfit.operators.adam.kernels import update_blocks
from bbfit.operators.drawing.fused import differentiate, draw
from bbfit.operators.drawing.fused import kernels_for as drawing_kernels
from bbfit.operators.drawing.projection import Projection, project
from bbfit.operators.drawing.projection_kernels import project_planes
from bbfit.operators.drawing.projector import Projector
from bbfit.operators.image_loss.fused import PixelLoss, add_structure, unpacked
from bbfit.operators.image_loss.kernels import unpack
from bbfit.operators.launching import compile_together, cores_for_kernels
from bbfit.operators.sharpness.kernels import measure
from bbfit.operators.ssim.fused import kernels_for as ssim_kernels


class FusedPass:
    """Differentiates the loss of views in texels and placement; parameters as of :class:`~bbfit.fitting.steps.Stepper`."""

    adam = AdamFused
    cores = staticmethod(cores_for_kernels)
    """Context of a step."""

    def __init__(self, cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None, groups: int) -> None:
        self._targets, self._config, self._movement, self._groups = targets, config, movement, groups
        self._scratch: list[Tensor] | None = None
        self._fixed = None if movement else project(cloud, targets.cameras.to(cloud.texels.device))
        self._projector = Projector(cloud, targets.cameras) if movement else None
        self._compile(len(cloud) // groups, cloud.texels.device)

    def _compile(self, count: int, device: torch.device) -> None:
        """Compile the kernels of a step that are not compiled yet."""
        on_gpu, config = device.type == "cuda", self._config
        kernels = [update_blocks, project_planes]
        if not on_gpu:  # there the kernels depend on the layers in a picture
            drawing = drawing_kernels(count)
            kernels += [drawing.draw, drawing.differentiate]
        if config.ssim_weight:
            structure = ssim_kernels(self._targets.cameras.width, on_gpu)
            kernels += [structure.sweep, structure.find_extents, structure.widen_extents]
        if config.sharpness_weight:
            kernels += [measure]
        if config.ssim_weight or config.sharpness_weight:
            kernels += [unpack]
        compile_together(kernels, device)

    def differentiate(self, state: AdamFused, chosen: Sequence[int], alpha: AlphaMode, moves: bool) -> tuple[Tensor, Tensor | None]:
        """Add the gradient in the texels to ``state.gradient``, for the chosen views drawn in an alpha mode.

        Returns the loss, a scalar, and the gradient in the movement's parameters, [N, 8], if the billboards move.
        """
        config, device, movement, projector, groups = self._config, state.texels.device, self._movement, self._projector, self._groups
        if movement is not None and projector is not None:
            placement = movement.placement()
            projection = projector.project(placement, chosen)
        else:
            assert self._fixed is not None
            projection = self._fixed.take(torch.tensor(chosen, device=device))
        projection = replace(projection, alpha=alpha).grouped(groups)
        pixels = len(chosen) * projection.width * projection.height
        target = self._targets.packed(chosen).to(device)
        if groups > 1:
            target = target.repeat(groups, 1, 1, 1)
        loss = PixelLoss(target, self._targets.shrunk is None, config.loss, 1 / pixels, config.colors == "views")
        structure, of_image = self._structure(state, projection, loss)
        sums, of_matrices = differentiate(
            state.texels, projection, state.gradient, image_gradient=of_image, loss=loss, occupied=state.occupied, placement=moves
        )
        assert sums is not None
        of_parameters = None
        if of_matrices is not None and movement is not None and projector is not None:
            of_matrices = of_matrices.unflatten(0, (groups, -1)).transpose(0, 1).flatten(1, 2)
            of_parameters = movement.pull_back(placement, projector.pull_back(of_matrices).cpu())
        return sums.sum() / pixels + structure, of_parameters

    def _structure(self, state: AdamFused, projection: Projection, loss: PixelLoss) -> tuple[Tensor | float, Tensor | None]:
        """The loss in structure and sharpness and its gradient in the picture, [B, H, W, 4], which exists only for a weight above 0."""
        # Both terms are means over views, but losses of groups are added.
        weights = [self._groups * weight for weight in (self._config.ssim_weight, self._config.sharpness_weight)]
        if not any(weights):
            return 0.0, None
        # The memory is kept: new pages for a few large pictures in every step would cost as much as drawing.
        if self._scratch is None or self._scratch[0].shape != loss.target.shape:
            self._scratch = [torch.empty(loss.target.shape, dtype=torch.float32, device=loss.target.device) for _ in range(3)]
        image = draw(state.texels, projection, state.occupied, out=self._scratch[0])
        target = unpacked(loss.target, loss.straight, out=self._scratch[1])
        return add_structure(image, target, weights[0], weights[1], self._scratch[2]), self._scratch[2]
