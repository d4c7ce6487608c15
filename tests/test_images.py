"""Reading and writing pictures, and the two kinds of alpha."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from bbfit.checks import InputError, MissingFileError
from bbfit.images import encode_png, over_color, premultiply, read_rgba, smaller_picture, to_bytes, unpremultiply, write_png


def noise(channels: int = 4) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (24, 31, channels), dtype=np.uint8)


def test_png_round_trip_keeps_every_byte(tmp_path: Path) -> None:
    image = noise()
    image[:4, :, 3] = 0  # color under full transparency stays as well
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_rgba(tmp_path / "a.png"), image)
    with Image.open(tmp_path / "a.png") as other:  # a second reader: channels in order, alpha straight
        assert other.mode == "RGBA" and np.array_equal(np.asarray(other), image)


def test_rgb_is_written_without_alpha(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", noise(3))
    with Image.open(tmp_path / "a.png") as other:
        assert other.mode == "RGB" and np.array_equal(np.asarray(other), noise(3))
    with pytest.raises(InputError, match=r"a\.png has no alpha channel"):
        read_rgba(tmp_path / "a.png")


def test_other_writers_pictures_are_read(tmp_path: Path) -> None:
    image = noise()
    Image.fromarray(image).save(tmp_path / "a.webp", lossless=True, exact=True)
    assert np.array_equal(read_rgba(tmp_path / "a.webp"), image)

    gray = np.ascontiguousarray(image[..., [0, 3]])
    Image.fromarray(gray).save(tmp_path / "gray.png")
    assert np.array_equal(read_rgba(tmp_path / "gray.png"), gray[..., [0, 0, 0, 1]])

    paletted = Image.fromarray(image).quantize(32)
    paletted.save(tmp_path / "palette.png")
    with Image.open(tmp_path / "palette.png") as again:
        assert np.array_equal(read_rgba(tmp_path / "palette.png"), np.asarray(again.convert("RGBA")))


def test_sixteen_bits_are_rounded_to_eight(tmp_path: Path) -> None:
    deep = np.array([[[0, 128, 129, 65535], [257, 385, 386, 32768]]], dtype=np.uint16)  # RGBA
    done, data = cv2.imencode(".png", deep[..., [2, 1, 0, 3]])
    assert done
    (tmp_path / "a.png").write_bytes(data.tobytes())
    assert read_rgba(tmp_path / "a.png").tolist() == [[[0, 0, 1, 255], [1, 1, 2, 128]]]


def test_damaged_pictures_are_refused_by_name(tmp_path: Path) -> None:
    path, good = tmp_path / "r_0.png", encode_png(noise())
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 0xFF
    huge = bytearray(good)
    huge[16:24] = struct.pack(">II", 100_000, 100_000)
    huge[29:33] = struct.pack(">I", zlib.crc32(bytes(huge[12:29])))
    for data, message in (
        (b"", "is empty"),
        (b"no picture at all", "neither PNG nor WebP"),
        (good[:-1], "is cut short"),
        (good[: len(good) // 2], "is cut short"),
        (good[:300] + good[600:], "cannot be read"),
        (bytes(flipped), "cannot be read"),
        (bytes(huge), "has 10,000,000,000 pixels, more than the limit"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"^image: .*r_0\.png {message}|r_0\.png is {message}"):
            read_rgba(path)
    path.unlink()
    for missing in (path, tmp_path):
        with pytest.raises(MissingFileError, match="does not exist"):
            read_rgba(missing)


@pytest.mark.parametrize("suffix", [".tif", ".jpg"])
def test_formats_whose_alpha_would_be_misread_are_refused(tmp_path: Path, suffix: str) -> None:
    Image.fromarray(noise(4 if suffix == ".tif" else 3)).save(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="neither PNG nor WebP"):
        read_rgba(tmp_path / f"a{suffix}")


def test_rounding_to_bytes() -> None:
    values = torch.tensor([-1.0, 0, 0.49 / 255, 0.51 / 255, 1 - 0.49 / 255, 1, 7])
    assert to_bytes(values).tolist() == [0, 0, 0, 1, 255, 255, 255]
    every = torch.arange(256, dtype=torch.float32) / 255
    assert to_bytes(every).tolist() == list(range(256))


def test_premultiplied_and_back() -> None:
    straight = torch.rand(50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    straight[:5, 3] = 1
    assert torch.equal(premultiply(straight)[:5], straight[:5])
    assert torch.allclose(unpremultiply(premultiply(straight)), straight, atol=1e-14)
    assert premultiply(torch.tensor([0.5, 1.0, 0.25, 0.5])).tolist() == [0.25, 0.5, 0.125, 0.5]


def test_nothing_is_black_and_has_finite_gradients() -> None:
    nothing = torch.zeros(3, 4, requires_grad=True)
    straight = unpremultiply(nothing)
    assert (straight == 0).all()
    straight.sum().backward()
    assert nothing.grad is not None and nothing.grad.isfinite().all()


def test_over_a_background() -> None:
    image = torch.tensor([[0.25, 0, 0.5, 0.5], [0, 0, 0, 0], [0.1, 0.2, 0.3, 1]])
    assert torch.allclose(over_color(image), torch.tensor([[0.75, 0.5, 1], [1, 1, 1], [0.1, 0.2, 0.3]]))
    assert torch.equal(over_color(image, 0.0), image[:, :3])
    assert over_color(image, torch.tensor([1.0, 0, 0]))[1].tolist() == [1, 0, 0]
    with pytest.raises(InputError, match="shape"):
        over_color(image[:, :3])


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_what_a_png_holds_beside_its_pixels_is_of_no_concern(depth: type, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Bad color profiles, of which some programs write one into every picture, and chunks whose checksum is wrong."""
    picture = np.random.default_rng(0).integers(0, np.iinfo(depth).max, (5, 7, 4)).astype(depth)
    data = cv2.imencode(".png", picture)[1].tobytes()
    extra = chunk(b"iCCP", b"icc\0\0" + zlib.compress(b"nonsense")) + chunk(b"tIME", b"")[:-4] + b"none"
    for name, content in (("plain.png", data), ("extra.png", data[:33] + extra + data[33:] + b"\0\0")):
        (tmp_path / name).write_bytes(content)
    np.testing.assert_array_equal(read_rgba(tmp_path / "extra.png"), read_rgba(tmp_path / "plain.png"))
    assert capfd.readouterr().err == ""


