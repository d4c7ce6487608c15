"""Bytes of a model, and textures that get fewer texels until a model has few enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from bbfit.checks import fail
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import OnExport, ShippedModel, shipped_model, silent_export
from bbfit.fitting.levels import resize_textures
from bbfit.fitting.loop import FitResult, Step, fit
from bbfit.fitting.palette import palettized
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import split_glb
from bbfit.views.dataset import ViewDataset

# The most steps of a fit that is repeated with fewer texels, the factor on its learning rate, the fraction of the limit that it aims at,
# the fraction that is enough, and the most repetitions.
_STEPS, _RATE, _AIM, _ENOUGH, _MOST_FITS = 100, 1 / 3, 0.98, 0.93, 5
# With which power of a model's texels its pictures grow, and the triangles of pieces. With a seventh to two thirds of the texels of an
# acer's 379 masks it was 0.52 to 0.60 and 0.03 to 0.15.
_PICTURES, _PIECES = 0.55, 0.15
# How many times a limit the estimated size of a model with another outline may be, so that the model is made and measured.
_DOUBT = 1.02


def model_bytes(cloud: BillboardCloud, export: ExportConfig) -> int:
    """Return the size of the cloud as GLB, in bytes."""
    return len(shipped_model(cloud, export).glb)


def picture_bytes(glb: bytes) -> int:
    """Return the size of all pictures in a GLB, in bytes."""
    return _parts(glb)[0]


def _parts(glb: bytes) -> tuple[int, int]:
    """The bytes of all pictures in a GLB, and of its vertices and triangles."""
    tree, contents = split_glb(glb)
    pictures = sum(len(contents[image["bufferView"]]) for image in tree["images"])
    return pictures, sum(map(len, contents)) - pictures


def fitted_within_bytes(
    views: ViewDataset, result: FitResult, max_bytes: int, export: ExportConfig, *, on_step: Callable[[Step], None] | None = None
) -> BillboardCloud:
    """Return the cloud of a fit, with fewer texels if the exported model has more than ``max_bytes`` bytes.

    The textures are then fitted to the training views again, each time from the result on, for at most 100 steps in the same placement. How
    many texels the limit leaves is estimated from the sizes so far; a model of less than 0.93 of the limit is fitted again with more
    texels. Resized textures without new steps are worse, by 0.2 to 0.8 dB on the views of the tests, as masks with smooth edges. They are
    the last resort (:func:`within_bytes`, which raises its error). ``on_step`` is called after each step.
    """
    whole, config = result.cloud, result.config
    short = {
        "levels": 1,
        "trunk_billboards": None,
        "steps": min(config.steps, _STEPS),
        "placement_learning_rate": 0.0,
        "learning_rate": _RATE * config.learning_rate,
    }
    cloud, texels, best = whole, len(whole.texels), None
    large = small = (0, 0)  # limits of texels and bytes of the smallest model that is too large, and of the largest that is not
    for fits in range(_MOST_FITS + 1):
        glb = shipped_model(cloud, export).glb
        if len(glb) > max_bytes:
            large = texels, len(glb)
        else:
            small, best = (texels, len(glb)), cloud
            if fits == 0 or len(glb) >= _ENOUGH * max_bytes:
                break
        growth = _growth(glb, export) if best is None else math.log(large[1] / small[1]) / math.log(large[0] / small[0])
        texels = int(large[0] * min(_AIM, (_AIM * max_bytes / large[1]) ** (1 / growth)))
        if fits == _MOST_FITS or texels <= max(small[0], whole.vertex_count // 2):  # two for each texture
            break
        cloud = fit(views, replace(config, billboards=len(whole), max_texels=texels, **short), placement=whole, on_step=on_step).cloud  # type: ignore[arg-type]
    return within_bytes(cloud, max_bytes, export, palette=config.palette) if best is None else best


def _growth(glb: bytes, export: ExportConfig) -> float:
    """Estimate with which power of its texels the size of a model grows."""
    pictures, triangles = _parts(glb)
    return (_PICTURES * pictures + (_PIECES * triangles if export.resolve().outline == "pieces" else 0.0)) / len(glb)


def within_bytes(cloud: BillboardCloud, max_bytes: int | None, export: ExportConfig, *, palette: int = 0) -> BillboardCloud:
    """Resize the textures of a cloud until the exported model has at most ``max_bytes`` bytes; ``None`` is no limit.

    A ``palette`` above 0 is the number of colors of the resized textures (:func:`~bbfit.fitting.palette.palettized`).

    Raises InputError if the model is larger even with one texel per texture.
    """
    whole, scale = cloud, 1.0
    while max_bytes is not None and (size := model_bytes(cloud, export)) > max_bytes:
        if int(cloud.texture_sizes.amax()) == 1:
            fail("bytes", f"{max_bytes:,} are too few: {size:,} are needed without textures", "allow more, or fewer billboards")
        scale *= min(0.98, math.sqrt(max_bytes / size))
        cloud = palettized(resize_textures(whole, (whole.texture_sizes * scale).long().clamp_min(1)), palette)
    return cloud


def finest_within_bytes(
    cloud: BillboardCloud, exports: Sequence[ExportConfig], max_bytes: int, on_progress: OnExport = silent_export
) -> ShippedModel:
    """The model of a cloud with the first of ``exports`` with which it has at most ``max_bytes`` bytes, or else with the last.

    ``exports`` differ only in their outlines and have ever fewer vertices (:meth:`~bbfit.exporting.config.ExportConfig.outlines`). Models
    that are estimated to be too large are not made: the triangles are about proportional to the vertices.
    """
    *finer, last = exports
    model = shipped_model(cloud, last, on_progress=on_progress)
    if finer:
        size, vertices, pieces = len(model.glb), model.cards.vertex_count, model.count_pieces()
        each = _parts(model.glb)[1] / vertices
        for export in finer:
            polygons = pieces if export.outline == "pieces" else len(model.cards.cards)
            if size + each * (polygons * export.resolve().corners - vertices) <= _DOUBT * max_bytes:
                other = shipped_model(cloud, export, on_progress=on_progress)
                if len(other.glb) <= max_bytes:
                    return other
    return model
