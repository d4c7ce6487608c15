"""The optimisation loop (thesis, algorithm 1), resumable."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import InputTypeError, fail
from bbfit.files import write_tensors
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import start_cloud
from bbfit.fitting.losses import image_loss
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import bleed_colour
from bbfit.rendering.dispatch import render
from bbfit.views import ViewDataset


@dataclass(frozen=True)
class Step:
    """What ``on_step`` is told after every optimiser step."""

    index: int
    """Steps done, from 1."""
    total: int
    """Steps in all."""
    loss: float
    """The step's loss, before its update."""
    learning_rate: float
    """Adam's rate in this step."""


@dataclass(frozen=True)
class FitResult:
    """A fitted billboard cloud and how it came about."""

    cloud: BillboardCloud
    """The result, float32 on the CPU."""
    losses: list[float]
    """Loss of every step."""
    config: FitConfig
    """The configuration, resolved."""
    seconds: float
    """Time spent fitting, over all attempts when resumed."""


@dataclass
class _State:
    """Everything that changes from step to step; what a checkpoint holds."""

    texels: Tensor
    first_moment: Tensor
    second_moment: Tensor
    losses: list[float]
    seconds: float = 0.0


def fit(
    views: ViewDataset,
    config: FitConfig | None = None,
    *,
    checkpoint: str | Path | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> FitResult:
    """Fit a billboard cloud to the training views; the test views are not looked at.

    Each step draws some training views, renders the cloud from their cameras, and lets Adam (Kingma and Ba 2015) move the texels down
    the gradient of the loss; texels are kept in [0, 1]. At the end transparent texels get their neighbours' colour.

    Parameters
    ----------
    views : training views from around the tree.
    config : the preset ``default`` when left out.
    checkpoint : file to keep the state in every ``config.checkpoint_every`` steps. If it holds the state of a fit of the same views by
        the same configuration, that fit goes on, and ends with the same result as an unbroken one. The caller removes the file once
        the result is safe.
    on_step : called after every step.

    Raises
    ------
    InputError
        if a view cannot be read or is empty, or the device is not there.
    """
    if not isinstance(views, ViewDataset):
        raise InputTypeError(f"views: expected a ViewDataset, got {views!r}; ViewDataset.load(folder) reads one")
    config = (config or FitConfig()).resolve()
    assert config.steps is not None and config.views_per_step is not None
    device = _device(config.device)
    views.train.check()
    start = start_cloud(views.train, config).to(device)
    mark = sha256(json.dumps([1, asdict(config), views.train.fingerprint], sort_keys=True).encode()).hexdigest()
    checkpoint = Path(checkpoint) if checkpoint is not None else None
    state = _load(checkpoint, mark, device) if checkpoint is not None else None
    if state is None:
        state = _State(start.texels.clone(), torch.zeros_like(start.texels), torch.zeros_like(start.texels), [])

    texels = state.texels.requires_grad_()
    adam = torch.optim.Adam([texels], fused=True)
    adam.state[texels] = {
        "step": torch.tensor(float(len(state.losses)), device=device),
        "exp_avg": state.first_moment,
        "exp_avg_sq": state.second_moment,
    }
    begun = time.perf_counter() - state.seconds
    for index in range(len(state.losses), config.steps):
        rate = learning_rate(config, index)
        adam.param_groups[0]["lr"] = rate
        chosen = draw_views(config, len(views.train), index)
        target = views.train.targets(chosen).to(device)
        image = render(start.with_texels(texels), views.train.cameras[chosen].to(device))
        loss = image_loss(image, target, config.loss, config.ssim_weight or 0.0)
        adam.zero_grad()
        loss.backward()
        adam.step()
        with torch.no_grad():
            texels.clamp_(0, 1)
        state.losses.append(loss.item())
        state.seconds = time.perf_counter() - begun
        if on_step is not None:
            on_step(Step(index + 1, config.steps, state.losses[-1], rate))
        if checkpoint is not None and ((index + 1) % config.checkpoint_every == 0 or index + 1 == config.steps):
            _save(checkpoint, mark, state)
    cloud = start.with_texels(texels.detach())
    # No view determines the colour of what is transparent, yet filtering shows it; so it is settled here, and an export need not.
    bled = [bleed_colour(side).reshape(-1, 4) for texture in cloud.textures() for side in texture]
    return FitResult(cloud.with_texels(torch.cat(bled)).to("cpu"), state.losses, config, state.seconds)


def learning_rate(config: FitConfig, index: int) -> float:
    """Adam's rate in step ``index`` (from 0) of a resolved configuration.

    ``growth`` is the thesis's schedule, lr_i = lr_(i-1) * (1 + 0.1 / n): over n steps the rate grows by about a tenth.
    """
    assert config.learning_rate is not None and config.steps is not None
    if config.schedule == "growth":
        return config.learning_rate * (1 + 0.1 / config.steps) ** index
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * index / config.steps))


def draw_views(config: FitConfig, count: int, index: int) -> list[int]:
    """The training views of step ``index``, of ``count``: a function of the seed and the step alone, so that any step can be resumed.

    One view a step is drawn at random with replacement (thesis, algorithm 1); several are dealt from reshuffled decks, so that all
    views come up equally often.
    """
    assert config.views_per_step is not None
    if config.views_per_step == 1:
        return np.random.default_rng([config.seed, index]).integers(count, size=1).tolist()
    batch = min(config.views_per_step, count)
    per_deck = count // batch
    deck = np.random.default_rng([config.seed, index // per_deck]).permutation(count)
    return deck[index % per_deck * batch :][:batch].tolist()


def _device(name: str) -> torch.device:
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError):
        fail("device", f"{name!r} is not available here", "use cpu, or cuda on a machine with a GPU and a CUDA build of torch")
    return torch.device(name)


def _save(path: Path, mark: str, state: _State) -> None:
    tensors = {
        "texels": state.texels.detach().cpu(),
        "first_moment": state.first_moment.cpu(),
        "second_moment": state.second_moment.cpu(),
        "losses": torch.tensor(state.losses, dtype=torch.float64),
    }
    write_tensors(path, tensors, {"fit": mark, "seconds": repr(state.seconds)})


def _load(path: Path, mark: str, device: torch.device) -> _State | None:
    """The state kept in a checkpoint, or ``None`` if there is none for this very fit."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("fit") != mark:
                return None
            return _State(
                file.get_tensor("texels").to(device),
                file.get_tensor("first_moment").to(device),
                file.get_tensor("second_moment").to(device),
                file.get_tensor("losses").tolist(),
                float(metadata["seconds"]),
            )
    except SafetensorError:
        return None
