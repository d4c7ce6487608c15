"""Adam for texels (Kingma and Ba 2015, algorithm 1) as one pass over memory that skips what it cannot change."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.rendering.fused import occupancy
from bbfit.rendering.launching import FLAGS, in_parallel, pieces_of
from bbfit.rendering.sampling import BLOCK

EPSILON = 1e-8
# A first moment that has shrunk to this share moves a texel by no more than a hundred-thousandth of a step, all in all.
_FORGOTTEN = 1.4e-6
# Blocks that a CPU thread takes at a time, and at least.
RUN, LEAST_RUNS = 64, 64

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})
texel_block: Any = wp.types.vector(length=4 * BLOCK, dtype=wp.float32)
"""A block of RGBA texels; wide enough for a CPU's vector units."""


@wp.kernel
def _update_blocks(
    first: int,
    run: int,
    step: int,
    rate: float,
    beta1: float,
    beta2: float,
    correction: float,
    epsilon: float,
    rest_after: int,
    binarization: float,
    alpha_rate: float,
    texels: wp.array(dtype=texel_block),  # type: ignore[valid-type]
    gradient: wp.array(dtype=texel_block),  # type: ignore[valid-type]
    first_moment: wp.array(dtype=texel_block),  # type: ignore[valid-type]
    second_moment: wp.array(dtype=texel_block),  # type: ignore[valid-type]
    last: wp.array(dtype=wp.int32),  # type: ignore[valid-type]
    occupied: wp.array(dtype=wp.uint8),  # type: ignore[valid-type]
) -> None:
    begin = first + wp.tid() * run  # type: ignore[operator]
    for i in range(begin, wp.min(begin + run, texels.shape[0])):
        g = gradient[i]
        idle = step - last[i]
        moved = wp.dot(g, g) != 0.0
        if moved or idle <= rest_after:
            decay1 = beta1
            decay2 = beta2
            if moved:
                gradient[i] = texel_block()
                last[i] = step
                if idle > rest_after:
                    decay1 = wp.pow(beta1, float(idle - rest_after))
                    decay2 = wp.pow(beta2, float(idle - rest_after))
            p = texels[i]
            if binarization != 0.0:
                for t in range(wp.static(BLOCK)):
                    alpha = p[4 * t + 3]
                    if alpha > 0.0:
                        g[4 * t + 3] += binarization * (1.0 - 2.0 * alpha)
            m = first_moment[i] * decay1 + g * (1.0 - beta1)
            v = second_moment[i] * decay2 + wp.cw_mul(g, g) * (1.0 - beta2)
            first_moment[i] = m
            second_moment[i] = v
            for c in range(wp.static(4 * BLOCK)):
                of_channel = wp.where((c & 3) == 3, rate * alpha_rate, rate)
                p[c] = wp.clamp(p[c] - of_channel * m[c] / (wp.sqrt(v[c]) * correction + epsilon), 0.0, 1.0)
            texels[i] = p
            opaque = p[3] + p[7] + p[11] + p[15]
            occupied[i] = wp.where(opaque > 0.0, wp.uint8(1), wp.uint8(0))


def rest_after(beta1: float) -> int:
    """Steps without gradient after which a block rests until it has one again, and is caught up with both moments' decay; 128 at 0.9."""
    return 1 if beta1 <= 0 else math.ceil(math.log(_FORGOTTEN) / math.log(beta1))


def padded(texels: Tensor) -> Tensor:
    """A copy of texels [P, 4] with transparent ones after them that fill the last block."""
    copy = texels.new_zeros(-(-len(texels) // BLOCK) * BLOCK, 4)
    copy[: len(texels)] = texels.detach()
    return copy


@dataclass(frozen=True)
class AdamState:
    """Texels and what Adam keeps of them, padded to whole blocks; all of it changes in place."""

    texels: Tensor
    """Float32 [P', 4], P' a multiple of :data:`bbfit.rendering.sampling.BLOCK`."""
    gradient: Tensor
    """To be added to before every update, which clears it, [P', 4]."""
    first_moment: Tensor
    """[P', 4]."""
    second_moment: Tensor
    """[P', 4]."""
    last: Tensor
    """Step in which each block last had a gradient, int32 [P' / BLOCK]."""
    occupied: Tensor
    """Whether each block has a texel that is not fully transparent, uint8 [P' / BLOCK]."""

    @staticmethod
    def start(texels: Tensor) -> AdamState:
        """Before the first step, for texels [P', 4] as :func:`padded` returns them, which from now on are the state's."""
        never = torch.full((len(texels) // BLOCK,), -(1 << 30), dtype=torch.int32, device=texels.device)
        zeros = [torch.zeros_like(texels) for _ in range(3)]
        return AdamState(texels, zeros[0], zeros[1], zeros[2], never, occupancy(texels))

    def tensors(self) -> dict[str, Tensor]:
        """What has to be kept to go on later; the gradient is zero between steps."""
        return {"texels": self.texels, "first_moment": self.first_moment, "second_moment": self.second_moment, "last": self.last}

    def restored(self, tensors: dict[str, Tensor]) -> AdamState:
        """The state that :meth:`tensors` are of."""
        kept = {name: tensor.to(self.texels.device) for name, tensor in tensors.items()}
        return replace(AdamState.start(kept["texels"]), **kept)

    def update(self, step: int, rate: float, betas: tuple[float, float], binarization: float = 0.0, alpha_rate: float = 1.0) -> None:
        """Take step number ``step``, from 1, at the given rate, the moments decaying by ``betas`` a step; keep the texels in [0, 1].

        ``crispness`` times the derivative of alpha (1 - alpha) is added to the gradient of every alpha that is not 0. Alpha moves by
        ``alpha_rate`` times the step.

        The same as ``torch.optim.Adam`` followed by ``clamp_`` up to rounding and :func:`rest_after`.
        """
        beta1, beta2 = betas
        run = 1 if self.texels.is_cuda else RUN
        arguments = [
            run,
            step,
            rate / (1 - beta1**step),
            beta1,
            beta2,
            (1 - beta2**step) ** -0.5,
            EPSILON,
            rest_after(beta1),
            binarization,
            alpha_rate,
            *(
                wp.from_torch(tensor.view(-1, 4 * BLOCK), dtype=texel_block)
                for tensor in (self.texels, self.gradient, self.first_moment, self.second_moment)
            ),
            wp.from_torch(self.last, dtype=wp.int32),
            wp.from_torch(self.occupied, dtype=wp.uint8),
        ]
        runs, device = -(-len(self.last) // run), wp.device_from_torch(self.texels.device)
        _update_blocks.module.load(device)  # or every thread would compile it

        def launch(begin: int, end: int) -> None:
            wp.launch(_update_blocks, end - begin, [begin * run, *arguments], device=device)

        in_parallel(launch, [(0, runs)] if self.texels.is_cuda else pieces_of(runs, LEAST_RUNS))