def test_libpng_says_nothing_of_damaged_pixels(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((64, 64, 4), np.uint8))[1].tobytes())
    data[data.index(b"IDAT") + 8] ^= 255
    (tmp_path / "bad.png").write_bytes(data)
    with pytest.raises(InputError, match=r"cannot be read \(its checksum is wrong\)"):
        read_rgba(tmp_path / "bad.png")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "JPEG"])
def test_a_smaller_picture_has_the_means_of_its_texels_by_alpha(kind: str) -> None:
    """Left, columns of opaque red alternate with transparent green ones. Right, it is white, with a transparent corner."""
    texels = np.full((64, 64, 4), 255, np.uint8)
    texels[:, :16:2], texels[:, 1:16:2] = [200, 0, 0, 255], [0, 200, 0, 0]
    texels[:16, 48:] = [0, 0, 200, 0]
    if kind == "JPEG":
        texels = np.full((64, 64, 3), [90, 120, 60], np.uint8)
    file = io.BytesIO()
    Image.fromarray(texels).save(file, kind, lossless=True, exact=True)
    small = Image.open(io.BytesIO(smaller_picture(file.getvalue(), 32)))
    found = np.array(small.convert("RGB" if kind == "JPEG" else "RGBA")).astype(int)
    assert small.format == kind and found.shape[:2] == (32, 32)
    if kind == "JPEG":
        assert abs(found - [90, 120, 60]).max() <= 4
        return
    assert (abs(found[8:, :6] - [200, 0, 0, 128]) <= 8).all() and (abs(found[8:, 10:] - 255) <= 8).all()
    assert (found[:8, 24:, 3] == 0).all() and (found[:6, 26:, :3] >= 247).all()  # with the color of its neighbor
    assert smaller_picture(file.getvalue(), 64) == file.getvalue()


@pytest.mark.parametrize("data", [b"", b"no picture", b"\x89PNG\r\n\x1a\n", encode_png(np.zeros((64, 64, 4), np.uint8))[:-40]])
def test_pictures_that_cannot_be_read_do_not_get_smaller(data: bytes) -> None:
    assert smaller_picture(data, 4) == data
