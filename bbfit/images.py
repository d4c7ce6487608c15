"""Reading and writing RGBA images, and converting between straight and premultiplied alpha."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import ndimage
from torch import Tensor

from bbfit.checks import MissingFileError, check_count, check_shape, fail
from bbfit.files import write_bytes
from bbfit.inputs import InputLimits, reading

_LIMITS = InputLimits()
_AGAIN = "render or copy it again"
# Headers of the formats that Pillow cannot read are shorter.
_HEADER_BYTES = 1 << 16
# The formats of textures and views. Pillow reads others by running other programs, or line by line.
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "DIB", "TGA", "SGI", "JPEG2000", "DDS", "PSD", "GIF", "PPM")
logging.getLogger("PIL").addHandler(logging.NullHandler())  # what Pillow says of damaged files is in the errors that it raises
# Channels of the kinds of PNG that have an alpha channel.
_CHANNELS = {4: 2, 6: 4}
PALETTE = 256
"""Most colors of a PNG with a palette."""
_PNG = b"\x89PNG\r\n\x1a\n"
# Guards a global limit of Pillow's.
_PILLOW = threading.Lock()


@dataclass(frozen=True)
class PictureHeader:
    """What the header of a picture says."""

    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    alpha: bool
    """Whether it has an alpha channel or a transparent color."""


def picture_header(name: str, path: str | Path, limits: InputLimits, data: bytes | None = None) -> PictureHeader | None:
    """Read the header of a picture, which is in ``data`` if given, and decode nothing. ``None`` for an unknown format.

    Raises ``InputError`` with the input's ``name`` if the header is damaged, or announces more pixels than ``limits`` allow.
    """
    with reading(name, path, _AGAIN), Path(path).open("rb") if data is None else io.BytesIO(data) as file:
        start = file.read(_HEADER_BYTES)
        size = _radiance_size(start) or _openexr_size(start)
        header = PictureHeader(*size, alpha=False) if size else _png_header(file) if start.startswith(_PNG) else None
        if header is None:
            try:
                with _opened(path if data is None else data) as picture:
                    header = PictureHeader(*picture.size, "A" in picture.getbands() or "transparency" in picture.info)
            except UnidentifiedImageError:
                return None
        limits.at_most("max_input_pixels", name, path, header.width * header.height, "pixels")
        return header


def _png_header(file: BinaryIO) -> PictureHeader:
    """The header of a PNG, whatever else the file contains: Pillow would also read texts, profiles and dates before the pixels."""
    file.seek(len(_PNG))
    size, alpha = (0, 0), False
    while len(head := file.read(8)) == 8 and head[4:] != b"IDAT":
        if head[4:] == b"IHDR":
            width, height, _, color = struct.unpack(">IIBB", file.read(10))
            size, alpha = (width, height), color in _CHANNELS
            file.seek(-10, io.SEEK_CUR)
        alpha |= head[4:] == b"tRNS"
        file.seek(int.from_bytes(head[:4], "big") + 4, io.SEEK_CUR)
    if not all(size):
        raise ValueError("it has no pixels")
    return PictureHeader(*size, alpha)


@contextlib.contextmanager
def _opened(source: str | Path | bytes) -> Iterator[Image.Image]:
    """A picture of which only the header is read. Pillow's own limit of pixels and its warnings are off while it opens the file."""
    with _PILLOW, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            picture = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=_FORMATS)
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    with picture:
        yield picture


def _radiance_size(start: bytes) -> tuple[int, int] | None:
    """Width and height of a Radiance picture (.hdr)."""
    found = re.search(rb"\n[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n", start) if start.startswith(b"#?") else None
    return (int(found[2]), int(found[1])) if found else None


def _openexr_size(start: bytes) -> tuple[int, int] | None:
    """Width and height of an OpenEXR picture."""
    at = start.find(b"dataWindow\0box2i\0") if start.startswith(b"\x76\x2f\x31\x01") else -1
    if at < 0:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", start, at + 21)
    return max(right - left + 1, 0), max(bottom - top + 1, 0)


