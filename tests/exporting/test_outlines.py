"""Tight outlines: nothing that shows is cut away, the corners are few, and the picture stays."""

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
from matplotlib.path import Path as Shape
from numpy.typing import NDArray
from test_hulls import PICTURES, cards_of, doubled_area, leaf, showing, texels

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import overdraw, with_hulls
from bbfit.exporting.model import export, shipped_model
from bbfit.exporting.outlines import with_outlines
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import MASK_RIM, Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.rendering.cards import draw_cards, fragments, hits, sheets_of


def islands() -> NDArray[np.float64]:
    """A branch with a gap beside it, and a few texels far away."""
    made = np.zeros((40, 60))
    made[2:30, 3:9], made[24:30, 3:50], made[1:3, 55:58] = 1, 1, 0.9
    return made


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


def overlaps(cards: Cards, texture: int) -> NDArray[np.int64]:
    """In how many triangles of a texture points of a grid lie that is not aligned with texels."""
    x, y = np.meshgrid(np.arange(-1.03, 62, 0.317), np.arange(-1.07, 62, 0.291))
    points, count = np.stack([x, y], -1).reshape(-1, 2), np.zeros(x.size, np.int64)
    for card in cards.cards:
        if card.rectangle == texture:
            corners = texels(cards, card)
            for face in card.triangles:
                count += Shape(corners[face]).contains_points(points)
    return count


def check(cards: Cards, made: Cards, corners: int, least: float) -> None:
    """All that a one-card model shows is inside, with few corners, and no triangles overlap."""
    (quad,) = cards.cards
    assert sum(len(card.corners) for card in made.cards) <= corners
    points = showing(cards, quad, least)
    inside = np.zeros(len(points), bool)
    for card in made.cards:
        at = texels(made, card)
        assert (at > texels(cards, quad).min(0) - 1e-8).all() and (at < texels(cards, quad).max(0) + 1e-8).all()
        for a, b, c in card.corners[card.triangles]:
            assert np.cross(b - a, c - a) @ card.normal > 0
        covered = sum(doubled_area(at[face]) for face in card.triangles)
        assert covered == pytest.approx(doubled_area(at), rel=1e-9)
        for face in card.triangles:
            turn = 1 if np.cross(at[face[1]] - at[face[0]], at[face[2]] - at[face[0]]) > 0 else -1
            along = np.roll(at[face], -1, 0) - at[face]
            left = np.cross(along[None], points[:, None] - at[face])
            inside |= (turn * left >= -1e-8 * np.linalg.norm(along, axis=-1)).all(-1)
    assert inside.all()
    assert overlaps(made, quad.rectangle).max(initial=0) <= 1
    convex = with_hulls(cards, corners, least).cards[0]
    total = sum(doubled_area(texels(made, card)) for card in made.cards)
    assert total <= doubled_area(texels(cards, convex)) * (1 + 1e-9)


@pytest.mark.parametrize("least", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("picture", [*PICTURES, "islands"])
def test_all_that_shows_is_inside_few_corners_that_never_overlap(picture: str, least: float) -> None:
    cards = cards_of(islands() if picture == "islands" else PICTURES[picture])
    for corners in (4, 8):
        check(cards, with_outlines(cards, corners, least), corners, least)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(3, 40), st.sampled_from([0.0, 0.25, 0.5]), st.integers(4, 8))
def test_random_pictures_are_kept(seed: int, width: int, height: int, least: float, corners: int) -> None:
    rng = np.random.default_rng(seed)
    picture = (rng.random((height, width)) < rng.choice([0.01, 0.1, 0.5])) * rng.random((height, width))
    cards = cards_of(picture)
    check(cards, with_outlines(cards, corners, least), corners, least)


