"""The report of an evaluation: the measures of each view, their means, and the costs of the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bbfit.checks import check_file, check_record
from bbfit.evaluation.distances import Distances
from bbfit.evaluation.light import LightScore
from bbfit.evaluation.measures import Measures, mean_measures
from bbfit.evaluation.trunk import TrunkScore
from bbfit.files import read_json, write_json
from bbfit.geometry.alpha import AlphaMode
from bbfit.inputs import reading

_EXPECTED = "write it again with bbfit evaluate"
RING_GAP = 1.0
"""Smallest difference in degrees between the elevations of two rings of views."""


@dataclass(frozen=True)
class ViewScore:
    """One held-out view and its measures."""

    name: str
    """The picture's name."""
    azimuth_degrees: float
    """Azimuth of the camera, in [0, 360): 0 looks from +Z, counter-clockwise seen from above."""
    elevation_degrees: float
    """Angle of the camera above the horizon, in [-90, 90]."""
    measures: Measures
    antialiased: Measures | None = None
    """The measures of a mask that is drawn with alpha to coverage (:class:`~bbfit.geometry.alpha.AlphaMode`), while ``measures`` are those
    of its hard edges; ``None`` for other alpha modes."""

    def to_json(self) -> dict[str, Any]:
        """The name, the angles and the groups of measures in one dictionary."""
        angles = {"azimuth_degrees": self.azimuth_degrees, "elevation_degrees": self.elevation_degrees}
        return {"name": self.name} | angles | _json(self.measures, self.antialiased)


@dataclass(frozen=True)
class RingScore:
    """The views from about the same elevation, and the means of their measures."""

    elevation_degrees: float
    """Their mean elevation."""
    views: int
    """Number of views."""
    measures: Measures
    antialiased: Measures | None = None
    """The means with alpha to coverage, as in :class:`ViewScore`."""

    def to_json(self) -> dict[str, Any]:
        """The elevation, the number of views and the groups of measures in one dictionary."""
        return {"elevation_degrees": self.elevation_degrees, "views": self.views} | _json(self.measures, self.antialiased)


@dataclass(frozen=True)
class SizeMeasures:
    """A model against the held-out views in pictures of one size."""

    psnr: float
    """Peak signal-to-noise ratio in dB, at most 120, the mean over views and :data:`bbfit.evaluation.backgrounds.BACKGROUNDS`."""
    coverage: float | None
    """Ratio of the mean alpha of the renders to that of the targets, over all views: 1 is as dense, below is thinner, above is denser;
    ``None`` if the targets are empty."""
    alpha: float
    """Root mean squared difference of alpha over all pixels of all views, in [0, 1]."""


@dataclass(frozen=True)
class SizeScore:
    """The exported model against the held-out views in pictures of one size (:mod:`bbfit.evaluation.sizes`)."""

    width: int
    """Width of the pictures in pixels."""
    height: int
    """Height of the pictures in pixels."""
    measures: SizeMeasures
    antialiased: SizeMeasures | None = None
    """The same with alpha to coverage, as in :class:`ViewScore`."""

    def to_json(self) -> dict[str, Any]:
        """The size and the measures in one dictionary."""
        antialiased = None if self.antialiased is None else asdict(self.antialiased)
        return {"width": self.width, "height": self.height} | asdict(self.measures) | {"antialiased": antialiased}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> SizeScore:
        """Read what :meth:`to_json` made. Raises KeyError or TypeError if something is missing."""
        names, antialiased = [entry.name for entry in fields(SizeMeasures)], content["antialiased"]
        measures = SizeMeasures(**{name: content[name] for name in names})
        return SizeScore(content["width"], content["height"], measures, None if antialiased is None else SizeMeasures(**antialiased))


@dataclass(frozen=True)
class ShimmerScore:
    """How much the exported model changes when the camera turns by a degree, in pictures of one size (:mod:`bbfit.evaluation.shimmer`)."""

    width: int
    """Width of the pictures in pixels."""
    height: int
    """Height of the pictures in pixels."""
    tree: float
    """The tree's own mean absolute change, over pixels, channels, pairs of views and
    :data:`bbfit.evaluation.backgrounds.BACKGROUNDS`, in [0, 1]."""
    ratio: float | None
    """The model's change over the tree's: above 1 flickers more than the tree; ``None`` if the tree does not change."""
    antialiased: float | None = None
    """The same ratio of a mask that is drawn with alpha to coverage; ``None`` for other alpha modes."""