def read_rgba(path: str | Path, limits: InputLimits = _LIMITS) -> NDArray[np.uint8]:
    """Read a straight-alpha PNG or WebP picture as uint8 [H, W, 4] RGBA; 16-bit files are reduced to 8 bits.

    Raises ``MissingFileError`` or ``InputError`` if the file is missing, cut short, damaged, too large, of another format, or has no alpha
    channel. Nothing is decoded before its size is known.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"image: {path} does not exist; check the spelling or render the views again")
    limits.at_most("max_input_bytes", "image", path, path.stat().st_size, "bytes")
    with reading("image", path, _AGAIN):
        data = path.read_bytes()
        png, webp = data.startswith(_PNG), data[:4] == b"RIFF" and data[8:12] == b"WEBP"
        if not png and not webp:  # OpenCV would premultiply a TIFF and return an EXR in linear light
            fail("image", f"{path} is {'neither PNG nor WebP' if data else 'empty'}", _AGAIN)
        if png and not data.rstrip(b"\0").endswith(b"IEND\xaeB`\x82"):
            fail("image", f"{path} is cut short", _AGAIN)
        header = picture_header("image", path, limits, data)
        if header is None:
            fail("image", f"{path} cannot be read", _AGAIN)
        if not header.alpha:
            fail("image", f"{path} has no alpha channel", "give straight-alpha RGBA images")
        image = _decoded_png(data) if png else _decoded_by_opencv(data)
    if image.dtype == np.uint16:
        image = np.rint(image / 257).astype(np.uint8)
    return np.ascontiguousarray(image)


def _decoded_png(data: bytes) -> NDArray[Any]:
    """Pillow decodes every PNG, because OpenCV writes what is wrong with a damaged one to standard error.

    Pillow discards half of 16 bits. OpenCV decodes those, after a check of all that it would complain about.
    """
    start, needed, pixels, kind = len(_PNG), [_PNG], [b""], b""
    while kind != b"IEND":  # what follows is of no concern, nor are texts, profiles and dates
        kind, end = data[start + 4 : start + 8], start + 8 + int.from_bytes(data[start : start + 4], "big")
        if end + 4 > len(data):
            raise ValueError("it is cut short")
        if kind in (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"):
            if zlib.crc32(data[start + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
                raise ValueError("its checksum is wrong")
            needed.append(data[start : end + 4])
            pixels += [data[start + 8 : end]] if kind == b"IDAT" else []
        start = end + 4
    data = b"".join(needed)
    with _opened(data) as picture:
        picture.load()
        if data[24] != 16:
            return np.array(picture.convert("RGBA"))
    width, height, _, color, *rest = struct.unpack(">IIBBBBB", data[16:29])
    stride = 1 + width * 2 * _CHANNELS.get(color, 0)
    inflate = zlib.decompressobj()
    rows = inflate.decompress(b"".join(pixels), stride * height + 1)
    if color not in _CHANNELS or any(rest) or max(width, height) >= 1 << 16:
        raise ValueError("it has 16 bits, and is of a kind that cannot be read")
    if len(rows) != stride * height or not inflate.eof or inflate.unused_data or max(rows[::stride]) > 4:
        raise ValueError("its pixels are damaged")
    return _decoded_by_opencv(data)


def _decoded_by_opencv(data: bytes) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        raise ValueError("it cannot be decoded")
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def distinct(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The different values of straight RGBA, uint8 [..., 4] -> [K, 4], by alpha and then by color."""
    values = np.unique(np.ascontiguousarray(texels[..., ::-1]).view(">u4") if texels.size else np.zeros(0, ">u4"))
    return values.view(np.uint8).reshape(-1, 4)[:, ::-1]


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Encode uint8 [H, W, 3] RGB or [H, W, 4] straight RGBA as PNG, without loss.

    A picture of at most :data:`PALETTE` colors, alpha included, gets a palette (PNG 1.2, section 4.1.2), which needs a quarter to a half of
    the bytes.
    """
    opaque = image if image.shape[2] == 4 else np.pad(image, ((0, 0), (0, 0), (0, 1)), constant_values=255)
    if len(palette := distinct(opaque)) <= PALETTE:
        return _with_palette(opaque, palette, "RGBA" if image.shape[2] == 4 else "RGB")
    code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    done, data = cv2.imencode(".png", cv2.cvtColor(image, code), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done
    return data.tobytes()


def smaller_picture(data: bytes, side: int) -> bytes:
    """A PNG, JPEG or WebP file with at most ``side`` texels a side, in its format.

    One that is no larger, of another kind, or damaged stays as it is.
    Each texel is the mean of those that it covers, weighted by alpha. Transparent texels have the color of the nearest visible one.
    """
    try:
        with _opened(data) as picture:
            kind, scale = picture.format, side / max(picture.size)
            if scale >= 1 or kind not in ("PNG", "JPEG", "WEBP") or picture.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
                return data
            sides = [max(1, round(scale * length)) for length in picture.size]
            mode = "RGBA" if picture.has_transparency_data else "RGB"
            made = np.array(picture.convert(mode).resize((sides[0], sides[1]), Image.Resampling.BOX))
    except (OSError, SyntaxError, ValueError, EOFError):  # what Pillow raises for damaged files
        return data
    if mode == "RGBA":
        made = bleed_color(torch.from_numpy(made)).numpy()
    if kind == "PNG":
        return encode_png(made)
    file = io.BytesIO()
    Image.fromarray(made).save(file, kind, quality=90, exact=True)
    return file.getvalue()


def _with_palette(image: NDArray[np.uint8], palette: NDArray[np.uint8], mode: str) -> bytes:
    """Encode a picture whose colors are those of a palette in the order of :func:`distinct`."""
    order = np.ascontiguousarray(image[..., ::-1]).view(">u4")[..., 0]
    places = np.searchsorted(np.ascontiguousarray(palette[:, ::-1]).view(">u4")[:, 0], order).astype(np.uint8)
    picture, file = Image.fromarray(places), io.BytesIO()
    picture.putpalette(np.ascontiguousarray(palette[:, : len(mode)]).tobytes(), mode)
    picture.save(file, "PNG", optimize=True)
    return file.getvalue()


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write uint8 [H, W, 3 or 4] as PNG, completely or not at all."""
    write_bytes(path, encode_png(image))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Round values in [0, 1] (clamped) to uint8, same shape."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def srgb_to_linear(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Display-referred sRGB to linear light, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear light to display-referred sRGB, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


