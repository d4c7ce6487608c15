"""Adam for texels as one pass over memory that skips blocks of texels without a gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor

from bbfit.operators.adam.kernels import Step, texel_block, update_blocks
from bbfit.operators.adam.reference import EPSILON, AdamReference
from bbfit.operators.drawing.fused import occupancy
from bbfit.operators.drawing.tile_forward import BLOCK
from bbfit.operators.launching import launch, warp_array

# A first moment that has decayed to this share moves a texel by less than 1e-5 of a step in all.
_FORGOTTEN = 1.4e-6
# Blocks in a run on a CPU, and the least runs for a thread.
RUN, LEAST_RUNS = 64, 64


def rest_after(beta1: float) -> int:
    """Steps without a gradient after which a block is skipped until it has one again; 128 for a ``beta1`` of 0.9."""
    return 1 if beta1 <= 0 else math.ceil(math.log(_FORGOTTEN) / math.log(beta1))


@dataclass(frozen=True)
class AdamFused(AdamReference):
    """As the reference, with all tensors in float32 and padded to P' texels, a multiple of
    :data:`~bbfit.operators.drawing.tile_forward.BLOCK`."""

    last: Tensor
    """Step in which each block last had a gradient, int32 [P' / BLOCK]."""
    occupied: Tensor
    """Whether each block has a texel with alpha above 0, uint8 [P' / BLOCK]."""

    @staticmethod
    def padded(texels: Tensor) -> Tensor:
        """A copy of texels [P, 4] for :meth:`start`, followed by transparent ones that complete the last block."""
        copy = texels.new_zeros(-(-len(texels) // BLOCK) * BLOCK, 4)
        copy[: len(texels)] = texels.detach()
        return copy

    @staticmethod
    def start(texels: Tensor) -> AdamFused:
        """The state before the first step, which takes over the memory of ``texels`` [P', 4], as :meth:`padded` returns them."""
        never = torch.full((len(texels) // BLOCK,), -(1 << 30), dtype=torch.int32, device=texels.device)
        gradient, first, second = (torch.zeros_like(texels) for _ in range(3))
        return AdamFused(texels, gradient, first, second, last=never, occupied=occupancy(texels))

    def tensors(self) -> dict[str, Tensor]:
        """As of the reference, and the last steps with a gradient."""
        return {**super().tensors(), "last": self.last}

    def restored(self, tensors: dict[str, Tensor]) -> AdamFused:
        """The state that :meth:`tensors` returned."""
        kept = {name: tensor.to(self.texels.device) for name, tensor in tensors.items()}
        return replace(AdamFused.start(kept["texels"]), **kept)

    def update(
        self,
        step: int,
        rate: float,
        betas: tuple[float, float],
        binarization: float = 0.0,
        sparsity: float = 0.0,
        alpha_rate: float = 1.0,
    ) -> None:
        """As of the reference, up to rounding and :func:`rest_after`; the loss of alpha does not wake blocks that rest."""
        beta1, beta2 = betas
        run = 1 if self.texels.is_cuda else RUN
        numbers = Step()
        numbers.index, numbers.beta1, numbers.beta2, numbers.epsilon = step, beta1, beta2, EPSILON
        numbers.rate, numbers.correction = rate / (1 - beta1**step), (1 - beta2**step) ** -0.5
        numbers.rest_after, numbers.alpha_rate = rest_after(beta1), alpha_rate
        numbers.binarization, numbers.sparsity = binarization, sparsity
        blocks = (self.texels, self.gradient, self.first_moment, self.second_moment)
        arrays = [warp_array(tensor.view(-1, 4 * BLOCK), texel_block) for tensor in blocks]
        arrays += [warp_array(self.last, wp.int32), warp_array(self.occupied, wp.uint8)]
        on = wp.device_from_torch(self.texels.device)
        launch(update_blocks, -(-len(self.last) // run), LEAST_RUNS, [run, numbers, *arrays], on=on)
