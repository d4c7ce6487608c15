"""How many texels a number of billboards may have within limits, and what it reaches with them, estimated from short fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

from bbfit.budget.config import BudgetConfig
from bbfit.budget.trials import Trial, Trials
from bbfit.fitting.config import Placement, Sides

# Estimate of the bytes per texel before the first trial.
_BYTES_PER_TEXEL = 2.0
# Fraction of a limit in bytes that trials aim at, the least that one has to use, and the most trials until one does.
_AIM, _MIN_USE, _MOST_AIMS = 0.92, 0.6, 3
# A trial that has less than this fraction of the texels that it may have is as dense as its configuration asks for.
_MIN_TEXELS = 0.6
# Of fewer texels for each texture than this, a part is lost by rounding, so that such a trial says nothing about its density.
_LEAST_EACH = 16
# All bytes but those of the pictures grow with at least this power of the number of textures, and at most in proportion. Trials of 32 to
# 384 billboards of an acer and an aspen had powers of 0.33 to 0.85.
_GROWTH = 0.6
# Gain in dB for twice the texels, before trials show it, and the least ratio of texels that shows it.
_TEXEL_GAIN_DB, _LEAST_RATIO = 0.4, 1.3


@dataclass(frozen=True)
class Spent:
    """What a configuration reaches with all that the limits leave it."""

    trial: Trial
    """The trial within the limits that comes nearest to them."""
    psnr: float
    """Estimated PSNR of a short fit at the limits, in dB."""
    max_texels: int | None
    """Limit of texels with which a short fit is expected to use all that it may. A full fit uses a little more and compresses better."""


def spent(trials: Trials, budget: BudgetConfig, count: int, sides: Sides, placement: Placement, *, anyway: bool = False) -> Spent | None:
    """Try a configuration with the texels that the limits leave it. Return ``None`` if it exceeds them.

    With a limit in bytes, up to three trials are run, until one is within the limit and uses most of it. None is run if earlier trials show
    that the limit is too low for so many billboards, unless ``anyway``. The PSNR is that of the trial and what the rest of the limit is
    expected to gain; with a target, only what the trial has counts.
    """
    limit, most = budget.most_bytes, budget.most_texels
    if limit is None:
        trial = trials.run(count, sides, placement, most)
        return Spent(trial, trial.psnr, most)
    textures, own = count * (1 if sides == "one" else 2), list[Trial]()
    for _ in range(_MOST_AIMS):
        left = texels_within(own[-1:] or trials.done, textures, _AIM * limit)
        if left <= 0 and not anyway:
            break
        texels = max(2 * textures, min(int(left), most or 1 << 40))
        if own and own[-1].max_texels == texels:
            break
        own.append(trials.run(count, sides, placement, texels))
        if own[-1].bytes <= limit and (own[-1].bytes >= _MIN_USE * limit or has_all_texels(own[-1])):
            break
    within = [trial for trial in own if trial.bytes <= limit]
    if not within:
        return None
    trial = max(within, key=lambda trial: trial.bytes)
    left = min(texels_within([trial], textures, limit), most or math.inf)
    octaves = 0.0 if has_all_texels(trial) else math.log2(left / _granted(trial))
    gain = 0.0 if budget.target_psnr is not None else texel_gain(trials.done) * min(1.0, octaves)
    return Spent(trial, trial.psnr + gain, min(int(left), most or 1 << 40))


def texels_within(trials: Sequence[Trial], textures: int, most_bytes: float) -> float:
    """Estimate the limit of texels with which a model of a number of textures has ``most_bytes`` bytes; at most 0 if there is none.

    The estimate follows the trial that is nearest in number of textures, and then in bytes. The bytes of the pictures are taken to be
    proportional to texels. Small billboards have simpler outlines, so all other bytes may grow more slowly than the number of textures. Of
    what is possible, the estimate is the highest: a trial shows whether it was too high.
    """
    if not trials:
        return most_bytes / _BYTES_PER_TEXEL
    nearest = min(trials, key=lambda trial: (abs(math.log(trial.textures / textures)), abs(math.log(trial.bytes / most_bytes))))
    ratio = textures / nearest.textures
    left = most_bytes - (nearest.bytes - nearest.texture_bytes) * min(ratio, ratio**_GROWTH)
    return _granted(nearest) * left / nearest.texture_bytes


def texel_gain(trials: Sequence[Trial]) -> float:
    """Estimate what twice the texels gain, in dB, from the trials of equal billboards with different numbers of texels."""
    gains = []
    for first, second in combinations(trials, 2):
        same = (first.billboards, first.sides, first.placement) == (second.billboards, second.sides, second.placement)
        octaves = math.log2(second.texels / first.texels)
        if same and abs(octaves) >= math.log2(_LEAST_RATIO):
            gains.append((second.psnr - first.psnr) / octaves)
    return max(0.0, fmean(gains)) if gains else _TEXEL_GAIN_DB


def has_all_texels(trial: Trial) -> bool:
    """Whether a trial is as dense as its configuration asks for, so that a higher limit of texels would change nothing."""
    if trial.max_texels is None:
        return True
    return trial.texels < _MIN_TEXELS * trial.max_texels and trial.max_texels >= _LEAST_EACH * trial.textures


def _granted(trial: Trial) -> int:
    """The limit of texels that a trial makes use of."""
    return trial.texels if trial.max_texels is None or has_all_texels(trial) else trial.max_texels
