"""One optimizer step: render, loss, gradient, update; by the fused kernels, or by the reference renderer and autograd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.levels import Targets
from bbfit.fitting.losses import binarization_loss, image_loss
from bbfit.fitting.movement import Movement
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.reference import render_reference

HARDEST = 16.0
"""Slope of a mask's ramp from which on it may as well be a step."""

if TYPE_CHECKING:
    from bbfit.fitting.adam import AdamState
    from bbfit.rendering.fused import PixelLoss
    from bbfit.rendering.projection import Projection


BLEND = AlphaMode()


def alpha_rate(alpha: AlphaMode) -> float:
    """By how much alpha moves less than color in a step: the harder the ramp, the more a change of alpha shows."""
    return 1.0 if alpha.kind == "blend" else min(alpha.hardness, HARDEST) ** -0.5


class Stepper(Protocol):
    """An optimizer of a cloud's texels and, if it has been given a movement, of where the billboards stand."""

    @property
    def texels(self) -> Tensor:
        """The texels as they are now, [P, 4]."""

    @property
    def cloud(self) -> BillboardCloud:
        """The cloud as it is now, on the CPU, with texels of its own."""

    def finish(self) -> BillboardCloud:
        """The same as :attr:`cloud` without a copy; no step may follow."""

    def step(self, chosen: Sequence[int], rate: float, placement_learning_rate: float = 0.0, alpha: AlphaMode = BLEND) -> Tensor:
        """Take the next step on the chosen views, drawn in an alpha mode; return the loss before the update, a scalar."""

    def tensors(self) -> dict[str, Tensor]:
        """Everything that changes from step to step."""

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """Go on from :meth:`tensors` as they were after so many steps."""


def make_stepper(
    cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None = None, *, groups: int = 1
) -> Stepper:
    """A stepper for a resolved configuration, which starts from the cloud's texels on their device.

    With ``groups``, so many equal parts of the billboards are fitted side by side, each as if it were alone; their losses are added up.
    """
    return (ReferenceStepper if config.backend == "reference" else FusedStepper)(cloud, targets, config, movement, groups)


def _copied(cloud: BillboardCloud) -> BillboardCloud:
    return cloud.with_texels(cloud.texels.clone())


class ReferenceStepper:
    """The specification: kornia's warp, autograd and torch's Adam."""

    def __init__(
        self, cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None = None, groups: int = 1
    ) -> None:
        self._cloud, self._targets, self._config, self._movement, self._groups = cloud.without_textures(), targets, config, movement, groups
        self._start(cloud.texels.clone(), torch.zeros_like(cloud.texels), torch.zeros_like(cloud.texels), 0)

    def _start(self, texels: Tensor, first_moment: Tensor, second_moment: Tensor, steps: int) -> None:
        self.texels = texels.to(self._cloud.texels.device).requires_grad_()
        self._adam = torch.optim.Adam([self.texels], betas=(self._config.beta1, self._config.beta2), fused=True)
        self._adam.state[self.texels] = {
            "step": torch.tensor(float(steps), device=self.texels.device),
            "exp_avg": first_moment.to(self.texels.device),
            "exp_avg_sq": second_moment.to(self.texels.device),
        }

    def tensors(self) -> dict[str, Tensor]:
        """See :class:`Stepper`."""
        kept = self._adam.state[self.texels]
        moved = self._movement.tensors() if self._movement else {}
        return {"texels": self.texels.detach(), "first_moment": kept["exp_avg"], "second_moment": kept["exp_avg_sq"]} | moved

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """See :class:`Stepper`."""
        self._start(tensors["texels"], tensors["first_moment"], tensors["second_moment"], steps)
        if self._movement:
            self._movement.restore(tensors)

    @property
    def cloud(self) -> BillboardCloud:
        """See :class:`Stepper`."""
        return _copied(self.finish())

    def finish(self) -> BillboardCloud:
        """See :class:`Stepper`."""
        texels = self.texels.detach().cpu()
        return self._movement.now(texels) if self._movement else self._cloud.to("cpu").with_texels(texels)

    def step(self, chosen: Sequence[int], rate: float, placement_learning_rate: float = 0.0, alpha: AlphaMode = BLEND) -> Tensor:
        """See :class:`Stepper`."""
        device = self.texels.device
        self._adam.param_groups[0]["lr"] = rate
        cloud, moved = replace(self._cloud, texels=self.texels, alpha=alpha), None
        if self._movement:
            moved = self._movement.parameters.clone().requires_grad_(bool(placement_learning_rate))
            cloud = replace(self._movement.placed(moved, self.texels).to(torch.float32).to(device), alpha=alpha)
        config, cameras = self._config, self._targets.cameras[list(chosen)].to(device)
        target, loss = self._targets.pictures(chosen).to(device), torch.zeros((), device=device)
        for group in cloud.parts(self._groups):
            image = render_reference(group, cameras)
            loss = loss + image_loss(image, target, config.loss, config.ssim_weight, config.sharpness_weight)
        self._adam.zero_grad()
        (loss + config.binarization_weight * binarization_loss(self.texels) / (target.shape[1] * target.shape[2])).backward()
        before = self.texels.detach()[:, 3].clone()
        self._adam.step()
        with torch.no_grad():
            self.texels[:, 3].sub_(before).mul_(alpha_rate(alpha)).add_(before)
            self.texels.clamp_(0, 1)
        if moved is not None and moved.grad is not None:
            assert self._movement is not None
            self._movement.update(moved.grad, placement_learning_rate)
        return loss.detach()


