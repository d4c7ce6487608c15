"""The optimization loop (thesis, algorithm 1), which can resume from a checkpoint."""

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

from bbfit.checks import InputError, InputTypeError, check_range, fail
from bbfit.files import write_tensors
from bbfit.fitting.bounds import opaque_bounds, trimmed
from bbfit.fitting.colors import matched_colors, smoothed_colors
from bbfit.fitting.config import FitConfig, ResolvedFit
from bbfit.fitting.coverage import matched_coverage, scaled_coverage
from bbfit.fitting.initialize import bounded, pixels_per_meter, random_textures, sized, start_cloud, tree_radius
from bbfit.fitting.levels import LEAST_SIDE, Targets, resampled, shrunk_sizes
from bbfit.fitting.maps import fit_maps
from bbfit.fitting.movement import Movement
from bbfit.fitting.palette import palettized
from bbfit.fitting.points import placement_points
from bbfit.fitting.requirements import check_cameras, check_device, check_lights
from bbfit.fitting.search import find_placement
from bbfit.fitting.steps import BLEND, HARDEST, Stepper
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import TENSORS, BillboardCloud
from bbfit.images import bleed_color
from bbfit.inputs import reading
from bbfit.provenance import cache_key
from bbfit.scratch import named_in_utf8
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

# Prefixes of the tensors of two clouds in a checkpoint.
_START, _PLACEMENT = "start.", "found."
_ANEW = "remove it to start the fit anew"
# More texels in a checkpoint than any fit has.
_MOST_TEXELS = 1 << 28
# Fraction of the steps at full resolution during which a mask hardens.
_HARDENING = 0.3


@dataclass(frozen=True)
class Step:
    """The state of a fit after an optimizer step."""

    index: int
    """Number of the step, from 1."""
    total: int
    """Total number of steps."""
    loss: float
    """Loss of the step, before its update."""
    learning_rate: float
    """Adam's learning rate in this step."""
    snapshot: Callable[[], BillboardCloud]
    """Copies the current cloud, at the current resolution, to the CPU."""


@dataclass(frozen=True)
class FitResult:
    """A fitted billboard cloud and the record of its fit."""

    cloud: BillboardCloud
    """The fitted cloud, float32 on the CPU."""
    losses: list[float]
    """Loss of every step for placement, color and alpha."""
    config: ResolvedFit
    """The configuration, resolved."""
    seconds: float
    """Duration of the fit, including the time before it was resumed."""


@dataclass
class _FitState:
    """The contents of a checkpoint."""

    losses: list[float]
    """Losses of the finished steps."""
    start: BillboardCloud
    """The rectangles at the start of the level, with their texture sizes at full resolution. The texels are not used."""
    placement: BillboardCloud | None
    """Result of the search for a placement, before the first step."""
    tensors: dict[str, Tensor]
    """State of the stepper after the last step."""
    seconds: float


