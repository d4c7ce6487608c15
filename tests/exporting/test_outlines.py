"""Pieces: nothing that shows is cut away, corners and pieces are few, seams stay closed, and the picture stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_viewer import view_glb
from hypothesis import given, settings
from hypothesis import strategies as st
from khronos import messages
from numpy.typing import NDArray
from test_hulls import PICTURES, cards_of, doubled_area, leaf, outside, showing, texels

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import MARGIN, overdraw, with_hulls
from bbfit.exporting.model import export, shipped_model
from bbfit.exporting.outlines import with_pieces
from bbfit.exporting.splitting import split
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import MASK_RIM, Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.cards.reference import hits
from bbfit.operators.cards.sheets import sheets_of
from bbfit.provenance import cache_key
from bbfit.rendering.cards import CardRenderer, draw_cards


def of_kind(cards: Cards, kind: str) -> Cards:
    return replace(cards, alpha=AlphaMode(kind))  # type: ignore[arg-type]


def angle() -> NDArray[np.float64]:
    """Two strips of about 56 by 6 texels that share a corner."""
    made = np.zeros((60, 60))
    made[2:58, 3:9], made[52:58, 3:58] = 1, 1
    return made


def apart() -> NDArray[np.float64]:
    """Two rectangles in opposite corners, of 9 by 18 and 18 by 8 texels."""
    made = np.zeros((60, 60))
    made[2:20, 3:12], made[50:58, 40:58] = 1, 1
    return made


def total(cards: Cards) -> float:
    """Area of all pieces in square texels."""
    return sum(doubled_area(texels(cards, card)) for card in cards.cards) / 2


def common(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width and height of what the bounding boxes of two polygons have in common; 0 along an axis along which they are apart."""
    return np.clip(np.minimum(first.max(0), second.max(0)) - np.maximum(first.min(0), second.min(0)), 0, None)


def check(cards: Cards, made: Cards, pieces: int, corners: int, least: float) -> None:
    """All that a one-card model shows is inside a few pieces of few corners, which overlap by their margins at most."""
    (quad,) = cards.cards
    polygons = [texels(made, card) for card in made.cards]
    assert 1 <= len(polygons) <= pieces and all(3 <= len(polygon) <= corners for polygon in polygons)
    points = showing(cards, quad, least)
    for card, polygon in zip(made.cards, polygons, strict=True):
        assert outside(polygon, texels(cards, quad)).max() < 1e-8
        assert all(np.cross(b - a, c - a) @ card.normal > 0 for a, b, c in card.corners[card.triangles])
    assert len(points) == 0 or np.min([outside(points, polygon) for polygon in polygons], axis=0).max() < 1e-8
    for index, polygon in enumerate(polygons):
        for other in polygons[:index]:
            assert common(polygon, other).min() < (2 * MARGIN + 1e-8 if cards.alpha.kind == "mask" else 1e-8)
    assert total(made) <= total(cards) * (1 + 1e-9)


