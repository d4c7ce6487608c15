"""Scoring a billboard cloud on the held-out views of its tree."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from bbfit.checks import check_count, check_shape, fail
from bbfit.evaluation import metrics, thesis_scale
from bbfit.evaluation.report import Cost, Measures, OverWhite, Report, Rgba, ThesisScale, ViewScore
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import over_color
from bbfit.rendering.dispatch import render
from bbfit.views import ViewSet


@dataclass(frozen=True)
class OriginalTree:
    """What the tree cost before it was compressed; ``None`` where it is not known."""

    vertices: int | None = None
    """Vertices of the mesh."""
    bytes: int | None = None
    """Size of its file, with the files that it names."""

    def __post_init__(self) -> None:
        for name in ("vertices", "bytes"):
            if getattr(self, name) is not None:
                check_count(f"original {name}", getattr(self, name), 0)


def evaluate(
    cloud: BillboardCloud,
    views: ViewSet,
    *,
    original: OriginalTree | None = None,
    model_bytes: int | None = None,
    seconds: Mapping[str, float] | None = None,
    on_view: Callable[[int, int], None] | None = None,
) -> Report:
    """Measure a billboard cloud against views that it was not fitted to.

    Renders are clamped to [0, 1] and not rounded to bytes; targets are the pictures' bytes over 255.

    Parameters
    ----------
    cloud : N billboards, N >= 0, on any device.
    views : V held-out views, ``ViewDataset.test``, of at least 11 x 11 pixels.
    original : what the tree cost before; its ratios stay open when left out.
    model_bytes : size of the exported file, if there is one yet.
    seconds : seconds of earlier stages by name; this one is added as ``evaluate``.
    on_view : called after each view with the number of views done and of all views.

    Returns
    -------
    :class:`Report` with every measure of each view.

    Raises
    ------
    InputError
        if there are no views, they are too small, or the cloud draws numbers that are not finite.
    """
    began = time.perf_counter()
    scores = score_views(lambda index: held_out(cloud, views, index)[1], views, on_view=on_view)
    original = original or OriginalTree()
    return Report(
        scores,
        Cost(cloud.vertex_count, original.vertices),
        Cost(model_bytes, original.bytes),
        {**(seconds or {}), "evaluate": time.perf_counter() - began},
        cloud.alpha,
    )


def score_views(
    draw: Callable[[int], Tensor], views: ViewSet, *, on_view: Callable[[int, int], None] | None = None
) -> tuple[ViewScore, ...]:
    """Measure whatever draws a tree against held-out views.

    Parameters
    ----------
    draw : premultiplied RGBA in [0, 1] of the view with a number, [H, W, 4].
    views : V held-out views, of at least 11 x 11 pixels.
    on_view : called after each view with the number of views done and of all views.

    Raises
    ------
    InputError
        if there are no views or they are too small.
    """
    if len(views) == 0:
        fail("views", "there is no held-out view to measure on", "give views with a test split")
    metrics.check_size(views.cameras.width, views.cameras.height)
    names, (azimuths, elevations) = views.names, view_angles(views.cameras).T.tolist()
    scores = []
    for index in range(len(views)):
        target = views.targets([index], torch.float64)[0]
        scores.append(ViewScore(names[index], azimuths[index], elevations[index], measure(target, draw(index))))
        if on_view is not None:
            on_view(index + 1, len(views))
    return tuple(scores)


def held_out(cloud: BillboardCloud, views: ViewSet, index: int) -> tuple[Tensor, Tensor]:
    """One view's target and render as they are measured: premultiplied RGBA in [0, 1], each float64 [H, W, 4] on the CPU.

    Raises
    ------
    InputError
        if the picture cannot be read, or the cloud draws numbers that are not finite.
    """
    target = views.targets([index], torch.float64)[0]
    with torch.inference_mode():
        image = render(cloud, views.cameras[index].to(cloud.texels.device)).double().cpu()
    if not image.isfinite().all():
        fail("cloud", f"what it draws in view {views.names[index]} holds numbers that are not finite", "fit it anew")
    return target, image.clamp(0, 1)


def measure(target: Tensor, image: Tensor) -> Measures:
    """Every measure of one view.

    Parameters
    ----------
    target, image : premultiplied RGBA in [0, 1], [H, W, 4], at least 11 x 11 pixels.
    """
    check_shape("target", tuple(target.shape), (None, None, 4))
    check_shape("image", tuple(image.shape), tuple(target.shape))
    rgba = tuple(picture.detach().cpu().double().numpy() for picture in (target, image))
    white = tuple(over_color(picture.detach().cpu().double()).numpy() for picture in (target, image))
    return Measures(
        OverWhite(metrics.psnr(*white), metrics.ssim(*white), metrics.flip(*white)),
        Rgba(metrics.root_mean_squared_error(*rgba), metrics.psnr(*rgba), metrics.alpha_iou(*rgba)),
        ThesisScale(
            thesis_scale.rmse(*rgba),
            thesis_scale.ssim(*rgba),
            thesis_scale.psnr(*rgba),
            thesis_scale.sre(*rgba),
        ),
        metrics.sharpness(*white),
        metrics.brightness(*rgba),
    )


def view_angles(camera: Camera) -> Tensor:
    """Azimuth in [0, 360) and elevation in [-90, 90] that each camera looks from, in degrees, [V, 2] float64.

    By the viewing direction, so it does not matter where the tree stands: azimuth 0 looks from +Z, counter-clockwise seen from above
    (as :class:`bbfit.geometry.orbit.Orbit`). A camera straight above or below has azimuth 0.
    """
    x, y, z = (-camera.batch().forward.double().cpu()).unbind(-1)
    level = torch.hypot(x, z)
    azimuth = torch.where(level > 1e-9, torch.atan2(x, z), 0.0) * (180 / math.pi)
    elevation = torch.atan2(y, level) * (180 / math.pi)
    # Rounded, or rounding errors would turn 0 into 359.99...
    return torch.stack([azimuth.round(decimals=6) % 360, elevation.round(decimals=6) + 0.0], -1)
