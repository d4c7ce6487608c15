"""The atlas: every texture whole and apart, no foreign color within reach of a filter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bbfit.exporting.atlas import pack_atlas
from bbfit.geometry.cards import Atlas

SIZES = [(20, 13), (9, 31), (1, 1), (64, 40), (16, 16), (3, 90)]


def noise(sizes: list[tuple[int, int]], seed: int = 0) -> list[NDArray[np.uint8]]:
    generator = np.random.default_rng(seed)
    return [generator.integers(1, 256, (h, w, 4), dtype=np.uint8) for h, w in sizes]


def rectangles(atlas: Atlas, margin: int = 0) -> list[tuple[slice, slice]]:
    return [
        np.s_[y - margin : y + h + margin, x - margin : x + w + margin]
        for (x, y), (w, h) in zip(atlas.corners.tolist(), atlas.sizes.tolist(), strict=True)
    ]


def mip(image: NDArray[np.floating], level: int) -> NDArray[np.float64]:
    n = 2**level
    height, width = image.shape[:2]
    assert height % n == 0 and width % n == 0
    return image.reshape(height // n, n, width // n, n, -1).mean((1, 3))


@pytest.mark.parametrize("padding", [1, 2, 8, 12])
@pytest.mark.parametrize("sizes", [SIZES, SIZES[:1], [(50, 30)] * 7])
def test_textures_are_whole_and_apart(sizes: list[tuple[int, int]], padding: int) -> None:
    textures = noise(sizes)
    atlas = pack_atlas(textures, padding)
    assert atlas.image.shape[0] % 4 == 0 and atlas.image.shape[1] % 4 == 0
    claimed = np.zeros(atlas.image.shape[:2], int)
    for texture, inner, outer in zip(textures, rectangles(atlas), rectangles(atlas, padding), strict=True):
        np.testing.assert_array_equal(atlas.image[inner], texture)
        assert claimed[outer].shape == (texture.shape[0] + 2 * padding, texture.shape[1] + 2 * padding), "runs out of the atlas"
        claimed[outer] += 1
    assert claimed.max() == 1
    transparent = np.ones(claimed.shape, bool)
    for inner in rectangles(atlas):
        transparent[inner] = False
    assert not atlas.image[transparent, 3].any()
    np.testing.assert_array_equal(pack_atlas(textures, padding).image, atlas.image)


def test_waste_is_small() -> None:
    # Measured: 0.86 for eight large squares (a 3 x 3 grid), 0.94 for four, 0.97 for one; what is lost is padding and the empty ninth.
    for count, least in ((1, 0.96), (4, 0.93), (8, 0.85)):
        atlas = pack_atlas([np.full((1024, 1024, 4), 255, np.uint8)] * count, 8)
        assert atlas.used >= least
        assert max(atlas.image.shape) <= 4096


def test_transparent_texels_take_the_nearest_opaque_color() -> None:
    (texture,) = noise([(11, 14)])
    generator = np.random.default_rng(1)
    texture[..., 3] = generator.choice(np.array([0, 0, 0, 60, 130, 255], np.uint8), (11, 14))
    atlas = pack_atlas([texture], 8)
    ((x, y),) = atlas.corners.tolist()
    opaque = np.argwhere(texture[..., 3] >= 128)
    for row, column in np.ndindex(atlas.image.shape[:2]):
        distance = ((opaque - [row - y, column - x]) ** 2).sum(-1)
        nearest = opaque[distance == distance.min()]
        ring = not (0 <= row - y < 11 and 0 <= column - x < 14) and -1 <= row - y <= 11 and -1 <= column - x <= 14
        if ring:  # fades out in the color of the rim
            rim = atlas.image[min(max(row, y), y + 10), min(max(column, x), x + 13), :3]
            np.testing.assert_array_equal(atlas.image[row, column, :3], rim)
        elif atlas.image[row, column, 3] == 0:
            assert (texture[nearest[:, 0], nearest[:, 1], :3] == atlas.image[row, column, :3]).all(-1).any()
    visible = texture[..., 3] > 0
    np.testing.assert_array_equal(atlas.image[rectangles(atlas)[0]][visible], texture[visible])


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_filtering_finds_no_foreign_color(level: int) -> None:
    """A leaf-green texture with black behind its holes among bright red ones: samples stay green up to a texel and a half outside."""
    green, red = (40, 160, 20), (255, 0, 0)
    textures = [np.full((h, w, 4), (*red, 255), np.uint8) for h, w in [(33, 17)] * 5]
    textures[2][:] = (*green, 255)
    textures[2][np.random.default_rng(0).random((33, 17)) < 0.5] = 0
    atlas = pack_atlas(textures, 8)
    image = mip(atlas.image.astype(np.float64), level)
    owner = np.zeros(atlas.image.shape[:2])
    for number, outer in enumerate(rectangles(atlas, 8), start=1):
        owner[outer] = number
    shared = owner[:, :, None] == np.arange(1, len(textures) + 1)
    assert ((mip(shared.astype(np.float64), level) > 0).sum(-1) <= 1).all(), "two textures in one texel of the level"
    (x, y), (w, h) = atlas.corners[2].tolist(), atlas.sizes[2].tolist()
    columns, rows = (
        np.linspace(start - 1.5, start + count + 1.5, 401) / 2**level - 0.5 for start, count in ((x, w), (y, h))
    )  # in texels of the level, centers at integers; a quad reaches half a texel outside
    for row in (np.floor(rows), np.floor(rows) + 1):
        for column in (np.floor(columns), np.floor(columns) + 1):
            taps = image[row.astype(int)][:, column.astype(int), :3]
            np.testing.assert_array_equal(taps, np.broadcast_to(green, taps.shape))


def test_nothing_visible() -> None:
    hidden = np.zeros((5, 6, 4), np.uint8)
    hidden[..., 0] = 200
    assert not pack_atlas([hidden], 8).image.any()
    (other,) = noise([(5, 6)])
    atlas = pack_atlas([hidden, other], 8)
    np.testing.assert_array_equal(atlas.image[rectangles(atlas)[1]], other)
    assert not atlas.image[rectangles(atlas)[0]].any()
