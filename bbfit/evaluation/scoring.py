"""The evaluation of a billboard cloud on the held-out views of its tree."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import InputError, check_count, check_shape, fail
from bbfit.evaluation import metrics, thesis_scale
from bbfit.evaluation.backgrounds import BACKGROUNDS, mean_psnr, over_background
from bbfit.evaluation.distances import Distances, viewing_distances
from bbfit.evaluation.light import LightScore, score_light
from bbfit.evaluation.measures import Colour, Measures, Over, OverBackground, Rgba, ThesisScale
from bbfit.evaluation.report import Cost, Report, ShimmerScore, SizeScore, ViewScore
from bbfit.evaluation.shading import score_shading
from bbfit.evaluation.shimmer import score_shimmer
from bbfit.evaluation.sizes import HALVINGS, score_sizes
from bbfit.evaluation.trunk import TrunkView, measure_trunk, trunk_score
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.rendering.cards import CardRenderer
from bbfit.views.dataset import TurnedViews
from bbfit.views.lit import LitViews
from bbfit.views.view_set import ViewSet


@dataclass(frozen=True)
class OriginalTree:
    """The size of the tree before it was compressed; ``None`` where it is unknown."""

    vertices: int | None = None
    """Vertices of the mesh."""
    bytes: int | None = None
    """Size of its file and of the files that it refers to."""

    def __post_init__(self) -> None:
        for name in ("vertices", "bytes"):
            if getattr(self, name) is not None:
                check_count(f"original {name}", getattr(self, name), 0)


def evaluate(
    cloud: BillboardCloud,
    views: ViewSet,
    *,
    export: ExportConfig | None = None,
    original: OriginalTree | None = None,
    turned: TurnedViews | None = None,
    lit: LitViews | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Measure a billboard cloud, as it is exported, against views that it was not fitted to.

    Renders are clamped to [0, 1] and not rounded to bytes; targets are the pictures' bytes over 255.

    Parameters
    ----------
    cloud : BillboardCloud
        N >= 1 billboards on any device.
    views : ViewSet
        V held-out views, ``ViewDataset.test``, of at least 11 x 11 pixels.
    export : ExportConfig
        How the model is exported. By default as ``bbfit export`` does without options, in the alpha mode that the cloud was fitted for.
    original : OriginalTree
        The size of the original tree. Without it the report has no ratios.
    turned : TurnedViews
        Pairs of neighboring views, ``ViewDataset.turned``. Without them the report has no shimmer.
    lit : LitViews
        Held-out views under many lights, ``ViewDataset.lit_test``. Without them the report has no score under light.
    on_progress : callable
        Called with the number of finished pictures or picture sizes and their total.

    Returns
    -------
    Report
        The measures of each view and of each picture size, and the costs of the GLB file; ``seconds`` holds the time of this evaluation.

    Raises
    ------
    InputError
        if there are no views or they are too small, if the cloud is empty, or if it draws numbers that are not finite.
    """
    return evaluate_model(shipped_model(cloud, export), views, original=original, turned=turned, lit=lit, on_progress=on_progress)


