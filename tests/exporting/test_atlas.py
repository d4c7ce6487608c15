"""The atlas: every texture whole and apart, no foreign color within reach of a filter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

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


def test_transparent_texels_beside_visible_ones_take_the_nearest_opaque_color() -> None:
    (texture,) = noise([(22, 28)])
    generator = np.random.default_rng(1)
    texture[..., 3] = generator.choice(np.array([0, 0, 0, 60, 130, 255], np.uint8), (22, 28))
    atlas = pack_atlas([texture], 8)
    ((x, y),) = atlas.corners.tolist()
    opaque, beside = np.argwhere(texture[..., 3] >= 128), ndimage.binary_dilation(np.pad(texture[..., 3] > 0, 1), np.ones((3, 3)))
    assert not beside.all()
    for row, column in np.ndindex(atlas.image.shape[:2]):
        distance = ((opaque - [row - y, column - x]) ** 2).sum(-1)
        nearest = opaque[distance == distance.min()]
        ring = not (0 <= row - y < 22 and 0 <= column - x < 28) and -1 <= row - y <= 22 and -1 <= column - x <= 28
        if ring:  # fades out in the color of the rim
            rim = atlas.image[min(max(row, y), y + 21), min(max(column, x), x + 27), :3]
            np.testing.assert_array_equal(atlas.image[row, column, :3], rim)
        elif -1 <= row - y <= 22 and -1 <= column - x <= 28 and atlas.image[row, column, 3] == 0 and beside[row - y + 1, column - x + 1]:
            assert (texture[nearest[:, 0], nearest[:, 1], :3] == atlas.image[row, column, :3]).all(-1).any()
    visible = texture[..., 3] > 0
    np.testing.assert_array_equal(atlas.image[rectangles(atlas)[0]][visible], texture[visible])


def test_transparent_texels_continue_the_visible_colors_smoothly() -> None:
    """A program that ignores alpha shows no patches. Measured: steps of at most 19, where visible neighbors differ by 114 on average."""
    (texture,) = noise([(40, 40)])
    texture[..., 3] = np.where(np.hypot(*np.mgrid[-20:20, -20:20]) < 10, 255, 0)
    color = pack_atlas([texture], 8).image.astype(float)
    away = ~ndimage.binary_dilation(color[..., 3] > 0, np.ones((3, 3)), iterations=2)
    steps = [abs(np.diff(color, axis=axis))[np.minimum(away, np.roll(away, -1, axis)).take(range(55), axis)] for axis in (0, 1)]
    assert max(step.max() for step in steps) <= 25
    np.testing.assert_allclose(color[0, 0, :3], texture[texture[..., 3] > 0, :3].mean(0), atol=12)


def test_transparent_texels_keep_their_hue_in_a_palette() -> None:
    """Many greens: black and full red would be the nearest of a few evenly spaced colors."""
    (texture,) = noise([(60, 60)])
    texture[..., [0, 2]], texture[..., 1] = 0, texture[..., 1] % 240
    texture[..., 3] = np.random.default_rng(1).choice(np.array([0, 255], np.uint8), (60, 60), p=[0.9, 0.1])
    image = pack_atlas([texture], 8).image
    assert not image[..., [0, 2]].any() and 8 <= len(np.unique(image[image[..., 3] == 0][:, 1])) <= 16


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
    mean = np.rint(np.average(other.reshape(-1, 4)[:, :3], 0, other[..., 3].ravel()))
    assert (atlas.image[rectangles(atlas)[0]] == [*mean, 0]).all()


@pytest.mark.parametrize("padding", [1, 2, 3, 5])
@pytest.mark.parametrize("halvings", [1, 2, 3])
def test_an_atlas_that_will_be_halved_is_made_of_whole_blocks(padding: int, halvings: int) -> None:
    textures = [np.full((5, 9, 4), 255, np.uint8), np.full((17, 3, 4), 255, np.uint8)]
    atlas, unit = pack_atlas(textures, padding, halvings=halvings), 1 << halvings
    assert all(side % (4 * unit) == 0 for side in atlas.image.shape[:2])
    assert (atlas.corners % unit == 0).all() and (atlas.corners >= padding * unit).all()
