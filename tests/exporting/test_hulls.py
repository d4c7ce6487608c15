"""Hulls: nothing that shows is cut away, and as little else as can be is kept."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_viewer import view_glb
from numpy.typing import NDArray

from bbfit.checks import InputError
from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import overdraw, with_hulls
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Card, Cards
from bbfit.geometry.cloud import BillboardCloud

LEASTS = (0.0, 1 / 255, 0.5, 1.0)


def cards_of(*alphas: NDArray[np.float64], two_sided: bool = False) -> Cards:
    """A tilted card for each alpha picture, or with both sides one for every two, noise for colors."""
    generator = torch.Generator().manual_seed(1)
    count = len(alphas) // (1 + two_sided)
    frames, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    texels = [np.concatenate([np.random.default_rng(2).random((a.size, 3)), a.reshape(-1, 1)], -1) for a in alphas]
    cloud = BillboardCloud(
        centers=torch.rand(count, 3, generator=generator, dtype=torch.float64),
        rights=frames[:, 0].contiguous(),
        ups=frames[:, 1].contiguous(),
        half_extents=0.5 + torch.rand(count, 2, generator=generator, dtype=torch.float64),
        texture_sizes=torch.tensor([a.shape for a in alphas[:: 1 + two_sided]]),
        two_sided=torch.full((count,), two_sided),
        texels=torch.from_numpy(np.concatenate(texels)),
    )
    return cloud_cards(cloud, 2)


def leaf(angle: float, size: int = 48, width: float = 0.12) -> NDArray[np.float64]:
    """A thin ellipse that fades out, turned by an angle."""
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    return (1.5 * (1 - np.hypot(along / 0.9, across / width))).clip(0, 1)


def blobs(seed: int) -> NDArray[np.float64]:
    """A few discs and single texels anywhere, of any alpha, also at the rim."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:23, 0:31]
    made = np.zeros((23, 31))
    for center, radius, alpha in zip(rng.random((4, 2)) * [23, 31], 3 * rng.random(4), rng.random(4), strict=True):
        made = np.maximum(made, alpha * (np.hypot(y - center[0], x - center[1]) < radius))
    made[tuple(rng.integers(0, [23, 31]))] = 1
    return made


PICTURES = {
    "thin leaf": leaf(0.6),
    "upright leaf": leaf(np.pi / 2),
    "blobs": blobs(0),
    "others": blobs(3),
    "noise": np.random.default_rng(5).random((9, 7)),
    "full": np.ones((6, 8)),
    "dot": np.pad(np.ones((1, 1)), ((3, 8), (5, 2))),
    "row": np.pad(np.full((1, 40), 0.5), ((5, 5), (0, 0))),
    "slanted row": np.eye(40),
}


@functools.cache
def pictured(name: str) -> Cards:
    return cards_of(PICTURES[name])


def texels(cards: Cards, card: Card) -> NDArray[np.float64]:
    """Corners with the top-left texel's center at (0, 0), [K, 2]."""
    return card.uvs * np.array(cards.atlas.image.shape[1::-1]) - 0.5 - cards.atlas.corners[card.rectangle]


