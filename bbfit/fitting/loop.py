"""The optimisation loop (thesis, algorithm 1), resumable."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import InputTypeError, fail
from bbfit.files import write_tensors
from bbfit.fitting.config import FitConfig
from bbfit.fitting.initialize import random_textures, start_cloud
from bbfit.fitting.levels import LEAST_SIDE, Targets, resize_textures, shrunk_sizes
from bbfit.fitting.steps import Stepper, make_stepper
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import bleed_colour
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
    snapshot: Callable[[], BillboardCloud]
    """Copies the cloud as it is after the step, at the step's level of resolution, to the CPU."""


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
class _Progress:
    """What a checkpoint holds: the losses of the steps done, and the stepper's tensors after the last of them."""

    losses: list[float]
    tensors: dict[str, Tensor]
    seconds: float


def fit(
    views: ViewDataset,
    config: FitConfig | None = None,
    *,
    checkpoint: str | Path | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> FitResult:
    """Fit a billboard cloud to the training views; the test views are not looked at.

    Each step draws some training views, renders the cloud from their cameras, and lets Adam (Kingma and Ba 2015) move the texels down
    the gradient of the loss; texels are kept in [0, 1]. Views and textures start coarse and are refined level by level. At the end
    transparent texels get their neighbours' colour.

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
    begun = time.perf_counter()
    views.train.check()
    start = start_cloud(views.train, config)
    mark = sha256(json.dumps([2, asdict(config), views.train.fingerprint], sort_keys=True).encode()).hexdigest()
    checkpoint = Path(checkpoint) if checkpoint is not None else None
    done = (_load(checkpoint, mark) if checkpoint is not None else None) or _Progress([], {}, 0.0)
    begun -= done.seconds

    losses, fitted = done.losses, None  # type: list[float], BillboardCloud | None
    for level in levels_of(config, views.train.cameras):
        if len(losses) > level.end:
            continue  # the checkpoint is of a later level
        sizes = shrunk_sizes(start, level.halvings)
        cloud = random_textures(start, sizes, config.seed) if fitted is None else resize_textures(fitted, sizes)
        stepper = make_stepper(cloud.to(device), Targets.at(views.train, level.halvings), config)
        if done.tensors and len(losses) > level.begin:
            stepper.restore(done.tensors, len(losses) - level.begin)
        for index in range(len(losses), level.end):
            rate = learning_rate(config, index)
            loss = stepper.step(draw_views(config, len(views.train), index, level.halvings), rate)
            losses.append(float(loss))
            if on_step is not None:
                on_step(Step(index + 1, config.steps, losses[-1], rate, partial(_snapshot, cloud, stepper)))
            if checkpoint is not None and ((index + 1) % config.checkpoint_every == 0 or index + 1 == config.steps):
                _save(checkpoint, mark, _Progress(losses, stepper.tensors(), time.perf_counter() - begun))
        fitted = cloud.with_texels(stepper.texels.detach().cpu())
    assert fitted is not None
    # No view determines the colour of what is transparent, yet filtering shows it; so it is settled here, and an export need not.
    bled = [bleed_colour(side).reshape(-1, 4) for texture in fitted.textures() for side in texture]
    return FitResult(fitted.with_texels(torch.cat(bled)), losses, config, time.perf_counter() - begun)


def _snapshot(cloud: BillboardCloud, stepper: Stepper) -> BillboardCloud:
    return cloud.with_texels(stepper.texels.detach().cpu().clone())


@dataclass(frozen=True)
class Level:
    """Steps that are taken at one resolution."""

    halvings: int
    """How often the sides of views and textures are halved."""
    begin: int
    """Steps before the level."""
    end: int
    """Steps after the level."""


def levels_of(config: FitConfig, cameras: Camera) -> list[Level]:
    """The levels of a resolved configuration, coarse to fine; levels of very small pictures are left out."""
    assert config.levels is not None and config.steps is not None
    side = min(cameras.width, cameras.height)
    halvings = [h for h in reversed(range(config.levels)) if h == 0 or side >> h >= LEAST_SIDE]
    edges = [config.steps * i // len(halvings) for i in range(len(halvings) + 1)]
    return [Level(*level) for level in zip(halvings, edges, edges[1:], strict=False)]


def learning_rate(config: FitConfig, index: int) -> float:
    """Adam's rate in step ``index`` (from 0) of a resolved configuration.

    ``growth`` is the thesis's schedule, lr_i = lr_(i-1) * (1 + 0.1 / n): over n steps the rate grows by about a tenth.
    """
    assert config.learning_rate is not None and config.steps is not None
    if config.schedule == "growth":
        return config.learning_rate * (1 + 0.1 / config.steps) ** index
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * index / config.steps))


def draw_views(config: FitConfig, count: int, index: int, halvings: int = 0) -> list[int]:
    """The training views of step ``index``, of ``count``: a function of the seed and the step alone, so that any step can be resumed.

    One view a step is drawn at random with replacement (thesis, algorithm 1); several are dealt from reshuffled decks, so that all
    views come up equally often. Every halving of the resolution doubles their number.
    """
    assert config.views_per_step is not None
    wanted = config.views_per_step << halvings
    if wanted == 1:
        return np.random.default_rng([config.seed, index]).integers(count, size=1).tolist()
    batch = min(wanted, count)
    per_deck = count // batch
    deck = np.random.default_rng([config.seed, index // per_deck]).permutation(count)
    return deck[index % per_deck * batch :][:batch].tolist()


def _device(name: str) -> torch.device:
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError):
        fail("device", f"{name!r} is not available here", "use cpu, or cuda on a machine with a GPU and a CUDA build of torch")
    return torch.device(name)


def _save(path: Path, mark: str, progress: _Progress) -> None:
    tensors = {name: tensor.detach().cpu() for name, tensor in progress.tensors.items()}
    losses = torch.tensor(progress.losses, dtype=torch.float64)
    write_tensors(path, tensors | {"losses": losses}, {"fit": mark, "seconds": repr(progress.seconds)})


def _load(path: Path, mark: str) -> _Progress | None:
    """What is kept in a checkpoint, or ``None`` if there is none for this very fit."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("fit") != mark:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            return _Progress(tensors.pop("losses").tolist(), tensors, float(metadata["seconds"]))
    except SafetensorError:
        return None