def fit(
    views: ViewDataset,
    config: FitConfig | None = None,
    *,
    tree: str | Path | TreeFile | None = None,
    placement: BillboardCloud | None = None,
    checkpoint: str | Path | None = None,
    on_step: Callable[[Step], None] | None = None,
    on_place: Callable[[int, int], None] | None = None,
) -> FitResult:
    """Fit a billboard cloud to the training views. The test views are not used.

    A search first finds a placement, unless the configuration requests the even placement. Each step then samples training views, renders
    the cloud from their cameras, and updates the texels and the placement by Adam (Kingma and Ba 2015) on the gradient of the loss. Texels
    are clamped to [0, 1].

    Views and textures start at a coarse resolution, and each level doubles it. Between levels, the rectangles get new bounds around their
    opaque texels. At the end, transparent texels take the color of their neighbors.

    Parameters
    ----------
    views
        Views from around the tree.
    config
        Options of the fit. Default: the preset ``default``.
    tree
        The mesh that the views show, as glTF, OBJ, PLY or STL, for the search for a placement. Default: the visual hull of the views.
    placement
        Billboards with textures to start from in place of a search, as :func:`~bbfit.fitting.search.find_placement` returns them. They
        determine the number and the sides of the billboards. Default: a search, or the even placement. Not with ``checkpoint``.
    checkpoint
        File that stores the state every ``config.checkpoint_every`` steps. If it contains the state of a fit of the same views and mesh
        with the same configuration, the fit resumes from it and ends with the same result as an uninterrupted fit. The caller removes the
        file once the result is saved.
    on_step
        Called after every step, also those of maps, which follow the others.
    on_place
        Called during the search for a placement, with the work done and the total work.

    Raises
    ------
    MissingFileError
        If the mesh is missing.
    InputError
        If a view cannot be read, all are empty, or they look along one line. If the mesh is not of the tree that the views show, or the
        device is not available. If the result is not finite. If both a placement and a checkpoint are given.
    """
    if not isinstance(views, ViewDataset):
        raise InputTypeError(f"views: expected a ViewDataset, got {views!r}; ViewDataset.load(folder) reads one")
    if placement is not None and checkpoint is not None:
        fail("checkpoint", "a fit from a given placement keeps none", "leave one of them out")
    config = (config or FitConfig()).resolve()
    device = check_device(config)
    started = time.perf_counter()
    views.train.check()
    check_cameras(views.train.cameras, config, mesh=tree is not None)
    check_lights(views, config)
    tree_file = None if tree is None or config.placement == "even" else TreeFile.open(tree)
    key = cache_key("fit", *fit_inputs(views, config, tree_file))
    checkpoint = Path(checkpoint) if checkpoint is not None else None
    state = _load(checkpoint, key, config.steps) if checkpoint is not None else None
    if state is None and placement is not None:
        state = _placed_state(views, config, placement)
    elif state is None:
        state = _initial_state(views, config, tree_file, on_place)
        if checkpoint is not None and state.placement is not None:
            _save(checkpoint, key, replace(state, seconds=time.perf_counter() - started))
    started -= state.seconds

    config = config.counted(len(state.start))
    start, fitted, losses = state.start, state.placement, state.losses
    density, radius = config.texel_density * float(pixels_per_meter(views.train.cameras)), tree_radius(views.train)
    for level in resolution_levels(config, views.train.cameras):
        if len(losses) > level.end:
            continue  # the checkpoint is from a later level
        sizes = shrunk_sizes(start, level.halvings)
        cloud = random_textures(start, sizes, config.seed) if fitted is None else resampled(fitted, start, sizes)
        # Compact billboards do not grow: more of them gain more for as many drawn pixels.
        movement = Movement(cloud, radius, grow=not config.locality, steps=config.steps) if config.placement_learning_rate else None
        level_config = config.coarse() if level.halvings else config
        stepper = Stepper(cloud.to(device), Targets.at(views.train, level.halvings), level_config, movement)
        del cloud  # the stepper has its own copy of the texels, which can take hundreds of megabytes
        fitted = None
        if state.tensors and len(losses) > level.begin:
            with reading("checkpoint", checkpoint or "", _ANEW):
                stepper.restore(state.tensors, len(losses) - level.begin)
        for index in range(len(losses), level.end):
            rate = learning_rate(config, index)
            placement_learning_rate = config.placement_learning_rate * rate / config.learning_rate
            indices = sample_views(config, len(views.train), index, level.halvings)
            losses.append(float(stepper.step(indices, rate, placement_learning_rate, step_alpha(config, level, index))))
            if on_step is not None:
                on_step(Step(index + 1, _total_steps(config), losses[-1], rate, partial(getattr, stepper, "cloud")))
            if checkpoint is not None and ((index + 1) % config.checkpoint_every == 0 or index + 1 == config.steps):
                _save(checkpoint, key, _FitState(losses, start, None, stepper.tensors(), time.perf_counter() - started))
        fitted = stepper.finish()
        del stepper
        if movement is not None and level.halvings:
            bounds = opaque_bounds(fitted, grow=not config.locality)
            start = bounded(fitted, bounds, density, config.max_texels).to(torch.float32)
    assert fitted is not None
    shipped = AlphaMode(config.alpha, config.alpha_cutoff)
    kept = fitted.texels[:, 3] >= config.least_alpha
    if not bool(kept.any()):
        fail("least_alpha", f"no texel of the fit reaches {config.least_alpha:g}", "lower it, or raise --steps")
    fitted.texels[:, 3] *= kept
    if config.alpha == "mask":
        fitted = matched_coverage(replace(fitted, alpha=config.drawn_alpha), views.train, config.backend)
    fitted = replace(fitted, alpha=shipped)
    if config.alpha == "coverage":
        fitted = scaled_coverage(fitted, views.train, config.backend)
    # No view determines the colors of transparent texels, but filtering shows them.
    bled = [bleed_color(side).reshape(-1, 4) for texture in fitted.textures() for side in texture]
    fitted = fitted.with_texels(torch.cat(bled))
    if config.light == "maps":
        fitted = trimmed(fitted)
        fitted = fit_maps(fitted, views, config, None if on_step is None else partial(_report_map_step, on_step, fitted, config))
    if config.colors != "joint":
        fitted = matched_colors(smoothed_colors(fitted), views.train, config.backend)
    fitted = palettized(fitted, config.palette)
    if config.placement != "even" or config.placement_learning_rate:
        fitted = trimmed(fitted)
    try:
        fitted.check()
    except InputError as error:
        fail("fit", f"the result cannot be used ({error})", "check the pictures, the cameras and the size of the tree, or lower the rates")
    return FitResult(fitted, losses, config, time.perf_counter() - started)


