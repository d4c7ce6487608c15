"""Compressed textures for the web and for graphics cards: KTX 2.0 with mip levels, and WebP."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_shape, fail
from bbfit.exporting.atlas import BLOCK
from bbfit.exporting.config import ktx2_missing

WEBP_SIDE = 16383
"""The longest side of a WebP picture in texels."""


def encode_ktx2(levels: list[NDArray[np.uint8]], *, srgb: bool = True) -> bytes:
    """Encode mip levels as KTX 2.0 in Basis Universal's ETC1S with BasisLZ, for glTF's extension ``KHR_texture_basisu``.

    The levels are straight-alpha display-referred sRGB, uint8 [h, w, 4] each, or, with ``srgb`` false, data that are no colors, such as
    normals, uint8 [h, w, 3 or 4]. The sides of the first are multiples of 4. Each further level
    has half the sides of the one before, rounded down, at least 1; the last need not be 1 x 1. Raises InputError for levels of other sizes,
    or if the package alktx2 is missing. One release of alktx2 gives the same bytes for the same levels, with any number of threads.

    Graphics cards receive BC, ETC2 or ASTC blocks of one byte per texel. The encoder runs at the best quality of ETC1S. For three atlases
    of fitted trees of about 1000 x 1000 texels, the file with all levels has 22 to 29 % of the bytes of the first level's PNG. The
    premultiplied picture has 37.8 to 44.3 dB at that level, and 0.9 to 2.9 dB less at the next two. UASTC with Zstandard has 1.1 to 3.1 dB
    more, in 53 to 61 % of that PNG; the error of either is far smaller than that of a fit. A texture's coverage at cutoff 0.5 changes by at
    most 0.3 % at levels 0 to 2 and 1.6 % at level 3 where a quarter is covered, and by 0.4 % (3 % at levels 1 to 3) where 1 % is. An atlas
    of 1856 x 1952 texels takes 29 s of one core.
    """
    if missing := ktx2_missing():
        fail("KTX2", "the package alktx2 is not installed", missing)
    if not levels:
        fail("levels", "expected at least one")
    height, width, channels = *levels[0].shape[:2], 4 if srgb or levels[0].shape[-1] == 4 else 3
    if height % BLOCK or width % BLOCK:
        fail("levels", f"sides must be multiples of {BLOCK}, got {width} x {height}")
    for number, level in enumerate(levels):
        check_shape(f"levels[{number}]", level.shape, (max(1, height >> number), max(1, width >> number), channels))
    import alktx2

    opaque = [np.pad(level, ((0, 0), (0, 0), (0, 4 - channels)), constant_values=255) for level in levels]
    raw = [(level.tobytes(), level.shape[1], level.shape[0]) for level in opaque]
    return alktx2.encode_raw_mips_to_ktx2(raw, codec="etc1s", quality=100, effort=3, srgb=srgb)


def encode_webp(image: NDArray[np.uint8], lossless: bool = True) -> bytes:
    """Encode straight RGBA, uint8 [h, w, 4], or RGB as WebP; transparent texels keep their color, because filtering uses it.

    ``lossless`` keeps each texel. Otherwise alpha is exact, and color has quality 90 of 100 at half its resolution. Raises InputError for a
    picture of more than 16,383 texels per side.
    """
    from PIL import Image

    check_shape("image", image.shape, (None, None, image.shape[-1] if image.shape[-1] in (3, 4) else 4))
    if max(image.shape) > WEBP_SIDE:
        fail("image", f"WebP has at most {WEBP_SIDE} texels a side, got {image.shape[1]} x {image.shape[0]}", "write it as PNG")
    file = io.BytesIO()
    if lossless:
        Image.fromarray(image).save(file, "WEBP", lossless=True, quality=80, method=6, exact=True)  # here the effort of the search
    else:
        Image.fromarray(image).save(file, "WEBP", quality=90, alpha_quality=100, method=4, exact=True)
    return file.getvalue()
