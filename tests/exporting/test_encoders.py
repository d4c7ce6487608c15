"""Compressed pictures: what the files say about themselves, read by hand, and what comes out of them again."""

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from bbfit.checks import InputError
from bbfit.exporting.atlas import pack_atlas
from bbfit.exporting.encoders import encode_ktx2, encode_webp, ktx2_missing
from bbfit.exporting.mips import coverage, mip_chain
from bbfit.images import read_rgba

WHOLE = np.array([[0.0, 0.0], [1.0, 1.0]])


@pytest.fixture(scope="module")
def alktx2() -> ModuleType:
    if sys.version_info < (3, 11):
        pytest.skip("alktx2 needs Python 3.11")
    missing = ktx2_missing()
    assert missing is None, missing
    return __import__("alktx2")


def leaves(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """Leaves of some texels in greens that vary smoothly, with soft rims, over half of the picture."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 4))
    blurred = [ndimage.gaussian_filter(noise[..., channel], 4 if channel < 3 else 1.5) for channel in range(4)]
    red, green, blue, alpha = (values / values.std() for values in blurred)
    straight = np.stack([90 + 25 * red, 130 + 30 * green, 50 + 15 * blue, 127.5 + 150 * alpha], -1)
    return np.rint(straight.clip(0, 255)).astype(np.uint8)


@pytest.fixture(scope="module")
def levels() -> list[NDArray[np.uint8]]:
    """An atlas with odd sides from level 3 on."""
    chain = mip_chain(pack_atlas([leaves(90, 130), leaves(77, 110, seed=1)], 8), 0.5)
    assert any(side % 2 for side in chain[3].shape[:2])
    return chain


@pytest.fixture(scope="module")
def ktx2(alktx2: ModuleType, levels: list[NDArray[np.uint8]]) -> bytes:
    return encode_ktx2(levels)


def premultiplied(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    straight = image / 255
    return np.concatenate([straight[..., :3] * straight[..., 3:], straight[..., 3:]], -1)


def psnr(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(((premultiplied(image) - premultiplied(other)) ** 2).mean()))


def key_values(data: bytes) -> dict[str, bytes]:
    found = {}
    while data:
        (length,) = struct.unpack_from("<I", data)
        key, _, value = data[4 : 4 + length].partition(b"\0")
        found[key.decode()] = value
        data = data[4 + -(-length // 4) * 4 :]
    return found


def test_ktx2_says_what_gltf_demands(ktx2: bytes, levels: list[NDArray[np.uint8]]) -> None:
    """Header, level index, data format descriptor and key/value data of KTX 2.0; what KHR_texture_basisu asks of them."""
    assert ktx2[:12] == b"\xabKTX 20\xbb\r\n\x1a\n"
    form, type_size, width, height, depth, layers, faces, count, scheme = struct.unpack_from("<9I", ktx2, 12)
    assert (form, type_size, scheme) == (0, 1, 1)  # undefined, bytes, BasisLZ
    assert (height, width) == levels[0].shape[:2] and not width % 4 and not height % 4
    assert (depth, layers, faces, count) == (0, 0, 1, len(levels))
    dfd, dfd_length, kvd, kvd_length, sgd, sgd_length = struct.unpack_from("<4I2Q", ktx2, 48)
    assert sgd_length > 0 and sgd + sgd_length <= len(ktx2)
    for offset, length, _ in struct.iter_unpack("<3Q", ktx2[80 : 80 + 24 * count]):
        assert length > 0 and offset + length <= len(ktx2)

    total, kind, version, size, model, primaries, transfer, flags = struct.unpack_from("<IIHHBBBB", ktx2, dfd)
    assert (total, kind, version, size) == (dfd_length, 0, 2, dfd_length - 4)
    assert (model, primaries, transfer, flags) == (163, 1, 2, 0)  # ETC1S, BT.709, sRGB, straight alpha
    channels = [ktx2[dfd + 28 + 16 * sample + 3] & 15 for sample in range((size - 24) // 16)]
    assert channels == [0, 15]  # RGB and alpha
    assert key_values(ktx2[kvd : kvd + kvd_length]).get("KTXorientation", b"rd\0") == b"rd\0"


def test_every_level_comes_out_of_the_ktx2_again(alktx2: ModuleType, ktx2: bytes, levels: list[NDArray[np.uint8]]) -> None:
    """Decoded levels are as large as their blocks of 4 x 4 texels.

    Measured on these small leaves: 27.7 dB or more at every level (upside down there are 18 at most), and coverage
    0.2 % off at levels 0 to 2, 3 and 4 % at levels 3 and 4, of 26 and 13 rows. Fitted trees are kept far better.
    """
    for number, level in enumerate(levels):
        data, _ = alktx2.decode_ktx2_to_bytes(ktx2, format="png", level=number)
        decoded = np.asarray(Image.open(io.BytesIO(data)))
        height, width = level.shape[:2]
        assert decoded.shape == (-(-height // 4) * 4, -(-width // 4) * 4, 4)
        decoded = decoded[:height, :width]
        assert psnr(decoded, level) >= 26
        if number <= 4:
            shares = [coverage(image[..., 3], 0.5, WHOLE) for image in (decoded, level)]
            assert shares[0] == pytest.approx(shares[1], rel=0.005 if number <= 2 else 0.06)


def test_alpha_is_kept_wherever_it_is(alktx2: ModuleType) -> None:
    chain = mip_chain(pack_atlas([leaves(24, 24)], 4), None)
    for level in chain:
        level[..., 3] = 255
    assert not alktx2.inspect_ktx2(encode_ktx2(chain))["has_alpha"]
    chain[1][3, 3, 3] = 0
    assert alktx2.inspect_ktx2(encode_ktx2(chain))["has_alpha"]


def test_the_same_picture_gives_the_same_bytes(ktx2: bytes, levels: list[NDArray[np.uint8]], capfd: pytest.CaptureFixture[str]) -> None:
    """Whatever its layout in memory, and without a word."""
    assert encode_ktx2([np.asfortranarray(level) for level in levels]) == ktx2
    for lossless in (True, False):
        assert encode_webp(np.asfortranarray(levels[0]), lossless) == encode_webp(levels[0], lossless)
    assert capfd.readouterr() == ("", "")


def test_a_chain_may_end_early(alktx2: ModuleType, levels: list[NDArray[np.uint8]]) -> None:
    assert alktx2.inspect_ktx2(encode_ktx2(levels[:1]))["levels"] == 1
    assert alktx2.inspect_ktx2(encode_ktx2(levels[:3]))["levels"] == 3


@pytest.mark.parametrize(
    ("sides", "said"),
    [
        ([], "levels: expected at least one"),
        ([(8, 10)], "levels: sides must be multiples of 4, got 10 x 8"),
        ([(6, 8)], "levels: sides must be multiples of 4, got 8 x 6"),
        ([(8, 8), (4, 3)], r"levels\[1\]: expected shape \[4, 4, 4\], got \[4, 3, 4\]"),
        ([(8, 8), (4, 4), (1, 1)], r"levels\[2\]: expected shape \[2, 2, 4\]"),
    ],
)
def test_levels_of_wrong_sizes_are_refused(alktx2: ModuleType, sides: list[tuple[int, int]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        encode_ktx2([np.zeros((*side, 4), np.uint8) for side in sides])


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "alktx2", None)  # by which Python says that a module cannot be imported
    said = r'install bbfit with its extra, pip install "bbfit\[ktx2\]".*Python 3\.11'
    with pytest.raises(InputError, match="KTX2: the package alktx2 is not installed; " + said):
        encode_ktx2([np.zeros((4, 4, 4), np.uint8)])


def test_lossless_webp_keeps_every_texel_also_the_transparent_ones(tmp_path: Path, levels: list[NDArray[np.uint8]]) -> None:
    """Read by two readers, Pillow's and OpenCV's."""
    noise = np.random.default_rng(0).integers(0, 256, (20, 31, 4), dtype=np.uint8)
    noise[:, :16, 3] = 0
    for image in (noise, *levels):
        data = encode_webp(image)
        assert data[:4] == b"RIFF" and data[8:12] == b"WEBP" and b"VP8L" in data[:40]
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")), image)
    (tmp_path / "noise.webp").write_bytes(encode_webp(noise))
    np.testing.assert_array_equal(read_rgba(tmp_path / "noise.webp"), noise)


def test_lossy_webp_keeps_alpha_and_nearly_the_colors(levels: list[NDArray[np.uint8]]) -> None:
    """Measured: 2.2 of 255 off on average, 3.3 where transparent; that would be 17 if transparent texels were free to change."""
    image = levels[0]
    data = encode_webp(image, lossless=False)
    decoded = np.asarray(Image.open(io.BytesIO(data)))
    np.testing.assert_array_equal(decoded[..., 3], image[..., 3])
    error = np.abs(decoded[..., :3].astype(int) - image[..., :3])
    hidden = image[..., 3] == 0
    assert error[hidden].mean() <= 5 and error[~hidden].mean() <= 4
    assert len(data) < len(encode_webp(image))


def test_pictures_larger_than_webp_are_refused() -> None:
    with pytest.raises(InputError, match=r"image: WebP has at most 16383 texels a side, got 16384 x 4; write it as PNG"):
        encode_webp(np.zeros((4, 16384, 4), np.uint8))
    assert encode_webp(np.zeros((4, 16383, 4), np.uint8))