# 8-bit sRGB of linear values, in 65535ths: at its steepest, 12.92, the curve passes a twentieth of a byte from one to the next.
_ENCODED = np.rint(255 * linear_to_srgb(np.arange(1 << 16) / ((1 << 16) - 1))).astype(np.uint8)


def sum_of_lights(pictures: Sequence[NDArray[np.uint8]], factors: Sequence[float]) -> NDArray[np.uint8]:
    """The picture of a scene under several lights, from its pictures under each alone, uint8 [H, W, 4], straight alpha.

    The pictures are added in linear light, each times its factor, and what is brighter than white is white. Alpha is that of the first.
    """
    table = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
    total = sum(np.float32(factor) * table[picture[..., :3]] for picture, factor in zip(pictures, factors, strict=True))
    places = np.rint(np.minimum(total, 1) * (len(_ENCODED) - 1)).astype(np.uint16)
    return np.concatenate([_ENCODED[places], pictures[0][..., 3:]], -1)


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


def shrunk(picture: Tensor, width: int, height: int) -> Tensor:
    """A picture at a smaller size, [H, W, C] -> [h, w, C]; each pixel is the mean, by area, of what it covers.

    Raises InputError if the new size is larger, or not at least 1 x 1.
    """
    for name, side, old in (("width", width, picture.shape[1]), ("height", height, picture.shape[0])):
        check_count(name, side)
        if side > old:
            fail(name, f"expected at most the picture's {old}, got {side}")
    if tuple(picture.shape[:2]) == (height, width):
        return picture
    return _means(_means(picture.double(), height).transpose(0, 1), width).transpose(0, 1).to(picture)


def _means(values: Tensor, count: int) -> Tensor:
    """Means of ``count`` equal parts of the first axis, from differences of the running sum, which is linear within a value."""
    edges = torch.arange(count + 1, dtype=values.dtype) * (len(values) / count)
    whole = edges.long().clamp(max=len(values) - 1)
    before = torch.cat([torch.zeros_like(values[:1]), values.cumsum(0)[:-1]])
    sums = before[whole] + (edges - whole).view(-1, *[1] * (values.ndim - 1)) * values[whole]
    return sums.diff(dim=0) * (count / len(values))
