"""What a graphics card shows of cards: near as the reference renderer, from afar by trilinear filtering; and levels matched to views."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from bbfit.checks import InputError
from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.hulls import with_hulls
from bbfit.exporting.mip_matching import matched_chain, with_mips
from bbfit.exporting.mips import mip_chain
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics, pinhole_intrinsics
from bbfit.geometry.cards import Atlas, Card, Cards
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit
from bbfit.operators.cards.reference import hits
from bbfit.operators.cards.sheets import SAMPLES, sheets_of
from bbfit.operators.drawing.reference import render_reference
from bbfit.rendering.cards import draw_cards

KINDS = ("one", "two", "mixed")


@pytest.fixture(autouse=True, params=["fused", "reference"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test here draws with each of both renderers."""
    monkeypatch.setattr(f"{__name__}.draw_cards", partial(draw_cards, backend=request.param))


def parallel(camera: Camera) -> Camera:
    """Cameras at the same places that see 3.5 meters in parallel projection."""
    intrinsics = orthographic_intrinsics(3.5, camera.width, camera.height).expand(len(camera), 3, 3)
    return Camera(camera.world_to_camera, intrinsics, camera.width, camera.height, True)


def inside(camera: Camera) -> Camera:
    """Cameras among the cards, which then are partly behind them."""
    eyes = torch.tensor([[0.1, 1.1, 0.15], [0.4, 0.9, -0.1], [-0.3, 1.3, 0.2]], dtype=torch.float64)
    ahead = torch.tensor([[1.0, 0.2, 0.1], [-0.5, 0.1, 1.0], [0.3, -0.4, -1.0]], dtype=torch.float64)
    intrinsics = pinhole_intrinsics(80, camera.width, camera.height).expand(3, 3, 3)
    return Camera(look_at(eyes, eyes + ahead), intrinsics, camera.width, camera.height)


@pytest.mark.parametrize(
    ("kind", "seen"),
    [
        *((kind, lambda camera: camera) for kind in KINDS),
        ("two", parallel),
        ("two", inside),
        ("two", lambda camera: parallel(inside(camera))),
    ],
    ids=[*KINDS, "parallel", "inside", "parallel from inside"],
)
def test_without_mip_levels_it_is_the_reference(kind: str, seen: object, clouds: dict[str, BillboardCloud], orbit: Camera) -> None:
    """With one sample a pixel, up to the rounding to 8 bits of three layers' color and alpha; measured 0.6 / 255."""
    cameras = seen(orbit)  # type: ignore[operator]
    expected = render_reference(clouds[kind], cameras).float()
    assert expected[..., 3].amax((1, 2)).min() > 0.5, "an empty view shows nothing"
    image = draw_cards(cloud_cards(clouds[kind], 4), cameras, multisampled=False)
    assert image.shape == expected.shape and image.dtype == torch.float32
    assert float((image - expected).abs().max()) <= 1 / 255
    assert torch.equal(draw_cards(cloud_cards(clouds[kind], 4), cameras[1], multisampled=False), image[1])


@pytest.mark.parametrize("mode", [AlphaMode("mask", 0.4), AlphaMode("hash")], ids=["mask", "hash"])
def test_tests_of_alpha_are_those_of_the_reference(mode: AlphaMode, clouds: dict[str, BillboardCloud], orbit: Camera) -> None:
    """Of textures of 8 bits; only rounding in float32 could take a sample across the cutoff: measured no pixel, one is allowed."""
    for kind in KINDS:
        cloud = replace(clouds[kind], alpha=mode, texels=(clouds[kind].texels * 255).round() / 255)
        expected, image = render_reference(cloud, orbit).float(), draw_cards(cloud_cards(cloud, 4), orbit)
        assert set(image[..., 3].unique().tolist()) == {0.0, 1.0}
        assert int(((image - expected).abs().amax(-1) > 1e-5).sum()) <= 1


