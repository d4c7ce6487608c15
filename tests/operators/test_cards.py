"""The kernel that draws cards against the drawing in torch: pictures, light, numbers of fragments, and what it promises beyond."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import random_scene

from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.mips import mip_chain, surface_chain
from bbfit.exporting.outlines import with_pieces
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cards import Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.operators.cards.fused import count_fragments_fused, draw_cards_fused
from bbfit.operators.cards.reference import draw_cards_reference, hits
from bbfit.operators.cards.sheets import prepared_cards

MODES = (
    AlphaMode("blend"),
    AlphaMode("mask", 0.4),
    AlphaMode("mask", 0.4, antialiased=True),
    AlphaMode("mask", 0.4, hardness=8.0),
    AlphaMode("mask", 0.4, hardness=8.0, antialiased=True),
    AlphaMode("hash"),
    AlphaMode("coverage"),
    AlphaMode("coverage", samples=0),
)


def levelled(cloud: BillboardCloud) -> Cards:
    """Cards with mip levels."""
    cards = cloud_cards(cloud, 4)
    return replace(cards, chain=tuple(mip_chain(cards.atlas, None)))


def in_pieces(cloud: BillboardCloud) -> Cards:
    """Cards of several polygons a plane, each twice, so that they overlap."""
    cards = with_pieces(levelled(cloud), 4, 8, 0.05)
    return cards.with_cards([*cards.cards, *cards.cards[::-1]])


def inside() -> Camera:
    """Cameras among the cards, which then are partly behind them."""
    eyes = torch.tensor([[0.1, 0.1, 0.15], [0.3, -0.2, -0.1]], dtype=torch.float64)
    ahead = torch.tensor([[1.0, 0.2, 0.1], [-0.5, 0.1, 1.0]], dtype=torch.float64)
    return Camera(look_at(eyes, eyes + ahead), pinhole_intrinsics(80, 50, 42).expand(2, 3, 3), 50, 42)


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("make", [lambda cloud: cloud_cards(cloud, 4), levelled, in_pieces], ids=["plain", "levelled", "pieces"])
def test_the_kernel_draws_what_torch_draws(mode: AlphaMode, make: Callable[[BillboardCloud], Cards]) -> None:
    """Near, from afar, among the cards and in parallel projection; rounding takes no sample across a cutoff.

    Measured: 7e-6, of an antialiased mask, whose ramp multiplies rounding.
    """
    shown = 0
    for seed in range(6):
        cloud, camera = random_scene(seed, 5, orthographic=seed % 2 == 1)
        prepared = prepared_cards(make(replace(cloud, alpha=mode)))
        for cameras in (camera.resized(60, 53).batch(), camera.resized(9, 8).batch(), inside()):
            expected, image = (draw(prepared, cameras) for draw in (draw_cards_reference, draw_cards_fused))
            assert image.dtype == torch.float32 and image.shape == expected.shape
            torch.testing.assert_close(image, expected, rtol=0, atol=3e-5)
            assert count_fragments_fused(prepared, cameras) == len(hits(prepared.cards, prepared.sheets, cameras).x)
            shown += int((expected[..., 3] > 0).sum())
    assert shown > 15000, shown


def with_maps(cards: Cards, channels: int) -> Cards:
    """Cards with random maps: normals, occlusion, and translucency if there are five channels."""
    noise = np.random.default_rng(0).integers(0, 256, (*cards.atlas.image.shape[:2], channels), dtype=np.uint8)
    tangents = [(card.corners[1] - card.corners[0]) / np.linalg.norm(card.corners[1] - card.corners[0]) for card in cards.cards]
    own = [replace(card, tangent=tangent) for card, tangent in zip(cards.cards, tangents, strict=True)]
    surfaces = tuple(surface_chain(noise, None))
    return replace(cards.with_cards(own), atlas=replace(cards.atlas, surface=noise), surface_chain=surfaces)


@pytest.mark.parametrize("channels", [4, 5])
@pytest.mark.parametrize("traced", [False, True])
def test_the_kernel_shades_what_torch_shades(traced: bool, channels: int) -> None:
    """Under a light for each view, one for all, and none. Measured: 4e-7."""
    different = 0
    for seed in range(4):
        cloud, camera = random_scene(seed, 5, orthographic=False)
        prepared = prepared_cards(replace(with_maps(levelled(cloud), channels), traced=traced))
        cameras = camera.resized(60, 53).batch()[[0, 0]]
        lights = Light.of(torch.tensor([[0.3, 0.8, -0.5], [-0.6, 0.2, 0.7]]), 2.5, 0.6, (1.0, 0.9, 0.8))
        pictures = []
        for light in (lights, lights[[1]], None):
            expected, image = (draw(prepared, cameras, light) for draw in (draw_cards_reference, draw_cards_fused))
            torch.testing.assert_close(image, expected, rtol=0, atol=1e-5)
            pictures.append(expected)
        assert torch.equal(pictures[0][1], pictures[1][1])
        different += int(((pictures[0][0] - pictures[2][0]).abs().amax(-1) > 0.1).sum())
    assert different > 500


def test_nothing_is_drawn_of_nothing() -> None:
    """Without cards, and without cameras."""
    cloud, camera = random_scene(0, 3, orthographic=False)
    cards = cloud_cards(cloud, 4)
    assert not draw_cards_fused(prepared_cards(cards.with_cards([])), camera.batch()).any()
    assert draw_cards_fused(prepared_cards(cards), camera.batch()[:0]).shape == (0, camera.height, camera.width, 4)


def test_the_picture_does_not_depend_on_threads_and_other_views(threads: None) -> None:
    """Bit by bit."""
    cloud, camera = random_scene(2, 7, orthographic=False)
    prepared, pictures = prepared_cards(levelled(cloud)), []
    cameras = camera.resized(200, 190).batch()[[0, 0, 0]]
    cameras = replace(cameras, intrinsics=cameras.intrinsics * torch.tensor([1.0, 0.8, 1.2])[:, None, None])
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        pictures += [draw_cards_fused(prepared, cameras), torch.cat([draw_cards_fused(prepared, cameras[[view]]) for view in range(3)])]
    assert pictures[0].any() and all(torch.equal(picture, pictures[0]) for picture in pictures)
