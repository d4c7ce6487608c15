"""The score of the trunk: how whole it is below the crown, in every held-out view and in the worst of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from torch import Tensor

from bbfit.evaluation import metrics
from bbfit.fitting.trunk import STEEPEST_DEGREES, trunk_top


@dataclass(frozen=True)
class TrunkView:
    """The trunk below the crown in one held-out view."""

    name: str
    """The picture's name."""
    iou: float
    """Intersection over union of the silhouettes (alpha >= 0.5) below the crown, in [0, 1]."""
    delta_e: float | None
    """CIE 1976 distance of the mean colors below the crown; 0 is best. ``None`` if the render shows nothing there."""


@dataclass(frozen=True)
class TrunkScore:
    """The trunk below the crown, over all views in which there is one."""

    views: tuple[TrunkView, ...]
    """One entry per view that shows a trunk below the crown, at least one."""

    @property
    def worst(self) -> TrunkView:
        """The view with the lowest intersection over union."""
        return min(self.views, key=lambda view: view.iou)

    @property
    def iou(self) -> float:
        """The mean intersection over union."""
        return sum(view.iou for view in self.views) / len(self.views)

    @property
    def delta_e(self) -> float | None:
        """The mean color difference of the views that have one; ``None`` if none has."""
        known = [view.delta_e for view in self.views if view.delta_e is not None]
        return sum(known) / len(known) if known else None

    def to_json(self) -> dict[str, Any]:
        """``{"iou", "worst_iou", "delta_e", "worst_view", "views": [{"name", "iou", "delta_e"}]}``."""
        figures = {"iou": self.iou, "worst_iou": self.worst.iou, "delta_e": self.delta_e, "worst_view": self.worst.name}
        return {**figures, "views": [asdict(view) for view in self.views]}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> TrunkScore:
        """The score that :meth:`to_json` returned. Raises ValueError if it has no views."""
        views = tuple(TrunkView(**view) for view in content["views"])
        if not views:
            raise ValueError("the trunk has no views")
        return TrunkScore(views)


def measure_trunk(name: str, elevation_degrees: float, target: Tensor, image: Tensor) -> TrunkView | None:
    """Measure the trunk below the crown in one view, from premultiplied RGBA in [0, 1], two pictures [H, W, 4].

    All of the rows below the crown count, also to the sides of the trunk. Returns ``None`` if the camera is more than 30 degrees above or
    below the horizon, or if the picture shows no trunk below the crown (:func:`~bbfit.fitting.trunk.trunk_top`).
    """
    top = trunk_top(target[..., 3] >= metrics.ALPHA_THRESHOLD) if abs(elevation_degrees) <= STEEPEST_DEGREES else None
    if top is None:
        return None
    below, drawn = (picture[top:].numpy() for picture in (target, image))
    return TrunkView(name, metrics.alpha_iou(below, drawn), metrics.color_difference(metrics.color_sum(below), metrics.color_sum(drawn)))


def trunk_score(views: Sequence[TrunkView | None]) -> TrunkScore | None:
    """Gather the views that have a trunk; ``None`` if there are none."""
    shown = tuple(view for view in views if view is not None)
    return TrunkScore(shown) if shown else None