def test_an_angle_gets_a_notch_and_an_island_a_piece_of_its_own() -> None:
    """The convex polygon around an angle is half of its square; two strips of 56 by 6 texels are a fifth of it."""
    cards = cards_of(angle())
    (tight,), (convex,) = with_outlines(cards, 8, 0.5).cards, with_hulls(cards, 8, 0.5).cards
    assert tight.faces is not None and len(tight.corners) <= 8
    assert doubled_area(texels(cards, tight)) < 0.6 * doubled_area(texels(cards, convex))
    cards = cards_of(apart())
    pieces = with_outlines(cards, 8, 0.5).cards
    assert len(pieces) == 2
    assert sum(doubled_area(texels(cards, piece)) / 2 for piece in pieces) < 1.2 * (9 * 18 + 18 * 8)


@pytest.mark.parametrize("kind", ["blend", "mask", "hash"])
def test_the_picture_is_that_of_the_rectangles(kind: str, orbit: Camera, tmp_path: Path) -> None:
    cards = cards_of(angle(), leaf(0.6), apart())
    cards = replace(cards, alpha=AlphaMode(kind))  # type: ignore[arg-type]
    tight = with_outlines(cards, 8, cards.outlined_alpha)
    assert len(tight.cards) == 1 + len(cards.cards) and any(card.faces is not None for card in tight.cards)
    assert torch.equal(draw_cards(tight, orbit), draw_cards(cards, orbit))
    pictures = []
    for name, made in (("rectangles", cards), ("tight", tight)):
        (tmp_path / f"{name}.glb").write_bytes(glb_bytes(made, ExportConfig()))
        assert not messages(tmp_path / f"{name}.glb")
        pictures.append(np.stack([view_glb(tmp_path / f"{name}.glb", orbit[view]) for view in range(2)]))
    if kind != "hash":
        assert abs(pictures[0] - pictures[1]).max() < 1e-5
    assert len(sheets_of(tight)) == len(cards.cards)
    for index in range(len(orbit)):
        pixels = [hits(tight, sheet, orbit[index]) for sheet in sheets_of(tight)]
        assert all(len(set(zip(met.x.tolist(), met.y.tolist(), strict=True))) == len(met.x) for met in pixels)
        assert sum(len(met.x) for met in pixels) == fragments(tight, orbit[index]) < fragments(cards, orbit[index])


def test_files_have_the_default_and_what_is_asked(crossed: BillboardCloud, tmp_path: Path) -> None:
    cloud = replace(crossed, alpha=AlphaMode("mask", 0.5))
    tight, rectangles = shipped_model(cloud).cards, shipped_model(cloud, ExportConfig(outline="rectangle")).cards
    assert [len(card.corners) for card in rectangles.cards] == [4, 4] and rectangles.vertex_count == 8
    assert 8 < tight.vertex_count <= 16 and overdraw(tight, 0.5) < overdraw(rectangles, 0.5)
    assert tight.outlined_alpha == 0.5 * MASK_RIM and replace(tight, alpha=AlphaMode("blend")).outlined_alpha == 0
    obj, *_ = export(cloud, tmp_path / "model.obj")
    rows = obj.read_text().splitlines()
    assert sum(row.startswith("v ") for row in rows) == tight.vertex_count
    used = {int(entry.split("/")[0]) for row in rows if row.startswith("f ") for entry in row.split()[1:]}
    assert used == set(range(1, tight.vertex_count + 1))
    assert ExportConfig().comparable().outline == "rectangle" and ExportConfig(outline="tight").comparable().outline == "tight"
    assert ExportConfig(hull=6).comparable() == ExportConfig(hull=6)


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="hull: 6 corners are requested of rectangles"):
        ExportConfig(hull=6, outline="rectangle")
    with pytest.raises(InputError, match="outline"):
        ExportConfig(outline="round")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="outline corners: expected at least 4"):
        with_outlines(cards_of(np.ones((4, 4))), 3, 0.5)
    with pytest.raises(InputError, match="least alpha"):
        with_outlines(cards_of(np.ones((4, 4))), 4, 1.5)
