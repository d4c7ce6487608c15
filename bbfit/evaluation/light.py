"""The score under light: a model under suns that no training view had, seen by held-out cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from bbfit.evaluation import metrics
from bbfit.evaluation.backgrounds import BACKGROUNDS, mean_psnr, over_background
from bbfit.geometry.camera import Camera
from bbfit.geometry.light import QUARTER_TURN, SUNNY, Light, angles_degrees, direction
from bbfit.views.lit import SAME_SUN, LitViews
from bbfit.views.view_set import ViewSet

BLOCKS = 15
"""Number of blocks along the tree's larger side in the pictures; the light is compared in the mean colors of blocks."""
# Least mean alpha of the target in a block whose color counts.
_INSIDE = 0.5


@dataclass(frozen=True)
class LightView:
    """One held-out camera under one held-out sun."""

    name: str
    """The picture's name."""
    azimuth_degrees: float
    """Azimuth of the camera, in [0, 360)."""
    elevation_degrees: float
    """Angle of the camera above the horizon, in [-90, 90]."""
    sun_azimuth_degrees: float
    """Azimuth of the sun, in [0, 360), as those of cameras."""
    sun_elevation_degrees: float
    """Angle of the sun above the horizon."""
    psnr: float
    """PSNR in dB, the mean over :data:`~bbfit.evaluation.backgrounds.BACKGROUNDS`."""
    flip: float
    """FLIP, the mean over the same backgrounds."""
    low: float | None
    """Mean squared difference of the mean straight colors of blocks (:data:`BLOCKS`) inside the tree; ``None`` if there is none."""
    change: float
    """Sum over these blocks and channels of the squared change of the target from its baked light to this one."""
    missed: float
    """The same sum of what the model's change differs by."""
    turned: bool
    """Whether this sun is that of the baked light, turned by :data:`~bbfit.geometry.light.QUARTER_TURN` about the vertical."""


@dataclass(frozen=True)
class LightScore:
    """How well a model takes the light of a sun that it was not fitted to, on a sunny day (:data:`~bbfit.geometry.light.SUNNY`)."""

    views: tuple[LightView, ...]
    """One entry for each camera and sun, at least one."""
    albedo: float | None = None
    """Root mean squared difference of the mean base color of blocks from the diffuse color that Blender renders, in [0, 1];
    ``None`` for a model without maps, and for views without these passes."""
    normal_degrees: float | None = None
    """Mean angle in degrees between the mean normals of blocks and those that Blender renders; ``None`` as for ``albedo``."""

    @property
    def psnr(self) -> float:
        """Mean PSNR in dB."""
        return sum(view.psnr for view in self.views) / len(self.views)

    @property
    def flip(self) -> float:
        """Mean FLIP."""
        return sum(view.flip for view in self.views) / len(self.views)

    @property
    def low(self) -> float | None:
        """PSNR in dB of the mean colors of blocks inside the tree, over all views: the light, without the leaves' misfit."""
        known = [view.low for view in self.views if view.low is not None]
        return metrics.decibels(sum(known) / len(known)) if known else None

    @property
    def r2(self) -> float | None:
        """Share of the change with the light that the model reproduces: 1 is all of it, 0 is what a model with baked light has."""
        change = sum(view.change for view in self.views)
        return 1 - sum(view.missed for view in self.views) / change if change > 0 else None

    @property
    def drift(self) -> float | None:
        """Root mean squared difference of the mean colors of blocks, in [0, 1], where the model is turned by a quarter under a fixed sun;
        ``None`` if no view shows that."""
        known = [view.low for view in self.views if view.turned and view.low is not None]
        return math.sqrt(sum(known) / len(known)) if known else None

    def to_json(self) -> dict[str, Any]:
        """``{"psnr", "flip", "low", "r2", "drift", "albedo", "normal_degrees", "suns": [{"azimuth_degrees", "elevation_degrees", "psnr",
        "flip", "low", "r2"}], "cameras": [the same as suns], "views": [..]}``."""
        whole = {"drift": self.drift, "albedo": self.albedo, "normal_degrees": self.normal_degrees}
        suns = self._grouped(lambda view: (view.sun_azimuth_degrees, view.sun_elevation_degrees))
        cameras = self._grouped(lambda view: (view.azimuth_degrees, view.elevation_degrees))
        return self.figures | whole | {"suns": suns, "cameras": cameras, "views": [asdict(view) for view in self.views]}

    def _grouped(self, angles_of: Callable[[LightView], tuple[float, float]]) -> list[dict[str, float | None]]:
        """The means over the views that share angles."""
        groups = dict[tuple[float, float], list[LightView]]()
        for view in self.views:
            groups.setdefault(angles_of(view), []).append(view)
        return [
            {"azimuth_degrees": azimuth, "elevation_degrees": elevation, **LightScore(tuple(views)).figures}
            for (azimuth, elevation), views in groups.items()
        ]

    @property
    def figures(self) -> dict[str, float | None]:
        """The means over all views."""
        return {"psnr": self.psnr, "flip": self.flip, "low": self.low, "r2": self.r2}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> LightScore:
        """The score that :meth:`to_json` returned. Raises ValueError if it has no views."""
        views = tuple(LightView(**view) for view in content["views"])
        if not views:
            raise ValueError("the light has no views")
        return LightScore(views, content["albedo"], content["normal_degrees"])