@pytest.mark.parametrize("kind", ["mask", "blend"])
@pytest.mark.parametrize("least", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("picture", [*PICTURES, "angle", "apart"])
def test_all_that_shows_is_inside_few_pieces_of_few_corners(picture: str, least: float, kind: str) -> None:
    alpha = {"angle": angle, "apart": apart}[picture]() if picture in ("angle", "apart") else PICTURES[picture]
    cards = of_kind(cards_of(alpha), kind)
    for pieces, corners in ((1, 8), (2, 4), (8, 6)):
        check(cards, with_pieces(cards, pieces, corners, least), pieces, corners, least)


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(3, 40),
    st.integers(3, 40),
    st.sampled_from([0.0, 0.25, 0.5]),
    st.integers(4, 8),
    st.integers(1, 12),
    st.sampled_from(["mask", "hash", "blend", "coverage"]),
)
def test_random_pictures_are_kept(seed: int, width: int, height: int, least: float, corners: int, pieces: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    picture = (rng.random((height, width)) < rng.choice([0.01, 0.1, 0.5])) * rng.random((height, width))
    cards = of_kind(cards_of(picture), kind)
    check(cards, with_pieces(cards, pieces, corners, least), pieces, corners, least)


def test_pieces_are_as_small_as_what_they_show() -> None:
    """Solid rectangles of w x h texels fill (w - 1) x (h - 1) where alpha is 1; a full texture stays one rectangle."""
    cards = of_kind(cards_of(apart()), "mask")
    made = with_pieces(cards, 8, 8, 1.0)
    assert len(made.cards) == 2
    assert total(made) == pytest.approx((8 + 2 * MARGIN) * (17 + 2 * MARGIN) + (17 + 2 * MARGIN) * (7 + 2 * MARGIN), rel=1e-6)
    cards = of_kind(cards_of(angle()), "mask")
    strips = with_pieces(cards, 8, 8, 1.0)
    assert len(strips.cards) == 2 and total(strips) < 1.06 * (5 * 55 + 5 * 49) < 0.4 * total(with_hulls(cards, 8, 1.0))
    for kind in ("hash", "blend"):  # the cut crosses a strip, and the pieces meet there without an overlap
        assert total(with_pieces(of_kind(cards, kind), 8, 8, 1.0)) < total(strips)
    full = of_kind(cards_of(np.ones((30, 20))), "mask")
    (card,) = with_pieces(full, 8, 8, 0.5).cards
    np.testing.assert_allclose(card.corners, with_hulls(full, 8, 0.5).cards[0].corners)


def test_pieces_go_where_they_save_most() -> None:
    """Four corners of a large texture get four pieces; a disc and a blank one stay one piece each."""
    corners, disc = np.zeros((60, 60)), np.hypot(*np.mgrid[-9.5:10, -9.5:10]) < 9
    for y, x in ((2, 2), (2, 50), (50, 2), (50, 50)):
        corners[y : y + 8, x : x + 8] = 1
    cards = of_kind(cards_of(corners, disc.astype(np.float64), np.zeros((20, 20))), "mask")
    made = with_pieces(cards, 2, 8, 0.5)
    assert [card.rectangle for card in made.cards] == [0, 0, 0, 0, 1, 2]
    assert len(with_pieces(cards, 1, 8, 0.5).cards) == 3
    assert total(with_pieces(cards, 2, 4, 0.5)) > total(made)


def test_split_cards_stay_as_they_are(crossed: BillboardCloud) -> None:
    cards = split(shipped_model(crossed, ExportConfig(alpha="blend", outline="rectangle")).cards)
    made, hulls = with_pieces(cards, 8, 6, 0.0), with_hulls(cards, 6, 0.0)
    assert all(card.origin is not None for card in made.cards)
    for card, hull in zip(made.cards, hulls.cards, strict=True):
        np.testing.assert_array_equal(card.corners, hull.corners)


@pytest.mark.parametrize("kind", ["blend", "mask", "hash", "coverage"])
def test_the_picture_is_that_of_the_rectangles(kind: str, orbit: Camera, tmp_path: Path) -> None:
    cards = of_kind(cards_of(angle(), leaf(0.6), apart()), kind)
    made = with_pieces(cards, 4, 8, cards.outlined_alpha)
    assert len(made.cards) > len(cards.cards)
    assert torch.equal(*(draw_cards(each, orbit, multisampled=False) for each in (made, cards)))
    pictures = []
    for name, drawn in (("rectangles", cards), ("pieces", made)):
        (tmp_path / f"{name}.glb").write_bytes(glb_bytes(drawn, ExportConfig()))
        assert not messages(tmp_path / f"{name}.glb")
        pictures.append(np.stack([view_glb(tmp_path / f"{name}.glb", orbit[view]) for view in range(2)]))
    if kind != "hash":
        assert abs(pictures[0] - pictures[1]).max() < 1e-5
    assert len(sheets_of(made)) == len(cards.cards)
    for index in range(len(orbit)):
        met = hits(made, sheets_of(made), orbit[index])
        assert len(set(zip(met.sheet.tolist(), met.x.tolist(), met.y.tolist(), strict=True))) == len(met.x)
        assert len(met.x) == CardRenderer(made).fragments(orbit[index]) < CardRenderer(cards).fragments(orbit[index])


def rasterized(corners: NDArray[np.float64], camera: Camera, steps: int = 256) -> NDArray[np.int64]:
    """How often a graphics card draws each pixel of a polygon, [H, W]: float32 corners, rounded to 1/``steps`` pixel, top-left rule."""
    at = camera.to(torch.float64).project(torch.from_numpy(corners.astype(np.float32)).double())
    corner = np.rint(at.numpy() * steps).astype(np.int64)
    x, y = np.meshgrid(np.arange(camera.width) * steps, np.arange(camera.height) * steps)
    count = np.zeros(x.shape, np.int64)
    for last in range(2, len(corner)):
        triangle = corner[[0, last - 1, last]]
        (ax, ay), (bx, by) = triangle[1] - triangle[0], triangle[2] - triangle[0]
        triangle, inside = triangle[:: 1 if ax * by > ay * bx else -1], np.full(x.shape, ax * by != ay * bx)
        for (px, py), (qx, qy) in zip(triangle, np.roll(triangle, -1, 0), strict=True):
            height = (qx - px) * (y - py) - (qy - py) * (x - px)
            inside &= (height > 0) | ((height == 0) & ((qy < py) | ((qy == py) & (qx > px))))
        count += inside
    return count


@pytest.mark.parametrize("kind", ["mask", "blend"])
def test_graphics_cards_open_no_seams(kind: str, orbit: Camera) -> None:
    """Corners in files are float32, and on the screen multiples of 1/256 pixel.

    Pieces of a mask overlap, so that there are no seams. Blended ones must not. Where their sides differ along a cut, rounded corners leave
    out or repeat a pixel of a thousand at most.
    """
    rng, (y, x) = np.random.default_rng(4), np.mgrid[:60, :60]
    bumps = sum(np.hypot(x - a, y - b) < c for a, b, c in zip(*rng.uniform(2, 58, (2, 25)), rng.uniform(1, 6, 25), strict=True))
    picture = np.minimum(bumps, 1.0)
    cards = of_kind(cards_of(picture), kind)
    made = with_pieces(cards, 12, 8, cards.outlined_alpha)
    assert len(made.cards) == 12
    drawn, again, missing = 0, 0, 0
    for index in range(len(orbit)):
        camera = orbit[index].resized(4 * orbit.width, 4 * orbit.height)
        shown = draw_cards(cards, camera)[..., 3].numpy() > 0
        count = sum(rasterized(card.corners, camera) for card in made.cards)
        drawn, again, missing = drawn + int((count > 0).sum()), again + int((count > 1).sum()), missing + int((count[shown] < 1).sum())
    assert again <= (0.02 if kind == "mask" else 0.001) * drawn, (drawn, again)
    assert missing <= (0 if kind == "mask" else 0.001) * drawn, (drawn, missing)


def test_files_have_the_default_and_what_is_asked(crossed: BillboardCloud, tmp_path: Path) -> None:
    cloud = replace(crossed, alpha=AlphaMode("mask", 0.5))
    made, rectangles = shipped_model(cloud).cards, shipped_model(cloud, ExportConfig(outline="rectangle")).cards
    assert [len(card.corners) for card in rectangles.cards] == [4, 4] and rectangles.vertex_count == 8
    assert 8 < made.vertex_count <= 2 * 8 * 8 and overdraw(made, 0.5) < overdraw(rectangles, 0.5)
    assert shipped_model(cloud, ExportConfig(outline="hull", corners=6)).cards.vertex_count <= 12
    assert shipped_model(cloud, ExportConfig(pieces=2, corners=5)).cards.vertex_count <= 20
    assert made.outlined_alpha == 0.5 * MASK_RIM and replace(made, alpha=AlphaMode("blend")).outlined_alpha == 0
    obj, *_ = export(cloud, tmp_path / "model.obj")
    rows = obj.read_text().splitlines()
    assert sum(row.startswith("v ") for row in rows) == made.vertex_count
    assert sum(row.startswith("f ") for row in rows) == len(made.cards)
    assert ExportConfig().comparable().outline == "rectangle" and ExportConfig(outline="pieces").comparable().outline == "pieces"


def test_bad_input_is_refused() -> None:
    cards = cards_of(np.ones((4, 4)))
    with pytest.raises(InputError, match="pieces: expected at least 1"):
        with_pieces(cards, 0, 8, 0.5)
    with pytest.raises(InputError, match="corners: expected at least 4"):
        with_pieces(cards, 8, 3, 0.5)
    with pytest.raises(InputError, match="least alpha"):
        with_pieces(cards, 8, 4, 1.5)


def test_a_requested_outline_has_a_key_of_its_own() -> None:
    """It resolves to the default's, but comparisons draw rectangles, and budgets choose, only if none is requested."""
    free, requested = ExportConfig(), ExportConfig(outline="pieces")
    assert free.resolve() == requested.resolve() and free.comparable() != requested.comparable()
    assert cache_key("export", free.key) != cache_key("export", requested.key)
    assert cache_key("export", free.key) == cache_key("export", ExportConfig().key)