class FusedStepper:
    """The same by Warp kernels: one pass over the pixels and one over the texels."""

    def __init__(
        self, cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None = None, groups: int = 1
    ) -> None:
        from bbfit.fitting.adam import padded
        from bbfit.rendering.fused_projection import Projector
        from bbfit.rendering.projection import project

        self._cloud, self._targets, self._config, self._movement, self._groups = cloud.without_textures(), targets, config, movement, groups
        self._begin, self.steps = padded(cloud.texels), 0
        self._scratch: list[Tensor] | None = None
        self._standing = None if movement else project(self._cloud, targets.cameras.to(cloud.texels.device))
        self._projector = Projector(self._cloud, targets.cameras) if movement else None

    @cached_property
    def state(self) -> AdamState:
        """Texels and Adam's moments; made by the first step, when the caller may have let go of the texels that they begin with."""
        from bbfit.fitting.adam import AdamState

        return AdamState.start(self._begin)

    @property
    def texels(self) -> Tensor:
        """See :class:`Stepper`."""
        return self.state.texels[: len(self._cloud.texels)]

    @property
    def cloud(self) -> BillboardCloud:
        """See :class:`Stepper`."""
        return _copied(self.finish())

    def finish(self) -> BillboardCloud:
        """See :class:`Stepper`."""
        texels = self.texels.cpu()
        return self._movement.now(texels) if self._movement else self._cloud.to("cpu").with_texels(texels)

    def tensors(self) -> dict[str, Tensor]:
        """See :class:`Stepper`."""
        return self.state.tensors() | (self._movement.tensors() if self._movement else {})

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """See :class:`Stepper`."""
        self.state, self.steps = self.state.restored({name: tensors[name] for name in self.state.tensors()}), steps
        if self._movement:
            self._movement.restore(tensors)

    def step(self, chosen: Sequence[int], rate: float, placement_learning_rate: float = 0.0, alpha: AlphaMode = BLEND) -> Tensor:
        """See :class:`Stepper`."""
        from bbfit.rendering.fused import PixelLoss, differentiate

        state, config, device, movement = self.state, self._config, self.state.texels.device, self._movement
        if movement is not None:
            assert self._projector is not None
            placement = movement.placement()
            projection = self._projector.project(placement, chosen)
        else:
            assert self._standing is not None
            projection = self._standing.take(torch.tensor(chosen, device=device))
        projection, groups = replace(projection, alpha=alpha).grouped(self._groups), self._groups
        pixels = len(chosen) * projection.width * projection.height
        target = self._targets.packed(chosen).to(device)
        if groups > 1:
            target = target.repeat(groups, 1, 1, 1)
        loss = PixelLoss(target, self._targets.shrunk is None, config.loss, 1 / pixels)
        lost, of_image = self._perceived(projection, loss)
        moves = movement is not None and placement_learning_rate > 0
        sums, of_matrices = differentiate(
            state.texels,
            projection,
            state.gradient,
            image_gradient=of_image,
            loss=loss,
            occupied=state.occupied,
            placement=moves,
        )
        assert sums is not None
        if of_matrices is not None:
            assert movement is not None and self._projector is not None
            of_matrices = of_matrices.unflatten(0, (groups, -1)).transpose(0, 1).flatten(1, 2)
            movement.update(movement.pull_back(placement, self._projector.pull_back(of_matrices).cpu()), placement_learning_rate)
        self.steps += 1
        binarization = config.binarization_weight / (projection.width * projection.height)
        state.update(self.steps, rate, (config.beta1, config.beta2), binarization, alpha_rate(alpha))
        return sums.sum() / pixels + lost

    def _perceived(self, projection: Projection, loss: PixelLoss) -> tuple[Tensor | float, Tensor | None]:
        """What is lost in structure and sharpness against the loss's target, weighted, and its gradient in the picture, [B, H, W, 4]."""
        from bbfit.fitting.fused_sharpness import add_sharpness_gradient
        from bbfit.fitting.fused_ssim import similarity_and_gradient
        from bbfit.rendering.fused import draw, unpacked

        # Both are means over views, and groups are to be added up.
        ssim_weight, sharpness_weight = (self._groups * weight for weight in (self._config.ssim_weight, self._config.sharpness_weight))
        if not ssim_weight and not sharpness_weight:
            return 0.0, None
        # Memory that is kept: fresh pages for a few large pictures a step would cost as much as drawing them.
        if self._scratch is None or self._scratch[0].shape != loss.target.shape:
            self._scratch = [torch.empty(loss.target.shape, dtype=torch.float32, device=loss.target.device) for _ in range(3)]
        image = draw(self.state.texels, projection, self.state.occupied, out=self._scratch[0])
        target = unpacked(loss.target, loss.straight, out=self._scratch[1])
        lost: Tensor | float = 0.0
        of_image = self._scratch[2]
        if ssim_weight:
            similarity, of_image = similarity_and_gradient(image, target, -ssim_weight, out=of_image)
            lost = ssim_weight * (1 - similarity)
        else:
            of_image.zero_()
        if sharpness_weight:
            lost = lost + sharpness_weight * add_sharpness_gradient(image, target, sharpness_weight, of_image)
        return lost, of_image