@dataclass(frozen=True)
class Cost:
    """A cost of the model and of the original tree; ``None`` where it is unknown."""

    model: int | None = None
    """Cost of the billboards."""
    original: int | None = None
    """Cost of the tree."""

    @property
    def ratio(self) -> float | None:
        """Model over original: the ratio in table 1 of the thesis, where it is in percent."""
        return self.model / self.original if self.model is not None and self.original else None

    def to_json(self) -> dict[str, int | float | None]:
        """Both costs and their ratio."""
        return {"model": self.model, "original": self.original, "ratio": self.ratio}


@dataclass(frozen=True)
class Subject:
    """What a report is about, as far as it is known."""

    tree: str | None = None
    """The tree's name."""
    bounds: tuple[tuple[float, ...], ...] | None = None
    """Lowest and highest corner of its bounding box in meters, Y up."""
    sun_direction: tuple[float, ...] | None = None
    """Unit vector towards the sun of the views, Y up."""
    sun_strength: float | None = None
    """Strength of that sun in watts per square meter."""
    ambient: float | None = None
    """Strength of the sky."""
    cloud: str | None = None
    """SHA-256 of the file of the billboard cloud."""

    def to_json(self) -> dict[str, Any]:
        """The fields, with lists in place of tuples."""
        bounds, sun = self.bounds and [list(corner) for corner in self.bounds], self.sun_direction and list(self.sun_direction)
        return asdict(self) | {"bounds": bounds, "sun_direction": sun}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Subject:
        """The subject in ``metrics.json``."""
        bounds, sun = content["bounds"], content["sun_direction"]
        corners = None if bounds is None else tuple(tuple(corner) for corner in bounds)
        return Subject(**{**content, "bounds": corners, "sun_direction": None if sun is None else tuple(sun)})


