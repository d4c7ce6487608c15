"""Gaps of an atlas: from near nothing changes, and from afar plain mip levels show what the near pictures show."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gaps import with_filled_gaps
from bbfit.exporting.gltf import texture_files
from bbfit.exporting.mip_matching import densities
from bbfit.exporting.mips import plain_chain
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.orbit import Orbit
from bbfit.images import PALETTE, distinct, shrunk
from bbfit.rendering.cards import CardRenderer

MODES = {"mask": AlphaMode("mask", 0.2), "blend": AlphaMode(), "coverage": AlphaMode("coverage")}
# Sides of the pictures in which a pixel is as large as a texel, and as 16 texels.
NEAR, FAR = 320, 20


def crown(mode: str, share: float = 0.45, colors: int = 20) -> BillboardCloud:
    """Small billboards in a ball, each with leaves on a share of its texels, in a few colors."""
    count, side, generator = 200, 14, torch.Generator().manual_seed(0)
    frames, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    centers = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    centers *= 0.5 * (torch.rand(count, 1, generator=generator) ** (1 / 3) / centers.norm(dim=-1, keepdim=True)).double()
    noise = torch.nn.functional.avg_pool2d(torch.rand(count, 1, side, side, generator=generator), 3, 1, 1).flatten(1)
    alpha = (noise >= noise.quantile(1 - share, -1, keepdim=True)).flatten().float()
    palette = torch.rand(colors, 3, generator=generator) * torch.tensor([0.4, 0.6, 0.2])
    color = palette[torch.randint(colors, alpha.shape, generator=generator)]
    return BillboardCloud(
        centers=centers.float(),
        rights=frames[:, 0].float(),
        ups=frames[:, 1].float(),
        half_extents=torch.full((count, 2), 0.06),
        texture_sizes=torch.full((count, 2), side),
        two_sided=torch.zeros(count, dtype=torch.bool),
        texels=torch.cat([color, alpha[:, None]], 1),
        alpha=MODES[mode],
    )


def cards_of(cloud: BillboardCloud) -> Cards:
    """A model's cards with a PNG's empty gaps, and the mip levels that programs compute."""
    cards = shipped_model(cloud, ExportConfig(mipmaps=False)).cards
    return replace(cards, chain=tuple(plain_chain(cards.atlas.image)))


def cameras(side: int) -> Camera:
    """Views that the fit of gaps does not use."""
    points = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return Orbit(7, (12.0, 37.0)).frame(points, target=torch.zeros(3, dtype=torch.float64), width=side, height=side)


def drawn(cards: Cards, side: int, *, mips: bool = True, smooth: bool = True) -> Tensor:
    """Pictures with the mip levels that programs compute, and with smooth edges."""
    alpha = replace(cards.alpha, antialiased=smooth and cards.alpha.kind == "mask")
    shown = replace(cards, chain=cards.chain if mips else None, alpha=alpha)
    return CardRenderer(shown, multisampled=smooth).draw(cameras(side)).double()


@pytest.fixture(scope="module", params=sorted(MODES))
def both(request: pytest.FixtureRequest) -> tuple[Cards, Cards]:
    """Cards with empty and with filled gaps."""
    cards = cards_of(crown(request.param))
    return cards, with_filled_gaps(cards)


def test_from_near_nothing_changes(both: tuple[Cards, Cards]) -> None:
    """But where several samples of a pixel at the edge of a card seen at a slant show what lies far beyond it."""
    empty, filled = both
    assert not np.array_equal(empty.atlas.image, filled.atlas.image)
    assert torch.equal(*(drawn(cards, NEAR, mips=False, smooth=False) for cards in both))
    assert float((drawn(empty, NEAR, mips=False) - drawn(filled, NEAR, mips=False)).square().mean()) < 1e-5


def test_from_afar_cards_show_what_they_show_from_near(both: tuple[Cards, Cards]) -> None:
    near = torch.stack([shrunk(picture, FAR, FAR) for picture in drawn(both[0], NEAR, mips=False)])
    before, after = (float((drawn(cards, FAR) - near).square().mean()) for cards in both)
    assert after < 0.5 * before
    fewer, dense = (densities(cards, cards.chain or (), (4,))[0] for cards in both)
    assert 2 * fewer < dense < 1


def test_dense_cards_keep_empty_gaps() -> None:
    cards = cards_of(replace(crown("mask", 1.0), alpha=AlphaMode("mask", 0.01)))
    assert with_filled_gaps(cards) is cards
    hidden = crown("mask")
    hidden.texels[:, 3] = 0
    nothing = cards_of(hidden)
    assert with_filled_gaps(nothing) is nothing


def test_a_palette_stays_a_palette() -> None:
    cards = cards_of(crown("blend", colors=PALETTE - 32))
    assert len(distinct(cards.atlas.image)) <= PALETTE
    filled = with_filled_gaps(cards)
    assert len(distinct(cards.atlas.image)) < len(distinct(filled.atlas.image)) <= PALETTE
    many = cards_of(crown("blend", colors=2 * PALETTE))
    assert len(distinct(with_filled_gaps(many).atlas.image)) > PALETTE


def test_the_same_cards_get_the_same_gaps() -> None:
    cards = cards_of(crown("mask"))
    assert np.array_equal(*(with_filled_gaps(cards).atlas.image for _ in range(2)))


def test_a_model_that_is_first_drawn_without_gradients_has_the_same_gaps() -> None:
    """As an evaluation draws it, which makes its cards."""
    cloud = crown("mask")
    camera = cameras(FAR)
    made, drawn = shipped_model(cloud), shipped_model(cloud)
    assert made.glb
    with torch.inference_mode():
        pictures = made.draw(camera), drawn.draw(camera)
    assert torch.equal(*pictures) and drawn.glb == made.glb
    assert not np.array_equal(made.cards.atlas.image, shipped_model(cloud, ExportConfig(mipmaps=False)).cards.atlas.image)


def test_only_pictures_that_programs_average_have_filled_gaps() -> None:
    cloud, steps = crown("mask"), list[tuple[str, int, int]]()
    empty = cards_of(cloud).atlas.image
    png = shipped_model(cloud, on_progress=lambda *step: steps.append(step)).cards
    assert not np.array_equal(png.atlas.image, empty)
    assert png.chain is not None
    assert all(np.array_equal(*pair) for pair in zip(png.chain, plain_chain(png.atlas.image), strict=True))
    assert steps[-1] == ("mip levels", len(steps), len(steps))
    own = shipped_model(cloud, ExportConfig(textures="ktx2", fallback=False))
    assert np.array_equal(own.cards.atlas.image, empty) and own.cards.averaged is None


def test_a_png_beside_ktx2_has_filled_gaps(tmp_path: Path) -> None:
    """In a GLB and in an OBJ: programs that cannot read KTX2 average the levels of the PNG. The levels of KTX2 are of empty gaps."""
    cloud = crown("mask")
    png, both = (shipped_model(cloud, ExportConfig(textures=textures)) for textures in ("png", "ktx2"))  # type: ignore[arg-type]
    alone = shipped_model(cloud, ExportConfig(textures="ktx2", fallback=False))
    filled = png.cards.atlas.image
    assert both.cards.chain is not None and alone.cards.chain is not None
    assert all(np.array_equal(*levels) for levels in zip(both.cards.chain, alone.cards.chain, strict=True))
    files = texture_files(both.cards, both.config)
    assert files["atlas.ktx2"] == texture_files(alone.cards, alone.config)["atlas.ktx2"]
    pictures = [files["atlas.png"]]
    for model, name in ((both, "both"), (alone, "alone")):
        model.save(tmp_path / f"{name}.obj")
        pictures.append((tmp_path / f"{name}.png").read_bytes())
    assert all(np.array_equal(np.array(Image.open(io.BytesIO(data)).convert("RGBA")), filled) for data in pictures)