def test_coverage_is_that_of_the_reference(clouds: dict[str, BillboardCloud], orbit: Camera) -> None:
    """By four samples; only rounding could give a pixel one sample more or less: measured no pixel, one is allowed."""
    for kind in KINDS:
        texels, mode = (clouds[kind].texels * 255).round() / 255, AlphaMode("coverage")
        cloud = replace(clouds[kind], alpha=mode, texels=texels)
        expected, image = render_reference(cloud, orbit).float(), draw_cards(cloud_cards(cloud, 4), orbit, multisampled=False)
        assert set(image[..., 3].unique().tolist()) == {0.0, 0.25, 0.5, 0.75, 1.0}
        assert int(((image - expected).abs().amax(-1) > 1e-5).sum()) <= 1


def test_antialiased_masks_are_those_of_the_reference(clouds: dict[str, BillboardCloud], orbit: Camera) -> None:
    """Planes seen nearly edge-on differ, in 4 of 11,520 pixels (measured): there the next pixel reads another texture of the atlas."""
    for kind in KINDS:
        texels = (clouds[kind].texels * 255).round() / 255
        cloud = replace(clouds[kind], alpha=AlphaMode("mask", 0.4, antialiased=True), texels=texels)
        expected, image = render_reference(cloud, orbit).float(), draw_cards(cloud_cards(cloud, 4), orbit, multisampled=False)
        partly = (expected[..., 3] > 0.02) & (expected[..., 3] < 0.98)
        assert float(partly.float().mean()) > 0.02
        assert float(((image - expected).abs().amax(-1) > 1e-3).float().mean()) <= 5e-4


