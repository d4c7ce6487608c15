"""The strip of the report that shows a model under other suns, as one held-out camera sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from torch import Tensor

from bbfit.evaluation.light import LightView
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.model import ShippedModel
from bbfit.geometry.light import SUNNY
from bbfit.views.lit import LitViews

_SUNS = 3


@dataclass(frozen=True)
class UnderSun:
    """What a held-out camera sees under one sun, on a sunny day (:data:`~bbfit.geometry.light.SUNNY`)."""

    score: LightView
    """Name, camera, sun and measures."""
    target: Tensor
    """The view, premultiplied RGBA in [0, 1], float64 [H, W, 4]."""
    image: Tensor
    """What the model shows, likewise."""


def under_suns(model: ShippedModel, lit: LitViews, scores: Sequence[LightView]) -> list[UnderSun]:
    """Draw a model under the suns of one camera: at most three that are far apart, by azimuth.

    Of the cameras with the most suns, three or fewer, it is the one nearest to the horizon. ``scores`` are those of
    :class:`~bbfit.evaluation.light.LightScore`, at least one; masks are drawn with alpha to coverage, as they were scored.
    """
    by_camera, indices = dict[int, list[LightView]](), {name: index for index, name in enumerate(lit.suns.names)}
    for score in scores:
        by_camera.setdefault(lit.cameras[indices[score.name]], []).append(score)
    elevations = {number: abs(own[0].elevation_degrees) for number, own in by_camera.items()}
    camera = min(by_camera, key=lambda number: (-min(len(by_camera[number]), _SUNS), elevations[number], number))
    rest = sorted(by_camera[camera], key=lambda score: score.sun_azimuth_degrees)
    chosen = [rest.pop(0)]
    while rest and len(chosen) < _SUNS:
        suns = lit.directions[[indices[score.name] for score in chosen]]
        farthest = min(rest, key=lambda score: float((suns @ lit.directions[indices[score.name]]).max()))
        chosen.append(farthest)
        rest.remove(farthest)

    shown, sunny = model.antialiased() if model.cloud.alpha.kind == "mask" else model, lit.under(*SUNNY)
    assert sunny.light is not None
    strip = []
    for score in sorted(chosen, key=lambda score: score.sun_azimuth_degrees):
        index = indices[score.name]
        light = sunny.light[[index]] if model.cloud.surface is not None else None
        strip.append(UnderSun(score, *held_out(partial(shown.draw, light=light), sunny, index)))
    return strip
