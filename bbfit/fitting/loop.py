"""The optimization loop (thesis, algorithm 1), resumable."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bbfit.checks import InputTypeError, fail
from bbfit.files import write_tensors
from bbfit.fitting.bounds import opaque_bounds, trimmed
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.fitting.coverage import matched_coverage
from bbfit.fitting.initialize import bounded, pixels_a_meter, random_textures, sized, start_cloud, tree_radius
from bbfit.fitting.levels import LEAST_SIDE, Targets, resampled, shrunk_sizes
from bbfit.fitting.movement import Movement
from bbfit.fitting.points import hull_points, mesh_points
from bbfit.fitting.search import find_placement
from bbfit.fitting.steps import BLEND, HARDEST, Stepper, make_stepper
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import TENSORS, BillboardCloud
from bbfit.images import bleed_color
from bbfit.provenance import cache_key
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views import ViewDataset

_START, _FOUND = "start.", "found."
# Share of the steps at full resolution in which a mask hardens.
_HARDENING = 0.3


@dataclass(frozen=True)
class Step:
    """What ``on_step`` is told after every optimizer step."""

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
    config: ResolvedFit
    """The configuration, resolved."""
    seconds: float
    """Time spent fitting, over all attempts when resumed."""


@dataclass
class _FitState:
    """What a checkpoint holds."""

    losses: list[float]
    """Of the steps done."""
    start: BillboardCloud
    """The rectangles at the beginning of the level, with their texture sizes at full resolution; its texels mean nothing."""
    found: BillboardCloud | None
    """What the search for a placement has found, as long as no step is done."""
    tensors: dict[str, Tensor]
    """The stepper's, after the last step."""
    seconds: float


def fit(
    views: ViewDataset,
    config: FitConfig | None = None,
    *,
    tree: str | Path | TreeFile | None = None,
    checkpoint: str | Path | None = None,
    on_step: Callable[[Step], None] | None = None,
    on_place: Callable[[int, int], None] | None = None,
) -> FitResult:
    """Fit a billboard cloud to the training views; the test views are not looked at.

    First a placement is searched for, unless it is to be the even one. Then each step draws some training views, renders the cloud from
    their cameras, and lets Adam (Kingma and Ba 2015) move the texels, and at all but the finest level the billboards, down the gradient of
    the loss; texels are kept in [0, 1]. Views and textures start coarse and are refined level by level; billboards that have moved are cut
    to what they show at the end of a level. At the end transparent texels get their neighbors' color.

    Parameters
    ----------
    views : training views from around the tree.
    config : the preset ``default`` when left out.
    tree : the mesh that the views show, as glTF, OBJ, PLY or STL, to place billboards by; the visual hull of the views when left out.
    checkpoint : file to keep the state in every ``config.checkpoint_every`` steps. If it holds the state of a fit of the same views by
        the same configuration, that fit goes on, and ends with the same result as an unbroken one. The caller removes the file once
        the result is safe.
    on_step : called after every step.
    on_place : called while a placement is searched for, with how much of the work is done and how much there is.

    Raises
    ------
    InputError
        if a view cannot be read or is empty, the mesh is not of the tree that the views show, or the device is not there.
    """
    if not isinstance(views, ViewDataset):
        raise InputTypeError(f"views: expected a ViewDataset, got {views!r}; ViewDataset.load(folder) reads one")
    config = (config or FitConfig()).resolve()
    device = _device(config.device)
    begun = time.perf_counter()
    views.train.check()
    opened = None if tree is None or config.placement == "even" else TreeFile.open(tree)
    key = cache_key("fit", *fit_inputs(views, config, opened))
    checkpoint = Path(checkpoint) if checkpoint is not None else None
    done = _load(checkpoint, key) if checkpoint is not None else None
    if done is None:
        done = _begin(views, config, opened, on_place)
        if checkpoint is not None and done.found is not None:
            _save(checkpoint, key, replace(done, seconds=time.perf_counter() - begun))
    begun -= done.seconds

    start, fitted, losses = done.start, done.found, done.losses
    density, radius = config.texel_density * float(pixels_a_meter(views.train.cameras)), tree_radius(views.train)
    for level in (levels := levels_of(config, views.train.cameras)):
        if len(losses) > level.end:
            continue  # the checkpoint is of a later level
        sizes = shrunk_sizes(start, level.halvings)
        cloud = random_textures(start, sizes, config.seed) if fitted is None else resampled(fitted, start, sizes)
        movement = Movement(cloud, radius) if config.placement_learning_rate and (level.halvings or len(levels) == 1) else None
        asked = config.coarse() if level.halvings else config
        stepper = make_stepper(cloud.to(device), Targets.at(views.train, level.halvings), asked, movement)
        del cloud  # the stepper has its own texels, and those of large views take hundreds of megabytes
        fitted = None
        if done.tensors and len(losses) > level.begin:
            stepper.restore(done.tensors, len(losses) - level.begin)
        for index in range(len(losses), level.end):
            rate = learning_rate(config, index)
            placement_learning_rate = config.placement_learning_rate * rate / config.learning_rate
            chosen = sample_views(config, len(views.train), index, level.halvings)
            losses.append(float(stepper.step(chosen, rate, placement_learning_rate, drawn_as(config, level, index))))
            if on_step is not None:
                on_step(Step(index + 1, config.steps, losses[-1], rate, partial(_cloud_of, stepper)))
            if checkpoint is not None and ((index + 1) % config.checkpoint_every == 0 or index + 1 == config.steps):
                _save(checkpoint, key, _FitState(losses, start, None, stepper.tensors(), time.perf_counter() - begun))
        fitted = stepper.finish()
        del stepper
        if movement is not None:
            start = bounded(fitted, opaque_bounds(fitted), density, config.max_texels).to(torch.float32)
    assert fitted is not None
    fitted = replace(fitted, alpha=AlphaMode(config.alpha, config.alpha_cutoff))
    if config.alpha == "mask":
        fitted = matched_coverage(fitted, views.train, config.backend)
    # No view determines the color of what is transparent, yet filtering shows it; so it is settled here, and an export need not.
    bled = [bleed_color(side).reshape(-1, 4) for texture in fitted.textures() for side in texture]
    fitted = fitted.with_texels(torch.cat(bled))
    stand = config.placement == "even" and not config.placement_learning_rate
    return FitResult(fitted if stand else trimmed(fitted), losses, config, time.perf_counter() - begun)


