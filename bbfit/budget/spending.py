"""How many texels a number of billboards may have within limits, and what it reaches with them, estimated from short fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bbfit.budget.config import BudgetConfig
from bbfit.budget.trials import Trial, Trials
from bbfit.fitting.config import Placement, Sides

# Estimate before the first trial: bytes for each texture besides its texels, at most this share of a limit, and bytes per texel.
_BYTES_EACH, _MOST_BESIDES, _BYTES_PER_TEXEL = 125, 2 / 3, 2.5
# Fraction of a limit in bytes that trials aim at, how many times too many texels a trial may have, what the texels that the limit leaves
# may be expected to gain over the trial's, in dB, and the most trials until that is so.
_AIM, _MOST_OFF, _MOST_GAIN_DB, _MOST_AIMS = 0.92, 4.0, 0.4, 3
# Fewest texels for each texture of a trial within bytes: with fewer, fewer billboards are better.
_LEAST_EACH = 8
# The least density at which a trial counts as dense as its configuration asks for.
_DENSE = 0.98
# A full fit of as many texels as a trial takes up to 4 % more bytes, and to fit it again costs up to 0.4 dB: it may use this share.
_FULL = 0.95
# The gaps around a texture take about as many bytes as so many texels. In 17 models of 32 to 384 masks of an acer and an aspen, with 8 to
# 360 texels each, the bytes of a texel then differ by 15 % (a standard deviation within a tree), and by 30 % without gaps.
_GAPS = 20
# All bytes but those of the pictures grow with at least this power of the number of textures, and at most in proportion.
_GROWTH = 0.9
# A trial with a share d of the density that its configuration asks for has this many dB times 1 / d - 1 less than a dense one. In trials of
# 8 and 128 billboards of an acer and a poplar with a half to a tenth, in three alpha modes, the median was 0.07, and for the acer 0.1.
_DENSITY_DB = 0.1


@dataclass(frozen=True)
class Spent:
    """What a configuration reaches with all that the limits leave it."""

    trial: Trial
    """The trial that comes nearest to the limits. It may exceed a limit in bytes a little."""
    psnr: float
    """Estimated PSNR of a short fit at the limits, in dB."""
    max_texels: int | None
    """Limit of texels with which a full fit is expected to use nearly all that it may."""
    missing: float
    """What the same billboards are expected to gain without limits, in dB."""


def spent(
    trials: Trials, budget: BudgetConfig, count: int, sides: Sides, placement: Placement, *, anyway: bool = False, least: float = -math.inf
) -> Spent | None:
    """Try a configuration with the texels that the limits leave it. Return ``None`` if it exceeds them.

    With a limit in bytes, up to three trials are run, until one has at most four times the texels that the limit is estimated to leave,
    and these are expected to gain or to cost little. None is run if earlier trials leave less than eight texels for each texture,
    unless ``anyway``, and no more after one that exceeds the limit and has less PSNR than ``least``. The PSNR is that of the trial with
    what the difference in texels is expected to gain or to cost. With a target, no gain is counted.
    """
    limit, most, textures = budget.most_bytes, budget.most_texels, count * (1 if sides == "one" else 2)
    if most is not None and most < textures:
        return None
    if limit is None:
        trial = trials.run(count, sides, placement, most)
        return Spent(trial, trial.psnr, most, _missing(trial, _granted(trial)))

    def left(trial: Trial, share: float = 1.0) -> float:
        return min(texels_within([trial], trial.textures, share * limit), most or math.inf)

    own = list[Trial]()
    for _ in range(_MOST_AIMS):
        texels = allowed(own[-1:] or trials.done, budget, textures)
        if texels < _LEAST_EACH * textures and not anyway:
            break
        texels = max(2 * textures, int(texels))
        if own and own[-1].max_texels == texels:
            break
        own.append(trials.run(count, sides, placement, texels))
        if _is_near(own[-1], left(own[-1])) or (own[-1].bytes > limit and own[-1].psnr < least):
            break
    able = [trial for trial in own if trial.bytes <= limit or _is_near(trial, left(trial))]
    if not able:
        return None
    trial = min(able, key=lambda trial: abs(_gain(trial, left(trial))))
    gain = min(_gain(trial, left(trial)), _MOST_GAIN_DB if budget.target_psnr is None else 0.0)
    return Spent(trial, trial.psnr + gain, max(textures, int(left(trial, _FULL))), _missing(trial, left(trial)))


def allowed(trials: Sequence[Trial], budget: BudgetConfig, textures: int) -> float:
    """Estimate the limit of texels for a trial with a number of textures to stay within a budget of texels or bytes."""
    left = math.inf if budget.most_bytes is None else texels_within(trials, textures, _AIM * budget.most_bytes)
    return min(left, budget.most_texels or math.inf)


def texels_within(trials: Sequence[Trial], textures: int, most_bytes: float) -> float:
    """Estimate the limit of texels with which a model of a number of textures has ``most_bytes`` bytes; at most 0 if there is none.

    The estimate follows the trial that is nearest in number of textures, and then in bytes. The bytes of the pictures grow with the texels
    and with the gaps around textures. Small billboards have simpler outlines, so all other bytes may grow more slowly than the number of
    textures. Of what is possible, the estimate is the highest: a trial shows whether it was too high.
    """
    if not trials:
        return (most_bytes - min(_BYTES_EACH * textures, _MOST_BESIDES * most_bytes)) / _BYTES_PER_TEXEL
    nearest = min(trials, key=lambda trial: (abs(math.log(trial.textures / textures)), abs(math.log(trial.bytes / most_bytes))))
    ratio = textures / nearest.textures
    left = most_bytes - (nearest.bytes - nearest.texture_bytes) * min(ratio, ratio**_GROWTH)
    return left / nearest.texture_bytes * (_granted(nearest) + _GAPS * nearest.textures) - _GAPS * textures


def has_all_texels(trial: Trial) -> bool:
    """Whether a trial is as dense as its configuration asks for, so that a higher limit of texels would change nothing."""
    return trial.density >= _DENSE


def _granted(trial: Trial) -> int:
    """The limit of texels that a trial makes use of."""
    return trial.texels if trial.max_texels is None or has_all_texels(trial) else trial.max_texels


def _missing(trial: Trial, texels: float) -> float:
    """Estimate what a trial's billboards would gain without limits, in dB, over a limit of texels."""
    share = texels / _granted(trial) * (1.0 if has_all_texels(trial) else trial.density)
    return math.inf if share <= 0 else _DENSITY_DB * max(0.0, 1 / share - 1)


def _gain(trial: Trial, texels: float) -> float:
    """Estimate what a limit of texels gains over that of a trial, in dB; less than 0 if it is lower."""
    return _missing(trial, _granted(trial)) - _missing(trial, texels)


def _is_near(trial: Trial, texels: float) -> bool:
    """Whether a trial shows what its billboards reach with a limit of texels."""
    return texels * _MOST_OFF >= _granted(trial) and texels >= 2 * trial.textures and abs(_gain(trial, texels)) <= _MOST_GAIN_DB
