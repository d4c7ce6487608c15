"""Compressed pictures for the web and for graphics cards: KTX 2.0 with mip levels, and WebP."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_shape, fail
from bbfit.exporting.atlas import BLOCK
from bbfit.exporting.config import ktx2_missing

# The longest side that WebP has bits for.
_WEBP_SIDE = 16383


def encode_ktx2(levels: list[NDArray[np.uint8]]) -> bytes:
    """Encode mip levels as KTX 2.0 in Basis Universal's ETC1S with BasisLZ, which glTF takes by ``KHR_texture_basisu``.

    Graphics cards get it as BC, ETC2 or ASTC blocks, a byte a texel. Quality is the best that ETC1S has: of three atlases of fitted
    trees, about 1000 x 1000 texels with all levels, it makes 22 to 29 % of the bytes of the first level's PNG, and the premultiplied
    picture keeps 37.8 to 44.3 dB there, 0.9 to 2.9 dB less at the next two levels. UASTC with Zstandard has 1.1 to 3.1 dB more, in 53 to
    61 % of that PNG; either differs from the atlas by far less than a fit does from its views. A texture's coverage at cutoff 0.5 moves
    by at most 0.3 % at levels 0 to 2 and 1.6 % at level 3 where a quarter is covered, by 0.4 % and at levels 1 to 3 by 3 % where 1 % is.
    1856 x 1952 texels take 29 s of one core.

    The same levels give the same bytes, whatever the number of threads, by the same release of alktx2.

    Parameters
    ----------
    levels : straight-alpha display-referred sRGB, uint8 [h, w, 4] each. The sides of the first are multiples of 4, each further one
        has half the sides of the one before, rounded down, at least 1; the last need not be 1 x 1.

    Raises
    ------
    InputError
        if the package alktx2 is missing, or for levels of other sizes.
    """
    if missing := ktx2_missing():
        fail("KTX2", "the package alktx2 is not there", missing)
    if not levels:
        fail("levels", "expected at least one")
    height, width = levels[0].shape[:2]
    if height % BLOCK or width % BLOCK:
        fail("levels", f"sides must be multiples of {BLOCK}, got {width} x {height}")
    for number, level in enumerate(levels):
        check_shape(f"levels[{number}]", level.shape, (max(1, height >> number), max(1, width >> number), 4))
    import alktx2

    raw = [(level.tobytes(), level.shape[1], level.shape[0]) for level in levels]
    return alktx2.encode_raw_mips_to_ktx2(raw, codec="etc1s", quality=100, effort=3, srgb=True)


def encode_webp(image: NDArray[np.uint8], lossless: bool = True) -> bytes:
    """Encode straight RGBA, uint8 [h, w, 4], as WebP; the color of transparent texels stays, for filtering finds it.

    Parameters
    ----------
    image : at most 16,383 texels a side.
    lossless : texel for texel; otherwise alpha is exact and color at quality 90 of 100, at half of its resolution.

    Raises
    ------
    InputError
        for a larger picture.
    """
    from PIL import Image

    check_shape("image", image.shape, (None, None, 4))
    if max(image.shape) > _WEBP_SIDE:
        fail("image", f"WebP has at most {_WEBP_SIDE} texels a side, got {image.shape[1]} x {image.shape[0]}", "write it as PNG")
    file = io.BytesIO()
    if lossless:
        Image.fromarray(image).save(file, "WEBP", lossless=True, quality=80, method=6, exact=True)  # quality: of the search
    else:
        Image.fromarray(image).save(file, "WEBP", quality=90, alpha_quality=100, method=4, exact=True)
    return file.getvalue()