def _total_steps(config: ResolvedFit) -> int:
    return config.steps + (config.map_steps if config.light == "maps" else 0)


def _report_map_step(
    on_step: Callable[[Step], None], cloud: BillboardCloud, config: ResolvedFit, index: int, loss: float, rate: float
) -> None:
    """Report a step of the fit of maps; a snapshot shows the cloud with baked light that they are fitted for."""
    on_step(Step(config.steps + index, _total_steps(config), loss, rate, lambda: cloud))


def fit_inputs(views: ViewDataset, config: FitConfig, tree: TreeFile | None) -> tuple[Any, ...]:
    """Return the inputs that determine the result of :func:`fit`: configuration, training views, and the mesh if the placement uses it."""
    lit: tuple[str, str | None] | None = None
    if config.light == "maps" and views.lit_train is not None:
        lit = views.lit_train.fingerprint, None if views.train.light is None else views.train.light.fingerprint
    return config, views.train.fingerprint, lit, None if tree is None or config.placement == "even" else tree.digest


def _initial_state(
    views: ViewDataset, config: ResolvedFit, tree: TreeFile | None, on_place: Callable[[int, int], None] | None
) -> _FitState:
    """Place the billboards evenly, or search for a placement."""
    if config.placement == "even":
        try:
            start = start_cloud(views.train, config)
            start.check_rectangles()
        except (torch.linalg.LinAlgError, InputError) as error:
            fail("views", f"their cameras do not show a tree from around it ({error})", "check the cameras")
        return _FitState([], start, None, {}, 0.0)
    points, bark = placement_points(views, config, tree)
    return _placed_state(views, config, find_placement(views.train, points, config, on_place, bark=bark))


def _placed_state(views: ViewDataset, config: ResolvedFit, placement: BillboardCloud) -> _FitState:
    """Start from a placement with textures."""
    density = config.texel_density * float(pixels_per_meter(views.train.cameras))
    return _FitState([], sized(placement, density, config.max_texels), placement, {}, 0.0)


@dataclass(frozen=True)
class ResolutionLevel:
    """The steps of a fit at one resolution."""

    halvings: int
    """Number of times that the sides of views and textures are halved."""
    begin: int
    """Number of steps before the level."""
    end: int
    """Number of steps at the end of the level."""