@pytest.mark.parametrize("mode", [AlphaMode("blend"), AlphaMode("hash"), AlphaMode("mask", antialiased=True)], ids=str)
def test_cameras_that_are_drawn_together_see_what_each_sees_alone(
    mode: AlphaMode, clouds: dict[str, BillboardCloud], orbit: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit by bit, in groups of any size; one of the cameras sees nothing."""
    back = torch.diag(torch.tensor([-1.0, 1, -1, 1])).to(orbit.world_to_camera)
    poses = torch.cat([orbit.world_to_camera, back @ orbit.world_to_camera[:1], orbit.world_to_camera])
    cameras = Camera(poses, orbit.intrinsics[:1].expand(len(poses), 3, 3), orbit.width, orbit.height)
    drawn = cloud_cards(replace(clouds["two"], alpha=mode), 4)
    alone = torch.stack([draw_cards(drawn, cameras[index]) for index in range(len(cameras))])
    assert not alone[len(orbit)].any() and alone[0].any()
    assert torch.equal(draw_cards(drawn, cameras), alone)
    monkeypatch.setattr("bbfit.operators.cards.reference._TOGETHER", 2 * cameras.width * cameras.height)
    assert torch.equal(draw_cards(drawn, cameras), alone)


def test_polygons_and_pieces_show_what_the_rectangles_do(crossed: BillboardCloud, orbit: Camera) -> None:
    """Hulls leave out what is transparent; halves that share an edge, which runs through pixels' centers, show each pixel once."""
    cards = cloud_cards(crossed, 4)
    whole = draw_cards(cards, orbit, multisampled=False)
    hulls = with_hulls(cards, 8, 0)
    assert all(abs(hull.corners - card.corners[0]).max() > 0 for hull, card in zip(hulls.cards, cards.cards, strict=True))
    torch.testing.assert_close(draw_cards(hulls, orbit, multisampled=False), whole, rtol=0, atol=1e-6)
    pieces = [piece for card in cards.cards for piece in halves(card)]
    for samples in (False, True):
        seen = [draw_cards(each, orbit, multisampled=samples) for each in (cards, cards.with_cards(pieces))]
        torch.testing.assert_close(*seen, rtol=0, atol=1e-6)
    missing = draw_cards(cards.with_cards(pieces[1:]), orbit)
    assert float((missing - whole).abs().max()) > 0.3 and float(missing.sum()) < float(whole.sum())
    face = Camera(look_at(torch.tensor([[0.1, 1.1, 4.0]]).double(), torch.tensor([0.1, 1.1, 0.0]).double()), orbit.intrinsics[:1], 47, 41)
    face = Camera(face.world_to_camera, pinhole_intrinsics(40, 47, 41)[None], 47, 41)  # the middle column lies on the edge
    torch.testing.assert_close(draw_cards(cards.with_cards(pieces), face), draw_cards(cards, face), rtol=0, atol=1e-6)
    cut, whole_cards = sheets_of(cards.with_cards(pieces)), sheets_of(cards)
    met, once = hits(cards, cut, face[0]), hits(cards, whole_cards, face[0])
    assert len(cut) == len(whole_cards) == 2 and torch.bincount(cut.of_piece).tolist() == [2, 2]
    for name in ("sheet", "x", "y"):
        assert torch.equal(getattr(met, name), getattr(once, name))


def halves(card: Card) -> list[Card]:
    """A quad cut down the middle."""
    made = []
    for order in ((0, None, None, 3), (None, 1, 2, None)):
        corners, uvs = (
            np.stack([values[k] if k is not None else middle for k, middle in zip(order, middles, strict=True)])
            for values in (card.corners, card.uvs)
            for middles in [[(values[0] + values[1]) / 2] * 2 + [(values[2] + values[3]) / 2] * 2]
        )
        made.append(replace(card, corners=corners, uvs=uvs))
    return made


def plate(size: int, levels: int) -> Cards:
    """A square of two meters whose texture fills an atlas, and mip levels that are each of one color and alpha: 250 - 20 * level."""
    chain = [np.full((size >> n, size >> n, 4), 250 - 20 * n, np.uint8) for n in range(levels)]
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uvs = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    atlas = Atlas(chain[0], np.zeros((1, 2), np.int64), np.full((1, 2), size))
    return Cards((Card(corners, uvs, np.array([0.0, 0, 1]), False, 0),), atlas, chain=tuple(chain))


def facing(pixels_a_texel: float, size: int) -> Camera:
    """A parallel camera of 9 x 9 pixels before a plate."""
    pose = look_at(torch.tensor([[0.0, 0, 3]]).double(), torch.zeros(3).double())[0]
    return Camera(pose, orthographic_intrinsics(9 / pixels_a_texel * 2 / size, 9, 9), 9, 9, True)


def test_a_card_shows_in_the_samples_that_it_holds() -> None:
    """A plate of 5.2 x 5.2 pixels around each of some places, opaque up to its edges; the samples of a pixel are its center, or four."""
    cards = plate(128, 1)
    camera = facing(5.2 / 128, 128)
    x, y = np.meshgrid(np.arange(9), np.arange(9))
    for right, down in ((0.0, 0.0), (0.3, -0.45), (-0.5, 0.5), (3.1, -2.7), (-7.0, 0.0)):
        intrinsics = camera.intrinsics + torch.tensor([[0, 0, right], [0, 0, down], [0, 0, 0]])
        for samples in (((0.0, 0.0),), SAMPLES):
            image = draw_cards(cards, replace(camera, intrinsics=intrinsics), multisampled=len(samples) > 1)
            held = [(abs(x + over - 4 - right) <= 2.6) & (abs(y + under - 4 - down) <= 2.6) for over, under in samples]
            np.testing.assert_allclose(image[..., 3].numpy(), np.mean(held, 0) * 250 / 255, atol=1e-6)


@pytest.mark.parametrize("mode", [AlphaMode("blend"), AlphaMode("mask", antialiased=True), AlphaMode("coverage")], ids=str)
def test_samples_are_pictures_from_beside(mode: AlphaMode, orbit: Camera) -> None:
    """Of cards of one color and alpha each, a picture is the mean of four with one sample, whose pixels are moved to the four samples.

    But for pixels in which cards cross, where the order of all samples is that at the center: measured 0.1 % of the pixels, while a picture
    with one sample differs in 5 to 9 %.
    """

    def off(one: Tensor, other: Tensor) -> float:
        return float((one - other).abs().amax(-1).gt(1e-5).float().mean())

    generator, side = np.random.default_rng(3), 16
    image = np.repeat(generator.integers(60, 256, (1, 12, 4), dtype=np.uint8), side, 1).repeat(3 * side, 0)
    cards = []
    for number in range(12):
        middle, right, up = np.array([0.1, 1.1, 0.15]) + generator.normal(0, 0.6, 3), *generator.normal(0, 0.3, (2, 3))
        left, top = number / 12 + 1 / 36, 1 / 3
        quad = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners, uvs = middle + quad @ [right, up], (left, top) + (quad * (1, -1) + 1) / 2 * (1 / 36, 1 / 3)
        cards.append(Card(corners, uvs, np.cross(right, up) / np.linalg.norm(np.cross(right, up)), False, number))
    corners, sizes = np.array([[side * number, 0] for number in range(12)]), np.full((12, 2), (side, 3 * side))
    drawn = Cards(tuple(cards), Atlas(image, corners, sizes), alpha=mode)
    moved = [torch.tensor([[0.0, 0, -right], [0, 0, -down], [0, 0, 0]]) for right, down in SAMPLES]
    # What a sample shows of coverage, it shows of a mask with the sample's cutoff.
    modes = [AlphaMode("mask", (number + 0.5) / 4) if mode.kind == "coverage" else mode for number in range(4)]
    parts = [
        draw_cards(replace(drawn, alpha=own), replace(orbit, intrinsics=orbit.intrinsics + move), multisampled=False)
        for own, move in zip(modes, moved, strict=True)
    ]
    pictures, expected = draw_cards(drawn, orbit), torch.stack(parts).mean(0)
    assert off(pictures, expected) <= 0.003 < 0.03 < off(parts[0], expected)


@pytest.mark.parametrize(("step", "level"), [(0.4, 0.0), (1.0, 0.0), (2.0, 1.0), (3.0, math.log2(3)), (5.0, math.log2(5)), (12.0, 3.0)])
def test_the_level_of_detail_is_read_off_the_picture(step: float, level: float) -> None:
    """So many texels a pixel, face to face; of four levels the last serves all that is farther."""
    cards = plate(128, 4)
    image = draw_cards(cards, facing(1 / step, 128))
    assert float(image[4, 4, 3]) * 255 == pytest.approx(250 - 20 * level, abs=1e-3)
    assert float(draw_cards(replace(cards, chain=None), facing(1 / step, 128))[4, 4, 3]) * 255 == pytest.approx(250, abs=1e-4)


def test_the_cutoff_is_applied_to_what_the_levels_mix() -> None:
    """Alpha 250, 230, 210 and 190: with a cutoff of 220 / 255 level 1.5 still shows, and opaque."""
    cards = plate(128, 4)
    for level, shown in ((1.48, 1.0), (1.52, 0.0)):
        masked = replace(cards, alpha=AlphaMode("mask", 220 / 255))
        assert float(draw_cards(masked, facing(2.0**-level, 128))[4, 4, 3]) == shown
    at = replace(cards, alpha=AlphaMode("mask", 210 / 255))
    assert float(draw_cards(at, facing(0.25, 128))[4, 4, 3]) == 1.0


def slow_sample(level: NDArray[np.uint8], u: float, v: float) -> NDArray[np.float64]:
    """One bilinear sample in [0, 255], clamped to the edge."""
    height, width = level.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    total = np.zeros(4)
    for column in (math.floor(x), math.floor(x) + 1):
        for row in (math.floor(y), math.floor(y) + 1):
            texel = level[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
            total += (1 - abs(x - column)) * (1 - abs(y - row)) * texel
    return total


def slow_card(card: Card, chain: list[NDArray[np.uint8]], camera: Camera) -> NDArray[np.float64]:
    """A one-sided quad by a ray for every pixel, and two more half a thousandth of a pixel beside it for each derivative."""
    pose, k = camera.world_to_camera.numpy(), camera.intrinsics.numpy()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    across, along = card.corners[1] - card.corners[0], card.corners[3] - card.corners[0]
    size = np.array(chain[0].shape[1::-1])

    def place(x: float, y: float) -> tuple[float, float]:
        ray = pose[:3, :3].T @ np.linalg.solve(k, [x, y, 1.0])
        hit = eye + ray * ((card.corners[0] - eye) @ card.normal / (ray @ card.normal)) - card.corners[0]
        return hit @ across / (across @ across), hit @ along / (along @ along)

    def uv(x: float, y: float) -> NDArray[np.float64]:
        a, b = place(x, y)
        return card.uvs[0] + a * (card.uvs[1] - card.uvs[0]) + b * (card.uvs[3] - card.uvs[0])

    image = np.zeros((camera.height, camera.width, 4))
    for y in range(camera.height):
        for x in range(camera.width):
            a, b = place(x, y)
            if not (0.002 < a < 0.998 and 0.002 < b < 0.998):
                image[y, x] = np.nan if -0.002 < a < 1.002 and -0.002 < b < 1.002 else 0  # too near to the edge to tell
                continue
            h = 5e-4
            rates = [np.linalg.norm((uv(x + i, y + j) - uv(x - i, y - j)) * size) / (2 * h) for i, j in ((h, 0), (0, h))]
            detail = min(max(math.log2(max(rates)), 0), len(chain) - 1)
            low, u_v = min(int(detail), len(chain) - 2), uv(x, y)
            both = [slow_sample(level, *u_v) for level in chain[low : low + 2]]
            image[y, x] = (both[0] + (both[1] - both[0]) * (detail - low)) / 255
    image[..., :3] *= image[..., 3:]
    return image


def test_trilinear_filtering_of_slanted_cards_is_that_of_a_slow_viewer(clouds: dict[str, BillboardCloud], orbit: Camera) -> None:
    """Textures much finer than pixels, seen at a slant; what is left is float32 and the difference quotient: measured 9e-8."""
    cloud = clouds["one"].take([0])
    noise = torch.rand(20 * 13 * 64, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    cloud = replace(cloud, texture_sizes=cloud.texture_sizes * 8, texels=noise)
    cards = cloud_cards(cloud, 4)
    chain = mip_chain(cards.atlas, None)
    levelled = replace(cards, chain=tuple(chain))
    shown, different = 0, 0
    for index in range(len(orbit)):
        camera = orbit[index].resized(36, 30)
        expected = slow_card(cards.cards[0], chain, camera)
        known = ~np.isnan(expected).any(-1)
        shown += int(np.count_nonzero(expected[known][:, 3]))
        image = draw_cards(levelled, camera, multisampled=False).numpy()
        np.testing.assert_allclose(image[known], expected[known], rtol=0, atol=1e-6)
        different += int((np.abs(draw_cards(cards, camera).numpy() - image).max(-1) > 0.1).sum())
    assert shown > 300 and different > 100, "nothing is seen, or the levels make no difference"


def test_bad_chains_are_refused(crossed: BillboardCloud, orbit: Camera) -> None:
    cards = cloud_cards(crossed, 4)
    chain = mip_chain(cards.atlas, None)
    with pytest.raises(InputError, match="chain: has no levels"):
        draw_cards(replace(cards, chain=()), orbit)
    with pytest.raises(InputError, match=r"chain: level 1 is uint8 .* expected uint8"):
        draw_cards(replace(cards, chain=(chain[0], *chain[2:])), orbit)
    with pytest.raises(InputError, match="chain: level 0 is float64"):
        draw_cards(replace(cards, chain=(chain[0] / 255.0,)), orbit)  # type: ignore[arg-type]


def leafy(kind: str) -> tuple[BillboardCloud, Camera]:
    """Four crossed planes of small soft-rimmed leaves, denser in the middle, and 12 views of them of 96 x 96 pixels."""
    planes = even_upright(4, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([80, 80]))
    generator = np.random.default_rng(5)
    y, x = np.mgrid[-1:1:80j, -1:1:80j]
    textures = []
    for _ in range(4):
        noise = ndimage.gaussian_filter(generator.random((80, 80)), 1.2)
        alpha = np.clip(0.5 + (noise - noise.mean()) / noise.std() - 3 * (x**2 + y**2), 0, 1)
        textures.append(np.concatenate([generator.random((80, 80, 3)), alpha[..., None]], -1))
    cloud = planes.with_texels(torch.from_numpy(np.stack(textures)).float().reshape(-1, 4))
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double().numpy()
    camera = Orbit(24, (-20.0, 20.0)).frame(corners, target=torch.zeros(3).double(), width=96, height=96)
    return replace(cloud, alpha=AlphaMode(kind)), camera  # type: ignore[arg-type]


def share(cards: Cards, camera: Camera, chain: list[NDArray[np.uint8]], wanted: Tensor, halving: int) -> float:
    """Coverage in pictures of 2^-halving the size over what is wanted, the mean over 2 x 2 places of the pixels' grid."""
    small, drawn, levelled = camera.resized(camera.width >> halving, camera.height >> halving), [], replace(cards, chain=tuple(chain))
    for right, down in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]:
        intrinsics = small.intrinsics + torch.tensor([[0, 0, right], [0, 0, down], [0, 0, 0]], dtype=torch.float64)
        drawn.append(draw_cards(levelled, Camera(small.world_to_camera, intrinsics, small.width, small.height))[..., 3].mean())
    return float(torch.stack(drawn).mean() / wanted.mean())


@pytest.mark.parametrize(("kind", "least", "most"), [("mask", 0.2, 0.05), ("blend", 0.04, 0.01), ("coverage", 0.2, 0.05)])
def test_matched_levels_cover_as_much_as_the_views_from_everywhere(kind: str, least: float, most: float) -> None:
    """From views that they were not matched to, of a half and an eighth of the size.

    A mask is farther off than a blend, twelve views being few; other rounding may move a texel of 12 x 12 pixels' textures.
    Unmatched, at an eighth, a mask covers 0.65, a blend 1.07 and coverage 0.55 of what it should.
    """
    cloud, camera = leafy(kind)
    cards = cloud_cards(cloud, 8)
    chain = mip_chain(cards.atlas, 0.5 if kind == "mask" else None)
    coverages = draw_cards(cards, camera)[..., 3].mean((1, 2))
    matched = matched_chain(cards, chain, camera[::2])
    assert abs(share(cards, camera[1::2], chain, coverages[1::2], 3) - 1) > least
    for halving in (1, 3):
        assert share(cards, camera[1::2], matched, coverages[1::2], halving) == pytest.approx(1, abs=most)
    assert matched[0] is chain[0] and len(matched) == len(chain)
    for level, other in zip(matched, chain, strict=True):
        assert level.dtype == np.uint8 and level.flags.c_contiguous
        np.testing.assert_array_equal(level[..., :3], other[..., :3])


def test_a_hash_is_matched_like_a_blend() -> None:
    cloud, camera = leafy("blend")
    cards = cloud_cards(cloud, 8)
    chain, hashed = mip_chain(cards.atlas, None), replace(cards, alpha=AlphaMode("hash"))
    for level, other in zip(matched_chain(hashed, chain, camera[0]), matched_chain(cards, chain, camera[0]), strict=True):
        np.testing.assert_array_equal(level, other)


def test_cards_get_levels_by_views_of_their_own() -> None:
    """Seen by cameras of the fit's and a quarter of their size; nothing to show stays nothing."""
    cloud, camera = leafy("mask")
    plain = cloud_cards(cloud, 8)
    cards = with_mips(plain)
    assert cards.chain and cards.chain[0] is cards.atlas.image and cards.chain[-1].shape == (1, 1, 4)
    coverages = draw_cards(plain, camera)[..., 3].mean((1, 2))
    assert share(plain, camera, list(cards.chain), coverages, 2) == pytest.approx(1, abs=0.03)  # measured 0.976
    empty = cloud_cards(replace(cloud, texels=torch.zeros_like(cloud.texels)), 8)
    for level, other in zip(with_mips(empty).chain or (), mip_chain(empty.atlas, 0.5), strict=True):
        np.testing.assert_array_equal(level, other)


def test_views_that_see_nothing_are_refused() -> None:
    cloud, camera = leafy("mask")
    cards = cloud_cards(cloud, 8)
    away = Camera(look_at(camera.position, 2 * camera.position), camera.intrinsics, 96, 96)
    with pytest.raises(InputError, match="cameras: none sees a card"):
        matched_chain(cards, mip_chain(cards.atlas, 0.5), away)