def fit_inputs(views: ViewDataset, config: FitConfig, tree: TreeFile | None) -> tuple[Any, ...]:
    """What the result of :func:`fit` depends on: the configuration, the training views, and the mesh where billboards are placed by it."""
    return config, views.train.fingerprint, None if tree is None or config.placement == "even" else tree.digest


def _begin(views: ViewDataset, config: ResolvedFit, tree: TreeFile | None, on_place: Callable[[int, int], None] | None) -> _FitState:
    """Before the first step: evenly placed billboards, or what the search finds."""
    if config.placement == "even":
        return _FitState([], start_cloud(views.train, config), None, {}, 0.0)
    if tree is None:
        points = hull_points(views.train, seed=config.seed)
    else:
        points = mesh_points(tree, views.train, seed=config.seed)
    found = find_placement(views.train, points, config, on_place)
    density = config.texel_density * float(pixels_a_meter(views.train.cameras))
    return _FitState([], sized(found, density, config.max_texels), found, {}, 0.0)


def _cloud_of(stepper: Stepper) -> BillboardCloud:
    return stepper.cloud


@dataclass(frozen=True)
class ResolutionLevel:
    """Steps that are taken at one resolution."""

    halvings: int
    """How often the sides of views and textures are halved."""
    begin: int
    """Steps before the level."""
    end: int
    """Steps after the level."""


def levels_of(config: ResolvedFit, cameras: Camera) -> list[ResolutionLevel]:
    """The levels of a resolved configuration, coarse to fine; levels of very small pictures are left out."""
    side = min(cameras.width, cameras.height)
    halvings = [h for h in reversed(range(config.levels)) if h == 0 or side >> h >= LEAST_SIDE]
    edges = [config.steps * i // len(halvings) for i in range(len(halvings) + 1)]
    return [ResolutionLevel(*level) for level in zip(halvings, edges, edges[1:], strict=False)]


def drawn_as(config: ResolvedFit, level: ResolutionLevel, index: int) -> AlphaMode:
    """How step ``index`` (from 0) of a resolved configuration draws: as blend, but for a mask at full resolution.

    There the ramp about the cutoff hardens over the first third of the level's steps, and then is a step. At lower resolutions what is cut
    off at full resolution looks like a blend. A hash looks like one on average.
    """
    if config.alpha != "mask" or level.halvings:
        return BLEND
    share = (index - level.begin) / (_HARDENING * (level.end - level.begin))
    first = max(2.0, 0.5 / min(config.alpha_cutoff, 1 - config.alpha_cutoff))
    hardness = first * (max(first, HARDEST) / first) ** share if share < 1 else math.inf
    return AlphaMode("mask", config.alpha_cutoff, hardness)


def learning_rate(config: ResolvedFit, index: int) -> float:
    """Adam's rate in step ``index`` (from 0) of a resolved configuration.

    ``growth`` is the thesis's schedule, lr_i = lr_(i-1) * (1 + 0.1 / n): over n steps the rate grows by about a tenth.
    """
    if config.schedule == "growth":
        return config.learning_rate * (1 + 0.1 / config.steps) ** index
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * index / config.steps))


def sample_views(config: ResolvedFit, count: int, index: int, halvings: int = 0) -> list[int]:
    """The training views of step ``index``, of ``count``: a function of the seed and the step alone, so that any step can be resumed.

    One view a step is drawn at random with replacement (thesis, algorithm 1); several are dealt from reshuffled decks, so that all
    views come up equally often. Every halving of the resolution doubles their number.
    """
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


def _save(path: Path, key: str, progress: _FitState) -> None:
    tensors = {name: tensor.detach().cpu() for name, tensor in progress.tensors.items()}
    tensors["losses"] = torch.tensor(progress.losses, dtype=torch.float64)
    for prefix, cloud in {_START: progress.start, _FOUND: progress.found}.items():
        for name in TENSORS if cloud is not None else ():
            if prefix == _FOUND or name != "texels":
                tensors[prefix + name] = getattr(cloud, name).clone()  # no two may share memory
    write_tensors(path, tensors, {"fit": key, "seconds": repr(progress.seconds)})


def _load(path: Path, key: str) -> _FitState | None:
    """What is kept in a checkpoint, or ``None`` if there is none for this very fit."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("fit") != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError:
        return None
    parts = {
        prefix: {name.removeprefix(prefix): tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}
        for prefix in (_START, _FOUND)
    }
    texels = parts[_START]["texture_sizes"].prod(-1) * (1 + parts[_START]["two_sided"].long())
    start = BillboardCloud(**parts[_START], texels=torch.zeros(1, 4).expand(int(texels.sum()), 4))
    found = BillboardCloud(**parts[_FOUND]) if parts[_FOUND] else None
    return _FitState(tensors.pop("losses").tolist(), start, found, tensors, float(metadata["seconds"]))