def resolution_levels(config: ResolvedFit, cameras: Camera) -> list[ResolutionLevel]:
    """Divide the steps of a resolved configuration evenly among levels, from coarse to fine, without levels of very small pictures."""
    side = min(cameras.width, cameras.height)
    halvings = [h for h in reversed(range(config.levels)) if h == 0 or side >> h >= LEAST_SIDE]
    edges = [config.steps * i // len(halvings) for i in range(len(halvings) + 1)]
    return [ResolutionLevel(*level) for level in zip(halvings, edges, edges[1:], strict=False)]


def step_alpha(config: ResolvedFit, level: ResolutionLevel, index: int) -> AlphaMode:
    """Return the alpha mode that step ``index``, from 0, of a resolved configuration renders with.

    It is ``blend``, except for ``mask`` and ``coverage`` at full resolution. There the ramp of a mask around the cutoff hardens over the
    first 30 % of the level's steps and is a step function after that. At lower resolutions, a mask at full resolution looks like ``blend``.
    On average, so does ``hash``.
    """
    if config.alpha != "mask" or level.halvings:
        return BLEND if level.halvings else config.drawn_alpha
    progress = (index - level.begin) / (_HARDENING * (level.end - level.begin))
    first = max(2.0, 0.5 / min(config.alpha_cutoff, 1 - config.alpha_cutoff))
    hardness = first * (max(first, HARDEST) / first) ** progress if progress < 1 else math.inf
    return AlphaMode("mask", config.alpha_cutoff, hardness, config.antialiased)


def learning_rate(config: ResolvedFit, index: int) -> float:
    """Return Adam's learning rate in step ``index``, from 0, of a resolved configuration.

    ``growth`` is the schedule of the thesis, lr_i = lr_(i-1) * (1 + 0.1 / n): the rate grows by about a tenth over n steps.
    """
    if config.schedule == "growth":
        return config.learning_rate * (1 + 0.1 / config.steps) ** index
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * index / config.steps))


def sample_views(config: ResolvedFit, count: int, index: int, halvings: int = 0) -> list[int]:
    """Sample the indices of the training views, out of ``count``, for step ``index``.

    The sample depends only on the seed and the step, so that a fit can resume at any step. A single view per step is sampled with
    replacement (thesis, algorithm 1). Several views per step are taken from random permutations of all views, so that all views occur
    equally often. Every halving of the resolution doubles the number of views.
    """
    requested = config.views_per_step << halvings
    if requested == 1:
        return np.random.default_rng([config.seed, index]).integers(count, size=1).tolist()
    batch = min(requested, count)
    batches = count // batch  # of one permutation
    permutation = np.random.default_rng([config.seed, index // batches]).permutation(count)
    return permutation[index % batches * batch :][:batch].tolist()


def _save(path: Path, key: str, state: _FitState) -> None:
    tensors = {name: tensor.detach().cpu() for name, tensor in state.tensors.items()}
    tensors["losses"] = torch.tensor(state.losses, dtype=torch.float64)
    for prefix, cloud in {_START: state.start, _PLACEMENT: state.placement}.items():
        for name in TENSORS if cloud is not None else ():
            if prefix == _PLACEMENT or name != "texels":
                tensors[prefix + name] = getattr(cloud, name).clone()  # safetensors refuses tensors that share memory
    write_tensors(path, tensors, {"fit": key, "seconds": repr(state.seconds)})


def _load(path: Path, key: str, steps: int) -> _FitState | None:
    """Read a checkpoint, or return ``None`` if the file does not contain one of this fit, or is damaged."""
    try:
        return _read_checkpoint(path, key, steps) if path.is_file() else None
    except InputError:
        return None


def _read_checkpoint(path: Path, key: str, steps: int) -> _FitState | None:
    from safetensors import safe_open

    with reading("checkpoint", path, _ANEW):
        with named_in_utf8(path) as named, safe_open(named, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("fit") != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        if not all(tensor.isfinite().all() for tensor in tensors.values()):
            fail("checkpoint", f"{path} has values that are not finite", _ANEW)
        parts = {
            prefix: {name.removeprefix(prefix): tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}
            for prefix in (_START, _PLACEMENT)
        }
        texels = int((parts[_START]["texture_sizes"].double().prod(-1) * (1 + parts[_START]["two_sided"].long())).sum())
        if texels > _MOST_TEXELS:
            fail("checkpoint", f"{path} has {texels:,} texels", _ANEW)
        start = BillboardCloud(**parts[_START], texels=torch.zeros(1, 4).expand(texels, 4))
        placement = BillboardCloud(**parts[_PLACEMENT]) if parts[_PLACEMENT] else None
        for cloud in (start, placement):
            if cloud is not None:
                cloud.check_rectangles()
        losses, seconds = list(tensors.pop("losses").double().tolist()), float(metadata["seconds"])
        check_range("seconds", seconds, 0, math.inf)
        check_range("steps", len(losses), 0, steps)
        return _FitState(losses, start, placement, tensors, seconds)
