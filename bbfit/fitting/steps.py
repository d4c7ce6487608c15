"""One optimiser step: render, loss, gradient, update; by the fused kernels, or by the reference renderer and autograd."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from bbfit.fitting.config import FitConfig
from bbfit.fitting.levels import Targets
from bbfit.fitting.losses import image_loss
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.reference import render_reference

if TYPE_CHECKING:
    from bbfit.rendering.fused import PixelLoss
    from bbfit.rendering.projection import Projection


class Stepper(Protocol):
    """An optimiser of a cloud's texels."""

    @property
    def texels(self) -> Tensor:
        """The texels as they are now, [P, 4]."""

    def step(self, chosen: Sequence[int], rate: float) -> Tensor:
        """Take the next step on the chosen views; return the loss before the update, a scalar."""

    def tensors(self) -> dict[str, Tensor]:
        """Everything that changes from step to step."""

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """Go on from :meth:`tensors` as they were after so many steps."""


def make_stepper(cloud: BillboardCloud, targets: Targets, config: FitConfig) -> Stepper:
    """A stepper for a resolved configuration, which starts from the cloud's texels on their device."""
    return (ReferenceStepper if config.backend == "reference" else FusedStepper)(cloud, targets, config)


class ReferenceStepper:
    """The specification: kornia's warp, autograd and torch's Adam."""

    def __init__(self, cloud: BillboardCloud, targets: Targets, config: FitConfig) -> None:
        self._cloud, self._targets, self._config = cloud, targets, config
        self._start(cloud.texels.clone(), torch.zeros_like(cloud.texels), torch.zeros_like(cloud.texels), 0)

    def _start(self, texels: Tensor, first_moment: Tensor, second_moment: Tensor, steps: int) -> None:
        self.texels = texels.to(self._cloud.texels.device).requires_grad_()
        self._adam = torch.optim.Adam([self.texels], fused=True)
        self._adam.state[self.texels] = {
            "step": torch.tensor(float(steps), device=self.texels.device),
            "exp_avg": first_moment.to(self.texels.device),
            "exp_avg_sq": second_moment.to(self.texels.device),
        }

    def tensors(self) -> dict[str, Tensor]:
        """See :class:`Stepper`."""
        kept = self._adam.state[self.texels]
        return {"texels": self.texels.detach(), "first_moment": kept["exp_avg"], "second_moment": kept["exp_avg_sq"]}

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """See :class:`Stepper`."""
        self._start(tensors["texels"], tensors["first_moment"], tensors["second_moment"], steps)

    def step(self, chosen: Sequence[int], rate: float) -> Tensor:
        """See :class:`Stepper`."""
        device = self.texels.device
        self._adam.param_groups[0]["lr"] = rate
        image = render_reference(self._cloud.with_texels(self.texels), self._targets.cameras[list(chosen)].to(device))
        assert self._config.loss is not None
        loss = image_loss(image, self._targets.pictures(chosen).to(device), self._config.loss, self._config.ssim_weight or 0.0)
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        with torch.no_grad():
            self.texels.clamp_(0, 1)
        return loss.detach()


class FusedStepper:
    """The same by Warp kernels: one pass over the pixels and one over the texels."""

    def __init__(self, cloud: BillboardCloud, targets: Targets, config: FitConfig) -> None:
        from bbfit.fitting.adam import AdamState
        from bbfit.rendering.projection import project

        self._targets, self._config, self._count = targets, config, len(cloud.texels)
        self.state, self.steps = AdamState.start(cloud.texels), 0
        self._scratch: list[Tensor] | None = None
        self._projection = project(cloud, targets.cameras.to(cloud.texels.device))

    @property
    def texels(self) -> Tensor:
        """See :class:`Stepper`."""
        return self.state.texels[: self._count]

    def tensors(self) -> dict[str, Tensor]:
        """See :class:`Stepper`."""
        return self.state.tensors()

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """See :class:`Stepper`."""
        self.state, self.steps = self.state.restored(tensors), steps

    def step(self, chosen: Sequence[int], rate: float) -> Tensor:
        """See :class:`Stepper`."""
        from bbfit.rendering.fused import PixelLoss, differentiate

        state, config, device = self.state, self._config, self.state.texels.device
        projection = self._projection.take(torch.tensor(chosen, device=device))
        pixels = len(chosen) * projection.width * projection.height
        assert config.loss is not None
        loss = PixelLoss(self._targets.packed(chosen).to(device), self._targets.shrunk is None, config.loss, 1 / pixels)
        dissimilarity, of_image = self._dissimilarity(projection, loss) if config.ssim_weight else (0.0, None)
        sums, _ = differentiate(state.texels, projection, state.gradient, image_gradient=of_image, loss=loss, occupied=state.occupied)
        assert sums is not None
        self.steps += 1
        state.update(self.steps, rate)
        return sums.sum() / pixels + dissimilarity

    def _dissimilarity(self, projection: Projection, loss: PixelLoss) -> tuple[Tensor, Tensor]:
        """The weighted 1 - SSIM of the present picture to the loss's target, and its gradient in the picture, [B, H, W, 4]."""
        from bbfit.fitting.fused_ssim import similarity_and_gradient
        from bbfit.rendering.fused import draw, unpacked

        # Memory that is kept: fresh pages for a few large pictures a step would cost as much as drawing them.
        if self._scratch is None or self._scratch[0].shape != loss.target.shape:
            self._scratch = [torch.empty(loss.target.shape, dtype=torch.float32, device=loss.target.device) for _ in range(3)]
        image = draw(self.state.texels, projection, self.state.occupied, out=self._scratch[0])
        target = unpacked(loss.target, loss.straight, out=self._scratch[1])
        weight = self._config.ssim_weight or 0.0
        similarity, of_image = similarity_and_gradient(image, target, -weight, out=self._scratch[2])
        return weight * (1 - similarity), of_image