@dataclass(frozen=True)
class Report:
    """How close an exported billboard cloud comes to the held-out views, and what it costs."""

    views: tuple[ViewScore, ...]
    """One entry per held-out view, in the order of the view set; at least one."""
    vertices: Cost = field(default_factory=Cost)
    """Vertices of the exported mesh and of the original tree."""
    bytes: Cost = field(default_factory=Cost)
    """Sizes of the exported file and of the original tree's file."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall-clock seconds of each stage."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """The alpha mode of the exported model."""
    overdraw: float | None = None
    """Share of the model's area that is drawn although nothing is visible there, in [0, 1]."""
    sizes: tuple[SizeScore, ...] = ()
    """The exported model in smaller and smaller pictures, the largest first."""
    shaded: float | None = None
    """Fragments that a graphics card shades over the pixels that the targets cover (:func:`bbfit.evaluation.shading.score_shading`)."""
    shimmer: tuple[ShimmerScore, ...] = ()
    """The change between neighboring views in smaller and smaller pictures, the largest first; empty if the views have no neighbors."""
    trunk: TrunkScore | None = None
    """The trunk below the crown, or ``None`` if no view from near the horizon shows one."""
    light: LightScore | None = None
    """The model under held-out suns, or ``None`` if the views have one light."""
    distances: Distances | None = None
    """From which distances it looks like the tree, or ``None`` if the scale of the views is not known."""
    subject: Subject = field(default_factory=Subject)
    """The tree, the light and the file of the cloud."""

    @property
    def mean(self) -> Measures:
        """The means over the views (:func:`bbfit.evaluation.measures.mean_measures`)."""
        return mean_measures([view.measures for view in self.views])

    @property
    def antialiased(self) -> Measures | None:
        """The means over the views of a mask that is drawn with alpha to coverage; ``None`` for other alpha modes."""
        return _antialiased(self.views)

    @property
    def rings(self) -> tuple[RingScore, ...]:
        """Means by elevation, from low to high; successive elevations within :data:`RING_GAP` degrees belong to one ring."""
        rings: list[list[ViewScore]] = []
        for view in sorted(self.views, key=lambda view: view.elevation_degrees):
            if not rings or view.elevation_degrees - rings[-1][-1].elevation_degrees > RING_GAP:
                rings.append([])
            rings[-1].append(view)
        return tuple(
            RingScore(
                round(sum(view.elevation_degrees for view in ring) / len(ring), 3),
                len(ring),
                mean_measures([view.measures for view in ring]),
                _antialiased(ring),
            )
            for ring in rings
        )

    def to_json(self) -> dict[str, Any]:
        """The contents of ``metrics.json``; all numbers are finite, and unknown or undefined ones are ``None``.

        Returns
        -------
        dict
            ``{"over_white": {"psnr", "ssim", "flip"}, "over": {"white", "black", "grass", "sky", "mean": {"psnr", "ssim", "flip"} each},
            "rgba": {"rmse", "psnr", "iou"}, "thesis_scale": {"rmse", "ssim", "psnr", "sre"},
            "colour": {"delta_e", "chroma", "brightness", "target", "render", "target_inside", "render_inside"},
            "sharpness", "brightness", "vertices": {"model", "original", "ratio"}, "bytes": {the same}, "overdraw", "shaded",
            "antialiased": {the same measures} or None,
            "trunk": {"iou", "worst_iou", "delta_e", "worst_view", "views": [{"name", "iou", "delta_e"}]} or None,
            "light": {"psnr", "flip", "low", "r2", "drift", "albedo", "normal_degrees", "suns", "cameras", "views"} or None,
            "alpha": {"mode", "cutoff"}, "seconds": {stage: ..},
            "distances": {"silhouette_pixels", "near_meters", "far_meters"} or None,
            "subject": {"tree", "bounds", "sun_direction", "sun_strength", "ambient", "cloud"},
            "sizes": [{"width", "height", "psnr", "coverage", "alpha", "antialiased": {the last three} or None}],
            "shimmer": [{"width", "height", "tree", "ratio", "antialiased"}],
            "rings": [{"elevation_degrees", "views", and the same measures, with "antialiased"}],
            "views": [{"name", "azimuth_degrees", "elevation_degrees", and the same measures, with "antialiased"}]}``
        """
        return _json(self.mean, self.antialiased) | {
            "vertices": self.vertices.to_json(),
            "bytes": self.bytes.to_json(),
            "overdraw": self.overdraw,
            "shaded": self.shaded,
            "trunk": None if self.trunk is None else self.trunk.to_json(),
            "light": None if self.light is None else self.light.to_json(),
            "alpha": {"mode": self.alpha.kind, "cutoff": self.alpha.cutoff},
            "seconds": dict(self.seconds),
            "distances": None if self.distances is None else asdict(self.distances),
            "subject": self.subject.to_json(),
            "sizes": [size.to_json() for size in self.sizes],
            "shimmer": [asdict(size) for size in self.shimmer],
            "rings": [ring.to_json() for ring in self.rings],
            "views": [view.to_json() for view in self.views],
        }

    def save(self, path: str | Path) -> None:
        """Write :meth:`to_json` to a file, completely or not at all."""
        write_json(path, self.to_json())

    @staticmethod
    def load(path: str | Path) -> Report:
        """Read a file that :meth:`save` wrote.

        Raises
        ------
        MissingFileError, InputError
            if the file is missing, damaged, of an earlier version or not a report.
        """
        path = check_file("metrics", path)
        content = read_json("metrics", path)
        with reading("metrics", path, _EXPECTED):
            vertices, sizes = (Cost(content[name]["model"], content[name]["original"]) for name in ("vertices", "bytes"))
            alpha = AlphaMode(content["alpha"]["mode"], content["alpha"]["cutoff"])
            scores = tuple(
                ViewScore(
                    view["name"],
                    view["azimuth_degrees"],
                    view["elevation_degrees"],
                    Measures.from_json(view),
                    None if view["antialiased"] is None else Measures.from_json(view["antialiased"]),
                )
                for view in content["views"]
            )
            afar = tuple(SizeScore.from_json(size) for size in content["sizes"])
            shaded = content["shaded"]
            trunk = None if content["trunk"] is None else TrunkScore.from_json(content["trunk"])
            shimmer = tuple(ShimmerScore(**size) for size in content["shimmer"])
            light = None if content["light"] is None else LightScore.from_json(content["light"])
            seconds, overdraw = dict(content["seconds"]), content["overdraw"]
            distances = None if content["distances"] is None else Distances(**content["distances"])
            subject = Subject.from_json(content["subject"])
            report = Report(scores, vertices, sizes, seconds, alpha, overdraw, afar, shaded, shimmer, trunk, light, distances, subject)
            if not scores:
                raise ValueError("it has no views")
            check_record("report", report, Report)
            return report


def _antialiased(views: Sequence[ViewScore]) -> Measures | None:
    """The means of views with alpha to coverage, or ``None`` if there are none."""
    measures = [view.antialiased for view in views if view.antialiased is not None]
    return mean_measures(measures) if measures else None


def _json(measures: Measures, antialiased: Measures | None) -> dict[str, Any]:
    """The groups of measures, and those with alpha to coverage."""
    return measures.to_json() | {"antialiased": None if antialiased is None else antialiased.to_json()}


def stage_seconds(path: str | Path) -> dict[str, float]:
    """The seconds of each stage in a file that :meth:`Report.save` wrote, also in an earlier version of bbfit.

    Raises MissingFileError or InputError if the file is missing or damaged.
    """
    path = check_file("metrics", path)
    content = read_json("metrics", path)
    with reading("metrics", path, _EXPECTED):
        seconds = dict(content["seconds"])
        check_record("seconds", seconds, dict[str, float])
        return seconds
