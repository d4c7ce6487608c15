"""Bytes of a model, and textures that shrink until a model has few enough."""

from __future__ import annotations

import math

from bbfit.checks import fail
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.levels import resize_textures
from bbfit.geometry.cloud import BillboardCloud
from bbfit.glb import split_glb


def model_bytes(cloud: BillboardCloud, export: ExportConfig) -> int:
    """Return the size of the cloud as GLB, in bytes."""
    return len(shipped_model(cloud, export).glb)


def picture_bytes(glb: bytes) -> int:
    """Return the size of all pictures in a GLB, in bytes."""
    tree, contents = split_glb(glb)
    return sum(len(contents[image["bufferView"]]) for image in tree["images"])


def within_bytes(cloud: BillboardCloud, max_bytes: int | None, export: ExportConfig) -> BillboardCloud:
    """Shrink the textures of a cloud until the exported model has at most ``max_bytes`` bytes; ``None`` is no limit.

    Raises InputError if the model is larger even with one texel per texture.
    """
    while max_bytes is not None and (size := model_bytes(cloud, export)) > max_bytes:
        if int(cloud.texture_sizes.amax()) == 1:
            fail("bytes", f"{max_bytes:,} are too few: {size:,} are needed without textures", "allow more, or fewer billboards")
        sizes = (cloud.texture_sizes * min(0.98, math.sqrt(max_bytes / size))).long().clamp_min(1)
        cloud = resize_textures(cloud, sizes)
    return cloud