def doubled_area(polygon: NDArray[np.float64]) -> float:
    x, y = polygon.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def outside(points: NDArray[np.float64], polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far points lie outside a convex polygon, at most; not positive inside, [N]."""
    along = np.roll(polygon, -1, 0) - polygon
    turn = np.sign(np.cross(along[0], along[1]))
    normals = turn * np.stack([along[:, 1], -along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    return ((points[:, None] - polygon) * normals).sum(-1).max(-1)


def showing(cards: Cards, card: Card, least: float, each: int = 6) -> NDArray[np.float64]:
    """Points, texel centers among them, where the atlas's bilinear alpha reaches ``least``; 0 asks for more than nothing, [N, 2]."""
    (left, top), (width, height) = cards.atlas.corners[card.rectangle], cards.atlas.sizes[card.rectangle]
    alpha = cards.atlas.image[top - 1 : top + height + 1, left - 1 : left + width + 1, 3] / 255.0
    x, y = np.meshgrid(np.arange((width + 1) * each + 1) / each, np.arange((height + 1) * each + 1) / each)
    column, row = np.minimum(x.astype(int), width), np.minimum(y.astype(int), height)
    x, y = x - column, y - row
    upper = alpha[row, column] * (1 - x) + alpha[row, column + 1] * x
    lower = alpha[row + 1, column] * (1 - x) + alpha[row + 1, column + 1] * x
    value = upper * (1 - y) + lower * y
    return np.stack([x + column - 1, y + row - 1], -1)[value >= max(least, 1e-9)]


@pytest.mark.parametrize("least", LEASTS)
@pytest.mark.parametrize("picture", PICTURES)
def test_all_that_shows_is_kept_within_the_quad_and_by_more_corners_not_less_tightly(picture: str, least: float) -> None:
    cards = pictured(picture)
    (quad,) = cards.cards
    points = showing(cards, quad, least)
    areas = [doubled_area(texels(cards, quad))]
    for vertices in range(4, 9):
        (card,) = with_hulls(cards, vertices, least).cards
        polygon = texels(cards, card)
        assert 3 <= len(polygon) <= vertices
        # Rounding of float64 coordinates up to about 100 texels moves them by 1e-13; allowed is far less than the margin of 1/64.
        assert outside(polygon, texels(cards, quad)).max() < 1e-8
        assert len(points) == 0 or outside(points, polygon).max() < 1e-8
        areas.append(doubled_area(polygon))
    assert (np.diff(areas) <= 1e-9 * areas[0]).all(), areas


def test_a_thin_slanted_leaf_gets_a_thin_quadrangle() -> None:
    """The ellipse's bounding rectangle has 0.9 x 0.12 of the quad; bilinear filtering adds a texel of 50 on every side."""
    cards = cards_of(leaf(0.6))
    quad, four, eight = (
        doubled_area(texels(cards, made.cards[0])) for made in (cards, with_hulls(cards, 4, 0.0), with_hulls(cards, 8, 0.0))
    )
    assert four < 0.16 * quad  # measured 0.142
    assert eight < 0.9 * four  # measured 0.87 of it


def test_the_polygon_is_as_small_as_a_search_finds() -> None:
    """The smallest polygon of k sides around a disc is the regular one, k tan(pi / k) times the radius squared."""
    y, x = np.mgrid[-49.5:50, -49.5:50]
    cards = cards_of((np.hypot(x, y) < 40).astype(np.float64))
    area = {k: doubled_area(texels(cards, with_hulls(cards, k, 1.0).cards[0])) / 2 for k in (4, 6, 8)}
    for k in area:
        # Texel centers within 40 texels reach a little less far than that in most directions: measured 0.976 to 0.981.
        assert 0.96 < area[k] / (k * np.tan(np.pi / k) * 40**2) < 1


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_hull_lies_in_its_quads_plane_with_its_texture_in_place(two_sided: bool) -> None:
    cards = cards_of(leaf(0.6), blobs(0)[:, :23], two_sided=False) if not two_sided else cards_of(leaf(0.6), leaf(-0.4), two_sided=True)
    cards = cards.with_cards([Card(**{**vars(cards.cards[0]), "origin": np.array([1.0, 2.0, 3.0])}), *cards.cards[1:]])
    for quad, card in zip(cards.cards, with_hulls(cards, 6, 0.5).cards, strict=True):
        edges = quad.corners[1:] - quad.corners[0]
        weights = np.linalg.lstsq(edges.T, (card.corners - quad.corners[0]).T, rcond=None)[0]
        np.testing.assert_allclose(quad.corners[0] + weights.T @ edges, card.corners, rtol=0, atol=1e-12)
        np.testing.assert_allclose(quad.uvs[0] + weights.T @ (quad.uvs[1:] - quad.uvs[0]), card.uvs, rtol=0, atol=1e-12)
        for a, b, c in card.corners[card.triangles]:
            assert np.cross(b - a, c - a) @ quad.normal > 0
        assert (card.culled, card.rectangle) == (quad.culled, quad.rectangle)
        np.testing.assert_array_equal(card.normal, quad.normal)
        assert card.origin is quad.origin


@pytest.mark.parametrize("alpha", ["blend", "mask"])
def test_the_drawn_picture_stays(alpha: str, orbit: Camera, tmp_path: Path) -> None:
    cards = cards_of(leaf(0.6), blobs(0), blobs(3))
    cards = replace(cards, alpha=AlphaMode(alpha))  # type: ignore[arg-type]
    pictures = []
    for index, made in enumerate((cards, with_hulls(cards, 6, 0.5 if alpha == "mask" else 0.0))):
        (tmp_path / f"{index}.glb").write_bytes(glb_bytes(made, ExportConfig()))
        pictures.append(np.stack([view_glb(tmp_path / f"{index}.glb", orbit[view]) for view in range(3)]))
    assert pictures[0][..., 3].max() > 0.9
    # Vertices are float32, which moves a sample by some 1e-5 texels: measured 1.7e-6.
    assert abs(pictures[0] - pictures[1]).max() < 1e-5


def test_pieces_of_any_shape_get_hulls_too() -> None:
    cards = cards_of(leaf(0.6))
    (quad,) = cards.cards
    half = [0, 1, 2]  # a triangle
    cards = cards.with_cards([Card(**{**vars(quad), "corners": quad.corners[half], "uvs": quad.uvs[half]})])
    (card,) = with_hulls(cards, 4, 0.5).cards
    (piece,) = cards.cards
    points = showing(cards, piece, 0.5)
    points = points[outside(points, texels(cards, piece)) <= 0]
    assert len(points) > 100 and outside(points, texels(cards, card)).max() < 1e-8
    assert outside(texels(cards, card), texels(cards, piece)).max() < 1e-8
    assert doubled_area(texels(cards, card)) < 0.06 * doubled_area(texels(cards, piece))  # measured 0.038


def test_a_card_that_shows_nothing_shrinks_to_a_texel() -> None:
    cards = cards_of(np.zeros((9, 9)), np.full((9, 9), 0.25))
    shrunk = with_hulls(cards, 4, 0.5)
    assert [doubled_area(texels(cards, card)) / 2 for card in shrunk.cards] == pytest.approx([1, 1])
    assert overdraw(shrunk, 0.5) == 1
    np.testing.assert_allclose(shrunk.cards[0].corners.mean(0), cards.cards[0].corners.mean(0), rtol=0, atol=1e-12)


def test_overdraw_is_the_share_that_shows_nothing() -> None:
    alpha = np.zeros((10, 20))
    alpha[:, :5] = 1
    cards = cards_of(alpha)
    # Of the quad's 11 x 21 texels, 9 x 4 are as opaque as can be, and alpha is more than 0 within a texel around them. Measured by
    # samples a 47th of a texel apart: measured 6e-4 off.
    assert overdraw(cards, 1.0) == pytest.approx(1 - 9 * 4 / 231, abs=0.002)
    assert overdraw(cards, 0.0) == pytest.approx(1 - 11 * 6 / 231, abs=0.002)
    assert overdraw(with_hulls(cards, 4, 0.0), 0.0) < 0.01
    both = cards_of(alpha, np.ones((10, 20)))
    assert overdraw(both, 0.0) == pytest.approx((1 - 11 * 6 / 231) / 2, abs=0.002)
    for vertices, least in itertools.product((4, 8), LEASTS):
        assert overdraw(with_hulls(cards, vertices, least), least) <= overdraw(cards, least) + 1e-9


def test_bad_input_is_refused() -> None:
    cards = cards_of(np.ones((4, 4)))
    with pytest.raises(InputError, match="hull vertices: expected at least 4"):
        with_hulls(cards, 3, 0.5)
    for least in (-0.1, 1.1, float("nan")):
        with pytest.raises(InputError, match="least alpha"):
            with_hulls(cards, 4, least)
        with pytest.raises(InputError, match="least alpha"):
            overdraw(cards, least)
