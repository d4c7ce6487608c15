"""The measures of one view, and their means over several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.evaluation.metrics import ColorSum


@dataclass(frozen=True)
class OverBackground:
    """RGB composited over an opaque background, data range 1 (:mod:`bbfit.evaluation.metrics`)."""

    psnr: float
    """Peak signal-to-noise ratio in dB, at most 120."""
    ssim: float
    """Structural similarity with a Gaussian window, in [-1, 1]."""
    flip: float
    """Mean perceived difference, in [0, 1]."""


@dataclass(frozen=True)
class Over:
    """The scores over each of :data:`bbfit.evaluation.backgrounds.BACKGROUNDS`."""

    white: OverBackground
    black: OverBackground
    grass: OverBackground
    sky: OverBackground

    @property
    def mean(self) -> OverBackground:
        """The mean over the four backgrounds; decibels are averaged as decibels."""
        mean: OverBackground = _mean(OverBackground, [getattr(self, name) for name in BACKGROUNDS])
        return mean

    def to_json(self) -> dict[str, dict[str, float]]:
        """The scores over each background and their mean."""
        return {**asdict(self), "mean": asdict(self.mean)}


@dataclass(frozen=True)
class Rgba:
    """Premultiplied RGBA, data range 1 (:mod:`bbfit.evaluation.metrics`)."""

    rmse: float
    """Root mean squared error over all four channels, in [0, 1]."""
    psnr: float
    """Peak signal-to-noise ratio in dB, at most 120."""
    iou: float
    """Intersection over union of the silhouettes, alpha >= 0.5, in [0, 1]."""


@dataclass(frozen=True)
class ThesisScale:
    """Premultiplied RGBA with a peak of 4095, as in the thesis (:mod:`bbfit.evaluation.thesis_scale`)."""

    rmse: float
    """Root mean squared error over 4095."""
    ssim: float
    """Structural similarity with a data range of 4095."""
    psnr: float
    """Peak signal-to-noise ratio in dB, 72.25 above that of data range 1."""
    sre: float
    """Signal-to-reconstruction-error ratio in dB, without the square of the error's norm."""


@dataclass(frozen=True)
class Colour:
    """The mean colors of render and target, whatever their shapes: sums over pixels (:func:`bbfit.evaluation.metrics.color_sum`).

    The figures of several views follow from the sums over all of their pixels (:meth:`pooled`). A figure is ``None`` if the target or the
    render is empty there.
    """

    target: ColorSum
    """Sums of premultiplied RGB and of alpha over the target."""
    render: ColorSum
    """The same over the render."""
    target_inside: ColorSum
    """The sums over the target inside its silhouette, alpha >= 0.5."""
    render_inside: ColorSum
    """The sums over the render inside the target's silhouette."""

    @property
    def delta_e(self) -> float | None:
        """Distance of the mean colors in CIELAB (:func:`bbfit.evaluation.metrics.color_difference`); 0 is best."""
        return metrics.color_difference(self.target, self.render)

    @property
    def chroma(self) -> float | None:
        """Ratio of the chromas of the mean colors (:func:`bbfit.evaluation.metrics.chroma_ratio`); below 1 is paler."""
        return metrics.chroma_ratio(self.target, self.render)

    @property
    def brightness(self) -> float | None:
        """Ratio of the mean colors inside the target's silhouette (:func:`bbfit.evaluation.metrics.brightness_ratio`); below 1 is darker.

        Unlike :attr:`Measures.brightness` it does not count holes in the render as darkness.
        """
        return metrics.brightness_ratio(self.target_inside, self.render_inside)

    @staticmethod
    def pooled(colors: Sequence[Colour]) -> Colour:
        """The sums over several pictures."""
        totals = {}
        for entry in fields(Colour):
            red, green, blue, alpha = (sum(part) for part in zip(*(getattr(one, entry.name) for one in colors), strict=True))
            totals[entry.name] = red, green, blue, alpha
        return Colour(**totals)

    def to_json(self) -> dict[str, Any]:
        """The three figures, and the sums as lists."""
        sums = {entry.name: list(getattr(self, entry.name)) for entry in fields(self)}
        return {"delta_e": self.delta_e, "chroma": self.chroma, "brightness": self.brightness, **sums}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Colour:
        """The colors that :meth:`to_json` returned. Raises ValueError if a sum does not consist of four numbers."""
        sums = {entry.name: tuple(content[entry.name]) for entry in fields(Colour)}
        if any(len(values) != 4 for values in sums.values()):
            raise ValueError("a sum of colors is not of red, green, blue and alpha")
        return Colour(**sums)


@dataclass(frozen=True)
class Measures:
    """All measures of one view, or their means over views."""

    over: Over
    rgba: Rgba
    thesis_scale: ThesisScale
    colour: Colour
    sharpness: float | None
    """Ratio of the mean absolute gradient to that of the target, over white; ``None`` for a flat target."""
    brightness: float | None
    """Ratio of the mean premultiplied color inside the target's silhouette to that of the target, so that holes in the render darken it;
    ``None`` for an empty or black silhouette."""

    @property
    def over_white(self) -> OverBackground:
        """The scores over white, ``over.white``."""
        return self.over.white

    def to_json(self) -> dict[str, Any]:
        """The groups of measures as JSON holds them; ``over_white`` repeats ``over.white``."""
        return {
            "over_white": asdict(self.over_white),
            "over": self.over.to_json(),
            "rgba": asdict(self.rgba),
            "thesis_scale": asdict(self.thesis_scale),
            "colour": self.colour.to_json(),
            "sharpness": self.sharpness,
            "brightness": self.brightness,
        }

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Measures:
        """The measures that :meth:`to_json` returned; other keys are ignored. Raises ValueError for those of an earlier version."""
        if "over" not in content and "over_white" in content:
            raise ValueError("an earlier version of bbfit wrote it, with scores over white only")
        return Measures(
            Over(**{name: OverBackground(**content["over"][name]) for name in BACKGROUNDS}),
            Rgba(**content["rgba"]),
            ThesisScale(**content["thesis_scale"]),
            Colour.from_json(content["colour"]),
            content["sharpness"],
            content["brightness"],
        )


def mean_measures(measures: Sequence[Measures]) -> Measures:
    """The means of one or more views' measures.

    Decibels are averaged as decibels, as in the thesis. A measure's mean leaves out views where it is ``None``. Colors are pooled.
    """
    means: Measures = _mean(Measures, measures)
    return means


def _mean(group: type[Any], items: Sequence[Any]) -> Any:
    """Field by field mean of dataclasses of numbers, ``None``, colors and further such dataclasses."""
    means: dict[str, Any] = {}
    for entry in fields(group):
        values = [value for item in items if (value := getattr(item, entry.name)) is not None]
        if values and isinstance(values[0], Colour):
            means[entry.name] = Colour.pooled(values)
        elif values and is_dataclass(values[0]):
            means[entry.name] = _mean(type(values[0]), values)
        else:
            means[entry.name] = sum(values) / len(values) if values else None
    return group(**means)
