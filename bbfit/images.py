"""Reading and writing RGBA images, and converting between straight and premultiplied alpha."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from bbfit.checks import MissingFileError, check_shape, fail
from bbfit.files import write_bytes


def read_rgba(path: str | Path) -> NDArray[np.uint8]:
    """Read a straight-alpha PNG or WebP picture as uint8 [H, W, 4] RGBA; 16-bit files are reduced to 8 bits.

    Raises ``MissingFileError`` or ``InputError`` if the file is missing, cut short, damaged, of another format, or has no alpha channel.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"image: {path} does not exist; check the spelling or render the views again")
    data = path.read_bytes()
    png, webp = data.startswith(b"\x89PNG\r\n\x1a\n"), data[:4] == b"RIFF" and data[8:12] == b"WEBP"
    if not png and not webp:  # OpenCV would premultiply a TIFF and return an EXR in linear light
        fail("image", f"{path} is {'neither PNG nor WebP' if data else 'empty'}", "render or copy it again")
    if png and not data.rstrip(b"\0").endswith(b"IEND\xaeB`\x82"):
        fail("image", f"{path} is cut short", "render or copy it again")
    try:
        image = cv2.imdecode(np.frombuffer(_essential(data) if png else data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # the header announces more pixels than OpenCV accepts
        image = None
    if image is None:
        fail("image", f"{path} cannot be decoded", "render or copy it again")
    if image.ndim != 3 or image.shape[2] != 4:
        fail("image", f"{path} has no alpha channel", "give straight-alpha RGBA images")
    if image.dtype == np.uint16:
        image = np.rint(image / 257).astype(np.uint8)
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA))


def _essential(png: bytes) -> bytes:
    """The chunks of a PNG file that its pixels depend on; nothing if one is damaged. libpng would print complaints about the others."""
    kept, start, kind = [png[:8]], 8, b""
    while kind != b"IEND":
        kind, end = png[start + 4 : start + 8], start + 12 + int.from_bytes(png[start : start + 4], "big")
        if end > len(png):
            return b""
        if kind in (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"):
            if zlib.crc32(png[start + 4 : end - 4]) != int.from_bytes(png[end - 4 : end], "big"):
                return b""
            kept.append(png[start:end])
        start = end
    return b"".join(kept)


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Encode uint8 [H, W, 3] RGB or [H, W, 4] straight RGBA as PNG."""
    code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    done, data = cv2.imencode(".png", cv2.cvtColor(image, code), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done
    return data.tobytes()


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write uint8 [H, W, 3 or 4] as PNG, completely or not at all."""
    write_bytes(path, encode_png(image))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Round values in [0, 1] (clamped) to uint8, same shape."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def premultiply(straight: Tensor) -> Tensor:
    """Straight to premultiplied alpha, [..., 4] (Porter and Duff 1984)."""
    return torch.cat([straight[..., :3] * straight[..., 3:], straight[..., 3:]], -1)


def unpremultiply(premultiplied: Tensor) -> Tensor:
    """Premultiplied to straight alpha, [..., 4]; black where alpha is 0."""
    alpha = premultiplied[..., 3:]
    color = torch.where(alpha > 0, premultiplied[..., :3] / alpha.clamp_min(1e-12), 0.0)
    return torch.cat([color.clamp(0, 1), alpha], -1)


def over_color(premultiplied: Tensor, color: float | Tensor = 1.0) -> Tensor:
    """Composite premultiplied RGBA over an opaque background, [..., 4] -> [..., 3]."""
    check_shape("image", (premultiplied.shape[-1],), (4,))
    return premultiplied[..., :3] + (1 - premultiplied[..., 3:]) * color


def bleed_color(texture: Tensor) -> Tensor:
    """Give each transparent texel of a straight RGBA texture, [h, w, 4], the color of the nearest opaque one.

    The texture is uint8 or floating point in [0, 1], and the result has its shape and type. Visible texels are unchanged, and a second call
    changes nothing. If nothing is visible, the result is all zero.

    Filtering straight alpha mixes in the color of transparent texels: next to visible texels in bilinear filtering, everywhere in mip
    levels. A texel is transparent if its alpha rounds to 0 in 8 bits; it becomes exactly 0. A texel is opaque if its alpha is at least half
    of the texture's largest; fainter texels often have a color that no view determined. The nearest texel follows from the exact Euclidean
    distance transform (Felzenszwalb and Huttenlocher 2012).
    """
    alpha = texture[..., 3]
    hidden = (alpha == 0) if texture.dtype == torch.uint8 else (alpha * 255 < 0.5)
    if hidden.all():
        return torch.zeros_like(texture)
    opaque = alpha.double() >= 0.5 * alpha.max().double()
    nearest = ndimage.distance_transform_edt(~opaque.cpu().numpy(), return_distances=False, return_indices=True)
    row, column = torch.from_numpy(nearest).long().to(texture.device)
    filled = torch.cat([texture[row, column, :3], torch.zeros_like(texture[..., 3:])], -1)
    return torch.where(hidden[..., None], filled, texture)
