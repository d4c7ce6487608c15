"""Optimizer steps: draw views, compare, differentiate, update texels and placement."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from torch import Tensor

from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud

if TYPE_CHECKING:
    from bbfit.fitting.fused_pass import FusedPass
    from bbfit.fitting.reference_pass import ReferencePass
    from bbfit.operators.adam.fused import AdamFused
    from bbfit.operators.adam.reference import AdamReference

HARDEST = 16.0
"""Slope from which on a mask's ramp counts as a step."""
BLEND = AlphaMode()


def alpha_rate(alpha: AlphaMode) -> float:
    """Factor of alpha's learning rate: the harder the ramp of a mask, the more a change of alpha shows."""
    return min(alpha.hardness, HARDEST) ** -0.5 if alpha.kind == "mask" else 1.0


class Stepper:
    """Optimizer of a cloud's texels, from its own on their device, and, if it has a movement, of the placement.

    ``config.backend`` selects the operators: ``reference`` runs torch and autograd, any other backend the Warp kernels. Every step compares
    renders with views of ``targets`` and changes ``movement``. ``groups`` equal parts of the billboards are fitted side by side, each as if
    it were alone; their losses are added.
    """

    def __init__(
        self, cloud: BillboardCloud, targets: Targets, config: ResolvedFit, movement: Movement | None = None, *, groups: int = 1
    ) -> None:
        self._cloud, self._movement, self._betas = cloud.without_textures(), movement, (config.beta1, config.beta2)
        pixels = targets.cameras.width * targets.cameras.height
        self._of_alpha = config.binarization_weight / pixels, config.sparsity_weight / pixels
        self._pass: Any = pass_of(config)(self._cloud, targets, config, movement, groups)
        self._begin, self.steps = self._pass.adam.padded(cloud.texels), 0

    @cached_property
    def state(self) -> AdamReference | AdamFused:
        """Texels and Adam's moments. The first step creates it; by then the caller may have freed the cloud."""
        return self._pass.adam.start(self._begin)

    @property
    def texels(self) -> Tensor:
        """Current texels, [P, 4]."""
        return self.state.texels[: len(self._cloud.texels)]

    @property
    def cloud(self) -> BillboardCloud:
        """A copy of the current cloud on the CPU."""
        cloud = self.finish()
        return cloud.with_texels(cloud.texels.clone())

    def finish(self) -> BillboardCloud:
        """The current cloud on the CPU without a copy; no step may follow."""
        texels = self.texels.cpu()
        return self._movement.now(texels) if self._movement else self._cloud.to("cpu").with_texels(texels)

    def step(self, chosen: Sequence[int], rate: float, placement_learning_rate: float = 0.0, alpha: AlphaMode = BLEND) -> Tensor:
        """Take the next step with the chosen views, drawn in an alpha mode; return the loss before the update, a scalar."""
        with self._pass.cores():
            movement = self._movement if placement_learning_rate > 0 else None
            loss, of_parameters = self._pass.differentiate(self.state, chosen, alpha, movement is not None)
            if movement is not None and of_parameters is not None:
                movement.update(of_parameters, placement_learning_rate)
            self.steps += 1
            self.state.update(self.steps, rate, self._betas, *self._of_alpha, alpha_rate(alpha))
        return loss

    def tensors(self) -> dict[str, Tensor]:
        """All that changes from step to step."""
        return self.state.tensors() | (self._movement.tensors() if self._movement else {})

    def restore(self, tensors: dict[str, Tensor], steps: int) -> None:
        """Continue from what :meth:`tensors` returned after ``steps`` steps. ``ValueError``: it was another stepper."""
        own = self.tensors()
        if any(name not in tensors or tensors[name].shape != own[name].shape or tensors[name].dtype != own[name].dtype for name in own):
            raise ValueError("its tensors are not those of this fit")
        self.state, self.steps = self.state.restored({name: tensors[name] for name in self.state.tensors()}), steps
        if self._movement:
            self._movement.restore(tensors)


def pass_of(config: ResolvedFit) -> type[ReferencePass] | type[FusedPass]:
    """The operators of a configuration's backend."""
    if config.backend == "reference":
        from bbfit.fitting.reference_pass import ReferencePass

        return ReferencePass
    from bbfit.fitting.fused_pass import FusedPass  # Warp takes a while to start

    return FusedPass