def evaluate_model(
    model: ShippedModel,
    views: ViewSet,
    *,
    original: OriginalTree | None = None,
    turned: TurnedViews | None = None,
    lit: LitViews | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Do what :func:`evaluate` does for a model whose polygons or file may already be computed."""
    started, original, on_progress = time.perf_counter(), original or OriginalTree(), on_progress or (lambda done, total: None)
    smooth = model.antialiased().draw if model.cloud.alpha.kind == "mask" else None
    baked = views.light[[0]] if views.light is not None else None
    suns = len(lit.other_suns(baked)) if lit is not None and baked is not None else 0
    total, trunks, off = len(views) + HALVINGS + 1 + (turned is not None) + suns, list[TrunkView | None](), list[float]()
    names, elevations = views.names, view_angles(views.cameras)[:, 1].tolist()

    def drawn(index: int) -> Tensor:
        target, image = held_out(model.draw, views, index)
        trunks.append(measure_trunk(names[index], elevations[index], target, image))
        off.append(metrics.silhouette_distance(target.numpy(), image.numpy()))
        return image

    scores = score_views(
        drawn,
        views,
        antialiased=None if smooth is None else lambda index: held_out(smooth, views, index)[1],
        on_view=lambda done, _: on_progress(done, total),
    )
    sizes = score_sizes(model.draw, views, antialiased=smooth, on_size=lambda done, _: on_progress(len(views) + done, total))
    shimmer: tuple[ShimmerScore, ...] = ()
    if turned is not None:
        shimmer = score_shimmer(model.draw, turned, smooth)
        on_progress(total - suns, total)
    light = None
    if lit is not None and baked is not None:
        light = score_model_light(model, lit, baked, lambda done, _: on_progress(total - suns + done, total))
    return Report(
        views=scores,
        vertices=Cost(model.cards.vertex_count, original.vertices),
        bytes=Cost(len(model.glb), original.bytes),
        alpha=model.cloud.alpha,
        overdraw=model.overdraw,
        sizes=sizes,
        shaded=score_shading(CardRenderer(model.cards).fragments, views),
        shimmer=shimmer,
        trunk=trunk_score(trunks),
        light=light,
        distances=_distances(max(off), views, sizes),
        seconds={"evaluate": time.perf_counter() - started},
    )


def _distances(silhouette_pixels: float, views: ViewSet, sizes: Sequence[SizeScore]) -> Distances | None:
    """The verdict on distances; ``None`` if the views do not tell where the tree is."""
    try:
        scale = float(pixels_per_meter(views.cameras))
    except InputError:  # they all look the same way
        return None
    return viewing_distances(silhouette_pixels, scale, [(size.width, size.measures.coverage) for size in sizes])


def score_model_light(
    model: ShippedModel, lit: LitViews, baked: Light, on_view: Callable[[int, int], None] | None = None
) -> LightScore | None:
    """Do what :func:`~bbfit.evaluation.light.score_light` does for a model, whose masks are drawn with alpha to coverage."""
    shown, has_maps = model.antialiased() if model.cloud.alpha.kind == "mask" else model, model.cloud.surface is not None
    draw = shown.draw if has_maps else lambda camera, light: shown.draw(camera)
    return score_light(draw, lit, baked, model.surfaces if has_maps else None, on_view)


def score_views(
    draw: Callable[[int], Tensor],
    views: ViewSet,
    *,
    antialiased: Callable[[int], Tensor] | None = None,
    on_view: Callable[[int, int], None] | None = None,
) -> tuple[ViewScore, ...]:
    """Measure pictures of a tree, whatever drew them, against V held-out views of at least 11 x 11 pixels.

    ``draw`` returns the picture of the view with a given index: premultiplied RGBA in [0, 1], [H, W, 4]. ``antialiased`` does so for a mask
    drawn with alpha to coverage. ``on_view`` is called after each view with the number of finished views and V. Raises InputError if there
    are no views or they are too small.
    """
    if len(views) == 0:
        fail("views", "there is no held-out view to measure on", "give views with a test split")
    metrics.check_size(views.cameras.width, views.cameras.height)
    names, (azimuths, elevations) = views.names, view_angles(views.cameras).T.tolist()
    scores = []
    for index in range(len(views)):
        target = views.targets([index], torch.float64)[0]
        smooth = None if antialiased is None else measure(target, antialiased(index))
        scores.append(ViewScore(names[index], azimuths[index], elevations[index], measure(target, draw(index)), smooth))
        if on_view is not None:
            on_view(index + 1, len(views))
    return tuple(scores)


def held_out(draw: Callable[[Camera], Tensor], views: ViewSet, index: int) -> tuple[Tensor, Tensor]:
    """The target and the render of one view as they are measured: premultiplied RGBA in [0, 1], each float64 [H, W, 4] on the CPU.

    ``draw`` returns what one camera sees, premultiplied RGBA [H, W, 4] (:meth:`~bbfit.exporting.model.ShippedModel.draw`). Raises
    InputError if the picture cannot be read, or if the render has values that are not finite.
    """
    return views.targets([index], torch.float64)[0], drawn_view(draw, views.cameras[index], views.names[index])


def drawn_view(draw: Callable[[Camera], Tensor], camera: Camera, name: str, drawn: str = "cloud") -> Tensor:
    """The render of one camera as it is measured, like that of :func:`held_out`. An error names the view and what was ``drawn``."""
    with torch.inference_mode():
        image = draw(camera).double().cpu()
    if not image.isfinite().all():
        fail(drawn, f"its render of view {name} has values that are not finite", "make it again")
    return image.clamp(0, 1)


def views_psnr(draw: Callable[[Camera], Tensor], views: ViewSet) -> float:
    """The PSNR of a model in dB, the mean over views and :data:`~bbfit.evaluation.backgrounds.BACKGROUNDS`.

    ``draw`` and the errors are those of :func:`held_out`.
    """
    return sum(mean_psnr(*held_out(draw, views, index)) for index in range(len(views))) / len(views)


def measure(target: Tensor, image: Tensor) -> Measures:
    """All measures of one view, from premultiplied RGBA in [0, 1], [H, W, 4], of at least 11 x 11 pixels."""
    check_shape("target", tuple(target.shape), (None, None, 4))
    check_shape("image", tuple(image.shape), tuple(target.shape))
    target, image = (picture.detach().cpu().double() for picture in (target, image))
    rgba = target.numpy(), image.numpy()
    white = over_background(target, image, "white")
    inside = rgba[0][..., 3] >= metrics.ALPHA_THRESHOLD
    return Measures(
        Over(**{name: _over(*over_background(target, image, name)) for name in BACKGROUNDS}),
        Rgba(metrics.root_mean_squared_error(*rgba), metrics.psnr(*rgba), metrics.alpha_iou(*rgba)),
        ThesisScale(thesis_scale.rmse(*rgba), thesis_scale.ssim(*rgba), thesis_scale.psnr(*rgba), thesis_scale.sre(*rgba)),
        Colour(*map(metrics.color_sum, rgba), *(metrics.color_sum(picture, inside) for picture in rgba)),
        metrics.sharpness(*white),
        metrics.brightness(*rgba),
    )


def _over(target: metrics.Image, image: metrics.Image) -> OverBackground:
    return OverBackground(metrics.psnr(target, image), metrics.ssim(target, image), metrics.flip(target, image))


def view_angles(camera: Camera) -> Tensor:
    """The azimuth in [0, 360) and the elevation in [-90, 90] of each camera in degrees, float64 [V, 2].

    Both follow from the viewing direction alone, not from the tree's place. Azimuth 0 looks from +Z, and azimuths grow counter-clockwise
    seen from above, as in :class:`bbfit.geometry.orbit.Orbit`. A camera straight above or below has azimuth 0.
    """
    x, y, z = (-camera.batch().forward.double().cpu()).unbind(-1)
    level = torch.hypot(x, z)
    azimuth = torch.where(level > 1e-9, torch.atan2(x, z), 0.0) * (180 / math.pi)
    elevation = torch.atan2(y, level) * (180 / math.pi)
    # Rounded, or rounding errors would turn 0 into 359.99...
    return torch.stack([azimuth.round(decimals=6) % 360, elevation.round(decimals=6) + 0.0], -1)