def score_light(
    draw: Callable[[Camera, Light], Tensor],
    lit: LitViews,
    baked: Light,
    surfaces: Callable[[Camera], Tensor] | None = None,
    on_view: Callable[[int, int], None] | None = None,
) -> LightScore | None:
    """Measure a model under the suns of held-out views, on a sunny day.

    Parameters
    ----------
    draw
        What one camera sees in one light: premultiplied RGBA, [H, W, 4]. A model with baked light ignores the light.
    lit
        ``ViewDataset.lit_test``.
    baked
        The light of the views' own pictures, a batch of one, from which the change is measured.
    surfaces
        The base color and normals that one camera sees, for a model with maps: :meth:`~bbfit.exporting.model.ShippedModel.surfaces`.
    on_view
        Called with the number of finished views and their total.

    Returns
    -------
    LightScore or None
        ``None`` if there is no picture under a sun besides the baked one.
    """
    chosen = lit.other_suns(baked)
    own = {camera: index for index, camera in enumerate(lit.cameras) if index not in chosen}
    sunny = lit.under(*SUNNY)
    assert sunny.light is not None
    scored = [index for index in chosen if lit.cameras[index] in own]
    if not scored:
        return None
    before = lit.under(float(baked.sun_strengths), float(baked.ambients))
    side = max(1, round(max(_extent(sunny, index) for index in scored) / BLOCKS))
    azimuth, elevation = angles_degrees(baked.sun_directions[0])
    quarter = direction(azimuth + QUARTER_TURN, elevation)
    results, at_first = list[LightView](), dict[int, tuple[Tensor, Tensor]]()
    for done, index in enumerate(scored, 1):
        camera = lit.cameras[index]
        if camera not in at_first:
            at_first = {camera: _pair(draw, before, own[camera], baked)}
        target, image = _pair(draw, sunny, index, sunny.light[[index]])
        blocks = [_blocks(picture, side) for picture in (target, image, *at_first[camera])]
        inside = blocks[0][..., 3] >= _INSIDE
        after, drawn, earlier, drawn_earlier = (block[inside][:, :3] / block[inside][:, 3:].clamp_min(1e-3) for block in blocks)
        flips = [metrics.flip(*over_background(target, image, name)) for name in BACKGROUNDS]
        results.append(
            LightView(
                sunny.names[index],
                *angles_degrees(-sunny.cameras[index].forward),
                *angles_degrees(lit.directions[index]),
                mean_psnr(target, image),
                sum(flips) / len(flips),
                float((after - drawn).square().mean()) if len(after) else None,
                float((after - earlier).square().sum()),
                float(((after - earlier) - (drawn - drawn_earlier)).square().sum()),
                bool((lit.directions[index] - quarter).norm() < SAME_SUN),
            )
        )
        if on_view is not None:
            on_view(done, len(scored))
    errors = (None, None) if surfaces is None else _surface_errors(surfaces, lit, sorted({lit.cameras[index] for index in scored}), side)
    return LightScore(tuple(results), *errors)


def _surface_errors(
    surfaces: Callable[[Camera], Tensor], lit: LitViews, cameras: Sequence[int], side: int
) -> tuple[float | None, float | None]:
    """The errors of base color and normals (:class:`LightScore`) for some cameras of lit views."""
    if lit.albedo is None or lit.normal is None:
        return None, None
    colors, angles = list[Tensor](), list[Tensor]()
    for camera in cameras:
        albedo = lit.albedo.targets([camera], torch.float64)[0]
        normals = lit.normals(camera).double() * albedo[..., 3:]
        target = torch.cat([albedo[..., :3], normals, albedo[..., 3:]], -1)
        with torch.inference_mode():
            shown = surfaces(lit.albedo.cameras[camera]).double().cpu()
        before, after = (_blocks(picture, side) for picture in (target, shown))
        inside = before[..., -1] >= _INSIDE
        before, after = before[inside], after[inside]
        colors.append(before[:, :3] / before[:, -1:] - after[:, :3] / after[:, -1:].clamp_min(1e-3))
        cosines = (normalize(before[:, 3:6], dim=-1) * normalize(after[:, 3:6], dim=-1)).sum(-1)
        angles.append(cosines.clamp(-1, 1).acos() * (180 / math.pi))
    if not sum(map(len, angles)):
        return None, None
    return math.sqrt(float(torch.cat(colors).square().mean())), float(torch.cat(angles).mean())


def _pair(draw: Callable[[Camera, Light], Tensor], views: ViewSet, index: int, light: Light) -> tuple[Tensor, Tensor]:
    """The target and the picture of a view, premultiplied RGBA in [0, 1], float64 [H, W, 4]."""
    with torch.inference_mode():
        image = draw(views.cameras[index], light).double().cpu().clamp(0, 1)
    return views.targets([index], torch.float64)[0], image


def _blocks(picture: Tensor, side: int) -> Tensor:
    """Means over blocks of ``side`` x ``side`` pixels, [h, w, 4]; what does not fill a block is left out."""
    side = min(side, *picture.shape[:2])
    return avg_pool2d(picture.permute(2, 0, 1)[None], side)[0].permute(1, 2, 0)


def _extent(views: ViewSet, index: int) -> int:
    """The larger side of the box around what a picture shows, in pixels; 1 if it shows nothing."""
    shown = views.image(index)[..., 3] > 0
    spans = [torch.nonzero(shown.any(axis))[:, 0].tolist() for axis in (0, 1)]
    return max(span[-1] - span[0] + 1 if span else 1 for span in spans)
