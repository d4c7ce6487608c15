"""Adam for texels in torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.optim.adam import adam

EPSILON = 1e-8


def alpha_loss(texels: Tensor, binarization: float, sparsity: float) -> Tensor:
    """Sum of binarization alpha (1 - alpha) + sparsity alpha over texels [P, 4], a scalar; the derivative is zero where alpha is 0."""
    alpha = texels[:, 3]
    return torch.where(alpha > 0, binarization * alpha * (1 - alpha) + sparsity * alpha, 0).sum()


@dataclass(frozen=True)
class AdamReference:
    """Texels and Adam's moments, all of which :meth:`update` changes in place."""

    texels: Tensor
    """[P, 4]."""
    gradient: Tensor
    """To add to before every update, which clears it, [P, 4]."""
    first_moment: Tensor
    """[P, 4]."""
    second_moment: Tensor
    """[P, 4]."""

    @staticmethod
    def padded(texels: Tensor) -> Tensor:
        """A copy of texels [P, 4] for :meth:`start`."""
        return texels.detach().clone()

    @staticmethod
    def start(texels: Tensor) -> AdamReference:
        """The state before the first step, which takes over the memory of ``texels``, as :meth:`padded` returns them."""
        return AdamReference(texels, *(torch.zeros_like(texels) for _ in range(3)))

    def tensors(self) -> dict[str, Tensor]:
        """What :meth:`restored` needs to continue; the gradient is zero between steps."""
        return {"texels": self.texels, "first_moment": self.first_moment, "second_moment": self.second_moment}

    def restored(self, tensors: dict[str, Tensor]) -> AdamReference:
        """The state that :meth:`tensors` returned."""
        return replace(self.start(self.texels), **{name: tensor.to(self.texels.device) for name, tensor in tensors.items()})

    def update(
        self,
        step: int,
        rate: float,
        betas: tuple[float, float],
        binarization: float = 0.0,
        sparsity: float = 0.0,
        alpha_rate: float = 1.0,
    ) -> None:
        """Take a step of Adam (Kingma and Ba 2015, algorithm 1) and clamp texels to [0, 1].

        Parameters
        ----------
        step
            Number of the step, from 1.
        rate, betas
            Learning rate, and decay of the two moments in a step.
        binarization, sparsity
            Weights of :func:`alpha_loss`, whose gradient is added.
        alpha_rate
            Factor of the change of alpha.
        """
        leaf = self.texels.detach().requires_grad_()
        if binarization or sparsity:
            self.gradient.add_(torch.autograd.grad(alpha_loss(leaf, binarization, sparsity), leaf)[0])
        texels, alpha, steps = self.texels.detach(), self.texels[:, 3].clone(), torch.tensor(step - 1.0, device=self.texels.device)
        adam(
            [texels], [self.gradient], [self.first_moment], [self.second_moment], [], [steps],
            fused=True, amsgrad=False, beta1=betas[0], beta2=betas[1], lr=rate, weight_decay=0.0, eps=EPSILON, maximize=False,
        )  # fmt: skip
        texels[:, 3].sub_(alpha).mul_(alpha_rate).add_(alpha)
        texels.clamp_(0, 1)
        self.gradient.zero_()
